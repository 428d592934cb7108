"""Checks that ask the RTC; they move nothing but a dither."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import msgpack
import numpy as np
from numpy.typing import NDArray

from check_rtc.connection import ANSWER_S, RtcConnection
from check_rtc.requirements import Checked, fine, seen, skipped, wrong
from check_rtc.watch import TelemetryObserver
from service.errors import LinkError, WireError
from service.estimation.dither_monitor import DitherMeasurement, DitherMonitor, measure_block
from service.estimation.frames import FrameBlock
from service.estimation.windows import ExpectedDither
from service.wire import (
    CommandKind,
    DitherKind,
    DitherRequest,
    DitherStop,
    LoopRequest,
    Reply,
    Status,
    decode,
    encode,
)

REPLY_S: Final = 1.0
"""Within which a command is answered."""

TOTAL_M: Final = 7e-9
"""RMS of all lines of the check's dither together: below what the service plays by itself."""

LINES: Final = (0.08, 0.211, 0.239)
"""Of the frame rate. The slow one tells a sign from a lag."""

DITHER_S: Final = 6.0
"""Asked for; it is stopped before."""

PLAYED_S: Final = 2.5
"""Of dither that is looked at."""

LAGS: Final = np.arange(-3.0, 3.01, 0.05)
"""Frames by which slopes may lag the commands of their row."""

MOST_LAG: Final = 0.2
NOISY: Final = 0.3
"""Noise over answer from which on a line tells nothing."""

SILENT: Final = 0.1
"""Least answer over command, noise included, of a mirror that moves."""

_SIDES: Final = (-4.0, -3.0, 3.0, 4.0)
"""Bins beside a line, where its noise is."""

_STOPS_S: Final = 2.0


class RtcClient:
    """A connection and an observer of telemetry, pumped while something is awaited."""

    def __init__(
        self,
        connection: RtcConnection,
        observer: TelemetryObserver,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self.connection, self.watch, self.clock = connection, observer, clock
        self._sleep = sleep

    def listen(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Listen for so long, or until a condition holds; return whether it does."""
        end_s = self.clock() + seconds
        while not until():
            left_s = end_s - self.clock()
            if left_s <= 0.0:
                return False
            self._sleep(min(left_s, 0.02))
            self.watch.take(self.connection.take())
        return True


# --- replies


@dataclass(frozen=True, slots=True)
class _Question:
    """A command that must be refused."""

    kind: CommandKind
    payload: bytes
    what: str
    words: tuple[str, ...] = ("range", "unsupported", "busy")
    """With one of which the reason may begin."""

    optional: bool = False


def _questions(client: RtcClient, status: Status) -> list[_Question]:
    """Return commands that no RTC can carry out."""
    new, n_modes = client.connection.new_id, status.n_modes
    dither = DitherRequest(
        id=new("dither"),
        kind=DitherKind.SINE,
        modes=(n_modes,),
        amplitude_m=(1e-12,),
        frequency_hz=(0.1 * status.frame_rate_hz,),
        duration_s=0.01,
    )
    told = msgpack.unpackb(encode(dither))
    gains = encode(LoopRequest(id=new("loop"), gains=(0.0,) * (n_modes + 1)))
    measure = {"v": 1, "id": new("measure"), "pattern": "push-pull-modal", "modes": [n_modes]}
    measure |= dict.fromkeys(("frequency_hz", "duration_s"))
    measure |= {"amplitude_m": [1e-12], "n_average": 1}
    ramp = {"v": 1, "id": new("ramp"), "groups": [[1, 0]], "gains": [0.1], "frames_per_gain": 1}
    offload = {"v": 1, "id": new("offload"), "rotation_deg": 0.0, "magnification": 0.0}
    offload |= {"shift_x_subap": 0.0}
    dithering = CommandKind.DITHER
    without = {key: value for key, value in told.items() if key != "modes"}
    return [
        _Question(dithering, b"\xc1", "bytes of no message", ("range", "signature")),
        _Question(
            dithering,
            msgpack.packb({**without, "id": new("missing")}),
            "a dither without the key modes",
            ("missing",),
        ),
        _Question(
            dithering,
            msgpack.packb({**told, "v": 2, "id": new("version")}),
            "a dither of version 2",
            ("v",),
        ),
        _Question(dithering, msgpack.packb(told), f"a dither of mode {n_modes}"),
        _Question(CommandKind.LOOP, gains, "one gain more than modes"),
        _Question(
            CommandKind.MEASURE,
            msgpack.packb(measure),
            f"a measurement of mode {n_modes}",
            optional=True,
        ),
        _Question(CommandKind.RAMP, msgpack.packb(ramp), "a ramp of modes 1 to 0", optional=True),
        _Question(
            CommandKind.OFFLOAD,
            msgpack.packb(offload),
            "an offload demand of 0 without the key shift_y_subap",
            ("missing", "unsupported"),
            optional=True,
        ),
    ]


def replies(client: RtcClient, status: Status) -> Checked:
    """Send commands that must be refused; one of them twice, with the same id."""
    problems, absent, slowest_s, first = [], [], 0.0, b""
    questions = _questions(client, status)
    for question in questions:
        answer, took_s = client.connection.ask(question.kind, question.payload)
        if answer is None:
            if question.optional and took_s < ANSWER_S / 2:
                absent.append(question.kind.value)
            else:
                problems.append(f"no answer to {question.what}")
            continue
        slowest_s = max(slowest_s, took_s)
        problems += _wrong_reply(answer, question, took_s)
        first = answer if question is questions[3] else first
    again, _ = client.connection.ask(questions[3].kind, questions[3].payload)
    if first and (again is None or decode(Reply, again) != decode(Reply, first)):
        problems.append("the same id got another answer when asked again")
    if problems:
        return wrong("replies", "; ".join(problems))
    found = f"{len(questions) - len(absent)} refusals in their words, within {slowest_s:.2f} s"
    without = f"; it offers no {' and no '.join(absent)}" if absent else ""
    return fine("replies", f"{found}, twice the same for the same id{without}")


def _wrong_reply(answer: bytes, question: _Question, took_s: float) -> list[str]:
    try:
        reply = decode(Reply, answer)
    except WireError as error:
        return [f"the reply to {question.what} cannot be read: {error}"]
    if reply.accepted:
        return [f"{question.what} was accepted"]
    word = reply.reason.partition(":")[0]
    if word not in question.words:
        wanted = " or ".join(question.words)
        return [f"{question.what} was refused with {reply.reason!r:.60}, expected {wanted}: ..."]
    return [f"the reply to {question.what} took {took_s:.1f} s"] if took_s > REPLY_S else []


def signatures(client: RtcClient, status: Status) -> Checked:
    """Send an order that changes nothing: without its signature, with it, again, and changed."""
    connection, kind = client.connection, CommandKind.LOOP
    if not connection.signs:
        return skipped("signatures", "no secret is shared: [zenoh.signing] in --config")
    plain = encode(LoopRequest(id=connection.new_id("signed"), leak=status.leak))
    signed = connection.signed(kind, plain)
    changed = signed[:-1] + bytes([signed[-1] ^ 1])
    problems = []
    for what, payload, expected in (
        ("what is not signed", plain, False),
        ("what was changed on its way", changed, False),
        ("what is signed", signed, True),
        ("what was sent before", signed, False),
    ):
        answer, _ = connection.ask(kind, payload, as_it_is=True)
        reply = None if answer is None else decode(Reply, answer)
        if reply is None:
            problems.append(f"no answer to {what}")
        elif reply.accepted is not expected:
            problems.append(f"{what} was {'accepted' if reply.accepted else reply.reason}")
        elif not expected and not reply.reason.startswith("signature"):
            found = f"{what} was refused with {reply.reason!r:.60}"
            problems.append(f"{found}, expected signature: ...")
    if problems:
        return wrong("signatures", "; ".join(problems))
    return fine("signatures", "refused: not signed, changed on its way, sent before")


# --- the dither


class _Ledger:
    """The dither in the frames, summed block by block."""

    def __init__(
        self, asked: ExpectedDither, matrix: NDArray[np.float32] | None, in_loop: list[int]
    ) -> None:
        self.first_seq: int | None = None
        self.last_seq = -1
        self.next_seq = 0
        self.findings: list[DitherMeasurement] = []
        self.seq: list[NDArray[np.int64]] = []
        self.seen_m: list[NDArray[np.float64]] = []
        self.moved_m: list[NDArray[np.float64]] = []
        self._meter, self._matrix, self._in_loop = DitherMonitor(asked=asked), matrix, in_loop
        self._span = asked.first_seq, asked.stop_seq

    def take(self, block: FrameBlock) -> None:
        """Take frames."""
        self.next_seq = block.next_seq
        if block.dither_m is not None:
            rows = np.flatnonzero(block.dither_m.any(axis=1))
            if len(rows):
                self.last_seq = block.first_seq + int(rows[-1])
                if self.first_seq is None:
                    self.first_seq = block.first_seq + int(rows[0])
        self._meter, found = measure_block(self._meter, block)
        self.findings += [] if found is None else [found]
        first, stop = self._span
        if self._matrix is None or block.first_seq < first or block.next_seq > stop:
            return
        self.seq.append(np.arange(block.first_seq, block.next_seq))
        modes = self._in_loop
        self.seen_m.append(np.asarray(block.slopes @ self._matrix[modes].T, dtype=float))
        self.moved_m.append(np.asarray(block.commands_m[:, modes], dtype=float))


def dither(
    client: RtcClient, status: Status, matrix: NDArray[np.float32] | None, most_m: float = TOTAL_M
) -> list[Checked]:
    """Have a small dither played and stopped, and say what the frames held of it."""
    if status.dither is not None:
        why = f"{status.dither_id} plays: stop it first"
        return [skipped("dither", why), skipped("columns", why)]
    modes = dithered_modes(status)
    amplitude = min(most_m / np.sqrt(len(modes)), status.max_dither_m)
    request = DitherRequest(
        id=client.connection.new_id("dither"),
        kind=DitherKind.SINE,
        modes=modes,
        amplitude_m=(float(amplitude),) * len(modes),
        frequency_hz=tuple(line * status.frame_rate_hz for line in LINES[: len(modes)]),
        duration_s=DITHER_S,
    )
    try:
        reply = client.connection.command(request)
    except LinkError as error:
        return [wrong("dither", str(error)), skipped("columns", "there was no dither")]
    if not reply.accepted or reply.start_seq is None:
        found = f"refused: {reply.reason}" if not reply.accepted else "start_seq is nil"
        return [wrong("dither", found), skipped("columns", "there was no dither")]
    try:
        ledger = _listen_to_dither(client, status, request, reply.start_seq, matrix)
    finally:  # also where it is broken off
        ended = stopped(client)
    ordered_seq = ledger.next_seq
    gone = client.listen(
        _STOPS_S,
        lambda: (
            client.watch.status is not None
            and client.watch.status.dither is None
            and ledger.next_seq > ledger.last_seq + 50
        ),
    )
    client.watch.block_takers.remove(ledger.take)
    judged = _judged(client, request, reply.start_seq, ledger)
    if not judged and not (ended.accepted and gone):
        still_s = (ledger.last_seq - ordered_seq) / status.frame_rate_hz
        judged = (
            f"ordered to stop, it went on for {still_s:.1f} s, or its status does: {ended.reason}"
        )
    if judged:
        return [wrong("dither", judged), _columns(ledger, modes, status)]
    found_m = ledger.findings[-1].found_m
    found = (
        f"{1e9 * found_m:.2f} nm RMS on modes {', '.join(map(str, modes))} from frame "
        f"{reply.start_seq} as asked for, stopped at {ledger.last_seq}"
    )
    return [fine("dither", found), _columns(ledger, modes, status)]


def stopped(client: RtcClient) -> Reply:
    """Stop the dither; return the reply, if there is one."""
    try:
        return client.connection.command(DitherStop(id=client.connection.new_id("stop")))
    except LinkError as error:
        return Reply(id=None, accepted=False, reason=str(error), start_seq=None)


def dithered_modes(status: Status) -> tuple[int, ...]:
    """Return two modes of the loop and one outside it, as far as there are any."""
    in_loop = status.in_loop
    chosen = [in_loop[min(8, len(in_loop) // 4)], in_loop[len(in_loop) // 3]] if in_loop else []
    if status.n_controlled < status.n_modes or not in_loop:
        chosen.append(status.n_controlled + (status.n_modes - status.n_controlled) // 4)
    most = max(status.max_dither_modes, 1)
    return tuple(dict.fromkeys(min(mode, status.n_modes - 1) for mode in chosen))[:most]


def _listen_to_dither(
    client: RtcClient,
    status: Status,
    request: DitherRequest,
    start_seq: int,
    matrix: NDArray[np.float32] | None,
) -> _Ledger:
    """Listen to a dither that has been accepted."""
    rate_hz = status.frame_rate_hz
    stop_seq = start_seq + round(PLAYED_S * rate_hz)
    own = tuple(mode not in status.in_loop for mode in request.modes)
    asked = ExpectedDither(
        modes=request.modes,
        amplitude_m=request.amplitude_m,
        frequency_hz=request.frequency_hz or (),
        frame_rate_hz=rate_hz,
        first_seq=start_seq,
        stop_seq=stop_seq,
        own=own,
    )
    in_loop = [mode for mode, outside in zip(request.modes, own, strict=True) if not outside]
    ledger = _Ledger(asked, matrix, in_loop)
    client.watch.block_takers.append(ledger.take)
    client.listen(2.0 * PLAYED_S, lambda: ledger.next_seq >= stop_seq)
    return ledger


def _judged(client: RtcClient, request: DitherRequest, start_seq: int, ledger: _Ledger) -> str:
    """Return how the dither differs from the request; empty: it does not."""
    if ledger.first_seq is None:
        return f"accepted from frame {start_seq}, and the frames hold none of it"
    late = ledger.first_seq - start_seq
    if late not in {0, 1}:  # the first value of a sine is 0
        return f"it begins at frame {ledger.first_seq}, {late} after the one announced"
    texts = [finding.text for finding in ledger.findings if finding.text]
    if texts:
        return texts[0]
    if not ledger.findings:
        return "less than a second of it has come"
    told = [status.dither for _, status in client.watch.statuses if status.dither_id == request.id]
    if not told or told[0] is None:
        return "no status shows it"
    if told[0].start_seq != start_seq or told[0].request != request:
        return "the status shows it otherwise than asked for"
    return ""


def _columns(ledger: _Ledger, modes: tuple[int, ...], status: Status) -> Checked:
    """Say how far slopes and commands of a row are apart, from two lines in the loop."""
    n_lines = ledger.seen_m[0].shape[1] if ledger.seen_m else 0
    if n_lines < 2 or ledger.first_seq is None:
        return skipped("columns", "it takes a dither on two modes of the loop and its matrix")
    seq = np.concatenate(ledger.seq)
    turns = 2 * np.pi * np.array(LINES[: len(modes)])[[mode in status.in_loop for mode in modes]]
    answer, noise = _transfer(
        seq, np.concatenate(ledger.seen_m), np.concatenate(ledger.moved_m), turns
    )
    if (np.abs(answer) + noise < SILENT).all():
        return wrong("columns", "no slope answers what the commands hold: the mirror stands still")
    if (noise > NOISY * np.abs(answer)).any():
        return skipped("columns", f"too noisy: {np.max(noise / np.abs(answer)):.2f} of the answer")
    unit, weight = answer / np.abs(answer), np.abs(answer) / np.maximum(noise, 1e-9)
    models = np.exp(-1j * np.outer(LAGS, turns))
    misfit = np.stack([np.abs(unit - sign * models) ** 2 @ weight**2 for sign in (1.0, -1.0)])
    k_sign, k_lag = np.unravel_index(int(np.argmin(misfit)), misfit.shape)
    lag, sigma = float(LAGS[k_lag]), float(1.0 / np.sqrt(np.sum((weight * turns) ** 2)))
    share = float(np.median(np.abs(answer)))
    if k_sign:
        return wrong("columns", "slopes times matrix have the other sign than the commands")
    found = f"slopes lag {lag:+.2f} frames behind the commands of their row"
    if abs(lag) > MOST_LAG + 3.0 * sigma:
        return wrong("columns", found)
    found += f", and answer {share:.2f} of them by the matrix in use"
    return (fine if 0.1 < share < 3.0 else seen)("columns", found)


def _transfer(
    seq: NDArray[np.int64],
    seen_m: NDArray[np.float64],
    moved_m: NDArray[np.float64],
    turns: NDArray[np.float64],
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Return ``(n_lines,)`` answer over command at the lines, and its noise."""
    window = np.hanning(len(seq))
    bin_rad = 2 * np.pi / max(int(seq[-1] - seq[0]), 1)

    def at(columns: NDArray[np.float64], shift: float) -> NDArray[np.complex128]:
        phasors = np.exp(-1j * np.outer(seq, turns + shift * bin_rad)) * window[:, None]
        return np.asarray(np.sum(phasors * (columns - columns.mean(axis=0)), axis=0))

    moved = at(moved_m, 0.0)
    sides = np.stack([at(seen_m - moved_m, shift) for shift in _SIDES])
    noise = np.sqrt(np.mean(np.abs(sides) ** 2, axis=0)) / np.abs(moved)
    return at(seen_m, 0.0) / moved, noise
