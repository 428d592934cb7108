"""Check that an offload moves the image: α before and after."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from check_rtc.client import REPLY_S, TOTAL_M, RtcClient, stopped
from check_rtc.connection import ANSWER_S
from check_rtc.requirements import Checked, fine, seen, skipped, wrong
from service.errors import LinkError, WireError
from service.estimation.estimate import Estimate
from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInPlan, Spectra
from service.estimation.loop import closed_loop
from service.estimation.windows import ClosedLoop, WindowRefused
from service.model.misregistration import BOUNDARY_SCALE
from service.wire import (
    CommandKind,
    DitherKind,
    DitherRequest,
    OffloadRequest,
    Reply,
    Status,
    decode,
    encode,
)

Registered = Callable[[Spectra, ClosedLoop], Estimate | WindowRefused]
"""Makes α of a window of dither."""

STEP: Final = 0.1
"""Asked for along x, and back, subapertures: the service's own largest step."""

WINDOW_S: Final = 2.0
SETTLE_S: Final = 3.0
"""After which the image stands still where the reply does not say when: the service's default."""

LONGEST_S: Final = 50.0
"""Of a move, by its reply: the service believes no longer one."""

OBEDIENT: Final = (0.67, 1.33)
"""Share of a demand that is good enough."""

MOST_BESIDE: Final = 0.05
"""By which the image may move where it was not asked to, subapertures or fifths of a degree."""

LINES: Final = (0.21, 0.24, 0.27, 0.3)
"""Of the frame rate."""

_DRAINED_S: Final = 0.1
_BESIDE_UNITS: Final = np.array([1.0, 1.0, 5.0, 0.2])
_ALLOWED: Final = ("busy", "range", "unsupported")


def offload(
    client: RtcClient, matrix: NDArray[np.float32] | None, registered: Registered
) -> Checked:
    """Have the image moved a little and back, while a dither measures where it is."""
    status = client.watch.status
    if status is None or matrix is None or status.cm_id is None:
        return skipped("offload", "the matrix in use is not to be had on rtc/cm/applied")
    request = _dither(client, status)
    try:
        reply = client.connection.command(request)
        if not reply.accepted or reply.start_seq is None:
            return skipped("offload", f"there was no dither: {reply.reason}")
        loop = closed_loop(status, status.cm_id, matrix)
        return _moved(client, request, reply.start_seq, lambda spectra: registered(spectra, loop))
    except (LinkError, WireError) as error:
        return wrong("offload", str(error))
    finally:
        stopped(client)


def _moved(
    client: RtcClient,
    request: DitherRequest,
    from_seq: int,
    alpha: Callable[[Spectra], Estimate | WindowRefused],
) -> Checked:
    before = _measured(client, request, from_seq, alpha)
    if isinstance(before, str):
        return skipped("offload", f"α cannot be measured: {before}")
    demand = OffloadRequest(
        id=client.connection.new_id("offload"),
        shift_x_subap=STEP if before.alpha.shift_x_subap < 0.0 else -STEP,
        shift_y_subap=0.0,
        rotation_deg=0.0,
        magnification=0.0,
    )
    client.listen(_DRAINED_S)  # much has come while α was computed
    sent_seq = _next_seq(client)
    answer, took_s = client.connection.ask(CommandKind.OFFLOAD, encode(demand))
    if answer is None and took_s < ANSWER_S / 2:
        return skipped("offload", "no answer on cmd/rtc/offload")
    if answer is None or took_s > REPLY_S:
        unknown = "whether the image has moved is unknown: check where it is"
        return wrong("offload", f"no answer within {REPLY_S:g} s; {unknown}")
    reply = decode(Reply, answer)
    if not reply.accepted:
        allowed = reply.reason.partition(":")[0] in _ALLOWED
        return (skipped if allowed else wrong)("offload", f"it will not: {reply.reason}")
    try:
        return _compared(client, demand, reply, sent_seq, before, request, alpha)
    finally:  # whoever breaks it off wants the image where it was
        back = replace(
            demand, id=client.connection.new_id("back"), shift_x_subap=-demand.shift_x_subap
        )
        client.connection.command(back)


def _compared(
    client: RtcClient,
    demand: OffloadRequest,
    reply: Reply,
    sent_seq: int,
    before: Estimate,
    request: DitherRequest,
    alpha: Callable[[Spectra], Estimate | WindowRefused],
) -> Checked:
    """Ask again by the same id, wait until the image stands still, and measure."""
    problems = []
    if client.connection.command(demand) != reply:
        problems.append("the same id got another answer when asked again")
    rate_hz = client.watch.status.frame_rate_hz if client.watch.status else 1.0
    there_seq = sent_seq + round(SETTLE_S * rate_hz)
    if reply.start_seq is not None:
        there_seq = reply.start_seq
        lasts_s = (there_seq - sent_seq) / rate_hz
        if not 0.0 <= lasts_s <= LONGEST_S:
            span = f"expected 0 to {LONGEST_S:g} s ahead"
            return wrong("offload", f"start_seq is {lasts_s:.1f} s ahead of the frames, {span}")
    after = _measured(client, request, there_seq, alpha)
    if isinstance(after, str):
        return skipped("offload", f"α cannot be measured afterwards: {after}")
    way = (after.alpha.vector - before.alpha.vector) * BOUNDARY_SCALE
    sigma = float(np.sqrt(before.covariance[0, 0] + after.covariance[0, 0])) / STEP
    share = way[0] / demand.shift_x_subap
    found = f"the image moved by {share:.2f} of the {STEP:g} subap asked for, ± {sigma:.2f}"
    beside = np.abs(way * _BESIDE_UNITS)[1:].max()
    if not OBEDIENT[0] - 2 * sigma <= share <= OBEDIENT[1] + 2 * sigma:
        problems.append(_why(share))
    if problems:
        return wrong("offload", "; ".join([found, *problems]))
    if beside > MOST_BESIDE:
        return seen("offload", f"{found}, and elsewhere: {_as_text(way)}")
    start = "nil" if reply.start_seq is None else f"{(there_seq - sent_seq) / rate_hz:.1f} s ahead"
    return fine("offload", f"{found}; start_seq {start}; asked again it did not move again")


def _why(share: float) -> str:
    if share < -OBEDIENT[0]:
        return "that is the other sign"
    if 2 * OBEDIENT[0] < share < 2 * OBEDIENT[1]:
        return "a demand that comes twice with one id is carried out twice, or the unit is another"
    expected = f"expected {OBEDIENT[0]:g} to {OBEDIENT[1]:g}"
    return f"{expected}: another unit or axis, or it moves later than start_seq says"


def _as_text(way: NDArray[np.float64]) -> str:
    x, y, turned, size = way
    return f"{x:+.3f}, {y:+.3f} subap, {turned:+.3f} deg, {size:+.4f}"


def _dither(client: RtcClient, status: Status) -> DitherRequest:
    """Return sines on four modes outside the loop, or the highest ones of it."""
    n_outside = status.n_modes - status.n_controlled
    if n_outside >= len(LINES):
        modes = status.n_controlled + np.arange(len(LINES)) * n_outside // len(LINES)
    else:
        modes = np.arange(status.n_modes)[-len(LINES) :]
    modes = modes[: max(status.max_dither_modes, 1)]
    each_m = min(TOTAL_M / np.sqrt(len(modes)), status.max_dither_m)
    lines = [round(line * status.frame_rate_hz * WINDOW_S) / WINDOW_S for line in LINES]
    return DitherRequest(
        id=client.connection.new_id("dither"),
        kind=DitherKind.SINE,
        modes=tuple(modes.tolist()),
        amplitude_m=(float(each_m),) * len(modes),
        frequency_hz=tuple(lines[: len(modes)]),
        duration_s=2 * LONGEST_S,
    )


def _measured(
    client: RtcClient,
    request: DitherRequest,
    from_seq: int,
    alpha: Callable[[Spectra], Estimate | WindowRefused],
) -> Estimate | str:
    """Return α of the first window from a frame on, or why there is none."""
    status = client.watch.status
    rate_hz = status.frame_rate_hz if status else 1.0
    cutter = LockIn(
        plan=LockInPlan(
            modes=request.modes,
            amplitude_m=request.amplitude_m,
            n_frames=round(WINDOW_S * rate_hz),
            first_seq=from_seq + 1,
            frequencies_hz=request.frequency_hz or (),
            frame_rate_hz=rate_hz,
        )
    )
    ended: list[Spectra | WindowRefused] = []

    def take(block: FrameBlock) -> None:
        nonlocal cutter
        if not ended:
            cutter, found = cutter.accumulate(block)
            ended.extend(found)

    client.watch.block_takers.append(take)
    wait_s = (from_seq - _next_seq(client)) / rate_hz + 3.0 * WINDOW_S
    try:
        client.listen(max(wait_s, 3.0 * WINDOW_S), lambda: bool(ended))
    finally:
        client.watch.block_takers.remove(take)
    if not ended:
        return "no window of dither has come"
    found = ended[0] if isinstance(ended[0], WindowRefused) else alpha(ended[0])
    return found.reason if isinstance(found, WindowRefused) else found


def _next_seq(client: RtcClient) -> int:
    return max((one.stop_seq for one in client.watch.arrivals[-1:]), default=0)
