"""What tests of several modules share of system.test_fit."""

from __future__ import annotations

import os
import subprocess
import sys

from tests.support.night import ROOT
from tests.support.pace import patience


def pyrcal(*words, folder):
    """Run a command in an empty folder, as a shell would."""
    return subprocess.run(
        [sys.executable, "-m", "pyrcal", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=patience(120.0),
        check=False,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
