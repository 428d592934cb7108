import subprocess
import sys

import pytest

from sim_rtc.options import parse_options


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
    ],
)
def test_an_impossible_option_is_one_line_and_status_two(capsys, arguments, text):
    with pytest.raises(SystemExit) as ended:
        parse_options(arguments)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert text in said
    assert said.count("\n") == 1


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
    for word in ("registration", "truth file", "exit status", "--jump T:DX,DY,DROT_DEG,DMAG"):
        assert word in manual
