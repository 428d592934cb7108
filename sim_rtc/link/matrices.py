"""The simulator's exchange of matrices: faults on request, and a recording of what is sent."""

from __future__ import annotations

import zenoh
from typing_extensions import override

from pyrcal.rtc.identity import Reconstructor
from pyrcal.rtc.matrices import Matrices
from pyrcal.rtc.replies import Computer
from service.files.recording import RecordedKind, RecordingWriter
from service.wire import Keys
from service.wire.signing import Signatures
from sim_rtc.faults import Fault, FaultKind, FaultPlan


class FaultyMatrices(Matrices):
    """Exchanges matrices, with the faults of a plan.

    Faults: commits are ignored or rejected, swaps are late, acknowledgements are not sent.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        computer: Computer,
        *,
        signatures: Signatures,
        plan: FaultPlan,
        recorder: RecordingWriter | None,
    ) -> None:
        super().__init__(session, keys, computer, signatures=signatures)
        self._plan = plan
        self._recorder = recorder
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
        late = self._plan.active(FaultKind.LATE_SWAP)
        if late is None:
            super()._stage(reconstructor)
        else:
            self._late.append((self._plan.now_s + late.value("DELAY"), reconstructor))

    @override
    def _put_acknowledgement(self, data: bytes) -> None:
        if self._plan.active(FaultKind.MUTE):
            return
        if self._recorder is not None:
            self._recorder.put(RecordedKind.ACKNOWLEDGEMENT, data)
        super()._put_acknowledgement(data)
