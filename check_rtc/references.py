"""Check that an offset of the reference slopes is subtracted, ramped, named and read back."""

from __future__ import annotations

from itertools import groupby
from typing import Final

import numpy as np
from numpy.typing import NDArray

from check_rtc.client import RtcClient
from check_rtc.requirements import CheckResult, fine, skipped, wrong
from service.errors import LinkError, WireError
from service.estimation.frames import FrameBlock
from service.wire import ReferencesInUse, ReferencesRequest, Status, checksum

RAMP_S: Final = 0.5
"""Duration of each ramp in the commands, seconds."""

RAMP_RANGE_S: Final = (0.4, 0.8)
"""Accepted duration of a ramp in the names of the frames; it may last to the end of a batch."""

AVERAGED_S: Final = 1.0
"""Time over which slopes are averaged before and after a ramp, seconds."""

OFFSET_SIGMA: Final = 20.0
"""Offset over the standard deviation of the slopes along it.

Turbulence that the loop does not see is slow: a mean over a second has up to half of that noise.
"""

MAX_ERROR: Final = 0.15
"""Largest error of the subtracted offset relative to the request."""

MAX_RAMP_ERROR: Final = 0.25
"""Largest departure of the mean during a ramp from half the offset; a ramp of batches has 0.1."""

_REPLY_TIMEOUT_S: Final = 3.0
"""Time in which a ramp must begin and end in addition to its duration, seconds."""


class _Recorder:
    """Slopes along one direction, frame by frame, with the names of the references."""

    def __init__(self, direction: NDArray[np.float64]) -> None:
        self.direction = direction
        self.frames: list[tuple[str | None, str, str | None, NDArray[np.float64]]] = []
        """Reference name, session, matrix and slopes along the direction of each block."""

    def take(self, block: FrameBlock) -> None:
        """Add a block of frames."""
        along = np.asarray(block.slopes @ self.direction, dtype=np.float64)
        self.frames.append((block.reference_name, block.session, block.cm_id, along))

    @property
    def names(self) -> list[str | None]:
        """Names of the references in the order in which frames have them."""
        return [name for name, _ in groupby(name for name, *_ in self.frames)]

    def under(self, name: str) -> NDArray[np.float64]:
        """Return the slopes of all frames under a name, ``(n_frames,)``."""
        return np.concatenate([np.empty(0), *(one[-1] for one in self.frames if one[0] == name)])


def check_references(client: RtcClient, status: Status) -> CheckResult:
    """Subtract a small offset and take it back.

    The offset is a direction of the slopes that the matrix in use does not see, so that the mirror
    does not move.
    """
    matrix = client.observer.loop.matrix
    direction = None if matrix is None else _find_unseen(matrix.astype(np.float64))
    if direction is None:
        return skipped("references", "no matrix in use is known that leaves slopes unseen")
    try:
        before = client.connection.fetch_references()
    except (LinkError, WireError) as error:
        return _explain_no_read_back(client, status, error)
    recorder = _Recorder(direction)
    client.observer.block_callbacks.append(recorder.take)
    try:
        return _check(client, status, before, recorder)
    except (LinkError, WireError) as error:
        return wrong("references", str(error))
    finally:
        client.observer.block_callbacks.remove(recorder.take)


def _find_unseen(matrix: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return a unit vector of slopes ``(n_slopes,)`` that the matrix maps to zero, if any."""
    drawn = np.random.default_rng(1).standard_normal(matrix.shape[1])
    unseen = drawn - matrix.T @ np.linalg.lstsq(matrix @ matrix.T, matrix @ drawn)[0]
    size = np.linalg.norm(unseen)
    return unseen / size if size > 0.1 * np.linalg.norm(drawn) else None


def _explain_no_read_back(client: RtcClient, status: Status, error: Exception) -> CheckResult:
    """Return the result if ``rtc/references`` cannot be read: right if there is no command."""
    request = _make_request(client, status, np.zeros(status.n_slopes + 1))
    try:
        reply = client.connection.command(request)
    except LinkError:
        return skipped("references", "the RTC does not offer the command, which is optional")
    if reply.reason.startswith("unsupported"):
        return skipped("references", f"not offered: {reply.reason}")
    return wrong("references", f"the command is offered, and rtc/references not: {error}")


def _make_request(
    client: RtcClient, status: Status, offset: NDArray[np.floating]
) -> ReferencesRequest:
    slopes, name = offset.astype("<f4"), client.connection.new_id("references")
    return ReferencesRequest(
        id=name,
        reference_id=name,
        config_id=status.config_id,
        slopes=slopes.tobytes(),
        sha256=checksum(slopes),
        ramp_s=RAMP_S,
    )


def _check(
    client: RtcClient, status: Status, before: ReferencesInUse, recorder: _Recorder
) -> CheckResult:
    client.listen(AVERAGED_S)
    at_first = np.concatenate([along for *_, along in recorder.frames])
    size = OFFSET_SIGMA * float(at_first.std())
    request = _make_request(client, status, before.offset + size * recorder.direction)
    reply = client.connection.command(request)
    if not reply.accepted:
        is_allowed = reply.reason.startswith(("unsupported", "busy"))
        return (skipped if is_allowed else wrong)("references", f"refused: {reply.reason}")
    try:
        problems = _follow_ramp(client, request, recorder)
        problems += _compare_read_back(client, request)
    finally:  # also if the user interrupts the check
        back = _make_request(client, status, before.offset)
        returned = client.connection.command(back)
    if not returned.accepted:
        return wrong("references", f"the return to the offset before: {returned.reason}")
    problems += _follow_ramp(client, back, recorder)
    names = [request.reference_id, f"{request.reference_id}~", back.reference_id]
    found = [recorder.under(name) for name in names]
    # A name without frames is a problem already.
    ratio, ramped, left = (
        float((at_first.mean() - one.mean()) / size) if len(one) else np.nan for one in found
    )
    if abs(ratio - 1.0) > MAX_ERROR:
        problems.insert(0, f"{ratio:.2f} of the offset is subtracted, expected 1: {_cause(ratio)}")
    elif abs(left) > MAX_ERROR:
        problems.append(f"{left:.2f} of the offset is left after the return: it was added")
    elif abs(ramped - 0.5) > MAX_RAMP_ERROR:
        problems.append(f"{ramped:.2f} of the offset on the ramp, expected half: it is not linear")
    problems += _find_changes(client, status, recorder)
    if problems:
        return wrong("references", "; ".join(problems))
    text = f"{ratio:.2f} of an offset is subtracted after a ramp, named and read back"
    return fine("references", f"{text}; the return took it away")


def _find_changes(client: RtcClient, status: Status, recorder: _Recorder) -> list[str]:
    """Return what has changed with the references and must not."""
    problems, after = [], client.observer.status or status
    if len({one[1:3] for one in recorder.frames}) > 1:
        problems.append("session or cm_id changed with the references")
    if (after.gains, after.leak) != (status.gains, status.leak):
        problems.append("gains or leak changed with the references")
    return problems


def _follow_ramp(client: RtcClient, request: ReferencesRequest, recorder: _Recorder) -> list[str]:
    """Wait until the whole offset is subtracted; return what is wrong in names and duration."""
    name, n_before = request.reference_id, len(recorder.names)
    status = client.observer.status
    rate_hz = 1.0 if status is None else status.frame_rate_hz
    ended = client.listen(_REPLY_TIMEOUT_S + RAMP_S, lambda: len(recorder.under(name)) > 0)
    if not ended:
        return [f"no frame names {name} within {_REPLY_TIMEOUT_S:g} s after the ramp"]
    client.listen(AVERAGED_S)
    problems, found = [], recorder.names[n_before:]
    if found != [f"{name}~", name]:
        problems.append(
            f"frames have the names {', '.join(map(str, found))}, expected {name}~ and {name}"
        )
    ramp_s = len(recorder.under(f"{name}~")) / rate_hz
    low, high = RAMP_RANGE_S
    if found[0] == f"{name}~" and not low <= ramp_s <= high:
        problems.append(f"a ramp of {RAMP_S:g} s takes {ramp_s:.2f} s")
    status = client.observer.status
    if status is None or status.reference_id != name:
        problems.append(f"the status does not name {name}")
    return problems


def _compare_read_back(client: RtcClient, request: ReferencesRequest) -> list[str]:
    try:
        in_use = client.connection.fetch_references()
    except (LinkError, WireError) as error:
        return [f"rtc/references afterwards: {error}"]
    if in_use.reference_id != request.reference_id:
        return [f"rtc/references afterwards has the name {in_use.reference_id}"]
    same = in_use.sha256 == request.sha256
    return [] if same else ["rtc/references afterwards has other numbers than were sent"]


def _cause(ratio: float) -> str:
    """Return the likely cause of an offset that is not subtracted as requested."""
    if abs(ratio) < MAX_ERROR:
        return "it is named and not applied, or not in the slopes of the frames"
    return "a wrong sign" if ratio < 0.0 else "a wrong scale, or another order of slopes"
