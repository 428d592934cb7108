"""An operator cannot approve a verdict that is of another registration."""

from dataclasses import replace

import numpy as np
import pytest

from service.errors import CommandError
from service.tracker import step
from service.tracking import commands as cmd
from service.tracking.products import MatrixState
from service.tracking.registration import Registration
from tests.states import tracker_state
from tests.unit.tracking.situations import (
    ALL_SHOWN,
    ALPHA,
    POLICY,
    START_NS,
    judged,
    moved,
    record,
    rtc,
)


def proposed(alpha):
    """The service believes in ``alpha``; a proposal for ``ALPHA`` waits."""
    registration = Registration(
        alpha=alpha,
        covariance=np.diag([0.001, 0.001, 1e-5, 1e-4]) ** 2,
        floor=POLICY.floor,
        t_ns_utc=START_NS,
        arrived_ns_utc=START_NS,
        n_windows=5,
    )
    then = judged(replace(registration, alpha=ALPHA), rtc())
    return tracker_state(
        system="flao",
        rtc=rtc(),
        verified_ids=frozenset({"initial"}),
        reconstructors=(record("cm-1", judged=then),),
        registration=registration,
        mode_proof=ALL_SHOWN,
    )


def test_a_proposal_for_a_registration_left_behind_is_refused_and_still_there():
    state = proposed(moved(ALPHA, shift_x_subap=0.1))
    with pytest.raises(CommandError, match="refit"):
        step(state, cmd.Approve(id="cm-1"), POLICY, START_NS)
    assert state.reconstructor("cm-1").state is MatrixState.PROPOSED


def test_a_change_below_the_update_threshold_does_not_make_it_stale():
    state = proposed(replace(ALPHA, shift_x_subap=ALPHA.shift_x_subap + 0.005))
    state, _ = step(state, cmd.Approve(id="cm-1"), POLICY, START_NS)
    assert state.reconstructor("cm-1").state is MatrixState.PUBLISHED
