"""The least an RTC can be, written from the wire contract alone; also runs as a process.

``python fake_rtc.py ENDPOINT SYSTEM SESSION N_SLOPES N_MODES RATE_HZ FRAMES_PER_BATCH`` sends until
it is killed.
"""

import sys
import threading
import time

import numpy as np
import zenoh
import zenoh.ext

from service.errors import WireError
from service.wire import (
    Acknowledgement,
    AckState,
    ChunkAssembler,
    CommandKind,
    Encodings,
    FrameHeader,
    Keys,
    Loop,
    Manifest,
    MeasuredManifest,
    Reply,
    Role,
    Status,
    command_id,
    decode,
    decode_command,
    encode,
    encode_frames,
    split,
)
from service.wire.signing import Signatures
from tests.support.pace import patience
from tests.support.stranger import open_client

T0_NS = 1_800_000_000_000_000_000
DT_NS = 1_000_000


def client_session(endpoint, stamped=True, **more):
    """Open a zenoh client as wire.md asks an RTC to; it waits where a link is slow."""
    patient = {"transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000}
    return open_client(endpoint, **({"timestamping/enabled": stamped} | patient | more))


class FakeRtc:
    """Sends what a test tells it to, stages and applies what it is sent."""

    def __init__(
        self, endpoint, system="bench", session="s1", n_slopes=6, n_modes=4, secret=None, **more
    ):
        self.signatures = Signatures(secret, Role.RTC)
        self.keys = Keys(system)
        self.session = session
        self.n_slopes, self.n_modes = n_slopes, n_modes
        self.basis_id, self.config_id = "kl-1", "mask-1"
        self.cm_id = None
        self.applied = {}
        self.commands = []
        self.silent = 0
        self.held = []
        self.answers = []
        self.waiting = {}
        self.lock = threading.Lock()
        self.zenoh = client_session(endpoint, **more)
        self.frames = zenoh.ext.declare_advanced_publisher(
            self.zenoh,
            self.keys.frames,
            congestion_control=zenoh.CongestionControl.DROP,
            cache=zenoh.ext.CacheConfig(512),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=0.2),
        )
        for key in (self.keys.all_chunks, self.keys.all_commits):
            self.zenoh.declare_subscriber(key, self._on_matrix)
        self.zenoh.declare_queryable(self.keys.applied, self._on_applied_query)
        for kind in CommandKind:
            self.zenoh.declare_queryable(
                self.keys.command(kind), lambda query, kind=kind: self._on_command(kind, query)
            )
        self.token = self.zenoh.liveliness().declare_token(self.keys.alive(Role.RTC))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.zenoh.close()

    def header(self, seq0, n=10, **changes):
        """Describe a batch as this RTC would."""
        values = {
            "session": self.session,
            "seq0": seq0,
            "n": n,
            "t0_ns": T0_NS + seq0 * DT_NS,
            "dt_ns": DT_NS,
            "n_slopes": self.n_slopes,
            "n_modes": self.n_modes,
            "dither": False,
            "cm_id": self.cm_id,
            "basis_id": self.basis_id,
            "config_id": self.config_id,
        }
        return FrameHeader(**(values | changes))

    def rows(self, header):
        """Rows in which every number tells which frame it belongs to."""
        seq = np.arange(header.seq0, header.seq0 + header.n, dtype=np.float32)
        return np.repeat(seq[:, None], header.n_columns, axis=1)

    def send(self, seq0, n=10, rows=None, plain=False, **changes):
        """Send one batch, through the advanced publisher or as a plain put."""
        header = self.header(seq0, n, **changes)
        rows = self.rows(header) if rows is None else rows
        payload, attachment = encode_frames(header, rows)
        attachment = self.signatures.sign(self.keys.frames, attachment, payload)
        self.send_raw(payload, attachment, plain=plain)

    def send_raw(self, payload, attachment, plain=False):
        """Send bytes that need not mean anything."""
        if plain:
            self.zenoh.put(self.keys.frames, payload, attachment=attachment)
        else:
            self.frames.put(payload, attachment=attachment)

    def status(self, seq=0, **changes):
        """Describe the loop."""
        values = {
            "session": self.session,
            "seq": seq,
            "t_ns": T0_NS,
            "loop": Loop.CLOSED,
            "frame_rate_hz": 1000.0,
            "delay_frames": 2.0,
            "gains": (0.4,) * self.n_modes,
            "leak": 0.99,
            "n_slopes": self.n_slopes,
            "n_modes": self.n_modes,
            "n_controlled": 2,
            "cm_id": self.cm_id,
            "basis_id": self.basis_id,
            "config_id": self.config_id,
            "dither": None,
            "max_dither_m": 2e-8,
            "max_dither_modes": 8,
            "magnitude": 8.0,
            "flux": None,
        }
        return Status(**(values | changes))

    def send_status(self, **changes):
        """Send a status message."""
        status = encode(self.status(**changes))
        self.zenoh.put(self.keys.status, self.signatures.sign(self.keys.status, status))

    def send_bytes(self, key, data):
        """Put anything anywhere."""
        self.zenoh.put(key, data)

    def send_measured(self, manifest: MeasuredManifest, matrix):
        """Send a measured interaction matrix, its commit in the middle of its chunks."""
        parts = split(matrix, manifest.layout.chunk_bytes)
        block = zenoh.CongestionControl.BLOCK
        for index, part in enumerate(parts):
            if index == 1:
                data = encode(manifest)
                key = self.keys.measured_commit(manifest.id)
                self.zenoh.put(key, data, congestion_control=block)
            key = self.keys.measured_chunk(manifest.id, index)
            self.zenoh.put(key, part, congestion_control=block)

    def acknowledge(self, matrix_id, sha256, state, reason="", frame_seq=None):
        """Send an acknowledgement."""
        message = Acknowledgement(
            session=self.session,
            id=matrix_id,
            sha256=sha256,
            state=state,
            reason=reason,
            frame_seq=frame_seq,
        )
        self.zenoh.put(
            self.keys.acknowledgement,
            self.signatures.sign(self.keys.acknowledgement, encode(message)),
            encoding=Encodings.ACKNOWLEDGEMENT,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.DATA_HIGH,
        )

    def fetch(self, selector):
        """Return the first reply's bytes, or the text of its error."""
        for reply in self.zenoh.get(selector, timeout=patience(2.0)):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            return reply.err.payload.to_bytes().decode()
        return None

    def fetch_current(self):
        """Come late: ask for the manifest, then for each part."""
        manifest = decode(Manifest, self.fetch(self.keys.current))
        assembler = ChunkAssembler()
        assembler.announce(manifest.layout)
        for index in assembler.missing():
            assembler.add(index, self.fetch(f"{self.keys.matrix(manifest.id)}?chunk={index}"))
        return manifest, assembler.matrix()

    def _on_matrix(self, sample):
        key, data = str(sample.key_expr), sample.payload.to_bytes()
        name, index = self.keys.matrix_id_of(key), self.keys.chunk_index_of(key)
        with self.lock:
            assembler, _ = self.waiting.setdefault(name, [ChunkAssembler(), None])
            if index is not None:
                assembler.add(index, data)
            else:
                self.signatures.check(key, data)
                manifest = decode(Manifest, data)
                assembler.announce(manifest.layout)
                self.waiting[name][1] = manifest
            manifest = self.waiting[name][1]
            if assembler.complete:
                self._apply(manifest, assembler)
                del self.waiting[name]

    def _apply(self, manifest: Manifest, assembler):
        sha256 = manifest.layout.sha256
        try:
            matrix = assembler.matrix()
        except WireError as error:
            self.acknowledge(manifest.id, sha256, AckState.REJECTED, str(error))
            return
        self.acknowledge(manifest.id, sha256, AckState.STAGED)
        self.applied = {"manifest": manifest, "matrix": matrix}
        self.cm_id = manifest.id
        self.acknowledge(manifest.id, sha256, AckState.APPLIED, frame_seq=1234)

    def _on_applied_query(self, query):
        with query:
            if not self.applied:
                query.reply_err(b"no matrix in use")
                return
            manifest, part = self.applied["manifest"], query.parameters.get("chunk")
            data = self.signatures.sign(self.keys.applied, encode(manifest))
            if part is not None:
                data = split(self.applied["matrix"], manifest.layout.chunk_bytes)[int(part)]
            query.reply(query.key_expr, data)

    def _on_command(self, kind, query):
        if self.silent:
            self.silent -= 1
            self.held.append(query)  # the caller waits its whole timeout
            return
        with query:
            if self.answers:
                query.reply(query.key_expr, self.answers.pop(0))
                return
            data = query.payload.to_bytes()
            try:
                self.signatures.check(self.keys.command(kind), data)
                command = decode_command(kind, data)
            except WireError as error:
                reply = Reply(
                    id=command_id(data), accepted=False, reason=str(error), start_seq=None
                )
            else:
                self.commands.append(command)
                reply = Reply(id=command.id, accepted=True, reason="", start_seq=77)
            key = self.keys.command(kind)
            query.reply(key, self.signatures.sign(key, encode(reply)))


def main(endpoint, system, session, n_slopes, n_modes, rate_hz, per_batch):
    """Send frames in real time until killed."""
    rng = np.random.default_rng(1)
    per_batch, period_s = int(per_batch), int(per_batch) / float(rate_hz)
    with FakeRtc(endpoint, system, session, int(n_slopes), int(n_modes)) as rtc:
        rtc.send_status()
        columns = rtc.header(0, dither=True).n_columns
        rows = rng.standard_normal((per_batch, columns)).astype(np.float32)
        due, seq = time.monotonic(), 0
        while True:
            rows[:, 0] = np.arange(seq, seq + per_batch) % 1_000_000
            rtc.send(seq, per_batch, rows, dither=True)
            seq += per_batch
            due += period_s
            time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main(*sys.argv[1:])
