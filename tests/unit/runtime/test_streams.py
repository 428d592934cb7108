from dataclasses import replace

import numpy as np
import pytest

from service.errors import CommandError
from service.estimation.description import LOW_MODES, Description
from service.estimation.dither_monitor import DitherWatch
from service.estimation.dither_windows import DitherWindows
from service.estimation.health import LoopHealth, VibrationMonitor
from service.estimation.lockin import LockIn, Spectra
from service.estimation.loopcheck import LoopCheck
from service.estimation.passive import Passive
from service.estimation.random_dither import Correlated
from service.records import events as ev
from service.records.alarms import Alarm
from service.records.estimates import WindowRefused
from service.records.messages import as_message
from service.records.operations import DitherPurpose
from service.records.products import MatrixState, ModeSet
from service.runtime.engine import (
    IDLE_GATHER_S,
    Engine,
    detect_changes,
    shape_mismatch,
)
from service.runtime.estimator_bank import (
    EstimatorBank,
    process_block,
    with_dither,
    with_matrix,
    with_rtc,
)
from service.tracking.dither_request import plan_random
from service.wire import DitherKind, DitherRequest
from tests.support import handmade
from tests.support.loopcheck import GAIN, INVERSE, LEAK, blocks, closed_loop
from tests.support.situations import POLICY, START_NS, foreign, rtc
from tests.support.states import changed, tracker_state
from tests.support.streams import (
    DESCRIPTION,
    DITHER,
    MANY,
    N_MANY,
    N_MODES,
    N_SLOPES,
    REQUEST,
    RING,
    RTC,
    WINDOW_S,
    block,
    driven,
)


def played(start_seq=0, window_s=None, **changes):
    request = replace(REQUEST, **changes)
    return replace(DITHER, request=request, start_seq=start_seq, window_s=window_s)


@pytest.fixture
def streams():
    return with_dither(with_rtc(EstimatorBank.of(DESCRIPTION), RTC), DITHER, WINDOW_S)


def play(streams, first_seq, n_blocks, **changes):
    windows = []
    for index in range(n_blocks):
        streams, ended = process_block(streams, block(first_seq + 100 * index, **changes))
        windows += ended
    return streams, windows


def test_the_first_window_begins_when_the_loop_has_settled_and_each_lasts_as_long_as_asked(streams):
    _, windows = play(streams, 0, 14)
    assert [(type(w), w.first_seq) for w in windows] == [(Spectra, 300), (Spectra, 800)]
    assert windows[0].cm_id == "initial"


def test_a_dither_the_rtc_has_not_accepted_yet_opens_nothing(streams):
    waiting = played(id="dither-2", start_seq=None)
    assert with_dither(streams, waiting, WINDOW_S)[DitherWindows].cutter is None


def test_the_same_dither_keeps_its_open_window(streams):
    streams, _ = play(streams, 0, 5)
    assert streams[DitherWindows].cutter.window is not None
    assert with_dither(streams, DITHER, WINDOW_S) is streams


def test_another_dither_starts_another_series(streams):
    streams, _ = play(streams, 0, 5)
    streams = with_dither(streams, played(id="dither-2", start_seq=5000), WINDOW_S)
    assert streams[DitherWindows].cutter.window is None
    assert streams[DitherWindows].cutter.plan.first_seq == 5300


@pytest.mark.parametrize(
    "changes", [{"gains": (0.3,) * 4 + (0.0,) * 4}, {"leak": 0.99}, {"loop": "partial"}]
)
def test_another_loop_makes_the_open_window_void(streams, changes):
    streams, _ = play(streams, 0, 6)
    streams = with_rtc(streams, replace(RTC, **changes))
    assert streams[DitherWindows].cutter.window is None
    _, windows = play(streams, 600, 6)
    assert [w.first_seq for w in windows] == [600]


@pytest.mark.parametrize("read_late_by", [0, 100])
def test_the_next_window_is_counted_from_the_status_not_from_when_it_was_read(
    streams, read_late_by
):
    changed = replace(RTC, leak=0.99, seq=549)
    streams, _ = play(streams, 0, (600 + read_late_by) // 100)
    _, windows = play(with_rtc(streams, changed), 600 + read_late_by, 8)
    # 0.3 s after frame 549, whichever block the status was read behind
    assert [w.first_seq for w in windows] == [849]


def test_the_same_loop_seen_again_keeps_everything(streams):
    streams, _ = play(streams, 0, 6)
    again = with_rtc(streams, replace(RTC, t_ns=5, magnitude=9.0, cm_id="cm-1"))
    assert again[DitherWindows].cutter is streams[DitherWindows].cutter
    assert again[Passive] is streams[Passive]


def test_frames_of_another_session_are_left_alone(streams):
    after, windows = play(streams, 0, 14, session="s2")
    assert after is streams
    assert not windows


def test_without_an_rtc_nothing_is_taken_in(streams):
    gone = with_rtc(streams, None)
    after, windows = play(gone, 0, 14)
    assert (after[DitherWindows].cutter, after[Passive].n_modes, windows) == (None, 0, [])


def test_a_dither_goes_on_after_the_rtc_was_not_trusted_for_a_while(streams):
    back = with_dither(with_rtc(with_rtc(streams, None), RTC), DITHER, WINDOW_S)
    _, windows = play(back, 1000, 6)
    assert [w.first_seq for w in windows] == [1000]


def test_the_watchdog_counts_closed_loop_frames_only(streams):
    closed, _ = play(streams, 0, 3)
    opened, _ = play(with_rtc(streams, replace(RTC, loop="open")), 0, 3)
    assert closed[Passive].tail is not None
    assert opened[Passive].tail is None


def test_a_loop_whose_high_modes_run_away_is_diverging_and_calms_down_again(streams):
    calm, _ = play(streams, 0, 20, scale=1e-8)
    assert not calm[LoopHealth].diverging
    wild, _ = play(calm, 2000, 20, scale=1e-6)
    assert wild[LoopHealth].diverging
    calm, _ = play(wild, 4000, 60, scale=1e-8)
    assert not calm[LoopHealth].diverging


def test_lines_that_cannot_be_told_apart_give_no_window_and_say_why(streams):
    close = played(id="d2", modes=(6, 7), amplitude_m=(1e-9,) * 2, frequency_hz=(240.0, 242.0))
    found = with_dither(streams, close, WINDOW_S)
    assert found[DitherWindows].cutter is None
    assert "closer than 4 bins" in found.loop.dither.why_unreadable


def test_an_rtc_of_another_shape_is_described_with_both_shapes():
    assert shape_mismatch(DESCRIPTION, RTC) is None
    text = shape_mismatch(DESCRIPTION, replace(RTC, n_slopes=10))
    assert text == (
        "the RTC has 10 slopes and 8 modes, the instrument file 6 and 8: wrong instrument file?"
    )
    pixels = shape_mismatch(DESCRIPTION, replace(RTC, n_slopes=2 * N_SLOPES))
    assert pixels.endswith('they look like pixels: is it slopes.kind = "intensity"?')
    slopes = shape_mismatch(DESCRIPTION, replace(RTC, n_slopes=N_SLOPES // 2))
    assert slopes.endswith('they look like x and y slopes: is it slopes.kind = "xy"?')


class TestCommandsOffTheLoop:
    R = np.random.default_rng(5).standard_normal((4, N_SLOPES)).astype(np.float32) * 1e-9

    def telemetry(self, n_blocks, *, stroke_m=1.0, from_frame=0):
        """Blocks whose commands follow from their slopes, up to a stroke from some frame on."""
        blocks = [block(100 * index) for index in range(n_blocks)]
        slopes = np.concatenate([b.slopes for b in blocks])
        own = np.zeros((len(slopes) + 2, N_MODES), np.float32)
        for k in range(len(slopes)):
            own[k + 2] = np.float32(RTC.leak) * own[k + 1]
            own[k + 2, :4] -= np.float32(0.4) * (self.R @ slopes[k])
            if k >= from_frame:
                np.clip(own[k + 2], -stroke_m, stroke_m, out=own[k + 2])
        return [
            replace(b, commands_m=own[100 * i : 100 * i + 100] + b.dither_m)
            for i, b in enumerate(blocks)
        ]

    def play(self, streams, blocks, *, status_every=2):
        windows, off = [], []
        for number, frames in enumerate(blocks):
            streams, ended = process_block(streams, frames)
            windows += ended
            if number % status_every == 0:
                seq = frames.first_seq + frames.n_frames - 1
                streams = with_rtc(streams, replace(streams.loop.rtc, seq=seq))
                off.append(streams[LoopCheck].residual is not None)
        return streams, windows, off

    def test_a_loop_that_obeys_gives_its_windows(self, streams):
        streams = with_matrix(streams, "initial", self.R)
        _, windows, off = self.play(streams, self.telemetry(30))
        assert [type(w) for w in windows] == [Spectra] * 5
        assert not any(off)

    def test_a_saturated_mirror_gives_none_and_is_named_within_two_seconds(self, streams):
        streams = with_matrix(streams, "initial", self.R)
        streams, windows, off = self.play(streams, self.telemetry(30, stroke_m=5e-10))
        assert [type(w) for w in windows] == [WindowRefused] * 5
        assert off.index(True) * 0.2 < 2.0
        assert "4 of 4 modes" in streams[LoopCheck].residual.text

    @pytest.mark.parametrize("from_frame", [2300, 2700, 3100, 3500, 3900, 4300])
    def test_whenever_it_begins_to_saturate_that_is_named_in_time(self, streams, from_frame):
        """Frames wait half a second besides, and 3 s are promised: also just after a window."""
        streams = with_matrix(with_dither(streams, None, 2.0), "initial", self.R)
        streams = with_dither(streams, played(id="dither-2"), 2.0)
        blocks = self.telemetry(70, stroke_m=5e-10, from_frame=from_frame)
        _, windows, off = self.play(streams, blocks, status_every=5)
        assert [type(windows[k]) for k in (0, -1)] == [Spectra, WindowRefused]
        assert (500 * off.index(True) + 100 - from_frame) / 1000 <= 2.4

    def test_what_a_window_shows_need_not_be_asked_again(self, streams):
        streams = with_matrix(streams, "initial", self.R)
        for window_s, obeyed_seq in ((0.5, 0), (1.0, 1299)):
            begun = with_dither(streams, played(id=f"of {window_s}"), window_s)
            for frames in self.telemetry(14):
                begun, _ = process_block(begun, frames)
            assert begun[LoopCheck].obeyed_seq == obeyed_seq

    def test_nobody_is_blamed_for_a_matrix_that_is_not_known(self, streams):
        blocks = self.telemetry(30, stroke_m=5e-10)
        _, windows, off = self.play(with_matrix(streams, "other", self.R), blocks)
        assert [type(w) for w in windows] == [Spectra] * 5
        assert not any(off)

    def test_frames_before_a_changed_loop_was_told_are_not_held_against_it(self, streams):
        blocks = self.telemetry(40)
        streams = with_matrix(with_rtc(streams, replace(RTC, leak=0.5)), "initial", self.R)
        for number, frames in enumerate(blocks):
            streams, _ = process_block(streams, frames)
            told = replace(streams.loop.rtc, leak=RTC.leak, seq=frames.first_seq + 99)
            if number == 4:
                told_before = replace(told, leak=0.5, seq=0)
                streams = with_rtc(streams, told_before)
            if number >= 10:
                streams = with_rtc(streams, told)
                assert streams[LoopCheck].residual is None
        assert streams[LoopCheck].from_seq == 1100

    def test_only_the_matrices_that_may_still_come_are_kept(self, streams):
        for name in ("a", "b", "c", "d", "b"):
            streams = with_matrix(streams, name, self.R)
        assert [name for name, _ in streams.loop.matrices] == ["c", "d", "b"]

    def test_the_matrix_that_multiplies_is_kept_however_many_are_sent(self, streams):
        streams = replace(streams, loop=replace(streams.loop, cm_id="in-use"))
        for name in ("in-use", "sent-1", "sent-2", "sent-3", "sent-4"):
            streams = with_matrix(streams, name, self.R)
        assert "in-use" in [name for name, _ in streams.loop.matrices]


class TestADitherThatIsNotThere:
    def test_frames_without_it_are_counted_from_where_it_should_have_begun(self, streams):
        streams = with_dither(streams, played(start_seq=250), WINDOW_S)
        streams, _ = play(streams, 0, 10, dither=False)
        assert streams[DitherWatch].silent_s == pytest.approx(0.75)

    def test_one_that_comes_late_is_no_longer_missed(self, streams):
        streams, _ = play(streams, 0, 8, dither=False)
        assert streams[DitherWatch].silent_s == pytest.approx(0.8)
        streams, _ = play(streams, 800, 1)
        assert streams[DitherWatch].silent_s == 0.0
        _, windows = play(streams, 900, 6)
        assert [type(w) for w in windows] == [Spectra]
        assert windows[0].first_seq == 800

    def test_nobody_misses_it_after_its_time(self, streams):
        short = played(duration_s=0.3)
        streams, _ = play(with_dither(streams, short, WINDOW_S), 0, 20, dither=False)
        assert streams[DitherWatch].silent_s == pytest.approx(0.3)

    def test_a_correction_of_its_first_frame_moves_the_windows(self, streams):
        streams = with_dither(streams, played(start_seq=400), WINDOW_S)
        _, windows = play(streams, 0, 14)
        assert [w.first_seq for w in windows] == [700]

    def test_the_columns_have_the_last_word_on_the_amplitude(self, streams):
        half = played(amplitude_m=(9e-9,))
        _, windows = play(with_dither(streams, half, WINDOW_S), 0, 9)
        (window,) = windows
        found = np.abs(window.dither[0, 6]) / (0.25 * window.plan.n_frames) / np.sqrt(2)
        assert found == pytest.approx(5e-9, rel=0.01)


@pytest.fixture(name="slipped")
def slipped_edge():
    """A loop whose outermost actuator has gone away, and that says so."""
    description = replace(
        DESCRIPTION, n_modes=N_MANY, mode_variance_m2=np.full(N_MANY, 1e-16), actuators=RING
    )
    bank = with_rtc(EstimatorBank.of(description), MANY)
    for first_seq in range(0, 1000, 10):
        bank, _ = process_block(bank, driven(first_seq, 0.0))
    assert bank.loop.edge is not None
    assert dict(told(bank))["edge-slip"] is None
    for first_seq in range(1000, 2000, 10):
        bank, _ = process_block(bank, driven(first_seq, 2e-6))
    assert "an outer actuator" in dict(told(bank))["edge-slip"]
    return bank


def of_modes(n_controlled, seq):
    gains = (0.4,) * n_controlled + (0.0,) * (N_MANY - n_controlled)
    return replace(MANY, n_controlled=n_controlled, gains=gains, seq=seq)


def test_an_edge_that_has_slipped_is_named_until_the_loop_is_closed_anew(slipped):
    opened = with_rtc(slipped, replace(MANY, loop="open", seq=2000))
    assert dict(told(opened))["edge-slip"] is None


def test_or_until_so_few_modes_are_controlled_that_nobody_can_tell(slipped):
    few = with_rtc(slipped, of_modes(2 * LOW_MODES, seq=2000))
    assert few.loop.edge is None
    assert dict(told(few))["edge-slip"] is None
    many = with_rtc(few, replace(MANY, seq=3000))
    for first_seq in range(3000, 4000, 10):
        many, _ = process_block(many, driven(first_seq, 2e-6))


def test_but_not_because_a_few_modes_less_are_controlled(slipped):
    fewer = with_rtc(slipped, of_modes(2 * LOW_MODES + 10, seq=2000))
    assert "an outer actuator" in dict(told(fewer))["edge-slip"]


def raised(bank):
    return {name: text for name, text in told(bank) if text is not None}


def told(streams):
    return [
        (name, text)
        for entry, member in zip(streams.entries, streams.members, strict=True)
        for name, text, _ in entry.conditions(member)
    ]


def test_no_window_is_begun_that_the_end_of_the_dither_would_cut(streams):
    streams = with_dither(streams, played(duration_s=1.1), WINDOW_S)
    streams, windows = play(streams, 0, 9)
    assert [w.first_seq for w in windows] == [300]
    assert streams[DitherWindows].cutter is None
    _, windows = play(streams, 900, 10, dither=False)
    assert not windows


def test_the_window_a_dither_was_planned_with_counts(streams):
    planned = played(id="dither-2", window_s=0.25)
    _, windows = play(with_dither(streams, planned, WINDOW_S), 0, 9)
    assert [w.first_seq for w in windows] == [300, 550]


class TestVibrations:
    def shaken(self, first_seq, n=100):
        turns = 0.13 * (first_seq + np.arange(n))
        slopes = block(first_seq, n).slopes
        slopes[:, : N_SLOPES // 2] += 3 * np.sin(2 * np.pi * turns)[:, None].astype(np.float32)
        return replace(block(first_seq, n, dither=False), slopes=slopes, dither_m=None)

    def test_a_line_is_heard_within_seconds_and_told_once(self, streams):
        streams = with_dither(streams, None, WINDOW_S)
        state = tracker_state(system="flao", rtc=RTC)
        for number in range(130):
            streams, _ = process_block(streams, self.shaken(100 * number))
        (told,) = [
            e for e in detect_changes(streams, streams, state) if isinstance(e, ev.Vibrations)
        ]
        np.testing.assert_allclose(told.lines_hz, [130.0], atol=1.0)
        known = changed(state, vibrations_hz=told.lines_hz)
        assert not [
            e for e in detect_changes(streams, streams, known) if isinstance(e, ev.Vibrations)
        ]

    def lines_told(self, bank, state):
        return [e for e in detect_changes(bank, bank, state) if isinstance(e, ev.Vibrations)]

    def test_an_open_loop_is_not_listened_to(self, streams):
        streams = with_rtc(streams, replace(RTC, loop="open"))
        for number in range(130):
            streams, _ = process_block(streams, self.shaken(100 * number))
        assert streams[VibrationMonitor].lines_hz == ()


class TestLooks:
    """What the watchdog takes from the streams."""

    def test_too_little_stays_where_it_is(self, streams):
        young, _ = play(streams, 0, 1, n=15)
        kept, sums = handmade.take_sums(young)
        assert sums.endswith("0 frames in runs without gaps, 20 are needed for 4 modes")
        assert kept[Passive] is young[Passive]

    def test_a_loop_that_answers_too_soon_says_so(self, streams):
        """Two frames are what the instrument needs: 1.5 leave it none."""
        quick, _ = play(with_rtc(streams, replace(RTC, delay_frames=1.5)), 0, 20)
        assert "1.5 frames" in handmade.take_sums(quick)[1]

    def test_an_open_loop_and_a_missing_rtc_say_so_too(self, streams):
        assert (
            "the loop is open"
            in handmade.take_sums(with_rtc(streams, replace(RTC, loop="open")))[1]
        )
        assert "no telemetry" in handmade.take_sums(with_rtc(streams, None))[1]

    def test_no_two_looks_share_telemetry(self, streams):
        """Nothing is forgotten here: two looks hold together what one of all telemetry would."""
        sums = replace(streams[Passive], memory_frames=1e12)
        quiet = with_dither(handmade.with_member(streams, sums), None, WINDOW_S)
        one, _ = play(quiet, 0, 20)
        all_of_it, _ = play(one, 2000, 20)
        rest, first = handmade.take_sums(one)
        rest, _ = play(rest, 2000, 20)
        _, second = handmade.take_sums(rest)
        _, both = handmade.take_sums(all_of_it)
        assert both.n_effective == pytest.approx(first.n_effective + second.n_effective)
        power = first.sums[2] + second.sums[2]
        np.testing.assert_allclose(both.sums[2], power, rtol=1e-5, atol=1e-20)

    def test_beside_windows_that_tell_of_alpha_one_stretch_in_four_is_looked_at(self, streams):
        """And a look says of which time it is."""
        one, _ = play(streams, 0, 40)
        rest, first = handmade.take_sums(one, has_windows=True)
        resting, _ = play(rest, 4000, 120)
        assert handmade.take_sums(resting, has_windows=True)[1] is None
        some, _ = play(resting, 16000, 20)
        assert handmade.take_sums(some, has_windows=True)[1] is None
        _, second = handmade.take_sums(play(some, 18000, 20)[0], has_windows=True)
        assert second.n_effective == pytest.approx(first.n_effective, rel=0.02)
        assert second.since_ns_utc == first.tail.next_t_ns - 1_000_000 + 12_000_000_000

    def test_beside_windows_that_do_not_every_other_stretch_is_left_out(self, streams):
        one, _ = play(streams, 0, 40)
        rest, first = handmade.take_sums(one)
        resting, _ = play(rest, 4000, 40)
        assert handmade.take_sums(resting)[1] is None
        _, second = handmade.take_sums(play(resting, 8000, 40)[0])
        assert second.n_effective == pytest.approx(first.n_effective, rel=0.02)

    @pytest.mark.parametrize("how", ["no window is accepted", "the dither ends"])
    def test_a_rest_ends_where_windows_tell_of_alpha_no_longer(self, streams, how):
        rest, first = handmade.take_sums(play(streams, 0, 40)[0], has_windows=True)
        resting, _ = play(rest, 4000, 40)
        if how == "the dither ends":
            resting, _ = handmade.take_sums(with_dither(resting, None, WINDOW_S), has_windows=True)
        else:
            resting, sums = handmade.take_sums(resting)
            assert sums is None
        _, sums = handmade.take_sums(play(resting, 8000, 40)[0])
        assert sums.since_ns_utc == 7_999_000_000
        assert sums.n_effective == pytest.approx(first.n_effective, rel=0.05)

    @pytest.mark.parametrize(
        ("age_s", "doubt", "rest_s"), [(7.0, "", 12.0), (9.0, "", 4.0), (7.0, "a jump", 4.0)]
    )
    def test_windows_tell_of_alpha_while_they_are_accepted(self, streams, age_s, doubt, rest_s):
        class Driver:
            def now_ns(self):
                return START_NS

        since_ns = START_NS - round(age_s * 1e9)
        registration = replace(
            handmade.STATE.alpha.registration, window_ns_utc=since_ns, doubt=doubt
        )
        engine = Engine(changed(handmade.STATE, registration=registration), POLICY, Driver())
        engine.bank, _ = play(streams, 0, 40)
        assert engine.take_sums().n_effective > 1000
        assert engine.bank[Passive].from_seq == 4000 + 1000 * rest_s

    def test_what_is_taken_is_gone_at_once(self, streams):
        one, _ = play(streams, 0, 20)
        rest, sums = handmade.take_sums(one)
        assert sums.n_effective > 1000
        assert handmade.take_sums(rest)[1] is None
        quiet = with_dither(rest, None, WINDOW_S)
        assert isinstance(handmade.take_sums(quiet)[1], str)


class TestLaw:
    """A loop that is not what the status tells, on the loops of the loop check."""

    TOLD = rtc(
        16,
        n_modes=24,
        n_slopes=60,
        gains=(float(GAIN),) * 16 + (0.0,) * 8,
        leak=LEAK,
        cm_id="cm-1",
        seq=0,
    )

    def after(self, telemetry, told=TOLD, **moving):
        """Streams after two and a half seconds with a status five times a second."""
        description = Description(n_slopes=60, n_modes=24, mode_variance_m2=np.full(24, 4e-14 / 24))
        bank = with_rtc(EstimatorBank.of(description), told)
        bank = with_matrix(bank, "cm-1", INVERSE)
        for part in blocks(telemetry, lengths=(50,)):
            bank, _ = process_block(bank, part)
            seq = part.first_seq + part.n_frames
            if seq % 200 == 0:
                gains = tuple(g * (1 + 0.01 * seq / 1000) for g in told.gains)
                now = replace(told, seq=seq - 1)
                bank = with_rtc(bank, replace(now, gains=gains) if moving else now)
        return raised(bank)

    def test_one_that_is_as_told_raises_nothing(self):
        assert self.after(closed_loop()) == {}

    def test_another_leak_is_named_within_a_second_and_a_half_whatever_the_gains_do(self):
        telemetry = closed_loop(n_frames=1500)
        for moving in ({}, {"moving": True}):
            found = self.after(telemetry, replace(self.TOLD, leak=0.9), **moving)
            assert "leak 0.995 found, 0.900 in the status" in found["loop-law"]

    def test_commands_in_nanometres_are_a_unit_and_nothing_else_is_opened_for(self):
        slopes, commands, _ = closed_loop()
        found = self.after((slopes, commands * np.float32(1e9), None))
        assert "nanometres" in found["command-unit"]
        assert not {"loop-diverging", "edge-slip"} & set(found)


class TestStrengthOfTheDither:
    """By the frames, whatever the status says."""

    def test_windows_of_one_that_is_twenty_times_too_strong_are_refused(self, streams):
        asked = played(amplitude_m=(5e-9 / 20,))
        streams = with_dither(with_rtc(EstimatorBank.of(DESCRIPTION), RTC), asked, WINDOW_S)
        _, windows = play(streams, 0, 20)
        assert windows
        assert all(isinstance(window, WindowRefused) for window in windows)
        assert windows[0].reason.code == "window.dither-strong"
        assert windows[0].reason.values["requested_nm"] == pytest.approx(0.25)

    def test_it_is_news_once_and_again_when_it_is_over(self, streams):
        state = tracker_state(system="s", rtc=RTC)
        asked = played(amplitude_m=(5e-9 / 20,))
        streams = with_dither(with_rtc(EstimatorBank.of(DESCRIPTION), RTC), asked, WINDOW_S)
        streams, _ = play(streams, 0, 12)
        (told,) = [
            e for e in detect_changes(streams, streams, state) if isinstance(e, ev.DitherMeasured)
        ]
        assert told.found_m == pytest.approx(5e-9, rel=0.01)
        told_of = replace(state.dithers.policy, mismatched_id=told.id, mismatched_m=told.found_m)
        state = changed(state, policy=told_of)
        assert not [
            e for e in detect_changes(streams, streams, state) if isinstance(e, ev.DitherMeasured)
        ]

    def test_columns_that_hold_nothing_hold_no_dither(self, streams):
        quiet = block(0, dither=True)
        quiet = replace(quiet, dither_m=np.zeros_like(quiet.dither_m))
        streams, _ = process_block(streams, quiet)
        assert streams[DitherWatch].silent_s == pytest.approx(0.1)


class TestGainsThatFollowTheSeeing:
    """A percent a second is the same loop, for windows as for verdicts and for the bias."""

    def windows(self, gain_of, window_s, seconds=20, **changes):
        """Windows, and how often the sums of ordinary telemetry began anew."""
        bank = with_dither(with_rtc(EstimatorBank.of(DESCRIPTION), RTC), DITHER, window_s)
        found, resets = 0, 0
        for t in range(seconds):
            gains = tuple(gain * gain_of(t) for gain in RTC.gains)
            rtc_now = replace(RTC, gains=gains, seq=1000 * t)
            for name, change in changes.items():
                rtc_now = replace(rtc_now, **{name: change(t)})
            before = bank[Passive]
            bank = with_dither(with_rtc(bank, rtc_now), DITHER, window_s)
            resets += bank[Passive] is not before
            bank, ended = play(bank, 1000 * t, 10)
            found += sum(isinstance(window, Spectra) for window in ended)
        return found, resets

    @pytest.mark.parametrize("step", [0.0, 0.01, 0.04])
    def test_to_and_fro_it_costs_nothing(self, step):
        assert self.windows(lambda t: 1.0 + step * (t % 2), 2.0) == (9, 0)

    def test_on_and_on_it_costs_a_window_now_and_then_at_the_most(self):
        found, resets = self.windows(lambda t: 1.01**t, 2.0)
        assert found >= 8
        assert resets <= 4

    def test_a_change_that_an_operator_makes_cuts_as_ever(self):
        found, resets = self.windows(lambda t: 1.0 if t < 10 else 1.3, 2.0)
        assert resets == 1
        assert found == 8

    def test_a_rate_that_is_measured_and_not_nominal_is_the_same_rate(self):
        rate_hz = 1000.0
        jitter = {"frame_rate_hz": lambda t: rate_hz * (1.0 + 1e-6 * (-1) ** t)}
        assert self.windows(lambda t: 1.0, 2.0, **jitter) == (9, 0)


def test_frames_wait_only_while_alpha_is_followed_and_nothing_else_happens():
    class Driver:
        def now_ns(self):
            return START_NS

    def gathered_s(**changes):
        return Engine(changed(handmade.STATE, **changes), POLICY, Driver()).gather_s

    assert gathered_s() == gathered_s(dither=DITHER) == IDLE_GATHER_S
    sent = replace(foreign(), id="cm-2", state=MatrixState.PUBLISHED)
    alarm = Alarm(name="edge-slip", since_ns_utc=START_NS, message=as_message("x", ""))
    for changes in (
        {"registration": None},
        {"active": (alarm,)},
        {"making_since_ns_utc": START_NS},
        {"reconstructors": (foreign(), sent)},
    ):
        assert gathered_s(**changes) == 0.0


def test_estimators_follow_the_rtc_again_after_a_look_that_fails(streams, monkeypatch):
    class Driver:
        def now_ns(self):
            return START_NS

        def stepped(self, before, event):
            pass

        def perform(self, effect):
            pass

        def swapped(self, in_use):
            pass

    def broken(streams, block):
        raise ValueError("an inhomogeneous shape")

    engine = Engine(changed(handmade.STATE, rtc=RTC), POLICY, Driver())
    engine.bank = streams
    monkeypatch.setattr("service.runtime.estimator_bank.process_block", broken)
    with pytest.raises(ValueError, match="inhomogeneous"):
        engine.feed([block(0)])
    engine.receive(replace(RTC, session="s2"))
    assert engine.bank.loop.rtc.session == "s2"


class TestModesThatComeIntoTheLoop:
    """A dithered mode that is controlled from now on is amplified by the loop: no fault of it."""

    RAISED = replace(RTC, n_controlled=8, gains=(0.4,) * 8, seq=1049)

    def amplified(self, first_seq, by=1.34):
        """100 frames in which the loop answers the dither of mode 6."""
        plain = block(first_seq, scale=1e-12)
        commands = plain.commands_m.copy()
        commands[:, 6] += (by - 1.0) * plain.dither_m[:, 6]
        return replace(plain, commands_m=commands)

    def heard(self, streams, first_seq, n_blocks, **changes):
        found = []
        for index in range(n_blocks):
            streams, _ = process_block(streams, self.amplified(first_seq + 100 * index, **changes))
            found.append(
                streams[DitherWatch].measurement.text if streams[DitherWatch].measurement else ""
            )
        return streams, found

    @pytest.mark.parametrize("late_by", [1, 5, 9])
    def test_what_the_loop_makes_of_it_is_no_excess_however_late_the_status_says(
        self, streams, late_by
    ):
        streams, before = self.heard(streams, 0, 10, by=1.0)
        streams, meanwhile = self.heard(streams, 1000, late_by)
        streams, after = self.heard(with_rtc(streams, self.RAISED), 1000 + 100 * late_by, 40)
        assert not any([*before, *meanwhile, *after])
        assert streams[DitherWatch].measurement.found_m == pytest.approx(5e-9, rel=0.01)

    def test_a_mode_that_no_status_tells_of_is_named_by_two_seconds(self, streams):
        _, found = self.heard(streams, 0, 20)
        assert not any(found[:19])
        assert "mode 6 carries 6.7 nm instead of 5 nm" in found[19]

    def test_what_no_loop_makes_of_it_is_named_by_one(self, streams):
        _, found = self.heard(streams, 0, 10, by=4.0)
        assert "mode 6 carries 20 nm instead of 5 nm" in found[9]


def test_an_rtc_whose_clock_goes_back_an_hour_is_looked_at_again_at_once(streams):
    streams, _ = play(streams, 0, 45)
    streams, sums = handmade.take_sums(streams, has_windows=True)
    assert not isinstance(sums, str)
    earlier_ns = streams.loop.received_ns_utc - 3600 * 10**9
    back = replace(streams, loop=replace(streams.loop, received_ns_utc=earlier_ns))
    assert back[Passive].since_ns_utc > back.loop.received_ns_utc + 3000 * 10**9
    back, _ = handmade.take_sums(back, has_windows=True)
    assert back[Passive].since_ns_utc <= back.loop.received_ns_utc


# --- random dither in the streams of a running service


RANDOM_REQUEST = DitherRequest(
    id="noisy-1",
    kind=DitherKind.BINARY,
    modes=(1, 6),
    amplitude_m=(2e-9, 2e-9),
    seed=5,
    duration_s=1.2,
)
ASKED = {
    "purpose": DitherPurpose.NOISY,
    "dither_id": "noisy-1",
    "total_m": 5e-9,
    "duration_s": 30.0,
}
RANDOM_DITHER = replace(DITHER, request=RANDOM_REQUEST, window_s=0.4)


@pytest.fixture
def signs():
    return with_dither(with_rtc(EstimatorBank.of(DESCRIPTION), RTC), RANDOM_DITHER, 2.0)


def test_random_signs_are_correlated_in_windows_of_the_dithers_own_length(signs):
    signs, windows = play(signs, 0, 12, signs=True)
    assert [(type(w), w.first_seq) for w in windows] == [(Correlated, 300), (Correlated, 700)]
    assert windows[0].plan.modes == (1, 6)
    # a third window would be cut by the end of the dither: it is never begun
    assert signs[DitherWindows].cutter is None


def test_a_sine_after_random_signs_is_read_as_a_sine(signs):
    request = DitherRequest(
        id="d-2",
        kind=DitherKind.SINE,
        modes=(6,),
        amplitude_m=(5e-9,),
        frequency_hz=(240.0,),
        duration_s=60.0,
    )
    sine = replace(DITHER, request=request, window_s=0.5)
    signs = with_dither(signs, sine, 2.0)
    assert isinstance(signs[DitherWindows].cutter, LockIn)
    assert signs[DitherWindows].cutter.plan.modes == (6,)


def test_a_window_too_short_for_its_modes_is_refused_with_how_long_it_must_be(signs):
    short = replace(RANDOM_DITHER, request=replace(RANDOM_REQUEST, id="d-3"), window_s=0.1)
    found = with_dither(signs, short, 2.0)
    assert found[DitherWindows].cutter is None
    expected = "found windows of 100 frames, expected at least 192"
    assert expected in found.loop.dither.why_unreadable


def test_all_modes_of_a_basis_may_share_a_few_nanometres():
    """5 nm on 594 modes: 0.205 nm each; windows of 594 modes at 1 kHz last 4.75 s at least."""
    dither = plan_random(rtc(), POLICY, 77, modes=ModeSet.ALL, **ASKED)
    request = dither.request
    assert request.modes == tuple(range(594))
    assert np.sqrt(np.sum(np.square(request.amplitude_m))) == pytest.approx(5e-9)
    assert (request.kind, request.seed, dither.frequency_hz) == (DitherKind.BINARY, 77, ())
    assert dither.window_s == pytest.approx(5.0)
    assert request.duration_s >= 30.0


def test_more_modes_than_the_rtc_dithers_are_refused():
    with pytest.raises(CommandError, match="found 594 modes; the RTC dithers at most 64"):
        plan_random(rtc(max_dither_modes=64), POLICY, 0, modes=ModeSet.ALL, **ASKED)
