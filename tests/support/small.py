"""An instrument small enough that a job takes milliseconds, and the loop that goes with it."""

import os
from functools import cache
from pathlib import Path

import numpy as np

from service.control.loop import ControlLoop
from service.files.disk_cache import usual_folder
from service.instrument import load_instrument
from service.runtime.worker import Compute, Conditions

INSTRUMENT = Path(__file__).parents[1] / "unit" / "runtime" / "small.toml"
COMPUTE = Compute(threads=1, nice=0, cache=usual_folder(os.environ))
N_CONTROLLED = 45
SIGMA = np.array([0.003, 0.003, 1e-4, 3e-4])


@cache
def small_instrument():
    return load_instrument(str(INSTRUMENT))


def loop_settings(n_modes=N_CONTROLLED, gain=0.4):
    return ControlLoop(
        frame_rate_hz=1000.0, gains=np.full(n_modes, gain), leak=0.999, delay_frames=2.0
    )


def conditions(alpha, covariance, loop, bound):
    """What a reconstructor has to hold in."""
    return Conditions(alpha=alpha, covariance=covariance, loop=loop, bound=bound)
