import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from service import __version__
from service.__main__ import main

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch, tmp_path):
    for name in [name for name in os.environ if name.startswith("PYRCAL_")]:
        monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)


def refused(capsys, *words):
    """The command line ends with status 2 and one line, which is returned."""
    assert main(list(words)) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("pyrcal: ")
    return lines[0]


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out.strip() == f"pyrcal {__version__}"


@pytest.mark.parametrize("words", [[], ["fly"], ["run", "--mode", "wild"], ["run", "--prot", "1"]])
def test_a_command_line_that_makes_no_sense_is_refused(capsys, words):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    assert "pyrcal" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["demo", "--help"]])
def test_help_explains_the_commands(capsys, words):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 0
    assert "usage: pyrcal" in capsys.readouterr().out


def test_the_precedence_of_settings_is_documented_where_they_are_given(capsys):
    with pytest.raises(SystemExit):
        main(["run", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "command line > environment (PYRCAL_<SECTION>__<KEY>) > TOML file > defaults" in text


def test_an_unknown_key_is_named_with_its_file(capsys, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[api]\nprot = 8080\n", encoding="utf-8")
    line = refused(capsys, "run", "--config", str(path))
    assert "prot" in line
    assert str(path) in line
    assert "port" in line


def test_an_unknown_variable_of_the_environment_is_named(capsys, monkeypatch):
    monkeypatch.setenv("PYRCAL_API__PROT", "8080")
    assert "PYRCAL_API__PROT" in refused(capsys, "run")


def test_a_value_out_of_range_names_the_option(capsys):
    assert "api.port" in refused(capsys, "run", "--port", "70000")


def test_an_instrument_nobody_has_is_named(capsys):
    assert "flao-lbtt" in refused(capsys, "run", "--instrument", "flao-lbtt")


def test_a_busy_port_is_said_before_anything_starts(capsys, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as busy:
        port = str(busy.getsockname()[1])
        line = refused(capsys, "run", "--port", port)
    assert f"127.0.0.1:{port}" in line
    assert "choose another with --port" in line
    assert not (tmp_path / "var").exists()


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--listen", "foo"], "foo"),
        (["--listen", "tcp/127.0.0.1:99999"], "99999"),
        (["--listen", "tcp/nowhere.invalid:7447"], "nowhere.invalid"),
        (["--listen", "carrier-pigeon/127.0.0.1:7447"], "carrier-pigeon"),
        (["--listen", ""], "listen"),
        (["--connect", "foo"], "foo"),
        (["--data-dir", "/dev/null/data"], "/dev/null/data"),
        (["--data-dir", "file"], "file"),
        (["--config", "."], "."),
        (["--config", "file"], "file"),
        (["--instrument", "."], "."),
        (["--instrument", ""], "instrument"),
        (["--instrument", "file"], "file"),
        (["--host", "nowhere.invalid"], "nowhere.invalid"),
    ],
)
def test_what_run_cannot_use_is_named_in_one_line(capsys, tmp_path, words, named):
    (tmp_path / "file").write_bytes(b"\xff\x00 = [")
    assert named in refused(capsys, "run", "--port", "0", *words)


def test_a_host_that_is_not_ours_is_refused_in_one_line(capsys):
    assert "192.0.2.1" in refused(capsys, "run", "--host", "192.0.2.1", "--port", "0")


@pytest.mark.parametrize("option", ["--port", "--zenoh-port"])
def test_the_demo_refuses_a_busy_port_instead_of_watching_another_service(capsys, tmp_path, option):
    with socket.create_server(("127.0.0.1", 0)) as busy:
        port = str(busy.getsockname()[1])
        line = refused(capsys, "demo", option, port, "--dir", str(tmp_path / "demo"))
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
        ("--alpha", "1,2"),
        ("--mag", "x"),
        ("--jump", "30"),
        ("--json", "nowhere/figures.json"),
        ("--nonsense", "1"),
    ],
)
def test_the_demo_refuses_an_argument_in_one_line_before_it_starts_anything(
    capsys, tmp_path, monkeypatch, option, value
):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr("service.demo.run.children", None)  # whoever starts something fails
    words = ["demo", "--dir", str(tmp_path / "demo"), option, value]
    try:
        status = main(words)
    except SystemExit as end:
        status = end.code
    lines = capsys.readouterr().err.splitlines()
    assert status == 2
    assert len(lines) == 1
    assert option in lines[0]
    assert not (tmp_path / "demo").exists()


@pytest.mark.parametrize(
    ("words", "begins"),
    [
        (["sim", "--alpha", "nonsense"], "sim_rtc: "),
        (["campaign", "--plant", "nonsense"], "usage: pyrcal campaign"),
    ],
)
def test_simulator_and_campaigns_are_reached_through_the_same_program(words, begins):
    found = subprocess.run(
        [sys.executable, "-m", "service", *words],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert found.returncode == 2
    assert found.stderr.startswith(begins)


def test_a_start_imports_no_more_than_it_needs():
    """Each of these takes a tenth of a second or more, and a start is to take two."""
    code = (
        "import sys, service.commands.run; from service.config import load_instrument; "
        "load_instrument('flao-lbt'); "
        "late = ('scipy.linalg', 'scipy.spatial', 'scipy.ndimage', 'scipy.interpolate', "
        "'scipy.sparse', 'scipy.special', 'matplotlib', 'astropy'); "
        "print([name for name in late if name in sys.modules])"
    )
    root = Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": str(root)}
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True
    )
    assert found.stdout.strip() == "[]"
