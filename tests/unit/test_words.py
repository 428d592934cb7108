"""The words of the glossary: what is retired there is no identifier any more."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GLOSSARY = next((ROOT / "docs").rglob("glossary.md"))
PACKAGES = [top for top in ("service", "pyrcal", "check_rtc") if (ROOT / top).is_dir()]

ANOTHER_THING = {
    ("turn", "_turn"),  # whose it is: of uploads, of jobs
    ("turn", "turn"),  # of light, an angle
    ("most_step", "most_step"),  # a key of the user's settings
}


def retired():
    """Words of the last column, in back-ticks."""
    rows = [line.split(" | ") for line in GLOSSARY.read_text(encoding="utf-8").splitlines()]
    return {word for row in rows[1:] if len(row) == 3 for word in re.findall(r"`(\w+)`", row[2])}


def names(tree):
    """Names of classes, functions, parameters and attributes, each with its line."""
    for node in ast.walk(tree):
        match node:
            case ast.ClassDef():
                yield node.name, node.lineno
                for line in node.body:
                    if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
                        yield line.target.id, line.lineno
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                yield node.name, node.lineno
            case ast.arg():
                yield node.arg, node.lineno
            case ast.Attribute(ctx=ast.Store(), attr=name):
                yield name, node.lineno


def files():
    return [
        path
        for top in PACKAGES
        for path in sorted((ROOT / top).rglob("*.py"))
        if "manual" not in path.parts
    ]


def test_the_glossary_has_words_to_refuse():
    assert {"Turn", "unwatched", "displace"} <= retired()


@pytest.mark.parametrize("path", files(), ids=lambda path: str(path.relative_to(ROOT)))
def test_no_retired_word_is_an_identifier(path):
    gone = retired()
    found = {
        f"{name}, line {line}"
        for name, line in names(ast.parse(path.read_text(encoding="utf-8")))
        if (word := name if name[:1].isupper() else name.strip("_")) in gone
        and (word, name) not in ANOTHER_THING
        and not (name.startswith("_") and name[1:2].isupper())
    }
    assert found == set(), f"docs/glossary.md has another name for it: {path}"
    assert path.stem not in gone, f"docs/glossary.md has another name for the module {path}"
