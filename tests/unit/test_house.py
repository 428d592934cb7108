"""The house: one name for one thing, one place for one name, files one can read in a sitting.

What is not so yet is listed here by name. No list may grow, and what has been mended leaves it.
"""

import ast
import itertools
from collections import defaultdict
from functools import cache
from pathlib import Path

import vulture

import service
from service.tracking.alarms import ALARMS

ROOT = Path(service.__file__).parent.parent
HELD = ("service", "pyrcal", "check_rtc")

LONG = set()
"""Files that want to be divided."""

LONGEST = 500

CALLED_FROM_ELSEWHERE = {
    "__getattr__",  # Python
    "capture_signals",  # uvicorn
    "collect",  # prometheus_client
    "send_400_response",  # uvicorn
}

WORDS_TOO = {"acquisition", "archive-failed", "dither", "margin"}
"""Alarms whose name means something else, too: a word of the wire, of REST, of a file."""


@cache
def trees():
    paths = sorted(path for top in HELD for path in (ROOT / top).rglob("*.py"))
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}


def records():
    """Every class as (name, its fields)."""
    for tree in trees().values():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                stated = [line.target for line in node.body if isinstance(line, ast.AnnAssign)]
                yield node.name, {name.id for name in stated if isinstance(name, ast.Name)}


def test_no_two_classes_have_one_name():
    names = [name for name, _ in records()]
    assert {name for name in names if names.count(name) > 1} == set()


def test_no_two_records_say_the_same():
    """Four fields or more in common, and four fifths of the smaller one's."""
    found = set()
    for (one, these), (other, those) in itertools.combinations(records(), 2):
        n_common = len(these & those)
        if n_common >= 4 and n_common >= 0.8 * min(len(these), len(those)):
            found.add(" and ".join(sorted((one, other))))
    assert found == set(), "let one of them be the other, or hold it"


def test_a_file_is_read_in_a_sitting():
    n_lines = {
        str(path.relative_to(ROOT)): path.read_text(encoding="utf-8").count("\n")
        for path in trees()
        if path.name != "__init__.py"
    }
    assert {name for name, n in n_lines.items() if n > LONGEST} == LONG


def test_the_name_of_an_alarm_is_written_once():
    where = defaultdict(list)
    for path, tree in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and node.value in ALARMS.keys() - WORDS_TOO:
                where[node.value].append(str(path.relative_to(ROOT)))
    assert {
        name: found for name, found in where.items() if found != ["service/tracking/alarms.py"]
    } == {}


def test_nothing_is_there_that_nobody_calls():
    """Decorators call routes and checks of fields; what REST shows is named in words."""
    tool = vulture.Vulture(
        ignore_decorators=["@*.get", "@*.post", "@*.put", "@*.delete", "@*_validator*"]
    )
    tool.scavenge([str(ROOT / name) for name in (*HELD, "sim_rtc", "studies", "benchmarks")])
    idle = {
        item.name
        for item in tool.get_unused_code()
        if {ROOT / name for name in HELD} & set(item.filename.parents)
        and item.typ not in {"variable", "attribute", "property"}
    }
    assert idle == CALLED_FROM_ELSEWHERE
