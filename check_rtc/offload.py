"""Check that an offload demand moves the mirror's image, by α measured before and after."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from check_rtc.client import DITHER_RMS_M, MAX_REPLY_DELAY_S, RtcClient, stop_dither
from check_rtc.connection import ANSWER_TIMEOUT_S
from check_rtc.requirements import CheckResult, fine, seen, skipped, wrong
from service.errors import LinkError, WireError
from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInPlan, Spectra
from service.estimation.loop import build_loop
from service.estimation.windows import ClosedLoop
from service.model.misregistration import BOUNDARY_SCALE
from service.records.estimates import Estimate, WindowRefused
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

RegistrationFit = Callable[[Spectra, ClosedLoop], Estimate | WindowRefused]
"""Function that fits α to the spectra of a window of dither."""

STEP_SUBAP: Final = 0.1
"""Demand along x, and back, in subapertures; the largest single step of the service."""

WINDOW_S: Final = 2.0
"""Duration of the dither from which α is measured, seconds."""

SETTLING_S: Final = 3.0
"""Time until the image is still if the reply gives no ``start_seq``; the service's default."""

MAX_MOVE_S: Final = 50.0
"""Longest duration of a move by its ``start_seq``; the service ignores a longer one."""

MOVE_RATIO_RANGE: Final = (0.67, 1.33)
"""Accepted range of the measured move over the demand."""

MAX_SIDE_MOTION: Final = 0.05
"""Largest change of the other parameters, each multiplied by ``_SIDE_MOTION_SCALE``."""

ALPHA_LINE_RATIOS: Final = (0.21, 0.24, 0.27, 0.3)
"""Frequencies of the dither over the frame rate."""

_DRAIN_S: Final = 0.1
"""Time to read the frames that were queued during a fit."""

_SIDE_MOTION_SCALE: Final = np.array([1.0, 1.0, 5.0, 0.2])
"""Factors on changes in subapertures, degrees and magnification that make them comparable."""

_REFUSAL_CODES: Final = ("busy", "range", "unsupported")
"""First words of refusals that break no rule of the contract."""


def check_offload(
    client: RtcClient, matrix: NDArray[np.float32] | None, fit_registration: RegistrationFit
) -> CheckResult:
    """Move the image a little and back, and measure α with a dither before and after."""
    status = client.observer.status
    if status is None or matrix is None or status.cm_id is None:
        return skipped("offload", "rtc/cm/applied does not give the matrix in use")
    request = _dither(client, status)
    try:
        reply = client.connection.command(request)
        if not reply.accepted or reply.start_seq is None:
            return skipped("offload", f"there was no dither: {reply.reason}")
        loop = build_loop(status, status.cm_id, matrix)
        return _check_move(
            client, request, reply.start_seq, lambda spectra: fit_registration(spectra, loop)
        )
    except (LinkError, WireError) as error:
        return wrong("offload", str(error))
    finally:
        stop_dither(client)


def _check_move(
    client: RtcClient,
    request: DitherRequest,
    from_seq: int,
    alpha: Callable[[Spectra], Estimate | WindowRefused],
) -> CheckResult:
    before = _measure_alpha(client, request, from_seq, alpha)
    if isinstance(before, str):
        return skipped("offload", f"α cannot be measured: {before}")
    demand = OffloadRequest(
        id=client.connection.new_id("offload"),
        # Towards zero, so that the check never makes the registration worse.
        shift_x_subap=STEP_SUBAP if before.alpha.shift_x_subap < 0.0 else -STEP_SUBAP,
        shift_y_subap=0.0,
        rotation_deg=0.0,
        magnification=0.0,
    )
    # The fit took seconds, in which frames were queued. Without reading them ``sent_seq`` would be
    # that long ago, and the window after the move would begin before it.
    client.listen(_DRAIN_S)
    sent_seq = _next_seq(client)
    answer, took_s = client.connection.ask(CommandKind.OFFLOAD, encode(demand))
    if answer is None and took_s < ANSWER_TIMEOUT_S / 2:
        return skipped("offload", "no answer on cmd/rtc/offload")
    if answer is None or took_s > MAX_REPLY_DELAY_S:
        unknown = "the image may have moved or not: check its position"
        return wrong("offload", f"no reply within {MAX_REPLY_DELAY_S:g} s; {unknown}")
    reply = decode(Reply, answer)
    if not reply.accepted:
        allowed = reply.reason.partition(":")[0] in _REFUSAL_CODES
        return (skipped if allowed else wrong)("offload", f"refused: {reply.reason}")
    try:
        return _compare_move(client, demand, reply, sent_seq, before, request, alpha)
    finally:  # also if the user interrupts the check: the image must not stay displaced
        back = replace(
            demand, id=client.connection.new_id("back"), shift_x_subap=-demand.shift_x_subap
        )
        client.connection.command(back)


def _compare_move(
    client: RtcClient,
    demand: OffloadRequest,
    reply: Reply,
    sent_seq: int,
    before: Estimate,
    request: DitherRequest,
    alpha: Callable[[Spectra], Estimate | WindowRefused],
) -> CheckResult:
    """Repeat the demand with the same id, wait until the image is still, and measure the move.

    A repeated id must not move the image again, which would show as twice the demand.
    """
    problems = []
    if client.connection.command(demand) != reply:
        problems.append("a repeated id had another reply")
    rate_hz = client.observer.status.frame_rate_hz if client.observer.status else 1.0
    still_seq = sent_seq + round(SETTLING_S * rate_hz)
    if reply.start_seq is not None:
        still_seq = reply.start_seq
        move_s = (still_seq - sent_seq) / rate_hz
        if not 0.0 <= move_s <= MAX_MOVE_S:
            span = f"expected 0 to {MAX_MOVE_S:g} s ahead"
            return wrong("offload", f"start_seq is {move_s:.1f} s ahead of the frames, {span}")
    after = _measure_alpha(client, request, still_seq, alpha)
    if isinstance(after, str):
        return skipped("offload", f"α cannot be measured afterwards: {after}")
    change = (after.alpha.vector - before.alpha.vector) * BOUNDARY_SCALE
    sigma = float(np.sqrt(before.covariance[0, 0] + after.covariance[0, 0])) / STEP_SUBAP
    ratio = change[0] / demand.shift_x_subap
    found = f"the image moved by {ratio:.2f} of the {STEP_SUBAP:g} subap demanded, ± {sigma:.2f}"
    side_motion = np.abs(change * _SIDE_MOTION_SCALE)[1:].max()
    # The measured ratio has the noise of two windows of α, so the range is wider by 2 σ.
    if not MOVE_RATIO_RANGE[0] - 2 * sigma <= ratio <= MOVE_RATIO_RANGE[1] + 2 * sigma:
        problems.append(_explain_ratio(ratio))
    if problems:
        return wrong("offload", "; ".join([found, *problems]))
    if side_motion > MAX_SIDE_MOTION:
        return seen("offload", f"{found}, and in other parameters: {_format_move(change)}")
    start = "nil" if reply.start_seq is None else f"{(still_seq - sent_seq) / rate_hz:.1f} s ahead"
    return fine("offload", f"{found}; start_seq {start}; a repeated id did not move it again")


def _explain_ratio(ratio: float) -> str:
    """Return the likely cause of a move that is not as demanded."""
    if ratio < -MOVE_RATIO_RANGE[0]:
        return "that is the opposite sign"
    if 2 * MOVE_RATIO_RANGE[0] < ratio < 2 * MOVE_RATIO_RANGE[1]:
        return "a repeated demand with the same id is carried out twice, or the unit is wrong"
    expected = f"expected {MOVE_RATIO_RANGE[0]:g} to {MOVE_RATIO_RANGE[1]:g}"
    return f"{expected}: a wrong unit or axis, or the image moves later than start_seq says"


def _format_move(change: NDArray[np.float64]) -> str:
    x, y, rotation_deg, magnification = change
    return f"{x:+.3f}, {y:+.3f} subap, {rotation_deg:+.3f} deg, {magnification:+.4f}"


def _dither(client: RtcClient, status: Status) -> DitherRequest:
    """Return sines on four uncontrolled modes, or on the highest modes if there are fewer."""
    n_outside = status.n_modes - status.n_controlled
    if n_outside >= len(ALPHA_LINE_RATIOS):
        modes = status.n_controlled + np.arange(len(ALPHA_LINE_RATIOS)) * n_outside // len(
            ALPHA_LINE_RATIOS
        )
    else:
        modes = np.arange(status.n_modes)[-len(ALPHA_LINE_RATIOS) :]
    modes = modes[: max(status.max_dither_modes, 1)]
    each_m = min(DITHER_RMS_M / np.sqrt(len(modes)), status.max_dither_m)
    # Whole periods in a window, so that lines do not leak into each other.
    lines = [round(line * status.frame_rate_hz * WINDOW_S) / WINDOW_S for line in ALPHA_LINE_RATIOS]
    return DitherRequest(
        id=client.connection.new_id("dither"),
        kind=DitherKind.SINE,
        modes=tuple(modes.tolist()),
        amplitude_m=(float(each_m),) * len(modes),
        frequency_hz=tuple(lines[: len(modes)]),
        duration_s=2 * MAX_MOVE_S,
    )


def _measure_alpha(
    client: RtcClient,
    request: DitherRequest,
    from_seq: int,
    alpha: Callable[[Spectra], Estimate | WindowRefused],
) -> Estimate | str:
    """Return α of the first window from ``from_seq`` on, or the reason why there is none."""
    status = client.observer.status
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

    client.observer.block_callbacks.append(take)
    wait_s = (from_seq - _next_seq(client)) / rate_hz + 3.0 * WINDOW_S
    try:
        client.listen(max(wait_s, 3.0 * WINDOW_S), lambda: bool(ended))
    finally:
        client.observer.block_callbacks.remove(take)
    if not ended:
        return "no complete window of dither has come"
    found = ended[0] if isinstance(ended[0], WindowRefused) else alpha(ended[0])
    return str(found.reason) if isinstance(found, WindowRefused) else found


def _next_seq(client: RtcClient) -> int:
    return max((one.stop_seq for one in client.observer.arrivals[-1:]), default=0)
