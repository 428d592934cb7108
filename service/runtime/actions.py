"""Carry out effects; every action ends in an event, failures too."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from service import wire
from service.control.gains import gain_table
from service.control.loop import ControlLoop
from service.errors import ArchiveError, CommandError, LinkError, StorageError, UnknownIdError
from service.estimation.loop import extend_gains, same_gains, select_gains
from service.link.matrices import MeasuredMatrix
from service.model.instrument import Instrument
from service.records import alarms, products
from service.records import events as ev
from service.records.events import Effect, Event
from service.records.operations import MeasurementRecord
from service.records.products import GateVerdict
from service.records.registration import Registration
from service.records.state import TrackerState
from service.runtime import estimates, ports
from service.runtime.worker import Conditions, OpticsWorker
from service.tracking.pointing_law import registration_ahead
from service.tracking.reconstructors import require_record
from service.tracking.references import mean_gain, require_references
from service.version import software_version

UNKNOWN_PARENT = "unknown"
"""Parent id of a matrix made while the matrix in use is unknown: only the RTC's own have no parent.
"""

MATRICES_KEPT = 3
"""Matrices kept in memory, the most recently used: in use, the previous one, a new one. Others are
read from the archive."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Publishing:
    """Context of a publication besides the state."""

    system: str
    chunk_bytes: int
    pole_radius_bound: float
    """Largest closed-loop pole radius of a matrix that may be published."""


class Actions:
    """Everything the service does to the world: RTC, worker, archive."""

    def __init__(
        self,
        *,
        bridge: ports.RtcPort,
        workers: ports.WorkerPort,
        archive: ports.StorePort,
        instrument: Instrument,
        publishing: Publishing,
        clock_ns: Callable[[], int],
    ) -> None:
        self._bridge = bridge
        self._workers = workers
        self._archive = archive
        self.instrument = instrument
        """The telescope that it is all done for."""

        self._publishing = publishing
        self._clock_ns = clock_ns
        self._matrices: OrderedDict[str, NDArray[np.float32]] = OrderedDict()
        # The cache of matrices is read from threads as well: the archive is waited for off the
        # event loop.
        self._guard = threading.Lock()
        self._judging: set[str] = set()
        self.noisy = estimates.NoisySums(workers=workers, archive=archive, instrument=instrument)
        """Sums of the noisy interaction matrix under way."""

    async def perform(  # noqa: C901 - one line for each effect
        self, effect: Effect, state: TrackerState
    ) -> Event | None:
        """Do it and return what came of it; None when the answer comes over the link.

        Raises
        ------
        PyrcalError
            If it cannot be done now; nothing is half-done.
        """
        match effect:
            case ev.MakeMatrix():
                return await self._make(effect, state)
            case ev.RepublishMatrix():
                return await self._republish(effect, state)
            case ev.JudgeMatrix() | ev.JudgeProposal():
                return await self._judge(effect, state)
            case ev.FetchMatrix(id=matrix_id):
                return await self._fetch(matrix_id, state)
            case ev.FetchReferences():
                return ev.ReferencesFetched(in_use=await self._bridge.fetch_references())
            case ev.SendMatrix():
                return await self._send(effect, state)
            case ev.MakeReferences():
                return await self._make_references(effect, state)
            case ev.SendReferences():
                return await self._send_references(effect, state)
            case ev.FinishNoisy(record=record):
                return await self.noisy.finish(record, state)
            case ev.Ask(request=wire.LoopRequest() as request, judged=True):
                return await self._ask_judged(request, state)
            case ev.Ask(request=request):
                return await self._ask(request)

    def matrix(self, matrix_id: str) -> NDArray[np.float32]:
        """Return a reconstructor ``(n_modes, n_slopes)`` from memory or the archive.

        Raises
        ------
        UnknownIdError
            If neither has it.
        ArchiveError
            If the archive's file is damaged.
        """
        kept = self._matrices.get(matrix_id)
        matrix = self._archive.reconstructors.matrix(matrix_id) if kept is None else kept
        self._remember(matrix_id, matrix)
        return matrix

    def offer(self, state: TrackerState) -> None:
        """Let an RTC ask for the matrix in use.

        Raises
        ------
        PyrcalError
            If its numbers are not to be had.
        """
        record = state.reconstructor(state.matrices.in_use or "")
        if record is None or state.loop.rtc is None:
            return
        matrix = self.matrix(record.id)
        layout = wire.layout_of(matrix, self._publishing.chunk_bytes)
        system = self._publishing.system
        self._bridge.offer(record.manifest(layout, state.loop.rtc, system), matrix)
        self._bridge.set_current(record.id)

    async def keep_measured(self, received: MeasuredMatrix) -> Event:
        """Archive an interaction matrix that the RTC has measured.

        Raises
        ------
        ArchiveError
            If it cannot be written, or another one has its id.
        """
        record = MeasurementRecord.sent(received.manifest)
        # An aborted measurement has a manifest and no numbers.
        if received.matrix is not None:
            instrument = self.instrument.name
            store = self._archive.measured.store
            await asyncio.to_thread(store, record, received.matrix, instrument)
        return ev.MatrixMeasured(record=record)

    async def _ask(self, request: wire.Command) -> Event | None:
        reply = await self._bridge.command(request)
        if isinstance(request, wire.DitherStop) and reply.accepted:
            return None  # the next status tells
        return ev.Answered(request=request, reply=reply)

    async def _make(self, effect: ev.MakeMatrix, state: TrackerState) -> Event:
        rtc, registration = _there(state), _registration_to_use(state)
        # More modes than are controlled now have no gain in the status: the gate needs one for
        # each.
        gains = (effect.gains or extend_gains(rtc, effect.n_modes))[: effect.n_modes]
        conditions = self._conditions(state, gains)
        made = await self._workers.call(OpticsWorker.make, conditions, effect.fewer)
        accepted = made.gate.accepted
        parent = state.matrices.in_use or UNKNOWN_PARENT
        # The gate may have passed fewer modes than requested, so the matrix counts, not the
        # request.
        record = self._record(len(made.matrix), effect.why, registration, parent)
        record = replace(
            record,
            config_id=state.loop.config_id,
            reference_id=state.loop.reference_id,
            state=products.MatrixState.PROPOSED if accepted else products.MatrixState.REFUSED,
            condition_number=made.condition_number,
            gate=made.gate,
            judged=present_conditions(state, gains[: len(made.matrix)]),
            sha256=wire.checksum(made.matrix),
        )
        await self._keep(record, made.matrix, registration, effect.why)
        return ev.MatrixMade(
            record=record, wanted=False, asked_modes=effect.n_modes, why_fewer=made.why_fewer
        )

    async def _republish(self, effect: ev.RepublishMatrix, state: TrackerState) -> Event:
        rtc, registration = _there(state), state.alpha.registration
        source = state.reconstructor(effect.source)
        matrix = await asyncio.to_thread(self.matrix, effect.source)
        gate, judged, why = None, None, effect.why
        gains = select_gains(rtc, len(matrix))
        if not effect.judged and source is not None:
            # the loop ran with it: what the gate has against it since does not count
            held = source.gate is not None and source.gate.accepted
            gate, judged = (source.gate, source.judged) if held else (None, None)
        elif registration is not None and any(gains):
            gate = await self._verdict(matrix, gains, state)
            judged = present_conditions(state, gains)
        else:
            unknown = "α is unknown" if registration is None else "an open loop shows no gains"
            why = f"{why}; the gate could not judge it: {unknown}"
        refused = gate is not None and not gate.accepted
        if gate is not None and refused and effect.anyway:
            why, gate, judged, refused = f"{why}, though {gate.reason}", None, None, False
        record = replace(
            self._record(len(matrix), why, None, effect.source),
            config_id=state.loop.config_id if source is None else source.config_id,
            state=products.MatrixState.REFUSED if refused else products.MatrixState.PROPOSED,
            alpha=None if source is None else source.alpha,
            sigma=None if source is None else source.sigma,
            condition_number=None if source is None else source.condition_number,
            gate=gate,
            judged=judged,
            optical_gains=() if registration is None else registration.optical_gains,
            sha256=wire.checksum(matrix),
        )
        # A full disk must not stand in the way of a rollback: the archive has the source's numbers.
        with contextlib.suppress(StorageError):
            await self._keep(record, matrix, None, why)
        return ev.MatrixMade(record=record, wanted=effect.judged, anyway=effect.anyway)

    async def _judge(
        self, effect: ev.JudgeMatrix | ev.JudgeProposal, state: TrackerState
    ) -> Event | None:
        if isinstance(effect, ev.JudgeMatrix):
            return await self._margin(effect, state)
        matrix = await asyncio.to_thread(self.matrix, effect.id)
        judged = present_conditions(state, effect.gains)
        verdict = await self._verdict(matrix, effect.gains, state)
        return ev.ProposalJudged(id=effect.id, verdict=verdict, judged=judged, wanted=effect.wanted)

    async def _margin(self, effect: ev.JudgeMatrix, state: TrackerState) -> Event | None:
        if effect.id in self._judging:
            return None  # the answer to the question that waits serves
        rtc, registration = _there(state), _registration_to_use(state)
        self._judging.add(effect.id)
        try:
            matrix = await asyncio.to_thread(self.matrix, effect.id)
            gains = rtc.gains[: len(matrix)]
            verdict, expected = await self._workers.call(
                OpticsWorker.margin,
                matrix,
                self._conditions(state, gains),
                expected_gains(registration, rtc.n_modes),
                rtc.magnitude,
            )
        finally:
            self._judging.discard(effect.id)
        return ev.MarginJudged(
            id=effect.id,
            verdict=verdict,
            alpha=registration.alpha,
            expected=expected,
            judged=present_conditions(state, gains),
        )

    async def _verdict(
        self, matrix: NDArray[np.float32], gains: tuple[float, ...], state: TrackerState
    ) -> GateVerdict:
        conditions = self._conditions(state, gains)
        return await self._workers.call(OpticsWorker.judge, matrix, conditions)

    def _conditions(self, state: TrackerState, gains: tuple[float, ...]) -> Conditions:
        """Return what a reconstructor has to hold in now, with these gains."""
        registration = _registration_to_use(state)
        return Conditions(
            alpha=registration.alpha,
            covariance=registration.covariance_to_hold_in,
            loop=loop_to_judge(state, gains),
            bound=self._publishing.pole_radius_bound,
        )

    async def _ask_judged(self, request: wire.LoopRequest, state: TrackerState) -> Event | None:
        """Ask for gains only if the gate lets the matrix in use run with them."""
        if state.matrices.in_use is None or request.gains is None:
            # Not sent without a verdict: higher gains can make a stable loop unstable.
            raise CommandError("the reconstructor in use is not known: its gains cannot be judged")
        matrix = await asyncio.to_thread(self.matrix, state.matrices.in_use)
        verdict = await self._verdict(matrix, request.gains[: len(matrix)], state)
        if not verdict.accepted:
            refused = wire.Reply(
                id=request.id, accepted=False, reason=verdict.reason, start_seq=None
            )
            return ev.Answered(request=request, reply=refused)
        return await self._ask(request)

    async def _fetch(self, matrix_id: str | None, state: TrackerState) -> Event:
        manifest, matrix = await self._bridge.fetch_applied()
        if matrix_id not in {None, manifest.id}:
            raise LinkError(f"the RTC offers {manifest.id}, its status says it uses {matrix_id}")
        brought = products.ReconstructorRecord.brought(manifest)
        record = replace(brought, config_id=state.loop.config_id)
        known = state.reconstructor(record.id)
        if known is not None and known.sha256 not in {"", record.sha256}:
            return ev.MatrixFetched(record=record)  # the tracker says what that means
        # first: the archive refuses other numbers under an id it knows
        await asyncio.to_thread(self._store_foreign, record, matrix)
        self._remember(record.id, matrix)
        return ev.MatrixFetched(record=record)

    async def _send(self, effect: ev.SendMatrix, state: TrackerState) -> Event | None:
        rtc, record = _there(state), require_record(state, effect.id)
        matrix = await asyncio.to_thread(self.matrix, effect.id)
        commanded = state.loop.commanded_modes or rtc.n_controlled
        anew = effect.gains is not None or commanded != effect.n_modes
        if anew:
            # First, because the RTC rejects a matrix with another number of rows than was commanded
            #
            await self._command_modes(effect)
        layout = wire.layout_of(matrix, self._publishing.chunk_bytes)
        manifest = record.manifest(layout, rtc, self._publishing.system)
        await self._bridge.publish(manifest, matrix)
        return ev.ModesCommanded(n_modes=effect.n_modes) if anew else None

    async def _make_references(self, effect: ev.MakeReferences, state: TrackerState) -> Event:
        rtc, registration = _there(state), _registration_to_use(state)
        shape = state.references.shape
        if shape is None:
            raise CommandError("no shape is loaded")
        made = await self._workers.call(
            OpticsWorker.make_references,
            shape,
            registration.alpha,
            expected_gains(registration, rtc.n_modes),
            rtc.n_controlled,
            effect.worst_seeing_arcsec,
        )
        record = products.ReferencesRecord(
            id=effect.id,
            state=products.MatrixState.REFUSED if made.refusal else products.MatrixState.PROPOSED,
            created_ns_utc=self._clock_ns(),
            shape=shape.id,
            coefficients_m=made.coefficients_m,
            alpha=registration.alpha,
            gain=mean_gain(made.coefficients_m, registration.optical_gains),
            offset_rms=float(np.sqrt(np.mean(np.square(made.offset)))),
            unexplained_ratio=made.unexplained,
            sha256=wire.checksum(made.offset),
            reason=made.refusal,
        )
        await asyncio.to_thread(self._archive.references.store, record, made.offset)
        return ev.ReferencesMade(record=record)

    async def _send_references(self, effect: ev.SendReferences, state: TrackerState) -> Event:
        rtc, record = _there(state), require_references(state, effect.id)
        store, copied = self._archive.references, record.shape is None or record.parent is not None
        if record.shape is None:
            offset = np.zeros(rtc.n_slopes, np.float32)
        else:
            offset = await asyncio.to_thread(store.matrix, record.parent or record.id)
        if copied:
            # A full disk must not stand in the way of a rollback.
            with contextlib.suppress(StorageError):
                await asyncio.to_thread(store.store, record, offset)
        request = wire.ReferencesRequest(
            id=f"references-{self._clock_ns()}",
            reference_id=record.id,
            config_id=rtc.config_id,
            slopes=offset.astype("<f4").tobytes(),
            sha256=record.sha256,
            ramp_s=effect.ramp_s,
        )
        return ev.Answered(request=request, reply=await self._bridge.command(request))

    async def _command_modes(self, effect: ev.SendMatrix) -> None:
        """Command the number of modes and the gains of the next matrix."""
        reply = await self._bridge.command(
            wire.LoopRequest(
                id=f"modes-{self._clock_ns()}", gains=effect.gains, n_controlled=effect.n_modes
            )
        )
        if not reply.accepted:
            raise CommandError(f"the RTC will not control {effect.n_modes} modes: {reply.reason}")

    def _record(
        self, n_modes: int, why: str, registration: Registration | None, parent: str | None
    ) -> products.ReconstructorRecord:
        now_ns = self._clock_ns()
        stamp = datetime.fromtimestamp(now_ns / 1e9, UTC).strftime("%Y%m%dT%H%M%S.%f")[:-3]
        return products.ReconstructorRecord(
            id=f"cm-{stamp}-{n_modes}",
            state=products.MatrixState.PROPOSED,
            n_modes=n_modes,
            created_ns_utc=now_ns,
            alpha=None if registration is None else registration.alpha,
            sigma=None if registration is None else registration.sigma,
            parent=parent,
            optical_gains=() if registration is None else registration.optical_gains,
            reason=why,
        )

    async def _keep(
        self,
        record: products.ReconstructorRecord,
        matrix: NDArray[np.float32],
        registration: Registration | None,
        why: str,
    ) -> None:
        """Archive before sending, so that every sent matrix can be found."""
        self._remember(record.id, matrix)
        covariance = None if registration is None else registration.total_covariance
        provenance = {
            "instrument": self.instrument.name,
            "software": f"pyrcal {software_version()}",
            "why": why,
        }
        await asyncio.to_thread(
            self._archive.reconstructors.store, record, matrix, covariance, provenance
        )

    def _remember(self, matrix_id: str, matrix: NDArray[np.float32]) -> None:
        with self._guard:  # threads ask, too
            self._matrices[matrix_id] = matrix
            self._matrices.move_to_end(matrix_id)
            while len(self._matrices) > MATRICES_KEPT:
                self._matrices.popitem(last=False)

    def _store_foreign(
        self, record: products.ReconstructorRecord, matrix: NDArray[np.float32]
    ) -> None:
        """Archive the RTC's own matrix, once; another one under the same id is an error.

        It replaces one whose file is damaged: the RTC has the numbers.
        """
        try:
            same = wire.checksum(self._archive.reconstructors.matrix(record.id)) == record.sha256
        except (ArchiveError, UnknownIdError):  # damaged, or none of it
            provenance = {"instrument": self.instrument.name, "why": record.reason}
            self._archive.reconstructors.store(record, matrix, None, provenance)
            return
        if not same:
            raise LinkError(
                f"the RTC's matrix {record.id} is not the one archived under that id: give it "
                "another id, or use another data directory"
            )


GAIN_SAFETY = 1.1
"""Margin on a mean optical gain whose modes are unknown."""


def loop_to_judge(state: TrackerState, gains: tuple[float, ...]) -> ControlLoop:
    """Return the loop the gate is to judge, with the largest optical gains it may have."""
    rtc, registration = _there(state), _registration_to_use(state)
    mean = registration.optical_gain
    highest: float | NDArray[np.float64] = 1.0 if mean is None else GAIN_SAFETY * mean
    if registration.optical_gains:
        highest = gain_table(registration.optical_gains, len(gains)).highest
    return ControlLoop(
        gains=np.array(gains),
        leak=rtc.leak,
        delay_frames=rtc.delay_frames,
        frame_rate_hz=rtc.frame_rate_hz,
        optical_gain=highest,
        n_holding=modes_that_hold(state, gains),
    )


def expected_gains(registration: Registration, n_modes: int) -> NDArray[np.float64]:
    """Return the optical gain that each mode is expected to have, ``(n_modes,)``."""
    if registration.optical_gains:
        return gain_table(registration.optical_gains, n_modes).optical_gain
    return np.full(n_modes, registration.optical_gain or 1.0)


def present_conditions(state: TrackerState, gains: tuple[float, ...]) -> products.Judged:
    """Return the conditions of a verdict requested now."""
    rtc, registration = _there(state), _registration_to_use(state)
    return products.Judged(
        session=rtc.session,
        gains=tuple(gains),
        leak=rtc.leak,
        delay_frames=rtc.delay_frames,
        alpha=registration.alpha,
        sigma=registration.sigma,
    )


def modes_that_hold(state: TrackerState, gains: tuple[float, ...]) -> int | None:
    """Return how many modes the loop holds with, if these are its gains; None: it does not."""
    rtc = state.loop.rtc
    if (
        rtc is None
        or rtc.loop == "open"
        or alarms.blocking_alarm(state.alarms.active, alarms.Interlock.MEASURE) is not None
    ):
        return None
    n_modes = rtc.n_controlled
    return n_modes if same_gains(gains[:n_modes], rtc.gains[:n_modes]) else None


def _there(state: TrackerState) -> wire.Status:
    if state.loop.rtc is None:
        raise LinkError("no RTC is there")
    return state.loop.rtc


def _registration_to_use(state: TrackerState) -> Registration:
    """Return what matrices are made and judged for."""
    if state.alpha.registration is None:
        raise CommandError("α is not known")
    return registration_ahead(state, state.alpha.registration)
