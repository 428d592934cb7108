"""What is asked of processes in these tests: here, so that they import nothing for it."""

import os
import signal
import time
from dataclasses import replace

import numpy as np

from service.errors import MatrixError
from service.estimation.own_matrix import LeftOver


def process_id(_bench=None):
    return os.getpid()


def niceness(_bench=None):
    return os.nice(0)


def interrupted(_bench):
    """Survive what Ctrl-C sends to the whole process group."""
    os.kill(os.getpid(), signal.SIGINT)
    return "still here"


def asleep(_bench):
    time.sleep(60.0)


def napping(_bench):
    time.sleep(1.2)


def endless(_bench):
    while True:
        pass


def killed(_bench=None):
    os.kill(os.getpid(), signal.SIGKILL)


def spinning(_bench):
    end_s = time.process_time() + 0.2
    while time.process_time() < end_s:
        pass


def failing(_bench=None):
    raise ValueError("a bug in a job")


def refusing(*_given):
    raise MatrixError("transposed")


def measuring(bench, value):
    """Change the model as a job does that has measured something."""
    residual = LeftOver(columns=np.array([7]), slopes=np.full((224, 1), value, np.float32))
    bench.restore(replace(bench.state, own_residual=bench._keep(residual)), {})


def measured(bench):
    """Return what the model has of that."""
    return [float(one.slopes[0, 0]) for one in bench.arrays.values()]
