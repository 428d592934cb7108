import argparse
import threading
from contextlib import contextmanager

import numpy as np
import pytest

from service.errors import WireError
from service.wire import FrameHeader, Loop, decode_frames
from sim_rtc.computer.telemetry import FrameClock, Pace
from sim_rtc.faults import (
    FORMS,
    ComputerFaults,
    FaultKind,
    FaultPlan,
    WireFaults,
    manual,
    read_fault,
)

N_SLOPES, N_MODES, N = 6, 3, 10


def batch(seq0):
    header = FrameHeader(
        session="s",
        seq0=seq0,
        n=N,
        t0_ns=seq0 * 1_000_000,
        dt_ns=1_000_000,
        n_slopes=N_SLOPES,
        n_modes=N_MODES,
        dither=False,
        cm_id="cm",
        basis_id="basis",
        config_id="sensor",
    )
    rows = np.arange(seq0, seq0 + N, dtype=np.float32)[:, None] + np.zeros(
        N_SLOPES + N_MODES, np.float32
    )
    return header, rows


def sent(*texts, n_batches=20, seed=1):
    """Send batches of 10 ms under faults; return them as (loop time, payload, attachment)."""
    plan = FaultPlan(tuple(read_fault(text) for text in texts))
    faults = WireFaults(plan, np.random.default_rng(seed))
    out = []
    for number in range(n_batches):
        time_s = number * 0.01
        header, rows = batch(number * N)
        out += [(time_s, *message) for message in faults.messages(header, rows, time_s)]
    return out


def starts(messages):
    return [decode_frames(payload, attachment).header.seq0 for _, payload, attachment in messages]


class TestReading:
    """What the command line says."""

    def test_arguments_left_out_have_the_defaults_of_the_manual(self):
        fault = read_fault("lost@12.5:0.2")
        assert (fault.kind, fault.time_s, fault.values) == (FaultKind.LOST, 12.5, (0.2, 1.0))
        assert fault.end_s == 13.5
        assert read_fault(str(fault)) == fault

    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ("lots@3", "KIND one of lost, late"),
            ("lost", "T >= 0"),
            ("lost@-1", "T >= 0"),
            ("lost@x", r"lost@T\[:SHARE,SECONDS\]"),
            ("lost@1:0.5,1,1", r"lost@T\[:SHARE,SECONDS\]"),
            ("lost@1:2", "SHARE from 0 to 1"),
            ("lost@1:nan", "SHARE from 0 to 1"),
        ],
    )
    def test_what_cannot_be_is_refused_with_what_was_expected(self, text, expected):
        with pytest.raises(argparse.ArgumentTypeError, match=expected):
            read_fault(text)

    @pytest.mark.parametrize("kind", FaultKind)
    def test_every_kind_is_in_the_manual(self, kind):
        assert FORMS[kind][1]
        assert f"    {kind} " in manual()

    def test_the_latest_fault_of_a_kind_counts_while_it_lasts(self):
        plan = FaultPlan((read_fault("lost@5:0.5,1"), read_fault("lost@1:0.1,10")))
        assert plan.active(FaultKind.LOST, 0.5) is None
        assert plan.active(FaultKind.LOST, 4.0).value("SHARE") == 0.1
        assert plan.active(FaultKind.LOST, 5.5).value("SHARE") == 0.5
        assert plan.active(FaultKind.LATE, 5.5) is None


class TestWire:
    """What becomes of a batch on its way."""

    def test_without_faults_every_batch_goes_out_as_it_is(self):
        assert starts(sent()) == [N * k for k in range(20)]

    def test_a_gap_takes_the_batches_of_its_time(self):
        assert starts(sent("lost@0.05:1,0.03")) == [N * k for k in range(20) if k not in {5, 6, 7}]

    def test_late_batches_come_in_order_after_their_delay(self):
        messages = sent("late@0.05:0.04,0.02")
        late = [
            (time_s, start) for (time_s, *_), start in zip(messages, starts(messages), strict=True)
        ]
        assert (pytest.approx(0.09), 50) in late
        assert (pytest.approx(0.1), 60) in late
        assert len(messages) == 20

    def test_duplicates_are_the_same_bytes(self):
        messages = sent("duplicated@0:1,0.01")
        assert messages[0] == messages[1]
        assert len(messages) == 21

    def test_reordered_batches_change_places_in_pairs(self):
        assert starts(sent("reordered@0:1,0.035", n_batches=6)) == [10, 0, 30, 20, 40, 50]

    def test_a_nan_strikes_its_share_of_frames_in_the_slopes_only(self):
        rows = np.concatenate(
            [decode_frames(p, a).rows for _, p, a in sent("nan@0:0.3,1", n_batches=100)]
        )
        struck = ~np.isfinite(rows)
        # 1000 frames: 0.3 within 4 sigma of sqrt(0.21 / 1000)
        assert struck.any(axis=1).mean() == pytest.approx(0.3, abs=0.06)
        assert not struck[:, N_SLOPES:].any()

    def test_frozen_slopes_repeat_and_thaw_while_commands_go_on(self):
        batches = [decode_frames(p, a) for _, p, a in sent("frozen@0.02:0.03")]
        np.testing.assert_array_equal(batches[4].slopes, 29.0)
        np.testing.assert_array_equal(batches[4].commands_m[:, 0], np.arange(40, 50))
        np.testing.assert_array_equal(batches[5].slopes[:, 0], np.arange(50, 60))

    def test_garbage_breaks_payload_and_header_in_turn(self):
        texts = []
        for _, payload, attachment in sent("garbage@0:1,0.02")[:2]:
            with pytest.raises(WireError) as refused:
                decode_frames(payload, attachment)
            texts.append(str(refused.value))
        assert "not msgpack" in texts[0]
        assert "bytes, expected" in texts[1]

    def test_another_shape_and_basis_are_consistent_in_themselves(self):
        ((_, payload, attachment),) = sent("shape@0", "basis@0", n_batches=1)
        found = decode_frames(payload, attachment)
        assert found.slopes.shape == (N, N_SLOPES - 1)
        np.testing.assert_array_equal(found.commands_m, batch(0)[1][:, N_SLOPES:])
        assert found.header.basis_id == "another-basis"

    def test_a_second_rtc_has_a_session_of_its_own(self):
        sessions = [decode_frames(p, a).header.session for _, p, a in sent("second@0:0.02")]
        assert sessions[0] == sessions[2] == "s"
        assert sessions[1] == sessions[3] != "s"
        assert set(sessions[4:]) == {"s"}

    def test_the_same_seed_strikes_the_same_batches(self):
        assert sent("lost@0:0.5,1") == sent("lost@0:0.5,1")
        assert sent("lost@0:0.5,1") != sent("lost@0:0.5,1", seed=2)


class Victim:
    """Writes down what is done to it."""

    def __init__(self):
        self.done = []

    def execute(self, command):
        self.done.append(command.loop)

    def restart(self):
        self.done.append("restart")

    def limit_stroke(self, stroke_m):
        self.done.append(("stroke", stroke_m))

    def delay_dithers(self, n_frames):
        self.done.append(("dithers", n_frames))


def sabotaged(*texts, until_s=3.0):
    """Run a loop of 10 batches a second under faults; return victim, clock and absences."""
    victim, absences = Victim(), []

    @contextmanager
    def absence():
        absences.append(list(victim.done))
        yield

    clock = FrameClock(start_ns_utc=0, dt_ns=1_000_000)
    sabotage = ComputerFaults(
        FaultPlan(tuple(read_fault(text) for text in texts)),
        victim,
        clock=clock,
        pace=Pace(batch_s=0.0),
        absence=absence,
    )
    for number in range(round(until_s * 10)):
        sabotage.before_batch(number / 10, threading.Event())
    return victim.done, clock, absences


class TestComputer:
    """What is done to the computer between two batches."""

    def test_the_loop_opens_and_closes_again(self):
        assert sabotaged("open@1:0.5")[0] == [Loop.OPEN, Loop.CLOSED]

    def test_stroke_and_dithers_are_given_back(self):
        done, _, _ = sabotaged("saturation@1:20,1", "dither-late@0.5:0.25,1")
        assert done == [
            ("dithers", 250),
            ("stroke", pytest.approx(20e-9)),
            ("dithers", 0),
            ("stroke", None),
        ]

    def test_a_pause_shows_in_the_timestamps_and_a_stall_does_not(self):
        assert sabotaged("pause@1:0.02")[1].end_of_exposure_ns(0) == 21_000_000
        assert sabotaged("stall@1:0.02")[1].end_of_exposure_ns(0) == 1_000_000

    def test_a_clock_steps_by_what_was_asked_for_good(self):
        assert sabotaged("clock@1:-0.5")[1].start_ns_utc == -500_000_000

    def test_a_restart_happens_out_of_sight_and_with_a_clock_of_its_own(self):
        done, clock, absences = sabotaged("restart@1:0.02")
        assert done == ["restart"]
        assert absences == [[]]
        assert clock.start_ns_utc > 1_000_000_000_000_000_000
