"""The noisy interaction matrix under way: its windows summed, fitted, archived and drawn."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from service import events as ev
from service.archive import Archive
from service.archive.noisy import NoisyNumbers
from service.errors import CommandError, ModelError
from service.events import Event
from service.files.figures.noisy import WHAT, draw
from service.files.figures.sheet import check_plots
from service.model.instrument import Instrument
from service.model.misregistration import Misregistration
from service.reactions.alarms import Act, forbidding
from service.runtime.crew import Crew
from service.runtime.errand import run_apart
from service.state import NoisyFinding, NoisyRecord, NoisyState, TrackerState
from service.telemetry.noisymatrix import RandomEstimate, noisy_matrix
from service.telemetry.randomdither import Correlated, joined
from service.telemetry.span import WindowRefused
from service.wire import checksum
from service.worker import Workbench

DRAW_WITHIN_S = 120.0
DRAW_NICE = 10


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """What the worker makes of the sums."""

    numbers: NoisyNumbers
    estimate: RandomEstimate | None
    reason: str
    """Why there is no estimate; empty: there is."""

    snr: float


class NoisyDesk:
    """Sums the windows of the dither that measures a noisy interaction matrix.

    Belongs to the event loop. Its matrices are none of the deeds': nothing here is published.
    """

    def __init__(self, *, crew: Crew, archive: Archive, instrument: Instrument) -> None:
        self._crew = crew
        self._archive = archive
        self._instrument = instrument
        self._id: str | None = None
        self._total: Correlated | None = None

    def take(self, window: Correlated, state: TrackerState) -> None:
        """Add a window, if it is of the matrix under way and its telemetry can be believed."""
        record, dither = state.gathering, state.dither
        if record is None or (dither is not None and dither.id != record.id):
            return
        if window.plan.modes != record.modes or forbidding(state, Act.MEASURE) is not None:
            return
        total = self._total if self._id == record.id else None
        self._id = record.id
        try:
            self._total = window if total is None else joined(total, window)
        except ModelError:  # the RTC has started anew: what came before is of another loop
            self._total = window

    async def finish(self, record: NoisyRecord, state: TrackerState) -> Event:
        """Fit what has been summed, archive it and return what came of it.

        Raises
        ------
        CommandError
            If there is no whole window of it.
        PyrcalError
            If it cannot be fitted or archived.
        """
        total, known = self._total, state.registration
        if self._id != record.id or total is None:
            raise CommandError("no window of its dither was whole: see the log for the reasons")
        self._id = self._total = None
        start = None if known is None else known.alpha
        found = await self._crew.call(work_out, total, start)
        record = finished(record, total, found)
        store = self._archive.noisy.store
        await asyncio.to_thread(store, record, found.numbers, self._instrument.name)
        return ev.NoisyMade(record=record)

    async def picture(self, noisy_id: str) -> bytes:
        """Return a PNG of a stored one, drawn in a process of its own.

        Raises
        ------
        UnknownIdError, ArchiveError
            If it is not there, or damaged.
        ConfigurationError
            If matplotlib is not installed.
        """
        check_plots(WHAT)
        path = self._archive.noisy.path(noisy_id)
        work = partial(draw, path, self._instrument)
        return await run_apart(work, nice=DRAW_NICE, limit_s=DRAW_WITHIN_S)


def work_out(bench: Workbench, total: Correlated, start: Misregistration | None) -> Found:
    """Return the matrix, its noise, what the model makes of it; runs in the worker."""
    noisy = noisy_matrix(total)
    outcome = bench.fit_random(total, start)
    if isinstance(outcome, WindowRefused):
        estimate, reason = None, outcome.reason
    else:
        estimate, reason = outcome, ""
    unknown = np.full(len(noisy.modes), np.nan)
    alpha = start if estimate is None else estimate.alpha
    return Found(
        numbers=NoisyNumbers(
            matrix=_single(noisy.matrix),
            noise=_single(noisy.noise),
            synthetic=_single(bench.response(alpha)[:, list(noisy.modes)]),
            optical_gain=unknown if estimate is None else estimate.optical_gain,
            gain_sigma=unknown if estimate is None else estimate.gain_sigma,
            snr=noisy.snr_of_modes,
        ),
        estimate=estimate,
        reason=reason,
        snr=noisy.snr,
    )


def _single(values: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, np.float32)


def finished(record: NoisyRecord, total: Correlated, found: Found) -> NoisyRecord:
    """Return the record of a matrix that is ready for the archive."""
    estimate = found.estimate
    finding = NoisyFinding(
        n_slopes=len(found.numbers.matrix),
        n_frames=total.sums.n_pairs,
        n_missing=total.n_missing,
        snr=found.snr,
        alpha=None if estimate is None else estimate.alpha,
        covariance=None if estimate is None else estimate.covariance,
        optical_gain=None if estimate is None else _mean_gain(estimate),
        misfit=None if estimate is None else estimate.misfit,
        cm_id=total.cm_id,
        session=total.session,
        created_ns_utc=total.t_end_ns_utc,
        sha256=checksum(found.numbers.matrix),
    )
    reason = f"no registration could be fitted: {found.reason}" if found.reason else ""
    return replace(record, state=NoisyState.STORED, reason=reason, finding=finding)


def _mean_gain(estimate: RandomEstimate) -> float:
    return float(np.average(estimate.optical_gain, weights=estimate.gain_sigma**-2.0))
