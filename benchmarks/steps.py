"""What the tracker's step costs: the golden nights told to it again, the events alone timed.

Run: ``python -m benchmarks.steps``. Beside telemetry of 1 kHz there are some ten steps a second.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from contextlib import suppress

import numpy as np

from pyrcal_studies.campaign.golden import FOLDER, INSTRUMENT, nights_in, read, with_instrument
from pyrcal_studies.campaign.golden_codec import decoded
from service.config import load_settings
from service.errors import PyrcalError
from service.runtime.policy import policy_of
from service.tracker import step
from service.tracking.events import Event
from service.tracking.state import Mode, OperatorState, TrackerState


def main() -> int:
    """Print median and mean cost of a step, of all and of the commonest events."""
    (instrument,) = read(FOLDER / INSTRUMENT)
    took_us: dict[str, list[float]] = defaultdict(list)
    for path in nights_in(FOLDER):
        begin, *entries = read(path)
        policy = with_instrument(policy_of(load_settings(None, {}, begin["settings"])), instrument)
        operator = OperatorState(mode=Mode(begin["mode"]))
        state = TrackerState(system=begin["system"], operator=operator)
        for entry in entries:
            if "event" not in entry:
                break  # a restart: what follows is as in other nights
            event: Event = decoded(Event, entry["event"])
            began_ns = time.perf_counter_ns()
            with suppress(PyrcalError):
                state, _ = step(state, event, policy, entry["t"])
            took_us[type(event).__name__].append((time.perf_counter_ns() - began_ns) / 1e3)
    every = [us for each in took_us.values() for us in each]
    print(f"{'all':16} {len(every):6} steps, {np.median(every):7.0f} us, mean {np.mean(every):.0f}")
    for name in sorted(took_us, key=lambda name: -sum(took_us[name]))[:6]:
        us = took_us[name]
        print(f"{name:16} {len(us):6} steps, {np.median(us):7.0f} us, mean {np.mean(us):.0f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
