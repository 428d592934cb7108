"""What the streaming estimators cost for every frame, at the size of FLAO.

One core, processor time, 1408 slopes, 594 modes of which 400 are controlled, telemetry in blocks
as the link delivers them. Run: ``python -m benchmarks.estimators``; ``--block 30`` is what a
service at 1 kHz sees.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.shared import study_parser
from service.estimation import loopcheck, passive
from service.estimation.description import Actuators, Description, edge_watch
from service.estimation.frames import FrameBlock
from service.estimation.health import (
    EdgeHealth,
    LoopHealth,
    VibrationMonitor,
    observe,
    observe_edge,
)
from service.estimation.lockin import LockIn, LockInPlan
from service.estimation.loopcheck import LoopCheck
from service.estimation.passive import Passive
from service.estimation.random_dither import RandomDither, RandomPlan
from service.estimation.windows import ClosedLoop
from service.instrument import load_instrument
from service.model.modes import karhunen_loeve_basis
from service.records.operations import Dither, DitherPurpose
from service.runtime.estimator_bank import (
    EstimatorBank,
    process_block,
    with_dither,
    with_matrix,
    with_rtc,
)
from service.wire import DitherKind, DitherRequest, Loop, Status

N_SLOPES, N_MODES, N_CONTROLLED = 1408, 594, 400
RATE_HZ = 1000.0
WINDOW_FRAMES = 5000
LINES_HZ = (211.0, 239.0, 283.0, 331.0)
DITHERED = (409, 427, 445, 463)
AMPLITUDE_M = 5e-9
TARGET_US = 50.0

TOGETHER = ("lock-in, 4 lines", "random dither, 4 modes", "passive, 400 modes")
"""The three estimators of the target."""

N_ALTERNATIVES = 5
"""Rows of dithers and passive estimates, of which a service has some at a time."""

BANK = "all of them, through the bank"

Array = NDArray[Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """One thing that looks at every frame."""

    name: str
    begin: Any
    """Its state before the first frame."""

    feed: Callable[[Any, FrameBlock], Any]
    """State after one more block."""


def main() -> None:
    """Print the table; exit with 1 when the three estimators together miss the target."""
    given = _arguments()
    with threadpool_limits(1):
        blocks = list(blocks_of(given.block, given.frames))
        costs = {part.name: _cost_us(part, blocks, given.repeats) for part in _parts()}
        whole = _cost_us(_bank(), blocks, given.repeats)
    sys.stdout.write(_table(costs, given.block))
    sys.stdout.write(f"| **{BANK}** | **{whole:.1f}** |\n")
    raise SystemExit(1 if sum(costs[name] for name in TOGETHER) > TARGET_US else 0)


def _arguments() -> argparse.Namespace:
    parser = study_parser("benchmarks.estimators", __doc__)
    parser.add_argument("--block", type=int, default=30, help="frames per block (default: 30)")
    parser.add_argument("--frames", type=int, default=3000, help="per repeat (default: 3000)")
    parser.add_argument("--repeats", type=int, default=5, help="the fastest counts (default: 5)")
    return parser.parse_args()


def blocks_of(n_block: int, n_frames: int) -> Iterator[FrameBlock]:
    """Yield contiguous telemetry of a dithered loop: what it holds does not change its cost."""
    rng = np.random.default_rng(1)
    shape = (max(n_block, 200), N_SLOPES)
    slopes = (1e-2 * rng.standard_normal(shape)).astype(np.float32)
    commands = (1e-8 * rng.standard_normal((len(slopes), N_MODES))).astype(np.float32)
    for first_seq in range(0, n_frames, n_block):
        # rows of a long array in turn, or the caches would hold all there is
        rows = (first_seq + np.arange(n_block)) % len(slopes)
        dither = np.zeros((n_block, N_MODES), np.float32)
        turns = np.outer(first_seq + np.arange(n_block), LINES_HZ) / RATE_HZ
        dither[:, DITHERED] = AMPLITUDE_M * np.sqrt(2.0) * np.sin(2 * np.pi * turns)
        yield FrameBlock(
            session="benchmark",
            first_seq=first_seq,
            t0_ns_utc=round(first_seq * 1e9 / RATE_HZ),
            dt_ns=round(1e9 / RATE_HZ),
            slopes=slopes[rows],
            commands_m=commands[rows] + dither,
            dither_m=dither,
            cm_id="cm",
        )


def _parts() -> Iterator[Part]:
    """Yield all that looks at the telemetry of a running service, and the two kinds of dither."""
    lock_in = LockIn(
        plan=LockInPlan(
            modes=DITHERED,
            frequencies_hz=LINES_HZ,
            amplitude_m=(AMPLITUDE_M,) * 4,
            frame_rate_hz=RATE_HZ,
            n_frames=WINDOW_FRAMES,
            first_seq=0,
        )
    )
    yield Part(name=TOGETHER[0], begin=lock_in, feed=lambda s, b: s.accumulate(b)[0])
    yield Part(name=TOGETHER[1], begin=_random(DITHERED), feed=_random_fed)
    watched = Passive(n_modes=N_CONTROLLED, memory_frames=1e4)
    yield Part(name=TOGETHER[2], begin=watched, feed=passive.accumulate)
    everything = _random(tuple(range(N_CONTROLLED)))
    yield Part(name="random dither, 400 modes", begin=everything, feed=_random_fed)
    yield from _watchers()


def _random(modes: tuple[int, ...]) -> RandomDither:
    amplitude_m = (AMPLITUDE_M / len(modes) ** 0.5,) * len(modes)
    plan = RandomPlan(modes=modes, amplitude_m=amplitude_m, n_frames=WINDOW_FRAMES, first_seq=0)
    return RandomDither(plan=plan)


def _random_fed(state: RandomDither, block: FrameBlock) -> RandomDither:
    return state.accumulate(block)[0]


def _watchers() -> Iterator[Part]:
    """Yield what guards the loop."""
    basis = karhunen_loeve_basis(load_instrument("flao-lbt"))
    variance, in_loop = basis.variance_m2, np.arange(N_CONTROLLED)
    yield Part(
        name="loop health",
        begin=LoopHealth(),
        feed=lambda state, block: observe(state, block, variance, in_loop),
    )
    watch = edge_watch(_actuators(), variance, in_loop)
    if watch is None:
        raise TypeError("benchmark: found no edge to watch; expected the ring of 400 modes")
    yield Part(
        name="edge of the mirror",
        begin=EdgeHealth(),
        feed=lambda state, block: observe_edge(state, block, watch),
    )
    terms = _terms()
    yield Part(
        name="commands obey the loop",
        begin=LoopCheck(),
        feed=lambda state, block: loopcheck.observe(state, block, terms),
    )
    monitor = VibrationMonitor.of(N_SLOPES)
    yield Part(
        name="vibrations", begin=monitor, feed=lambda state, block: state.follow(block, LINES_HZ)
    )


def _terms() -> ClosedLoop:
    return ClosedLoop(
        cm_id="cm",
        reconstructor=np.ones((N_CONTROLLED, N_SLOPES), np.float32),
        gains=np.full(N_CONTROLLED, 0.5, np.float32),
        leak=0.999,
        delay_frames=2.0,
        frame_rate_hz=RATE_HZ,
    )


def _bank() -> Part:
    """Return all of them together, as the service feeds them, with a dither of sines."""
    basis = karhunen_loeve_basis(load_instrument("flao-lbt"))
    description = Description(
        n_slopes=N_SLOPES,
        n_modes=N_MODES,
        mode_variance_m2=basis.variance_m2,
        actuators=_actuators(),
        products=np.eye(N_MODES, dtype=np.float32) * np.float32(1e16),
    )
    request = DitherRequest(
        id="benchmark",
        kind=DitherKind.SINE,
        modes=DITHERED,
        amplitude_m=(AMPLITUDE_M,) * len(DITHERED),
        frequency_hz=LINES_HZ,
        duration_s=1e5,
    )
    rtc = Status(
        session="benchmark",
        seq=0,
        t_ns=0,
        loop=Loop.CLOSED,
        frame_rate_hz=RATE_HZ,
        delay_frames=2.0,
        leak=0.999,
        gains=(0.5,) * N_CONTROLLED + (0.0,) * (N_MODES - N_CONTROLLED),
        n_controlled=N_CONTROLLED,
        n_modes=N_MODES,
        n_slopes=N_SLOPES,
        cm_id="cm",
        basis_id="kl",
        config_id="benchmark",
        magnitude=8.0,
        max_dither_m=5e-8,
        max_dither_modes=N_MODES,
        dither=None,
    )
    bank = with_rtc(EstimatorBank.of(description), rtc)
    bank = with_matrix(bank, "cm", np.ones((N_CONTROLLED, N_SLOPES), np.float32))
    dither = Dither(request=request, purpose=DitherPurpose.FOLLOW, start_seq=0, asked_ns_utc=0)
    bank = with_dither(bank, dither, WINDOW_FRAMES / RATE_HZ)
    return Part(name=BANK, begin=bank, feed=lambda state, block: process_block(state, block)[0])


def _actuators() -> Actuators:
    instrument = load_instrument("flao-lbt")
    return Actuators(
        positions=instrument.analytic_mirror.positions_m,
        strokes=karhunen_loeve_basis(instrument).mode_to_actuator,
    )


def _cost_us(part: Part, blocks: list[FrameBlock], repeats: int) -> float:
    """Return processor time per frame, the fastest of a few passes; the first one warms up."""
    n_frames = sum(block.n_frames for block in blocks)
    state, costs = part.begin, []
    for k in range(repeats + 1):
        shifted = [_later(block, k * n_frames) for block in blocks]
        start_s = time.process_time()
        for block in shifted:
            state = part.feed(state, block)
        costs.append((time.process_time() - start_s) / n_frames)
    return 1e6 * min(costs[1:])


def _later(block: FrameBlock, n_frames: int) -> FrameBlock:
    """Return the block ``n_frames`` further on, so that a second pass goes on from the first."""
    return replace(
        block,
        first_seq=block.first_seq + n_frames,
        t0_ns_utc=block.t0_ns_utc + n_frames * block.dt_ns,
    )


def _table(costs: dict[str, float], n_block: int) -> str:
    """Return the table in Markdown."""
    lines = [f"| blocks of {n_block} frames | us per frame |", "| --- | --- |"]
    lines += [f"| {name} | {cost:.1f} |" for name, cost in costs.items()]
    three = sum(costs[name] for name in TOGETHER)
    lines.append(f"| **the three estimators together** | **{three:.1f}** |")
    rest = sum(cost for name, cost in itertools.islice(costs.items(), N_ALTERNATIVES, None))
    lines.append(f"| everything else on every frame | {rest:.1f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
