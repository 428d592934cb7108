"""Having the worker look at telemetry: a window to be fitted, the watchdog's sums."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from service import events as ev
from service.errors import PyrcalError, UnknownIdError
from service.events import Event
from service.fit.dialect import setting_written
from service.reactions.alarms import WRONG_MATRIX
from service.reactions.watchdog import fit_begins_at
from service.runtime.crew import Crew
from service.runtime.deeds import Deeds
from service.state import Level, ReconstructorRecord, RtcView, TrackerState
from service.telemetry import lockin, randomdither
from service.telemetry.estimator import Window
from service.telemetry.instrumental import Loop
from service.telemetry.lockin import Spectra, WindowRefused
from service.telemetry.passive import Passive
from service.telemetry.randomdither import Correlated
from service.worker import Workbench, run_job

LONGEST_S = 30.0
"""Later ones are not joined to a window: α moves meanwhile."""


class Backlog:
    """The window that waits for the worker: those that end meanwhile are joined to it.

    So windows grow as long as the worker needs, and what they say is not lost.
    """

    def __init__(self) -> None:
        self._window: Spectra | Correlated | None = None
        self._first_end_ns = 0
        self._news = asyncio.Event()

    @property
    def waits(self) -> bool:
        """Whether a window waits."""
        return self._window is not None

    def put(self, window: Spectra | Correlated) -> WindowRefused | None:
        """Add a window; return why the one that waited is given up, where it has to be."""
        waiting = self._window
        late = window.t_end_ns_utc - self._first_end_ns > LONGEST_S * 1e9
        both = None if waiting is None or late else _joined(waiting, window)
        self._window = both or window
        self._news.set()
        if both is not None:
            return None
        self._first_end_ns = window.t_end_ns_utc
        if waiting is None:
            return None
        return WindowRefused(
            reason="the worker had no hand free before the dither, the reconstructor or the "
            f"session changed, or for {LONGEST_S:.0f} s: the window was given up",
            t_ns_utc=waiting.t_end_ns_utc,
        )

    async def some(self) -> None:
        """Wait until a window is there."""
        await self._news.wait()

    def take(self) -> Spectra | Correlated | None:
        """Return the window that waits."""
        self._news.clear()
        window, self._window = self._window, None
        return window


def _joined(one: Spectra | Correlated, other: Spectra | Correlated) -> Spectra | Correlated | None:
    if isinstance(one, Spectra) and isinstance(other, Spectra):
        return lockin.joined(one, other)
    if isinstance(one, Correlated) and isinstance(other, Correlated) and _alike(one, other):
        return randomdither.joined(one, other)
    return None


def _alike(one: Correlated, other: Correlated) -> bool:
    return (one.session, one.cm_id, replace(one.plan, first_seq=0)) == (
        other.session,
        other.cm_id,
        replace(other.plan, first_seq=0),
    )


async def fitted(
    window: Spectra | Correlated, state: TrackerState, crew: Crew, deeds: Deeds
) -> Event:
    """Return what becomes of one window: an estimate, or why there is none."""
    if isinstance(window, Correlated):
        return await _correlated(window, state, crew)
    return await _demodulated(window, state, crew, deeds)


async def _correlated(window: Correlated, state: TrackerState, crew: Crew) -> Event:
    """Return what a window of random dither says; it needs no reconstructor."""
    known = state.registration
    try:
        start = None if known is None else known.alpha
        outcome = await crew.call(Workbench.fit_random, window, start)
    except PyrcalError as error:
        return lost(window, str(error))
    if isinstance(outcome, WindowRefused):
        return ev.WindowLost(refused=outcome)
    return ev.WindowFitted(estimate=outcome, began_ns_utc=_began_ns(window, state.rtc))


async def _demodulated(spectra: Spectra, state: TrackerState, crew: Crew, deeds: Deeds) -> Event:
    """Return what a window of sines says of the registration."""
    rtc, known = state.rtc, state.registration
    if state.acquisition.looks_afar:
        return await _found(spectra, state, crew)
    if rtc is None:
        return lost(spectra, "the RTC is not known")
    try:
        matrix = await asyncio.to_thread(_reconstructor, spectra, state, deeds)
        loop = Loop(
            reconstructor=matrix,
            gains=np.array(rtc.gains),
            leak=rtc.leak,
            delay_frames=rtc.delay_frames,
            frame_rate_hz=rtc.frame_rate_hz,
        )
        start = None if known is None else known.alpha
        outcome = await crew.call(Workbench.fit, spectra, loop, start)
    except PyrcalError as error:
        return lost(spectra, str(error))
    if isinstance(outcome, WindowRefused):
        return ev.WindowLost(refused=outcome)
    return ev.WindowFitted(estimate=outcome, began_ns_utc=_began_ns(spectra, rtc))


def _reconstructor(spectra: Spectra, state: TrackerState, deeds: Deeds) -> NDArray[np.float32]:
    """Return the matrix that made the commands; one that nobody has tells nothing of the loop.

    The fit takes the dither alone for its instrument then, which costs precision and no truth.
    """
    unknown = np.zeros((0, spectra.slopes.shape[-1]), np.float32)
    if spectra.cm_id is None and state.in_use is None:
        return unknown
    try:
        return deeds.matrix(spectra.cm_id or state.in_use or "")
    except UnknownIdError:
        return unknown


async def _found(spectra: Spectra, state: TrackerState, crew: Crew) -> Event:
    """Return where a window with the loop open puts the mirror, or why it does not."""
    flux = None if state.rtc is None else state.rtc.flux
    try:
        outcome = await crew.call(Workbench.find, spectra, state.acquisition.alpha, flux)
    except PyrcalError as error:
        return lost(spectra, str(error))
    if isinstance(outcome, WindowRefused):
        return ev.WindowLost(refused=outcome)
    return ev.FarFitted(found=outcome, began_ns_utc=_began_ns(spectra, state.rtc))


async def watched(
    sums: Passive | str, state: TrackerState, crew: Crew
) -> ev.Watched | ev.Unwatched | ev.Noted | None:
    """Return what the watchdog makes of ordinary telemetry, or why it can make nothing of it.

    None: there is no more to tell than before.
    """
    if isinstance(sums, str):
        return None if sums == state.unwatched else ev.Unwatched(text=sums)
    last = sums.tail
    if last is None:
        return None
    end_ns = last.t0_ns_utc + (last.n_frames - 1) * last.dt_ns
    try:
        estimate = await crew.call(Workbench.watch, sums, fit_begins_at(state))
    except PyrcalError as error:
        return ev.Noted(name="watchdog.failed", text=str(error), level=Level.WARNING)
    if estimate is None:
        return None
    loop = () if state.rtc is None else state.rtc.loop_numbers
    return ev.Watched(estimate=estimate, t_ns_utc=end_ns, began_ns_utc=sums.since_ns_utc, loop=loop)


def _began_ns(window: Spectra | Correlated, rtc: RtcView | None) -> int:
    """Return when a window began, by the RTC's clock; 0: no RTC tells how long it was."""
    if rtc is None:
        return 0
    n_frames = window.n_windows * window.plan.n_frames
    return window.t_end_ns_utc - round(n_frames * 1e9 / rtc.frame_rate_hz)


async def listened(
    record: ReconstructorRecord, matrix: NDArray[np.float32], state: TrackerState, crew: Crew
) -> list[Event]:
    """Return what a matrix that the RTC brought tells of its slopes and commands.

    One that the service has made and judged says nothing that it did not know.
    """
    if record.judged is not None:
        return []
    known = state.registration
    try:
        dialect = await crew.call(Workbench.listen, matrix, None if known is None else known.alpha)
    except PyrcalError as error:
        return [ev.Noted(name="slopes.unknown", text=str(error), level=Level.WARNING)]
    events: list[Event] = []
    if dialect.found is not None and dialect.adopted:
        crew.first = partial(run_job, Workbench.adopt, dialect.found)
        text = f'orientation "auto": found {setting_written(dialect.found)} by {record.id}'
        events.append(ev.Noted(name="slopes.adopted", text=text))
    raised = any(alarm.name == WRONG_MATRIX for alarm in state.alarms)
    if dialect.wrong or raised:
        text = f"{record.id}: {dialect.wrong}" if dialect.wrong else f"{record.id} is as told"
        events.append(ev.Trouble(name=WRONG_MATRIX, text=text, over=not dialect.wrong))
    return events


def lost(window: Window, reason: str) -> Event:
    """Return what becomes of a window that cannot be fitted."""
    refused = WindowRefused(reason=reason, t_ns_utc=window.t_end_ns_utc)
    return ev.WindowLost(refused=refused)
