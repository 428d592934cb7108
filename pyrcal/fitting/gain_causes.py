"""Find causes of mode gains far from 1: the scaling of each mode, or a common unit.

The gain of a mode is the amplitude of its measured column over the model's. Modes with another
normalisation have gains proportional to, for example, one over their peak to valley; a wrong unit
is common to all modes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.methods import Settled
from service.model.modes import ModalBasis

Array = NDArray[np.float64]

MIN_SCATTER = 0.06
"""Robust relative scatter of gains above which a cause is searched in each mode."""

MAX_SCATTER_RATIO = 0.3
"""Largest scatter that a normalisation may leave, over the original scatter, to be the cause."""

MAX_CAUSE_SCATTER = 0.08
"""Largest scatter that a normalisation may leave to be the cause."""

MAX_SMOOTH_SCATTER = 0.05
"""Largest scatter about a parabola in the logarithm of the mode number that counts as smooth."""

DIMMED_GAIN = 0.9
"""Median gain below which an optical gain in residual turbulence is considered."""

UNIT_TOLERANCE = 0.03
"""Relative distance from a unit's factor within which the unit is reported."""

_SLOPE_SIZE = "the size of their slopes, as normalised columns do"

_N_POINTS = 4000
"""Approximate number of pupil points at which modes are evaluated."""

_MIN_MODES = 8
"""Smallest number of modes for which the scatter is evaluated."""


def find_gain_causes(settled: Settled, *, passes: int, stroke_known: bool) -> Iterator[str]:
    """Yield likely causes of gains that are far from 1, one sentence each."""
    gains = settled.solution.projection.gains
    if len(gains) < 1 or np.any(gains <= 0.0):
        if np.all(gains < 0.0):
            yield (
                "every mode answers with the wrong sign: commands or slopes have the other sign; "
                "turn the sign of orientation in [slopes], or leave orientation to be found"
            )
        return
    if stroke_known:
        yield from _find_unit(float(np.median(gains)), settled, passes)
    if len(gains) < _MIN_MODES or scatter_of(gains) <= MIN_SCATTER:
        return
    # multiplied by the norm that the modes were divided by, the gains become equal
    sizes = _compute_norms(settled)
    apart = {words: scatter_of(gains * size) for words, size in sizes.items()}
    words = min(apart, key=lambda one: apart[one])
    if apart[words] < min(MAX_SCATTER_RATIO * scatter_of(gains), MAX_CAUSE_SCATTER):
        middle = float(np.median(gains * sizes[words]))
        times = (
            ""
            if abs(middle - 1.0) < UNIT_TOLERANCE or words == _SLOPE_SIZE
            else f", times {middle:.3g}"
        )
        yield (
            f"the gains go as one over {words}{times}: the matrix's modes are scaled so, the "
            "file's are not; the registration does not depend on it"
        )
    elif (
        stroke_known
        and float(np.median(gains)) < DIMMED_GAIN
        and _is_smooth(gains, settled.target.modes)
    ):
        low, high = np.percentile(gains, [5.0, 95.0])
        yield (
            f"the gains run smoothly from {low:.2g} to {high:.2g} over the modes, as the optical "
            "gain of a pyramid in residual turbulence does; the registration does not depend on it"
        )


def scatter_of(values: Array) -> float:
    """Return the robust relative scatter of positive values."""
    logarithms = np.log(values)
    return float(np.median(np.abs(logarithms - np.median(logarithms)))) * 1.4826


def _find_unit(middle: float, settled: Settled, passes: int) -> Iterator[str]:
    """Yield the unit that explains a common factor of all gains."""
    wavelength_m = settled.models.instrument.wfs.wavelength_m
    radian_m = wavelength_m / (2.0 * np.pi)
    units = {
        "per wave of OPD: divide it by the wavelength": wavelength_m,
        "per radian of phase: multiply it by 2 pi over the wavelength": radian_m,
        "per millimetre: multiply it by 1000": 1e-3,
        "per micrometre: multiply it by 1e6": 1e-6,
        "per nanometre: multiply it by 1e9": 1e-9,
    }
    # A file that states two passes has its matrix divided by them already.
    if passes == 1:
        units["of both passes and per metre of surface: divide it by 4"] = 4.0
    for words, unit in units.items():
        if abs(np.log(middle / unit)) < UNIT_TOLERANCE:
            yield f"the gains' median is {middle:.3g}: the matrix is {words}"


def _compute_norms(settled: Settled) -> Mapping[str, Array]:
    """Return the norms by which modes may have been scaled, ``(n_modes,)`` each."""
    basis, points = settled.models.basis, settled.models.cheap.pupil.points
    shapes = basis.render(points[:: 1 + len(points) // _N_POINTS])
    sizes = {
        "the modes' peak to valley": np.ptp(shapes, axis=0),
        "the modes' largest value": np.abs(shapes).max(axis=0),
        "the modes' RMS": shapes.std(axis=0),
        _SLOPE_SIZE: np.linalg.norm(np.asarray(settled.solution.matrix, dtype=np.float64), axis=0),
    }
    if isinstance(basis, ModalBasis):
        sizes["the largest stroke of their actuators"] = np.abs(basis.mode_to_actuator).max(axis=0)
        sizes["the norm of their strokes"] = np.linalg.norm(basis.mode_to_actuator, axis=0)
    return sizes


def _is_smooth(gains: Array, modes: NDArray[np.intp]) -> bool:
    """Return True if gains are a smooth function of the mode number."""
    order = np.log1p(modes.astype(np.float64))
    logarithms = np.log(gains)
    left = logarithms - np.polyval(np.polyfit(order, logarithms, 2), order)
    return bool(np.std(left) < MAX_SMOOTH_SCATTER)
