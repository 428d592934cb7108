"""The offset of an RTC's reference slopes, which the service sets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.wire import ReferencesInUse, ReferencesRequest, checksum

Array32 = NDArray[np.float32]

RAMP_SUFFIX = "~"
"""End of the name of reference slopes during the ramp to them."""


class ReferenceOffset:
    """Slopes to subtract beyond an RTC's own reference slopes, and the ramp from one to the next.

    The offset is zero until the service requests another one.
    """

    def __init__(self, n_slopes: int) -> None:
        self.slopes: Array32 = np.zeros(n_slopes, dtype=np.float32)
        """Offset in the latest frame, ``(n_slopes,)``."""
        self.name: str | None = None
        """``reference_id`` of the latest frame; None before the first request."""
        self._request: ReferencesRequest | None = None
        self._start_seq = self._n_ramp = 0
        self._before: Array32 | None = None

    def check(self, request: ReferencesRequest, config_id: str) -> str:
        """Return the reason of a refusal with its code; empty if there is none."""
        if request.config_id != config_id:
            return f"range: config_id {request.config_id}, expected {config_id}"
        if len(request.offset) != len(self.slopes):
            return f"range: {len(request.offset)} slopes, expected {len(self.slopes)}"
        return ""

    def begin(self, request: ReferencesRequest, start_seq: int, frame_rate_hz: float) -> None:
        """Begin the ramp to another offset in the first batch from frame ``start_seq`` on."""
        self._request, self._start_seq, self._before = request, start_seq, None
        self._n_ramp = max(round(request.ramp_s * frame_rate_hz), 1)

    def is_steady(self, seq: int) -> bool:
        """Return True if a batch that begins at frame ``seq`` has the offset of the latest one."""
        return self._request is None or seq < self._start_seq

    def advance(self, seq: int, n_frames: int) -> Array32:
        """Return the offset of the next frames ``(n_frames, n_slopes)``; the first one is ``seq``.

        :attr:`name` is that of these frames afterwards. A batch has one name, so the name of the
        ramp lasts until the end of the batch in which the ramp ends.
        """
        request = self._request
        if request is None or seq < self._start_seq:
            return np.broadcast_to(self.slopes, (n_frames, len(self.slopes)))
        if self._before is None:
            self._before, self._start_seq = self.slopes, seq
        done = np.arange(seq + 1, seq + n_frames + 1) - self._start_seq
        share = np.minimum(done / self._n_ramp, 1.0).astype(np.float32)[:, None]
        offsets: Array32 = self._before + share * (request.offset - self._before)
        # The very numbers at the end, so that they read back with the checksum of the request.
        offsets[share[:, 0] == 1.0] = request.offset
        self.slopes, ramps = offsets[-1], bool(share[0, 0] < 1.0)
        self.name = request.reference_id + (RAMP_SUFFIX if ramps else "")
        if not ramps:
            self._request = None
        return offsets

    def in_use(self, reference_id: str) -> ReferencesInUse:
        """Return the message that reads the offset back, under the name in frames and status."""
        data = self.slopes.astype("<f4").tobytes()
        return ReferencesInUse(reference_id=reference_id, slopes=data, sha256=checksum(self.slopes))
