"""Every figure that the studies draw for the manual is there, and a page shows it."""

import re

import pytest

from tests.support.repository import ROOT

figures = pytest.importorskip("pyrcal_studies.figures", reason="needs the extra plots")
PAGES = "\n".join(page.read_text("utf-8") for page in (ROOT / "docs").rglob("*.md"))
MIN_FIGURES = 40


@pytest.mark.parametrize("name", figures.FIGURES)
def test_a_figure_is_there_and_shown(name):
    assert (ROOT / "docs" / f"{name}.png").is_file()
    assert re.search(rf"[(/]{name.rpartition('/')[2]}\.png\)", PAGES)


def test_the_manual_has_figures_enough():
    shown = [path for end in ("png", "svg") for path in (ROOT / "docs").rglob(f"*.{end}")]
    assert sum(path.name in PAGES for path in shown) >= MIN_FIGURES
