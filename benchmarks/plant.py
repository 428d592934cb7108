"""What a second of the simulated telescope costs, linear and diffractive, beside OOPAO's.

One core. A step is a frame of the closed loop: atmosphere, mirror, pyramid with 24 modulation
points, photons and read noise, slopes, control. The linear telescope replaces the optics by
products: its cost is told per second of telemetry, encoded for the wire, and in products of
2000 x 2000 numbers, for a processor that others use is slower for both. Processor time is counted,
not the clock on the wall. OOPAO runs in an interpreter of its own::

    python -m venv peer && peer/bin/pip install OOPAO
    python -m benchmarks.plant --oopao-python peer/bin/python
"""

from __future__ import annotations

import argparse
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
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.computer.feed import BATCH_FRAMES, message_frames
from sim_rtc.computer.telemetry import frames_of
from sim_rtc.options import parse_options
from sim_rtc.telescope.diffractive import DiffractiveOptics

_PEER = Path(__file__).with_name("plant_oopao.py")
_PEER_SAMPLINGS = (2, 4)
"""Pupil points per subaperture: OOPAO refuses 3, its grids are multiples of four points."""

_PEER_TIMEOUT_S = 300.0
_PRODUCT = 2000
_TARGET_LINEAR = 0.25
"""Of a core."""

_TARGET_FPS = 150.0
_TARGET_RATIO = 10.0


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

    @property
    def gflops(self) -> float:
        """Of that product."""
        return 2 * _PRODUCT**3 / self.product_s / 1e9


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
                encode_frames(*frames_of(batch, telescope.identity, 0, 1_000_000))
            costs_s.append(time.process_time() - start_s)
        return LinearCost(
            per_second_s=float(np.mean(costs_s[1:])), product_s=float(np.median(products_s))
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Processor time of a frame."""

    sensor_ms: float
    """Pyramid alone."""

    step_ms: float
    """The whole loop step."""


def measure(n_blocks: int) -> Cost:
    """Return what a frame costs here, over this many blocks of 200 frames after the first."""
    with threadpool_limits(1):
        options = parse_options(["--plant", "diffractive", "--seed", "1"])
        telescope = build_telescope(options, load_instrument(options.instrument))
        blocks = telescope.feed.blocks()
        computer = telescope.computer(blocks)
        computer.prepare()
        computer.next_batch()
        n_frames = 0
        start_s = time.process_time()
        for _ in range(20 * n_blocks):
            computer.next_batch()
            n_frames += BATCH_FRAMES
        step_s = (time.process_time() - start_s) / n_frames
        return Cost(sensor_ms=1e3 * _sensor_s(telescope), step_ms=1e3 * step_s)


def _sensor_s(telescope: Telescope) -> float:
    optics = telescope.optics.at(0.0)
    if not isinstance(optics, DiffractiveOptics):
        raise TypeError(f"benchmark: found {type(optics).__name__}; expected DiffractiveOptics")
    opd_m = np.random.default_rng(1).normal(0.0, 1e-7, len(telescope.weights)).astype(np.float32)
    return _processor_s(lambda: optics.sensor.images(opd_m), 50)


def _processor_s(function: Callable[[], object], n: int) -> float:
    function()
    start_s = time.process_time()
    for _ in range(n):
        function()
    return (time.process_time() - start_s) / n


def measure_oopao(python: str, sampling: int) -> Cost:
    """Return what the same frame costs OOPAO, run by the interpreter it is installed for."""
    done = subprocess.run(
        [python, str(_PEER), str(sampling)],
        env=variables(),
        capture_output=True,
        text=True,
        timeout=_PEER_TIMEOUT_S,
        check=True,
    )
    found = json.loads(done.stdout.splitlines()[-1])
    return Cost(sensor_ms=found["sensor_ms"], step_ms=found["step_ms"])


def main() -> None:
    """Print the costs, and the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--blocks", type=int, default=3, help="of 200 frames to time")
    parser.add_argument("--oopao-python", metavar="PATH", help="interpreter that has OOPAO")
    parser.add_argument("--seconds", type=int, default=20, help="of linear telemetry to time")
    given = parser.parse_args()
    linear = measure_linear(given.seconds)
    print(
        f"linear plant, 1 kHz: {linear.per_second_s:.3f} s of processor time per second of "
        f"telemetry, on a core of {linear.gflops:.0f} GFLOPS: {linear.in_products:.2f} products; "
        f"expected: {_TARGET_LINEAR:.2f} s at 55 GFLOPS"
    )
    own = measure(given.blocks)
    fps = 1e3 / own.step_ms
    print("24 modulation points, 30 x 30 subapertures, noise on, one core")
    print(f"{'':28s} pyramid ms   step ms   steps/s")
    print(f"{'pyrcal, 3 points':28s} {own.sensor_ms:10.2f} {own.step_ms:9.2f} {fps:9.0f}")
    if given.oopao_python is not None:
        costs = [(n, measure_oopao(given.oopao_python, n)) for n in _PEER_SAMPLINGS]
        for n, peer in costs:
            print(
                f"{f'OOPAO, {n} points':28s} {peer.sensor_ms:10.2f} {peer.step_ms:9.2f} "
                f"{1e3 / peer.step_ms:9.0f}   {peer.step_ms / own.step_ms:5.1f} x"
            )
        exponent = np.log(costs[1][1].step_ms / costs[0][1].step_ms) / np.log(2.0)
        between = costs[0][1].step_ms * 1.5**exponent / own.step_ms
        print(f"OOPAO at 3 points, between the two: {between:.1f} x")
    print(f"expected: {_TARGET_FPS:.0f} steps/s, {_TARGET_RATIO:.0f} x OOPAO's at no coarser grid")


if __name__ == "__main__":
    main()
