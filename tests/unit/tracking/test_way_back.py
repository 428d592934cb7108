"""There is always a way back: the RTC's own matrix is sent again as ours are, or the loop opens."""

from dataclasses import replace

import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import ProbationFinding, ProbationState, Verdict
from service.records.products import MatrixState
from service.records.state import Mode
from service.tracking.resume import restored
from service.tracking.update_policy import is_settled
from service.wire import Loop, LoopRequest
from tests.support.situations import POLICY, Story, foreign, loop_answered, moved, rtc

OWN_SUM, OUR_SUM = "a" * 64, "b" * 64
LAW = "gain 3 times the one in the status"


def found(before="initial", after="cm-1", *, verdict=Verdict.WORSE, lost=True):
    lost = lost and verdict is Verdict.WORSE
    text = "20 um instead of 37 nm"
    return ev.Compared(
        finding=ProbationFinding(verdict=verdict, before=before, after=after, text=text, lost=lost)
    )


def story(mode=Mode.AUTO, policy=POLICY):
    """The first matrix of ours has just taken the place of the RTC's own."""
    told = Story(mode, policy)
    own_shown(told)
    told.see(n_windows=3)
    told.make("cm-1", wanted=mode is not Mode.AUTO, sha256=OUR_SUM)
    told.acknowledge("cm-1")
    told.tell(replace(rtc(), cm_id="cm-1"), after_s=0.2)
    told.effects = []
    return told


def own_shown(told, **changes):
    """An RTC comes with a matrix of its own and shows it."""
    told.tell(ev.SessionStarted(session="s1"))
    told.tell(rtc(**changes))
    told.tell(ev.MatrixFetched(record=replace(foreign(), sha256=OWN_SUM)))
    told.tell(ev.Tick(), after_s=3)


def copied(told, name="cm-2", **changes):
    """The RTC's own numbers come under an id of ours: nobody has judged them."""
    values = {"alpha": None, "sigma": None, "gate": None, "judged": None, "parent": "initial"}
    return told.make(name, sha256=OWN_SUM, **(values | changes))


def gone_back(told):
    told.tell(found(), after_s=0.2)
    copied(told)
    told.acknowledge("cm-2")
    told.tell(replace(rtc(), cm_id="cm-2"), after_s=0.2)
    return told


def opened(told):
    return [r for r in told.asked(LoopRequest) if r.loop is Loop.OPEN]


def trial(told):
    return told.state.operations.probation


def alarm(told, name):
    return next(a for a in told.state.alarms.active if a.name == name)


def test_the_matrix_that_the_rtc_brought_is_gone_back_to_though_no_gate_has_judged_it():
    told = story()
    assert [e.source for e in told.tell(found()) if isinstance(e, ev.RepublishMatrix)] == [
        "initial"
    ]
    copied(told)
    assert [e.id for e in told.asked(ev.SendMatrix)] == ["cm-2"]
    told.acknowledge("cm-2")
    assert told.state.matrices.in_use == "cm-2"
    assert trial(told).rollback == "cm-2"
    assert told.matrix_state("cm-1") is MatrixState.FAILED


def test_it_has_its_own_number_of_modes():
    told = Story()
    told.tell(ev.SessionStarted(session="s1"))
    told.tell(rtc(300))
    told.tell(ev.MatrixFetched(record=replace(foreign(n_modes=300), sha256=OWN_SUM)))
    told.tell(ev.Tick(), after_s=3)
    told.see(n_windows=3)
    told.make("cm-1", sha256=OUR_SUM)
    told.acknowledge("cm-1")
    told.tell(replace(rtc(400), cm_id="cm-1"), after_s=0.2)
    told.effects = []
    told.tell(found())
    copied(told, n_modes=300)
    (sent,) = told.asked(ev.SendMatrix)
    assert (sent.n_modes, sum(gain > 0.0 for gain in sent.gains)) == (300, 300)


@pytest.mark.parametrize(
    "name",
    ["loop-law", "commands-off-loop", "matrix-mismatch", "response-mismatch", "loop-diverging"],
)
def test_what_came_with_the_worse_matrix_does_not_keep_it_in_use(name):
    told = story()
    told.tell(ev.ConditionChanged(name=name, text="it came with it"), after_s=0.1)
    told.tell(found())
    copied(told)
    assert [e.id for e in told.asked(ev.SendMatrix)] == ["cm-2"]


@pytest.mark.parametrize("name", ["loop-law", "commands-off-loop", "loop-diverging"])
def test_commands_that_no_longer_obey_after_a_swap_are_reason_enough(name):
    told = story()
    told.tell(ev.ConditionChanged(name=name, text=LAW), after_s=1.0)
    assert trial(told).state is ProbationState.ROLLING_BACK
    assert LAW in trial(told).text
    assert [e.source for e in told.asked(ev.RepublishMatrix)] == ["initial"]


def test_a_law_that_was_wrong_before_the_swap_is_not_the_matrixs_doing():
    told = story()
    told.tell(found(verdict=Verdict.AS_GOOD))
    told.tell(ev.ConditionChanged(name="loop-law", text=LAW), after_s=60.0)
    assert trial(told).state is ProbationState.PASSED


def test_after_going_back_the_loop_is_looked_at_once_more():
    told = gone_back(story())
    assert trial(told).state is ProbationState.WATCHED
    told.tell(found(after="cm-2", verdict=Verdict.AS_GOOD), after_s=1.0)
    assert trial(told).state is ProbationState.ROLLED_BACK
    assert opened(told) == []
    assert "probation" in told.alarms


def test_a_loop_that_is_lost_though_the_matrix_before_is_back_is_opened_in_auto():
    told = gone_back(story())
    told.tell(found(after="cm-2"), after_s=2.0)
    (request,) = opened(told)
    assert trial(told).state is ProbationState.OPENING
    told.tell(loop_answered(request.id, accepted=True))
    open_loop = replace(rtc(), cm_id="cm-2", loop=Loop.OPEN, gains=(0.0,) * 594)
    told.tell(open_loop, after_s=0.2)
    told.wait(20)
    assert trial(told).state is ProbationState.OPENED
    assert len(opened(told)) == 1
    assert "loop-opened" in told.alarms
    told.tell(replace(rtc(), cm_id="cm-2"), after_s=5)
    assert "loop-opened" not in told.alarms, "somebody has closed it again"


def test_one_that_goes_on_diverging_is_opened_before_telemetry_has_been_compared():
    told = story()
    told.tell(ev.ConditionChanged(name="loop-diverging", text="ten times"), after_s=0.1)
    gone_back(told)
    told.wait(1.5, every_s=0.5)
    assert len(opened(told)) == 1


@pytest.mark.parametrize("mode", [Mode.AUTO, Mode.PROPOSE])
def test_one_that_is_only_somewhat_worse_stays_closed(mode):
    """Open it would be far worse. In auto the service goes on: the swap was not the cause."""
    told = gone_back(story(mode))
    told.tell(found(after="cm-2", lost=False), after_s=2.0)
    assert opened(told) == []
    assert told.matrix_state("cm-1") is MatrixState.FAILED
    if mode is Mode.AUTO:
        assert trial(told).state is ProbationState.NOT_CONFIRMED
        assert (told.state.operator.mode, told.state.operator.settings_mode) == (mode, None)
        assert "probation" not in told.alarms
        assert not is_settled(told.state.alpha.registration)
        assert told.state.alpha.dither_due_since_ns_utc is not None
    else:
        assert trial(told).state is ProbationState.ROLLED_BACK
        assert told.state.operator.mode is Mode.HOLD
        assert "20 um" in alarm(told, "probation").text


ACQUIRES = replace(POLICY, acquires=True)


def acquires(told):
    return told.state.operations.acquisition.under_way


def test_a_loop_that_neither_matrix_holds_is_opened_and_acquired_again():
    """The mirror has jumped within seconds of the swap: neither matrix is to blame."""
    told = gone_back(story(policy=ACQUIRES))
    told.tell(found(after="cm-2"), after_s=2.0)
    assert acquires(told)
    assert len(opened(told)) == 1
    assert told.state.operator.mode is Mode.AUTO
    assert not told.alarms.intersection({"probation", "loop-opened"})
    told.wait(1)
    assert trial(told).state is ProbationState.NOT_CONFIRMED


def test_one_whose_alarm_lasts_though_the_matrix_before_is_back_is_acquired_again():
    told = story(policy=ACQUIRES)
    told.tell(ev.ConditionChanged(name="loop-diverging", text="ten times"), after_s=0.1)
    gone_back(told)
    told.wait(1.5, every_s=0.5)
    assert acquires(told)


@pytest.mark.parametrize("name", ["loop-law", "commands-off-loop"])
def test_commands_that_contradict_the_law_are_no_jump(name):
    """An RTC that does not apply the matrix would not apply the next one either."""
    told = story(policy=ACQUIRES)
    told.tell(ev.ConditionChanged(name=name, text=LAW), after_s=1.0)
    copied(told)
    told.acknowledge("cm-2")
    told.tell(replace(rtc(), cm_id="cm-2"), after_s=0.2)
    told.tell(found(after="cm-2"), after_s=2.0)
    assert not acquires(told)
    assert trial(told).state is ProbationState.OPENING
    assert told.state.operator.mode is Mode.HOLD


def test_an_operator_who_sets_a_mode_meanwhile_has_taken_over():
    told = gone_back(story(policy=ACQUIRES))
    told.tell(cmd.SetMode(mode=Mode.PROPOSE), after_s=0.1)
    told.tell(found(after="cm-2"), after_s=2.0)
    assert not acquires(told)
    assert told.state.operator.mode is Mode.PROPOSE


def test_one_who_does_so_while_the_loop_is_being_opened_has_taken_over():
    told = gone_back(story())
    told.tell(found(after="cm-2"), after_s=2.0)
    assert trial(told).state is ProbationState.OPENING
    told.tell(cmd.SetMode(mode=Mode.PROPOSE), after_s=0.1)
    assert trial(told).state is ProbationState.KEPT
    told.wait(20)
    assert len(opened(told)) == 1


@pytest.mark.parametrize(("after_s", "again"), [(60.0, False), (700.0, True)])
def test_the_service_goes_on_by_itself_once_in_ten_minutes(after_s, again):
    """A matrix that is wrong, and spoils the loop for the next one too, is not sent for ever."""
    told = gone_back(story())
    told.tell(found(after="cm-2", lost=False), after_s=2.0)
    told.wait(after_s, every_s=10.0)
    told.see(n_windows=3)
    told.make("cm-3", wanted=True, sha256="d" * 64)
    told.acknowledge("cm-3")
    told.tell(replace(rtc(), cm_id="cm-3"), after_s=0.2)
    told.tell(found(before="cm-2", after="cm-3", lost=False))
    assert trial(told).state is ProbationState.ROLLING_BACK
    copied(told, "cm-4")
    told.acknowledge("cm-4")
    told.tell(replace(rtc(), cm_id="cm-4"), after_s=0.2)
    told.tell(found(before="cm-2", after="cm-4", lost=False), after_s=2.0)
    assert (trial(told).state is ProbationState.NOT_CONFIRMED) == again
    assert (told.state.operator.mode is Mode.AUTO) == again


def test_a_jump_that_windows_have_shown_since_is_not_blamed_on_the_matrix():
    told = story()
    told.see(moved(shift_x_subap=0.3), n_windows=3, every_s=0.5)
    assert told.state.alpha.registration.jumped_ns_utc is not None
    told.tell(found(lost=False))
    assert trial(told).state is ProbationState.NOT_JUDGED
    assert told.state.operator.mode is Mode.AUTO
    assert told.asked(ev.RepublishMatrix) == []


def test_modes_that_a_good_matrix_has_held_stay_proven_when_fewer_are_controlled():
    told = story()
    told.tell(found(verdict=Verdict.AS_GOOD))
    assert told.state.matrices.mode_proof.proven >= frozenset(range(400))


def test_where_there_is_no_way_back_a_lost_loop_is_opened():
    told = story()
    (effect,) = (e for e in told.tell(found()) if isinstance(e, ev.RepublishMatrix))
    told.tell(ev.JobFailed(effect=effect, text="the disk is gone"))
    assert trial(told).state is ProbationState.OPENING
    assert len(opened(told)) == 1


@pytest.mark.parametrize("mode", [Mode.PROPOSE, Mode.HOLD])
def test_nothing_is_opened_unasked_but_in_auto(mode):
    told = gone_back(story(mode))
    told.tell(found(after="cm-2"), after_s=2.0)
    assert opened(told) == []


@pytest.mark.parametrize(("setting", "mode", "n"), [(True, Mode.PROPOSE, 1), (False, Mode.AUTO, 0)])
def test_a_setting_says_otherwise(setting, mode, n):
    told = gone_back(story(mode, replace(POLICY, opens_lost_loop=setting)))
    told.tell(found(after="cm-2"), after_s=2.0)
    assert len(opened(told)) == n


def test_an_opening_that_the_rtc_refuses_or_does_not_answer_is_asked_for_again_and_said():
    told = gone_back(story())
    told.tell(found(after="cm-2"), after_s=2.0)
    told.tell(loop_answered(opened(told)[0].id, accepted=False, reason="interlock"))
    assert "interlock" in alarm(told, "loop-opened").text
    told.wait(3)
    assert len(opened(told)) == 2


def unshown():
    """An RTC does not show the matrix that it uses."""
    told = Story()
    told.tell(ev.SessionStarted(session="s1"))
    told.tell(rtc())
    told.tell(ev.JobFailed(effect=ev.FetchMatrix(id="initial"), text="no answer"))
    told.tell(ev.Tick(), after_s=3)
    told.see(n_windows=3)
    return told


def test_in_auto_nothing_is_sent_before_the_matrix_in_use_could_be_sent_back():
    told = unshown()
    told.make("cm-1", sha256=OUR_SUM)
    assert told.asked(ev.SendMatrix) == []
    assert told.matrix_state("cm-1") is MatrixState.PROPOSED
    assert "reconstructor.kept-back" in told.logged
    told.tell(cmd.Approve(id="cm-1"))
    assert [e.id for e in told.asked(ev.SendMatrix)] == ["cm-1"]


def test_what_waits_for_an_operator_is_not_made_again():
    told = unshown()
    made = len(told.asked(ev.MakeMatrix))
    told.make("cm-1", sha256=OUR_SUM)
    told.wait(30)
    assert len(told.asked(ev.MakeMatrix)) == made


def test_once_a_matrix_of_ours_is_in_use_the_next_follows_by_itself():
    told = unshown()
    told.make("cm-1", wanted=True, sha256=OUR_SUM)
    told.acknowledge("cm-1")
    told.tell(replace(rtc(), cm_id="cm-1"), after_s=0.2)
    told.tell(found(before="initial", verdict=Verdict.UNKNOWN))
    told.make("cm-2", sha256="c" * 64)
    assert [e.id for e in told.asked(ev.SendMatrix)] == ["cm-1", "cm-2"]


def test_an_operator_can_go_back_to_the_rtcs_own_as_to_ours():
    told = story()
    told.tell(found(verdict=Verdict.AS_GOOD))
    told.tell(cmd.Rollback())
    assert [e.source for e in told.asked(ev.RepublishMatrix)] == ["initial"]
    copied(told)
    own, again = told.state.reconstructor("initial"), told.state.reconstructor("cm-2")
    assert own.origin == "the RTC's own"
    assert again.origin == "the RTC's own, initial sent again"
    assert told.state.reconstructor("cm-1").origin == "the service's"


def test_a_restarted_service_can_still_go_back_to_it():
    own = replace(foreign(), sha256=OWN_SUM)
    (kept,) = restored((own,))
    assert kept.id == "initial"
