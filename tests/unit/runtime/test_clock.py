"""The machine's clock leaps an hour ahead and back; what the service waits for does not."""

import pytest

from service.records.state import Mode
from service.runtime.clock import ServiceClock
from tests.support.situations import START_NS, dither_answered
from tests.support.world import World

SECOND = 1_000_000_000
HOUR = 3600 * SECOND


class Machine:
    """A machine on which time passes, and whose clock can be set."""

    def __init__(self):
        self.passed_ns, self.set_ns = 5 * HOUR, START_NS
        self.clock = ServiceClock(lambda: self.set_ns + self.passed_ns, lambda: self.passed_ns)

    def pass_(self, seconds):
        self.passed_ns += round(seconds * SECOND)


@pytest.fixture
def machine():
    return Machine()


def test_it_tells_utc_and_goes_with_the_time_that_passes(machine):
    assert machine.clock.now_ns() == START_NS + machine.passed_ns
    machine.pass_(100)
    assert machine.clock.now_ns() == START_NS + machine.passed_ns
    assert machine.clock.complaint() == ""


def test_a_clock_that_is_set_by_little_is_followed_step_by_step(machine):
    for _ in range(100):
        machine.set_ns += SECOND // 10
        machine.pass_(1)
        assert machine.clock.now_ns() == machine.set_ns + machine.passed_ns
        assert machine.clock.complaint() == ""


@pytest.mark.parametrize("leap_ns", [HOUR, -HOUR, 2 * SECOND])
def test_a_leap_is_not_followed_but_told_until_the_clock_is_right_again(machine, leap_ns):
    machine.pass_(10)
    machine.set_ns += leap_ns
    machine.pass_(10)
    assert machine.clock.now_ns() == START_NS + machine.passed_ns
    assert f"leapt by {leap_ns / SECOND:+.0f} s" in machine.clock.complaint()
    machine.set_ns -= leap_ns - SECOND // 2
    assert machine.clock.complaint() == ""
    assert machine.clock.now_ns() == machine.set_ns + machine.passed_ns


def test_time_in_which_nobody_asked_has_passed_all_the_same(machine):
    machine.pass_(7200)
    assert machine.clock.now_ns() == START_NS + machine.passed_ns


class Leaping(World):
    """A world whose service waits by a clock, and whose RTC's frames are told by time as it is."""

    def __init__(self, clock_of):
        self.machine = Machine()
        self.clock_ns = clock_of(self.machine)
        super().__init__(Mode.HOLD)

    def tell(self, event, after_s=0.0, cause=""):
        self.machine.pass_(after_s)
        kept = self.now_ns
        self.now_ns = self.clock_ns()
        effects = super().tell(event, cause=cause)
        self.now_ns = kept + round(after_s * SECOND)
        return effects

    def pass_(self, seconds):
        for _ in range(round(2 * seconds)):
            self.machine.pass_(0.5)
            super().pass_(0.5)
        return self


def seconds_to_a_window(world):
    """Live until a window has been accepted; return how long that took, at most a minute."""
    before = world.state.windows.accepted
    for k in range(120):
        if world.state.windows.accepted > before:
            return 0.5 * k
        world.pass_(0.5)
    return 60.0


def after_an_hour_ahead_and_back(world):
    """The RTC is busy for a moment meanwhile: the next dither is put off by ten seconds."""
    world.pass_(20)
    world.machine.set_ns += HOUR
    world.pass_(30)
    refused = dither_answered(world.state.dithers.dither.id, accepted=False, reason="busy: ramp")
    world.playing = None
    world.tell(refused)
    world.pass_(9)
    world.machine.set_ns -= HOUR
    return seconds_to_a_window(world)


def test_windows_are_found_again_within_five_seconds_of_an_hour_ahead_and_back():
    by_the_machine = Leaping(lambda machine: lambda: machine.set_ns + machine.passed_ns)
    assert after_an_hour_ahead_and_back(by_the_machine) == 60.0, "the test can fail"
    by_the_service = Leaping(lambda machine: machine.clock.now_ns)
    assert after_an_hour_ahead_and_back(by_the_service) <= 5.0
