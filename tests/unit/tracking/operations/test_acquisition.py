"""From nothing known to tracking, as a story told to the tracker."""

from dataclasses import replace

import numpy as np
import pytest

from service.records import commands as cmd
from service.records import events as ev
from service.records.estimates import RefusalKind, WideCaptureEstimate
from service.records.operations import AcquisitionStage
from service.records.products import MatrixState
from service.records.state import Mode
from service.tracking.dither_request import lock_in_plan, total_m
from service.tracking.operations.acquisition import (
    MAX_ATTEMPTS,
    MAX_DIVERGENCE_S,
    MAX_STAGE_DURATION_S,
    MAX_STAGE_MISSES,
    MISSES_BEFORE_ACQUISITION,
    MISSES_WHILE_TRACKING,
    wide_capture_dither,
)
from service.tracking.update_policy import fewer_modes_than
from service.wire import DitherStop, Loop, LoopRequest
from tests.support.acquiring import ACQUIRES, DIVERGING, FAR, Acquiring
from tests.support.situations import (
    POLICY,
    dither_answered,
    estimate,
    loop_answered,
    moved,
    of_kind,
    rtc,
    verdict,
)

LOST = ev.ConditionChanged(name="loop-lost", text="found")


def test_an_operator_is_led_from_nothing_to_tracking():
    story = Acquiring(Mode.PROPOSE)
    story.tell(cmd.Acquire())
    assert story.stage is AcquisitionStage.OPENING
    story.open()
    assert story.stage is AcquisitionStage.COARSE
    story.see_afar()
    assert story.stage is AcquisitionStage.CONFIRMING
    story.see_afar()
    assert story.stage is AcquisitionStage.PARTIAL
    story.close(150)
    assert story.stage is AcquisitionStage.WIDENING
    story.see(FAR)
    story.widen(400)
    story.see(FAR, n_windows=2)
    story.closed(400)
    assert story.stage is AcquisitionStage.TRACKING
    assert "400 modes" in story.text
    assert [made.n_modes for made in story.asked(ev.MakeMatrix)] == [150, 400]
    assert [sent.n_modes for sent in story.asked(ev.SendMatrix)] == [150, 400]


def test_the_two_dithers_have_no_mode_in_common_and_are_stopped_in_between():
    story = Acquiring().to_partial()
    far = story.far_dithers
    assert len(far) == 2
    assert not set(far[0].modes) & set(far[1].modes)
    assert len(story.asked(DitherStop)) >= 2


def test_reconstructors_are_judged_and_sent_with_the_gains_the_loop_was_found_with():
    story = Acquiring().to_partial()
    (made,) = story.asked(ev.MakeMatrix)
    assert made.gains == (0.4,) * 150 + (0.0,) * 444
    story.close(150)
    (sent,) = story.asked(ev.SendMatrix)
    assert sent.gains == made.gains


def test_a_loop_found_open_is_closed_with_a_low_gain_and_not_opened_first():
    story = Acquiring()
    story.status(loop="open", gains=(0.0,) * 594)
    story.tell(cmd.Acquire())
    assert story.stage is AcquisitionStage.COARSE
    assert not story.asked(LoopRequest)
    story.see_afar()
    story.see_afar()
    (made,) = story.asked(ev.MakeMatrix)
    assert set(made.gains[:150]) == {0.3}


class TestByItself:
    def test_it_begins_when_the_loop_goes_on_diverging(self):
        story = Acquiring()
        story.tell(DIVERGING)
        assert not story.wait(MAX_DIVERGENCE_S - 1)
        story.wait(2)
        assert story.stage is AcquisitionStage.OPENING
        assert [asked.loop for asked in story.asked(LoopRequest)] == [Loop.OPEN]

    def test_it_begins_at_once_when_the_loop_is_lost(self):
        story = Acquiring()
        story.tell(DIVERGING)
        story.tell(LOST, 0.1)
        assert story.stage is AcquisitionStage.OPENING
        assert [asked.loop for asked in story.asked(LoopRequest)] == [Loop.OPEN]

    @pytest.mark.parametrize("mode", [Mode.PROPOSE, Mode.HOLD, "forbidden", "dither stopped"])
    def test_only_in_auto_and_not_where_settings_or_an_operator_forbid_it(self, mode):
        story = Acquiring(policy=POLICY) if mode == "forbidden" else Acquiring()
        if mode == "dither stopped":
            story.tell(cmd.StopDither())
        elif mode != "forbidden":
            story.tell(cmd.SetMode(mode=mode))
        story.tell(DIVERGING)
        story.wait(60)
        assert not story.asked(LoopRequest)

    def test_it_begins_when_windows_find_no_registration(self):
        story = Acquiring()
        for _ in range(MISSES_BEFORE_ACQUISITION - 1):
            story.miss_afar("it is far away", RefusalKind.OUT_OF_REACH)
        assert story.stage is AcquisitionStage.IDLE
        story.miss_afar("it is far away", RefusalKind.OUT_OF_REACH)
        assert story.stage is AcquisitionStage.OPENING

    def test_a_loop_that_holds_well_is_not_opened_for_them(self):
        story = Acquiring()
        story.tell(ev.LoopHeld(holds=True))
        texts = set()
        for _ in range(2 * MISSES_WHILE_TRACKING):
            story.miss_afar("it is far away", RefusalKind.OUT_OF_REACH)
            alarms = story.state.alarms.active
            texts |= {a.text for a in alarms if a.name == "registration-not-found"}
        assert story.asked(LoopRequest) == []
        assert len(texts) == 1
        story.see()
        assert "registration-not-found" not in story.alarms

    def test_one_that_holds_no_longer_is(self):
        story = Acquiring()
        story.tell(ev.LoopHeld(holds=True))
        for _ in range(MISSES_BEFORE_ACQUISITION):
            story.miss_afar("it is far away", RefusalKind.OUT_OF_REACH)
        story.tell(ev.LoopHeld(holds=False))
        assert story.stage is AcquisitionStage.OPENING

    def test_with_alpha_known_bad_windows_must_go_on_for_longer(self):
        story = Acquiring()
        story.see(n_windows=3)
        for _ in range(MISSES_WHILE_TRACKING - 1):
            story.miss_afar("it is far away", RefusalKind.OUT_OF_REACH)
        assert story.stage is AcquisitionStage.IDLE
        story.miss_afar("it is far away", RefusalKind.OUT_OF_REACH)
        assert story.stage is AcquisitionStage.OPENING

    def test_a_window_that_is_accepted_ends_the_counting(self):
        story = Acquiring()
        for _ in range(3):
            story.miss_afar("it is far away", RefusalKind.OUT_OF_REACH)
            story.see()
        assert story.stage is AcquisitionStage.IDLE

    def test_windows_refused_for_another_reason_do_not_count(self):
        story = Acquiring()
        for _ in range(2 * MISSES_BEFORE_ACQUISITION):
            story.miss_afar("520 of 2000 frames missing", RefusalKind.OTHER)
        assert story.stage is AcquisitionStage.IDLE

    def test_it_does_not_begin_again_after_it_has_failed(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        command = story.asked(LoopRequest)[-1]
        story.tell(loop_answered(command.id, accepted=False, reason="busy"))
        story.tell(DIVERGING)
        n_before = len(story.asked(LoopRequest))
        story.wait(60)
        assert len(story.asked(LoopRequest)) == n_before
        assert "acquisition" in story.alarms

    def test_it_begins_again_when_an_rtc_that_vanished_is_back_and_diverges(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.tell(ev.RtcVanished())
        story.meet(session="s9")
        assert story.stage is AcquisitionStage.ABORTED
        story.tell(DIVERGING)
        story.wait(4)
        assert story.stage is AcquisitionStage.OPENING


class TestNothingWrong:
    def test_two_estimates_that_disagree_are_not_believed(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.open()
        story.see_afar()
        story.see_afar(moved(FAR, rotation_rad=np.deg2rad(3.0)))
        assert story.stage in {AcquisitionStage.OPENING, AcquisitionStage.COARSE}
        assert story.state.alpha.registration is None
        assert not story.asked(ev.MakeMatrix)

    @pytest.mark.parametrize("changes", [{"session": "s1"}, {"modes": (1, 2, 3)}])
    def test_a_window_of_another_session_or_of_other_modes_is_not_used(self, changes):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.open()
        own = {"session": "s2", "modes": story.state.dithers.dither.request.modes}
        found = estimate(FAR, **(own | changes))
        far = WideCaptureEstimate(estimate=found, unexplained=0.0, n_starts=1)
        story.tell(ev.WideCaptureFitted(found=far))
        assert story.stage is AcquisitionStage.COARSE

    def test_fewer_modes_are_made_where_the_gate_refuses_many(self):
        story = Acquiring().to_partial()
        (made,) = story.asked(ev.MakeMatrix)
        assert (made.n_modes, made.fewer) == (150, fewer_modes_than(150))
        story.close(60)
        (sent,) = story.asked(ev.SendMatrix)
        assert sent.gains == (0.4,) * 60 + (0.0,) * 534

    def test_when_no_number_of_modes_passes_the_gate_it_ends_with_the_loop_open(self):
        story = Acquiring().to_partial()
        story.make("cm-150", MatrixState.REFUSED, n_modes=150)
        assert story.stage is AcquisitionStage.FAILED
        assert not story.asked(ev.SendMatrix)
        assert [asked.loop for asked in story.asked(LoopRequest)] == [Loop.OPEN]
        assert story.state.alpha.registration is None

    def test_where_the_edge_would_slip_with_any_modes_a_leak_is_asked_for_first(self):
        story = Acquiring().to_partial()
        slips = replace(verdict(accepted=False), edge_motion_m=5e-7)
        story.make("cm-150", MatrixState.REFUSED, n_modes=150, gate=slips)
        asked = story.asked(LoopRequest)[-1]
        assert (asked.loop, asked.leak) == (None, 0.99)
        story.tell(loop_answered(asked.id, accepted=True, reason=""))
        story.still_open()
        assert len(story.asked(ev.MakeMatrix)) == 1
        story.still_open(leak=0.99)
        assert len(story.asked(ev.MakeMatrix)) == 2
        story.close(150)
        assert story.stage is AcquisitionStage.WIDENING

    def test_a_leak_that_does_not_help_ends_it(self):
        story = Acquiring().to_partial()
        slips = replace(verdict(accepted=False), edge_motion_m=5e-7)
        story.make("cm-150", MatrixState.REFUSED, n_modes=150, gate=slips)
        story.still_open(leak=0.99)
        story.make("cm-151", MatrixState.REFUSED, n_modes=150, gate=slips)
        assert story.stage is AcquisitionStage.FAILED

    def test_a_matrix_asked_for_before_it_began_is_not_sent(self):
        story = Acquiring()
        story.see(n_windows=3)
        assert story.asked(ev.MakeMatrix)
        story.tell(cmd.Acquire())
        story.make("cm-late")
        assert not story.asked(ev.SendMatrix)

    def test_more_modes_that_the_gate_refuses_are_done_without(self):
        story = Acquiring().to_widening()
        story.see(FAR)
        asked = story.asked(ev.MakeMatrix)[-1]
        assert (asked.n_modes, asked.fewer[0], asked.fewer[-1]) == (400, 381, 151)
        story.make("cm-400", MatrixState.REFUSED, n_modes=400)
        story.see(FAR)
        story.widen(150)
        story.see(FAR, n_windows=2)
        story.closed(150)
        assert story.stage is AcquisitionStage.TRACKING
        assert "150 of 400" in story.text


class TestTrouble:
    def test_a_loop_that_slips_is_opened_again_and_closed_on_fewer_modes(self):
        story = Acquiring().to_widening()
        story.tell(ev.ConditionChanged(name="edge-slip", text="found"))
        assert story.stage is AcquisitionStage.OPENING
        assert story.asked(LoopRequest)[-1].loop is Loop.OPEN
        story.tell(ev.ConditionChanged(name="edge-slip", text="gone", over=True))
        story.open()
        story.see_afar()
        story.see_afar()
        assert story.asked(ev.MakeMatrix)[-1].n_modes == 75
        assert story.state.matrices.mode_limit.n_modes == 75

    def test_one_that_slips_once_it_tracks_is_acquired_anew_on_half_as_many_modes(self):
        """More are tried after a while, and after a longer one when it slips again."""
        story = Acquiring(Mode.AUTO).to_widening()
        story.see(FAR)
        story.widen(400)
        story.see(FAR, n_windows=3)
        assert story.stage is AcquisitionStage.TRACKING
        story.tell(ev.ConditionChanged(name="edge-slip", text="found"))
        story.wait(3)
        assert story.stage is AcquisitionStage.OPENING
        assert story.state.operations.acquisition.max_modes == 200
        limit = story.state.matrices.mode_limit
        assert (limit.n_modes, limit.reason) == (200, "edge-slip with 400 modes")

    @pytest.mark.parametrize(
        ("to", "n_modes"),
        [(moved(FAR, shift_x_subap=0.3), 400), (moved(FAR, shift_x_subap=0.02), 200)],
    )
    def test_a_loop_lost_because_the_mirror_jumped_is_closed_on_all_modes_again(self, to, n_modes):
        """Where the mirror is where it was, all modes did not hold, and half of them follow."""
        story = Acquiring(Mode.AUTO).to_widening()
        story.see(FAR)
        story.widen(400)
        story.see(FAR, n_windows=3)
        assert story.stage is AcquisitionStage.TRACKING
        story.tell(DIVERGING)
        story.tell(LOST)
        assert story.state.matrices.mode_limit.n_modes == 200
        story.open()
        story.see_afar(to)
        story.see_afar(to)
        story.close(150)
        story.see(to)
        assert story.asked(ev.MakeMatrix)[-1].n_modes == n_modes
        limit = story.state.matrices.mode_limit
        assert limit is None if n_modes == 400 else limit.n_modes == 200

    def test_that_a_loop_slips_on_the_rtcs_own_matrix_says_nothing_of_the_modes(self):
        story = Acquiring(Mode.AUTO)
        story.tell(ev.ConditionChanged(name="edge-slip", text="found"))
        story.wait(3)
        assert story.stage is AcquisitionStage.OPENING
        assert story.state.operations.acquisition.max_modes is None
        assert story.state.matrices.mode_limit is None

    def test_windows_that_lead_nowhere_begin_it_anew_and_end_it_after_a_few_attempts(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.open()
        for _ in range(MAX_ATTEMPTS * MAX_STAGE_MISSES):
            assert story.state.operations.acquisition.under_way
            story.miss_afar()
            story.still_open()
        assert story.stage is AcquisitionStage.FAILED
        assert "acquisition" in story.alarms

    def test_windows_that_were_never_looked_at_do_not_count(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.open()
        for _ in range(2 * MAX_STAGE_MISSES):
            story.miss_afar("the worker is too slow: a window was given up", RefusalKind.OTHER)
        assert story.state.operations.acquisition.attempt == 1

    def test_a_stage_that_takes_too_long_begins_it_anew(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.open()
        story.wait(MAX_STAGE_DURATION_S + 2)
        assert story.state.operations.acquisition.attempt == 2

    def test_an_rtc_that_begins_anew_is_looked_at_anew(self):
        story = Acquiring().to_widening()
        story.session += 1
        story.tell(ev.SessionStarted(session=f"s{story.session}"))
        assert story.stage is AcquisitionStage.OPENING
        assert story.state.operations.acquisition.attempt == 2

    def test_a_refused_dither_is_asked_for_again(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.open()
        dither = story.state.dithers.dither
        refused = dither_answered(dither.id, accepted=False, reason="busy", start_seq=None)
        story.tell(refused)
        for _ in range(12):
            story.still_open()
            story.wait(1)
        assert len(story.far_dithers) == 2

    def test_dithers_that_are_refused_again_and_again_begin_it_anew(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.open()
        for n_refused in range(1, MAX_STAGE_MISSES + 1):
            dither = story.state.dithers.dither
            story.tell(dither_answered(dither.id, accepted=False, reason="busy", start_seq=None))
            attempt = story.state.operations.acquisition.attempt
            assert attempt == (1 if n_refused < MAX_STAGE_MISSES else 2)
            for _ in range(11):
                story.still_open()
                story.wait(1)

    def test_a_request_to_open_the_loop_without_an_answer_begins_it_anew(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        (request,) = story.asked(LoopRequest)
        story.tell(ev.JobFailed(effect=ev.Ask(request=request), text="no answer came"))
        assert story.state.operations.acquisition.attempt == 2
        assert len(story.asked(LoopRequest)) == 2

    def test_a_reconstructor_the_rtc_rejects_begins_it_anew(self):
        story = Acquiring().to_partial()
        story.make("cm-150", n_modes=150)
        story.acknowledge("cm-150", MatrixState.REJECTED, reason="wrong basis")
        story.still_open()
        assert story.state.operations.acquisition.attempt == 2
        assert "wrong basis" in story.text or "looking" in story.text

    def test_a_loop_somebody_closes_meanwhile_is_opened_again(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.open()
        story.closed(400)
        assert story.stage is AcquisitionStage.OPENING
        assert len(story.asked(LoopRequest)) == 2


class TestOperator:
    def test_who_aborts_gets_a_healthy_loop_back_as_it_was(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.open()
        story.tell(cmd.AbortAcquisition())
        assert story.stage is AcquisitionStage.ABORTED
        last = story.asked(LoopRequest)[-1]
        assert (last.loop, last.gains, last.leak) == (Loop.CLOSED, None, 0.999)
        assert story.asked(DitherStop)

    def test_who_aborts_gets_a_diverging_loop_open(self):
        story = Acquiring()
        story.tell(DIVERGING)
        story.tell(cmd.Acquire())
        story.open()
        story.tell(cmd.AbortAcquisition())
        assert [asked.loop for asked in story.asked(LoopRequest)] == [Loop.OPEN]

    def test_who_aborts_late_keeps_the_loop_on_its_judged_matrix(self):
        story = Acquiring().to_widening()
        n_asked = len(story.asked(LoopRequest))
        story.tell(cmd.AbortAcquisition())
        assert len(story.asked(LoopRequest)) == n_asked
        assert story.state.alpha.registration is not None

    def test_stopping_the_dither_aborts_it(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.open()
        story.tell(cmd.StopDither())
        assert story.stage is AcquisitionStage.ABORTED

    def test_hold_leaves_alone_what_was_asked_for(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        story.tell(cmd.SetMode(mode=Mode.HOLD))
        assert story.state.operations.acquisition.under_way


def test_the_loop_open_alarm_is_kept_quiet_meanwhile():
    story = Acquiring()
    story.tell(cmd.Acquire())
    story.open()
    assert "loop-open" not in story.alarms


def test_the_far_dither_is_as_strong_as_settings_and_rtc_allow():
    dither = wide_capture_dither(AcquisitionStage.COARSE, rtc(max_dither_m=2e-8), ACQUIRES, 0)
    assert set(dither.request.amplitude_m) == {2e-8}
    dither = wide_capture_dither(AcquisitionStage.COARSE, rtc(), ACQUIRES, 0)
    assert set(dither.request.amplitude_m) == {5e-8}


@pytest.mark.parametrize("rate_hz", [300.0, 300.00003, 499.99, 999.9993, 1000.0, 2000.017])
@pytest.mark.parametrize("stage", [AcquisitionStage.COARSE, AcquisitionStage.CONFIRMING])
def test_its_dithers_can_be_read_at_any_frame_rate(rate_hz, stage):
    view = rtc(frame_rate_hz=rate_hz)
    dither = wide_capture_dither(stage, view, POLICY, 0)
    assert lock_in_plan(dither, view, 2.0).n_frames == round(2.0 * rate_hz)
    # a status whose rate differs by parts per million reads it all the same
    assert lock_in_plan(dither, rtc(frame_rate_hz=rate_hz * (1.0 + 2.3e-6)), 2.0)


def test_one_whose_dither_cannot_be_read_ends_and_says_why():
    story = Acquiring()
    story.tell(cmd.Acquire())
    story.open()
    story.tell(ev.DitherUnusable(text="600 frames cut a period"))
    assert story.stage is AcquisitionStage.FAILED
    assert "600 frames cut a period" in story.text


@pytest.mark.parametrize(("ratio", "stage"), [(3.0, "failed"), (1.05, "coarse")])
def test_one_whose_dither_is_too_strong_ends(ratio, stage):
    story = Acquiring()
    story.tell(cmd.Acquire())
    story.open()
    dither = story.state.dithers.dither
    asked_m = total_m(dither.request)
    found = ev.DitherMeasured(
        id=dither.id, found_m=ratio * asked_m, asked_m=asked_m, text="other than requested"
    )
    effects = story.tell(found)
    assert story.stage == stage
    assert bool(of_kind(effects, DitherStop)) is (stage == "failed")


def test_one_in_whose_dithers_no_window_ever_ends_comes_to_an_end():
    story = Acquiring()
    story.tell(cmd.Acquire())
    story.open()
    for _ in range(1200):
        dither = story.state.dithers.dither
        if story.stage is AcquisitionStage.FAILED:
            break
        if story.stage is AcquisitionStage.OPENING:
            story.still_open()
        if dither is not None and dither.start_seq is None:
            story.tell(dither_answered(dither.id, accepted=True, reason="", start_seq=story.now_ns))
        story.still_open()
        story.tell(ev.Tick(), 1.0)
    assert story.stage is AcquisitionStage.FAILED
    assert len(story.far_dithers) < 60
