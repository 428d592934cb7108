"""What each alarm forbids, seen from outside: told to the tracker, whatever it is doing."""

import ast
import re
from dataclasses import replace
from pathlib import Path

import pytest

import service
from service.errors import CommandError
from service.estimation.windows import RefusalKind, WindowRefused
from service.tracking import alarms
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.alarm_rules import LASTING, RULES
from service.tracking.alarms import ALARMS, AlarmDefinition, Interlock, Severity
from service.tracking.products import MatrixState
from service.tracking.state import Mode
from service.wire import DitherRequest, LoopRequest
from tests.unit.tracking.situations import Story, judged, of_kind, record

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
        reason="slopes have the other sign", t_ns_utc=story.now_ns, kind=RefusalKind.MISTOLD
    )
    story.tell(ev.WindowLost(refused=wrong))
    assert "response-mismatch" in story.alarms
    story.see(n_windows=1)
    assert "response-mismatch" not in story.alarms
