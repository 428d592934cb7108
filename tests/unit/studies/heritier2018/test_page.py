from __future__ import annotations

import re

import pytest

from pyrcal_studies.heritier2018 import page


def test_text_is_text_whatever_it_holds() -> None:
    shown = page.table(["<a>"], [["1 < 2 & 3"]]) + page.paragraph("<b>")
    assert "<a>" not in shown
    assert "1 &lt; 2 &amp; 3" in shown
    assert "&lt;b&gt;" in shown


def test_a_page_needs_nothing_but_itself() -> None:
    figures = pytest.importorskip("matplotlib.figure")
    figure = figures.Figure(figsize=(2, 2))
    figure.subplots().plot([0, 1])
    body = page.picture(figure, "A line. More words.")
    shown = page.page("title", "", [page.Section(anchor="one", title="One", body=body)])
    sources = re.findall(r'(?:src|href)="([^"]{1,30})', shown)
    assert sorted(source[:14] for source in sources) == ["#one", "data:image/png"]
    assert 'alt="A line"' in shown


def test_a_remark_shows_whether_it_agrees() -> None:
    assert "agrees" in page.remark("as in the paper", agrees=True)
    assert "why" in page.remark("another", agrees=False)
