"""The whole service against a small simulated telescope, in simulated time."""

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import (
    N_TARGET,
    SETTINGS,
    SMALL,
    START_NS,
    Dome,
    Latencies,
    Observatory,
    Outcome,
    Swap,
    bench_of,
    latencies_of,
    published,
    replayed,
    true_radius,
)
from pyrcal_studies.campaign.system_nights import recovery_of, row_of
from service.config import load_settings
from service.errors import CommandError
from service.estimation.description import actuator_watch
from service.estimation.health import (
    DIVERGING_RATIO,
    UNPLAYED_RATIO,
    LoopHealth,
    PlayedCommands,
    observe,
    observe_played,
)
from service.records import commands as cmd
from service.records import events as ev
from service.records.products import MatrixState
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.runtime.worker import OpticsWorker
from service.wire import DitherRequest
from tests.support.small import COMPUTE, INSTRUMENT, N_CONTROLLED, small_instrument

WORDS = [
    f"--instrument={INSTRUMENT}",
    "--plant=linear",
    "--imperfections=ideal",
    "--optical-gain=0.7,0.9",
    f"--n-controlled={N_CONTROLLED}",
    "--seed=1",
    "--alpha=0.05,-0.03,0.1,1.002",
]
JUMP_S, JUMP_SUBAP = 8.0, 0.1


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="module")
def bench():
    return OpticsWorker(small_instrument(), COMPUTE)


@pytest.fixture(scope="module")
def policy():
    given = {
        "dither.budget_m": 20e-9,
        "dither.amplitude_m": 10e-9,
        "dither.window_s": 1.0,
        "dither.longest_pause_s": 0.0,
        "control.n_modes_target": N_CONTROLLED,
    }
    return policy_of(load_settings(None, {}, given))


@pytest.fixture(scope="module")
def night(bench, policy):
    """Seventeen seconds on auto, with a jump of a tenth of a subaperture in the middle."""
    words = [*WORDS, f"--jump={JUMP_S}:{JUMP_SUBAP},0,0,0"]
    night = Observatory(words, policy, Mode.AUTO, bench)
    night.advance(17.0)
    return night


def short(bench, policy, seconds, mode=Mode.AUTO, **changes):
    night = Observatory(WORDS, policy, mode, bench, **changes)
    night.advance(seconds)
    return night


@pytest.fixture(scope="module")
def three_seconds(bench, policy):
    return short(bench, policy, 3.0)


def times_s(night, name):
    return [(e.t_ns_utc - START_NS) * 1e-9 for e in night.state.log if e.name == name]


def test_the_service_finds_the_registration_by_itself(night):
    before_jump = [
        (g.alpha - m.alpha.vector) / g.sigma
        for g, m in zip(night.glances, night.dome.moments, strict=True)
        if g.alpha is not None and 4.0 < g.time_s < JUMP_S
    ]
    assert np.abs(before_jump).max() < 4.0


def test_a_matrix_is_made_sent_and_applied_each_in_its_time(night):
    published_s, applied_s = (
        times_s(night, f"reconstructor.{name}")[0] for name in ("published", "applied")
    )
    first = next(r for r in night.state.matrices.reconstructors if r.published_ns_utc is not None)
    asked_s = (first.created_ns_utc - START_NS) * 1e-9
    wait = night.latencies
    assert published_s - asked_s >= wait.make_s
    assert wait.send_s <= applied_s - published_s <= wait.send_s + 0.15
    swap = night.swaps[0]
    assert swap.id == first.id
    assert swap.time_s == pytest.approx(applied_s)


def test_a_jump_is_flagged_and_a_corrected_matrix_follows(night):
    (jump,) = row_of(night, (JUMP_S,))["jumps"]
    assert 0.0 < jump["flagged_s"] <= 5.0
    assert jump["flagged_s"] < jump["corrected_s"] <= 15.0


def test_what_the_gate_let_through_held_the_loop(night):
    publications = night.publications()
    assert len(publications) >= 2
    for publication in publications:
        assert publication.swap.gate.accepted
        assert publication.swap.radius < 0.95
        assert publication.outcome is Outcome.HELD


def test_the_truth_moves_when_it_should_and_by_as_much(night):
    x = {round(m.time_s, 2): m.alpha.shift_x_subap for m in night.dome.moments}
    assert x[JUMP_S + 0.05] - x[JUMP_S] == pytest.approx(JUMP_SUBAP)


def test_the_same_orders_make_the_same_night_and_without_dither_a_calmer_one(three_seconds):
    night = three_seconds
    errors = [m.wavefront_nm for m in night.dome.moments]
    again = replayed(WORDS, night.dome.orders, 3.0)
    assert [m.wavefront_nm for m in again.moments] == errors
    calm = [o for o in night.dome.orders if not isinstance(o.what, DitherRequest)]
    twin = replayed(WORDS, calm, 3.0)
    assert max(m.dither_nm for m in twin.moments) == 0.0
    added = np.mean(np.square(errors)) - np.mean([m.wavefront_nm**2 for m in twin.moments])
    dithers = np.mean([m.dither_nm**2 for m in night.dome.moments])
    assert added == pytest.approx(dithers, rel=0.5)


def test_two_nights_of_one_seed_are_one_night(bench, policy, three_seconds):
    first, second = three_seconds, short(bench, policy, 3.0)
    assert [m.wavefront_nm for m in first.dome.moments] == [
        m.wavefront_nm for m in second.dome.moments
    ]
    assert first.state.alpha.registration is not None
    assert np.array_equal(
        first.state.alpha.registration.alpha.vector, second.state.alpha.registration.alpha.vector
    )


def test_an_rtc_that_restarts_brings_its_first_matrix_back(bench, policy):
    night = short(bench, policy, 1.0)
    first, session = night.state.matrices.in_use, night.state.loop.rtc.session
    night.restart_rtc()
    assert night.state.loop.rtc is None
    night.advance(1.0)
    assert night.state.loop.rtc.session != session
    assert night.state.loop.rtc.seq < 1000
    assert night.state.matrices.in_use == first
    assert night.state.dithers.dither.start_seq < 1000


def test_a_worker_too_slow_for_the_telemetry_gets_longer_windows(bench, policy):
    slow = Latencies(fit_s=2.5)
    night = short(bench, policy, 9.0, Mode.HOLD, latencies=slow)
    fitted = [event for _, event in night.events if isinstance(event, ev.WindowFitted)]
    lasted_s = [(e.estimate.t_ns_utc - e.began_ns_utc) * 1e-9 for e in fitted]
    assert max(lasted_s) > 1.8 * lasted_s[0]
    assert night.state.windows.accepted == len(fitted) >= 2
    assert not [e.text for e in night.state.log if e.name == "window.refused"]


def test_an_operator_is_told_what_cannot_be_done(bench, policy):
    night = short(bench, policy, 0.5, Mode.HOLD)
    with pytest.raises(CommandError):
        night.command(cmd.Refit())


def test_an_effect_of_unknown_duration_is_refused_aloud(bench, policy):
    night = short(bench, policy, 0.1)
    with pytest.raises(TypeError, match="expected an effect whose duration is known"):
        night._do(object(), night.state)


def test_a_matrix_that_breaks_the_loop_is_called_so():
    dome = Dome([*WORDS, "--gain=0.4"])
    while dome.time_s < 2.0:
        dome.play()
    rtc = dome.computer
    bad = replace(rtc.reconstructor, matrix=-rtc.reconstructor.matrix)
    radius = true_radius(bad.matrix, dome.optics, rtc.settings)
    assert radius > 1.0
    assert true_radius(rtc.reconstructor.matrix, dome.optics, rtc.settings) < 0.95
    dome.stage(bad)
    swapped_s = dome.time_s
    while dome.time_s < 4.0:
        dome.play()
    # by the wavefront alone: nobody has looked at the poles
    swap = Swap(
        id="bad",
        n_modes=N_CONTROLLED,
        time_s=swapped_s,
        alpha=dome.alpha,
        made_for=None,
        gate=None,
        radius=None,
    )
    found = published(swap, dome.moments, 4.0)
    assert found.outcome is Outcome.DIVERGED
    assert found.after_nm > 10.0 * found.before_nm
    before = replace(swap, time_s=1.5)
    assert published(before, dome.moments, 1.7).outcome is Outcome.UNTESTED


def test_nothing_is_published_that_nobody_approved(bench, policy):
    night = short(bench, policy, 7.0, Mode.PROPOSE)
    assert not night.swaps
    (proposed,) = [
        r for r in night.state.matrices.reconstructors if r.state is MatrixState.PROPOSED
    ]
    night.command(cmd.Approve(id=proposed.id))
    night.advance(0.5)
    assert [swap.id for swap in night.swaps] == [proposed.id]


def test_a_mirror_that_does_not_answer_is_named_within_a_second_and_the_dither_is_ended(
    bench, policy
):
    night = short(bench, policy, 1.5, Mode.HOLD)
    assert night.state.dithers.dither is not None
    night.dome.computer.hide_dithers()
    night.advance(2.1)  # the second under way had an answer, the next has none
    (alarm,) = [alarm for alarm in night.state.alarms.active if alarm.name == "mirror-silent"]
    assert "of the power that modes" in alarm.text
    assert night.state.dithers.dither is None
    assert night.state.loop.rtc.dither is None
    night.dome.computer.hide_dithers(hidden=False)
    night.command(cmd.StartDither())
    night.advance(1.3)
    assert "mirror-silent" not in {alarm.name for alarm in night.state.alarms.active}


def night_with_a_jump(jump_s, seconds):
    """Half a subaperture and 4 degrees: no loop of 60 modes survives; 45 of them begin."""
    words = [
        f"--instrument={SMALL}",
        *("--plant=linear", "--seed=1", "--mag=7", "--n-controlled=45"),
        "--alpha=-0.25,-0.03,-2,1.002",
        f"--jump={jump_s}:0.5,0,4,0",
    ]
    policy = policy_of(load_settings(None, {}, {**SETTINGS, "control.n_modes_target": N_TARGET}))
    night = Observatory(
        words, policy, Mode.AUTO, bench_of(SMALL), latencies=latencies_of(), with_poles=False
    )
    night.advance(jump_s + seconds)
    return night


def test_a_loop_lost_to_a_jump_is_opened_within_a_second_and_back_on_all_modes_within_20():
    night, jump_s = night_with_a_jump(20.0, 18.0), 20.0
    found = recovery_of(night, jump_s)
    assert found["lost_after_s"] < 1.0
    assert found["opened_after_s"] < found["lost_after_s"] + 1.0
    assert found["all_modes_after_s"] < 17.0
    last = [one for one in night.dome.moments if one.time_s > jump_s + 17.0]
    assert all(one.closed and one.n_controlled == N_TARGET for one in last)
    assert found["after_nm"] < 1.1 * found["before_nm"]


def test_a_jump_a_second_after_a_swap_leaves_the_loop_neither_open_nor_in_hold():
    """Neither matrix holds the loop then: none is to blame, and α is acquired again."""
    night, jump_s = night_with_a_jump(12.5, 12.0), 12.5
    assert jump_s - 5.0 < max(swap.time_s for swap in night.swaps if swap.time_s < jump_s)
    assert any(not one.closed for one in night.dome.moments if one.time_s < jump_s + 2.0)
    assert night.dome.moments[-1].closed
    assert night.state.operator.mode is Mode.AUTO
    assert not night.state.alarms.active


Seen = list[tuple[float, LoopHealth, PlayedCommands]]


def watched(*words, seconds, plant="diffractive") -> Seen:
    """Return the watch of the loop on a simulated telescope, block by block."""
    usual = ("--mag=8", "--n-controlled=60", "--rate=500", "--gain=0.4")
    dome = Dome([f"--instrument={SMALL}", f"--plant={plant}", *usual, *words])
    about, matrix = bench_of(SMALL).describe(), dome.computer.reconstructor.matrix
    modes, variance = np.array(dome.computer.status().in_loop), about.mode_variance_m2
    actuators = actuator_watch(about.actuators, variance, modes)
    loop, played, seen = LoopHealth(), PlayedCommands(), []
    while dome.time_s < seconds:
        for block in dome.play():
            loop = observe(loop, block, variance, modes)
            if dome.time_s > 0.5:  # the loop has closed
                played = observe_played(played, block, actuators, matrix)
            seen.append((dome.time_s, loop, played))
    return seen


def test_a_jump_that_saturates_the_pyramid_is_called_diverging_within_half_a_second():
    """A subaperture: 0.1 to 2 um of wavefront error, and slopes only twice as large as before."""
    seen = watched("--seed=4", "--seeing=0.6", "--jump=2.5:1,0,0,0", seconds=3.2)
    assert not any(loop.diverging for time_s, loop, _ in seen if time_s <= 2.5)
    assert all(loop.diverging for time_s, loop, _ in seen if time_s > 3.0)
    # that of the expected turbulence alone does not see it
    assert max(loop.ratio for _, loop, _ in seen) < DIVERGING_RATIO


def test_a_gust_is_no_jump_and_no_clipped_command():
    gust = (
        "--seeing-at=1.9:0.6",
        "--seeing-at=2:1.05",
        "--seeing-at=3:1.05",
        "--seeing-at=3.1:0.6",
    )
    seen = watched("--seed=4", "--seeing=0.6", *gust, seconds=4.0)
    assert not any(loop.diverging or played.unplayed for _, loop, played in seen)


CLIPPED = ("--seed=3", "--seeing=0.8", "--actuator-stroke=1.2", "--actuator-bend=100")


@pytest.mark.parametrize("plant", ["linear", "diffractive"])
def test_commands_as_asked_while_the_mirror_clips_them_are_named_within_seconds(plant):
    seen = watched(*CLIPPED, "--report-asked", seconds=4.0, plant=plant)
    assert seen[-1][2].unplayed
    assert max(ratio for ratio, _ in seen[-1][2].beyond) > UNPLAYED_RATIO


def test_clipped_commands_as_played_are_what_the_slopes_show():
    seen = watched(*CLIPPED, seconds=4.0, plant="linear")
    assert not any(played.unplayed for _, _, played in seen)


def test_a_loop_that_diverges_at_its_own_frequency_clips_nothing():
    """The implied turbulence is 10 times the usual one, and swings within a few frames."""
    seen = watched("--seed=2", "--seeing=0.8", "--jump=1.5:0.5,0,4,0", seconds=3.5, plant="linear")
    assert seen[-1][1].diverging
    assert not any(played.unplayed for _, _, played in seen)
