"""The simulator's exchange of matrices: faults on request, and a recording of what is sent."""

from __future__ import annotations

from dataclasses import replace

import zenoh
from typing_extensions import override

from pyrcal.rtc.identity import Reconstructor
from pyrcal.rtc.matrices import Matrices
from service.files.recording import RecordedKind, RecordingWriter
from service.wire import Acknowledgement, AckState, Keys
from service.wire.signing import Signatures
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.faults import Fault, FaultKind, FaultPlan


class FaultyMatrices(Matrices):
    """Exchanges matrices, with the faults of a plan.

    Faults: commits are ignored or rejected, swaps are late or acknowledged before they happen,
    matrices are applied with the sign turned, acknowledgements are not sent.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        computer: RealTimeComputer,
        *,
        signatures: Signatures,
        plan: FaultPlan,
        recorder: RecordingWriter | None,
    ) -> None:
        super().__init__(session, keys, computer, signatures=signatures)
        self._rtc = computer
        self._plan = plan
        self._recorder = recorder
        self._early: set[str] = set()
        """Ids of the matrices that were acknowledged before they were swapped in."""

        self._n_rejected: dict[Fault, int] = {}
        self._late: list[tuple[float, Reconstructor]] = []
        """Loop time in seconds at which each delayed matrix is passed to the loop."""

    @override
    def _follow_session(self) -> None:
        super()._follow_session()
        while self._late and self._late[0][0] <= self._plan.now_s:
            super()._stage(self._late.pop(0)[1])

    @override
    def _void(self) -> None:
        super()._void()
        self._late.clear()

    @override
    def _commit(self, key: str, data: bytes) -> None:
        if not self._plan.active(FaultKind.DEAF):
            super()._commit(key, data)

    @override
    def _refusal(self) -> str:
        fault = self._plan.active(FaultKind.REFUSE)
        if fault is None or self._n_rejected.get(fault, 0) >= fault.value("COUNT"):
            return ""
        self._n_rejected[fault] = self._n_rejected.get(fault, 0) + 1
        return "range: refused, as --fault requests"

    @override
    def _stage(self, reconstructor: Reconstructor) -> None:
        if self._plan.active(FaultKind.TURNED_SIGN):
            reconstructor = replace(reconstructor, matrix=-reconstructor.matrix)
        early = self._plan.active(FaultKind.EARLY_ACK)
        late = early or self._plan.active(FaultKind.LATE_SWAP)
        if late is None:
            super()._stage(reconstructor)
            return
        self._late.append((self._plan.now_s + late.value("DELAY"), reconstructor))
        if early is not None:
            matrix_id, seq = reconstructor.manifest.id, (self._rtc.status().seq or 0) + 1
            applied = self._staging.applied(matrix_id, seq)
            if applied is not None:
                self._acknowledge(applied)
                self._early.add(matrix_id)

    @override
    def _acknowledge(self, acknowledgement: Acknowledgement) -> None:
        # The swap itself is not acknowledged a second time.
        if acknowledgement.state is not AckState.APPLIED or acknowledgement.id not in self._early:
            super()._acknowledge(acknowledgement)

    @override
    def _put_acknowledgement(self, data: bytes) -> None:
        if self._plan.active(FaultKind.MUTE):
            return
        if self._recorder is not None:
            self._recorder.put(RecordedKind.ACKNOWLEDGEMENT, data)
        super()._put_acknowledgement(data)
