"""A service that lives and stands still is found out."""

from service.runtime.supervisor import MAX_ROUND_S, Heartbeat


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


def test_a_part_that_goes_on_is_well_and_one_that_stands_still_is_named():
    clock = Clock()
    heart = Heartbeat(clock)
    heart.beat("the tick")
    heart.beat("the intake")
    clock.now_s += MAX_ROUND_S - 1.0
    heart.beat("the intake")
    assert not heart.stalled
    clock.now_s += 2.0
    assert heart.stalled.startswith("the tick has stood still for 31 s, expected a round within")
    assert "the intake" not in heart.stalled
    heart.beat("the tick")
    assert not heart.stalled


def test_what_has_not_begun_cannot_stand_still():
    clock = Clock()
    heart = Heartbeat(clock)
    clock.now_s += 1e6
    assert not heart.stalled
