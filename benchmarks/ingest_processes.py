"""The processes beside the service in ``benchmarks.ingest``: a sender of frames and a worker."""

from __future__ import annotations

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event

import numpy as np
import zenoh
import zenoh.ext
from threadpoolctl import threadpool_limits

from service.config.link_tables import Router
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from service.wire import FrameHeader, Keys, Role, encode_frames
from service.wire.signing import Signatures

CACHE_S = 5.0
HEARTBEAT_MS = 200
WAIT_BEFORE_DROP_US = 20_000
QUEUE_MESSAGES = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class Sending:
    """What the sender is to do."""

    system: str
    frame_rate_hz: float
    frames_per_message: int
    seconds: float
    n_slopes: int
    n_modes: int
    router: Router
    """What is shown and signed on a secured link."""

    @property
    def bytes_per_frame(self) -> int:
        """Slopes, commands and dither, float32."""
        return 4 * (self.n_slopes + 2 * self.n_modes)


def send_frames(
    sending: Sending, n_sent: Synchronized[int], processor_ns: Synchronized[int]
) -> None:
    """Put frames at the frame rate from a real zenoh client; the timestamp is the time of put."""
    key, signatures = Keys(sending.system).frames, Signatures(sending.router.secret, Role.RTC)
    n = sending.frames_per_message
    rows = np.random.default_rng(0).standard_normal(
        (n, sending.bytes_per_frame // 4), dtype=np.float32
    )
    n_messages = round(sending.seconds * sending.frame_rate_hz / n)
    with zenoh.open(_client(sending.router)) as session:
        publisher = zenoh.ext.declare_advanced_publisher(
            session,
            key,
            congestion_control=zenoh.CongestionControl.DROP,
            cache=zenoh.ext.CacheConfig(round(CACHE_S * sending.frame_rate_hz / n)),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(
                heartbeat=HEARTBEAT_MS / 1000, sporadic_heartbeat=None
            ),
        )
        start, began_ns = time.perf_counter(), time.process_time_ns()
        for message in range(n_messages):
            payload, attachment = encode_frames(_header(sending, message * n), rows)
            signed = signatures.sign(key, attachment, payload)
            publisher.put(payload, attachment=signed)
            n_sent.value += n
            behind = time.perf_counter() - start - (message + 1) * n / sending.frame_rate_hz
            time.sleep(max(0.0, -behind))
        processor_ns.value = time.process_time_ns() - began_ns
        time.sleep(2 * HEARTBEAT_MS / 1000)


def compute_without_pause(stop: Event, n_computed: Synchronized[int]) -> None:
    """Linearise the FLAO model at one registration after the other, as the fits do, at nice 10."""
    os.nice(10)
    instrument = load_instrument("flao-lbt")
    with threadpool_limits(limits=1), ThreadPoolExecutor(2) as pool:
        basis = karhunen_loeve_basis(instrument)
        model = InteractionModel(instrument, basis, mapper=pool.map)
        while not stop.is_set():
            model.linearise(Misregistration(shift_x_subap=1e-3 * n_computed.value))
            n_computed.value += 1


def _header(sending: Sending, seq0: int) -> FrameHeader:
    return FrameHeader(
        session="benchmark",
        seq0=seq0,
        n=sending.frames_per_message,
        t0_ns=time.time_ns(),
        dt_ns=round(1e9 / sending.frame_rate_hz),
        n_slopes=sending.n_slopes,
        n_modes=sending.n_modes,
        dither=True,
        cm_id=None,
        basis_id="benchmark",
        config_id="benchmark",
    )


def _client(router: Router) -> zenoh.Config:
    config = zenoh.Config()
    settings: dict[str, object] = {
        "mode": "client",
        "connect/endpoints": [router.endpoint],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/queue/size/data": QUEUE_MESSAGES,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": WAIT_BEFORE_DROP_US,
        **router.security,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config
