"""What tests of several modules share of unit.fitting.test_reconstruct."""

from __future__ import annotations

from pathlib import Path

TINY = Path(__file__).parents[1] / "data" / "tiny" / "tiny.toml"
