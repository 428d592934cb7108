"""Registration from far away: smooth modes dithered with the loop open.

With the loop open, a dithered line is a measured column of the interaction matrix. No loop has to
be known or stable, and the fit is that of a small matrix: Gauss-Newton steps, halved when they
increase the misfit, with a free gain per column. An open loop leaves the pyramid a seventh of its
response in 1" seeing, and changes the shape of the response. The result is accurate to some per
cent of a subaperture, which is sufficient to close a loop.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.estimation import solver
from service.estimation.lockin import MAX_LAG_FRAMES, Spectra, fit_window
from service.estimation.solver import MAX_STEP, Columns
from service.estimation.windows import ClosedLoop
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import CannotTell
from service.model.slopes import Orientation
from service.records.estimates import (
    RefusalKind,
    WideCaptureEstimate,
    WindowRefused,
)
from service.records.messages import Message, compose

Array = NDArray[Any]

WIDE_STEP_LIMIT = np.array([0.02, 0.02, np.deg2rad(0.1), 2e-3])
"""A step shorter than this leaves the rest to the finer model (numeric units)."""

SEARCH_RANGE = np.array([3.0, 3.0, np.deg2rad(20.0), 0.15])
"""Largest distance from the nominal registration that is searched (numeric units)."""

MAX_UNEXPLAINED_SHARE = 0.2
"""Largest share of the columns' power, noise taken off, that the right registration may leave."""

MIN_LINE_SIGMA = 5.0
"""σ of a line's gain from which on it is seen."""

MAX_GAIN = 3.0

MAX_PUPIL_SHIFT_SUBAP = 3.0
"""Largest shift of the pupil that its light may indicate; beyond it the light is of another
instrument."""

_TURNS_RAD = np.deg2rad([5.0, -5.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WideCaptureSearch:
    """Range and models of the search."""

    coarse: InteractionModel
    """Coarse model of the dithered modes alone, columns in the order of the lines. It leads the
    search."""

    fine: InteractionModel
    """The same, fine: decides."""

    nominal: Misregistration
    """Centre of the range."""

    starts: tuple[Misregistration, ...]
    """Tried in this order."""

    def contains(self, vector: Array) -> bool:
        """Return whether a registration ``(4,)`` is within the range."""
        return bool(np.all(np.abs(vector - self.nominal.vector) < SEARCH_RANGE))


def find(spectra: Spectra, search: WideCaptureSearch) -> WideCaptureEstimate | WindowRefused:
    """Return where the first start leads from which the model explains the columns."""
    columns, noise = _columns(spectra)
    loop = ClosedLoop(
        # A loop that controls no mode: the commands are the dither alone.
        reconstructor=np.zeros((0, len(columns.matrix)), np.float32),
        gains=np.zeros(0),
        leak=1.0,
        delay_frames=1.0,
        frame_rate_hz=spectra.plan.frame_rate_hz,
    )
    modes = list(spectra.plan.modes)
    # only the dithered modes are left, in the order of the lines
    alone = replace(
        spectra, commands=spectra.commands[:, :, modes], dither=spectra.dither[:, modes]
    )
    reason = compose("not-found.no-start")
    for tried, start in enumerate(search.starts, start=1):
        landed = solver.approach(
            search.coarse, columns, start, approached=WIDE_STEP_LIMIT, allowed=search.contains
        )
        if not landed.converged:
            reason = compose("not-found.no-convergence", start=str(start))
            continue
        there = search.fine.linearise(landed.alpha)
        estimate = fit_window(alone, there, loop)
        left = _unexplained_share(columns, noise, search.fine.interaction_matrix(estimate.alpha))
        found = WideCaptureEstimate(estimate=estimate, unexplained=left, n_starts=tried)
        why_not = _why_not(found, search)
        if why_not is None:
            return found
        reason = why_not
    return not_found(reason, spectra)


def not_found(reason: Message, spectra: Spectra) -> WindowRefused:
    """Return the refusal of a window of an open loop that led nowhere."""
    refusal = compose("window.not-found", reason.key, reason=str(reason))
    return spectra.refuse(refusal, RefusalKind.NOT_FOUND)


def _columns(spectra: Spectra) -> tuple[Columns, Array]:
    """Return the measured columns of the interaction matrix, and the noise power of each.

    Slopes at the lines divided by the known dither; the noise ``(n_lines,)`` is that of the side
    bins.
    """
    lines = np.arange(len(spectra.plan.modes))
    known = spectra.dither[lines, list(spectra.plan.modes)].astype(complex)
    noise = np.sum(np.abs(spectra.slopes[:, 1:]) ** 2, axis=2).mean(axis=1)
    # The real part: columns of an interaction matrix are real, and the phase of the dither was
    # divided out.
    measured = (spectra.slopes[:, 0] / known[:, None]).real.T
    columns = Columns(
        matrix=measured,
        # Each column counts alike, whatever the amplitude of its mode.
        weights=1.0 / np.sum(measured**2, axis=0),
        rows=np.ones(len(measured), dtype=np.bool_),
        signed=False,
    )
    # half of a complex bin's noise is in its real part
    return columns, 0.5 * noise / np.abs(known) ** 2


def _unexplained_share(columns: Columns, noise: Array, matrix: Array) -> float:
    """Return the mean share of the columns that a matrix leaves, the noise taken off both."""
    power, total = np.sum(matrix**2, axis=0), np.sum(columns.matrix**2, axis=0)
    # A column with a negative gain counts as not explained at all.
    along = np.maximum(np.sum(matrix * columns.matrix, axis=0), 0.0)
    left = total - along**2 / power - noise
    # Noise may exceed the measured power of a weak column: the denominator must stay positive.
    return float(np.mean(left / np.maximum(total - noise, 0.1 * total)))


def _why_not(found: WideCaptureEstimate, search: WideCaptureSearch) -> Message | None:
    """Return the reason why an estimate is rejected, or None."""
    estimate = found.estimate
    gains = np.abs(estimate.optical_gain)
    if estimate.gain_sigma is not None and np.any(gains < MIN_LINE_SIGMA * estimate.gain_sigma):
        return compose("not-found.dither-not-seen")
    if gains.max() > MAX_GAIN:
        return compose("not-found.gains", most=float(gains.max()))
    lag = float(np.median(estimate.lag_frames))
    if abs(lag) > MAX_LAG_FRAMES:
        return compose("not-found.misaligned", lag_frames=lag)
    if not search.contains(estimate.alpha.vector):
        return compose("not-found.out-of-range", alpha=str(estimate.alpha))
    if np.any(np.abs(estimate.step) > MAX_STEP):
        return compose("not-found.leads-away", alpha=str(estimate.alpha))
    if found.unexplained > MAX_UNEXPLAINED_SHARE:
        return compose(
            "not-found.unexplained",
            alpha=str(estimate.alpha),
            left=found.unexplained,
            most=MAX_UNEXPLAINED_SHARE,
        )
    return None


def far_starts(
    instrument: Instrument, flux: bytes | None, nominal: Misregistration | None = None
) -> tuple[Misregistration, ...]:
    """Return starting points for an unknown registration, the most likely first.

    With the mirror as stop, the pupil image moves with the mirror, so its mean light measures the
    shift if the sensor supports it, but neither rotation nor magnification. ``flux`` is as the RTC
    sends it, in its own axes; it is used if these are the conventions'. ``nominal`` is the expected
    registration; None for that of the instrument file.
    """
    nominal = nominal or instrument.start
    turned = [replace(nominal, rotation_rad=nominal.rotation_rad + turn) for turn in _TURNS_RAD]
    lit = _lit_start(instrument, nominal, flux)
    return (*(() if lit is None else (lit,)), nominal, *turned)


def _lit_start(
    instrument: Instrument, nominal: Misregistration, flux: bytes | None
) -> Misregistration | None:
    own_axes = instrument.slopes.assumed_orientation == Orientation()
    if flux is None or instrument.stop is not Stop.MIRROR or not own_axes:
        return None
    light = kind_of(instrument).light(instrument)
    if isinstance(light, CannotTell):
        return None
    try:
        seen = light.find_pupil(light.counts_of(flux))
    except ModelError:
        return None
    if isinstance(seen, CannotTell) or max(map(abs, seen.at)) > MAX_PUPIL_SHIFT_SUBAP:
        return None
    return replace(nominal, shift_x_subap=seen.at[0], shift_y_subap=seen.at[1])
