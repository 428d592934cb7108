import json
from dataclasses import replace

import numpy as np
import pytest

from pyrcal.rtc.identity import Identity
from service.model.misregistration import Misregistration
from service.wire import ReferencesRequest, checksum
from sim_rtc.assembly import build_telescope
from sim_rtc.computer.telemetry import Batch, FrameClock
from sim_rtc.options import parse_options
from sim_rtc.telescope.linear import LinearOptics
from sim_rtc.truth import TruthRecorder, WavefrontError

N_POINTS = 50
WEIGHTS = np.full(N_POINTS, 1 / N_POINTS)
CLOCK = FrameClock(start_ns_utc=1_000, dt_ns=1_000_000)


OPTICS = LinearOptics(
    alpha=Misregistration(shift_x_subap=0.1),
    stuck_opd_m=np.zeros(N_POINTS, dtype=np.float32),
    slopes_per_command=np.zeros((4, 2), dtype=np.float32),
    opd_per_command=np.random.default_rng(1).standard_normal((N_POINTS, 2)).astype(np.float32),
    images=np.ones((2, 1, 2, 1)),
)

IDENTITY = Identity(system="small", basis_id="basis", config_id="sensor")


def frames(seq0, phase_m, cm_id="a", commands_m=None):
    return Batch(
        session="s",
        seq0=seq0,
        slopes=np.zeros((10, 4), dtype=np.float32),
        commands_m=np.zeros((10, 2), dtype=np.float32) if commands_m is None else commands_m,
        dither_m=None,
        cm_id=cm_id,
        identity=IDENTITY,
        n_clipped=0,
        closed=True,
        n_controlled=2,
        optics=OPTICS,
        phase_m=phase_m,
    )


def ripple(rms_m, piston_m=3e-6):
    return (piston_m + rms_m * np.tile([1.0, -1.0], N_POINTS // 2)).astype(np.float32)


def test_the_wavefront_error_is_rms_without_piston_and_with_the_mirror():
    commands = np.array([[1e-7, -2e-7]] + [[0.0, 0.0]] * 9, dtype=np.float32)
    cancelled = -(OPTICS.opd_per_command @ commands[0]) + ripple(40e-9)
    batches = [
        frames(0, cancelled, commands_m=commands),
        frames(10, ripple(25e-9)),
    ]
    # float32 beside a piston of 3 micrometres.
    error = WavefrontError(WEIGHTS)
    assert error.rms_nm(error.residual_m(batches)) == pytest.approx([40.0, 25.0], abs=0.01)


def test_lines_come_twice_a_second_and_swaps_tell_the_peaks_around_them(tmp_path):
    path = tmp_path / "truth.jsonl"
    with TruthRecorder(path, weights=WEIGHTS, clock=CLOCK) as recorder:
        for seq in range(0, 4000, 10):
            rms_m = 30e-9 if seq < 2250 else 20e-9
            if seq in {300, 2000, 2400}:
                rms_m += 50e-9
            recorder.offer(
                frames(seq, ripple(rms_m), cm_id="a" if seq < 2250 else "b"),
                overrun_frames=seq // 1000,
            )
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    truth = [line for line in lines if line["kind"] == "truth"]
    assert [line["seq"] for line in truth] == [499, 999, 1499, 1999, 2249, 2749, 3249, 3749, 3999]
    assert truth[1]["wavefront_error_nm"] == pytest.approx(30.0, abs=0.01)
    assert truth[0]["wavefront_error_peak_nm"] == pytest.approx(80.0, abs=0.01)
    assert truth[0]["shift_x_subap"] == 0.1
    assert truth[0]["t_ns_utc"] == 1_000 + 500 * 1_000_000
    assert [line["cm_id"] for line in truth] == ["a"] * 5 + ["b"] * 4
    (swap,) = [line for line in lines if line["kind"] == "swap"]
    assert (swap["seq"], swap["cm_id"], swap["frames_skipped"]) == (2250, "b", 0)
    assert swap["peak_before_nm"] == pytest.approx(80.0, abs=0.01)
    assert swap["peak_after_nm"] == pytest.approx(70.0, abs=0.01)


def test_frames_that_were_skipped_at_a_swap_are_told(tmp_path):
    path = tmp_path / "truth.jsonl"
    with TruthRecorder(path, weights=WEIGHTS, clock=CLOCK) as recorder:
        for seq in [*range(0, 500, 10), *range(530, 2000, 10)]:
            batch = frames(seq, ripple(1e-8), cm_id="a" if seq < 500 else "b")
            recorder.offer(batch, overrun_frames=0)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["frames_skipped"] for line in lines if line["kind"] == "swap"] == [30]


def test_a_static_aberration_is_told_and_gone_with_the_references_that_hold_it(
    small_instrument, tmp_path
):
    """Almost without turbulence the optical gain is 1: the aberration's own slopes hold it.

    3 nm: what 30 modes leave of astigmatism, and 60 nm on a pyramid that is not quite linear.
    """
    words = ["--plant", "diffractive", "--ncpa", "60", "--ncpa-zernike", "5", "--seeing", "0.05"]
    options = parse_options([*words, "--alpha=0,0,0,1", "--mag", "5", "--seed", "1"])
    options = replace(options, frame_rate_hz=500.0)
    telescope = build_telescope(options, small_instrument)
    computer = telescope.computer(telescope.feed.blocks())
    optics = telescope.optics.at(0.0)
    slopes = optics.slopes(np.zeros(len(telescope.weights)), None, np.random.default_rng(1))
    request = ReferencesRequest(
        id="r-1",
        reference_id="ncpa",
        config_id=computer.identity.config_id,
        slopes=slopes.astype("<f4").tobytes(),
        sha256=checksum(slopes),
        ramp_s=0.5,
    )
    path = tmp_path / "truth.jsonl"
    points_m = telescope.plant.points_m
    with TruthRecorder(path, weights=telescope.weights, points_m=points_m, clock=CLOCK) as recorder:
        for batch in range(250):
            if batch == 100:
                assert computer.execute(request).accepted
            recorder.offer(computer.next_batch(), overrun_frames=0)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [lines[k]["reference_id"] for k in (0, -1)] == [None, "ncpa"]
    flat = [line for line in lines if line["reference_id"] is None][1:]
    held = lines[-1]
    assert flat[-1]["static_error_nm"] == pytest.approx(60.0, abs=3.0)
    assert held["static_error_nm"] < 3.0
    # 20 orders from tip on: oblique astigmatism is x y, the fifth of them after the square of x
    assert np.argmax(np.abs(flat[-1]["low_orders_nm"])) == 4
    assert held["wavefront_error_nm"] < 0.5 * flat[-1]["wavefront_error_nm"]


def test_the_setup_comes_first_and_the_seeing_of_the_moment_with_every_line(tmp_path):
    path = tmp_path / "truth.jsonl"
    words = ["--scene", "onsky", "--seeing-at", "2:3", "--spiders", "3:0.2", "--truth", "realistic"]
    words += ["--vibration", "tip:13:50", "--walk", "0.1,0,0,0", "--seed", "4", "--seeing", "1"]
    options = parse_options([*words, "--truth", str(path)])
    with TruthRecorder(path, weights=WEIGHTS, clock=CLOCK, options=options) as recorder:
        for seq in range(0, 2500, 10):
            recorder.offer(frames(seq, ripple(1e-8)), overrun_frames=0)
    setup, *truth = [json.loads(line) for line in path.read_text().splitlines()]
    assert setup["kind"] == "setup"
    assert setup["scene"] == {"kind": "onsky", "spiders": {"n_arms": 3, "width_m": 0.2}}
    assert setup["imperfections"]["ncpa_nm"] == 30.0
    assert setup["vibrations"][0]["shape"] == "tip"
    assert setup["walk"]["shift_x_subap"] == 0.1
    assert setup["seed"] == 4
    seeing = [line["seeing_arcsec"] for line in truth]
    assert seeing[0] < seeing[1] < seeing[2] < seeing[3]
    assert seeing[3:] == pytest.approx([3.0, 3.0], abs=0.01)


@pytest.mark.parametrize(("more", "known"), [([], False), (["--alpha=0.1,0,0,1"], True)])
def test_nobody_knows_the_true_registration_of_a_measured_plant(tmp_path, more, known):
    path = tmp_path / "truth.jsonl"
    options = parse_options(["--plant", "measured", "--matrix", "m.h5", *more])
    offsets = np.arange(8.0).reshape(4, 2)
    with TruthRecorder(
        path, weights=WEIGHTS, clock=CLOCK, options=options, image_offsets_px=offsets
    ) as recorder:
        recorder.offer(frames(0, ripple(1e-8)), overrun_frames=0)
    setup, truth = [json.loads(line) for line in path.read_text().splitlines()]
    assert (setup["matrix"], setup["image_offsets_px"]) == ("m.h5", offsets.tolist())
    assert truth["shift_x_subap"] == (0.1 if known else None)
    assert truth["wavefront_error_nm"] == pytest.approx(10.0, abs=0.01)
