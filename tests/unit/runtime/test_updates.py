"""Updates on a real worker and archive: fewer modes, what is won, gains beside the matrix."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from scipy.optimize import brentq

from service.control.gate import MAX_EDGE_MOTION_M, MAX_HELD_EDGE_MOTION_M
from service.control.loop import ControlLoop
from service.errors import CommandError
from service.model.misregistration import Misregistration
from service.records import events as ev
from service.records.alarms import Alarm
from service.records.messages import as_message
from service.records.products import MatrixState
from service.records.registration import ModeGain
from service.runtime.actions import (
    GAIN_SAFETY,
    expected_gains,
    loop_to_judge,
    modes_that_hold,
)
from service.runtime.worker import OpticsWorker
from service.tracking.update_policy import fewer_modes_than
from service.wire import LoopRequest
from tests.support.handmade import N_MODES, REGISTRATION, STATE
from tests.support.situations import START_NS, rtc
from tests.support.small import COMPUTE, N_CONTROLLED, SIGMA, conditions, small_instrument
from tests.support.states import changed

pytestmark = pytest.mark.timeout(60)

MEASURED = tuple(
    ModeGain(mode=mode, gain=gain, sigma=0.01, scatter=0.02, t_ns_utc=START_NS)
    for mode, gain in ((60, 0.55), (70, 0.56), (80, 0.57))
)


def loop_of(gain):
    return rtc(
        N_CONTROLLED,
        n_modes=N_MODES,
        gains=(gain,) * N_CONTROLLED + (0.0,) * (N_MODES - N_CONTROLLED),
    )


def unsure(by):
    """A registration so uncertain that many modes have no margin."""
    return replace(REGISTRATION, covariance=np.diag(np.array([by, by, by / 10, by / 10]) ** 2))


async def make(actions, state, n_modes=N_CONTROLLED, fewer=()):
    return await actions.perform(ev.MakeMatrix(n_modes=n_modes, why="a test", fewer=fewer), state)


def make_in(bench, loop, fewer=()):
    return bench.make(conditions(Misregistration(), np.diag(SIGMA**2), loop, 0.95), fewer)


def slip_alarm():
    return Alarm(
        name="edge-slip",
        since_ns_utc=START_NS,
        message=as_message("x", "found"),
        seen_ns_utc=START_NS,
    )


class TestFewer:
    """What is made where the gate refuses as many modes as were asked for."""

    async def test_as_many_as_asked_for_where_they_pass(self, actions):
        made = await make(actions, STATE, fewer=(30, 20, 10))
        assert (made.record.n_modes, made.asked_modes, made.why_fewer) == (45, 45, "")

    async def test_the_most_that_pass_where_they_do_not(self, actions):
        state = changed(STATE, registration=unsure(0.3))
        alone = {
            n: (await make(actions, state, n)).record.gate.accepted for n in (45, 30, 20, 10, 5)
        }
        assert not alone[45]
        assert any(alone.values())
        most = max(n for n, accepted in alone.items() if accepted)
        made = await make(actions, state, fewer=(30, 20, 10, 5))
        assert made.record.state is MatrixState.PROPOSED
        assert made.record.n_modes == most
        assert made.record.gate.accepted
        assert made.record.id.endswith(f"-{most}")
        assert "pole radius" in made.why_fewer

    async def test_what_was_asked_for_is_refused_where_none_pass(self, actions):
        state = changed(STATE, rtc=loop_of(1.9))
        made = await make(actions, state, fewer=(30, 10))
        assert made.record.state is MatrixState.REFUSED
        assert (made.record.n_modes, made.why_fewer) == (45, "")


@pytest.fixture(scope="module")
def bench():
    return OpticsWorker(small_instrument(), COMPUTE)


@pytest.fixture(scope="module")
def just_beyond(bench):
    """A loop whose ring moves by a nanometre more than that of one to be closed may."""

    def loop(gain):
        return ControlLoop(
            frame_rate_hz=1000.0, gains=np.full(N_CONTROLLED, gain), leak=0.999, delay_frames=2.0
        )

    def excess_m(gain):
        return make_in(bench, loop(gain)).gate.edge_motion_m - (MAX_EDGE_MOTION_M + 1e-9)

    return loop(brentq(excess_m, 0.2, 0.6, xtol=1e-5))


class TestEdge:
    """The most modes where the outer ring decides, and a loop that has them already."""

    def test_one_that_is_to_be_closed_gets_fewer(self, bench, just_beyond):
        made = make_in(bench, just_beyond, fewer_modes_than(N_CONTROLLED))
        assert len(made.matrix) == fewer_modes_than(N_CONTROLLED)[0] == 43
        assert "outer ring" in made.why_fewer

    def test_one_that_holds_with_as_many_keeps_them(self, bench, just_beyond):
        held = replace(just_beyond, n_holding=N_CONTROLLED)
        made = make_in(bench, held, fewer_modes_than(N_CONTROLLED))
        assert made.gate.accepted
        assert (len(made.matrix), made.why_fewer) == (N_CONTROLLED, "")
        assert MAX_EDGE_MOTION_M < made.gate.edge_motion_m < MAX_HELD_EDGE_MOTION_M

    def test_one_that_holds_with_fewer_is_not_given_more(self, bench, just_beyond):
        made = make_in(bench, replace(just_beyond, n_holding=40), (40,))
        assert len(made.matrix) == 40

    async def test_the_one_in_use_is_judged_by_the_same_measure(self, actions, just_beyond):
        """Or it would be replaced by its like again and again."""
        gain = float(just_beyond.gains[0])
        registration = replace(REGISTRATION, alpha=Misregistration(), optical_gain=None)
        state = changed(STATE, registration=registration, rtc=loop_of(gain))
        made = await make(actions, state, fewer=fewer_modes_than(N_CONTROLLED))
        assert made.record.n_modes == N_CONTROLLED
        assert MAX_EDGE_MOTION_M < made.record.gate.edge_motion_m < MAX_HELD_EDGE_MOTION_M
        state = changed(state, reconstructors=(made.record,))
        judged = await actions.perform(ev.JudgeMatrix(id=made.record.id), state)
        assert judged.verdict.accepted
        slipping = changed(state, active=(slip_alarm(),))
        judged = await actions.perform(ev.JudgeMatrix(id=made.record.id), slipping)
        assert not judged.verdict.accepted


class TestLoss:
    """What the one in use loses against a new one."""

    async def test_the_one_just_made_loses_nothing(self, actions):
        made = await make(actions, STATE)
        state = changed(STATE, reconstructors=(made.record,))
        judged = await actions.perform(ev.JudgeMatrix(id=made.record.id), state)
        assert judged.alpha == REGISTRATION.alpha
        assert judged.expected.loss_m == pytest.approx(0.0, abs=1e-12)

    async def test_one_for_another_registration_loses_wavefront_and_margin(self, actions):
        made = await make(actions, STATE)
        moved = replace(REGISTRATION.alpha, shift_y_subap=0.25)
        state = changed(STATE, registration=replace(REGISTRATION, alpha=moved))
        judged = await actions.perform(ev.JudgeMatrix(id=made.record.id), state)
        assert judged.expected.loss_m > 1e-11
        assert judged.expected.pole_radius > judged.expected.fresh_pole_radius + 0.02


class TestGains:
    """Optical gains stand beside a matrix and are never part of it."""

    async def test_the_same_bytes_whatever_gains_were_measured_or_are_in_force(self, actions):
        found = set()
        for gains in ((), MEASURED, tuple(replace(one, gain=0.3) for one in MEASURED)):
            for gain in (0.1, 0.4):
                state = changed(
                    STATE,
                    rtc=loop_of(gain),
                    registration=replace(REGISTRATION, optical_gains=gains),
                )
                found.add((await make(actions, state)).record.sha256)
        assert len(found) == 1

    async def test_the_table_is_in_the_file_beside_the_matrix(self, actions, archive, tmp_path):
        state = changed(STATE, registration=replace(REGISTRATION, optical_gains=MEASURED))
        made = (await make(actions, state)).record
        assert made.optical_gains == MEASURED
        assert archive.reconstructors.records()[-1].optical_gains == MEASURED
        with h5py.File(tmp_path / "reconstructors" / f"{made.id}.h5") as file:
            assert file["gains"].attrs["measured_modes"].tolist() == [60, 70, 80]
            assert file["gains/factor"].shape == (N_CONTROLLED,)
            assert file["gains/factor"][()].mean() == pytest.approx(1.0)

    async def test_gains_by_the_table_are_asked_for_when_the_gate_agrees(self, actions, bridge):
        made = await make(actions, STATE)
        state = changed(STATE, reconstructors=(made.record,), in_use=made.record.id)
        gains = tuple(np.linspace(0.5, 0.4, N_CONTROLLED)) + (0.0,) * (N_MODES - N_CONTROLLED)
        asked = ev.Ask(request=LoopRequest(id="loop-1", gains=gains), judged=True)
        answer = await actions.perform(asked, state)
        assert answer.reply.accepted
        assert bridge.commands[-1].gains == gains

    async def test_and_never_reach_the_rtc_when_it_does_not(self, actions, bridge):
        made = await make(actions, STATE)
        state = changed(STATE, reconstructors=(made.record,), in_use=made.record.id)
        gains = (2.5,) * N_CONTROLLED + (0.0,) * (N_MODES - N_CONTROLLED)
        asked = ev.Ask(request=LoopRequest(id="loop-1", gains=gains), judged=True)
        answer = await actions.perform(asked, state)
        assert not answer.reply.accepted
        assert "unstable" in answer.reply.reason
        assert not bridge.commands

    async def test_nothing_is_judged_for_a_matrix_nobody_knows(self, actions):
        asked = ev.Ask(request=LoopRequest(id="loop-1", gains=(0.1,) * N_MODES), judged=True)
        with pytest.raises(CommandError, match="cannot be judged"):
            await actions.perform(asked, changed(STATE, in_use=None))


def loop_with(registration):
    state = changed(STATE, rtc=loop_of(0.4), registration=registration)
    return loop_to_judge(state, (0.4,) * N_CONTROLLED)


class TestLoopOfTheGate:
    """The optical gains the gate and the expected loss are told."""

    def test_the_gate_gets_more_than_the_expected_gain_of_every_mode(self):
        registration = replace(REGISTRATION, optical_gains=MEASURED)
        loop = loop_with(registration)
        expected = expected_gains(registration, N_MODES)
        assert expected.shape == (N_MODES,)
        assert np.all(loop.optical_gain > 1.05 * expected[:N_CONTROLLED])

    def test_a_mean_of_unknown_modes_is_taken_for_all_with_some_safety(self):
        loop = loop_with(REGISTRATION)
        assert loop.optical_gain == pytest.approx(GAIN_SAFETY * REGISTRATION.optical_gain)

    def test_with_nothing_measured_the_model_is_believed(self):
        blind = replace(REGISTRATION, optical_gain=None)
        assert loop_with(blind).optical_gain == 1.0


class TestModesThatHold:
    """Which loop the gate may take for one that holds."""

    def test_the_loop_that_is_closed_with_these_gains(self):
        state = changed(STATE, rtc=loop_of(0.4))
        assert modes_that_hold(state, (0.4,) * N_CONTROLLED) == N_CONTROLLED
        assert modes_that_hold(state, (0.4,) * (N_CONTROLLED + 9)) == N_CONTROLLED

    def test_not_with_other_gains_or_fewer_of_them(self):
        state = changed(STATE, rtc=loop_of(0.4))
        assert modes_that_hold(state, (0.5,) * N_CONTROLLED) is None
        assert modes_that_hold(state, (0.4,) * (N_CONTROLLED - 1)) is None

    def test_not_one_that_is_open_or_gone(self):
        opened = replace(loop_of(0.4), loop="open")
        assert modes_that_hold(changed(STATE, rtc=opened), (0.4,) * N_CONTROLLED) is None
        assert modes_that_hold(changed(STATE, rtc=None), (0.4,) * N_CONTROLLED) is None

    @pytest.mark.parametrize("name", ["edge-slip", "loop-diverging", "commands-off-loop"])
    def test_not_one_that_is_out_of_hand(self, name):
        state = changed(STATE, rtc=loop_of(0.4), active=(replace(slip_alarm(), name=name),))
        assert modes_that_hold(state, (0.4,) * N_CONTROLLED) is None
