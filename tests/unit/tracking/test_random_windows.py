"""What a window of random dither does to the registration."""

from dataclasses import replace

import numpy as np
import pytest

from service.errors import CommandError
from service.estimation.random_dither import RandomEstimate
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.dither_request import total_m
from service.tracking.products import ModeSet
from service.tracking.registration import Source
from service.wire import DitherKind, DitherRequest
from tests.unit.tracking.situations import ALPHA, POLICY, PRECISE, Story, moved, of_kind


def random_estimate(alpha=ALPHA, *, t_ns=0, n_modes=400, **changes):
    values = {
        "alpha": alpha,
        "covariance": PRECISE,
        "optical_gain": np.full(n_modes, 0.6),
        "gain_sigma": np.full(n_modes, 0.04),
        "lag_frames": np.zeros(1),
        "misfit": 1.0,
        "step": np.zeros(4),
        "t_ns_utc": t_ns,
        "cm_id": "initial",
        "session": "s1",
        "modes": tuple(range(n_modes)),
    }
    return RandomEstimate(**(values | changes))


def see(story, **changes):
    story.now_ns += 5_000_000_000
    return story.tell(ev.WindowFitted(estimate=random_estimate(t_ns=story.now_ns, **changes)))


def test_a_window_of_random_dither_enters_the_registration_like_any_other():
    story = Story().meet()
    see(story)
    known = story.state.alpha.registration
    np.testing.assert_allclose(known.alpha.vector, ALPHA.vector)
    assert story.state.alpha.history[-1].source is Source.RANDOM
    assert known.optical_gain == pytest.approx(0.6)


def test_gains_of_hundreds_of_modes_are_kept_as_those_of_a_few_groups():
    story = Story().meet()
    see(story)
    gains = story.state.alpha.registration.optical_gains
    assert 4 <= len(gains) <= 32
    assert gains[0].mode < 50 < 350 < gains[-1].mode


def test_one_noisy_gain_among_hundreds_is_no_reason_to_refuse_a_window():
    story = Story().meet()
    gains = np.full(400, 0.6)
    gains[7] = -0.2
    see(story, optical_gain=gains, gain_sigma=np.full(400, 0.3))
    assert story.state.windows.accepted == 1


def test_a_dither_nobody_sees_is_refused_for_its_gains():
    story = Story().meet()
    see(story, optical_gain=np.full(400, 0.02))
    assert story.state.windows.refused == 1
    assert "optical gains of 0.02 to 0.02" in story.state.log[-1].text


def test_neighbours_are_averaged_by_their_noise():
    """Two modes of gain 1 ± 0.1 and 0 ± 0.2: 0.8, ± 0.0894."""
    pair = random_estimate(
        n_modes=2, optical_gain=np.array([1.0, 0.0]), gain_sigma=np.array([0.1, 0.2])
    )
    modes, gains, sigma = pair.gains_by_group(1)
    assert modes == (1,)
    assert gains[0] == pytest.approx(0.8)
    assert sigma[0] == pytest.approx(1 / np.sqrt(125))


def test_a_jump_seen_by_random_signs_needs_a_second_window():
    story = Story().meet()
    for _ in range(3):
        see(story)
    see(story, alpha=moved(shift_x_subap=0.1))
    assert story.state.alpha.registration.suspected_jump is not None


def test_an_operator_may_dither_every_mode_of_the_basis():
    story = Story(policy=replace(POLICY, dither_enabled=False)).meet()
    command = cmd.StartDither(
        kind=DitherKind.BINARY, modes=ModeSet.ALL, total_amplitude_m=5e-9, duration_s=60.0
    )
    (asked,) = of_kind(story.tell(command), DitherRequest)
    assert asked.modes == tuple(range(594))
    assert total_m(asked) == pytest.approx(5e-9)
    assert "binary, 594 modes, 5 nm RMS in all" in story.state.log[-1].text


def test_random_signs_over_the_budget_must_be_meant():
    story = Story(policy=replace(POLICY, dither_enabled=False)).meet()
    command = cmd.StartDither(kind=DitherKind.BINARY, total_amplitude_m=20e-9, duration_s=60.0)
    with pytest.raises(CommandError, match="20 nm RMS in all, budget 8 nm"):
        story.tell(command)
    assert of_kind(story.tell(replace(command, over_budget=True)), DitherRequest)
