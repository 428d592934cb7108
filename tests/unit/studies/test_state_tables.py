"""The page of states is what the service goes by."""

from studies.state_tables import PAGE, page


def test_the_page_is_of_the_tables_as_they_are():
    assert PAGE.read_text(encoding="utf-8") == page(), "run python -m studies.state_tables"
