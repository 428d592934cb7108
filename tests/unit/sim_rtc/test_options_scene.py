from dataclasses import replace
from pathlib import Path

import pytest

from sim_rtc.options import parse_options
from sim_rtc.telescope.atmosphere import PROFILES
from sim_rtc.telescope.imperfections import SETS, Imperfections
from sim_rtc.telescope.scene import SceneKind, Spiders
from sim_rtc.telescope.sky import DAYTIME_LINES, Shape, VibrationLine


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


@pytest.mark.parametrize(
    ("words", "text"),
    [
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
    ],
)
def test_an_impossible_scene_is_one_line_and_status_two(capsys, words, text):
    with pytest.raises(SystemExit) as ended:
        parse_options(words)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert text in said
    assert said.count("\n") == 1
