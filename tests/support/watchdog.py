"""What tests of several modules share of unit.tracking.test_watchdog."""

from __future__ import annotations

import numpy as np

from service.records import events as ev
from service.records.estimates import PassiveEstimate
from tests.support.situations import SECOND, moved, rtc

SCATTER = np.array([0.003, 0.003, 1e-4, 1e-4])


def watched(alpha, scatter=SCATTER):
    return PassiveEstimate(
        alpha=alpha,
        covariance=np.diag(scatter**2),
        optical_gain=np.full(400, 0.6),
        misfit=1.0,
        step=np.zeros(4),
    )


def watch(story, alpha, after_s=10.0, scatter=SCATTER):
    """A look of the watchdog; the RTC's clock tells when."""
    now_ns = story.now_ns + round(after_s * SECOND)
    effects = story.tell(rtc(t_ns=now_ns), after_s)
    look = ev.PassiveFitted(estimate=watched(alpha, scatter), t_ns_utc=now_ns)
    return effects + story.tell(look)


def learnt(story, off=0.06, n_looks=20):
    """A night in which windows and looks alternate: the passive shift is off by so much."""
    for _ in range(n_looks):
        story.see(every_s=5.0)
        watch(story, moved(shift_x_subap=off), after_s=5.0)
    return story
