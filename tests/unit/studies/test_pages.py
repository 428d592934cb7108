"""Pages that repeat what the code says are as it is."""

import pytest

from pyrcal_studies.pages import PAGES, ROOT


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_of_the_code_as_it_is(name):
    text = (ROOT / "docs" / name).read_text(encoding="utf-8")
    assert text == PAGES[name](), "run python -m pyrcal_studies.pages"
