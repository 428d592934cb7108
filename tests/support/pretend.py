"""An RTC in memory, on a clock of its own, that a checker can listen to and talk with.

It keeps the contract; what a test sets in ``twists`` it does otherwise.
"""

import itertools
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from check_rtc.client import RtcClient
from check_rtc.connection import ReceivedMessage, Topic
from check_rtc.watch import TelemetryObserver
from pyrcal.rtc.dither import Dither, check_dither
from pyrcal.rtc.identity import Identity
from pyrcal.rtc.references import ReferenceOffset
from pyrcal.rtc.replies import ReplyCache
from pyrcal.rtc.staging import Staging, Terms
from service.errors import LinkError, WireError
from service.link.session import Endpoint
from service.model.misregistration import Misregistration
from service.wire import (
    Acknowledgement,
    AckState,
    DitherRequest,
    DitherStatus,
    DitherStop,
    FrameHeader,
    Keys,
    Loop,
    LoopRequest,
    Manifest,
    MeasuredManifest,
    MeasureRequest,
    OffloadRequest,
    ReferencesRequest,
    Reply,
    Status,
    checksum,
    command_id,
    decode,
    decode_command,
    encode,
    encode_frames,
    layout_of,
    split,
)
from service.wire.commands import command_kind
from sim_rtc.computer.real_time_computer import loop_refusal

N_SLOPES, N_MODES, N_CONTROLLED, RATE_HZ, BATCH = 60, 24, 16, 1000.0, 50
RESPONSE = 1e6 * np.random.default_rng(1).standard_normal((N_SLOPES, N_MODES))
MATRIX = np.linalg.pinv(RESPONSE[:, :N_CONTROLLED]).astype(np.float32)
ENDPOINT = Endpoint(system="bench")
RECORDED = {}
"""Batches of a loop that nothing has disturbed since its first frame: they are always the same."""


class Pretend:
    """Ear and RTC in one: what it "hears" is what the RTC does while ``sleep`` passes."""

    own_router, other_service = True, False

    def __init__(self, **twists):
        self.twists, self.keys, self.now_s = twists, Keys("bench"), 1000.0
        # Behind the wall clock, because time passes faster here.
        self.rng, self.t0_ns = np.random.default_rng(3), time.time_ns() - 5 * 10**9
        self.session, self.seq, self.closed = "s-1", 0, True
        self.leak, self.gains = 0.99, np.where(np.arange(N_MODES) < N_CONTROLLED, 0.4, 0.0)
        self.matrix, self.next, self.turbulence = MATRIX, np.zeros((2, N_MODES)), np.zeros(N_MODES)
        self.dither = self.told_dither = None
        self.commands, self.quiet = [], True
        self.heard, self.due, self.offers, self.away = [], [], {}, False
        self.identity = Identity(system="bench", basis_id="kl-1", config_id="mask-1")
        self.references = ReferenceOffset(N_SLOPES)
        self.staging = Staging(self._terms, limit_bytes=10**6)
        self.cache = ReplyCache(self._execute)
        self._ids, self._status_s, self._asked_current = itertools.count(), 0.0, False
        self.manifest = Manifest(
            id="own-1",
            layout=layout_of(MATRIX, 1500),
            alpha=None,
            sigma=None,
            im_id=None,
            parent=None,
            created_ns=7,
            basis_id="kl-1",
            config_id="mask-1",
            system="bench",
        )
        self.image = 0.1
        """Where the mirror's is on the sensor, along x."""
        self._hear(Topic.ALIVE, alive=True)

    def talk(self):
        return RtcClient(
            self, TelemetryObserver(ENDPOINT, lambda: self.now_s), lambda: self.now_s, self.sleep
        )

    # --- the ear

    def take(self):
        taken, self.heard = self.heard, []
        return taken

    def new_id(self, what):
        return f"check-{what}-{next(self._ids)}"

    def command(self, command):
        answer, _ = self.ask(command_kind(command), encode(command))
        if answer is None:
            raise LinkError("no answer from the RTC")
        return decode(Reply, answer)

    has_secret = False

    def ask(self, kind, payload):
        if kind in self.twists.get("no_command", ()):
            return None, 0.01
        try:
            reply = self.cache.handle(decode_command(kind, payload), self.now_s)
        except WireError as error:
            reply = Reply(id=command_id(payload), accepted=False, reason=str(error), start_seq=None)
        reply = self.twists.get("reply", lambda _, reply: reply)(kind, reply)
        return encode(reply), self.twists.get("reply_s", 0.01)

    def fetch_applied(self):
        if "applied" in self.twists:
            raise self.twists["applied"]
        return self.manifest, self.matrix

    def fetch_references(self):
        if "read_back" in self.twists:
            raise self.twists["read_back"]
        in_use = self.references.in_use(self._name(self.references.name) or "mask-1")
        slopes = self.twists.get("denied", 1.0) * in_use.offset
        return replace(in_use, slopes=slopes.tobytes(), sha256=checksum(slopes))

    def _name(self, name):
        return self.twists.get("named", lambda name: name)(name)

    def offer(self, manifest, matrix):
        self.offers[manifest.id] = split(matrix, manifest.layout.chunk_bytes)

    def put_chunk(self, matrix_id, index, data):
        self._carry_out(self.staging.chunk(matrix_id, index, data))

    def put_commit(self, matrix_id, data):
        if self.twists.get("deaf"):
            return
        try:
            manifest = decode(Manifest, data)
        except WireError as error:
            self._say(self.staging.unreadable(str(error)))
            return
        if self.twists.get("takes_anything"):  # it queries the chunks, and checks nothing
            numbers = np.frombuffer(b"".join(self.offers[matrix_id]), "<f4")
            self.manifest, self.matrix = manifest, numbers.reshape(manifest.layout.shape)
            applied = self.staging.answer(manifest, AckState.APPLIED)
            self._say(replace(applied, frame_seq=self.seq))
            return
        self._carry_out(self.staging.commit(manifest, self.now_s))

    def close(self):
        self.away = True

    def open(self):
        self.away = False
        if self.twists.get("new_session_on_return"):
            self.session = "s-returned"

    # --- the RTC

    def sleep(self, seconds):
        """Let time pass."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += BATCH / RATE_HZ
            self._batch()
            if self.now_s - self._status_s >= 0.2:
                self._status_s = self.now_s
                self._hear(Topic.STATUS, encode(self.status()))
            self._carry_out(self.staging.poll(self.now_s))
            late = [item for item in self.due if item[0] <= self.now_s]
            self.due = [item for item in self.due if item[0] > self.now_s]
            for _, act in late:
                act()

    def status(self):
        status = Status(
            session=self.session,
            seq=self.seq - 1 if self.seq else None,
            t_ns=self.t0_ns,
            loop=Loop.CLOSED if self.closed else Loop.OPEN,
            frame_rate_hz=RATE_HZ,
            delay_frames=2.0,
            gains=tuple(self.gains.tolist()),
            leak=self.leak,
            n_slopes=N_SLOPES,
            n_modes=N_MODES,
            n_controlled=N_CONTROLLED,
            cm_id=self.manifest.id,
            basis_id="kl-1",
            config_id="mask-1",
            dither=self.told_dither,
            reference_id=self._name(self.references.name),
            max_dither_m=5e-8,
            max_dither_modes=8,
            magnitude=None,
        )
        return replace(status, **self.twists.get("status", {}))

    def _hear(self, topic, data=b"", attachment=None, key="", **more):
        if not self.away:
            self.heard.append(
                ReceivedMessage(
                    topic=topic,
                    key=key,
                    at_s=self.now_s,
                    data=data,
                    attachment=attachment,
                    recoverable=True,
                    **more,
                )
            )

    def _batch(self):
        slopes = np.zeros((BATCH, N_SLOPES))
        commands, dithers = np.zeros((BATCH, N_MODES)), np.zeros((BATCH, N_MODES))
        if self.dither is not None:
            played = self.dither.commands(self.seq, BATCH)
            dithers += 0.0 if played is None else played
            if self.seq >= self.dither.stop_seq:
                self.dither = self.told_dither = None
        self.quiet = self.quiet and self.dither is None and self.closed
        known = RECORDED.get(self.seq) if self.quiet else None
        if known is not None:
            slopes, commands, self.next, self.turbulence = known
        else:
            self._run(slopes, commands, dithers)
        if self.quiet:
            RECORDED[self.seq] = slopes, commands, self.next, self.turbulence
        offsets = self.references.advance(self.seq, BATCH)
        # The checker's offset is one that the matrix does not see: the loop is as without it.
        slopes = slopes - self.twists.get("subtracted", lambda now: now)(offsets)
        header = FrameHeader(
            session=self.session,
            seq0=self.seq,
            n=BATCH,
            t0_ns=self.t0_ns + self.seq * 10**6,
            dt_ns=10**6,
            n_slopes=N_SLOPES,
            n_modes=N_MODES,
            dither=True,
            cm_id=self.manifest.id,
            basis_id="kl-1",
            config_id="mask-1",
            reference_id=self._name(self.references.name),
        )
        self.seq += BATCH
        rows = np.hstack([slopes, commands, dithers]).astype(np.float32)
        sent = self.twists.get("frames", lambda header, rows: [(header, rows)])(header, rows)
        for header, rows in sent:
            self._hear(Topic.FRAMES, *encode_frames(header, rows))

    def _run(self, slopes, commands, dithers):
        for k in range(BATCH):
            kick = 1e-9 * self.rng.standard_normal(N_MODES)
            self.turbulence = 0.995 * self.turbulence + kick
            commands[k] = self.next[0] + dithers[k]
            slopes[k] = RESPONSE @ (commands[k] + self.turbulence)
            slopes[k] += 1e-3 * self.rng.standard_normal(N_SLOPES)
            after = self.leak * self.next[1]
            n = len(self.matrix)
            after[:n] -= self.gains[:n] * (self.matrix @ slopes[k])
            kept = self.next[1] if self.twists.get("integrator_stays") else np.zeros(N_MODES)
            self.next = np.stack([self.next[1], after if self.closed else kept])

    def _execute(self, command):
        self.commands.append(command)
        match command:
            case DitherStop() if self.twists.get("no_stop_without") and self.dither is None:
                return Reply(id=command.id, accepted=False, reason="busy: none", start_seq=None)
            case DitherStop():
                if not self.twists.get("never_stops"):
                    self.dither = self.told_dither = None
                return Reply(id=command.id, accepted=True, reason="", start_seq=None)
            case DitherRequest():
                return self._start_dither(command)
            case LoopRequest():
                return self._change_loop(command)
            case ReferencesRequest() if not self.twists.get("own_references"):
                return self._change_references(command)
        others = {MeasureRequest: self._measure, OffloadRequest: self._offload}
        if type(command) in others:
            return others[type(command)](command)
        return Reply(id=command.id, accepted=False, reason="unsupported: no", start_seq=None)

    def _start_dither(self, command):
        limits = {"max_amplitude_m": 50e-9, "max_duration_s": 3600.0, "max_modes": 8}
        reason = check_dither(command, n_modes=N_MODES, frame_rate_hz=RATE_HZ, **limits)
        if reason:
            return Reply(id=command.id, accepted=False, reason=reason, start_seq=None)
        start_seq = self.seq + BATCH
        played = replace(command, **self.twists.get("dither", {}))
        self.dither = Dither(
            played,
            start_seq=start_seq,
            n_modes=N_MODES,
            frame_rate_hz=RATE_HZ,
            delay_frames=self.twists.get("late_dither", 0),
        )
        self.told_dither = DitherStatus(request=command, start_seq=start_seq)
        return Reply(id=command.id, accepted=True, reason="", start_seq=start_seq)

    def _change_loop(self, command):
        reason = loop_refusal(command, N_MODES)
        if reason:
            return Reply(id=command.id, accepted=False, reason=reason, start_seq=None)
        if command.loop is Loop.OPEN:
            self._start_over(self.twists.get("session_when_open", "s-open"))
        if command.loop is Loop.CLOSED:
            self.closed = True
            self.session = self.twists.get("session_when_closed", self.session)
        return Reply(id=command.id, accepted=True, reason="", start_seq=self.seq)

    def _offload(self, command):
        if "stage" not in self.twists:
            return Reply(
                id=command.id, accepted=False, reason="unsupported: no stage", start_seq=None
            )
        self.image = self.image + self.twists["stage"] * command.shift_x_subap
        start_seq = self.twists.get("stands", lambda seq: seq + 500)(self.seq)
        return Reply(id=command.id, accepted=True, reason="", start_seq=start_seq)

    def _change_references(self, command):
        reason = self.references.check(command, "mask-1")
        if reason:
            return Reply(id=command.id, accepted=False, reason=reason, start_seq=None)
        command = self.twists.get("references", lambda command, _: command)(command, self)
        self.references.begin(command, self.seq, RATE_HZ)
        return Reply(id=command.id, accepted=True, reason="", start_seq=self.seq)

    def fit_registration(self, _window, _loop):
        """What somebody who knows the optics makes of a window; a window is of some second."""
        return SimpleNamespace(
            alpha=Misregistration(shift_x_subap=self.image), covariance=1e-6 * np.eye(4)
        )

    def _start_over(self, session):
        self.closed, self.session = False, session
        if not self.twists.get("integrator_stays"):
            self.next = np.zeros((2, N_MODES))

    def _measure(self, command):
        if max(command.modes) >= N_MODES:
            reason = f"range: mode {max(command.modes)}"
            return Reply(id=command.id, accepted=False, reason=reason, start_seq=None)
        self._start_over("s-measuring")
        matrix = self.twists.get("measured", 1.0) * RESPONSE[:, list(command.modes)]
        matrix += self.twists.get("noise", 0.0) * self.rng.standard_normal(matrix.shape)
        self.due.append((self.now_s + 1.0, lambda: self._send(command, matrix.astype("<f4"))))
        return Reply(id=command.id, accepted=True, reason="", start_seq=self.seq)

    def _send(self, command, matrix):
        manifest = MeasuredManifest(
            id=command.id,
            layout=layout_of(matrix, 300),
            reason=None,
            modes=command.modes,
            amplitude_m=command.amplitude_m,
            n_average=1,
            pattern=command.pattern,
            double_pass=False,
            session=self.session,
            basis_id="kl-1",
            config_id="mask-1",
            system="bench",
            created_ns=7,
        )
        for index, part in enumerate(split(matrix, 300)):
            key = self.keys.measured_chunk(command.id, index)
            self._hear(Topic.MEASURED, part, key=key)
        key = self.keys.measured_commit(command.id)
        self._hear(Topic.MEASURED, encode(manifest), key=key)
        self.closed = not self.twists.get("stays_open")

    def _terms(self):
        return Terms(
            session=self.session,
            identity=self.identity,
            n_slopes=N_SLOPES,
            n_controlled=(N_CONTROLLED,),
        )

    def _carry_out(self, outcome):
        for said in outcome.acknowledgements:
            self._say(said)
        for staged in outcome.staged:
            due_s = self.now_s + self.twists.get("swap_s", 0.05)
            self.due.append((due_s, lambda staged=staged: self._swap(staged)))
        for matrix_id, missing in outcome.missing:
            for index in missing:
                self._hear(Topic.QUERY, key=f"{self.keys.matrix(matrix_id)}?chunk={index}")
                self.put_chunk(matrix_id, index, self.offers[matrix_id][index])

    def _swap(self, staged):
        self.manifest, self.matrix = staged.manifest, staged.matrix
        frame_seq = self.seq + self.twists.get("frame_off", 0)
        self._say(self.staging.applied(staged.manifest.id, frame_seq))

    def _say(self, acknowledgement: Acknowledgement):
        if self.twists.get("mute") or acknowledgement.state in self.twists.get("silent_about", ()):
            return
        self._hear(Topic.ACK, encode(acknowledgement))
