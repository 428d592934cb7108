"""A matrix just applied is on probation: what makes the loop worse gives way, once."""

from dataclasses import replace

import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import ProbationFinding, ProbationState, Verdict
from service.records.products import MatrixState
from service.records.state import Mode
from tests.support.situations import Story, acknowledged, moved, rtc, verdict
from tests.support.states import changed

NUMBERS = "mode 30 moves 3.10 times as much"


def found(verdict=Verdict.WORSE, before="cm-1", after="cm-2"):
    return ev.Compared(
        finding=ProbationFinding(verdict=verdict, before=before, after=after, text=NUMBERS, mode=30)
    )


def story(mode=Mode.AUTO, after="cm-2"):
    """A night in which one matrix has passed and another one is just applied."""
    told = Story(mode).meet()
    told.see(n_windows=3)
    swap(told, "cm-1")
    if after:
        told.tell(found(Verdict.AS_GOOD, "initial", "cm-1"))
        swap(told, after)
    told.effects = []
    return told


def swap(told, name):
    told.make(name, wanted=True, sha256=name[-1] * 64)
    told.acknowledge(name)
    told.tell(replace(rtc(), cm_id=name), after_s=0.2)


def copied(told, name="cm-3", **changes):
    """The matrix before comes under a new id, with what was said of it."""
    source = told.state.reconstructor("cm-1")
    changes = {"judged": source.judged, "sha256": source.sha256, "parent": "cm-1"} | changes
    return told.make(name, wanted=False, **changes)


def trial(told):
    return told.state.operations.probation


def test_every_matrix_that_was_sent_is_on_probation_for_four_seconds():
    told = story()
    assert trial(told).state is ProbationState.RUNNING
    assert (trial(told).before, trial(told).id) == ("cm-1", "cm-2")
    assert trial(told).until_ns_utc - trial(told).since_ns_utc == 4_000_000_000
    told.tell(found(Verdict.AS_GOOD))
    assert (trial(told).state, trial(told).text) == (ProbationState.PASSED, NUMBERS)
    assert told.state.operator.mode is Mode.AUTO
    assert "probation" not in told.alarms


def test_one_that_makes_the_loop_worse_gives_way_to_the_one_before():
    told = story()
    assert told.tell(found()) == (ev.RepublishMatrix(source="cm-1", why=WHY, judged=False),)
    assert told.state.operator.mode is Mode.HOLD
    assert told.state.operator.settings_mode is Mode.AUTO
    (alarm,) = (a for a in told.state.alarms.active if a.name == "probation")
    assert NUMBERS in alarm.text
    copied(told)
    assert told.asked(ev.SendMatrix) == [ev.SendMatrix(id="cm-3", n_modes=400, gains=None)]
    told.acknowledge("cm-3")
    assert (trial(told).state, trial(told).rollback) == (ProbationState.WATCHED, "cm-3")
    assert told.state.matrices.in_use == "cm-3"
    assert told.matrix_state("cm-2") is MatrixState.FAILED
    assert told.state.previous != "cm-2", "an operator's rollback would use it again"
    told.tell(found(Verdict.AS_GOOD, after="cm-3"))
    assert trial(told).state is ProbationState.ROLLED_BACK
    assert "probation" in told.alarms
    assert "probation.rolled-back" in told.logged


WHY = "the service goes back to cm-1: cm-2 made the loop worse"


def test_it_happens_once_whatever_is_told_again():
    told = story()
    told.tell(found())
    told.tell(found())
    copied(told)
    copied(told, "cm-4")
    told.tell(found())
    told.acknowledge("cm-3")
    told.tell(found())
    told.tell(found(before="cm-2", after="cm-3"))
    told.wait(20)
    assert len(told.asked(ev.RepublishMatrix)) == 1
    assert [effect.id for effect in told.asked(ev.SendMatrix)] == ["cm-3"]


def test_the_alpha_that_it_was_made_for_is_not_asked_of_the_matrix_before():
    """α may be what is wrong: the loop vouches for the matrix before, not the gate at that α."""
    told = story()
    told.see(moved(shift_x_subap=0.02), n_windows=2)
    told.effects = []
    told.tell(found())
    copied(told)
    assert told.asked(ev.JudgeProposal) == []
    assert [effect.id for effect in told.asked(ev.SendMatrix)] == ["cm-3"]


def test_one_that_was_being_made_is_not_taken_for_the_way_back():
    told = story()
    told.tell(found())
    told.make("cm-7", wanted=False, sha256="7" * 64, parent="cm-1")
    assert told.asked(ev.SendMatrix) == []
    copied(told)
    assert [effect.id for effect in told.asked(ev.SendMatrix)] == ["cm-3"]


@pytest.mark.parametrize(
    ("obstacle", "text"),
    [
        (cmd.StopEverything(by="ann"), "everything was stopped by ann"),
        (ev.ConditionChanged(name="second-rtc", text="two RTCs"), "two RTCs"),
        (replace(rtc(300), cm_id="cm-2", leak=0.99), "the loop has been changed since"),
        (ev.RtcVanished(), ""),
    ],
)
@pytest.mark.parametrize("late", [False, True])
def test_nothing_is_sent_where_something_forbids_it(obstacle, text, late):
    told = story()
    for event in (found(), obstacle) if late else (obstacle, found()):
        told.tell(event)
    if late:
        copied(told)
    told.wait(10)
    assert told.asked(ev.SendMatrix) == []
    if text:
        assert trial(told).state is ProbationState.KEPT
        assert text in trial(told).text
        assert [a.name for a in told.state.alarms.active].count("probation") == 1


def test_one_whose_numbers_the_rtc_has_not_shown_is_not_gone_back_to():
    told = story(after="")
    told.state = changed(told.state, verified_ids=frozenset({"cm-1"}))
    told.tell(found(before="initial", after="cm-1"))
    assert trial(told).state is ProbationState.KEPT
    assert told.asked(ev.RepublishMatrix) == []
    assert told.state.operator.mode is Mode.HOLD


def test_what_the_gate_says_of_the_matrix_before_by_now_is_not_asked():
    """α may be what is wrong, and the loop held with it until a moment ago."""
    told = story()
    told.tell(ev.MarginJudged(id="cm-1", verdict=verdict(accepted=False)))
    told.tell(found())
    copied(told, gate=None, judged=None)
    assert [effect.id for effect in told.asked(ev.SendMatrix)] == ["cm-3"]


def test_while_it_runs_nothing_is_made_or_sent_unasked():
    told = story()
    told.see(moved(shift_x_subap=0.05), n_windows=2, every_s=0.5)
    told.wait(1)
    told.make("cm-5", wanted=False)
    assert told.asked(ev.MakeMatrix) == []
    assert told.asked(ev.SendMatrix) == []


def test_an_operator_who_wants_it_all_the_same_gets_it():
    told = story()
    told.tell(found())
    copied(told)
    told.acknowledge("cm-3")
    told.make("cm-6", wanted=True, sha256="2" * 64)
    told.acknowledge("cm-6")
    assert trial(told).state is ProbationState.NOT_JUDGED
    told.tell(found(before="cm-3", after="cm-6"))
    assert len(told.asked(ev.RepublishMatrix)) == 1


def test_telemetry_that_comes_late_counts_when_it_comes():
    told = story()
    told.wait(8)
    assert trial(told).state is ProbationState.OVERDUE
    told.tell(found())
    assert trial(told).state is ProbationState.ROLLING_BACK


@pytest.mark.parametrize(
    "event",
    [
        replace(rtc(), cm_id="cm-2", loop="open", gains=(0.0,) * 594),
        ev.SessionStarted(session="s2"),
        ev.RtcVanished(),
    ],
)
def test_a_loop_that_opens_or_goes_is_not_judged(event):
    told = story()
    told.tell(event)
    assert trial(told).state is ProbationState.NOT_JUDGED
    told.tell(found())
    assert told.asked(ev.RepublishMatrix) == []
    assert told.state.operator.mode is Mode.AUTO


def test_a_copy_that_fails_or_that_the_rtc_rejects_is_said_to_have_failed():
    told = story()
    (effect,) = told.tell(found())
    told.tell(ev.JobFailed(effect=effect, text="the disk is full"))
    assert trial(told).state is ProbationState.KEPT
    told = story()
    told.tell(found())
    copied(told)
    told.tell(acknowledged("cm-3", state="rejected", reason="shape"))
    assert "shape" in trial(told).text


def test_a_mode_that_an_operator_orders_ends_the_alarm():
    told = story()
    told.tell(found())
    copied(told)
    told.acknowledge("cm-3")
    told.tell(cmd.SetMode(mode=Mode.AUTO))
    assert "probation" not in told.alarms


def test_what_the_rtc_takes_by_itself_is_its_own_affair():
    told = story()
    told.tell(found(Verdict.AS_GOOD))
    told.tell(replace(rtc(), cm_id="own"))
    told.tell(ev.MatrixFetched(record=replace(told.state.reconstructor("initial"), id="own")))
    assert (trial(told).id, trial(told).state) == ("own", ProbationState.NOT_JUDGED)
