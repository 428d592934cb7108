"""Telemetry into the service while it computes: what is lost, and how late it comes.

``python -m benchmarks.ingest [--seconds 60] [--rate 1000] [--batch 1] [--json FILE]``

Three processes, as in the field: a sender that puts full-size frames at the frame rate, the
service's own link, and a nice'd worker that linearises the optical model without pause.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import socket
import time
from dataclasses import asdict, dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path

import numpy as np

from benchmarks.ingest_processes import Sending, compute_without_pause, send_frames
from service.rtc_bridge import Bridge, Endpoint

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
    cpus: int | None


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
    endpoint = Endpoint(system="benchmark", listen=(f"tcp/127.0.0.1:{_free_port()}",))
    sending = Sending(
        endpoint=endpoint.listen[0],
        system=endpoint.system,
        frame_rate_hz=arguments.rate,
        frames_per_message=arguments.batch,
        seconds=arguments.seconds,
        n_slopes=arguments.n_slopes,
        n_modes=arguments.n_modes,
    )
    spawn = multiprocessing.get_context("spawn")
    stop, n_fits, n_sent = spawn.Event(), spawn.Value("q", 0), spawn.Value("q", 0)
    worker = spawn.Process(target=compute_without_pause, args=(stop, n_fits), daemon=True)
    sender = spawn.Process(target=send_frames, args=(sending, n_sent), daemon=True)
    worker.start()
    _wait_until_positive(n_fits)
    with Bridge(endpoint) as bridge:
        consumer = Consumer(bridge)
        bridge.set_wakeup(consumer.on_wakeup)
        fits_before = n_fits.value
        sender.start()
        sender.join(arguments.seconds + START_TIMEOUT_S)
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
        cpus=os.cpu_count(),
    )


def _wait_until_positive(counter: Synchronized[int]) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while counter.value == 0:
        if time.monotonic() > deadline:
            raise SystemExit(f"the worker finished nothing within {START_TIMEOUT_S:.0f} s")
        time.sleep(0.1)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _report(result: Result) -> str:
    return (
        f"{result.frames_sent} frames of {result.bytes_per_frame} bytes sent at "
        f"{result.frame_rate_hz:g} Hz, {result.frames_per_message} per message\n"
        f"{result.frames_received} received, {result.frames_lost} lost, "
        f"{result.frames_overwritten} overwritten, "
        f"while {result.fits_computed} linearisations were computed\n"
        f"put to consumer: p50 {1e3 * result.latency_p50_s:.2f} ms, "
        f"p99 {1e3 * result.latency_p99_s:.2f} ms, max {1e3 * result.latency_max_s:.1f} ms"
    )


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ingest", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=1000.0, help="frames per second")
    parser.add_argument("--batch", type=int, default=1, help="frames per message, 1 to 50")
    parser.add_argument("--n-slopes", type=int, default=1408)
    parser.add_argument("--n-modes", type=int, default=594)
    parser.add_argument("--json", type=Path, metavar="FILE")
    return parser.parse_args()


if __name__ == "__main__":
    main()
