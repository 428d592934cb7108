"""Hold a matrix and a basis against the numbered rules of docs/reference/conventions.md.

Each finding has the number of its rule, what was measured and what is allowed. What an instrument
file leaves open (``orientation = "auto"``, ``stroke = "unknown"``) breaks no rule.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import fit_matrix
from pyrcal.fitting.recorded import read_recorded
from pyrcal.terminal import print_lines
from service.errors import MatrixError, ModelError
from service.estimation.reference import Reference
from service.files.disk_cache import cached_basis
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.misregistration import wrap_angle
from service.model.pupil import instrument_pupil, rtc_valid_subapertures
from service.model.slopes import FLIPS

Array = NDArray[Any]

AXES, ROTATION, MODES, ORDER, SIGN, MATRIX, PASSES = 1, 2, 9, 10, 11, 13, 15
"""Rules that can be measured."""

MAX_ROTATION_DEG = 20.0
"""Largest rotation from the nominal one, if that is known, degrees; a larger one indicates that
rows and columns start at another corner."""

MAX_GAIN_CHANGE = 0.3
"""Largest ratio of all gains, less 1: wavelength and flux change them, a factor of two is a wrong
number of passes."""

_A_PASS = 0.3
"""Range around a factor of two, in powers of two, that indicates a wrong number of passes."""

MAX_MODE_CHANGE = 0.4
"""Largest relative deviation of a mode's gain from the common gain."""

MIN_LIKENESS = 0.5
"""Smallest correlation of a column with the model of its mode."""

MAX_RESIDUAL = 0.2
"""Largest RMS residual of the model; a larger one indicates another order of slopes."""

HEIGHTS_M = (0.05, 50.0)
"""Plausible range of a mode's peak over the pupil, metres per unit command."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RuleCheck:
    """Result of the check of one rule."""

    rule: int
    """Number in docs/reference/conventions.md."""

    deviation: float
    """Measured deviation, in the unit given in the text."""

    limit: float = 0.0
    """Largest deviation that keeps the rule."""

    text: str
    """Sentence with the measured and the expected value."""

    @property
    def kept(self) -> bool:
        """True if the rule is kept."""
        return self.deviation <= self.limit


def main(options: argparse.Namespace) -> int:
    """Hold a matrix in a file against the rules, print what was found; return the exit status.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used.
    """
    instrument = load_instrument(options.instrument)
    recorded = read_recorded(options.reference, options.dataset)
    findings = check(instrument, recorded.values, columns=recorded.modes)
    print_lines(
        f"rule {one.rule:2} {'kept' if one.kept else 'BROKEN'}: {one.text}" for one in findings
    )
    return int(not all(one.kept for one in findings))


def check(
    instrument: Instrument,
    matrix: Array | None = None,
    *,
    columns: Array | None = None,
) -> tuple[RuleCheck, ...]:
    """Return every rule that could be measured; broken ones have ``kept`` False.

    Parameters
    ----------
    instrument
        Says what it states; its modes are held against the rules, too.
    matrix
        ``(n_slopes, n_modes)`` as its file has it.
    columns
        Basis index of each column; None: the first ones.
    """
    findings = [*_basis(instrument)]
    if matrix is not None:
        findings += _matrix(instrument, np.asarray(matrix), columns)
    return tuple(findings)


# --- modes


def _basis(instrument: Instrument) -> Iterator[RuleCheck]:
    """Yield checks of the modes' shapes over the pupil, for the lowest modes."""
    if not instrument.mirror.stroke_known:
        return
    basis = cached_basis(instrument)
    lowest = basis.subset(np.arange(min(basis.n_modes, 20)))
    pupil = instrument_pupil(instrument, 3)
    shapes = lowest.render(pupil.points)
    mean = pupil.weights @ shapes
    peak = float(np.median(np.abs(shapes - mean).max(axis=0)))
    low, high = HEIGHTS_M
    yield RuleCheck(
        rule=MODES,
        # In powers of ten: a basis in another unit is outside by three or more.
        deviation=float(max(np.log10(low / peak), np.log10(peak / high), 0.0)) if peak else np.inf,
        text=f"peak of a mode: {peak:.3g} m per unit command; expected metres of OPD",
    )


# --- a matrix


def _matrix(instrument: Instrument, matrix: Array, columns: Array | None) -> Iterator[RuleCheck]:
    n_planes = instrument.slopes.kind.n_planes
    n_slopes = n_planes * int(rtc_valid_subapertures(instrument).sum())
    shape = RuleCheck(
        rule=MATRIX,
        deviation=abs(matrix.shape[0] - n_slopes) if matrix.ndim == 2 else np.inf,
        text=f"shape {matrix.shape}; expected ({n_slopes} slopes, n_modes)",
    )
    yield shape
    if not shape.kept:
        return
    reference = Reference(
        matrix=matrix,
        modes=np.arange(matrix.shape[1]) if columns is None else np.asarray(columns),
        double_pass=instrument.double_pass,
    )
    # The fit finds axes and signs by itself: they are compared with the stated ones below.
    free = replace(instrument, slopes=replace(instrument.slopes, orientation=None))
    try:
        with threadpool_limits(1):
            fit = fit_matrix(free, reference)
    except (MatrixError, ModelError) as error:
        yield RuleCheck(rule=MATRIX, deviation=np.inf, text=str(error))
        return
    yield from _axes(instrument, fit)
    yield from _gains(instrument, fit)
    yield from _columns(fit)
    yield RuleCheck(
        rule=ORDER,
        deviation=fit.residual_fraction,
        limit=MAX_RESIDUAL,
        text=f"{fit.residual_fraction:.3f} of the matrix is left over by the model; expected "
        "subapertures row by row over the mask, every one in its place",
    )


def _axes(instrument: Instrument, fit: Fit) -> Iterator[RuleCheck]:
    """Yield the check of the slopes' order and signs against the stated ones."""
    stated, found = instrument.slopes.orientation, fit.orientation
    yield RuleCheck(
        rule=ORDER,
        deviation=float(fit.order is not instrument.slopes.order),
        text=f"order {fit.order}; stated {instrument.slopes.order}",
    )
    if stated is not None:
        flips = sum(getattr(stated, one) is not getattr(found, one) for one in FLIPS)
        yield RuleCheck(
            rule=AXES,
            deviation=float(flips),
            text=f"axes {found}; stated {stated}",
        )
        signs = abs(stated.sign_x - found.sign_x) + abs(stated.sign_y - found.sign_y)
        yield RuleCheck(
            rule=SIGN,
            deviation=signs / 2,
            text=f"signs {found.sign_x}, {found.sign_y} of Sx and Sy; stated {stated.sign_x}, "
            f"{stated.sign_y}",
        )
    nominal = instrument.mirror.nominal_rotation_rad
    if nominal is not None:
        away = float(np.rad2deg(abs(wrap_angle(fit.alpha.rotation_rad - nominal))))
        yield RuleCheck(
            rule=ROTATION,
            deviation=away,
            limit=MAX_ROTATION_DEG,
            text=f"{away:.1f} deg from the nominal rotation",
        )


def _gains(instrument: Instrument, fit: Fit) -> Iterator[RuleCheck]:
    """Yield the check of the columns' norms against the model's."""
    if not instrument.mirror.stroke_known or "wfs.wavelength_m" in instrument.unknown:
        return
    median = float(np.median(fit.gains))
    # A factor of two is a wrong number of passes, or surface instead of OPD.
    twice = abs(abs(np.log2(max(median, 1e-300))) - 1.0) < _A_PASS
    yield RuleCheck(
        rule=PASSES if twice else MATRIX,
        deviation=abs(median - 1.0),
        limit=MAX_GAIN_CHANGE,
        text=f"columns are {median:.3g} times the model's; expected slope per metre of OPD"
        + (", passes divided out" if twice else ""),
    )
    apart = float(np.abs(fit.gains / median - 1.0).max())
    yield RuleCheck(
        rule=MODES,
        deviation=apart,
        limit=MAX_MODE_CHANGE,
        text=f"a column is {apart:.0%} larger or smaller than all; expected one unit for all modes",
    )


def _columns(fit: Fit) -> Iterator[RuleCheck]:
    """Yield the check of the column that correlates least with its own mode."""
    measured, model = _unit(fit.measured), _unit(fit.synthetic)
    alike = np.einsum("ij,ij->j", measured, model)
    worst = int(np.argmin(alike))
    yield RuleCheck(
        rule=MODES,
        deviation=float(MIN_LIKENESS - alike[worst]),
        text=f"column of mode {fit.modes[worst]} correlates by {alike[worst]:.2f} with that mode; "
        "expected the modes of the basis in their order and signs",
    )


def _unit(columns: Array) -> Array:
    values = np.nan_to_num(np.asarray(columns, dtype=np.float64))
    return np.asarray(values / np.linalg.norm(values, axis=0))
