"""No mode is controlled that nobody has seen to answer as the instrument file says."""

from dataclasses import replace

import numpy as np
import pytest

from service.errors import CommandError
from service.estimation.lockin import WEAK_LINE_RATIO
from service.records import alarms
from service.records import commands as cmd
from service.records import events as ev
from service.records.estimates import WindowRefused
from service.records.products import MAX_COMPARED_WINDOWS, MatrixState, ModeProof, ModeRatio
from service.records.state import Mode
from service.tracking.dither_request import LOW_MODE, PROVING_LINE_RANGE
from service.tracking.mode_limits import compare
from service.tracking.mode_proof import (
    MAX_PROOF_TRIES,
    MAX_WEAK_LINES,
    n_proven_modes,
    proven_modes,
)
from service.tracking.resume import restored, resumed, saved_of
from service.wire import DitherRequest
from tests.support.situations import N_MODES, POLICY, SECOND, estimate, foreign, of_kind
from tests.support.states import changed, tracker_state
from tests.support.world import STEP_S, WINDOW_S, World

TARGET = replace(POLICY, n_modes_target=450)


class Shown(World):
    """A world in which every mode answers with 0.6 of the model but those in ``answers``."""

    all_shown = False

    def __init__(self, answers=None, mode=Mode.AUTO, offered=True, policy=TARGET, **changes):
        self.answers_of, self.offered, self.sigma_of = answers or {}, offered, {}
        super().__init__(mode, policy, **changes)

    def of_matrices(self, effect):
        if isinstance(effect, ev.FetchMatrix) and not self.offered:
            yield ev.JobFailed(effect=effect, text="no answer from the RTC on rtc/cm/applied")
            return
        yield from super().of_matrices(effect)

    def windows(self):
        playing = self.playing
        self.since_window_s = 0.0 if playing is None else self.since_window_s + STEP_S
        if self.since_window_s < WINDOW_S + STEP_S or self.state.dithers.dither is None:
            return
        self.since_window_s = STEP_S
        modes = playing.request.modes
        gains = np.array([self.answers_of.get(mode, 0.6) for mode in modes], dtype=complex)
        size = np.array(playing.request.amplitude_m)
        faint = size < WEAK_LINE_RATIO * size.max()
        fitted = estimate(
            t_ns=self.now_ns,
            session=f"s{self.session}",
            modes=modes,
            optical_gain=gains,
            gain_sigma=np.array([self.sigma_of.get(mode, 0.02) for mode in modes]),
            lag_frames=np.zeros(len(modes)),
            weak=tuple(np.array(modes)[faint].tolist()),
        )
        self.tell(ev.WindowFitted(estimate=fitted))

    @property
    def shown(self):
        """Modes of each dither that was there to see them answer."""
        asked = self.asked(DitherRequest)
        return [request.modes for request in asked if request.id.startswith("dither-prove-")]

    @property
    def made(self):
        return [effect.n_modes for effect in self.asked(ev.MakeMatrix)]


def test_modes_of_the_rtcs_own_matrix_are_known_and_all_others_are_shown_first():
    world = Shown().pass_(60.0)
    assert {mode for modes in world.shown for mode in modes} >= set(range(400, 450))
    assert not {mode for modes in world.shown for mode in modes} & set(range(400))
    first_of_more = next(
        k
        for k, effect in enumerate(world.effects)
        if isinstance(effect, ev.MakeMatrix) and effect.n_modes > 400
    )
    before = of_kind(world.effects[:first_of_more], DitherRequest)
    assert set(range(400, 450)) <= {mode for request in before for mode in request.modes}
    assert world.state.loop.rtc.n_controlled == 450
    assert world.alarms == set()


def test_many_are_shown_at_once_each_on_a_line_of_its_own_and_within_the_budget():
    world = Shown().pass_(30.0)
    first = of_kind(world.effects, DitherRequest)
    proving = next(request for request in first if request.id.startswith("dither-prove-"))
    assert len(proving.modes) == 50
    lines = np.sort(proving.frequency_hz)
    assert np.diff(lines).min() * WINDOW_S >= 4
    assert PROVING_LINE_RANGE[0] * 1000 <= lines[0] < lines[-1] <= PROVING_LINE_RANGE[1] * 1000
    assert np.sqrt(np.sum(np.square(proving.amplitude_m))) <= POLICY.dither_budget_m * 1.001


@pytest.mark.parametrize("answer", [-0.6, 0.0, 1.9, 0.06])
def test_a_mode_that_answers_otherwise_is_named_and_no_matrix_controls_it(answer):
    """Another sign, another mode's place, three times or a tenth of its size."""
    world = Shown({430: answer}).pass_(60.0)
    alarm = world.state.alarm(alarms.MODES_CONTRARY)
    assert alarm.text.startswith("mode 430 has not answered the dither")
    assert max(world.made) <= 430
    assert world.state.loop.rtc.n_controlled <= 430


def test_it_is_shown_again_after_a_wait_and_the_alarm_goes_once_it_answers():
    world = Shown({430: -0.6}).pass_(40.0)
    n_shown = len(world.shown)
    world.answers_of = {}
    world.pass_(120.0)
    assert len(world.shown) > n_shown
    assert world.alarms == set()
    assert world.state.loop.rtc.n_controlled == 450


def test_where_the_rtc_does_not_offer_its_matrix_every_mode_is_shown():
    world = Shown({10: -0.6}, offered=False).pass_(30.0)
    assert {mode for modes in world.shown for mode in modes} >= set(range(24))
    told = world.state.alarm(alarms.MODES_CONTRARY).text
    assert "mode 10 has" in told
    assert "(-0.60 times the model)" in told
    assert world.made == []


def test_modes_of_the_rtcs_matrix_that_were_not_recognised_are_shown_too():
    world = Shown()
    strange = ev.ModesRecognised(id="initial", strange=(7, 8), text="two are not recognised")
    world.tell(strange)
    assert n_proven_modes(world.state, 450) == 7
    world.pass_(30.0)
    assert {7, 8} <= {mode for modes in world.shown for mode in modes}
    assert 400 in world.made


def test_an_operator_cannot_send_what_is_not_proven_and_is_told_what_to_do():
    world = Shown(mode=Mode.PROPOSE).pass_(12.0)
    world.tell(cmd.StopDither())
    world.make("cm-large", n_modes=560)
    with pytest.raises(CommandError, match="to 559 have not been seen to answer yet"):
        world.tell(cmd.Approve(id="cm-large"))
    assert world.matrix_state("cm-large") is MatrixState.PROPOSED


def test_what_has_been_in_use_can_be_sent_again_whatever_is_proven():
    world = Shown().pass_(60.0)
    world.state = changed(world.state, mode_proof=ModeProof())
    world.tell(cmd.Rollback())
    assert of_kind(world.effects[-3:], ev.RepublishMatrix)


def test_dithers_that_show_nothing_are_given_up_for_a_while():
    world = Shown().pass_(6.0)
    quiet = changed(world.state, mode_proof=ModeProof(proven=frozenset(range(400))))
    world.state = quiet
    world.answers_of = dict.fromkeys(range(400, 450), 0.01 + 0.0j)
    world.windows = lambda: None
    world.pass_(120.0)
    assert 1 <= len(world.shown) <= 2 * MAX_PROOF_TRIES + 2
    assert "have not been seen to answer in 3 dithers" in world.state.matrices.mode_limit.reason


def test_an_answer_too_noisy_to_tell_proves_nothing_and_accuses_nobody():
    world = Shown().pass_(8.0)
    session = f"s{world.session}"
    world.tell(
        ev.WindowFitted(
            estimate=estimate(
                t_ns=world.now_ns,
                session=session,
                modes=(500, 501, 502, 503),
                optical_gain=np.array([0.6, 0.6, 0.6, -0.3], dtype=complex),
                gain_sigma=np.array([0.02, 0.02, 0.3, 0.3]),
            )
        )
    )
    assert {500, 501} <= proven_modes(world.state)
    assert not {502, 503} & (
        world.state.matrices.mode_proof.proven | world.state.matrices.mode_proof.contrary
    )


def test_a_matrix_in_use_proves_its_modes():
    world = Shown().pass_(6.0)
    assert proven_modes(world.state) >= set(range(400))
    assert foreign().parent is None


def test_one_window_that_says_otherwise_accuses_nobody():
    """A loop that slips for a moment answers anyhow: the next window decides."""
    world = Shown().pass_(8.0)
    for gain in (-0.6, 0.6):
        gains = np.array([0.6, 0.6, 0.6, gain], dtype=complex)
        seen = estimate(
            t_ns=world.now_ns,
            session=f"s{world.session}",
            modes=(500, 501, 502, 410),
            optical_gain=gains,
            gain_sigma=np.full(4, 0.02),
        )
        world.tell(ev.WindowFitted(estimate=seen))
        assert not world.state.matrices.mode_proof.contrary
        assert (410 in proven_modes(world.state)) is (gain > 0.0)
    assert world.alarms == set()


def test_a_mode_that_the_loop_runs_with_is_not_accused_by_its_dither():
    """The matrix in use is the better witness, and α is followed on."""
    world = Shown({410: 0.6}).pass_(60.0)
    assert world.state.loop.rtc.n_controlled == 450
    for _ in range(3):
        gains = np.array([0.6, 0.6, 0.6, -0.6], dtype=complex)
        seen = estimate(
            t_ns=world.now_ns,
            session=f"s{world.session}",
            modes=(446, 447, 448, 449),
            optical_gain=gains,
            gain_sigma=np.full(4, 0.02),
        )
        world.tell(ev.WindowFitted(estimate=seen))
    assert n_proven_modes(world.state, 450) == 450
    assert alarms.MODES_CONTRARY not in world.alarms


def test_modes_that_nobody_knows_are_shown_after_one_window_where_the_loop_runs_with_them():
    """Nothing can be sent before; where the RTC's matrix is known three windows must agree."""
    world = Shown(offered=False).pass_(2.0 * WINDOW_S)
    assert world.shown
    assert not Shown().pass_(2.0 * WINDOW_S).shown


def test_a_mode_accused_once_is_shown_again_though_fewer_are_wanted_meanwhile():
    """Mode 30 is named first, and no more than 30 are wanted: 120 is the other half of it."""
    world = Shown({30: 0.0, 120: 0.0}, offered=False).pass_(30.0)
    assert world.state.matrices.mode_limit.n_modes == 30
    assert "modes 30, 120 have" in world.state.alarm(alarms.MODES_CONTRARY).text


def test_modes_that_were_known_already_do_not_make_a_dither_count_as_one_that_has_told():
    world = Shown(offered=False)
    noisy = dict.fromkeys((0, 1, 2), 0.3 + 0.0j)
    world.answers_of, world.sigma_of = noisy, dict.fromkeys(noisy, 0.2)
    world.pass_(60.0)
    assert "have not been seen to answer in 3 dithers" in world.state.matrices.mode_limit.reason


def told(world, gains, answers_as=None, first=410):
    """One window of a dither of modes from ``first`` on."""
    modes = tuple(range(first, first + len(gains)))
    seen = estimate(
        t_ns=world.now_ns,
        session=f"s{world.session}",
        modes=modes,
        optical_gain=np.array(gains, dtype=complex),
        gain_sigma=np.full(len(gains), 0.02),
        lag_frames=np.zeros(len(gains)),
        answers_as=answers_as or modes,
    )
    world.tell(ev.WindowFitted(estimate=seen))
    return world


def test_modes_that_answer_as_each_other_are_said_to_be_exchanged():
    world = Shown().pass_(8.0)
    like = (412, 411, 410, *range(413, 422))
    for _ in range(2):
        told(world, [0.01, 0.6, -0.01] + [0.6] * 9, like)
    text = world.state.alarm(alarms.MODES_CONTRARY).text
    assert "(410 and 412 are exchanged)" in text


def test_a_mode_that_answers_as_another_is_said_to_be_in_its_place():
    world = Shown().pass_(8.0)
    for _ in range(2):
        told(world, [0.01] + [0.6] * 11, (77, *range(411, 422)))
    assert "(410 is in the place of 77)" in world.state.alarm(alarms.MODES_CONTRARY).text


@pytest.mark.parametrize("answer", [1.1, 0.28])
def test_a_mode_of_twice_or_half_the_strength_is_named_by_two_windows_and_controlled(answer):
    world = Shown().pass_(8.0)
    told(world, [0.6] * 5 + [answer] + [0.6] * 6)
    assert 415 not in proven_modes(world.state)
    assert alarms.MODES_UNEVEN not in world.alarms
    told(world, [0.6] * 5 + [answer] + [0.6] * 6)
    assert 415 in proven_modes(world.state)
    assert "mode 415 answers the dither" in world.state.alarm(alarms.MODES_UNEVEN).text
    told(world, [0.6] * 12)
    assert alarms.MODES_UNEVEN not in world.alarms


def test_a_mode_whose_shape_the_model_does_not_explain_is_not_uneven():
    """Its gain is the projection of its response: 0.36 / sqrt(1 - 0.4) is 0.46."""
    modes = np.arange(12)
    gains, sigma = np.where(modes == 5, 0.36, 0.6), np.full(12, 0.01)
    unexplained = np.where(modes == 5, 0.4, 0.0)
    assert compare(modes, gains, sigma)[5].ratio == pytest.approx(0.6)
    found = compare(modes, gains, sigma, unexplained)
    assert found[5].ratio == pytest.approx(0.775, abs=0.001)
    assert not found[5].stands_out
    # noise that makes a strong mode stronger accuses nobody
    assert compare(modes, np.full(12, 0.6), sigma, unexplained)[5].ratio == pytest.approx(1.0)


def test_optical_gains_that_change_along_the_basis_are_not_uneven():
    world = Shown().pass_(8.0)
    for _ in range(3):
        told(world, np.linspace(0.3, 0.9, 40).tolist())
    assert not world.state.matrices.mode_proof.uneven
    assert not world.state.matrices.mode_proof.doubtful


def test_a_mode_that_answers_otherwise_is_dithered_no_more_and_its_window_tells_no_alpha():
    told_of = np.broadcast_to(np.eye(4), (N_MODES, 4, 4)).copy()
    told_of[[460, 470, 480, 490]] *= 100.0
    world = Shown({470: -0.6}, policy=replace(TARGET, mode_information=told_of))
    world.pass_(20.0)
    assert 470 in world.playing.request.modes or 470 in world.asked(DitherRequest)[0].modes
    world.pass_(30.0)
    assert 470 not in world.playing.request.modes
    refused = [entry.text for entry in world.state.log if entry.name == "window.refused"]
    assert any("mode 470 has not answered" in text for text in refused)
    assert alarms.WINDOWS_REFUSED not in world.alarms
    assert alarms.SUSPECTED not in world.alarms


def killed(world, session=None):
    """The service is killed and begun again three seconds later; the RTC goes on, or is another."""
    saved = saved_of(world.state, world.now_ns)
    world.now_ns += 3 * SECOND
    records = restored(world.state.matrices.reconstructors)
    fresh = tracker_state(system="flao", mode=Mode.AUTO, reconstructors=records)
    world.state = resumed(fresh, saved, world.policy, world.now_ns)
    world.session = session or world.session
    World.tell(world, ev.SessionStarted(session=f"s{world.session}"))
    world.tell(world.status())
    return world


def test_what_modes_have_shown_outlives_the_service():
    world = Shown().pass_(8.0)
    for _ in range(2):
        told(world, [0.6] * 5 + [1.1] + [0.6] * 5 + [-0.6])
    before = world.state.matrices.mode_proof
    assert 415 in before.proven
    killed(world)
    assert world.state.matrices.mode_proof.proven == before.proven
    text = world.state.alarm(alarms.MODES_CONTRARY).text
    assert text.startswith("mode 421 has not answered")
    assert "(-0.60 times the model)" in text
    assert "mode 415 answers" in world.state.alarm(alarms.MODES_UNEVEN).text
    assert world.state.matrices.mode_limit.n_modes == 421


@pytest.mark.parametrize("lost", ["restart", "worker"])
def test_modes_are_dithered_again_where_the_gate_has_lost_their_response(lost):
    """The model is poor: sign and size of a mode are not enough. They do not end with a worker."""
    lose = {"restart": killed, "worker": lost_worker}[lost]
    world = Shown().pass_(8.0)
    told(world, [0.6] * 12)
    before = world.state.matrices.mode_proof.proven
    assert before
    assert lose(world).state.matrices.mode_proof.proven == before
    proof = replace(world.state.matrices.mode_proof, own_weights=(1.0,) * N_MODES)
    world.state = changed(world.state, mode_proof=proof)
    assert bool(lose(world).state.matrices.mode_proof.proven) is (lost == "worker")


def lost_worker(world):
    world.tell(ev.ConditionChanged(name=alarms.WORKER_LOST, text="the worker died"))
    return world


def test_of_another_session_nothing_is_taken_over():
    """The RTC has begun anew meanwhile: its modes may be others."""
    world = killed(Shown({430: -0.6}).pass_(60.0), session=2)
    assert world.state.matrices.mode_proof == ModeProof()
    assert alarms.MODES_CONTRARY not in world.alarms


def test_an_rtc_that_begins_anew_shows_its_modes_anew():
    """It may be another one."""
    world = Shown().pass_(60.0)
    assert 430 in world.state.matrices.mode_proof.proven
    world.tell(ev.SessionStarted(session="s2"))
    assert world.state.matrices.mode_proof == ModeProof()


def test_of_another_basis_nothing_is_taken_over():
    world = Shown({430: -0.6}).pass_(60.0)
    world.changes = {"basis_id": "kl-300"}
    assert killed(world).state.matrices.mode_proof == ModeProof()


def test_a_window_before_a_restart_and_one_after_it_are_two():
    world = Shown().pass_(8.0)
    told(world, [-0.6] + [0.6] * 11)
    assert not world.state.matrices.mode_proof.contrary
    told(killed(world), [-0.6] + [0.6] * 11)
    assert world.state.matrices.mode_proof.contrary == {410}


def test_a_mode_that_the_loop_runs_with_is_not_accused_after_a_restart():
    world = Shown().pass_(60.0)
    for _ in range(2):
        told(world, [-0.6] + [0.6] * 11)
    assert world.state.loop.rtc.n_controlled == 450
    assert alarms.MODES_CONTRARY not in killed(world).alarms
    assert alarms.MODES_CONTRARY not in world.pass_(2.0).alarms


def informed(telling=(460, 470, 480, 490), **changes):
    """A policy that knows which modes tell most of α."""
    information = np.broadcast_to(np.eye(4), (N_MODES, 4, 4)).copy()
    information[list(telling)] *= 100.0
    return replace(TARGET, mode_information=information, **changes)


def test_weak_lines_show_other_modes_beside_the_first_dither():
    """Those that tell of α keep most of the power; one more line costs no time."""
    first = Shown(policy=informed()).asked(DitherRequest)[0]
    size = dict(zip(first.modes, first.amplitude_m, strict=True))
    telling = {460, 470, 480, 490}
    assert set(first.modes) == telling | set(range(400, 400 + MAX_WEAK_LINES))
    power = np.square(first.amplitude_m)
    assert np.sqrt(power.sum()) <= POLICY.dither_budget_m * 1.001
    assert sum(size[mode] ** 2 for mode in telling) >= 0.75 * power.sum() * 0.999
    assert max(size[mode] for mode in size if mode not in telling) < WEAK_LINE_RATIO * size[460]
    lines = dict(zip(first.modes, first.frequency_hz, strict=True))
    gaps = [abs(lines[mode] - lines[one]) for one in telling for mode in lines if mode != one]
    assert min(gaps) >= 4.0
    assert first.duration_s == pytest.approx(0.3 + 2 * WINDOW_S + 0.9)


def test_a_mode_beyond_the_loop_is_named_while_the_first_matrix_is_made():
    """Its line is weak: α is told by the others, and the matrix is asked for as soon as ever."""
    healthy, odd = (Shown(answers, policy=informed()) for answers in ({}, {430: -0.6}))
    for world in (healthy, odd):
        while not world.made:
            world.pass_(0.5)
    assert odd.now_ns == healthy.now_ns
    assert "mode 430 has" in odd.state.alarm(alarms.MODES_CONTRARY).text
    assert odd.made == [400]
    assert odd.state.windows.refused == 0


def test_the_first_matrix_is_asked_for_as_soon_as_with_four_lines():
    few = Shown(policy=informed(n_modes_target=400))
    many = Shown(policy=informed())
    for world in (few, many):
        while not world.made:
            world.pass_(0.5)
    assert len(few.asked(DitherRequest)[0].modes) == 5, "four for α, and a low one"
    assert few.now_ns == many.now_ns


@pytest.mark.parametrize(
    "changes",
    [{"mode": Mode.HOLD}, {"max_dither_modes": 4}, {"magnitude": 10.0}],
)
def test_no_weak_lines_are_asked_for_where(changes):
    """Nothing is made; the RTC plays no more; a faint star."""
    first = Shown(policy=informed(), **changes).asked(DitherRequest)[0]
    assert first.modes == (*range(460, 500, 10), LOW_MODE)[: changes.get("max_dither_modes", 5)]


def test_the_modes_beside_one_that_may_be_uneven_are_shown_with_it():
    """In a window of few modes nobody could tell."""
    world = Shown({430: 1.15}, policy=TARGET).pass_(60.0)
    again = [modes for modes in world.shown if 430 in modes]
    assert len(again) >= 2
    assert all(len(modes) > 10 for modes in again)
    assert set(range(425, 436)) <= set(again[1])
    assert "mode 430 answers" in world.state.alarm(alarms.MODES_UNEVEN).text
    assert world.state.loop.rtc.n_controlled == 450


def test_a_window_of_few_modes_takes_nothing_back():
    world = Shown().pass_(8.0)
    for _ in range(2):
        told(world, [0.6] * 5 + [1.1] + [0.6] * 6)
    told(world, [0.6, 1.1, 0.6, 0.6], first=414)
    assert "mode 415 answers" in world.state.alarm(alarms.MODES_UNEVEN).text


def test_two_windows_say_together_what_neither_says_alone():
    """Half as strong as its neighbours by one and a half σ more than a limit, twice."""
    one, other = (
        ModeRatio(mode=3, ratio=ratio, sigma=sigma)
        for ratio, sigma in ((0.55, 0.095), (0.52, 0.08))
    )
    assert one.undecided
    assert other.undecided
    both = one.plus(other)
    assert both.sigma == pytest.approx((0.095**-2 + 0.08**-2) ** -0.5)
    assert both.certain
    assert not replace(both, n_windows=1).certain
    assert not replace(both, ratio=0.64).certain
    assert not replace(both, sigma=0.1).certain


def test_a_mode_that_no_window_is_sure_of_is_let_be_after_some():
    world = Shown().pass_(8.0)
    for _ in range(MAX_COMPARED_WINDOWS):
        assert 415 not in proven_modes(world.state)
        told(world, [0.6] * 5 + [0.9] + [0.6] * 6)
    assert 415 in proven_modes(world.state)
    assert alarms.MODES_UNEVEN not in world.alarms


def test_a_mode_is_compared_with_those_beside_it_in_the_basis():
    modes = np.arange(40)
    gains = np.linspace(0.3, 0.9, 40)
    gains[20] *= 2.0
    found = compare(modes, gains, np.full(40, 0.03))
    assert found[20].ratio == pytest.approx(2.0, rel=0.03)
    assert found[20].sigma == pytest.approx(0.03 / gains[20] * 2.0, rel=0.03)
    assert max(abs(one.ratio - 1.0) for mode, one in found.items() if mode != 20) < 0.25
    assert compare(modes[:10], gains[:10], np.full(10, 0.03)) == {}
    # nor with those far from it, whose optical gains are others
    far = np.array([1, *range(25, 40)])
    assert compare(far, gains[far], np.full(16, 0.03)).keys() == set(range(25, 40))


@pytest.mark.parametrize("told", [{"max_dither_modes": 0}, {"max_dither_modes": 1}])
def test_an_rtc_that_plays_hardly_any_mode_is_asked_for_no_weak_lines(told):
    world = Shown(policy=informed(), **told).pass_(4.0)
    assert all(len(one.modes) <= 1 for one in world.asked(DitherRequest))


def test_weak_lines_are_as_far_from_strong_ones_as_short_windows_ask():
    window_s = 0.9
    first = Shown(policy=informed(window_s=window_s)).asked(DitherRequest)[0]
    assert len(first.modes) > 4
    lines = dict(zip(first.modes, first.frequency_hz, strict=True))
    gaps = [abs(lines[m] - lines[s]) for s in (460, 470, 480, 490) for m in lines if m != s]
    assert min(gaps) >= 4.0 / window_s - 1e-9


def test_where_all_modes_are_to_be_shown_the_first_dither_shows_the_free_ones_in_one_window():
    world = Shown({430: -0.6}, policy=informed(), offered=False)
    first = world.asked(DitherRequest)[0]
    assert set(first.modes) == {460, 470, 480, 490} | set(range(400, 400 + MAX_WEAK_LINES))
    assert first.duration_s == pytest.approx(0.3 + WINDOW_S + 0.9)
    world.pass_(3.0)
    assert 430 in world.shown[1]
    assert {0, 1, 2} <= set(world.shown[1])


def test_beside_a_dither_whose_window_was_refused_no_weak_lines_are_asked_for():
    world = Shown.__new__(Shown)
    world.windows = lambda: None
    world.__init__(policy=informed(), offered=False)
    world.tell(ev.WindowLost(refused=WindowRefused(reason="none found", t_ns_utc=world.now_ns)))
    world.pass_(6.0)
    assert len(world.asked(DitherRequest)[-1].modes) == 4


def test_a_dither_found_after_a_restart_gives_way_to_one_that_shows_modes():
    world = Shown(policy=informed()).pass_(4.0)
    world.state = changed(world.state, mode_proof=ModeProof())
    killed(world)
    assert not world.playing.request.id.startswith("dither-prove-")
    world.pass_(4.0)
    assert world.playing.request.id.startswith("dither-prove-")
