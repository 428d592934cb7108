"""Have the worker fit windows and passive sums."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from service.archive.products import NoisyNumbers
from service.errors import CommandError, ModelError, PyrcalError, UnknownIdError
from service.estimation import lockin, orientation, random_dither
from service.estimation.dither_windows import EndedWindow
from service.estimation.loop import loop_numbers
from service.estimation.own_matrix import OwnMatrix
from service.estimation.passive import Passive
from service.estimation.random_dither import Correlated, noisy_matrix
from service.estimation.slope_convention import SlopeConvention
from service.estimation.windows import OTHER_SESSION, ClosedLoop
from service.model.instrument import Instrument
from service.model.misregistration import Misregistration
from service.records import alarms, products
from service.records import events as ev
from service.records.estimates import (
    LockInEstimate,
    RandomEstimate,
    RefusalKind,
    WideCaptureEstimate,
    WindowRefused,
)
from service.records.events import Event
from service.records.messages import compose
from service.records.operations import MeasurementRecord, MeasureState, NoisyFinding
from service.records.state import Level, TrackerState
from service.runtime.ports import StorePort, WorkerPort
from service.runtime.worker import OpticsWorker
from service.runtime.worker.records import waits
from service.runtime.workers import with_another_worker
from service.tracking.pointing_law import start_of_fit
from service.tracking.window_processing import fit_begins_at
from service.wire import checksum

MatrixOf = Callable[[str], NDArray[np.float32]]
"""Returns a reconstructor ``(n_modes, n_slopes)`` by id; UnknownIdError if it is not archived."""

MAX_WINDOW_SPAN_S = 30.0
"""Later ones are not joined to a window: α moves meanwhile."""


class PendingWindow:
    """The window that waits for the worker: those that end meanwhile are joined to it.

    So windows grow as long as the worker needs, and what they say is not lost.
    """

    def __init__(self) -> None:
        self._window: EndedWindow | None = None
        self._first_end_ns = 0
        self._new = asyncio.Event()

    @property
    def waits(self) -> bool:
        """Return True if a window waits."""
        return self._window is not None

    def put(self, window: EndedWindow) -> WindowRefused | None:
        """Add a window; return why the one that waited is given up, where it has to be."""
        waiting = self._window
        late = window.t_end_ns_utc - self._first_end_ns > MAX_WINDOW_SPAN_S * 1e9
        both = None if waiting is None or late else _join(waiting, window)
        self._window = both or window
        self._new.set()
        if both is not None:
            return None
        self._first_end_ns = window.t_end_ns_utc
        if waiting is None:
            return None
        return waiting.refuse(compose("window.given-up", most_s=MAX_WINDOW_SPAN_S))

    async def some(self) -> None:
        """Wait until a window is there."""
        await self._new.wait()

    def take(self) -> EndedWindow | None:
        """Return the window that waits."""
        self._new.clear()
        window, self._window = self._window, None
        return window


def _join(one: EndedWindow, other: EndedWindow) -> EndedWindow | None:
    if isinstance(one, lockin.Spectra) and isinstance(other, lockin.Spectra):
        return lockin.join_windows(one, other)
    if isinstance(one, Correlated) and isinstance(other, Correlated) and one.is_like(other):
        return random_dither.join_random_windows(one, other)
    return None


async def fitted(
    window: EndedWindow, state: TrackerState, workers: WorkerPort, matrix_of: MatrixOf
) -> Event:
    """Return what becomes of one window: an estimate, or why there is none."""
    try:
        outcome = await _outcome(window, state, workers, matrix_of)
    except PyrcalError as error:
        return ev.WindowLost(refused=window.refuse(str(error)))
    if isinstance(outcome, WindowRefused):
        return ev.WindowLost(refused=outcome)
    began_ns = 0
    if state.loop.rtc is not None:
        n_frames = window.n_windows * window.plan.n_frames
        began_ns = window.t_end_ns_utc - round(n_frames * 1e9 / state.loop.rtc.frame_rate_hz)
    if isinstance(outcome, WideCaptureEstimate):
        return ev.WideCaptureFitted(found=outcome, began_ns_utc=began_ns)
    return ev.WindowFitted(estimate=outcome, began_ns_utc=began_ns)


async def _outcome(
    window: EndedWindow, state: TrackerState, workers: WorkerPort, matrix_of: MatrixOf
) -> LockInEstimate | RandomEstimate | WideCaptureEstimate | WindowRefused:
    rtc, registration = state.loop.rtc, state.alpha.registration
    alpha = None if registration is None else registration.alpha
    if alpha is None and state.alpha.law.nominal is None:
        alpha = state.alpha.own_matrix_alpha
    start = start_of_fit(state, alpha, window.t_end_ns_utc)
    if rtc is not None and window.session != rtc.session:
        # the model may be of another mode of the sensor by now
        return window.refuse(OTHER_SESSION, RefusalKind.VOID)
    if isinstance(window, Correlated):
        return await workers.call(OpticsWorker.fit_random, window, start)
    if not isinstance(window, lockin.Spectra):
        assert_never(window)
    if state.operations.acquisition.uses_wide_capture:
        flux = None if rtc is None else rtc.flux
        found, nominal = state.operations.acquisition.alpha, state.alpha.law.nominal
        return await workers.call(OpticsWorker.find, window, found, flux, nominal)
    if rtc is None:
        return window.refuse(compose("window.no-rtc"))
    loop = ClosedLoop(
        # In a thread, because a matrix that is not in memory is read from the archive.
        reconstructor=await asyncio.to_thread(_reconstructor, window, state, matrix_of),
        gains=np.array(rtc.gains),
        leak=rtc.leak,
        delay_frames=rtc.delay_frames,
        frame_rate_hz=rtc.frame_rate_hz,
    )
    return await workers.call(OpticsWorker.fit, window, loop, start)


def _reconstructor(
    spectra: lockin.Spectra, state: TrackerState, matrix_of: MatrixOf
) -> NDArray[np.float32]:
    """Return the matrix that made the commands, if the service has it.

    The fit takes the dither alone for its instrument then, which costs precision and no truth.
    """
    try:
        if spectra.cm_id is not None or state.matrices.in_use is not None:
            return matrix_of(spectra.cm_id or state.matrices.in_use or "")
    except UnknownIdError:
        pass
    return np.zeros((0, spectra.slopes.shape[-1]), np.float32)


async def fit_passive(
    sums: Passive | str | None, state: TrackerState, workers: WorkerPort
) -> list[Event]:
    """Return the passive estimate, or the reason why there is none.

    Empty if nothing is new.
    """
    if isinstance(sums, str):
        known = state.alpha.passive_unavailable_reason
        return [] if sums == known else [ev.PassiveUnavailable(text=sums)]
    if sums is None or sums.tail is None:
        return []
    try:
        estimate = await workers.call(OpticsWorker.fit_passive, sums, fit_begins_at(state))
    except PyrcalError as error:
        text = str(error)
        return [ev.LogEvent(name="watchdog.failed", text=text, level=Level.WARNING)]
    if estimate is None:
        return []
    found = ev.PassiveFitted(
        estimate=estimate,
        t_ns_utc=sums.tail.next_t_ns - sums.tail.dt_ns,
        began_ns_utc=sums.since_ns_utc,
        loop=loop_numbers(state.loop.rtc),
    )
    return [found]


async def read_own_matrix(
    record: products.ReconstructorRecord,
    matrix: NDArray[np.float32],
    state: TrackerState,
    workers: WorkerPort,
    matrix_of: MatrixOf,
) -> list[Event]:
    """Return slopes, commands and modes as the matrix in use shows them.

    One that the service has made and judged says nothing that it did not know. After a restart the
    matrix in use is one that an earlier run has made: it agrees with the model in everything. What
    the model does not explain is then read from the RTC's own matrix, its ancestor in the archive.
    """
    if record.judged is not None and state.model.own_matrix_read:
        return []
    record, matrix, unread = await _brought(record, matrix, state, matrix_of)
    registration = state.alpha.registration
    near = state.alpha.law.nominal if registration is None else registration.alpha
    try:
        # Repeated if the worker dies of something else: nothing reads this matrix again.
        convention = await with_another_worker(
            partial(workers.call, OpticsWorker.read_slope_convention, matrix, near)
        )
        own = None
        # The modes can only be compared once order and signs of the slopes are right.
        if not convention.wrong:
            own = await with_another_worker(
                partial(workers.call, OpticsWorker.recognise, matrix, near, convention.rotation_rad)
            )
    except PyrcalError as error:
        return [*unread, ev.LogEvent(name="slopes.unknown", text=str(error), level=Level.WARNING)]
    return [*unread, *_report_own_matrix(record, convention, own, state)]


async def _brought(
    record: products.ReconstructorRecord,
    matrix: NDArray[np.float32],
    state: TrackerState,
    matrix_of: MatrixOf,
) -> tuple[products.ReconstructorRecord, NDArray[np.float32], list[Event]]:
    """Return the RTC's own matrix that one in use descends from, or that one if it is not there."""
    origin = _origin_of(record, state)
    if origin is record:
        return record, matrix, []
    try:
        return origin, await asyncio.to_thread(matrix_of, origin.id), []
    except PyrcalError as error:
        text = f"{origin.id}, the RTC's own, is not read again: {error}"
        event = ev.LogEvent(name="slopes.unknown", text=text, level=Level.WARNING)
        return record, matrix, [event]


def _report_own_matrix(
    record: products.ReconstructorRecord,
    convention: SlopeConvention,
    own: OwnMatrix | None,
    state: TrackerState,
) -> list[Event]:
    """Return how the RTC lists its slopes and which modes the model has recognised, as events."""
    events: list[Event] = []
    if convention.adopted and convention.found is not None:
        text = f'orientation "auto": found {orientation.format_setting(convention.found)}'
        events.append(ev.LogEvent(name="slopes.adopted", text=f"{text} by {record.id}"))
    wrong = convention.wrong or (own.wrong if own is not None else "")
    if wrong or state.alarm(alarms.WRONG_MATRIX) is not None:
        text = f"{record.id}: {wrong}" if wrong else f"{record.id} agrees with the instrument file"
        events.append(ev.ConditionChanged(name=alarms.WRONG_MATRIX, text=text, over=not wrong))
    if own is not None:
        strange = tuple(own.columns[~own.known].tolist())
        events.append(
            ev.ModesRecognised(
                id=record.id,
                strange=strange,
                text=own.text,
                response=own.typical_response,
                uneven="" if wrong else own.uneven,
                # A matrix that contradicts the instrument file also fits some α, but not the
                # telescope's.
                alpha=None if wrong or not own.tells_registration else own.alpha,
                weights=() if wrong else own.weights,
                misfit=own.typical_misfit,
                model_error=None if wrong else own.model_error,
            )
        )
    return events


def _origin_of(
    record: products.ReconstructorRecord, state: TrackerState
) -> products.ReconstructorRecord:
    """Return the RTC's own matrix that a reconstructor descends from.

    The record itself if its ancestors are no longer known, or are of another mode of the sensor.
    """
    ancestor = record
    # Bounded by the number of records: damaged records may name each other as parents.
    for _ in state.matrices.reconstructors:
        if ancestor.parent is None:
            return ancestor if ancestor.config_id == record.config_id else record
        before = state.reconstructor(ancestor.parent)
        if before is None:
            break
        ancestor = before
    return record


class NoisySums:
    """Sums the windows of the dither that measures a noisy interaction matrix.

    Belongs to the event loop. Its matrices are none of the actions': nothing here is published.
    """

    def __init__(self, *, workers: WorkerPort, archive: StorePort, instrument: Instrument) -> None:
        self._workers = workers
        self._archive = archive
        self._instrument = instrument
        self._id: str | None = None
        self._total: Correlated | None = None

    def take(self, window: Correlated, state: TrackerState) -> None:
        """Add a window if it belongs to the matrix under way and its telemetry is valid."""
        record, dither = state.noisy_measurement, state.dithers.dither
        if record is None or (dither is not None and dither.id != record.id):
            return
        if (
            window.plan.modes != record.modes
            or alarms.blocking_alarm(state.alarms.active, alarms.Interlock.MEASURE) is not None
        ):
            return
        total = self._total if self._id == record.id else None
        self._id = record.id
        try:
            self._total = (
                window if total is None else random_dither.join_random_windows(total, window)
            )
        except ModelError:  # the RTC has started anew: what came before is of another loop
            self._total = window

    async def finish(self, record: MeasurementRecord, state: TrackerState) -> Event:
        """Fit what has been summed, archive it and return what came of it.

        Raises
        ------
        CommandError
            If there is no whole window of it.
        PyrcalError
            If it cannot be fitted or archived.
        """
        total, registration = self._total, state.alpha.registration
        if self._id != record.id or total is None:
            raise CommandError("no window of its dither was whole: see the log for the reasons")
        self._id = self._total = None
        start = None if registration is None else registration.alpha
        job = partial(self._workers.call, work_out, record, total, start)
        record, numbers = await with_another_worker(job)
        store = self._archive.noisy.store
        await asyncio.to_thread(store, record, numbers, self._instrument.name)
        return ev.MatrixMeasured(record=record)


@waits(at_most_s=5.0)
def work_out(
    bench: OpticsWorker,
    record: MeasurementRecord,
    total: Correlated,
    start: Misregistration | None,
) -> tuple[MeasurementRecord, NoisyNumbers]:
    """Return the record of a matrix, ready for the archive, and its numbers; runs in the worker."""
    noisy = noisy_matrix(total)
    outcome, reason = bench.fit_random(total, start), ""
    estimate = None if isinstance(outcome, WindowRefused) else outcome
    if isinstance(outcome, WindowRefused):
        reason = f"no registration could be fitted: {outcome.reason}"
    unknown = np.full(len(noisy.modes), np.nan)
    alpha = start if estimate is None else estimate.alpha
    numbers = NoisyNumbers(
        matrix=_single(noisy.matrix),
        noise=_single(noisy.noise),
        synthetic=_single(bench.response(alpha)[:, list(noisy.modes)]),
        optical_gain=unknown if estimate is None else estimate.optical_gain,
        gain_sigma=unknown if estimate is None else estimate.gain_sigma,
        snr=noisy.snr_of_modes,
    )
    finding = NoisyFinding(
        n_slopes=len(numbers.matrix),
        n_frames=total.sums.n_pairs,
        n_missing=total.n_missing,
        snr=noisy.snr,
        alpha=None if estimate is None else estimate.alpha,
        covariance=None if estimate is None else estimate.covariance,
        optical_gain=None if estimate is None else _mean_gain(estimate),
        misfit=None if estimate is None else estimate.misfit,
        cm_id=total.cm_id,
        session=total.session,
        created_ns_utc=total.t_end_ns_utc,
        sha256=checksum(numbers.matrix),
    )
    record = replace(record, state=MeasureState.STORED, reason=reason, finding=finding)
    return record, numbers


def _single(values: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, np.float32)


def _mean_gain(estimate: RandomEstimate) -> float:
    # Inverse variance: modes that the dither hardly moved say almost nothing.
    return float(np.average(estimate.optical_gain, weights=estimate.gain_sigma**-2.0))
