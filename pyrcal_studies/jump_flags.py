"""How often a steady mirror is taken for one that jumps, and how soon a jump is told.

The tracker's reactions alone, fed with windows drawn at random: no telescope and no loop. Each
window's covariance is that of its noise up to what 60 degrees of freedom leave of it.

Run: ``python -m pyrcal_studies.jump_flags --sigma-mdeg 15,22 --hours 8 --jumps 300``.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.campaign.rows import floats
from service.config.settings import Settings
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.runtime.policy import policy_of
from service.tracking.filtering import WindowEstimate
from service.tracking.policy import SECOND_NS, Policy
from service.tracking.registration import Source
from service.tracking.state import TrackerState
from service.tracking.step_context import StepContext
from service.tracking.validity import telemetry_span
from service.tracking.window_processing import process_window

WINDOW_S = 2.0
FIT_S = 0.5
"""From the end of a window until its estimate is here."""

SETTLED = 12
"""Windows before anything is counted."""

AFTERWARDS = 6
"""Windows after a jump in which it should be told."""

DEGREES = 60
"""Of freedom of a window's own estimate of its noise: its side bins."""

WITHIN_S = 5.0
START_NS = 1_800_000_000 * SECOND_NS
FLAGS = ("registration.jump-suspected", "registration.jump")

DRIFT = np.array([0.05, 0.0, 0.05, 0.0])
"""Of a minute (boundary units: subapertures, degrees), where it drifts."""

JUMPS = {"shift 10 %": np.array([0.1, 0, 0, 0]), "rotation 0.1 deg": np.array([0, 0, 0.1, 0])}

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Night:
    """A mirror that drifts, and jumps once or never (boundary units)."""

    sigma: Array
    """``(4,)`` of one window."""

    n_windows: int
    drift: Array
    """``(4,)`` of a minute."""

    jump: Array
    at_s: float = np.inf

    def mean(self, end_s: float) -> Array:
        """Return where the mirror was on average in the window that ends then."""
        after = np.clip((end_s - self.at_s) / WINDOW_S, 0.0, 1.0)
        return np.asarray(self.drift * (end_s - WINDOW_S / 2.0) / 60.0 + after * self.jump)


def main() -> int:
    """Print two tables: false flags, and how soon jumps are told."""
    given = _parser().parse_args()
    policy = policy_of(Settings())
    sys.stdout.write(
        "| rotation of a window, mdeg | mirror | hours | suspected an hour | named an hour |\n"
    )
    for sigma in map(_sigma, given.sigma_mdeg):
        for name, drift in (("still", 0.0 * DRIFT), ("5 %, 0.05 deg a minute", DRIFT)):
            found = _false(sigma, drift, given.hours, policy)
            rates = " | ".join(f"{found[flag] / given.hours:.2f}" for flag in FLAGS)
            row = f"| {1e3 * sigma[2]:g} | {name} | {given.hours:g} | {rates} |\n"
            sys.stdout.write(row)
            sys.stdout.flush()
    sys.stdout.write("| rotation of a window, mdeg | jump | told within 5 s | median, worst s |\n")
    for sigma in map(_sigma, given.sigma_mdeg):
        for name, jump in JUMPS.items():
            told_s = _told_s(sigma, jump, given.jumps, policy)
            share = float(np.mean(told_s <= WITHIN_S))
            row = f"{share:.0%} of {given.jumps} | {np.median(told_s):.1f}, {max(told_s):.1f}"
            sys.stdout.write(f"| {1e3 * sigma[2]:g} | {name} | {row} |\n")
            sys.stdout.flush()
    return 0


def _false(sigma: Array, drift: Array, hours: float, policy: Policy) -> Counter[str]:
    n_windows = round(hours * 3600.0 / WINDOW_S)
    night = Night(sigma=sigma, n_windows=n_windows, drift=drift, jump=np.zeros(4))
    return Counter(name for _, name in _flags(night, np.random.default_rng(1), policy))


def _told_s(sigma: Array, jump: Array, n_jumps: int, policy: Policy) -> Array:
    """Return ``(n_jumps,)`` after how long each was flagged; infinity: not while it was looked."""
    rng, told_s = np.random.default_rng(2), []
    for k in range(n_jumps):
        at_s = (SETTLED + (k + 0.5) / n_jumps) * WINDOW_S
        night = Night(
            sigma=sigma, n_windows=SETTLED + AFTERWARDS, drift=0.0 * DRIFT, jump=jump, at_s=at_s
        )
        times = [s - at_s for s, _ in _flags(night, rng, policy) if s > at_s]
        told_s.append(min(times, default=np.inf))
    return np.array(told_s)


def _flags(night: Night, rng: np.random.Generator, policy: Policy) -> list[tuple[float, str]]:
    """Return when what was flagged, once all has settled; seconds since the night began."""
    state, found = TrackerState(system="flao"), []
    for k in range(1, night.n_windows + 1):
        end_s = k * WINDOW_S
        now_ns = START_NS + round((end_s + FIT_S) * SECOND_NS)
        context = StepContext(state, policy, now_ns)
        process_window(context, _measured(night, end_s, rng, policy))
        state = context.state
        new = [e for e in state.log if e.t_ns_utc == now_ns]
        if k > SETTLED:
            found += [(end_s + FIT_S, entry.name) for entry in new if entry.name in FLAGS]
    return found


def _measured(
    night: Night, end_s: float, rng: np.random.Generator, policy: Policy
) -> WindowEstimate:
    read = night.mean(end_s) + night.sigma * rng.normal(size=4)
    said = night.sigma * np.sqrt(rng.chisquare(DEGREES) / DEGREES) / BOUNDARY_SCALE
    when = telemetry_span(*(START_NS + round(s * SECOND_NS) for s in (end_s - WINDOW_S, end_s)))
    return WindowEstimate(
        alpha=Misregistration.from_vector(Misregistration().vector + read / BOUNDARY_SCALE),
        covariance=np.diag(said**2),
        floor=policy.floor,
        misfit=1.0,
        t_ns_utc=when.ended_ns_utc,
        pointing=None,
        began_ns_utc=when.began_ns_utc,
        source=Source.LOCK_IN,
        optical_gain=0.6,
        optical_gains=(),
    )


def _sigma(rotation_mdeg: float) -> Array:
    """Return 1 σ of a window, all in proportion as four lines at magnitude 10 measure them."""
    return np.array([0.36, 0.36, 1.5, 0.036]) * rotation_mdeg / 15.0 / 100.0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m pyrcal_studies.jump_flags", description=__doc__
    )
    parser.add_argument("--sigma-mdeg", type=floats, default=(15.0, 22.0), metavar="MDEG,MDEG...")
    parser.add_argument("--hours", type=float, default=8.0, help="of windows without a jump")
    parser.add_argument("--jumps", type=int, default=300)
    return parser


if __name__ == "__main__":
    sys.exit(main())
