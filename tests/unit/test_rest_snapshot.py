"""What REST has promised stays: ``docs/openapi.json`` only gains."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROMISED = ROOT / "tests" / "data" / "rest.txt"
"""Operations with their statuses and parameters, schemas with their fields and values; of 1.0."""


def names_in(document):
    """Yield a line for everything that a client may rely on."""
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            where = f"{method.upper()} {path}"
            yield from (f"{where} {status}" for status in operation["responses"])
            yield from (f"{where} ?{one['name']}" for one in operation.get("parameters", ()))
    for name, schema in document["components"]["schemas"].items():
        yield from (f"{name}.{field}" for field in schema.get("properties", ()))
        yield from (f"{name}={value}" for value in schema.get("enum", ()))


def test_nothing_that_rest_has_promised_is_gone():
    document = json.loads((ROOT / "docs" / "openapi.json").read_text(encoding="utf-8"))
    promised = PROMISED.read_text(encoding="utf-8").splitlines()
    assert len(promised) > 1500
    assert sorted(set(promised) - set(names_in(document))) == []
