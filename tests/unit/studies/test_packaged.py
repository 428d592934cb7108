"""The page of the packaged instruments has every key with its source, or as assumed."""

import re
import tomllib

import pytest

from pyrcal_studies.reference import FOLDER, packaged
from service.files.toml import read_toml

PAGE = packaged()
NAMES = sorted(path.stem for path in FOLDER.glob("*.toml"))


def test_there_are_nine():
    assert len(NAMES) == 9


@pytest.mark.parametrize("name", NAMES)
def test_every_value_of_a_file_is_public_with_a_source_or_assumed(name):
    """Values that are equal in all files are listed once, before the instruments."""
    intro = PAGE.partition("\n## ")[0]
    section = PAGE.partition(f"## {name}\n")[2].partition("\n## ")[0]
    rows = [line[2:-2].split(" | ") for line in section.splitlines() if line.startswith("| ")][2:]
    public = {row[0].strip("`"): row[1] for row in rows}
    assumed = {row[0].strip("`"): row[2] for row in rows}
    labels = set(re.findall(r"^- (\[[A-Z]\])", section, re.M))
    n_modes = 0
    for table, key, value in values_of(read_toml(FOLDER / f"{name}.toml")):
        n_modes += (table, key) == ("wfs.mode", "config_id")
        table += f" {n_modes}" if table == "wfs.mode" else ""
        if key == "name":
            continue
        listed = re.search(rf"`{key}` (.*?)(, `|$)", public.get(table, ""))
        if listed:
            assert set(re.findall(r"\[[A-Z]\]", listed[1])) & labels, (table, key)
            given = listed[1]
        elif found := re.search(rf"`{key}` (.*?)(, `|$)", assumed.get(table, "")):
            given = found[1]
        else:
            given = re.search(rf"`{key}` (\S+) in `\[{table}\]`", intro)[1]
        given = re.split(r" \[[A-Z]\]| \(", given)[0]
        assert tomllib.loads(f"x = {given}")["x"] == value, (table, key)


def values_of(tables, above=""):
    """Every table, key and value of an instrument file."""
    for name, value in tables.items():
        if isinstance(value, dict):
            yield from values_of(value, f"{above}{name}.")
        elif isinstance(value, list) and isinstance(value[0], dict):
            for each in value:
                yield from values_of(each, f"{above}{name}.")
        else:
            yield above.rstrip("."), name, value
