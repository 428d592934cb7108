"""What tests of several modules share of unit.studies.heritier2018.test_paper."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]


PAGE = ROOT / "docs" / "results" / "heritier2018.md"
