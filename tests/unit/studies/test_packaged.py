"""The page of the packaged instruments has every key with its source, or as assumed."""

import pytest

from pyrcal_studies.packaged import FOLDER, packaged
from service.files.toml import read_toml

PAGE = packaged()
NAMES = sorted(path.stem for path in FOLDER.glob("*.toml"))


def test_there_are_nine():
    assert len(NAMES) == 9


@pytest.mark.parametrize("name", NAMES)
def test_every_key_of_a_file_has_a_row_with_a_source(name):
    section = PAGE.partition(f"## {name}\n")[2].partition("\n## ")[0]
    rows = [line.split(" | ") for line in section.splitlines() if line.startswith("| ")][2:]
    tables = read_toml(FOLDER / f"{name}.toml")
    found = {key for values in tables.values() for key in values if key != "mode"}
    listed = {row[1].strip("`") for row in rows}
    # tables within tables, as wfs.laser, have rows of their own
    assert {key for key in found if key not in {"laser", "orientation"}} <= listed
    assert all(row[-1].rstrip(" |") for row in rows)
