"""Interpreters that have the programs which run exported models."""

import importlib.util
import sys
from pathlib import Path

import pytest

from tests.support.repository import ROOT


def find_interpreter(program: str) -> Path:
    """Return an interpreter that has OOPAO or specula; skip the test if there is none."""
    kept = ROOT / "var" / "peers" / program.lower() / "venv" / "bin" / "python"
    if kept.exists():
        return kept
    if importlib.util.find_spec(program) is None:
        pytest.skip(f"{program} is not installed; python -m pyrcal_studies.peers installs it")
    return Path(sys.executable)
