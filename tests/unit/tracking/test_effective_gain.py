"""Loop gains by the table of optical gains, when an operator asks for them."""

from dataclasses import replace

import numpy as np
import pytest

from service.control.gains import ModeGain, gain_table
from service.errors import CommandError
from service.tracking import commands as cmd
from service.tracking.state import Mode
from service.wire import LoopRequest
from tests.states import changed
from tests.unit.tracking.situations import N_MODES, START_NS, Story, of_kind

MEASURED = tuple(
    ModeGain(mode=mode, gain=0.7, sigma=0.01, scatter=0.02, t_ns_utc=START_NS)
    for mode in (509, 527, 545, 563)
)


@pytest.fixture
def story():
    story = Story(Mode.HOLD).meet()
    story.see(n_windows=2)
    known = replace(story.state.alpha.registration, optical_gains=MEASURED)
    story.state = changed(story.state, registration=known)
    return story


def test_they_act_alike_on_every_controlled_mode_and_the_gate_is_asked(story):
    (effect,) = story.tell(cmd.SetLoop(effective_gain=0.3))
    assert effect.judged
    asked = effect.request
    assert len(asked.gains) == N_MODES
    in_effect = np.array(asked.gains[:400]) * gain_table(MEASURED, 400).optical_gain
    np.testing.assert_allclose(in_effect, 0.3, rtol=1e-12)
    assert set(asked.gains[400:]) == {0.0}
    assert "gain 0.3 in effect on every mode, by the gain table" in story.state.loop.command.text


def test_asked_twice_they_are_the_same(story):
    (first,) = of_kind(story.tell(cmd.SetLoop(effective_gain=0.3)), LoopRequest)
    story.now_ns += 1
    (second,) = of_kind(story.tell(cmd.SetLoop(effective_gain=0.3)), LoopRequest)
    assert first.gains == second.gains


def test_gains_an_operator_names_are_his_own_business(story):
    groups = (cmd.GainGroup(first=0, last=1, gain=0.5),)
    (asked,) = story.tell(cmd.SetLoop(gains=groups))
    assert not asked.judged


def test_without_a_measured_gain_there_is_nothing_to_undo():
    with pytest.raises(CommandError, match="no optical gain is measured yet; start a dither"):
        Story(Mode.HOLD).meet().tell(cmd.SetLoop(effective_gain=0.3))


def test_the_service_never_sets_them_by_itself():
    story = Story(Mode.AUTO).meet()
    story.see(n_windows=30)
    story.wait(60)
    assert not story.asked(LoopRequest)
