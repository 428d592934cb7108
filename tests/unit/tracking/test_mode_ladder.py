"""Fewer modes where the gate will not have more, and more again later."""

from copy import copy
from dataclasses import replace
from itertools import pairwise

import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.products import MatrixState
from service.records.state import Mode
from service.tracking.update_policy import (
    DECLINED_MODES_DELAY_S,
    FIRST_MODES_DELAY_S,
    MAX_MODES_DELAY_S,
    MIN_TRIED_MODES,
    fewer_modes_than,
)
from tests.support.situations import POLICY, Story, judged, moved, of_kind, record, rtc, verdict

WANTED = replace(POLICY, n_modes_target=500)


class Night(Story):
    """A night in which reconstructors are made as the gate allows."""

    def __init__(self, mode=Mode.AUTO, policy=WANTED, n_controlled=400):
        super().__init__(mode, policy)
        self.meet(n_controlled=n_controlled, gains=rtc(n_controlled).gains)
        self.made = 0

    def make_for(self, effect, n_modes, *, state=MatrixState.PROPOSED, why=""):
        """Answer a request with a reconstructor of so many modes, and let the RTC apply it."""
        self.made += 1
        name = f"cm-{self.made}"
        made = record(
            name,
            state,
            n_modes=n_modes,
            created_ns_utc=self.now_ns,
            alpha=self.state.alpha.registration.alpha,
            judged=judged(self.state.alpha.registration, self.state.loop.rtc, n_modes),
        )
        effects = self.tell(
            ev.MatrixMade(record=made, wanted=False, asked_modes=effect.n_modes, why_fewer=why)
        )
        if of_kind(effects, ev.SendMatrix):
            self.acknowledge(name)
            self.tell(replace(rtc(n_modes), cm_id=name))
        return effects

    def lowered(self, n_modes=300):
        """Be at 500 modes, find the margin short, and get fewer."""
        (first,) = of_kind(self.see(n_windows=2), ev.MakeMatrix)
        self.make_for(first, 400)
        (more,) = of_kind(self.wait(6), ev.MakeMatrix)
        self.make_for(more, 500)
        short = verdict(accepted=False, radius=0.97)
        self.wait(6)
        effects = self.tell(ev.MarginJudged(id=self.state.matrices.in_use, verdict=short))
        (fewer,) = of_kind((*effects, *self.wait(5)), ev.MakeMatrix)
        self.make_for(fewer, n_modes, why="500 modes: too little margin")
        return self


def test_every_request_of_the_services_own_names_fewer_modes_to_try():
    (effect,) = of_kind(Night().see(n_windows=2), ev.MakeMatrix)
    assert effect.n_modes == 400
    assert effect.fewer == fewer_modes_than(400)
    assert (effect.fewer[0], effect.fewer[-1]) == (381, 30)


@pytest.mark.parametrize(("n_modes", "n_trials"), [(5000, 7), (594, 6), (500, 6), (45, 4)])
def test_no_number_is_far_below_the_next_and_a_few_trials_find_the_most_that_pass(
    n_modes, n_trials
):
    """400 modes take a second each, and no fewer than thirty are tried."""
    tried = (n_modes, *fewer_modes_than(n_modes))
    assert all(upper > lower >= 0.93 * upper for upper, lower in pairwise(tried))
    assert MIN_TRIED_MODES <= tried[-1] <= MIN_TRIED_MODES + 2
    assert len(tried) - 1 < 2**n_trials
    assert [fewer_modes_than(few) for few in (1, 30, 31)] == [()] * 3


def test_raising_never_ends_below_the_present_number():
    night = Night()
    (first,) = of_kind(night.see(n_windows=2), ev.MakeMatrix)
    night.make_for(first, 400)
    night.policy = replace(WANTED, n_modes_target=594)
    (more,) = of_kind(night.wait(6), ev.MakeMatrix)
    assert (more.n_modes, more.fewer) == (594, (566, 539, 513, 489, 465, 443, 422, 402))


def test_a_short_margin_lowers_the_number_of_modes_and_says_why():
    night = Night().lowered()
    assert night.state.loop.rtc.n_controlled == 300
    entry = next(e for e in night.state.log if e.name == "modes.lowered")
    assert entry.text.endswith("has 300 modes, 500 are controlled: 500 modes: too little margin")
    assert night.state.matrices.mode_limit.n_modes == 300


def test_more_are_tried_after_a_wait_while_the_margin_is_comfortable():
    night = Night().lowered()
    assert not of_kind(night.wait(FIRST_MODES_DELAY_S - 5), ev.MakeMatrix)
    (more,) = of_kind(night.wait(10), ev.MakeMatrix)
    assert (more.n_modes, more.fewer[0], more.fewer[-1]) == (500, 476, 307)


@pytest.mark.parametrize("radius", [0.93, 0.949])
def test_but_not_while_the_margin_is_only_just_enough(radius):
    night = Night().lowered()
    night.tell(ev.MarginJudged(id=night.state.matrices.in_use, verdict=verdict(radius=radius)))
    assert not of_kind(night.wait(3 * FIRST_MODES_DELAY_S), ev.MakeMatrix)


def test_a_raise_the_gate_refuses_doubles_the_wait_publishes_nothing_and_holds_back_no_update():
    night = Night().lowered()
    (more,) = of_kind(night.wait(FIRST_MODES_DELAY_S + 5), ev.MakeMatrix)
    sent = len(night.asked(ev.SendMatrix))
    night.make_for(more, 500, state=MatrixState.REFUSED)
    assert len(night.asked(ev.SendMatrix)) == sent
    assert night.state.matrices.mode_limit.wait_s == 2 * FIRST_MODES_DELAY_S
    (update,) = of_kind(copy(night).see(moved(shift_x_subap=0.05), n_windows=4), ev.MakeMatrix)
    assert (update.n_modes, update.why[:8]) == (300, "moved by")
    assert not of_kind(night.wait(2 * FIRST_MODES_DELAY_S - 5), ev.MakeMatrix)
    assert of_kind(night.wait(10), ev.MakeMatrix)


def test_a_raise_that_passes_is_published_and_logged():
    night = Night().lowered()
    (more,) = of_kind(night.wait(FIRST_MODES_DELAY_S + 5), ev.MakeMatrix)
    night.make_for(more, 500)
    assert night.state.loop.rtc.n_controlled == 500
    assert night.state.log[-1].name != "modes.lowered"
    raised = [e.text for e in night.state.log if e.name == "modes.raised"]
    assert raised[-1].endswith("has 500 modes, 300 are controlled")


def test_a_number_lowered_again_soon_waits_longer_and_never_for_ever():
    night = Night().lowered()
    waits = []
    for _ in range(8):
        limit = night.state.matrices.mode_limit
        waits.append(limit.wait_s)
        n_windows = round(limit.wait_s / 30) + 2
        (more,) = of_kind(night.see(n_windows=n_windows, every_s=30), ev.MakeMatrix)
        night.make_for(more, 500, state=MatrixState.REFUSED)
    assert waits[:4] == [60.0, 120.0, 240.0, 480.0]
    assert max(waits) == MAX_MODES_DELAY_S


def test_in_propose_fewer_modes_are_a_proposal_and_nothing_is_sent():
    night = Night(Mode.PROPOSE)
    (first,) = of_kind(night.see(n_windows=2), ev.MakeMatrix)
    night.make_for(first, 200, why="400 modes: too little margin")
    assert not night.asked(ev.SendMatrix)
    assert night.matrix_state("cm-1") is MatrixState.PROPOSED


def test_in_hold_nothing_is_made_however_short_the_margin():
    night = Night(Mode.HOLD)
    night.see(n_windows=2)
    short = verdict(accepted=False, radius=0.99)
    night.tell(ev.MarginJudged(id="initial", verdict=short))
    night.wait(60)
    assert not night.asked(ev.MakeMatrix)
    assert "margin" in night.alarms


def test_an_operators_own_number_is_neither_lowered_nor_raised():
    night = Night(Mode.HOLD)
    night.see(n_windows=2)
    (effect,) = of_kind(night.tell(cmd.Refit(n_modes=450)), ev.MakeMatrix)
    assert effect.fewer == ()


class Declined(Night):
    """A night with 400 modes in use whose 500 somebody will not have."""

    def __init__(self, mode=Mode.AUTO):
        super().__init__()
        (first,) = of_kind(self.see(n_windows=2), ev.MakeMatrix)
        self.make_for(first, 400)
        self.tell(cmd.SetMode(mode=mode))

    def for_s(self, seconds, decline):
        """Let windows come for so long; every reconstructor asked for is made and declined."""
        asked = []
        for _ in range(round(seconds / 10.0)):
            for effect in of_kind(self.see(every_s=10.0), ev.MakeMatrix):
                asked.append(effect)
                made = self.make_for_nobody(effect)
                decline(self, f"cm-{self.made}", made)
        return asked

    def make_for_nobody(self, effect):
        self.made += 1
        registration = self.state.alpha.registration
        made = record(
            f"cm-{self.made}",
            n_modes=effect.n_modes,
            created_ns_utc=self.now_ns,
            alpha=registration.alpha,
            sigma=registration.sigma,
            judged=judged(registration, self.state.loop.rtc, effect.n_modes),
        )
        return self.tell(ev.MatrixMade(record=made, wanted=False, asked_modes=effect.n_modes))


def the_operator(night, name, _effects):
    night.tell(cmd.Reject(id=name, reason="400 will do"))


def the_rtc_rejects(night, name, _effects):
    night.acknowledge(name, MatrixState.REJECTED, reason="at most 400")


def the_rtc_refuses_the_modes(night, _name, effects):
    (sent,) = of_kind(effects, ev.SendMatrix)
    night.tell(ev.JobFailed(effect=sent, text="the RTC will not control 500 modes: range"))


def nobody_answers(night, _name, _effects):
    night.wait(5)


def test_an_operator_who_declines_more_modes_is_not_asked_again_for_an_hour():
    night = Declined(Mode.PROPOSE)
    assert [made.n_modes for made in night.for_s(DECLINED_MODES_DELAY_S - 60, the_operator)] == [
        500
    ]
    limit = night.state.matrices.mode_limit
    assert (limit.n_modes, limit.wait_s) == (400, DECLINED_MODES_DELAY_S)
    assert limit.reason == "cm-2 was discarded: 400 will do"
    assert [made.n_modes for made in night.for_s(120, the_operator)] == [500]


@pytest.mark.parametrize("decline", [the_rtc_rejects, the_rtc_refuses_the_modes, nobody_answers])
def test_an_rtc_that_will_not_have_more_modes_is_asked_less_and_less(decline):
    night = Declined()
    asked = night.for_s(900, decline)
    assert [made.n_modes for made in asked] == [500] * 4  # 60, 120, 240, 480 s
    assert night.state.matrices.mode_limit.wait_s == 480.0


def test_so_is_a_gate_that_judges_more_modes_again_and_then_refuses_them():
    night = Declined(Mode.PROPOSE)
    (more,) = of_kind(night.wait(6), ev.MakeMatrix)
    night.make_for(more, 500)
    judged = night.state.reconstructor("cm-2").judged
    no = verdict(accepted=False, radius=0.97)
    night.tell(ev.ProposalJudged(id="cm-2", verdict=no, judged=judged))
    assert night.matrix_state("cm-2") is MatrixState.REFUSED
    assert (night.state.matrices.mode_limit.n_modes, night.state.matrices.mode_limit.wait_s) == (
        400,
        FIRST_MODES_DELAY_S,
    )
    assert not of_kind(night.wait(FIRST_MODES_DELAY_S - 5), ev.MakeMatrix)


def test_updates_of_the_modes_in_use_go_on_meanwhile():
    night = Declined(Mode.PROPOSE)
    night.for_s(20, the_operator)
    (update,) = of_kind(night.see(moved(shift_x_subap=0.05), n_windows=4), ev.MakeMatrix)
    assert (update.n_modes, update.why[:8]) == (400, "moved by")


def test_declining_an_update_of_the_modes_in_use_says_nothing_of_more():
    night = Declined(Mode.PROPOSE)
    night.policy = replace(WANTED, n_modes_target=400)
    (update,) = of_kind(night.see(moved(shift_x_subap=0.05), n_windows=4), ev.MakeMatrix)
    night.make_for(update, 400)
    night.tell(cmd.Reject(id="cm-2"))
    assert night.state.matrices.mode_limit is None


def test_a_proposal_that_another_one_replaces_has_not_been_declined():
    night = Declined(Mode.PROPOSE)
    (more,) = of_kind(night.wait(6), ev.MakeMatrix)
    night.make_for(more, 500)
    night.make("cm-other", n_modes=400)
    assert night.matrix_state("cm-2") is MatrixState.DISCARDED
    assert night.state.matrices.mode_limit is None


def test_an_operators_own_request_for_more_is_heard_at_once_and_lifts_the_limit():
    night = Declined(Mode.PROPOSE)
    night.for_s(20, the_operator)
    (asked,) = of_kind(night.tell(cmd.Refit(n_modes=500)), ev.MakeMatrix)
    night.make_for(asked, 500)
    assert night.state.matrices.mode_limit.n_modes == 500


def test_a_limit_found_by_the_gate_does_not_shorten_an_operators_no():
    night = Declined(Mode.PROPOSE)
    night.for_s(20, the_operator)
    until_ns = night.state.matrices.mode_limit.until_ns_utc
    (asked,) = of_kind(night.tell(cmd.Refit(n_modes=500)), ev.MakeMatrix)
    night.make_for(asked, 500, state=MatrixState.REFUSED)
    assert night.state.matrices.mode_limit.until_ns_utc >= until_ns
