"""Faults of the telemetry on its way: batches lost, late, twice, in disorder, damaged."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.wire import FrameHeader, encode_frames
from sim_rtc.faults import FaultKind, FaultPlan
from sim_rtc.telemetry import new_session

Array32 = NDArray[np.float32]
Sendable = tuple[bytes, bytes]
"""Payload and attachment of one batch."""

_OTHER_BASIS = "another-basis"
_NONSENSE = b"\xc1 no header of frames"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Held:
    """A batch that waits for its time."""

    due_s: float
    message: Sendable


class WireFaults:
    """Turns each batch into what is really sent, in that order; for one thread."""

    def __init__(self, plan: FaultPlan, rng: np.random.Generator) -> None:
        self._plan = plan
        self._rng = rng
        self._held: list[_Held] = []
        self._frozen: Array32 | None = None
        self._overtaken: list[Sendable] = []
        self._second_session = new_session()
        self._n_garbled = 0

    def messages(self, header: FrameHeader, rows: Array32, time_s: float) -> list[Sendable]:
        """Return what is sent now: this batch or what has become of it, and what was held."""
        due = [held.message for held in self._held if held.due_s <= time_s]
        self._held = [held for held in self._held if held.due_s > time_s]
        header, rows = self._damaged(header, rows, time_s)
        sent = due + self._on_the_way(self._garbled(encode_frames(header, rows), time_s), time_s)
        if self._plan.active(FaultKind.SECOND, time_s):
            other = replace(header, session=self._second_session)
            sent.append(encode_frames(other, rows))
        return sent

    def basis_id(self, basis_id: str, time_s: float) -> str:
        """Return the basis that frames and status name."""
        return _OTHER_BASIS if self._plan.active(FaultKind.BASIS, time_s) else basis_id

    def _damaged(
        self, header: FrameHeader, rows: Array32, time_s: float
    ) -> tuple[FrameHeader, Array32]:
        n_slopes = header.n_slopes
        if self._plan.active(FaultKind.FROZEN, time_s):
            if self._frozen is None:
                self._frozen = rows[-1, :n_slopes].copy()
            rows = np.hstack([np.tile(self._frozen, (header.n, 1)), rows[:, n_slopes:]])
        else:
            self._frozen = None
        fault = self._plan.active(FaultKind.NAN, time_s)
        if fault is not None:
            struck = self._rng.random(header.n) < fault.value("SHARE")
            rows = rows.copy()
            rows[struck, self._rng.integers(n_slopes)] = np.nan
        if self._plan.active(FaultKind.SHAPE, time_s):
            rows = np.delete(rows, n_slopes - 1, axis=1)
            header = replace(header, n_slopes=n_slopes - 1)
        return replace(header, basis_id=self.basis_id(header.basis_id, time_s)), rows

    def _garbled(self, message: Sendable, time_s: float) -> Sendable:
        if not self._struck(FaultKind.GARBAGE, time_s):
            return message
        self._n_garbled += 1
        payload, attachment = message
        return (payload, _NONSENSE) if self._n_garbled % 2 else (payload[:-3], attachment)

    def _on_the_way(self, message: Sendable, time_s: float) -> list[Sendable]:
        """Return what leaves in place of a batch, after one that it has overtaken."""
        late = self._plan.active(FaultKind.LATE, time_s)
        sent: list[Sendable] = []
        if self._struck(FaultKind.LOST, time_s):
            pass
        elif late is not None:
            self._held.append(_Held(due_s=time_s + late.value("DELAY"), message=message))
        else:
            sent = [message] * (2 if self._struck(FaultKind.DUPLICATED, time_s) else 1)
        if not self._overtaken and self._struck(FaultKind.REORDERED, time_s):
            self._overtaken = sent
            return []
        sent += self._overtaken
        self._overtaken = []
        return sent

    def _struck(self, kind: FaultKind, time_s: float) -> bool:
        fault = self._plan.active(kind, time_s)
        return fault is not None and bool(self._rng.random() < fault.value("SHARE"))
