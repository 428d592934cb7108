"""Operators' own rules: what holds forbids, and what nobody tells is not known."""

from dataclasses import replace

import pytest

from service.config import load_settings
from service.config.settings import STATE_FIELDS
from service.errors import CommandError, ConfigurationError, UnknownIdError
from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import Interlock, Severity, blocking_alarm
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.tracker import step
from service.tracking.alarm_rules import FIELDS, changes_value
from tests.support.states import tracker_state

SHUTTER = """
[[rules]]
name = "shutter"
when = ["shutter_open", "==", false]
blocks = ["decide", "send_new", "send_known"]
severity = "critical"
text = "the shutter is shut: nothing is published"
"""
LOW = """
[[rules]]
name = "low"
when = ["state.elevation_deg", "<", 30]
text = "the telescope looks low"
severity = "warning"
unknown = "does-not-hold"
"""
SECOND = 10**9


@pytest.fixture
def settings(tmp_path):
    def read(text):
        path = tmp_path / "pyrcal.toml"
        path.write_text(text)
        return load_settings(path, {})

    return read


class Night:
    """A tracker with rules, without an RTC."""

    def __init__(self, policy):
        self.policy, self.now_ns = policy, 10 * SECOND
        self.state = tracker_state(system="small", mode=Mode.AUTO)
        self.tell(ev.Tick())

    def tell(self, event, after_s=0.0):
        self.now_ns += round(after_s * SECOND)
        self.state, _ = step(self.state, event, self.policy, self.now_ns)

    @property
    def alarms(self):
        return {alarm.name: alarm for alarm in self.state.alarms.active}


@pytest.fixture
def night(settings):
    return Night(policy_of(settings(SHUTTER + LOW)))


def test_a_rule_holds_while_its_value_is_told_so_and_while_nobody_tells_it(night):
    alarm = night.alarms["rule.shutter"]
    assert alarm.text.endswith("nothing is published (shutter_open is not known)")
    assert alarm.definition.severity is Severity.CRITICAL
    assert blocking_alarm(night.state.alarms.active, Interlock.SEND_KNOWN) is alarm
    assert blocking_alarm(night.state.alarms.active, Interlock.MEASURE) is None
    night.tell(cmd.SetValue(name="shutter_open", value=True, for_s=30.0, by="dome"))
    assert "rule.shutter" not in night.alarms
    assert blocking_alarm(night.state.alarms.active, Interlock.SEND_NEW) is None
    night.tell(cmd.SetValue(name="shutter_open", value=False))
    assert night.alarms["rule.shutter"].text.endswith("(shutter_open is false)")
    night.tell(cmd.SetValue(name="shutter_open", value=True, for_s=30.0))
    night.tell(ev.Tick(), after_s=29.0)
    assert "rule.shutter" not in night.alarms
    night.tell(ev.Tick(), after_s=1.5)
    assert night.alarms["rule.shutter"].text.endswith("(shutter_open is not known)")


def test_a_field_of_the_state_is_compared_as_it_is_now(night):
    assert "rule.low" not in night.alarms
    night.tell(cmd.SetPointing(elevation_deg=29.0, azimuth_deg=0.0))
    assert night.alarms["rule.low"].text == "the telescope looks low (state.elevation_deg is 29.0)"
    assert night.alarms["rule.low"].definition.blocks == frozenset()
    night.tell(cmd.SetPointing(elevation_deg=31.0, azimuth_deg=0.0))
    assert "rule.low" not in night.alarms


def test_a_rules_alarm_is_acknowledged_and_muted_like_others(night):
    night.tell(cmd.AcknowledgeAlarm(name="rule.shutter", by="Ada"))
    night.tell(cmd.MuteAlarm(name="rule.low", for_s=60.0))
    notes = {note.name: note for note in night.state.alarms.records}
    assert notes["rule.shutter"].acknowledged.by == "Ada"
    assert notes["rule.low"].muted is not None


def test_a_rule_that_goes_on_to_hold_is_no_news(night):
    before = night.state.alarms.active
    night.tell(ev.Tick(), after_s=1.0)
    assert night.state.alarms.active is before


def test_what_no_rule_asks_for_or_compares_otherwise_is_refused(night):
    with pytest.raises(UnknownIdError, match="did you mean shutter_open"):
        night.tell(cmd.SetValue(name="shuter_open", value=True))
    with pytest.raises(UnknownIdError, match="known: shutter_open"):
        night.tell(cmd.SetValue(name="state.elevation_deg", value=80.0))
    with pytest.raises(CommandError, match=r"found 1\.0, expected true or false: rule shutter"):
        night.tell(cmd.SetValue(name="shutter_open", value=1.0))
    with pytest.raises(ValueError, match="at most 200 characters"):
        cmd.SetValue(name="shutter_open", value="x" * 201)


def test_only_what_differs_from_what_is_known_is_news(night):
    told = cmd.SetValue(name="shutter_open", value=True, for_s=10.0)
    assert changes_value(night.state, told, night.now_ns)
    night.tell(told)
    assert not changes_value(night.state, told, night.now_ns)
    assert changes_value(night.state, replace(told, value=False), night.now_ns)
    assert changes_value(night.state, told, night.now_ns + 11 * SECOND)


def test_the_settings_know_every_field_there_is():
    assert set(FIELDS) == set(STATE_FIELDS)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (('"shutter_open"', '"state.lop"'), "found 'state.lop' in when, did you mean state.loop?"),
        (('"=="', '"<"'), "found False after <, expected a number"),
        (('"=="', '"is"'), "rules.0.when.1: found 'is', expected '==', '!='"),
        (("blocks", "block"), "rules.0.block: unknown key, did you mean blocks?"),
        (('"decide"', '"hold"'), "rules.0.blocks.0: found 'hold', expected 'measure', 'decide'"),
        (('"critical"', '"bad"'), "rules.0.severity: found 'bad', expected 'warning', 'serious'"),
        (('name = "shutter"', ""), "rules.0.name: missing, this key is mandatory"),
        (('["shutter_open", "==", false]', '"shutter"'), "rules.0.when: found 'shutter', expected"),
    ],
)
def test_a_mistake_in_the_file_is_said_in_a_line(settings, change, expected):
    with pytest.raises(ConfigurationError) as refused:
        settings(SHUTTER.replace(*change))
    assert expected in str(refused.value)
    assert "\n" not in str(refused.value)


def test_rules_of_one_name_or_of_two_minds_are_refused(settings):
    with pytest.raises(ConfigurationError, match="found rules shutter twice"):
        settings(SHUTTER + SHUTTER)
    other = SHUTTER.replace('"shutter"', '"other"').replace("false", "3.0")
    with pytest.raises(ConfigurationError, match=r"found 3\.0 for shutter_open: another rule"):
        settings(SHUTTER + other)


def test_rules_are_no_section_of_the_environment():
    with pytest.raises(ConfigurationError, match="unknown section rules"):
        load_settings(None, {"PYRCAL_RULES__NAME": "x"})
