"""Nights of the whole service that show when it makes a reconstructor, and of how many modes.

Simulated time, on the linear or the diffractive telescope. ``drift``: the mirror drifts all night,
with the service's thresholds and with thresholds of the plain distance alone. ``leak``: the leak is
too weak for so many modes, the edge would slip; then the operator sets a stronger one.
Run: ``python -m pyrcal_studies.update_nights drift leak --seconds 180``.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter

import numpy as np
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import Observatory
from pyrcal_studies.campaign.system_measures import wavefront_rms_nm
from service.config import load_settings
from service.control.gate import MAX_SLIP_SAFE_LEAK
from service.instrument import load_instrument
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, OpticsWorker
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.state import Mode

POLICIES: dict[str, dict[str, object]] = {
    "what it wins": {},
    "distance alone": {
        "control.update_shift_subap": 0.01,
        "control.update_rotation_deg": 0.02,
        "control.update_magnification": 0.001,
    },
}
TOLD = ("modes.", "reconstructor.refused", "margin")
"""Beginnings of the log's names that are shown."""


def night_of(
    given: argparse.Namespace, motion: list[str], settings: dict[str, object], bench: OpticsWorker
) -> Observatory:
    """Return a night that has just begun."""
    words = [
        f"--plant={given.plant}",
        "--imperfections=ideal",
        f"--mag={given.mag}",
        f"--seed={given.seed}",
        f"--gain={given.gain}",
        f"--n-controlled={given.modes}",
        f"--instrument={given.instrument}",
        f"--leak={given.leak}",
        "--wind=12,40",
        *motion,
    ]
    policy = policy_of(load_settings(None, {}, settings | {"control.n_modes_target": given.target}))
    return Observatory(words, policy, Mode.AUTO, bench)


def drift(given: argparse.Namespace, bench: OpticsWorker) -> None:
    """Print, for both rules, how many matrices a drifting mirror takes and what is left."""
    motion = ["--drift=0.04,-0.03,0.05,0"]
    for name, settings in POLICIES.items():
        night = night_of(given, motion, settings, bench)
        night.advance(given.seconds)
        settled = [moment for moment in night.dome.moments if moment.time_s > 60.0]
        later = [swap for swap in night.swaps if swap.time_s > 60.0]
        radii = [swap.radius for swap in night.swaps if swap.radius is not None]
        apart = Counter(swap.n_modes for swap in night.swaps)
        sys.stdout.write(
            f"drift, {name}: {len(later)} matrices in {given.seconds - 60:.0f} s, modes "
            f"{dict(apart)}, true pole radius at the swap at most {max(radii):.3f}, "
            f"{wavefront_rms_nm(settled):.2f} nm\n"
        )
        _tell(night)


def leak(given: argparse.Namespace, bench: OpticsWorker) -> None:
    """Print what becomes of the modes while the leak is too weak for so many, and after."""
    night = night_of(given, [], {}, bench)
    night.advance(given.seconds / 4)
    night.command(cmd.SetLoop(leak=MAX_SLIP_SAFE_LEAK))
    sys.stdout.write(f"{night.time_s:6.1f} s: the operator sets a leak of {MAX_SLIP_SAFE_LEAK}\n")
    night.advance(3 * given.seconds / 4)
    _tell(night)
    radii = np.array([swap.radius for swap in night.swaps if swap.radius is not None])
    sys.stdout.write(f"true pole radius at the swaps: {np.round(radii, 3).tolist()}\n")


def _tell(night: Observatory) -> None:
    """Print the swaps and what the service said of its modes."""
    start_ns = night.dome.now_ns - round(night.time_s * 1e9)
    lines = [
        ((entry.t_ns_utc - start_ns) / 1e9, f"{entry.name}: {entry.text}")
        for entry in night.state.log
        if entry.name.startswith(TOLD)
    ]
    why = {
        event.record.id: event.record.reason
        for _, event in night.events
        if isinstance(event, ev.MatrixMade)
    }
    lines.extend(
        (swap.time_s, f"swap: {swap.n_modes} modes; {why.get(swap.id, '')}") for swap in night.swaps
    )
    for time_s, text in sorted(lines):
        sys.stdout.write(f"{time_s:6.1f} s: {text}\n")


NIGHTS = {"drift": drift, "leak": leak}


def main() -> None:
    """Play the nights named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("nights", nargs="+", choices=NIGHTS)
    parser.add_argument("--plant", default="linear")
    parser.add_argument("--instrument", default="flao-lbt", metavar="NAME|FILE")
    parser.add_argument("--modes", type=int, default=400, help="controlled at the start")
    parser.add_argument("--target", type=int, default=500, help="modes wanted")
    parser.add_argument("--seconds", type=float, default=180.0)
    parser.add_argument("--gain", type=float, default=0.4)
    parser.add_argument("--leak", type=float, default=0.999)
    parser.add_argument("--mag", default="10")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with threadpool_limits(1):
        bench = OpticsWorker(load_instrument(given.instrument), Compute(threads=1))
        for name in given.nights:
            NIGHTS[name](given, bench)
            sys.stdout.flush()


if __name__ == "__main__":
    main()
