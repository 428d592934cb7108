"""What campaigns share: the small telescope of short nights, and a worker in their own process."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

from pyrcal_studies.campaign.observatory import Latencies
from service.instrument import load_instrument
from service.runtime.worker import Compute, OpticsWorker, Sampling

SMALL = "tests/system/small.toml"

N_TARGET = 60
"""Modes that its matrices are to control in the end."""

SETTINGS: Mapping[str, object] = {
    "dither.budget_m": 40e-9,
    "dither.amplitude_m": 20e-9,
    "dither.window_s": 1.0,
    "dither.longest_window_s": 1.0,
    "control.n_modes_target": N_TARGET,
    "tracking.floor_rotation_deg": 0.04,
    "tracking.floor_magnification": 0.0007,
}
"""Of the service: few modes must tell as much as many."""


def latencies_of(slower: float = 1.0) -> Latencies:
    """Return how long things take with a worker that takes so many times longer."""
    return Latencies(fit_s=0.5 * slower, make_s=2.0 * slower, judge_s=slower, watch_s=0.5 * slower)


@cache
def bench_of(instrument: str, sampling: int | None = None) -> OpticsWorker:
    """Return the worker of an instrument, one per process; ``sampling`` None: the usual one."""
    points = Sampling() if sampling is None else Sampling(sampling, sampling)
    return OpticsWorker(load_instrument(instrument), Compute(threads=1, sampling=points))
