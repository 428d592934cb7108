"""Telemetry into the service while it computes: what is lost, and how late it comes.

``python -m benchmarks.ingest [--seconds 60] [--batch 1] [--json FILE]``

Three processes, as in the field: a sender that puts full-size frames at the frame rate, the
service's own link, and a nice'd worker that linearises the optical model without pause.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np
import zenoh
import zenoh.ext
from threadpoolctl import threadpool_limits

from pyrcal_studies.shared import free_port, study_parser
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from service.rtc_bridge import Bridge, Endpoint
from service.wire import FrameHeader, Keys, encode_frames

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
    endpoint: str

    @property
    def bytes_per_frame(self) -> int:
        """Slopes, commands and dither, float32."""
        return 4 * (self.n_slopes + 2 * self.n_modes)


def send_frames(
    sending: Sending, n_sent: Synchronized[int], processor_ns: Synchronized[int]
) -> None:
    """Put frames at the frame rate from a real zenoh client; the timestamp is the time of put."""
    key = Keys(sending.system).frames
    n = sending.frames_per_message
    rows = np.random.default_rng(0).standard_normal(
        (n, sending.bytes_per_frame // 4), dtype=np.float32
    )
    n_messages = round(sending.seconds * sending.frame_rate_hz / n)
    with zenoh.open(_client(sending.endpoint)) as session:
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
            publisher.put(payload, attachment=attachment)
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


def _client(endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    settings: dict[str, object] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/queue/size/data": QUEUE_MESSAGES,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": WAIT_BEFORE_DROP_US,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


SYSTEM = "benchmark"

START_TIMEOUT_S = 60.0
"""For the worker to build its basis and finish a first linearisation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What came of one run."""

    frame_rate_hz: float
    frames_per_message: int
    bytes_per_frame: int
    seconds: float
    frames_sent: int
    frames_received: int
    frames_lost: int
    frames_overwritten: int
    fits_computed: int
    """Linearisations the worker finished meanwhile: the load was there."""

    latency_p50_s: float
    """From put to the frames being in the hands of the consumer, copied out of the ring."""

    latency_p99_s: float
    latency_max_s: float
    link_processor_s: float
    """Processor time of the service's link, all of its threads."""

    sender_processor_s: float


class Consumer:
    """Takes the frames out of the link the moment its bell rings, and notes how old they are."""

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._latency_s: list[float] = []

    def on_wakeup(self) -> None:
        """Drain on zenoh's thread; the sender writes its time of put into the timestamp."""
        blocks = self._bridge.drain()
        now_ns = time.time_ns()
        self._latency_s += [1e-9 * (now_ns - block.t0_ns_utc) for block in blocks]

    def percentiles_s(self) -> tuple[float, float, float]:
        """Return median, 99th percentile and maximum."""
        p50, p99, highest = np.percentile(self._latency_s, [50, 99, 100])
        return float(p50), float(p99), float(highest)


def main() -> None:
    """Run, print, write the JSON; exit with 1 when a frame was lost."""
    arguments = _arguments()
    result = measure(arguments)
    print(_report(result))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(asdict(result), indent=2) + "\n", encoding="utf-8")
    raise SystemExit(1 if result.frames_lost or result.frames_overwritten else 0)


def measure(arguments: argparse.Namespace) -> Result:
    """Return what one run of sender, link and worker gave."""
    listen = f"tcp/127.0.0.1:{free_port()}"
    endpoint = Endpoint(system=SYSTEM, listen=(listen,))
    sending = Sending(
        endpoint=listen,
        system=SYSTEM,
        frame_rate_hz=arguments.rate,
        frames_per_message=arguments.batch,
        seconds=arguments.seconds,
        n_slopes=arguments.n_slopes,
        n_modes=arguments.n_modes,
    )
    spawn = multiprocessing.get_context("spawn")
    stop, n_fits, n_sent = spawn.Event(), spawn.Value("q", 0), spawn.Value("q", 0)
    sender_ns = spawn.Value("q", 0)
    worker = spawn.Process(target=compute_without_pause, args=(stop, n_fits), daemon=True)
    sender = spawn.Process(target=send_frames, args=(sending, n_sent, sender_ns), daemon=True)
    worker.start()
    _wait_until_positive(n_fits)
    with Bridge(endpoint) as bridge:
        consumer = Consumer(bridge)
        bridge.set_wakeup(consumer.on_wakeup)
        fits_before = n_fits.value
        sender.start()
        began_ns = time.process_time_ns()
        sender.join(arguments.seconds + START_TIMEOUT_S)
        link_ns = time.process_time_ns() - began_ns
        fits_computed = n_fits.value - fits_before
        statistics = bridge.statistics()
    stop.set()
    worker.join()
    p50, p99, highest = consumer.percentiles_s()
    return Result(
        frame_rate_hz=arguments.rate,
        frames_per_message=arguments.batch,
        bytes_per_frame=sending.bytes_per_frame,
        seconds=arguments.seconds,
        frames_sent=n_sent.value,
        frames_received=statistics.frames_received,
        frames_lost=n_sent.value - statistics.frames_received,
        frames_overwritten=statistics.frames_overwritten,
        fits_computed=fits_computed,
        latency_p50_s=p50,
        latency_p99_s=p99,
        latency_max_s=highest,
        link_processor_s=1e-9 * link_ns,
        sender_processor_s=1e-9 * sender_ns.value,
    )


def _wait_until_positive(counter: Synchronized[int]) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while counter.value == 0:
        if time.monotonic() > deadline:
            raise SystemExit(f"the worker finished nothing within {START_TIMEOUT_S:.0f} s")
        time.sleep(0.1)


def _report(result: Result) -> str:
    return (
        f"{result.frames_sent} frames of {result.bytes_per_frame} bytes sent at "
        f"{result.frame_rate_hz:g} Hz, {result.frames_per_message} per message\n"
        f"{result.frames_received} received, {result.frames_lost} lost, "
        f"{result.frames_overwritten} overwritten, "
        f"while {result.fits_computed} linearisations were computed\n"
        f"put to consumer: p50 {1e3 * result.latency_p50_s:.2f} ms, "
        f"p99 {1e3 * result.latency_p99_s:.2f} ms, max {1e3 * result.latency_max_s:.1f} ms\n"
        f"processor time: link {result.link_processor_s:.2f} s, "
        f"sender {result.sender_processor_s:.2f} s in {result.seconds:g} s"
    )


def _arguments() -> argparse.Namespace:
    parser = study_parser("benchmarks.ingest", __doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=1000.0, help="frames per second")
    parser.add_argument("--batch", type=int, default=1, help="frames per message, 1 to 50")
    parser.add_argument("--n-slopes", type=int, default=1408)
    parser.add_argument("--n-modes", type=int, default=594)
    parser.add_argument("--json", type=Path, metavar="FILE")
    return parser.parse_args()


if __name__ == "__main__":
    main()
