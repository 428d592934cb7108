"""What a second of the simulated telescope costs, linear and diffractive, beside OOPAO's.

One core. A step is a frame of the closed loop: atmosphere, mirror, pyramid with 24 modulation
points, photons and read noise, slopes, control. The linear telescope replaces the optics by
products: its cost is told per second of telemetry, encoded for the wire, and in products of
2000 x 2000 numbers, for a processor that others use is slower for both. Processor time is counted,
not the clock on the wall. OOPAO runs in an interpreter of its own. ``make bench`` asks for it.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from pyrcal_studies.peers import variables
from service.instrument import load_instrument
from service.wire import encode_frames
from sim_rtc.assembly import build_telescope
from sim_rtc.computer.feed import BATCH_FRAMES, message_frames
from sim_rtc.computer.telemetry import frames_of
from sim_rtc.options import parse_options

_PEER = Path(__file__).with_name("plant_oopao.py")
_PEER_SAMPLING = 4
"""Pupil points per subaperture: OOPAO refuses 3, its grids are multiples of four points."""

_PEER_TIMEOUT_S = 300.0
_PRODUCT = 2000


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearCost:
    """Processor time of the linear telescope."""

    per_second_s: float
    """Of telemetry at 1 kHz, seconds."""

    product_s: float
    """Of one float32 product of 2000 x 2000, in the median of those in between, seconds."""

    @property
    def in_products(self) -> float:
        """What a second of telemetry costs, over that product."""
        return self.per_second_s / self.product_s


def measure_linear(n_seconds: int) -> LinearCost:
    """Return what telemetry of the linear telescope costs here, as a process would make it."""
    with threadpool_limits(1):
        options = parse_options(["--seed", "1"])
        batch_frames = message_frames(options.frame_rate_hz)
        telescope = build_telescope(
            options, load_instrument(options.instrument), batch_frames=batch_frames
        )
        computer = telescope.computer(telescope.feed.blocks())
        computer.prepare()
        factor = np.ones((_PRODUCT, _PRODUCT), dtype=np.float32)
        n_batches = round(options.frame_rate_hz / batch_frames)
        costs_s, products_s = [], []
        for _ in range(n_seconds + 1):
            products_s.append(_processor_s(lambda: factor @ factor, 1))
            start_s = time.process_time()
            for _ in range(n_batches):
                batch = computer.next_batch()
                encode_frames(*frames_of(batch, 0, 1_000_000))
            costs_s.append(time.process_time() - start_s)
        return LinearCost(
            per_second_s=float(np.mean(costs_s[1:])), product_s=float(np.median(products_s))
        )


def measure(n_blocks: int) -> float:
    """Return what a frame costs here, milliseconds, over blocks of 200 frames after the first."""
    with threadpool_limits(1):
        options = parse_options(["--plant", "diffractive", "--seed", "1"])
        telescope = build_telescope(options, load_instrument(options.instrument))
        computer = telescope.computer(telescope.feed.blocks())
        computer.prepare()
        return 1e3 * _processor_s(computer.next_batch, 20 * n_blocks) / BATCH_FRAMES


def _processor_s(function: Callable[[], object], n: int) -> float:
    function()
    start_s = time.process_time()
    for _ in range(n):
        function()
    return (time.process_time() - start_s) / n


def measure_oopao(python: str) -> float:
    """Return what the same frame costs OOPAO, run by the interpreter it is installed for."""
    done = subprocess.run(
        [python, str(_PEER), str(_PEER_SAMPLING)],
        env=variables(),
        capture_output=True,
        text=True,
        timeout=_PEER_TIMEOUT_S,
        check=True,
    )
    return float(json.loads(done.stdout.splitlines()[-1]))
