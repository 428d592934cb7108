"""What is taken for a jump, and what for a mirror that drifts as it always has."""

from dataclasses import replace

import numpy as np
import pytest

from service.model.misregistration import Misregistration
from service.records import events as ev
from service.records.estimates import PassiveEstimate
from service.records.state import Mode
from service.tracking.update_policy import is_settled
from tests.support.situations import ALPHA, POLICY, SECOND, Story, estimate, moved, rtc

PER_MINUTE = np.array([0.05, 0.05, np.deg2rad(0.05), 0.0005])
NIGHT = replace(
    POLICY,
    drift_rate=PER_MINUTE / np.sqrt(60.0),
    floor=np.array([0.005, 0.005, np.deg2rad(0.02), 0.001]),
)
WINDOW = np.array([0.0057, 0.0057, np.deg2rad(0.014), 0.0006])
"""1 σ of 2.5 s at magnitude 10 on the diffractive telescope."""

LOOK = np.array([0.01, 0.01, np.deg2rad(0.01), 0.0003])
BIAS = np.array([0.06, -0.04, 0.0, 0.0])
WINDOW_S, LOOK_S, GUSTS_S = 2.5, 4.0, 30.0
JUMP = "registration.jump"
FLAGS = ("registration.jump-suspected", JUMP, "registration.passive-jump")


class Sky:
    """A mirror that drifts and jumps, windows and looks that average over their own time."""

    def __init__(self, seed, *, jump=None, at_s=np.inf, scatter=1.0, gusts=0.0):
        self.rng = np.random.default_rng(seed)
        self.scatter, self.gusts = scatter, gusts
        self.jump, self.at_s = np.zeros(4) if jump is None else jump, at_s
        self.story = Story(Mode.HOLD, NIGHT).meet()
        self.begin_ns = self.story.now_ns

    def mean(self, end_s, over_s):
        """Where the mirror was on average; it drifts by as much as it may."""
        after = np.clip((end_s - self.at_s) / over_s, 0.0, 1.0)
        return ALPHA.vector + PER_MINUTE / 60.0 * (end_s - over_s / 2) + after * self.jump

    def gust(self, end_s):
        """How many σ aside windows lie: for 4 s of each half minute, then 4 s to the other side."""
        number, into_s = divmod(end_s, GUSTS_S)
        aside = np.random.default_rng(int(number)).normal(size=4)
        side = float(into_s < 4.0) - float(4.0 <= into_s < 8.0)
        return side * self.gusts * aside / np.linalg.norm(aside)

    def window(self, end_s, over_s=WINDOW_S):
        self.story.now_ns = self.begin_ns + round(end_s * SECOND)
        noise = self.scatter * self.rng.normal(size=4) + self.gust(end_s)
        read = self.mean(end_s, over_s) + WINDOW * noise
        found = estimate(
            Misregistration.from_vector(read),
            t_ns=self.story.now_ns,
            covariance=np.diag(WINDOW**2),
        )
        began_ns = self.story.now_ns - round(over_s * SECOND)
        self.story.tell(ev.WindowFitted(estimate=found, began_ns_utc=began_ns))

    def look(self, end_s, bias=BIAS, noise=LOOK):
        self.story.now_ns = self.begin_ns + round(end_s * SECOND)
        read = self.mean(end_s, LOOK_S) + bias + noise * self.rng.normal(size=4)
        found = PassiveEstimate(
            alpha=Misregistration.from_vector(read),
            covariance=np.diag(noise**2),
            optical_gain=np.full(400, 0.6),
            misfit=1.0,
            step=np.zeros(4),
        )
        self.story.tell(rtc(t_ns=self.story.now_ns))
        self.story.tell(ev.PassiveFitted(estimate=found, t_ns_utc=self.story.now_ns))

    def flags(self):
        """When what was told of jumps."""
        return [
            ((e.t_ns_utc - self.begin_ns) / SECOND, e.name)
            for e in self.story.state.log
            if e.name in FLAGS
        ]

    def flagged_s(self):
        return min([at_s - self.at_s for at_s, _ in self.flags()], default=np.inf)


def test_a_drift_of_five_percent_a_minute_is_no_jump_however_it_is_watched():
    """6 minutes of windows, then 20 of looks with a window every half minute."""
    busy, sparse = Sky(1), Sky(2)
    for k in range(1, 151):
        busy.window(k * WINDOW_S)
    for k in range(1, 301):
        sparse.look(k * LOOK_S)
        if k % 7 == 1:
            sparse.window(k * LOOK_S + 0.5)
    assert busy.flagged_s() == sparse.flagged_s() == np.inf


def test_windows_that_scatter_by_more_than_they_say_are_no_jumps_once_that_is_learnt():
    """By 1.8 σ instead of 1, as in bad seeing; a jump that stands out beyond it still is one."""
    sky = Sky(3, scatter=1.8, jump=np.array([0.1, 0.0, 0.0, 0.0]), at_s=500.0)
    for k in range(1, 211):
        sky.window(k * WINDOW_S)
    flagged = sky.flags()
    assert len([name for at_s, name in flagged if 50.0 < at_s <= 500.0]) <= 1, flagged
    assert "registration.jump" in {name for at_s, name in flagged if at_s > 500.0}


@pytest.mark.parametrize(
    "seeds", [range(1), pytest.param(range(1, 4), marks=pytest.mark.long)], ids=str
)
def test_what_a_gust_does_to_windows_for_seconds_is_no_jump(seeds):
    """9 σ for four seconds, then as far to the other side, where a loop slips off the pyramid.

    A mirror that jumps is suspected by the first window of the new place, so that nothing is made
    for the old one, and called so once that has lasted longer than a gust.
    """
    named, suspected_s, named_s = [], [], []
    for seed in seeds:
        sky = Sky(seed, scatter=1.5, gusts=9.0, jump=np.array([0.1, 0, 0, 0]), at_s=375.0)
        for end_s in range(1, 391):
            sky.window(float(end_s), over_s=1.0)
        flags = sky.flags()
        named += [at_s for at_s, name in flags if 60.0 < at_s <= 375.0 and name == JUMP]
        suspected_s.append(min(at_s for at_s, _ in flags if at_s > 375.0))
        named_s.append(min(at_s for at_s, name in flags if at_s > 375.0 and name == JUMP))
    assert not named
    assert max(suspected_s) == 376.0
    assert max(named_s) <= 385.0


@pytest.mark.parametrize(
    "jump", [np.array([0.1, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, np.deg2rad(0.1), 0.0])]
)
def test_a_jump_is_flagged_by_windows_within_seconds_wherever_it_falls(jump):
    """10 % of a subaperture or 0.1 deg: three windows at most, half of the time two."""
    found = []
    for seed in range(12):
        at_s = 40.0 + WINDOW_S * seed / 12
        sky = Sky(seed, jump=jump, at_s=at_s)
        for k in range(1, 21):
            sky.window(k * WINDOW_S)
        found.append(sky.flagged_s())
    assert min(found) > 0.0
    assert np.median(found) <= 2 * WINDOW_S
    assert max(found) <= 3 * WINDOW_S


LARGE = np.array([0.3, -0.1, np.deg2rad(1.0), 0.0])


@pytest.mark.parametrize("share", [0.2, 0.4, 0.6, 0.8, 0.95])
def test_a_large_jump_inside_a_window_is_told_by_that_window_and_the_next(share):
    """The first lies on the way to the new place, the second at it."""
    sky = Sky(5, jump=LARGE, at_s=40.0 + WINDOW_S * (1.0 - share))
    for k in range(1, 19):
        sky.window(k * WINDOW_S)
    assert [at_s for at_s, name in sky.flags() if name == JUMP] == [40.0 + 2 * WINDOW_S]
    error = sky.story.state.alpha.registration.alpha.vector - sky.mean(45.0, WINDOW_S)
    assert np.all(np.abs(error) < 4 * WINDOW)


@pytest.mark.parametrize(("jump", "settled"), [(LARGE, True), (0.12 * LARGE, False)])
def test_a_jump_beyond_all_turbulence_is_settled_once_two_windows_have_seen_it(jump, settled):
    """A smaller one waits for a third window where the first has seen but half of the way."""
    sky = Sky(5, jump=jump, at_s=40.0 + 0.5 * WINDOW_S)
    k = 0
    while JUMP not in {name for _, name in sky.flags()}:
        k += 1
        sky.window(k * WINDOW_S)
    assert is_settled(sky.story.state.alpha.registration) is settled
    sky.window((k + 1) * WINDOW_S)
    assert is_settled(sky.story.state.alpha.registration)


@pytest.mark.parametrize("first", [-LARGE, LARGE[[1, 0, 2, 3]], 1.5 * LARGE])
def test_two_windows_far_out_that_no_jump_explains_are_none(first):
    """The other way, another way, and beyond the place that the next one tells."""
    sky = Sky(5)
    for k in range(1, 11):
        sky.window(k * WINDOW_S)
    for k, aside in ((11, first), (12, LARGE)):
        sky.jump, sky.at_s = aside, 0.0
        sky.window(k * WINDOW_S)
    assert JUMP not in {name for _, name in sky.flags()}


def test_a_jump_between_windows_is_flagged_by_the_looks():
    """10 %, the bias learnt from windows before: two looks at most, half of the time within 5 s."""
    found = []
    for seed in range(12):
        sky = Sky(seed, jump=np.array([0.1, 0.0, 0.0, 0.0]), at_s=100.0 + LOOK_S * seed / 12)
        for k in range(1, 31):
            sky.look(k * LOOK_S)
            if k < 24:
                sky.window(k * LOOK_S + 0.5)
        found.append(sky.flagged_s())
    assert min(found) > 0.0
    assert np.median(found) <= 5.0
    assert max(found) <= 2 * LOOK_S


def test_a_magnification_that_looks_read_wrong_by_as_much_as_they_scatter_tells_of_no_jump():
    """4 % too much at a scatter of 0.9 %, as where 60 modes look through bad seeing."""
    bias = np.add(BIAS, [0.0, 0.0, 0.0, 0.04])
    noise = np.add(LOOK, [0.01, 0.01, 0.003, 0.0087])
    for seed in range(6):
        sky = Sky(seed)
        for k in range(1, 41):
            sky.window(k * LOOK_S - 0.5)
            sky.look(k * LOOK_S, bias, noise)
        assert sky.flagged_s() == np.inf


@pytest.mark.parametrize(
    ("own", "step", "flagged"),
    [
        ((0.012, 0.013, 0.0012, 0.0017), 0.0075, False),
        ((0.012, 0.013, 0.0012, 0.0017), 0.015, True),
        (None, 0.0075, True),
    ],
)
def test_windows_of_other_modes_differ_by_what_the_rtcs_own_matrix_shows(own, step, flagged):
    """Numbers of AO188's twin: its own matrix shows hardly more than 1.5 times a coarse floor."""
    floor = np.array([0.004, 0.004, np.deg2rad(0.014), 0.0014])
    story = Story(Mode.HOLD, replace(NIGHT, floor=floor)).meet()
    story.tell(ev.ModesRecognised(id="initial", strange=(), text="all", model_error=own))
    for alpha in (ALPHA, ALPHA, *[moved(magnification=step)] * 2):
        story.now_ns += 2 * SECOND
        noise = np.diag(np.square([0.004, 0.004, 0.0002, 0.0006]))
        found = estimate(alpha, t_ns=story.now_ns, covariance=noise)
        story.tell(ev.WindowFitted(estimate=found, began_ns_utc=story.now_ns - 2 * SECOND))
    assert any(entry.name in FLAGS for entry in story.state.log) is flagged
