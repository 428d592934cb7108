"""How slow this machine is just now: whoever waits for a process waits as much longer."""

import os
import time

WORK_S = 0.12
"""What :func:`_work` takes on the machine on which the deadlines of these tests were written down,
with nothing else to do."""

MOST = 8.0
"""A machine slower than this fails: something else is wrong with it."""

_measured = []


def slowness(*, again=False):
    """Return how many times longer than on an idle machine work takes; at least 1.

    Measured once; ``again``, for whoever has waited in vain: the load may have come meanwhile, or
    come and gone, which the load average of the last minute still tells.
    """
    if again or not _measured:
        began_s = time.monotonic()
        _work()
        took_s = time.monotonic() - began_s
        crowd = os.getloadavg()[0] / (os.cpu_count() or 1)
        _measured[:] = [min(max(took_s / WORK_S, crowd, 1.0), MOST)]
    return _measured[0]


def patience(seconds):
    """Return how long to wait here for what takes at most so long on an idle machine."""
    return seconds * slowness()


def in_time(began_s, seconds):
    """Return whether since ``began_s`` of the monotonic clock no more has passed than may here."""
    spent_s = time.monotonic() - began_s
    return spent_s < seconds or spent_s < seconds * slowness(again=True)


class Deadline:
    """The end of somebody's patience."""

    def __init__(self, seconds):
        self.began_s, self.seconds = time.monotonic(), seconds

    @property
    def passed(self):
        """Whether all the time is over that this machine may take, as it is now."""
        spent_s = time.monotonic() - self.began_s
        return spent_s > patience(self.seconds) and spent_s > self.seconds * slowness(again=True)

    def __str__(self):
        return f"{patience(self.seconds):.1f} s"


def _work():
    return sum(k * k for k in range(1_500_000))
