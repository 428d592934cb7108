import argparse
import json
import os
import shlex
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from cacao_bridge.__main__ import arguments_parser
from check_rtc.__main__ import check_parser
from pyrcal.__main__ import main
from pyrcal.arguments import (
    HEADINGS,
    OTHER_PROGRAMS,
    command_line,
    with_negative_numbers,
)
from pyrcal.demo.arguments import demo_parser
from pyrcal.fitting.matrix import FitOptions
from service.config import Settings, load_settings
from service.control.reconstructor import MAX_CONDITION, Recipe
from service.control.reconstructor import InversionMethod as MakeMethod
from service.model.kinds import Method as FitMethod
from service.records.state import Mode
from service.version import software_version
from service.wire import CHUNK_LIMIT

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
    assert capsys.readouterr().out.strip() == f"pyrcal {software_version()}"


@pytest.mark.parametrize("words", [["--completion", "bash"], ["--help"]])
def test_whoever_reads_may_have_seen_enough(monkeypatch, words):
    end, begin = os.pipe()
    os.close(end)
    with os.fdopen(begin, "w") as nobody_reads:
        monkeypatch.setattr(sys, "stdout", nobody_reads)
        assert main(words) == 0


def test_commands_stand_under_headings_in_their_order(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    places = [text.index(f"\n  {heading}:\n    {first} ") for first, heading in HEADINGS.items()]
    assert places == sorted(places)


@pytest.mark.parametrize("words", [[], ["fly"], ["run", "--mode", "wild"], ["run", "--prot", "1"]])
def test_a_command_line_that_makes_no_sense_is_refused(capsys, words):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    assert "pyrcal" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["fit", "a", "b", "--threads", "0"], "found '0', expected a whole number above 0"),
        (["fit", "a", "b", "--threads", "1.5"], "found '1.5'"),
        (["fit", "a", "b", "--modes", "1,1"], "found '1,1', expected no mode twice"),
        (["fit", "a", "b", "--start", "-1,2"], "found '-1,2', expected X,Y,ROT,MAG"),
        (["run", "--port", "70000"], "found '70000', expected a port, 0 to 65535"),
        (["run", "--port", "-1"], "found '-1'"),
        (["run", "--port", "http"], "found 'http'"),
        (["run", "--listen", "foo"], "found 'foo', expected an endpoint like tcp/"),
        (["run", "--listen", ""], "found ''"),
        (["run", "--connect", "foo"], "found 'foo'"),
        (["fit", "a", "b", "--arms", "0.9"], "expected WIDTH:DEG"),
        (["fit", "a", "b", "--method", "best"], "'joint', 'paper', 'sensitivity'"),
        (["reconstruct", "a", "0,0,0,1", "--output", "c", "--modes", "-3"], "found '-3'"),
    ],
)
def test_an_option_that_makes_no_sense_is_named_with_what_was_expected(capsys, words, named):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert named in line


def leaves(parser):
    """Every command of a parser that has no commands below it, by its words."""
    below = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    for action in below:
        for name, each in action.choices.items():
            if name not in OTHER_PROGRAMS:
                yield from leaves(each)
    if not below:
        yield parser


COMMANDS = list(leaves(command_line()))


@pytest.mark.parametrize("parser", COMMANDS, ids=lambda parser: parser.prog)
def test_every_help_has_an_example_that_the_command_takes(parser):
    assert parser.examples
    assert "examples:" in parser.format_help()
    for example in parser.examples:
        program, *words = shlex.split(example)
        options = command_line().parse_args(words)
        assert program == "pyrcal"
        assert example.startswith(parser.prog)
        assert options.module


@pytest.mark.parametrize(
    ("make", "read"),
    [
        (check_parser, lambda words: check_parser().parse_args(words)),
        (demo_parser, lambda words: demo_parser().parse_args(with_negative_numbers(words))),
        (arguments_parser, lambda words: arguments_parser().parse_args(words)),
    ],
)
def test_the_examples_of_other_programs_are_taken_by_them(make, read):
    for example in make().examples:
        read(shlex.split(example)[2:])


def test_required_options_are_marked():
    for parser in COMMANDS:
        required = [a for a in parser._actions if a.required and a.option_strings]
        assert parser.format_help().count("(required)") == len(required)
        assert not any(f"[{a.option_strings[0]} " in parser.format_usage() for a in required)


@pytest.mark.parametrize("group", ["alarms", "reconstructors", "recordings"])
def test_a_group_alone_lists_without_a_hint(capsys, group):
    for more in ([], ["--json"]):
        options = command_line().parse_args([group, *more])
        assert options.request.name == f"{group} list"
        assert options.json is bool(more)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("words", "close"),
    [
        (["aprove"], "reconstructors approve"),
        (["statsu"], "status"),
        (["reconstructors", "aprove"], "approve"),
        (["fit", "a", "b", "--metod", "joint"], "--method"),
        (["fit", "a", "b", "--method", "joints"], "joint"),
        (["run", "--prot", "1"], "--port"),
        (["dither", "strat"], "start"),
        (["import", "spekula"], "specula"),
    ],
)
def test_an_error_names_the_closest_word(capsys, words, close):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"did you mean {close};" in line


def test_a_word_like_no_other_is_not_guessed(capsys):
    with pytest.raises(SystemExit):
        main(["xyzzy"])
    assert "mean" not in capsys.readouterr().err


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


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--listen", "tcp/127.0.0.1:99999"], "99999"),
        (["--listen", "tcp/nowhere.invalid:7447"], "nowhere.invalid"),
        (["--listen", "carrier-pigeon/127.0.0.1:7447"], "carrier-pigeon"),
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


def test_the_simulator_is_reached_through_the_same_program():
    found = subprocess.run(
        [sys.executable, "-m", "pyrcal", "sim", "--alpha", "nonsense"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert found.returncode == 2
    assert found.stderr.startswith("sim_rtc: ")


@pytest.mark.parametrize("words", [["sim", "--plant", "linear"], ["demo", "--seconds", "9"]])
def test_each_has_a_module_of_its_own(monkeypatch, words):
    asked = []
    monkeypatch.setattr(os, "execv", lambda *given: asked.extend(given))
    with pytest.raises(SystemExit):  # the rest is for one that comes back
        main(words)
    program, (_, dash_m, module, *rest) = asked
    assert (program, dash_m, rest) == (sys.executable, "-m", words[1:])
    assert find_spec(f"{module}.__main__") or find_spec(module)


def interrupted_at(module, words, number):
    """Send a signal once a module is imported; return exit status and what was said after it.

    Python lists on standard error what it has imported, in the process that this one becomes too.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "pyrcal", *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONPROFILEIMPORTTIME": "1"},
    )
    try:
        for line in process.stderr:
            if line.rpartition("|")[2].strip() == module:
                process.send_signal(number)
                break
        _, said = process.communicate(timeout=60)
    finally:
        process.kill()
    listed = "import time:"
    return process.returncode, [x for x in said.splitlines() if not x.startswith(listed)]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    ("module", "words", "status"),
    [
        # imported before sim_rtc takes over
        ("pyrcal.client.remote", ["sim", "--seconds", "1"], 0),
        ("structlog", ["sim", "--seconds", "1"], 0),
        ("pyrcal.client.remote", ["fit", "flao-lbt", __file__], 130),
    ],
)
def test_an_interrupted_import_ends_without_a_traceback(module, words, status, number):
    assert interrupted_at(module, words, number) == (status, [])


def processor_s(*words, enough_s):
    """Return the processor time of a whole run of the program, and its end.

    It is the best of three, or of as many as it takes to be enough.
    """
    spent = []
    while len(spent) < 3 and min(spent, default=enough_s) >= enough_s:
        process = subprocess.Popen(
            [sys.executable, "-m", "pyrcal", *words],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        spent.append(usage.ru_utime + usage.ru_stime)
    return min(spent), process.returncode


AT_ONCE = [
    (["--version"], 0),
    (["--help"], 0),
    (["run", "--help"], 0),
    (["fit", "--help"], 0),
    (["fly"], 2),
    (["run", "--prot", "1"], 2),
    (["reconstruct", "flao-lbt", "0,0,0,1"], 2),
    (["status", "--url", "http://127.0.0.1:1"], 3),
    (["reconstructors", "approve", "--help"], 0),
    (["watch", "--url", "http://127.0.0.1:1"], 3),
    (["run", "--config", "none.toml"], 2),
    (["run", "--port", "99999"], 2),
    (["run", "--instrument", "nobodys"], 2),
    (["fit", "nobodys", "none.h5"], 2),
    (["fit", "flao-lbt", "none.h5"], 2),
    (["fit", "flao-lbt", __file__], 2),
    (["fit", "a", "b", "--modes", "1,1"], 2),
    (["reconstruct", "flao-lbt", "none.json", "--modes", "1", "--output", "cm.h5"], 2),
]
"""What needs no mathematics, and its status."""

IN_TURN = """
import json, sys
from pyrcal.__main__ import main
def status(words):
    try:
        return main(words)
    except SystemExit as ended:
        return ended.code
found = [status(words) for words in json.loads(sys.argv[1])]
late = {"numpy", "scipy", "h5py", "zenoh", "fastapi", "uvicorn", "httpx", "dask"} & set(sys.modules)
print(json.dumps([found, sorted(late)]), file=sys.stderr)
"""


def test_what_needs_no_mathematics_imports_none(tmp_path):
    found = subprocess.run(
        [sys.executable, "-c", IN_TURN, json.dumps([words for words, _ in AT_ONCE])],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    statuses, late = json.loads(found.stderr.splitlines()[-1])
    assert statuses == [status for _, status in AT_ONCE]
    assert late == []


@pytest.mark.parametrize(
    ("words", "status"),
    [one for one in AT_ONCE if one[0][0] in {"--help", "status"} or "none.h5" in one[0]],
)
def test_what_needs_no_mathematics_comes_at_once(words, status):
    """0.3 s on the machine of docs/operate/operating.md; a slower one may take twice as long."""
    spent_s, found = processor_s(*words, enough_s=0.6)
    assert found == status
    assert spent_s < 0.6


def test_the_command_line_offers_what_the_program_has():
    def default_of(name, *words):
        return getattr(command_line().parse_args(words), name)

    fit, make = ("fit", "a", "b"), ("reconstruct", "a", "0,0,0,1", "--modes", "1", "--output", "c")
    assert default_of("method", *fit) == FitOptions().method
    assert default_of("method", *make) == Recipe(n_modes=1).method
    assert default_of("max_condition", *make) == Recipe(n_modes=1).max_condition
    for words, methods in ((fit, FitMethod), (make, MakeMethod)):
        for method in methods:
            assert default_of("method", *words, "--method", method.value) == method
    for mode in Mode:
        assert default_of("mode", "run", "--mode", mode.value) == mode
        assert Mode(load_settings(None, {}, {"service.mode": mode.value}).service.mode) is mode
    for method in MakeMethod:
        load_settings(None, {}, {"control.method": method.value})
    assert Settings().control.max_condition == MAX_CONDITION
    assert Settings().zenoh.chunk_bytes == CHUNK_LIMIT


def test_a_start_imports_no_more_than_it_needs():
    """Each of these takes a tenth of a second or more, and a start is to take two."""
    code = (
        "import sys, service.cli.serve; from service.instrument import load_instrument; "
        "load_instrument('flao-lbt'); "
        "late = ('scipy.linalg', 'scipy.spatial', 'scipy.ndimage', 'scipy.interpolate', "
        "'scipy.sparse', 'scipy.special', 'matplotlib', 'astropy', 'fastapi', 'uvicorn'); "
        "print([name for name in late if name in sys.modules])"
    )
    root = Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": str(root)}
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True
    )
    assert found.stdout.strip() == "[]"
