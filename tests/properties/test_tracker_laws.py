"""Whatever happens, in whatever order: what the service must and must not do."""

from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
from hypothesis import given, settings

from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import MeasureState
from service.records.products import MatrixState
from service.records.state import Mode
from service.tracker import step
from service.tracking.dither_request import total_m
from service.tracking.filtering import HISTORY_LENGTH
from service.tracking.operations.measurement import MEASUREMENTS_KEPT
from service.tracking.reconstructors import RECONSTRUCTORS_KEPT
from service.tracking.step_context import LOG_LENGTH
from service.wire import (
    DitherRequest,
    Status,
)
from tests.support.laws import COMMANDS, LAWS, TROUBLES, Night, commands, heard
from tests.support.situations import (
    POLICY,
    of_kind,
    record,
    stopping,
)

answers = [st.just(how) for how in ("done",) * 9 + ("refused",) * 2 + ("failed",) * 2]
# one_of counts the innermost alternatives: the answers need their own weight
stories = st.lists(
    st.tuples(
        st.one_of(heard, commands, *answers),
        st.sampled_from([0.0, 0.1, 1.0, 4.0, 31.0]),
    ),
    min_size=30,
    max_size=60,
)


def the_shelf_stays_in_order(before, event, night):
    check_shelf(night.state)


def check_shelf(state):
    applied = [r.id for r in state.matrices.reconstructors if r.state is MatrixState.APPLIED]
    assert len(applied) <= 1
    assert len({r.id for r in state.matrices.reconstructors}) == len(state.matrices.reconstructors)
    if state.matrices.in_use is not None:
        assert state.reconstructor(state.matrices.in_use) is not None
        if applied:
            assert applied == [state.matrices.in_use]


def nothing_grows_for_ever(before, event, night):
    check_bounds(night.state)


def check_bounds(state):
    assert len(state.log) <= LOG_LENGTH
    assert len(state.alpha.history) <= HISTORY_LENGTH
    assert len(state.matrices.reconstructors) <= RECONSTRUCTORS_KEPT
    assert len(state.operations.measurements) <= MEASUREMENTS_KEPT
    assert len({alarm.name for alarm in state.alarms.active}) == len(state.alarms.active)


def what_the_gate_refused_is_never_sent(before, event, night):
    refused = {r.id for r in before.matrices.reconstructors if r.state is MatrixState.REFUSED}
    for effect in of_kind(night.last, ev.SendMatrix):
        assert effect.id not in refused
        assert night.state.reconstructor(effect.id).gate.accepted


def nothing_is_sent_to_nobody_or_to_an_rtc_that_may_be_the_wrong_one(before, event, night):
    if of_kind(night.last, ev.SendMatrix):
        assert night.state.loop.rtc is not None
        assert not {a.name for a in night.state.alarms.active} & set(TROUBLES[:3])


def an_uncertainty_is_never_nothing_nor_negative(before, event, night):
    known = night.state.alpha.registration
    if known is not None and known is not before.alpha.registration:
        assert np.all(np.linalg.eigvalsh(known.covariance) > 0.0)
        assert np.all(known.sigma >= known.floor)


def while_a_matrix_is_measured_nothing_else_is_asked_of_the_rtc_or_learnt(before, event, night):
    if before.measuring is None or night.state.measuring is None:
        return
    assert night.state.measuring.id == before.measuring.id
    assert night.state.windows.accepted == before.windows.accepted
    sent_before = {r.id for r in night.state.matrices.reconstructors if r.id.startswith("made")}
    for effect in night.last:
        assert isinstance(effect, ev.SendMatrix) or effect == stopping(night)
        if isinstance(effect, ev.SendMatrix):
            assert effect.id in sent_before


OVER = {MeasureState.REFUSED, MeasureState.FAILED, MeasureState.STORED, MeasureState.GIVEN_UP}


def a_measurement_that_is_over_stays_over_and_given_up_stays_given_up(before, event, night):
    after = {r.id: r.state for r in night.state.operations.measurements}
    for was in before.operations.measurements:
        assert was.state not in OVER or after[was.id] in OVER
        if was.state is MeasureState.GIVEN_UP:
            assert after[was.id] is MeasureState.GIVEN_UP


def no_dither_is_over_budget_unless_an_operator_means_it(before, event, night):
    if not getattr(event, "over_budget", False):
        for request in of_kind(night.last, DitherRequest):
            assert total_m(request) <= POLICY.dither_budget_m * (1.0 + 1e-9)


def an_open_loop_is_an_alarm_unless_a_measurement_has_opened_it(before, event, night):
    if isinstance(event, Status) and night.state.loop.rtc.loop == "open":
        measuring = night.state.measuring
        expected = measuring is None or not measuring.opens_loop
        assert ("loop-open" in {a.name for a in night.state.alarms.active}) is expected


def only_one_reconstructor_is_under_way_at_a_time(before, event, night):
    if isinstance(event, COMMANDS):
        return
    made = of_kind(night.last, ev.MakeMatrix)
    assert len(made) <= 1
    waiting = [r.id for r in before.matrices.reconstructors if r.state in SENT]
    still = [name for name in waiting if night.state.reconstructor(name).state in SENT]
    assert not (made and still)


SENT = {MatrixState.PUBLISHED, MatrixState.STAGED}
ALWAYS = (
    the_shelf_stays_in_order,
    nothing_grows_for_ever,
    what_the_gate_refused_is_never_sent,
    nothing_is_sent_to_nobody_or_to_an_rtc_that_may_be_the_wrong_one,
    an_uncertainty_is_never_nothing_nor_negative,
    while_a_matrix_is_measured_nothing_else_is_asked_of_the_rtc_or_learnt,
    a_measurement_that_is_over_stays_over_and_given_up_stays_given_up,
    no_dither_is_over_budget_unless_an_operator_means_it,
    an_open_loop_is_an_alarm_unless_a_measurement_has_opened_it,
    only_one_reconstructor_is_under_way_at_a_time,
)
"""What holds after every event, whatever the mode."""


@settings(LAWS, max_examples=100)
@given(stories, st.sampled_from([Mode.AUTO, Mode.AUTO, Mode.PROPOSE, Mode.HOLD]))
def test_nothing_but_a_command_is_ever_refused_and_every_law_holds(story, mode):
    night = Night(mode)
    for event, after_s in story:
        before = night.state
        night.tell(event, after_s)
        for law in ALWAYS:
            law(before, event, night)


@LAWS
@given(stories)
def test_in_hold_nothing_is_made_or_sent_by_itself(story):
    night = Night(Mode.HOLD)
    for event, after_s in story:
        if isinstance(event, COMMANDS):
            continue
        night.tell(event, after_s)
        assert not of_kind(night.last, ev.MakeMatrix | ev.RepublishMatrix | ev.SendMatrix)


@LAWS
@given(stories)
def test_in_propose_nothing_is_sent_but_what_an_operator_approved_or_asked_for_again(story):
    night = Night(Mode.PROPOSE)
    for event, after_s in story:
        if isinstance(event, cmd.SetMode):
            continue
        copied = any(isinstance(effect, ev.RepublishMatrix) for effect in night.open[:1])
        night.tell(event, after_s)
        if of_kind(night.last, ev.SendMatrix):
            assert isinstance(event, cmd.Approve) or copied


@LAWS
@given(stories, st.sampled_from([ev.RtcVanished(), ev.SessionStarted(session="s3")]))
def test_the_registration_and_the_shelf_outlive_the_rtc(story, end):
    night = Night()
    for event, after_s in story:
        night.tell(event, after_s)
    before = night.state
    after, _ = step(before, end, POLICY, night.now_ns)
    assert [r.id for r in after.matrices.reconstructors] == [
        r.id for r in before.matrices.reconstructors
    ]
    assert after.alpha.history == before.alpha.history
    assert (after.alpha.registration is None) is (before.alpha.registration is None)
    if before.alpha.registration is not None:
        assert after.alpha.registration.alpha == before.alpha.registration.alpha
        np.testing.assert_array_equal(
            after.alpha.registration.covariance, before.alpha.registration.covariance
        )


def test_a_long_night_fits_in_the_same_memory():
    night = Night()
    for number in range(3 * RECONSTRUCTORS_KEPT):
        made = replace(record(f"cm-{number}", MatrixState.REFUSED), created_ns_utc=night.now_ns)
        night.tell(ev.MatrixMade(record=made, wanted=False), 1.0)
        night.tell(ev.LogEvent(name="n", text=str(number)), 1.0)
    check_bounds(night.state)
    check_shelf(night.state)
    assert night.state.matrices.in_use == "initial"
