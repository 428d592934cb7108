"""The programs of pyrcal on a secured link: service, simulator, checker, examples."""

import subprocess
import sys

import pytest

from tests.system.cable import free_port
from tests.system.night import INSTRUMENT, ROOT
from tests.system.pace import patience

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]


def pyrcal(*words, **how):
    command = [sys.executable, "-m", "pyrcal", *map(str, words)]
    return subprocess.Popen(command, cwd=ROOT, text=True, stderr=subprocess.STDOUT, **how)


@pytest.fixture
def folder(tmp_path):
    made = pyrcal("certificates", "new", tmp_path / "tls", "--zenoh-port", free_port())
    assert made.wait(patience(20.0)) == 0
    return tmp_path / "tls"


def test_the_checker_finds_the_simulator_through_certificates(folder):
    where = ("--instrument", INSTRUMENT)
    rtc = pyrcal("sim", *where, "--config", folder / "rtc.toml", "--quiet", "--seconds", "60")
    try:
        checked = pyrcal(
            *("check-rtc", *where, "--config", folder / "service.toml", "--seconds", "4"),
            *("--only", "frames,status,delivery,dither,matrix,commit,late-join", "--yes"),
            stdout=subprocess.PIPE,
        )
        found, _ = checked.communicate(timeout=patience(90.0))
    finally:
        rtc.kill()
        rtc.wait(patience(10.0))
    assert checked.returncode == 0, found
    assert "0 wrong" in found
