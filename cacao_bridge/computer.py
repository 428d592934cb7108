"""cacao's loop as an RTC of the contract."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import replace
from typing import Final

import numpy as np
import structlog
from numpy.typing import NDArray

from cacao_bridge.calibration import Calibration
from cacao_bridge.dither import Mirror, Player, check_request
from cacao_bridge.rows import LEAST_KEPT, Rows
from cacao_bridge.settings import OF_THE_SUM, Settings
from cacao_bridge.streams import GoneError, Stream, StreamError, path_of, read_settled
from pyrcal.rtc.identity import Identity, Reconstructor, new_session
from pyrcal.rtc.replies import FinishedMeasurement
from pyrcal.rtc.staging import Terms
from service.wire import (
    Command,
    DitherRequest,
    DitherStatus,
    DitherStop,
    FrameHeader,
    Loop,
    LoopRequest,
    Reply,
    Status,
    checksum,
)
from service.wire.codec import TEXT_LIMIT

Array32 = NDArray[np.float32]
_log = structlog.get_logger("cacao")

_PAUSE_S: Final = 0.02
"""Pause between two reads of long rings: 50 messages a second."""

_STANDS_S: Final = 1.0
"""Time without a frame after which a counter is reported as stopped."""

_RATE_S: Final = 4.0
_RATE_TOLERANCE: Final = 0.1
_CLOCK_SHARE: Final = 0.02
_CLOCK_STEP_NS: Final = 100_000_000
_LEAD_S: Final = 0.1
"""Time between the acceptance of a dither and its first frame: the reply must arrive before it."""

_LEAK_SPREAD: Final = 0.004


class Cacao:
    """The loop: ``poll`` is for one thread, everything else for any."""

    def __init__(self, settings: Settings) -> None:
        """Raise ``ConfigurationError`` if a file of the settings is not what it should be."""
        wire, self._loop, self._names = settings.wire, settings.loop, settings.streams
        self.identity = Identity(
            system=wire.system, basis_id=wire.basis_id, config_id=wire.config_id
        )
        self._calibration = Calibration(settings, self.identity)
        n_slopes = len(self._calibration.index)
        self._whole = np.array_equal(self._calibration.index, np.arange(n_slopes))
        """True if all values of a frame are slopes."""
        self._projection = np.linalg.pinv(
            self._calibration.dm_modes.reshape(self._loop.n_modes, -1).astype(np.float64)
        ).astype(np.float32)
        self._rows = Rows(
            self._loop.n_slopes,
            self._loop.n_modes,
            self._loop.delay_frames,
            dither=bool(self._names.dither),
            kept=max(LEAST_KEPT, round(self._loop.frame_rate_hz)),  # a second: it may stand still
        )
        self._lock = threading.Lock()
        self._swaps: deque[tuple[str, int]] = deque(maxlen=16)
        self._played: deque[tuple[int, int, Array32]] = deque(maxlen=100_000)
        self._player: Player | None = None
        self._law: tuple[tuple[float, ...], float] | None = None
        self._law_trouble = ""
        self._n_next: int | None = None
        self._streams: dict[str, Stream] = {}
        self.complaint = ""
        """Problem with the streams, for people; empty if there is none."""
        self.n_lost = 0
        """Frames of slopes that were overwritten before they were read."""
        self._unlink()

    def _unlink(self) -> None:
        """Close the streams: another session follows."""
        self._streams, self.session = {}, new_session()
        self._stop_dither()
        self._rows.forget()
        self._played.clear()
        self._slopes_at: int | None = None
        self._commands_at: int | None = None
        self._moves = False
        """True if the newest command is not zero."""
        self._offset: int | None = self._loop.counter_offset
        self._moved_s = {"slopes": time.monotonic(), "commands": time.monotonic()}
        self._clock: tuple[int, int] | None = None
        self._rate_from: tuple[int, float] | None = None
        self._reference_at: int | None = None

    @property
    def unlinked(self) -> bool:
        """Return True if there are no streams to read."""
        return not self._streams

    @property
    def n_unpaired(self) -> int:
        """Number of frames of slopes whose command is unknown."""
        return self._rows.n_unpaired

    @property
    def pause_s(self) -> float:
        """Longest sleep between two reads that loses no frame, seconds."""
        streams = [self._streams.get(name) for name in ("slopes", "commands")]
        n_kept = min((stream.n_kept for stream in streams if stream is not None), default=64)
        # A quarter of the ring leaves time for a late wake-up; without a ring, four looks a frame.
        return min(max(n_kept / 4, 0.25) / self._loop.frame_rate_hz, _PAUSE_S)

    def poll(self) -> list[tuple[FrameHeader, Array32]]:
        """Return new rows, ready to send; a complaint is in :attr:`complaint`."""
        try:
            self._link()
            self._read_slopes()
            self._read_reference()
            self._read_commands()
            self._look_after_matrices()
            self._complain(self._check_counters() or self._off_rate() or self._law_trouble)
        except (StreamError, OSError) as error:
            self._complain(str(error))
            self._unlink()
            return []
        # take_slopes() sets the dither of new frames to zero, so the played values come after it.
        while self._played and self._played[0][1] <= self._rows.newest:
            self._rows.take_dither(*self._played.popleft())
        player = self._player
        answers_to = player.seen if player is not None and not player.ended.is_set() else None
        return [self._message(seq, rows) for seq, rows in self._rows.ready(answers_to)]

    def _complain(self, text: str) -> None:
        if text != self.complaint:
            self.complaint = text
            _log.warning("streams.wrong" if text else "streams.well", text=text)

    def _open(self, name: str, *, writable: bool = False) -> Stream:
        return Stream(path_of(name, self._names.directory), writable=writable)

    def _link(self) -> None:
        if self._streams:
            return
        slopes, commands = self._open(self._names.slopes), self._open(self._names.commands)
        multiplied = self._open(self._names.multiplied)
        needed = int(self._calibration.index.max()) + 1
        # With an index a frame may hold values that are not slopes; without one it may not.
        if slopes.n_values < needed or (self._whole and slopes.n_values != needed):
            raise StreamError(f"{slopes.name}: found {slopes.n_values} values, expected {needed}")
        n_modes, n_actuators = self._loop.n_modes, self._projection.shape[0]
        modal = self._loop.commands_are == "modes"
        # cacao may control fewer modes than the basis has; an actuator command is always complete.
        fits = commands.n_values <= n_modes if modal else commands.n_values == n_actuators
        if not fits:
            expected = f"at most {n_modes} modes" if modal else f"{n_actuators} actuators"
            found = f"{commands.n_values} values {commands.shape}"
            raise StreamError(f"{commands.name}: found {found}, expected {expected}")
        if self._names.dither:
            # A bridge that was killed may have left a dither in its channel.
            self._channel().write(np.zeros(n_actuators, dtype=np.float32))
        self._streams = {"slopes": slopes, "commands": commands, "multiplied": multiplied}
        if self._names.reference:
            self._streams["reference"] = self._open(self._names.reference)
        self._commands_writer = commands.writer
        for name, stream in self._streams.items():
            _log.info("stream.linked", role=name, name=stream.name, keeps=stream.n_kept)

    def _channel(self) -> Stream:
        """Return the mirror's channel that is the bridge's own."""
        channel, n_actuators = self._open(self._names.dither, writable=True), len(self._projection)
        if channel.n_values != n_actuators:
            found = f"{channel.n_values} values, expected {n_actuators}"
            raise StreamError(f"{channel.name}: found {found}")
        return channel

    def _read_slopes(self) -> None:
        slopes = self._streams["slopes"]
        frames = slopes.after(self._slopes_at)
        if frames is None:
            return
        if frames.n_lost and self._slopes_at is not None:
            self.n_lost += frames.n_lost
            _log.warning("frames.lost", n=frames.n_lost, before=frames.first, keeps=slopes.n_kept)
        self._slopes_at = frames.first + len(frames.values) - 1
        values = frames.values if self._whole else frames.values[:, self._calibration.index]
        values = values * np.float32(self._loop.slope_per_value)
        self._rows.take_slopes(frames.first, values)
        self._moved_s["slopes"] = time.monotonic()
        self._follow_clock(self._slopes_at, slopes.written_ns or time.time_ns())

    def _read_reference(self) -> None:
        """Name the reference by its numbers when another one was written."""
        stream = self._streams.get("reference")
        if stream is None or stream.counter == self._reference_at:
            return
        stream.here()
        # Counted before it is read: one that is written meanwhile is read again.
        is_first, self._reference_at = self._reference_at is None, stream.counter
        name = f"reference-{checksum(stream.latest())[:8]}"
        if name != self.identity.reference_id and not is_first:
            # Which reference some of these frames had is not known.
            self._rows.skip(self._rows.newest)
        self.identity = replace(self.identity, reference_id=name)

    def _read_commands(self) -> None:
        slopes, commands = self._streams["slopes"], self._streams["commands"]
        if commands.writer != self._commands_writer:
            who = f"{self._commands_writer} to {commands.writer}"
            raise GoneError(
                f"{commands.name}: written by another process ({who}): the loop was restarted"
            )
        frames = commands.after(self._commands_at)
        if frames is None:
            return
        self._commands_at = frames.first + len(frames.values) - 1
        self._moved_s["commands"] = time.monotonic()
        moves = np.concatenate([[self._moves], frames.values.any(axis=1)])
        self._moves = bool(moves[-1])
        # All commands exactly zero after some that were not: noise never does that.
        if np.any(moves[:-1] & ~moves[1:]):
            raise GoneError(f"{commands.name}: set to zero (loopZERO): the integrator was reset")
        before = self._offset
        if self._loop.counter_offset is None:
            self._offset = read_settled(lambda: _behind(commands, slopes.inode), before)
        if self._offset is None:
            if _behind(commands, slopes.inode) is None:
                told = f"its trace names no frame of {slopes.name}"
                raise StreamError(f"{commands.name}: {told}; set loop.counter_offset")
            return
        if before != self._offset:
            # Which slopes some of these answer is not known: the first ones, or the loop left
            # slopes out.
            _log.warning("commands.unpaired", n=len(frames.values), before=before, now=self._offset)
            return
        self._rows.take_commands(frames.first + self._offset, self._in_modes(frames.values))

    def _in_modes(self, values: Array32) -> Array32:
        """Return commands ``(n, n_modes)`` of the whole basis, metres."""
        unit = np.float32(self._loop.metre_per_unit)
        if self._loop.commands_are == "actuators":
            return np.asarray(values @ self._projection) * unit
        commands = np.zeros((len(values), self._loop.n_modes), dtype=np.float32)
        commands[:, : values.shape[1]] = values * unit
        return commands

    def _look_after_matrices(self) -> None:
        multiplied, slopes = self._streams["multiplied"], self._streams["slopes"]
        multiplied.here()
        if not multiplied.writer:
            told = "its trace names no process: when a matrix is taken up cannot be seen"
            raise StreamError(f"{multiplied.name}: {told}")
        with self._lock:
            known = self._calibration.in_use is not None
            taken_up = self._calibration.look(multiplied.writer, slopes.shape)
            if taken_up is not None and known:
                found = multiplied.made_by(slopes.inode)
                # Frames around the swap are left out: which matrix multiplied them is not known
                # exactly.
                self._rows.skip(self._rows.newest if found is None else found[1])
                self._swaps.append((taken_up, self._rows.next))

    def _check_counters(self) -> str:
        for name, moved_s in self._moved_s.items():
            stream = self._streams[name]
            if time.monotonic() - moved_s > _STANDS_S:
                why = stream.orphaned or ("" if name == "slopes" else "is the loop on (loopON)?")
                return f"{stream.name}: its counter stays at {stream.counter}; {why}".rstrip("; ")
        return ""

    def _off_rate(self) -> str:
        """Say when frames come at a wrong rate, as from two writers."""
        counter, now_s = self._streams["slopes"].counter, time.monotonic()
        if self._rate_from is None:
            self._rate_from = counter, now_s
        before, since_s = self._rate_from
        if now_s - since_s < _RATE_S:
            # The last result holds until the next measurement: "" would end the complaint.
            return self.complaint if "frames a second" in self.complaint else ""
        self._rate_from = counter, now_s
        rate_hz, expected_hz = (counter - before) / (now_s - since_s), self._loop.frame_rate_hz
        if abs(rate_hz / expected_hz - 1.0) < _RATE_TOLERANCE:
            return ""
        found = f"found {rate_hz:.0f} frames a second, expected {expected_hz:g}"
        return f"{self._names.slopes}: {found}: loop.frame_rate_hz, or two writers?"

    def _follow_clock(self, counter: int, measured_ns: int) -> None:
        """Let time follow the counter; it is corrected slowly, for frames are written late."""
        if self._clock is not None:
            late_ns = measured_ns - self._time_ns(counter)
            # A larger difference is a step of the clock or a gap, and is taken over at once.
            if abs(late_ns) < _CLOCK_STEP_NS:
                measured_ns -= round((1.0 - _CLOCK_SHARE) * late_ns)
        self._clock = counter, measured_ns

    def _time_ns(self, counter: int) -> int:
        at, time_ns = self._clock or (0, 0)
        return time_ns + round((counter - at) * 1e9 / self._loop.frame_rate_hz)

    def _message(self, seq: int, rows: Array32) -> tuple[FrameHeader, Array32]:
        header = FrameHeader(
            session=self.session,
            seq0=seq,
            n=len(rows),
            t0_ns=self._time_ns(seq),
            dt_ns=round(1e9 / self._loop.frame_rate_hz),
            n_slopes=self._loop.n_slopes,
            n_modes=self._loop.n_modes,
            dither=bool(self._names.dither),
            cm_id=self.reconstructor.manifest.id,
            basis_id=self.identity.basis_id,
            config_id=self.identity.config_id,
            reference_id=self.identity.reference_id,
        )
        return header, rows

    @property
    def known(self) -> bool:
        """Return True if the matrix in use is known; before that the bridge is no RTC."""
        return self._calibration.in_use is not None

    @property
    def reconstructor(self) -> Reconstructor:
        """The matrix that multiplies the slopes now."""
        in_use = self._calibration.in_use
        if in_use is None:
            raise StreamError("no matrix is known yet")
        return in_use

    @property
    def largest_matrix_bytes(self) -> int:
        """Bytes of a matrix for all modes."""
        return 4 * self._loop.n_modes * self._loop.n_slopes

    def terms(self) -> Terms:
        """Return what a new reconstructor must fit at present."""
        # A dictionary removes a repeated number and keeps the requested one first.
        rows = {self._n_next: None, len(self.reconstructor.matrix): None}
        return Terms(
            session=self.session,
            identity=self.identity,
            n_slopes=self._loop.n_slopes,
            n_controlled=tuple(n for n in rows if n is not None),
        )

    def stage(self, reconstructor: Reconstructor) -> None:
        """Keep a checked matrix until cacao may have it."""
        try:
            with self._lock:
                self._calibration.stage(reconstructor)
        except OSError as error:
            _log.error("matrix.not-kept", id=reconstructor.manifest.id, reason=str(error))

    @property
    def has_news(self) -> bool:
        """Return True if a swap is not reported yet."""
        return bool(self._swaps)

    def take_swaps(self) -> list[tuple[str, int]]:
        """Return ids and first frames of the matrices taken up since the last call."""
        return [self._swaps.popleft() for _ in range(len(self._swaps))]

    def take_measured(self) -> tuple[FinishedMeasurement, ...]:
        """Return no measurement: cacao measures with its own programs."""
        return ()

    def status(self) -> Status:
        """Return the loop's status."""
        gains, leak = self._gains_and_leak()
        n_controlled = len(self.reconstructor.matrix)
        # cacao's stream may hold gains for modes that the matrix in use does not control.
        gains = (*gains[:n_controlled], *[0.0] * (self._loop.n_modes - n_controlled))
        stands = time.monotonic() - self._moved_s["commands"] > _STANDS_S
        some = [gain > 0.0 for gain in gains[:n_controlled]]
        closed = Loop.CLOSED if all(some) else Loop.PARTIAL
        player = self._player
        return Status(
            session=self.session,
            seq=None if self._rows.next < 1 else self._rows.next - 1,
            t_ns=time.time_ns(),
            loop=Loop.OPEN if stands or not any(some) else closed,
            frame_rate_hz=self._loop.frame_rate_hz,
            delay_frames=self._loop.delay_frames,
            gains=gains,
            leak=leak,
            n_slopes=self._loop.n_slopes,
            n_modes=self._loop.n_modes,
            n_controlled=n_controlled,
            cm_id=self.reconstructor.manifest.id,
            basis_id=self.identity.basis_id,
            config_id=self.identity.config_id,
            reference_id=self.identity.reference_id,
            dither=None if player is None or player.ended.is_set() else player.status,
            max_dither_m=self._loop.max_dither_m if self._names.dither else 0.0,
            max_dither_modes=self._loop.n_modes if self._names.dither else 0,
            magnitude=None,
            trouble=self.complaint[:TEXT_LIMIT] or None,
        )

    def _gains_and_leak(self) -> tuple[tuple[float, ...], float]:
        """Return gains ``(n_modes,)`` and leak in the contract's terms.

        cacao's mult is its leak; by the law in which it holds for the sum it is in the gain, too.
        """
        n_modes, told = self._loop.n_modes, [self._loop.gain, self._loop.leak]
        both = np.tile(np.array(told, dtype=np.float64)[:, None], n_modes)
        try:
            for row, name in zip(both, (self._names.gains, self._names.factors), strict=True):
                if name:
                    values = self._open(name).latest().ravel()[:n_modes]
                    # Modes beyond the stream have no gain.
                    row[:], row[: len(values)] = 0.0, values
        except StreamError as error:
            self._law_trouble = str(error)
            # The last values that could be read, so that a missing stream is not a change of gains.
            return self._law or (tuple(both[0].tolist()), self._loop.leak)
        gains, factors = both
        n_controlled = len(self.reconstructor.matrix)
        # A mode with zero gain is not in the loop, so its leak is left out.
        in_loop = factors[:n_controlled][gains[:n_controlled] > 0]
        leak, self._law_trouble = float(np.median(in_loop)) if len(in_loop) else self._loop.leak, ""
        # The contract has one leak for all modes.
        if len(in_loop) and np.ptp(in_loop) > _LEAK_SPREAD:
            span = f"{in_loop.min():.4f} to {in_loop.max():.4f}"
            self._law_trouble = (
                f"{self._names.factors}: found {span}, expected the same for all modes"
            )
        if self._names.gains and self._loop.law == OF_THE_SUM:
            gains *= factors
        self._law = tuple(np.clip(gains, 0.0, None).tolist()), min(max(leak, 0.0), 1.0)
        return self._law

    def execute(self, command: Command) -> Reply:
        """Carry out a command, or say why not."""
        start_seq: int | None = None
        match command:
            case DitherRequest():
                reason, start_seq = self._start_dither(command)
            case DitherStop():
                reason = ""
                self._stop_dither()
            case LoopRequest():
                reason = self._change_loop(command)
            case _:
                reason = "unsupported: cacao's own programs measure, tune and set references"
        start_seq = None if reason else start_seq
        return Reply(id=command.id, accepted=not reason, reason=reason, start_seq=start_seq)

    def _start_dither(self, request: DitherRequest) -> tuple[str, int | None]:
        loop, slopes = self._loop, self._streams.get("slopes")
        if not self._names.dither:
            return "unsupported: no [streams] dither: the bridge has no channel to play in", None
        if slopes is None:
            return f"busy: {self.complaint}"[:1000], None
        if self._player is not None and not self._player.ended.is_set():
            return f"busy: {self._player.status.request.id} plays", None
        reason = check_request(request, loop.n_modes, loop.frame_rate_hz, loop.max_dither_m)
        if reason:
            return reason, None
        try:
            channel = self._channel()
        except StreamError as error:
            return f"busy: {error}"[:1000], None
        per_metre = self._calibration.dm_modes.reshape(loop.n_modes, -1)
        # The counter is that of slopes, because the telemetry counts frames by slopes.
        start_seq = slopes.counter + round(_LEAD_S * loop.frame_rate_hz) + 1
        mirror = Mirror(
            channel=channel,
            per_metre=per_metre / np.float32(loop.metre_per_unit),
            lead=int(loop.delay_frames),
            frame_rate_hz=loop.frame_rate_hz,
        )
        status = DitherStatus(request=request, start_seq=start_seq)
        self._player = Player(
            mirror, slopes, status, lambda first, last, u: self._played.append((first, last, u))
        )
        self._player.__enter__()
        return "", start_seq

    def _stop_dither(self) -> None:
        player, self._player = self._player, None
        if player is not None:
            player.__exit__()

    def close(self) -> None:
        """End the dither."""
        self._stop_dither()

    def _change_loop(self, request: LoopRequest) -> str:
        status = self.status()
        changed = {
            "loop": request.loop not in {None, status.loop},
            "gains": request.gains not in {None, status.gains},
            "leak": request.leak not in {None, status.leak},
        }
        if any(changed.values()):
            what = ", ".join(name for name, does in changed.items() if does)
            return f"unsupported: {what}: set at cacao, by cacao-fpsctrl or its operators"
        # Accepted, because it takes effect with the next matrix only.
        self._n_next = request.n_controlled or self._n_next
        return ""


def _behind(commands: Stream, inode: int) -> int | None:
    """Return how far the command's counter is behind that of the slopes it answers."""
    found = commands.made_by(inode)
    return None if found is None else found[1] - found[0]
