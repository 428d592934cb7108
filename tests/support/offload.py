"""What tests of several modules share of unit.tracking.test_offload."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.model.misregistration import BOUNDARY_SCALE
from service.records import commands as cmd
from service.records.state import Mode
from service.tracking.policy import Offloading
from tests.support.situations import ALPHA, POLICY, Story, rtc

LIMITS = Offloading(
    share=0.5,
    near=np.array([0.02, 0.02, 0.02, 0.002]) / BOUNDARY_SCALE,
    max_step=np.array([0.1, 0.03, 0.2, 0.005]) / BOUNDARY_SCALE,
    travel=np.array([1.0, 1.0, 1.0, 0.0]) / BOUNDARY_SCALE,
    settle_s=3.0,
)
"""The magnification of this device cannot be moved."""


STAYS = replace(POLICY, n_modes_target=400, update_threshold=np.full(4, 9.0))


MOVES = replace(STAYS, offloading=LIMITS)


def a_story(mode=Mode.AUTO, policy=MOVES, n_windows=3, alpha=ALPHA):
    """α is known, and the loop runs on a matrix that was made for it."""
    story = Story(Mode.AUTO, STAYS)
    story.meet()
    story.see(alpha, n_windows=3)
    story.use("cm-1")
    story.wait(40.0)
    story.tell(cmd.SetMode(mode=mode))
    story.tell(rtc(cm_id="cm-1", t_ns=story.now_ns))
    story.policy = policy
    story.see(alpha, n_windows=n_windows)
    return story
