"""Checks that send commands to the RTC: replies, signatures, and a small dither.

Also :class:`RtcClient`, which all checks use to wait for messages.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Final

import msgpack
import numpy as np
from numpy.typing import NDArray

from check_rtc.connection import ANSWER_TIMEOUT_S, RtcConnection
from check_rtc.requirements import CheckResult, fine, seen, skipped, wrong
from check_rtc.watch import TelemetryObserver
from service.errors import LinkError, WireError
from service.estimation.dither_monitor import DitherMeasurement, DitherMonitor, measure_block
from service.estimation.frames import FrameBlock
from service.estimation.windows import ExpectedDither
from service.wire import (
    FRAMES_PER_BATCH,
    CommandKind,
    DitherKind,
    DitherRequest,
    DitherStop,
    LoopRequest,
    ReferencesRequest,
    Reply,
    Status,
    decode,
    encode,
)

MAX_REPLY_DELAY_S: Final = 1.0
"""Longest time from a command to its reply by the contract, seconds."""

DITHER_RMS_M: Final = 7e-9
"""RMS of all lines of the dither together, metres OPD; less than the service's default budget."""

DITHER_LINE_RATIOS: Final = (0.08, 0.211, 0.239)
"""Frequencies of the dither over the frame rate.

At the slow one a lag of a few frames is a small phase, so that it differs from a reversed sign.
"""

DITHER_DURATION_S: Final = 6.0
"""Duration of the dither in the command, which is stopped earlier."""

ANALYSED_S: Final = 2.5
"""Duration of the dither that is analysed."""

LAG_GRID_FRAMES: Final = np.arange(-3.0, 3.01, 0.05)
"""Lags of slopes behind the commands of their row that are tried, frames."""

MAX_LAG_FRAMES: Final = 0.2
"""Largest lag of slopes and commands of the same exposure, frames."""

MAX_NOISE_RATIO: Final = 0.3
"""Largest noise over response with which a response is judged."""

MIN_RESPONSE_RATIO: Final = 0.1
"""Smallest response over command, noise added, of a mirror that moves."""

_NOISE_BINS: Final = (-4.0, -3.0, 3.0, 4.0)
"""Frequency bins near a line in which its noise is measured; the nearest have its leakage."""

_REPEAT_S: Final = 1.0
"""Time in which the frames after a repeated command must have no dither."""

_STOP_TIMEOUT_S: Final = 2.0
"""Longest time from the command to stop until frames and status show no dither."""


class RtcClient:
    """Connection to an RTC with the observer of its telemetry, and waiting for conditions."""

    def __init__(
        self,
        connection: RtcConnection,
        observer: TelemetryObserver,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self.connection, self.observer, self.clock = connection, observer, clock
        self._sleep = sleep

    def listen(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Receive messages for ``seconds`` or until a condition holds; return True if it does."""
        end_s = self.clock() + seconds
        while not until():
            left_s = end_s - self.clock()
            if left_s <= 0.0:
                return False
            self._sleep(min(left_s, 0.02))
            self.observer.take(self.connection.take())
        return True


# --- replies


@dataclass(frozen=True, slots=True)
class _InvalidCommand:
    """Command that an RTC must refuse."""

    kind: CommandKind
    payload: bytes
    what: str
    """Description for the report."""

    codes: tuple[str, ...] = ("range", "unsupported", "busy")
    """Words with one of which the reason of the refusal must begin."""

    optional: bool = False
    """True if an RTC may have no such command at all."""


def _invalid_commands(client: RtcClient, status: Status) -> list[_InvalidCommand]:
    """Return commands that no RTC may carry out, with values that would do no harm if it did."""
    new, n_modes = client.connection.new_id, status.n_modes
    dither = DitherRequest(
        id=new("dither"),
        kind=DitherKind.SINE,
        modes=(n_modes,),
        amplitude_m=(1e-12,),
        frequency_hz=(0.1 * status.frame_rate_hz,),
        duration_s=0.01,
    )
    keys = msgpack.unpackb(encode(dither))
    gains = encode(LoopRequest(id=new("loop"), gains=(0.0,) * (n_modes + 1)))
    measure = {"v": 1, "id": new("measure"), "pattern": "push-pull-modal", "modes": [n_modes]}
    measure |= dict.fromkeys(("frequency_hz", "duration_s"))
    measure |= {"amplitude_m": [1e-12], "n_average": 1}
    ramp = {"v": 1, "id": new("ramp"), "groups": [[1, 0]], "gains": [0.1], "frames_per_gain": 1}
    offload = {"v": 1, "id": new("offload"), "rotation_deg": 0.0, "magnification": 0.0}
    offload |= {"shift_x_subap": 0.0}
    no_slopes = b"\0" * 4 * status.n_slopes
    references = ReferencesRequest(
        id=new("references"),
        reference_id="no-references",
        config_id=status.config_id,
        slopes=no_slopes + b"\0" * 4,
        sha256=sha256(no_slopes + b"\0" * 4).hexdigest(),
        ramp_s=0.0,
    )
    wrong_sum = msgpack.unpackb(encode(references)) | {"slopes": no_slopes, "id": new("sum")}
    elsewhere = replace(
        references,
        id=new("sensor"),
        config_id="no-configuration-of-this-rtc",
        slopes=no_slopes,
        sha256=sha256(no_slopes).hexdigest(),
    )
    dithering = CommandKind.DITHER
    # One frame of a sine, whose first value is 0: the mirror does not move if it is accepted.
    frame = replace(dither, modes=(0,), duration_s=1.0 / status.frame_rate_hz)
    lines = status.max_dither_modes + 1
    many = replace(
        frame,
        modes=tuple(range(lines)),
        amplitude_m=(1e-12,) * lines,
        frequency_hz=(0.1 * status.frame_rate_hz,) * lines,
    )
    beyond = {
        "a dither above max_dither_m": replace(frame, amplitude_m=(2.0 * status.max_dither_m,)),
        "a dither at half the frame rate": replace(
            frame, frequency_hz=(0.5 * status.frame_rate_hz,)
        ),
    }
    if lines <= n_modes:
        beyond[f"a dither of {lines} modes"] = many
    without = {key: value for key, value in keys.items() if key != "modes"}
    return [
        # 0xc1 is the one byte that msgpack never uses. On a link with signatures these bytes are
        # refused before they are parsed, because they have none.
        _InvalidCommand(dithering, b"\xc1", "bytes of no message", ("range", "signature")),
        _InvalidCommand(
            dithering,
            msgpack.packb({**without, "id": new("missing")}),
            "a dither without the key modes",
            ("missing",),
        ),
        _InvalidCommand(
            dithering,
            msgpack.packb({**keys, "v": 2, "id": new("version")}),
            "a dither of version 2",
            ("v",),
        ),
        _InvalidCommand(dithering, msgpack.packb(keys), f"a dither of mode {n_modes}"),
        _InvalidCommand(
            dithering,
            msgpack.packb({**keys, "duration_s": 0.02}),
            "another command with a used id",
            ("id",),
        ),
        *(
            _InvalidCommand(dithering, encode(replace(request, id=new("beyond"))), what)
            for what, request in beyond.items()
        ),
        _InvalidCommand(CommandKind.LOOP, gains, "one gain more than modes"),
        _InvalidCommand(
            CommandKind.MEASURE,
            msgpack.packb(measure),
            f"a measurement of mode {n_modes}",
            optional=True,
        ),
        _InvalidCommand(
            CommandKind.RAMP, msgpack.packb(ramp), "a ramp of modes 1 to 0", optional=True
        ),
        _InvalidCommand(
            CommandKind.OFFLOAD,
            msgpack.packb(offload),
            "an offload demand of 0 without the key shift_y_subap",
            ("missing", "unsupported"),
            optional=True,
        ),
        *(
            _InvalidCommand(
                CommandKind.REFERENCES, payload, what, ("range", "unsupported"), optional=True
            )
            for what, payload in (
                ("references of one slope too many", encode(references)),
                ("references with another checksum", msgpack.packb(wrong_sum)),
                ("references of another configuration", encode(elsewhere)),
            )
        ),
    ]


def check_replies(client: RtcClient, status: Status) -> CheckResult:
    """Check the replies to commands that must be refused; one of them is sent twice."""
    problems, absent, slowest_s, first = [], [], 0.0, b""
    commands = _invalid_commands(client, status)
    for command in commands:
        response, took_s = client.connection.ask(command.kind, command.payload)
        if response is None:
            # zenoh says at once that a key has no queryable; a queryable that does not answer
            # costs the whole timeout.
            if command.optional and took_s < ANSWER_TIMEOUT_S / 2:
                absent.append(command.kind.value)
            else:
                problems.append(f"no answer to {command.what}")
            continue
        slowest_s = max(slowest_s, took_s)
        problems += _find_reply_problems(response, command, took_s)
        first = response if command is commands[3] else first
    again, _ = client.connection.ask(commands[3].kind, commands[3].payload)
    if first and (again is None or decode(Reply, again) != decode(Reply, first)):
        problems.append("a repeated id had another reply")
    if problems:
        return wrong("replies", "; ".join(problems))
    found = f"{len(commands) - len(absent)} refusals with their codes within {slowest_s:.2f} s"
    kinds = " and no ".join(dict.fromkeys(absent))
    without = f"; it offers no {kinds}" if absent else ""
    return fine("replies", f"{found}, and the same reply for a repeated id{without}")


def _find_reply_problems(response: bytes, command: _InvalidCommand, took_s: float) -> list[str]:
    try:
        reply = decode(Reply, response)
    except WireError as error:
        return [f"the reply to {command.what} cannot be read: {error}"]
    if reply.accepted:
        return [f"{command.what} was accepted"]
    word = reply.reason.partition(":")[0]
    if word not in command.codes:
        wanted = " or ".join(command.codes)
        return [f"{command.what} was refused with {reply.reason!r:.60}, expected {wanted}: ..."]
    return (
        [f"the reply to {command.what} took {took_s:.1f} s"] if took_s > MAX_REPLY_DELAY_S else []
    )


def check_signatures(client: RtcClient, status: Status) -> CheckResult:
    """Check signatures with a command that changes nothing: it sets the leak in use."""
    connection, kind = client.connection, CommandKind.LOOP
    if not connection.has_secret:
        return skipped("signatures", "no secret is shared: [zenoh.signing] in --config")
    plain = encode(LoopRequest(id=connection.new_id("signed"), leak=status.leak))
    signed = connection.sign(kind, plain)
    # The last byte belongs to the HMAC: the message itself stays readable.
    changed = signed[:-1] + bytes([signed[-1] ^ 1])
    problems = []
    for what, payload, expected in (
        ("an unsigned command", plain, False),
        ("a modified command", changed, False),
        ("a signed command", signed, True),
        ("a replayed command", signed, False),
    ):
        response, _ = connection.ask(kind, payload, is_signed=True)
        reply = None if response is None else decode(Reply, response)
        if reply is None:
            problems.append(f"no reply to {what}")
        elif reply.accepted is not expected:
            problems.append(f"{what} was {'accepted' if reply.accepted else reply.reason}")
        elif not expected and not reply.reason.startswith("signature"):
            found = f"{what} was refused with {reply.reason!r:.60}"
            problems.append(f"{found}, expected signature: ...")
    if problems:
        return wrong("signatures", "; ".join(problems))
    return fine("signatures", "refused: unsigned, modified and replayed commands")


# --- the dither


class _DitherRecorder:
    """Record of a dither in the frames, block by block."""

    def __init__(
        self, asked: ExpectedDither, matrix: NDArray[np.float32] | None, in_loop: list[int]
    ) -> None:
        self.first_seq: int | None = None
        """First frame with dither; None if none has come."""
        self.last_seq = -1
        """Last frame with dither."""
        self.next_seq = 0
        """Frame after the last one received."""
        self.findings: list[DitherMeasurement] = []
        """Measurements of the dither, one per second."""
        self.seq: list[NDArray[np.int64]] = []
        """Sequence numbers of the analysed frames, a block each; as the two below."""
        self.responses_m: list[NDArray[np.float64]] = []
        """Slopes times matrix of the controlled modes, ``(n_frames, n_modes)``."""
        self.commands_m: list[NDArray[np.float64]] = []
        """Commands of the same modes, ``(n_frames, n_modes)``."""
        self.dithers_m: list[NDArray[np.float64]] = []
        """Dither columns of the same modes, ``(n_frames, n_modes)``."""
        self._monitor, self._matrix, self._in_loop = DitherMonitor(asked=asked), matrix, in_loop
        self._span = asked.first_seq, asked.stop_seq

    def take(self, block: FrameBlock) -> None:
        """Add a block of frames."""
        self.next_seq = block.next_seq
        if block.dither_m is not None:
            rows = np.flatnonzero(block.dither_m.any(axis=1))
            if len(rows):
                self.last_seq = block.first_seq + int(rows[-1])
                if self.first_seq is None:
                    self.first_seq = block.first_seq + int(rows[0])
        self._monitor, found = measure_block(self._monitor, block)
        self.findings += [] if found is None else [found]
        first, stop = self._span
        # Only whole blocks inside the dither: outside it there is no response to measure.
        dither_m = block.dither_m
        if self._matrix is None or block.first_seq < first or block.next_seq > stop:
            return
        if dither_m is None:
            return
        self.seq.append(np.arange(block.first_seq, block.next_seq))
        modes = self._in_loop
        self.responses_m.append(np.asarray(block.slopes @ self._matrix[modes].T, dtype=float))
        self.commands_m.append(np.asarray(block.commands_m[:, modes], dtype=float))
        self.dithers_m.append(np.asarray(dither_m[:, modes], dtype=float))


def check_dither(
    client: RtcClient,
    status: Status,
    matrix: NDArray[np.float32] | None,
    max_rms_m: float = DITHER_RMS_M,
) -> list[CheckResult]:
    """Check that a small dither is played as requested and stops, and the columns of frames."""
    if status.dither is not None:
        reason = f"{status.dither_id} plays: stop it first"
        return [skipped("dither", reason), skipped("columns", reason)]
    modes = choose_dither_modes(status)
    amplitude = min(max_rms_m / np.sqrt(len(modes)), status.max_dither_m)
    request = DitherRequest(
        id=client.connection.new_id("dither"),
        kind=DitherKind.SINE,
        modes=modes,
        amplitude_m=(float(amplitude),) * len(modes),
        frequency_hz=tuple(
            line * status.frame_rate_hz for line in DITHER_LINE_RATIOS[: len(modes)]
        ),
        duration_s=DITHER_DURATION_S,
    )
    try:
        reply = client.connection.command(request)
    except LinkError as error:
        return [wrong("dither", str(error)), skipped("columns", "there was no dither")]
    if not reply.accepted or reply.start_seq is None:
        found = f"refused: {reply.reason}" if not reply.accepted else "start_seq is nil"
        return [wrong("dither", found), skipped("columns", "there was no dither")]
    try:
        recorder = _record_dither(client, status, request, reply.start_seq, matrix)
    finally:  # also if the user interrupts the check
        ended = stop_dither(client)
    stop_command_seq = recorder.next_seq
    has_stopped = client.listen(
        _STOP_TIMEOUT_S,
        lambda: (
            client.observer.status is not None
            and client.observer.status.dither is None
            # a full batch of frames without dither after the last frame with it
            and recorder.next_seq > recorder.last_seq + FRAMES_PER_BATCH
        ),
    )
    client.observer.block_callbacks.remove(recorder.take)
    problem = _compare_dither(client, request, reply.start_seq, recorder)
    if not problem and has_stopped:
        problem = _repeat_dither(client, request, reply)
    if not problem and not (ended.accepted and has_stopped):
        still_s = (recorder.last_seq - stop_command_seq) / status.frame_rate_hz
        problem = (
            f"not stopped: frames have it {still_s:.1f} s after the command to stop, or the status "
            f"still has it; reply: {ended.reason or 'accepted'}"
        )
    if problem:
        return [wrong("dither", problem), _check_columns(recorder, modes, status)]
    found_m = recorder.findings[-1].found_m
    found = (
        f"{1e9 * found_m:.2f} nm RMS on modes {', '.join(map(str, modes))} from frame "
        f"{reply.start_seq} as requested, until {recorder.last_seq}"
    )
    return [fine("dither", found), _check_columns(recorder, modes, status)]


def _repeat_dither(client: RtcClient, request: DitherRequest, reply: Reply) -> str:
    """Send the command of a stopped dither again; return what is wrong, empty if nothing is."""
    played: list[int] = []

    def take(block: FrameBlock) -> None:
        if block.is_dithered:
            played.append(block.first_seq)

    client.observer.block_callbacks.append(take)
    try:
        again = client.connection.command(request)
        client.listen(_REPEAT_S, lambda: bool(played))
    except LinkError as error:
        return f"its repeated command: {error}"
    finally:
        client.observer.block_callbacks.remove(take)
        ended = stop_dither(client)
    if played:
        return f"its repeated command was carried out again: dither from frame {played[0]} on"
    if again != reply:
        return f"its repeated command had another reply: {again.reason or again.start_seq}"
    return "" if ended.accepted else f"a stop without a dither was refused: {ended.reason}"


def stop_dither(client: RtcClient) -> Reply:
    """Stop the dither; return the reply, or a refusal if there is none."""
    try:
        return client.connection.command(DitherStop(id=client.connection.new_id("stop")))
    except LinkError as error:
        return Reply(id=None, accepted=False, reason=str(error), start_seq=None)


def choose_dither_modes(status: Status) -> tuple[int, ...]:
    """Return two controlled modes and an uncontrolled one, as far as there are any.

    Two controlled modes are needed for the lag; the amplitude of the uncontrolled one is not
    reduced by the loop.
    """
    in_loop = status.in_loop
    chosen = [in_loop[min(8, len(in_loop) // 4)], in_loop[len(in_loop) // 3]] if in_loop else []
    if status.n_controlled < status.n_modes or not in_loop:
        chosen.append(status.n_controlled + (status.n_modes - status.n_controlled) // 4)
    most = max(status.max_dither_modes, 1)
    return tuple(dict.fromkeys(min(mode, status.n_modes - 1) for mode in chosen))[:most]


def _record_dither(
    client: RtcClient,
    status: Status,
    request: DitherRequest,
    start_seq: int,
    matrix: NDArray[np.float32] | None,
) -> _DitherRecorder:
    """Record the dither after its command has been accepted."""
    rate_hz = status.frame_rate_hz
    stop_seq = start_seq + round(ANALYSED_S * rate_hz)
    is_uncontrolled = tuple(mode not in status.in_loop for mode in request.modes)
    asked = ExpectedDither(
        modes=request.modes,
        amplitude_m=request.amplitude_m,
        frequency_hz=request.frequency_hz or (),
        frame_rate_hz=rate_hz,
        first_seq=start_seq,
        stop_seq=stop_seq,
        own=is_uncontrolled,
    )
    in_loop = [mode for mode in request.modes if mode in status.in_loop]
    recorder = _DitherRecorder(asked, matrix, in_loop)
    client.observer.block_callbacks.append(recorder.take)
    client.listen(2.0 * ANALYSED_S, lambda: recorder.next_seq >= stop_seq)
    return recorder


def _compare_dither(
    client: RtcClient, request: DitherRequest, start_seq: int, recorder: _DitherRecorder
) -> str:
    """Return the difference between the dither and the request; empty if there is none."""
    if recorder.first_seq is None:
        return f"accepted from frame {start_seq}, but no frame contains it"
    late = recorder.first_seq - start_seq
    if late not in {0, 1}:  # the first value of a sine is 0
        return f"it begins at frame {recorder.first_seq}, {late} after its start_seq"
    texts = [finding.text for finding in recorder.findings if finding.text]
    if texts:
        return texts[0]
    if not recorder.findings:
        return "less than a second of it has come"
    shown = [
        status.dither for _, status in client.observer.statuses if status.dither_id == request.id
    ]
    if not shown or shown[0] is None:
        return "no status shows it"
    if shown[0].start_seq != start_seq or shown[0].request != request:
        return "the status shows another dither than requested"
    return ""


def _check_columns(
    recorder: _DitherRecorder, modes: tuple[int, ...], status: Status
) -> CheckResult:
    """Check that slopes and commands of a row are of one exposure, from two controlled modes.

    The matrix in use turns slopes into modes. Their phase at the dither lines against that of the
    commands is a lag, if it is proportional to frequency, or a reversed sign.
    """
    n_lines = recorder.responses_m[0].shape[1] if recorder.responses_m else 0
    if n_lines < 2 or recorder.first_seq is None:
        return skipped("columns", "needs the matrix in use and a dither on two controlled modes")
    seq = np.concatenate(recorder.seq)
    in_loop = [mode in status.in_loop for mode in modes]
    phase_per_frame = 2 * np.pi * np.array(DITHER_LINE_RATIOS[: len(modes)])[in_loop]
    responses_m = np.concatenate(recorder.responses_m)
    commands_m, dithers_m = (np.concatenate(x) for x in (recorder.commands_m, recorder.dithers_m))
    response, noise = _measure_transfer(seq, responses_m, commands_m, phase_per_frame)
    if (np.abs(response) + noise < MIN_RESPONSE_RATIO).all():
        return wrong("columns", "slopes do not respond to the commands: the mirror does not move")
    if (noise > MAX_NOISE_RATIO * np.abs(response)).any():
        ratio = np.max(noise / np.abs(response))
        return skipped("columns", f"too noisy: noise is {ratio:.2f} of the response")
    fit = _fit_lag(response, noise, phase_per_frame)
    found = f"slopes lag {fit.lag:+.2f} frames behind the commands of their row"
    share = float(np.median(np.abs(response)))
    if fit.is_reversed or not fit.is_same_exposure:
        # Without the dither the columns are the loop's answer to it, which has the other sign.
        total = _measure_transfer(seq, responses_m, commands_m + dithers_m, phase_per_frame)
        with_dither = _fit_lag(*total, phase_per_frame)
        if with_dither.is_same_exposure and not with_dither.is_reversed:
            lacking = "the command columns lack the dither: with it they agree with the slopes"
            return wrong("columns", f"{lacking} (lag {with_dither.lag:+.2f} frames)")
        turned = "slopes times matrix have the opposite sign of the commands"
        return wrong("columns", turned if fit.is_reversed else found)
    # Optical gain and double pass explain a response between 0.1 and 3; units do not.
    found += f"; their response by the matrix in use is {share:.2f}"
    return (fine if 0.1 < share < 3.0 else seen)("columns", found)


@dataclass(frozen=True, slots=True)
class _LagFit:
    """Sign and lag of the slopes against the commands of their row."""

    is_reversed: bool
    lag: float
    """Lag in frames."""

    sigma: float
    """1 σ of the lag, frames."""

    @property
    def is_same_exposure(self) -> bool:
        """True if the lag is that of slopes and commands of one exposure."""
        return abs(self.lag) <= MAX_LAG_FRAMES + 3.0 * self.sigma


def _fit_lag(
    response: NDArray[np.complex128],
    noise: NDArray[np.float64],
    phase_per_frame: NDArray[np.float64],
) -> _LagFit:
    """Fit sign and lag to the phases at all lines, each weighted by its signal-to-noise ratio."""
    unit, weight = response / np.abs(response), np.abs(response) / np.maximum(noise, 1e-9)
    models = np.exp(-1j * np.outer(LAG_GRID_FRAMES, phase_per_frame))
    misfit = np.stack([np.abs(unit - sign * models) ** 2 @ weight**2 for sign in (1.0, -1.0)])
    k_sign, k_lag = np.unravel_index(int(np.argmin(misfit)), misfit.shape)
    sigma = 1.0 / np.sqrt(np.sum((weight * phase_per_frame) ** 2))
    return _LagFit(bool(k_sign), float(LAG_GRID_FRAMES[k_lag]), float(sigma))


def _measure_transfer(
    seq: NDArray[np.int64],
    responses_m: NDArray[np.float64],
    commands_m: NDArray[np.float64],
    phase_per_frame: NDArray[np.float64],
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Return the response over the command at each line ``(n_lines,)``, complex, and its noise."""
    window = np.hanning(len(seq))
    bin_rad = 2 * np.pi / max(int(seq[-1] - seq[0]), 1)

    def at(columns: NDArray[np.float64], shift: float) -> NDArray[np.complex128]:
        phasors = np.exp(-1j * np.outer(seq, phase_per_frame + shift * bin_rad)) * window[:, None]
        return np.asarray(np.sum(phasors * (columns - columns.mean(axis=0)), axis=0))

    moved = at(commands_m, 0.0)
    # Slopes see commands and turbulence. What exceeds the commands is turbulence and noise, also
    # where the slopes are turned.
    sides = [
        [at(responses_m - sign * commands_m, shift) for shift in _NOISE_BINS] for sign in (1, -1)
    ]
    noise = np.sqrt(np.mean(np.abs(sides) ** 2, axis=1)).min(axis=0) / np.abs(moved)
    return at(responses_m, 0.0) / moved, noise
