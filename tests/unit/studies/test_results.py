"""Every result in force has a command that makes it today."""

import re

import pytest

from pyrcal_studies.results import files_behind, pages, sections, takes_long
from tests.support.repository import ROOT

SECTIONS = [section for page in pages() for section in sections(page) if section.has_values]


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.name)
def test_a_section_with_values_has_a_command_that_exists(section):
    assert section.commands
    assert all(files_behind(command) for command in section.commands)


def test_a_section_whose_command_takes_half_an_hour_or_more_says_so():
    long = [
        section
        for section in SECTIONS
        if any(takes_long(command) for command in section.commands if command in section.text)
    ]
    assert len(long) >= 5
    assert [section.name for section in long if not section.says_that_it_takes_long] == []


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_no_result_refers_to_a_script_that_is_only_in_git(page):
    assert not re.findall(r"\bgit\b", page.read_text("utf-8").replace("git log", ""))


@pytest.mark.parametrize(
    "command",
    ["python -m pyrcal_studies.gone", "make gone", "python -m pytest tests/gone.py", "sh gone"],
)
def test_a_command_that_does_not_exist_is_found(command):
    with pytest.raises(LookupError):
        files_behind(command)


def test_the_code_of_a_command_is_all_that_it_imports():
    found = files_behind("OPENBLAS_NUM_THREADS=1 python -m pyrcal_studies.missing_rim --data PATH")
    names = {str(path.relative_to(ROOT)) for path in found}
    assert {"pyrcal_studies/missing_rim.py", "service/model/misregistration.py"} <= names
    assert not any(name.startswith("sim_rtc") for name in names)


def test_a_section_without_a_command_is_made_by_that_before_it(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# Page\n\n## One\n**Measured**: 1. **Command**: `make bench`.\n\n### Two\n| a |\n| --- |\n"
        "\n## Three\n**Command**: `make soak`, and of `make load` the half.\n"
    )
    one, two, three = sections(page)
    assert one.commands == two.commands == ("make bench",)
    assert three.commands == ("make soak", "make load")
    assert (one.lines, two.lines) == (range(3, 5), range(6, 9))
    assert [section.has_values for section in (one, two, three)] == [True, True, False]
