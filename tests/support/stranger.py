"""An RTC that nobody here made: written from the wire contract alone, with msgpack and zenoh.

It closes a small linear loop in real time and knows none of the service's classes. Whatever it
sends can be twisted by a test on its way out: ``on_frames``, ``on_status``, ``on_ack`` and
``on_command`` take a message as plain numbers and return what is sent instead, or None to say
nothing. What its loop truly does (``leak``, ``gains``, the matrix ``response``) is changed apart
from what it tells (``told``).
"""

import functools
import hashlib
import json
import threading
import time
from pathlib import Path

import msgpack
import numpy as np
import zenoh
import zenoh.ext

BLOCK = zenoh.CongestionControl.BLOCK
INSTRUMENT = Path(__file__).parents[1] / "system" / "small.toml"


def open_client(endpoint, **more):
    """Open a zenoh client as the contract asks an RTC to."""
    config = zenoh.Config()
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/retry": {
            "period_init_ms": 200,
            "period_increase_factor": 1.5,
            "period_max_ms": 1000,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "timestamping/enabled": True,
        "transport/link/tx/lease": 2000,
        "transport/shared_memory/enabled": False,
    }
    for key, value in (settings | more).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@functools.cache
def small_telescope(shift_x_subap=0.0, shift_y_subap=0.0, rotation_deg=0.0, magnification=1.0):
    """Return D(α) of the small telescope ``(n_slopes, n_modes)`` and its turbulence's variance.

    Numbers only, from the service's own optics: this is for what goes wrong on the wire, and no
    accuracy is claimed on it.
    """
    from service.instrument import load_instrument
    from service.model.interaction import RtcInteractionModel
    from service.model.misregistration import Misregistration
    from service.model.modes import modal_basis

    instrument = load_instrument(str(INSTRUMENT))
    basis = modal_basis(instrument)
    model = RtcInteractionModel(instrument, basis, pupil_sampling=3, detector_nodes=3)
    alpha = Misregistration(
        shift_x_subap=shift_x_subap,
        shift_y_subap=shift_y_subap,
        rotation_rad=np.deg2rad(rotation_deg),
        magnification=magnification,
    )
    return np.array(model.interaction_matrix(alpha), dtype=np.float64), np.array(basis.variance_m2)


class Stranger:
    """An RTC with a loop of its own, in a thread; a context manager.

    ``response`` ``(n_slopes, n_modes)`` is what its sensor makes of its mirror, in its own order
    and sign of the slopes; ``assumed`` is the matrix its first reconstructor inverts.
    """

    def __init__(
        self,
        endpoint,
        response,
        variance_m2,
        *,
        assumed=None,
        system="small",
        n_controlled=45,
        rate_hz=500.0,
        per_batch=10,
        gain=0.4,
        leak=0.99,
        slope_noise=2e-3,
        coherence_s=1.0,
        seed=1,
    ):
        self.response = np.array(response)
        self.n_slopes, self.n_modes = self.response.shape
        self.rate_hz, self.per_batch = rate_hz, per_batch
        self.gains = np.where(np.arange(self.n_modes) < n_controlled, gain, 0.0)
        self.leak, self.n_controlled = leak, n_controlled
        self.slope_noise = slope_noise
        self.sigma_m = np.sqrt(np.array(variance_m2))
        self.memory = np.exp(-1.0 / (coherence_s * rate_hz))
        self.rng = np.random.default_rng(seed)
        self.session, self.closed = "stranger-1", True
        self.basis_id, self.config_id = "kl-1", "mask-1"
        assumed = self.response if assumed is None else np.array(assumed)
        self.matrix = np.linalg.pinv(assumed[:, :n_controlled])
        self.cm_id = "cm-of-the-stranger"
        self.max_dither_m = 60e-9

        self.told = {}
        """What the status says instead of the truth."""
        self.status_hz = 5.0
        self.on_frames = self.on_status = self.on_ack = self.on_command = None
        self.commands, self.acks, self.applied, self.residuals = [], [], [], []
        """Requests heard, acknowledgements sent, ids applied, (monotonic s, residual RMS in m)."""

        self.seq, self.start_ns = 0, time.time_ns()
        self.dither = None
        self._turbulence = self.sigma_m * self.rng.standard_normal(self.n_modes)
        self._integrator = np.zeros(self.n_modes)
        self._next = np.zeros(self.n_modes)
        self._parts, self._lock = {}, threading.Lock()
        self._stopped = threading.Event()

        self.root = f"ao/v1/{system}"
        self.zenoh = open_client(endpoint)
        self._frames = zenoh.ext.declare_advanced_publisher(
            self.zenoh,
            f"{self.root}/tel/frames",
            congestion_control=zenoh.CongestionControl.DROP,
            cache=zenoh.ext.CacheConfig(int(np.ceil(5 * rate_hz / per_batch))),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=0.2),
        )
        self._kept = [
            self.zenoh.declare_subscriber(f"{self.root}/cm/*/chunk/*", self._on_chunk),
            self.zenoh.declare_subscriber(f"{self.root}/cm/*/commit", self._on_commit),
            self.zenoh.declare_queryable(f"{self.root}/rtc/cm/applied", self._on_applied),
            *(
                self.zenoh.declare_queryable(
                    f"{self.root}/cmd/rtc/{kind}", functools.partial(self._on_query, kind)
                )
                for kind in ("dither", "loop", "measure")
            ),
            self.zenoh.liveliness().declare_token(f"{self.root}/alive/rtc"),
        ]
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stopped.set()
        self._thread.join(5.0)
        self.zenoh.close()

    @property
    def worst_m(self):
        """Largest residual RMS of any batch so far, in metres."""
        return max((value for _, value in self.residuals), default=0.0)

    def t_ns(self, seq):
        """Return the end of a frame's exposure, as its time stamp says."""
        return self.start_ns + round(seq * 1e9 / self.rate_hz)

    def restart(self, session):
        """Begin a new session: the sequence and the integrator start over."""
        with self._lock:
            self.session, self.seq, self.start_ns = session, 0, time.time_ns()
            self._integrator[:] = 0.0
            self._next[:] = 0.0
            self.dither = None

    def header(self, seq0, n):
        """Return the attachment of a batch."""
        return {
            "v": 1,
            "session": self.session,
            "seq0": seq0,
            "n": n,
            "t0_ns": self.t_ns(seq0),
            "dt_ns": round(1e9 / self.rate_hz),
            "n_slopes": self.n_slopes,
            "n_modes": self.n_modes,
            "dither": True,
            "cm_id": self.cm_id,
            "basis_id": self.basis_id,
            "config_id": self.config_id,
        }

    def status(self):
        """Return the status message, told otherwise where a test wants it."""
        truth = {
            "v": 1,
            "session": self.session,
            "seq": self.seq - 1 if self.seq else None,
            "t_ns": self.t_ns(max(self.seq - 1, 0)),
            "loop": "closed" if self.closed else "open",
            "frame_rate_hz": self.rate_hz,
            "delay_frames": 2.0,
            "gains": self.gains.tolist(),
            "leak": self.leak,
            "n_slopes": self.n_slopes,
            "n_modes": self.n_modes,
            "n_controlled": self.n_controlled,
            "cm_id": self.cm_id,
            "basis_id": self.basis_id,
            "config_id": self.config_id,
            "dither": self.dither,
            "max_dither_m": self.max_dither_m,
            "max_dither_modes": 8,
            "magnitude": 8.0,
            "flux": None,
        }
        return truth | self.told

    def put(self, key, data, **options):
        """Send bytes below the system's root."""
        self.zenoh.put(f"{self.root}/{key}", data, **options)

    def send_frames(self, header, slopes, commands, dither):
        """Send one batch as it is."""
        rows = np.concatenate([slopes, commands, *([dither] if header["dither"] else [])], axis=1)
        self._frames.put(
            np.ascontiguousarray(rows, dtype="<f4").tobytes(), attachment=msgpack.packb(header)
        )

    def send_status(self):
        """Send one status message."""
        status = self.status()
        status = self.on_status(status) if self.on_status else status
        if status is not None:
            self.put("tel/status", msgpack.packb(status))

    def _run(self):
        began, batches, last_status = time.monotonic(), 0, 0.0
        while not self._stopped.is_set():
            with self._lock:
                batch = self._advance()
            batch = self.on_frames(*batch) if self.on_frames else batch
            if batch is not None:
                self.send_frames(*batch)
            now = time.monotonic()
            if now - last_status >= 1.0 / self.status_hz:
                last_status = now
                self.send_status()
            batches += 1
            due = began + batches * self.per_batch / self.rate_hz
            time.sleep(max(0.0, due - time.monotonic()))

    def _advance(self):
        """Return the next batch: s_k = D (c_k + turbulence) + noise, loop delay two frames."""
        n, seq0 = self.per_batch, self.seq
        slopes = np.empty((n, self.n_slopes))
        commands, dithers = np.empty((n, self.n_modes)), np.zeros((n, self.n_modes))
        kick = np.sqrt(1.0 - self.memory**2) * self.sigma_m
        for k in range(n):
            self._turbulence *= self.memory
            self._turbulence += kick * self.rng.standard_normal(self.n_modes)
            dithers[k] = self._dither_at(seq0 + k)
            commands[k] = self._integrator + dithers[k]
            seen = commands[k] + self._turbulence
            slopes[k] = self.response @ seen
            slopes[k] += self.slope_noise * self.rng.standard_normal(self.n_slopes)
            answer = np.zeros(self.n_modes)
            if self.closed:
                m = len(self.matrix)
                answer = self.leak * self._next
                answer[:m] -= self.gains[:m] * (self.matrix @ slopes[k])
            self._integrator, self._next = self._next, answer
        self.seq += n
        self.residuals.append((time.monotonic(), float(np.sqrt(np.sum(seen**2)))))
        return self.header(seq0, n), slopes, commands, dithers

    def _dither_at(self, seq):
        out, dither = np.zeros(self.n_modes), self.dither
        if dither is None:
            return out
        since = seq - dither["start_seq"]
        if since >= round(dither["duration_s"] * self.rate_hz):
            self.dither = None
            return out
        modes, amplitude = np.array(dither["modes"]), np.array(dither["amplitude_m"])
        if dither["kind"] == "sine":
            phase = 2 * np.pi * np.array(dither["frequency_hz"]) * since / self.rate_hz
            out[modes] = amplitude * np.sqrt(2) * np.sin(phase)
        else:
            signs = np.random.default_rng([dither["seed"] or 0, since])
            out[modes] = amplitude * signs.choice([-1.0, 1.0], len(modes))
        return out

    def _on_query(self, kind, query):
        with query:
            request = msgpack.unpackb(query.payload.to_bytes())
            self.commands.append((kind, request))
            with self._lock:
                reply = self._reply(kind, request)
            if self.on_command:
                reply = self.on_command(kind, request, reply)
            if reply is not None:
                query.reply(query.key_expr, msgpack.packb(reply))

    def _reply(self, kind, request):
        reply = {"v": 1, "id": request["id"], "accepted": True, "reason": "", "start_seq": None}
        if kind == "dither" and request["action"] == "start":
            amplitude = request["amplitude_m"]
            if max(amplitude) > self.max_dither_m:
                reason = f"range: at most {self.max_dither_m} m"
                return reply | {"accepted": False, "reason": reason}
            self.dither = request | {"start_seq": self.seq + 2 * self.per_batch}
            return reply | {"start_seq": self.dither["start_seq"]}
        if kind == "dither":
            self.dither = None
        if kind == "loop":
            self._set_loop(request)
        if kind == "measure":
            return reply | {"accepted": False, "reason": "unsupported: no measurements here"}
        return reply

    def _set_loop(self, request):
        if request["gains"] is not None:
            self.gains = np.array(request["gains"], dtype=np.float64)
        if request["leak"] is not None:
            self.leak = request["leak"]
        if request["n_controlled"] is not None:
            self.n_controlled = request["n_controlled"]
        if request["loop"] is not None:
            self.closed = request["loop"] == "closed"
            if not self.closed:
                self._integrator, self._next = np.zeros(self.n_modes), np.zeros(self.n_modes)

    def _on_chunk(self, sample):
        words = str(sample.key_expr).split("/")
        parts = self._parts.setdefault(words[-3], {})
        parts[int(words[-1])] = sample.payload.to_bytes()
        self._stage(words[-3])

    def _on_commit(self, sample):
        manifest = msgpack.unpackb(sample.payload.to_bytes())
        self._parts.setdefault(manifest["id"], {})["manifest"] = manifest
        self._stage(manifest["id"])

    def _stage(self, matrix_id):
        parts = self._parts[matrix_id]
        manifest = parts.get("manifest")
        if manifest is None or len(parts) - 1 < manifest["n_chunks"]:
            return
        data = b"".join(parts[k] for k in range(manifest["n_chunks"]))
        if hashlib.sha256(data).hexdigest() != manifest["sha256"]:
            self._acknowledge(manifest, "rejected", "checksum")
            return
        self._acknowledge(manifest, "staged")
        matrix = np.frombuffer(data, "<f4").reshape(manifest["shape"])
        with self._lock:
            self.matrix, self.cm_id = matrix.astype(np.float64), matrix_id
            self.applied.append(matrix_id)
            self.gains = np.where(
                np.arange(self.n_modes) < len(matrix),
                np.where(self.gains > 0, self.gains, self.gains[self.gains > 0][-1]),
                0.0,
            )
            self.n_controlled, seq = len(matrix), self.seq
        self._acknowledge(manifest, "applied", frame_seq=seq)

    def _acknowledge(self, manifest, state, reason="", frame_seq=None):
        ack = {
            "v": 1,
            "session": self.session,
            "id": manifest["id"],
            "sha256": manifest["sha256"],
            "state": state,
            "reason": reason,
            "frame_seq": frame_seq,
        }
        ack = self.on_ack(ack) if self.on_ack else ack
        if ack is not None:
            self.acks.append(ack)
            self.put("cm/ack", msgpack.packb(ack), congestion_control=BLOCK)

    def _on_applied(self, query):
        with query:
            data = np.ascontiguousarray(self.matrix, dtype="<f4").tobytes()
            part = query.parameters.get("chunk")
            if part is not None:
                query.reply(query.key_expr, data)
                return
            manifest = {
                "v": 1,
                "id": self.cm_id,
                "shape": list(self.matrix.shape),
                "dtype": "<f4",
                "n_chunks": 1,
                "chunk_bytes": len(data),
                "sha256": hashlib.sha256(data).hexdigest(),
                "alpha": None,
                "sigma": None,
                "im_id": None,
                "parent": None,
                "basis_id": self.basis_id,
                "config_id": self.config_id,
                "system": self.root.rpartition("/")[2],
                "created_ns": self.start_ns,
            }
            query.reply(query.key_expr, msgpack.packb(manifest))
