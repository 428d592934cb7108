"""A commented instrument file with every key, written from the schema that reads it."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator, Mapping

from pyrcal.instruments.schema_texts import KeyText, TableText, tables_of
from service.instrument.schema import whole_of
from service.model.sensors.kind import SensorKind

EXAMPLES: Mapping[str, Mapping[str, object]] = {
    "[instrument]": {"name": "bench", "diameter_m": 8.0, "stop": "telescope"},
    "[wfs]": {"n_subapertures": 20, "wavelength_m": 750e-9, "modulation_lambda_over_d": 3.0},
    "[mirror]": {"layout": "grid", "n_across": 21, "pitch_m": 0.4, "diameter_m": 8.6},
}
"""Example values of the required keys, and of the template's mirror."""

_WIDTH = 98

_HEAD = """
An instrument file of pyrcal: every key, what it means, and its default. A key behind # is not set:
take the # away to set it. Files of data are named "path:/dataset", relative to this file. Then:
pyrcal instrument check FILE, pyrcal instrument show FILE PICTURE.png
"""


def make_template(kind: SensorKind) -> str:
    """Return a valid instrument file for a kind of sensor, as a template."""
    lines = [*_comment(_HEAD)]
    for table in tables_of(whole_of(kind)):
        examples = dict(EXAMPLES.get(table.header, {}))
        if table.header == "[wfs]":
            examples["kind"] = kind.name
        lines += ["", *_table(table, examples)]
    return "\n".join(lines) + "\n"


def _table(table: TableText, examples: Mapping[str, object]) -> Iterator[str]:
    """Yield a table; an optional nested table is commented out."""
    inner = "." in table.header
    yield from _comment(table.about)
    yield f"{'#' if inner else ''}{table.header}"
    for key in table.keys:
        yield from _comment(_describe_key(key))
        value = examples.get(key.name, key.default)
        unset = "#" if inner or key.name not in examples else ""
        yield f"{unset}{key.name} = {'' if value is None else json.dumps(value)}".rstrip()


def _describe_key(key: KeyText) -> str:
    type_words = f"({key.type}; needed)" if key.needed else f"({key.type})"
    return f"{key.meaning} {type_words}".strip()


def _comment(text: str) -> Iterator[str]:
    for line in textwrap.wrap(" ".join(text.replace("`", "").split()), _WIDTH - 2):
        yield f"# {line}"
