"""Each invariant of the state is violated by a state that is wrong, and by no other."""

from dataclasses import replace

import numpy as np
import pytest

from service.records.operations import (
    Acquisition,
    AcquisitionStage,
    Dither,
    DitherPurpose,
    MeasurementRecord,
    MeasureState,
)
from service.records.products import MatrixState, ReferencesRecord
from service.records.state import ReferenceStates
from service.tracking import transitions
from service.tracking.invariants import INVARIANTS, find_violations
from service.wire import Loop, Pattern
from tests.support.situations import START_NS, Story, dither_request, record, rtc
from tests.support.states import changed


@pytest.fixture(scope="module")
def state():
    story = Story().meet()
    story.see(n_windows=3)
    return story.state


def with_matrices(state, *records):
    return changed(state, reconstructors=(*state.matrices.reconstructors, *records))


def measured(name, **changes):
    return MeasurementRecord(
        id=name,
        pattern=Pattern.SINE,
        state=MeasureState.RUNNING,
        modes=(0,),
        amplitude_m=(1e-9,),
        **changes,
    )


def with_dither(state, purpose, loop, asked_after_s=1.0):
    view = replace(state.loop.rtc, loop=loop)
    asked_ns = view.t_ns + round(1e9 * asked_after_s)
    dither = Dither(request=dither_request("d-1"), purpose=purpose, asked_ns_utc=asked_ns)
    return changed(state, rtc=view, dither=dither)


def with_alpha(state, **values):
    return changed(state, registration=replace(state.alpha.registration, **values))


WRONG = {
    "an id of their own": lambda state: with_matrices(
        state, *[record("cm-1", MatrixState.SUPERSEDED)] * 2
    ),
    "at most one matrix is applied": lambda state: with_matrices(
        changed(state, in_use=None), record("cm-1", MatrixState.APPLIED)
    ),
    "the matrix in use is applied": lambda state: changed(
        state, reconstructors=(record("initial", MatrixState.REJECTED),)
    ),
    "no matrix but the one in use": lambda state: changed(
        state, reconstructors=(record("cm-1", MatrixState.APPLIED),)
    ),
    "references are applied if": lambda state: replace(
        state,
        references=ReferenceStates(
            records=(
                ReferencesRecord(id="ref-1", state=MatrixState.APPLIED, created_ns_utc=START_NS),
            )
        ),
    ),
    "at most one interaction matrix": lambda state: changed(
        state, measurements=(measured("im-1"), measured("im-2"))
    ),
    "exclude each other": lambda state: changed(
        state,
        measurements=(measured("im-1"),),
        acquisition=Acquisition(stage=AcquisitionStage.COARSE),
    ),
    "dither an open loop": lambda state: with_dither(state, DitherPurpose.FOLLOW, Loop.OPEN),
    "α and its covariance are finite": lambda state: with_alpha(
        state, covariance=np.full((4, 4), np.nan)
    ),
    "pointings are in the order": lambda state: changed(
        state, pointings=((2, rtc().pointing), (1, rtc().pointing))
    ),
}


def test_an_ordinary_state_violates_none(state):
    assert find_violations(state) == []
    closed = with_dither(state, DitherPurpose.FOLLOW, Loop.CLOSED)
    operators = with_dither(state, DitherPurpose.OPERATOR, Loop.OPEN)
    before_it_opened = with_dither(state, DitherPurpose.FOLLOW, Loop.OPEN, asked_after_s=-1.0)
    assert [find_violations(one) for one in (closed, operators, before_it_opened)] == [[], [], []]


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_state_violates_its_invariant(state, words):
    (violation,) = find_violations(WRONG[words](state))
    assert words in violation


def test_what_waits_in_a_state_that_leads_nowhere_is_named(state, monkeypatch):
    waiting = with_matrices(state, record("cm-1", MatrixState.STAGED))
    assert find_violations(waiting) == []
    monkeypatch.setitem(transitions.TABLES[MatrixState], MatrixState.STAGED, ())
    (violation,) = find_violations(waiting)
    assert "from which no transition leads on" in violation


def test_every_invariant_has_a_state_that_violates_it():
    assert len(INVARIANTS) == len(WRONG) + 1
