"""Encode documents as JSON: results of fits, of tracked telemetry, of systems, of archives.

Results hold NumPy numbers, which the standard encoder refuses, and numbers that are not finite,
for which JSON has no word. Every document that leaves the program is encoded here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def json_text(document: Mapping[str, Any] | list[Any], *, indent: int | None = None) -> str:
    """Return a document as JSON text.

    Raises
    ------
    TypeError
        If it holds anything but text, numbers, lists, arrays, mappings and None.
    """
    return json.dumps(plain(document), indent=indent, allow_nan=False)


def pick(record: object, names: str) -> dict[str, Any]:
    """Return attributes of a record for a document, in the order of the names.

    A name like ``verdict=verdict_line`` gives the attribute behind it another key.
    """
    pairs = (name.partition("=") for name in names.split())
    return {key: getattr(record, attribute or key) for key, _, attribute in pairs}


def plain(value: object, *, finite: bool = True) -> Any:  # noqa: ANN401 - as nested as the value
    """Return a value made of Python's own types.

    A number that is not finite becomes None, unless ``finite`` is False.
    """
    match value:
        case np.ndarray() | np.generic():
            return plain(value.tolist(), finite=finite)
        case Mapping():
            return {str(key): plain(part, finite=finite) for key, part in value.items()}
        case list() | tuple():
            return [plain(part, finite=finite) for part in value]
        case float() if finite and not math.isfinite(value):
            return None
    return value
