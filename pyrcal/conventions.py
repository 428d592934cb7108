"""Hold a matrix, a basis or a stream against the numbered rules of docs/reference/conventions.md.

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

AXES, ROTATION, OPD, MODES, ORDER = 1, 2, 8, 9, 10
SIGN, MATRIX, LAW, PASSES, TIME = 11, 13, 14, 15, 17
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

COMMANDS_M = (1e-11, 1e-4)
"""Plausible range of the RMS of commands, metres."""

MAX_SLOPE = 3.0
"""Largest plausible RMS of slopes, which are dimensionless."""

YEARS_NS = (946_684_800_000_000_000, 4_102_444_800_000_000_000)
"""Plausible range of times: 2000 to 2100, nanoseconds since 1970."""

MAX_LAW_RESIDUAL = 0.5
"""Largest RMS of command steps that the control law does not explain, relative to all steps."""


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stream:
    """Telemetry of a closed loop."""

    t_ns_utc: Array
    """``(n_frames,)`` nanoseconds."""

    slopes: Array
    """``(n_frames, n_slopes)`` as the RTC lists them."""

    commands: Array
    """``(n_frames, n_modes)`` metres OPD, as they were on the mirror during the frame."""

    reconstructor: Array
    """``(n_modes, n_slopes)`` metres per slope."""

    frame_rate_hz: float
    delay_frames: int = 1
    """Frames from an exposure to its correction."""


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
    stream: Stream | None = None,
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
    stream
        Telemetry of its loop.
    """
    findings = [*_basis(instrument)]
    if matrix is not None:
        findings += _matrix(instrument, np.asarray(matrix), columns)
    if stream is not None:
        findings += _stream(instrument, stream)
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
    decades = _decades_outside(peak, HEIGHTS_M)
    yield RuleCheck(
        rule=MODES,
        # In powers of ten: a basis in another unit is outside by three or more.
        deviation=decades,
        text=f"peak of a mode: {peak:.3g} m per unit command; expected metres of OPD",
    )


def _decades_outside(value: float, limits: tuple[float, float]) -> float:
    """Return the powers of ten by which a number is outside a range; 0 within it."""
    if not np.isfinite(value) or value <= 0.0:
        return np.inf
    low, high = limits
    return float(max(np.log10(low / value), np.log10(value / high), 0.0))


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
    factor = abs(
        np.log2(max(median, 1e-300))
    )  # in powers of two: a wrong number of passes, or surface instead of OPD
    twice = abs(factor - 1.0) < _A_PASS
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


# --- a stream


def _stream(instrument: Instrument, stream: Stream) -> Iterator[RuleCheck]:
    n_frames, n_modes = len(stream.t_ns_utc), len(stream.reconstructor)
    n_slopes = stream.reconstructor.shape[1]
    expected = instrument.slopes.kind.n_planes * int(rtc_valid_subapertures(instrument).sum())
    shapes = (stream.slopes.shape, stream.commands.shape, n_slopes)
    right = ((n_frames, n_slopes), (n_frames, n_modes), expected)
    yield RuleCheck(
        rule=MATRIX,
        deviation=float(shapes != right),
        limit=0.0,
        text=f"slopes, commands, slopes of R: {shapes}; expected {right}",
    )
    yield from _times(stream)
    if shapes != right:
        return
    size = float(np.sqrt(np.mean(np.square(stream.commands))))
    yield RuleCheck(
        rule=OPD,
        deviation=_decades_outside(size, COMMANDS_M),
        limit=0.0,
        text=f"commands of {size:.3g} RMS; expected metres of OPD",
    )
    light = float(np.sqrt(np.mean(np.square(stream.slopes))))
    yield RuleCheck(
        rule=ORDER,
        deviation=light,
        limit=MAX_SLOPE,
        text=f"slopes of {light:.3g} RMS; expected dimensionless ones",
    )
    yield from _law(stream)


def _times(stream: Stream) -> Iterator[RuleCheck]:
    times = np.asarray(stream.t_ns_utc)
    first, last = (float(t) for t in (times[0], times[-1]))
    in_range = times.dtype.kind in "iu" and YEARS_NS[0] < first <= last < YEARS_NS[1]
    yield RuleCheck(
        rule=TIME,
        deviation=float(not in_range),
        limit=0.0,
        text=f"times {first:.6g} to {last:.6g} of {times.dtype}; expected integer nanoseconds",
    )
    steps = np.diff(times.astype(np.float64)) * stream.frame_rate_hz * 1e-9
    late = float(abs(np.median(steps) - 1.0))
    yield RuleCheck(
        rule=TIME,
        deviation=late if (steps > 0.0).all() else np.inf,
        limit=0.2,
        text=f"a frame takes {np.median(steps):.3g} of what the rate says; expected 1, and times "
        "that rise",
    )


def _law(stream: Stream) -> Iterator[RuleCheck]:
    """Yield the check of ``c[k+d] - c[k+d-1] = -gain R s[k]`` with one gain above 0."""
    d = stream.delay_frames
    steps = np.diff(stream.commands, axis=0)[d - 1 :]
    requested = -(stream.slopes @ stream.reconstructor.T)[: len(steps)]
    steps = steps[: len(requested)]
    power = float(np.sum(requested * requested))
    gain = float(np.sum(requested * steps)) / power if power else 0.0
    left = steps - gain * requested
    size = float(np.sqrt(np.mean(np.square(steps))))
    share = float(np.sqrt(np.mean(np.square(left)))) / size if size else np.inf
    yield RuleCheck(
        rule=LAW,
        deviation=max(-gain, 0.0) if gain <= 0.0 else 0.0,
        limit=0.0,
        text=f"commands step by {gain:+.3g} times -R s; expected a gain above 0: R = +pinv(D)",
    )
    yield RuleCheck(
        rule=LAW,
        deviation=share,
        limit=MAX_LAW_RESIDUAL,
        text=f"{share:.2f} of the commands' steps are not -gain R s of {d} frames before",
    )
