"""What is asked of processes in these tests: here, so that they import nothing for it."""

import os
import signal
import time
from dataclasses import dataclass

import numpy as np

from service.errors import MatrixError


def process_id(_bench=None):
    return os.getpid()


def niceness(_bench=None):
    return os.nice(0)


def who():
    return os.getpid(), os.nice(0)


def interrupted(_bench):
    """Survive what Ctrl-C sends to the whole process group."""
    os.kill(os.getpid(), signal.SIGINT)
    return "still here"


def asleep(_bench):
    time.sleep(60.0)


def asleep_at(folder):
    """Tell there who sleeps."""
    (folder / "pid").write_text(str(os.getpid()))
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


def remembering(bench):
    bench.told = "first"


def remembered(bench):
    return getattr(bench, "told", None)


@dataclass(frozen=True)
class Asked:
    """What is asked of a fit, as far as these jobs look at it."""

    dataset: str | None = None


def at_a_stage(folder, _asked):
    (folder / "stage").write_text("orientation")
    time.sleep(60.0)


def drawing(folder, asked):
    (folder / "figures.json").write_text("{}")
    return telling(folder, asked)


def telling(folder, asked):
    """Say what lies in the folder of an upload, instead of fitting it."""
    content = (folder / "upload").read_bytes()
    return {"verdict": f"accepted: {len(content)} bytes of {asked.dataset}"}


def sleeping(_folder, _asked):
    time.sleep(60.0)


def hungry():
    return len(np.ones(400_000_000))


def modest():
    return float(np.ones(1_000_000).sum())
