"""Every tutorial, from top to bottom in an empty folder: its commands run, its outputs come."""

import contextlib
import io
import os
import subprocess
import sys

import pytest

from tests.system.night import ROOT
from tests.system.pace import patience
from tests.unit.test_docs import commands
from tests.unit.tutorial_blocks import missing_lines, steps

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(600)]

TUTORIALS = sorted(
    page
    for page in (ROOT / "docs" / "tutorials").glob("*.md")
    if next(steps(page), None) is not None
)


def typed(words, folder):
    """Run one command of a tutorial; return what it printed."""
    program, *rest = words
    module = {"pyrcal": ["-m", "pyrcal"], "python": []}[program]
    done = subprocess.run(
        [sys.executable, *module, *rest],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=patience(300.0),
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, (words, done.stderr)
    return done.stdout + done.stderr


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_tutorial_runs_and_prints_what_it_says(page, tmp_path, monkeypatch):
    for name in ("tests", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    names = {}
    for kind, text, printed in steps(page):
        output = io.StringIO()
        if kind == "python":
            with contextlib.redirect_stdout(output):
                exec(compile(text, str(page), "exec"), names)
        else:
            for words in commands(text):
                output.write(typed(words, tmp_path))
        if printed is not None:
            assert missing_lines(printed, output.getvalue()) == [], output.getvalue()
