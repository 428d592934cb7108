"""Bridge from the pyRTC bench to pyrcal: telemetry out, commands and matrices in."""

import math
import threading
import time

import numpy as np

from pyrcal.rtc.dither import Dither, check_dither
from pyrcal.rtc.identity import Identity, Reconstructor, new_session
from pyrcal.rtc.link import STATUS_PERIOD_S, RtcConnection
from pyrcal.rtc.staging import Terms
from service.errors import ConfigurationError, PyrcalError
from service.files.bundle import Place, read_bundle, why_not
from service.wire import (
    DitherRequest,
    DitherStop,
    FrameHeader,
    Loop,
    LoopRequest,
    Reply,
    Status,
    checksum,
)

from .bench import DELAY, RATE_HZ

MAX_DITHER_M, MAX_DITHER_MODES = 60e-9, 8
BATCH, DT_NS = 10, round(1e9 / RATE_HZ)


class Bridge:
    """RTC for pyrcal (``pyrcal.rtc.Computer``) on a bench of pyRTC.

    One thread runs frames. Commands and matrices come in other threads and take effect between two
    batches of frames.
    """

    def __init__(self, bench, system, matrix):
        self.bench, self.lock = bench, threading.Lock()
        basis = checksum(bench.modes.astype(np.float32))[:8]  # OOPAO's modes differ from run to run
        names = {"basis_id": f"kl-{bench.n_modes}-{basis}", "config_id": "pyramid"}
        self.identity, now_ns = Identity(system=system, **names), time.time_ns()
        name = f"own-{checksum(matrix)[:12]}"
        self.reconstructor = Reconstructor.own(name, matrix, self.identity, created_ns=now_ns)
        self.staged, self.swaps, self.dither, self.n_next = None, [], None, len(matrix)
        self.modal_gains, self.reference = np.ones(bench.n_modes), bench.reference
        self.before, self.scheduled = None, None
        self.session, self.seq, self.start_ns = new_session(), 0, time.time_ns()
        bench.use(matrix)

    @property
    def largest_matrix_bytes(self):
        return 4 * self.bench.loop.cm.size

    @property
    def gains(self):
        gains = self.bench.loop.effective_gains.copy()
        gains[len(self.reconstructor.matrix) :] = 0.0
        return tuple(gains.tolist())

    @property
    def reference_id(self):
        return f"reference-{checksum(self.reference)[:8]}"

    def terms(self):
        n_slopes, n_now = self.bench.loop.signal_size, len(self.reconstructor.matrix)
        known = {"session": self.session, "identity": self.identity, "n_slopes": n_slopes}
        return Terms(**known, n_controlled=(n_now, self.n_next))

    def stage(self, reconstructor):
        with self.lock:
            self.staged = reconstructor

    def take_swaps(self):
        swaps, self.swaps = self.swaps, []
        return swaps

    def take_measured(self):
        return []

    def execute(self, command):
        with self.lock:
            reason, start_seq = self._execute(command)
        return Reply(id=command.id, accepted=not reason, reason=reason, start_seq=start_seq)

    def _execute(self, command):
        """Execute a command; return the reason of a refusal, and the first frame of its effect."""
        if isinstance(command, DitherStop):
            self.dither = None
        elif isinstance(command, DitherRequest):
            reason = self._refusal(command)
            start_seq = None if reason else self.seq + DELAY + BATCH
            if not reason:
                self.dither = Dither(
                    command, start_seq=start_seq, n_modes=self.bench.n_modes, frame_rate_hz=RATE_HZ
                )
            return reason, start_seq
        elif isinstance(command, LoopRequest):
            return self._change_loop(command), None
        else:
            return "unsupported: pyRTC measures, tunes and sets references by its own means", None
        return "", None

    def _refusal(self, request):
        if self.dither is not None:
            return f"busy: {self.dither.request.id} plays"
        if request.frequency_hz is None:
            return "unsupported: random signs"
        return check_dither(
            request,
            n_modes=self.bench.n_modes,
            frame_rate_hz=RATE_HZ,
            max_amplitude_m=MAX_DITHER_M,
            max_duration_s=math.inf,
            max_modes=MAX_DITHER_MODES,
        )

    def _change_loop(self, request):
        loop = self.bench.loop
        if request.leak is not None:
            loop.leaky_gain = 1.0 - request.leak
        if request.gains is not None:
            if len(request.gains) != self.bench.n_modes:
                return f"range: {len(request.gains)} gains, expected {self.bench.n_modes}"
            self._set_gains(np.array(request.gains) / loop.gain)
        self.n_next = request.n_controlled or self.n_next
        # Opening the loop zeroes the integrator, which begins a session by the contract.
        if request.loop is Loop.OPEN and loop.running:
            loop.stop()
            self.bench.flatten()
            self.session, self.dither = new_session(), None
        elif request.loop is Loop.CLOSED:
            loop.start()
        return ""

    def _set_gains(self, modal_gains):
        self.modal_gains = modal_gains
        self.bench.loop.set_modal_gains(modal_gains)

    def apply(self, path):
        """Schedule a bundle for the next batch of frames, all of it or nothing; return its id."""
        bundle, takes = read_bundle(path), frozenset({"gain_factor", "reference_slopes"})
        place = Place(
            system=self.identity.system,
            config_id=self.identity.config_id,
            n_slopes=self.bench.loop.signal_size,
            modes=self.bench.modes.T,
            takes=takes,
        )
        reason = why_not(bundle, place)
        if reason:
            raise ConfigurationError(f"{path}: {reason}; nothing was changed")
        matrix, now_ns = bundle.arrays["reconstructor"].astype(np.float32), time.time_ns()
        own = Reconstructor.own(bundle.id, matrix, self.identity, created_ns=now_ns)
        gains = np.ones(self.bench.n_modes)
        if "gain_factor" in bundle.arrays:
            gains[: len(matrix)] = bundle.arrays["gain_factor"][: len(matrix)]
        self.scheduled = {
            "reconstructor": own,
            "modal_gains": gains,
            "reference": bundle.arrays.get("reference_slopes", self.reference),
        }
        return bundle.id

    def roll_back(self):
        """Schedule the calibration before the last bundle for the next batch; return its id."""
        if self.before is None:
            raise ConfigurationError("there is no earlier calibration to return to")
        self.scheduled = self.before
        return self.scheduled["reconstructor"].manifest.id

    def _calibrate(self, scheduled):
        """Use matrix, gains and reference slopes of a calibration, and keep the previous ones."""
        parts = ("reconstructor", "modal_gains", "reference")
        self.before = {name: getattr(self, name) for name in parts}
        self.reconstructor, self.reference = scheduled["reconstructor"], scheduled["reference"]
        self.bench.use(self.reconstructor.matrix)
        self._set_gains(scheduled["modal_gains"])
        if self.reference is not self.before["reference"]:
            self.bench.set_reference(self.reference)
        self.n_next = len(self.reconstructor.matrix)
        self.swaps.append((self.reconstructor.manifest.id, self.seq))

    def status(self):
        loop, n_controlled = self.bench.loop, len(self.reconstructor.matrix)
        return Status(
            session=self.session,
            seq=self.seq - 1 if self.seq else None,
            t_ns=self.time_ns(max(self.seq - 1, 0)),
            loop=Loop.CLOSED if loop.running else Loop.OPEN,
            frame_rate_hz=RATE_HZ,
            delay_frames=DELAY,
            gains=self.gains,
            leak=1.0 - loop.leaky_gain,
            n_slopes=loop.signal_size,
            n_modes=self.bench.n_modes,
            n_controlled=n_controlled,
            cm_id=self.reconstructor.manifest.id,
            basis_id=self.identity.basis_id,
            config_id=self.identity.config_id,
            reference_id=self.reference_id,
            dither=None if self.dither is None else self.dither.status,
            max_dither_m=MAX_DITHER_M,
            max_dither_modes=MAX_DITHER_MODES,
            magnitude=None,
        )

    def time_ns(self, seq):
        """Return the end of a frame's exposure in simulated time, which runs slower than real."""
        return self.start_ns + seq * DT_NS

    def _dither_m(self, first):
        """Return the dither of a batch, ``(BATCH, n_modes)`` metres of OPD."""
        if self.dither is not None and first >= self.dither.stop_seq:
            self.dither = None
        commands = None if self.dither is None else self.dither.commands(first, BATCH)
        return np.zeros((BATCH, self.bench.n_modes)) if commands is None else commands

    def batch(self):
        """Run a batch of frames; return its header and rows. A staged matrix is used from it on."""
        with self.lock:
            if self.staged is not None:
                self.reconstructor, self.staged = self.staged, None
                self.bench.use(self.reconstructor.matrix)
                self.swaps.append((self.reconstructor.manifest.id, self.seq))
            if self.scheduled is not None:
                scheduled, self.scheduled = self.scheduled, None
                self._calibrate(scheduled)
            header = FrameHeader(
                session=self.session,
                seq0=self.seq,
                n=BATCH,
                t0_ns=self.time_ns(self.seq),
                dt_ns=DT_NS,
                n_slopes=self.bench.loop.signal_size,
                n_modes=self.bench.n_modes,
                dither=True,
                cm_id=self.reconstructor.manifest.id,
                basis_id=self.identity.basis_id,
                config_id=self.identity.config_id,
                reference_id=self.reference_id,
            )
            rows = [self.bench.frame(dither_m) for dither_m in self._dither_m(self.seq + DELAY)]
            self.seq += BATCH
        return header, np.array(rows, dtype=np.float32)

    def apply_files(self, folder):
        """Apply ``bundle.h5`` or ``bundle.fits`` in a folder, or roll back for a ``rollback``."""
        for path in (folder / name for name in ("bundle.h5", "bundle.fits", "rollback")):
            if path.exists():
                try:
                    done = self.roll_back() if path.name == "rollback" else self.apply(path)
                    path.replace(path.with_name(f"{path.name}.taken"))
                    print(f"{path.name}: {done}", flush=True)
                except PyrcalError as error:
                    path.replace(path.with_name(f"{path.name}.refused"))
                    print(error, flush=True)

    def run(self, router, n_frames, folder):
        """Run as an RTC of the service at ``router`` for ``n_frames`` frames."""
        connection = RtcConnection(self, router, batches_per_s=RATE_HZ / BATCH)
        with connection.open() as link:
            next_status_s, last_session = 0.0, None
            while self.seq < n_frames:
                self.apply_files(folder)
                link.publish_frames(*self.batch())
                if self.swaps:
                    link.report_matrices()
                if time.monotonic() >= next_status_s or last_session != self.session:
                    last_session = self.session
                    next_status_s = time.monotonic() + STATUS_PERIOD_S
                    link.publish_status(self.status())
