import socket
from pathlib import Path

import pytest

from pyrcal.demo.__main__ import main
from pyrcal.demo.arguments import demo_parser
from pyrcal.demo.run import (
    _choose_introduction,
    _make_commands,
    _make_promise,
    _prepare_directory,
    _say,
    _Telescope,
)
from service.errors import ConfigurationError
from sim_rtc.options import parse_options

ROOT = Path(__file__).parents[4]


def options(*words):
    return demo_parser().parse_args(words)


def test_the_simulator_gets_what_is_meant_for_it_and_understands_it():
    _, simulator = _make_commands(
        options(
            "--alpha=-0.1,0.05,0.2,0.998",
            *("--mag", "7", "--seed", "5", "--gain", "0.3"),
            *("--jump", "30:0.2,0,0,0", "--jump", "60:-0.2,0,0,0", "--zenoh-port", "7500"),
        )
    )
    found = parse_options(simulator)
    assert found.alpha.shift_x_subap == -0.1
    assert (found.magnitude, found.seed, found.gain) == (7.0, 5, 0.3)
    assert [jump.time_s for jump in found.jumps] == [30.0, 60.0]
    assert found.given_connect == "tcp/127.0.0.1:7500"


def test_both_meet_at_the_same_place_and_the_service_is_never_told_the_truth(tmp_path):
    service, simulator = _make_commands(options("--alpha", "0.1,0,0,1", "--dir", str(tmp_path)))
    assert service[service.index("--listen") + 1] == simulator[simulator.index("--connect") + 1]
    assert service[service.index("--mode") + 1] == "auto"
    assert not any("0.1,0,0,1" in word or "truth" in word for word in service)


def begins_far(*words):
    _, simulator = _make_commands(options(*words))
    return parse_options(simulator).far


def test_the_night_begins_far_away_unless_something_else_is_asked_for():
    assert begins_far()
    assert begins_far("--mag", "9", "--jump", "90:0.2,0,0,0")
    assert not begins_far("--near")
    assert not begins_far("--alpha", "0.1,0,0,1")
    assert not begins_far("--plant", "diffractive")
    assert not begins_far("--scene", "daytime")


def test_what_is_said_of_400_modes_is_said_of_flao_only():
    assert "loop of 400 modes diverges" in _choose_introduction(options())
    assert "400 modes" not in _choose_introduction(options("--instrument", "canary"))


def test_a_night_that_begins_far_away_must_end_with_much_less_wavefront_error():
    assert _make_promise(options()).wanted_ratio == 1.5
    assert _make_promise(options("--near")).wanted_ratio == 1.0


def test_another_telescope_runs_as_fast_as_the_machine_holds_and_has_a_bar_of_its_own():
    other, own = options("--instrument", "soul-lbt"), options()
    assert parse_options(_make_commands(other)[1]).held_rate
    assert not parse_options(_make_commands(own)[1]).held_rate
    assert 1.0 < _make_promise(other).wanted_ratio < _make_promise(own).wanted_ratio


def test_few_modes_are_asked_for_a_third_of_what_they_can_leave():
    """40 modes begin with 28: (40 / 28) ** (sqrt(3) / 4) = 1.167, whose cubic root is 1.053."""
    promise = _make_promise(options("--instrument", "canary"))
    assert (promise.wanted_ratio, promise.across_subap) == (1.05, 7.0)


def test_a_telescope_too_large_for_real_time_is_asked_for_its_own_rate_and_given_time():
    """METIS: 4 x 500 Hz x 12,723 slopes x 4300 modes are 109 GFLOP/s; SOUL's are 10 of 30."""
    large = options("--instrument", "metis-elt")
    found = parse_options(_make_commands(large)[1])
    assert (found.frame_rate_hz, found.held_rate) == (500.0, True)
    assert _Telescope.read("metis-elt").gflop_s == pytest.approx(109, abs=1)
    promise = _make_promise(large)
    assert (promise.requested_rate_hz, promise.large, promise.wanted_ratio) == (500.0, True, 1.0)


@pytest.mark.parametrize("name", ["flao-lbt", "soul-lbt", "gpao-ut", "aof-ut4"])
def test_others_are_asked_for_the_usual_rate(name):
    found = options("--instrument", name)
    assert parse_options(_make_commands(found)[1]).frame_rate_hz == 1000.0
    assert not _make_promise(found).large


def test_the_leftovers_of_an_earlier_demo_are_removed(tmp_path):
    (tmp_path / "service.log").write_text("old", encoding="utf-8")
    (tmp_path / "data").mkdir()
    _prepare_directory(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_directory_of_somebody_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work", encoding="utf-8")
    with pytest.raises(ConfigurationError, match="holds other files"):
        _prepare_directory(tmp_path)
    assert (tmp_path / "thesis.tex").exists()


def test_a_new_directory_is_made(tmp_path):
    _prepare_directory(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()


def test_what_the_service_tells_of_others_is_harmless_on_the_screen(capsys):
    _say("two lines\nof \x1b[2J an \u202ealarm")
    assert capsys.readouterr().out == "two lines\nof \\x1b[2J an \\u202ealarm\n"


def refused(capsys, *words):
    assert main(list(words)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize("option", ["--port", "--zenoh-port"])
def test_the_demo_refuses_a_busy_port_instead_of_watching_another_service(capsys, tmp_path, option):
    with socket.create_server(("127.0.0.1", 0)) as busy:
        port = str(busy.getsockname()[1])
        line = refused(capsys, option, port, "--dir", str(tmp_path / "demo"))
    assert f"{option} {port}" in line
    assert not (tmp_path / "demo").exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--seconds", "-3"),
        ("--seconds", "0"),
        ("--seconds", "nan"),
        ("--seconds", "soon"),
        ("--seed", "-1"),
        ("--port", "70000"),
        ("--jump", "30"),
        ("--json", "nowhere/figures.json"),
        ("--plot", "nowhere/figure.png"),
        ("--nonsense", "1"),
    ],
)
def test_the_demo_refuses_an_argument_in_one_line_before_it_starts_anything(
    capsys, tmp_path, monkeypatch, option, value
):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pyrcal.demo.run.run_children", None)  # whoever starts something fails
    words = ["--dir", str(tmp_path / "demo"), option, value]
    try:
        status = main(words)
    except SystemExit as end:
        status = end.code
    lines = capsys.readouterr().err.splitlines()
    assert status == 2
    assert len(lines) == 1
    assert option in lines[0]
    assert not (tmp_path / "demo").exists()


def test_a_small_telescope_begins_with_fewer_modes_on_a_brighter_star():
    """1.6056 m gather 3.55 magnitudes less than 8.22 m: the star is as much brighter."""
    found = parse_options(_make_commands(options("--instrument", "papyrus"))[1])
    assert found.magnitude == pytest.approx(8.0 - 3.55, abs=0.01)
    assert found.given_n_controlled == 65
    assert (
        parse_options(_make_commands(options("--instrument", "papyrus", "--mag", "7"))[1]).magnitude
        == 7
    )
    other = parse_options(_make_commands(options("--instrument", "canary"))[1])
    assert (other.magnitude, other.given_n_controlled) == (8.0, None)


def test_on_a_measured_plant_the_service_has_an_instrument_file_of_its_own(tmp_path):
    words = ["--plant", "measured", "--matrix", "m.h5", "--instrument", "papyrus"]
    asked = options(*words, "--dir", str(tmp_path))
    service, simulator = _make_commands(asked)
    assert service[service.index("--instrument") + 1] == str(tmp_path / "instrument.toml")
    found = parse_options(simulator)
    assert (found.instrument, found.matrix, found.far) == ("papyrus", Path("m.h5"), False)
    promise = _make_promise(asked)
    assert promise.measured_plant
    assert promise.wanted_ratio == pytest.approx(1 / 1.1)
