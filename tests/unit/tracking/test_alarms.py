"""What each alarm forbids, seen from outside: told to the tracker, whatever it is doing."""

import ast
import re
from dataclasses import replace
from pathlib import Path

import pytest

import service
from service.archive.serialisation import TrackingFile
from service.errors import CommandError, UnknownIdError
from service.records import alarms
from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import (
    ALARMS,
    AlarmDefinition,
    AlarmState,
    Interlock,
    Severity,
    blocking_alarm,
)
from service.records.estimates import RefusalKind, WindowRefused
from service.records.products import MatrixState
from service.records.state import Mode, TrackerState
from service.tracking.alarm_records import muted_records, stale_records, worst_severity
from service.tracking.alarm_rules import LASTING, RULES
from service.tracking.interlocks import permitted
from service.tracking.resume import resumed, saved_of
from service.wire import DitherRequest, LoopRequest
from tests.support.situations import POLICY, Story, judged, of_kind, record, verdict

STRANGERS = ["second-rtc", "basis-mismatch", "instrument-mismatch"]
OUT_OF_HAND = ["loop-diverging", "edge-slip", "commands-off-loop"]

MISTOLD = ["matrix-mismatch", "response-mismatch", "loop-law", "command-unit"]

NAMES = {
    constant: name
    for constant, name in vars(alarms).items()
    if constant.isupper() and constant not in {"ALARMS", "RULE_PREFIX"}
}
SERVICE = Path(service.__file__).parent


def raised_in(path):
    """The constants of the alarms that a file raises or reports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        match node:
            case ast.Call(func=ast.Attribute(attr="raise_alarm"), args=[name, *_]):
                found.add(ast.unparse(name).rpartition(".")[2])
            case ast.Call(func=ast.Attribute(attr="ConditionChanged"), keywords=[name, *_]):
                found.add(ast.unparse(name.value).rpartition(".")[2])
            case _:
                continue
    return found


FORBIDDING = pytest.mark.parametrize("name", [*STRANGERS, *OUT_OF_HAND])


def settled(name, **story):
    """A night on which α is known, and then an alarm."""
    told = Story(Mode.AUTO, **story).meet()
    told.see(n_windows=3)
    told.effects.clear()
    told.tell(ev.ConditionChanged(name=name, text="found"))
    return told


def made(story, matrix_id="cm-1", **changes):
    known = story.state.alpha.registration
    return record(matrix_id, **({"judged": judged(known, story.state.loop.rtc)} | changes))


@FORBIDDING
def test_no_window_under_it_is_a_measurement(name):
    story = settled(name)
    before = story.state.windows.accepted
    story.see(n_windows=3)
    assert story.state.windows.accepted == before
    assert story.state.windows.refused == 3


@FORBIDDING
def test_nothing_is_made_or_sent_under_it_that_nobody_asked_for(name):
    story = settled(name)
    story.wait(6)
    story.tell(ev.MatrixMade(record=made(story), wanted=False))
    story.wait(6)
    assert not of_kind(story.effects, ev.SendMatrix | ev.MakeMatrix | DitherRequest)
    assert story.matrix_state("cm-1") is MatrixState.PROPOSED


@FORBIDDING
def test_one_that_is_being_judged_when_it_comes_is_not_sent_either(name):
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=3)
    of_old = replace(made(story).judged, leak=0.9)
    effects = story.tell(ev.MatrixMade(record=made(story, judged=of_old), wanted=False))
    (asked,) = of_kind(effects, ev.JudgeProposal)
    story.tell(ev.ConditionChanged(name=name, text="found"))
    now = judged(story.state.alpha.registration, story.state.loop.rtc)
    passed = ev.ProposalJudged(id="cm-1", verdict=made(story).gate, judged=now, wanted=asked.wanted)
    assert not of_kind(story.tell(passed), ev.SendMatrix)
    assert story.matrix_state("cm-1") is MatrixState.PROPOSED
    assert name in story.state.log[-1].text or "found" in story.state.log[-1].text


@pytest.mark.parametrize("name", OUT_OF_HAND)
def test_an_operator_may_mend_a_loop_that_is_out_of_hand_with_another_matrix(name):
    story = settled(name)
    assert of_kind(story.tell(ev.MatrixMade(record=made(story), wanted=True)), ev.SendMatrix)


@pytest.mark.parametrize("name", STRANGERS)
def test_not_even_an_operator_sends_to_an_rtc_that_may_be_another(name):
    story = settled(name)
    story.tell(ev.MatrixMade(record=made(story), wanted=True))
    with pytest.raises(CommandError, match="found"):
        story.tell(cmd.Approve(id="cm-1"))
    assert not story.asked(ev.SendMatrix)


def test_where_only_new_matrices_are_forbidden_one_that_was_in_use_may_come_back(monkeypatch):
    forbids = frozenset({Interlock.DECIDE, Interlock.SEND_NEW})
    because = "the model was wrong"
    kind = AlarmDefinition(
        severity=Severity.SERIOUS, means="-", do="-", blocks=forbids, because=because
    )
    monkeypatch.setitem(ALARMS, "wrong-model", kind)
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=3)
    story.make("cm-1", wanted=True, sha256="1" * 64)
    story.acknowledge("cm-1")
    story.use("cm-2")
    story.tell(ev.ConditionChanged(name="wrong-model", text="found"))
    story.effects.clear()
    story.tell(ev.MatrixMade(record=made(story, "cm-3", sha256="3" * 64), wanted=True))
    assert not story.asked(ev.SendMatrix)
    story.tell(ev.MatrixMade(record=made(story, "cm-4", sha256="1" * 64), wanted=True))
    assert [sent.id for sent in story.asked(ev.SendMatrix)] == ["cm-4"]


def test_every_alarm_is_in_the_table_and_says_what_it_refuses():
    assert {*NAMES.values()} | set(RULES) == set(ALARMS)
    for name, kind in ALARMS.items():
        assert bool(kind.because) == bool(kind.blocks), name


def test_every_alarm_is_found_in_the_file_that_the_table_says_and_nowhere_else():
    """One that follows from the state has a rule; one that an event raises is named there."""
    by_rule = {name for name, kind in ALARMS.items() if kind.origin == "tracking/alarm_rules.py"}
    assert by_rule == set(RULES)
    assert not by_rule & set(LASTING)
    for constant, name in NAMES.items():
        source = SERVICE / ALARMS[name].origin
        assert re.search(rf"\b{constant}\b", source.read_text(encoding="utf-8")), name
    for path in SERVICE.rglob("*.py"):
        # the tracker says besides what the dither that told of it has come to
        for constant in raised_in(path) & set(NAMES) - {"MIRROR_SILENT"}:
            assert ALARMS[NAMES[constant]].origin == str(path.relative_to(SERVICE)), constant


def test_what_raises_an_alarm_is_seen():
    assert raised_in(SERVICE / "tracking" / "rtc.py") >= {"VANISHED", "STANDING_BY"}


def test_a_name_that_is_in_no_table_forbids_nothing():
    story = settled("margin")
    assert of_kind(story.tell(ev.MatrixMade(record=made(story), wanted=False)), ev.SendMatrix)


@pytest.mark.parametrize("name", MISTOLD)
def test_no_loop_is_opened_for_what_is_only_told_wrongly(name):
    story = settled(name)
    story.wait(60)
    assert not of_kind(story.effects, LoopRequest)


@pytest.mark.parametrize("name", MISTOLD)
def test_while_slopes_are_not_as_told_nothing_is_made_or_sent_whoever_wants_it(name):
    story = settled(name)
    story.wait(6)
    story.tell(ev.MatrixMade(record=made(story), wanted=False))
    story.tell(ev.MatrixMade(record=made(story, "cm-2"), wanted=True))
    with pytest.raises(CommandError, match="cm-2 cannot be sent: found"):
        story.tell(cmd.Approve(id="cm-2"))
    story.wait(6)
    assert not of_kind(story.effects, ev.SendMatrix | ev.MakeMatrix)


def test_no_dither_is_played_that_nothing_would_be_measured_with():
    story = settled("matrix-mismatch")
    story.wait(30)
    assert not of_kind(story.effects, DitherRequest)


def test_a_window_that_is_as_it_should_be_ends_the_alarm_of_one_that_was_not():
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=3)
    wrong = WindowRefused(
        reason="slopes have the other sign", t_ns_utc=story.now_ns, kind=RefusalKind.MISDESCRIBED
    )
    story.tell(ev.WindowLost(refused=wrong))
    assert "response-mismatch" in story.alarms
    story.see(n_windows=1)
    assert "response-mismatch" not in story.alarms


# --- acknowledged, muted, gone unseen: what operators do about alarms, told to the tracker


ADA = {"by": "Ada", "reason": "seen"}


@pytest.fixture
def story():
    told = Story().meet()
    told.tell(ev.Tick())
    return told


def raised(story, name, *, over=False):
    story.tell(ev.ConditionChanged(name=name, text=f"{name} found", over=over))


def note(story, name):
    return next((note for note in story.state.alarms.records if note.name == name), None)


def restarted(story, tmp_path):
    """What the next service knows, of what was left on the disk."""
    file = TrackingFile(tmp_path / "tracking.json")
    file.write(saved_of(story.state, story.now_ns))
    again = Story()
    again.state = resumed(TrackerState(system="small"), file.read(), POLICY, story.now_ns)
    again.now_ns = story.now_ns
    return again


@pytest.fixture
def small(story):
    story.state = replace(story.state, system="small")
    return story


def test_one_that_goes_unseen_is_stale_until_somebody_has_seen_it(story):
    raised(story, "edge-slip")
    assert note(story, "edge-slip").alarm_state is AlarmState.ACTIVE
    raised(story, "edge-slip", over=True)
    (left,) = stale_records(story.state)
    assert (left.text, left.worst) == ("edge-slip found", Severity.CRITICAL)
    assert left.over_ns_utc == story.now_ns
    story.wait(20)
    assert stale_records(story.state) == (left,)
    story.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))
    assert note(story, "edge-slip") is None
    assert story.state.log[-1].text == "edge-slip by Ada (seen)"


def test_one_that_is_acknowledged_stays_while_it_lasts_and_is_then_done_with(story):
    raised(story, "edge-slip")
    story.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))
    assert "edge-slip" in story.alarms
    seen = note(story, "edge-slip").acknowledged
    assert (seen.by, seen.reason, seen.t_ns_utc) == ("Ada", "seen", story.now_ns)
    raised(story, "edge-slip")
    assert note(story, "edge-slip").alarm_state is AlarmState.ACKNOWLEDGED
    raised(story, "edge-slip", over=True)
    assert story.state.alarms.records == ()
    raised(story, "edge-slip")
    assert note(story, "edge-slip").alarm_state is AlarmState.ACTIVE


def test_the_worst_is_kept_and_what_becomes_worse_is_acknowledged_again(story):
    story.see(n_windows=2)
    story.use("cm-1")

    def margin(radius):
        found = verdict(accepted=False, radius=radius)
        story.tell(ev.MarginJudged(id="cm-1", verdict=found, judged=judged_now(story)))

    margin(0.97)
    assert note(story, "margin").worst is Severity.SERIOUS
    story.tell(cmd.AcknowledgeAlarm(name="margin", severity=Severity.SERIOUS, **ADA))
    margin(1.02)
    assert note(story, "margin").alarm_state is AlarmState.ACTIVE
    margin(0.97)
    assert note(story, "margin").worst is worst_severity(story.state) is Severity.CRITICAL
    assert (
        next(a for a in story.state.alarms.active if a.name == "margin").definition
        is ALARMS["margin"]
    )
    with pytest.raises(CommandError, match="margin has been critical, and serious was seen"):
        story.tell(cmd.AcknowledgeAlarm(name="margin", severity=Severity.SERIOUS))
    story.tell(cmd.AcknowledgeAlarm(name="margin", severity=Severity.CRITICAL))


def judged_now(story):
    return judged(story.state.alpha.registration, story.state.loop.rtc)


def test_what_an_operators_order_ends_has_been_seen(story):
    story.tell(cmd.StopEverything())
    story.tell(cmd.Resume(**ADA))
    assert story.state.alarms.records == ()


def test_what_makes_no_sense_is_refused_in_a_sentence(story):
    with pytest.raises(UnknownIdError, match="unknown alarm nonsense"):
        story.tell(cmd.AcknowledgeAlarm(name="nonsense"))
    with pytest.raises(CommandError, match="edge-slip neither lasts nor is stale"):
        story.tell(cmd.AcknowledgeAlarm(name="edge-slip"))
    with pytest.raises(CommandError, match="edge-slip is not muted"):
        story.tell(cmd.UnmuteAlarm(name="edge-slip"))
    raised(story, "edge-slip")
    story.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))
    with pytest.raises(CommandError, match="edge-slip was acknowledged by Ada"):
        story.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))


def test_a_muted_one_forbids_what_it_forbids_and_comes_back_by_itself(story):
    story.tell(cmd.MuteAlarm(name="matrix-mismatch", for_s=60.0, **ADA))
    raised(story, "matrix-mismatch")
    (quiet,) = muted_records(story.state)
    assert (quiet.name, quiet.alarm_state) == ("matrix-mismatch", AlarmState.ACTIVE)
    assert blocking_alarm(story.state.alarms.active, Interlock.SEND_NEW).name == "matrix-mismatch"
    story.wait(61)
    assert muted_records(story.state) == ()
    assert note(story, "matrix-mismatch").alarm_state is AlarmState.ACTIVE


def test_one_muted_before_it_comes_can_be_unmuted(story):
    story.tell(cmd.MuteAlarm(name="rtc-vanished", for_s=60.0))
    story.tell(cmd.UnmuteAlarm(name="rtc-vanished"))
    assert story.state.alarms.records == ()


def test_a_restart_changes_nothing_of_what_was_seen_and_what_was_not(small, tmp_path):
    for name in ("edge-slip", "frames-lost", "disk-low"):
        raised(small, name)
    raised(small, "disk-low", over=True)
    small.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))
    small.tell(cmd.MuteAlarm(name="second-rtc", for_s=3600.0, **ADA))
    again = restarted(small, tmp_path)
    assert {left.name for left in stale_records(again.state)} == {"disk-low", "frames-lost"}
    assert [quiet.name for quiet in muted_records(again.state)] == ["second-rtc"]
    raised(again, "edge-slip")
    assert note(again, "edge-slip").alarm_state is AlarmState.ACKNOWLEDGED
    raised(again, "frames-lost")
    assert note(again, "frames-lost").alarm_state is AlarmState.ACTIVE


def test_what_was_acknowledged_and_is_not_raised_again_after_a_restart_is_over(small, tmp_path):
    raised(small, "edge-slip")
    small.tell(cmd.AcknowledgeAlarm(name="edge-slip", **ADA))
    again = restarted(small, tmp_path)
    again.wait(30)
    assert note(again, "edge-slip") is not None
    again.wait(40)
    assert note(again, "edge-slip") is None


def test_what_lasts_without_news_costs_the_disk_nothing(story):
    raised(story, "frames-unused")
    before = story.state.alarms.records
    for k in range(5):
        story.tell(ev.ConditionChanged(name="frames-unused", text=f"{k} frames"))
        story.wait(1)
    assert story.state.alarms.records is before


REMEDIES = {
    "Open the loop": cmd.SetLoop(loop="open"),
    "lower the gain": cmd.SetLoop(gains=(cmd.GainGroup(first=0, last=9, gain=0.1),)),
    "dither stop": cmd.StopDither,
    "loop acquire": cmd.Acquire,
    "loop close": cmd.SetLoop(loop="closed"),
    "reconstructors approve": cmd.Approve,
    "reconstructors publish": cmd.Publish,
    "pyrcal resume": cmd.Resume,
    "Setting another mode": cmd.SetMode(mode=Mode.PROPOSE),
}
"""Orders that remedies ask for, by their words."""


@pytest.mark.parametrize("name", ALARMS)
def test_what_an_alarm_asks_for_may_be_ordered_while_it_lasts(name):
    story = Story(Mode.HOLD).meet()
    story.see(n_windows=2)
    story.use("cm-1")
    story.make("cm-2")
    story.tell(cmd.StopEverything() if name == "stopped" else of_alarm(name))
    for words, order in REMEDIES.items():
        if words in ALARMS[name].do:
            allowed = permitted(story.state, order, story.policy, story.now_ns)
            assert allowed.allowed, (words, allowed.reason)


def of_alarm(name):
    return ev.ConditionChanged(name=name, text="it is so")
