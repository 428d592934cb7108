import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.errors import ConfigurationError
from sim_rtc.assembly import build_drive, build_plant
from sim_rtc.faults import FaultKind
from sim_rtc.options import parse_options
from sim_rtc.telescope.atmosphere import PROFILES
from sim_rtc.telescope.diffractive import DiffractivePlant
from sim_rtc.telescope.imperfections import SETS, Imperfections
from sim_rtc.telescope.mirror import MirrorFaults
from sim_rtc.telescope.scene import SceneKind, Spiders
from sim_rtc.telescope.sky import DAYTIME_LINES, Shape, VibrationLine


def test_the_defaults_are_one_arcsecond_400_modes_and_a_secret_registration():
    options = parse_options([])
    assert (options.seeing.start_arcsec, options.magnitude, options.gain) == (1.0, 8.0, 0.4)
    assert (options.delay_frames, options.frame_rate_hz) == (2, 1000.0)
    assert [options.n_controlled(n_modes) for n_modes in (594, 90)] == [400, 63]
    assert options.alpha is None
    assert not options.far


def test_who_begins_far_away_begins_with_what_the_matrix_holds():
    assert parse_options(["--far"]).n_controlled(594) == 120
    assert parse_options(["--far"]).n_controlled(90) == 63
    assert parse_options(["--far", "--n-controlled", "30"]).n_controlled(594) == 30


def test_the_other_defaults_are_a_star_and_one_layer():
    options = parse_options([])
    assert options.router.endpoint == "tcp/127.0.0.1:7447"
    (layer,) = options.layers
    assert (layer.speed_m_s, layer.direction_deg) == (12.0, 35.0)


@pytest.mark.parametrize(
    "arguments", [["--alpha", "-0.1,0.2,-0.3,1.004"], ["--alpha=-.1,.2,-.3,1.004"]]
)
def test_a_registration_may_begin_with_a_minus_sign(arguments):
    alpha = parse_options(arguments).alpha.to_boundary()
    assert list(alpha.values()) == pytest.approx([-0.1, 0.2, -0.3, 1.004])


def test_layers_jumps_and_drift_are_read():
    options = parse_options(
        [
            "--wind",
            "8,0,2",
            "--wind=15,-90",
            "--jump",
            "30:0.2,0,-0.1,0.001",
            "--drift",
            "-0.1,0,0,0",
        ]
    )
    assert [(la.speed_m_s, la.direction_deg, la.fraction) for la in options.layers] == [
        (8.0, 0.0, 2.0),
        (15.0, -90.0, 1.0),
    ]
    (jump,) = options.jumps
    assert (jump.time_s, jump.shift_x_subap, jump.rotation_deg) == (30.0, 0.2, -0.1)
    assert options.drift.shift_x_subap == -0.1


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--alpha", "0.1,0.2,0.3"], "--alpha: found '0.1,0.2,0.3'; expected X,Y,ROT_DEG,MAG"),
        (["--alpha", "0,0,0,-1"], "--alpha: found '0,0,0,-1'; expected"),
        (["--alpha", "0,0,nan,1"], "expected X,Y,ROT_DEG,MAG"),
        (["--jump", "0.2,0,0,0"], "--jump: found '0.2,0,0,0'; expected T:DX,DY"),
        (["--jump", "-5:0.2,0,0,0"], "T > 0 seconds"),
        (["--drift", "1"], "--drift: found '1'; expected DX,DY,DROT_DEG,DMAG per minute"),
        (["--wind", "0,35"], "--wind: found '0,35'; expected SPEED,DIR_DEG"),
        (["--wind", "5,0"] + ["--wind", "6,0"] * 3, "--wind: found 4 layers; expected at most 3"),
        (["--gain", "3"], "--gain: found '3'; expected a number from 0 to 2"),
        (["--delay", "0"], "--delay: found '0'; expected a whole number from 1 to 10"),
        (["--delay", "1.5"], "--delay: found '1.5'; expected a whole number"),
        (["--mag", "bright"], "--mag: found 'bright'; expected a number from -5 to 20"),
        (["--plant", "cubic"], "--plant: found 'cubic', expected one of "),
        (["--connect", "localhost"], "--connect: found 'localhost'; expected PROTOCOL/ADDRESS"),
        (["--nonsense"], "found '--nonsense'"),
        (["--dead-actuators", "1,x"], "found '1,x'; expected whole numbers from 0, like 12,40"),
        (["--stuck-actuators", "5"], "found '5'; expected N:METRES"),
        (["--stuck-actuators", "5:1"], "at most 1e-4 m"),
        (["--image-offsets", "0,0,0,0"], "expected X1,Y1"),
        (["--image-offsets", "0,0,0,0,0,0,0,0", "--image-offset-rms", "0.1"], "one of them"),
        (["--excess-noise", "0.5"], "expected a number from 1 to 4"),
        (["--rise-ms", "-1"], "expected a number from 0 to 100"),
        (["--scene", "dusk"], "--scene: found 'dusk', expected one of "),
        (["--scene", "daytime", "--spiders", "2:0.1"], "--spiders: the fibre by day"),
        (["--spiders", "2.5:0.1"], "--spiders: found '2.5:0.1'; expected N:WIDTH_M"),
        (["--profile", "single", "--wind", "8,0"], "--profile: found together with --wind"),
        (["--seeing", "-1"], "--seeing: found '-1'; expected a number from 0.05 to 5"),
        (["--seeing-at", "5:-1"], "--seeing-at: found '5:-1'; expected T:ARCSEC"),
        (["--seeing-at", "5:1", "--seeing-at", "5:2"], "--seeing-at: found 5 s twice"),
        (["--vibration", "coma:10:5"], "--vibration: found 'coma:10:5'; expected tip, tilt or"),
        (["--vibration", "tip:600:5"], "--vibration: found 600 Hz; expected less than half"),
        (["--flexure", "0.1,0,0,0:5"], "--flexure: found '0.1,0,0,0:5'; expected DX,DY"),
        (["--walk=-0.1,0,0,0"], "--walk: found '-0.1,0,0,0'; expected X,Y,ROT_DEG,MAG"),
        (["--optical-gain", "0,1"], "--optical-gain: found '0,1'; expected LOW,HIGH"),
        (
            ["--optical-gain", "0.5,1", "--plant", "diffractive"],
            "--optical-gain: found --plant diffractive",
        ),
        (["--bad-pixels", "1.5"], "--bad-pixels: found '1.5'; expected a whole number"),
        (["--truth", "a", "--truth", "b"], "--truth: found 2 files; expected one"),
        (["--truth", "ideal", "--imperfections", "usual"], "found ideal and usual; expected one"),
        (["--fault", "lots@3"], "argument --fault: found 'lots@3'; expected KIND@T"),
        (["--fault", "lost@3:2"], "expected SHARE from 0 to 1"),
        (["--replay", "a.h5", "--record", "b.h5"], "--replay: plays a file as it is"),
    ],
)
def test_an_impossible_option_is_one_line_and_status_two(capsys, arguments, text):
    with pytest.raises(SystemExit) as ended:
        parse_options(arguments)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert text in line


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--n-controlled", "700"], "--n-controlled: found 700; flao-lbt has 594 modes"),
        (
            ["--truth", "no/such/folder/truth.jsonl"],
            "--truth: cannot write no/such/folder/truth.jsonl: No such file or directory",
        ),
    ],
)
def test_what_cannot_be_is_refused_before_anything_starts(arguments, text):
    ended = subprocess.run(
        [sys.executable, "-m", "sim_rtc", *arguments],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert ended.returncode == 2
    assert ended.stderr == f"sim_rtc: {text}\n"


def test_help_reads_like_a_manual(capsys):
    with pytest.raises(SystemExit) as ended:
        parse_options(["--help"])
    assert ended.value.code == 0
    manual = capsys.readouterr().out
    named = ("registration", "truth file", "exit status", "--jump T:DX,DY,DROT_DEG,DMAG")
    recording = ("/messages", "swmr=True")
    for word in (*named, *recording, *(f"    {kind} " for kind in FaultKind)):
        assert word in manual


# --- the device


def test_by_default_mirror_and_detector_are_as_before():
    devices = parse_options([])
    assert not devices.needs_drive
    assert devices.mirror_faults == MirrorFaults()
    assert (devices.camera.read_noise_electrons, devices.camera.excess_noise) == (4.0, 1.0)


def test_faults_limits_and_noise_are_read_in_the_units_they_are_given_in():
    mirror = "--rise-ms 0.7 --actuator-stroke 20 --actuator-bend 2"
    faults = "--dead-actuators 12,40 --stuck-actuators 7:-1e-6 --excess-noise 2"
    devices = parse_options(f"{mirror} {faults}".split())
    assert devices.rise_ms == pytest.approx(0.7)
    assert devices.mirror_limits.stroke_m == pytest.approx(20e-6)
    assert devices.mirror_limits.bend_m == pytest.approx(2e-6)
    assert devices.mirror_faults == MirrorFaults(dead=(12, 40), stuck=((7, -1e-6),))
    assert devices.camera.excess_noise == 2.0
    assert devices.needs_drive


def test_the_diffractive_plant_takes_its_time_unless_told_otherwise():
    assert parse_options([]).speed == 1.0
    assert parse_options(["--plant", "diffractive"]).speed == 0.0
    assert parse_options(["--plant", "diffractive", "--speed", "0.1"]).speed == 0.1


def test_an_ideal_linear_mirror_needs_no_drive(small_instrument, small_basis):
    assert build_drive(parse_options([]), small_instrument, small_basis) is None
    for given in (["--rise-ms", "0.7"], ["--plant", "diffractive"]):
        assert build_drive(parse_options(given), small_instrument, small_basis) is not None


def test_the_plant_is_the_one_asked_for(small_instrument, small_basis):
    options = parse_options(["--plant", "diffractive"])
    plant = build_plant(options, small_instrument, small_basis, np.random.default_rng(1))
    assert isinstance(plant, DiffractivePlant)


@pytest.mark.parametrize("plant", ["linear", "diffractive"])
def test_actuators_the_mirror_does_not_have_are_refused(small_instrument, small_basis, plant):
    options = parse_options(["--plant", plant, "--dead-actuators", "3,500"])
    with pytest.raises(ConfigurationError, match="found actuator 500"):
        build_plant(options, small_instrument, small_basis, np.random.default_rng(1))


def test_limits_alone_put_a_linear_mirror_on_a_drive():
    assert parse_options(["--actuator-bend", "1"]).needs_drive


# --- the scene


def sky(*words):
    return parse_options(list(words))


def test_the_default_is_a_night_with_the_usual_imperfections():
    options = parse_options([])
    assert options.scene.kind is SceneKind.ONSKY
    assert options.scene.passes == 1
    assert options.imperfections == Imperfections()
    assert options.vibrations == ()
    assert not options.seeing.changes


def test_by_day_the_fibre_is_brighter_the_gain_half_and_three_shapes_vibrate():
    options = parse_options(["--scene", "daytime"])
    assert (options.magnitude, options.gain, options.scene.passes) == (7.0, 0.2, 2)
    assert options.vibrations == DAYTIME_LINES
    assert {line.shape for line in DAYTIME_LINES} == set(Shape)
    given = parse_options(["--scene", "daytime", "--mag", "9", "--gain", "0.3"])
    assert (given.magnitude, given.gain) == (9.0, 0.3)


def test_vibrations_are_read_and_can_be_switched_off():
    (line, sine) = sky("--vibration", "tilt:22.5:40", "--vibration", "focus:5:3:0").vibrations
    assert line == VibrationLine(shape=Shape.TILT, frequency_hz=22.5, rms_m=40e-9)
    assert (sine.shape, sine.damping) == (Shape.FOCUS, 0.0)
    assert sky("--scene", "daytime", "--vibration", "none").vibrations == ()


@pytest.mark.parametrize("words", [["--imperfections", "realistic"], ["--truth", "realistic"]])
def test_a_set_is_asked_for_by_name_and_corrected_one_by_one(words):
    assert sky(*words).imperfections == SETS["realistic"]
    corrected = sky(*words, "--ncpa", "0", "--optical-gain", "0.5,0.9", "--bad-pixels", "2")
    assert corrected.imperfections == replace(
        SETS["realistic"],
        ncpa_nm=0.0,
        lowest_optical_gain=0.5,
        highest_optical_gain=0.9,
        bad_pixels=2,
    )


def test_the_truth_file_and_the_set_of_imperfections_do_not_get_mixed_up():
    options = parse_options(["--truth", "realistic", "--truth", "night.jsonl"])
    assert options.truth == Path("night.jsonl")
    assert parse_options(["--truth", "ideal"]).truth is None
    assert parse_options(["--truth", "./realistic"]).truth == Path("realistic")


def test_profile_spiders_seeing_flexure_and_walk_are_read():
    found = sky(
        *["--profile", "paranal-like", "--spiders", "3:0.25", "--seeing-at", "60:1.5"],
        *["--flexure", "-0.1,0.2,0,0:300", "--walk", "0.01,0.01,0.02,0"],
    )
    assert found.layers == PROFILES["paranal-like"]
    assert found.scene.spiders == Spiders(n_arms=3, width_m=0.25)
    assert found.seeing.later == ((60.0, 1.5),)
    assert (found.flexure.shift_x_subap, found.flexure.period_s) == (-0.1, 300.0)
    assert found.walk.rotation_deg == 0.02


@pytest.mark.parametrize("name", list(PROFILES))
def test_the_shares_of_a_profile_add_up(name):
    assert sum(layer.fraction for layer in PROFILES[name]) == pytest.approx(1.0)


# --- rehearsals


def test_faults_are_read_in_any_number_and_a_recording_beside_them():
    options = parse_options(
        ["--fault", "lost@3:0.5", "--fault", "clock@4:-0.5", "--record", "night.h5"]
    )
    assert [(f.kind, f.values[0]) for f in options.faults] == [
        (FaultKind.LOST, 0.5),
        (FaultKind.CLOCK, -0.5),
    ]
    assert options.record.name == "night.h5"
    assert parse_options([]).faults == ()
