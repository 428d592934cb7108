"""The house: one name for one thing, one place for one name.

What is not so yet is listed here by name. No list may grow, and what has been mended leaves it.
"""

import ast
import re
from collections import defaultdict
from pathlib import Path

import vulture

import service
from service.tracking.alarms import ALARMS

ROOT = Path(service.__file__).parent.parent
HELD = ("service", "pyrcal", "check_rtc")

CALLED_FROM_ELSEWHERE = {
    "__getattr__",  # Python
    "_check_value",  # argparse
    "capture_signals",  # uvicorn
    "collect",  # prometheus_client
}

CALLERS = ("sim_rtc", "cacao_bridge", "pyrcal_studies", "benchmarks", "examples")
"""Folders whose calls of the programs count, beside those of the programs themselves."""

WORDS_TOO = {"acquisition", "archive-failed", "dither", "margin"}
"""Alarms whose name means something else, too: a word of the wire, of REST, of a file."""


def test_the_name_of_an_alarm_is_written_once():
    where = defaultdict(list)
    quoted = re.compile(f'"({"|".join(ALARMS.keys() - WORDS_TOO)})"')
    for top in HELD:
        for path in (ROOT / top).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            if quoted.search(text) is None:  # few files name any: the others need no parsing
                continue
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.Constant) and node.value in ALARMS.keys() - WORDS_TOO:
                    where[node.value].append(str(path.relative_to(ROOT)))
    places = (["service/tracking/alarms.py"], ["service/tracking/alarm_rules.py"])
    assert {name: found for name, found in where.items() if found not in places} == {}
    assert where


def test_nothing_is_there_that_nobody_calls():
    """Decorators call routes and checks of fields; what REST shows is named in words."""
    tool = vulture.Vulture(
        ignore_decorators=["@*.get", "@*.post", "@*.put", "@*.delete", "@*_validator*"]
    )
    tool.scavenge([str(ROOT / name) for name in (*HELD, *CALLERS)])
    idle = {
        item.name
        for item in tool.get_unused_code()
        if {ROOT / name for name in HELD} & set(item.filename.parents)
        and item.typ not in {"variable", "attribute", "property"}
    }
    assert idle == CALLED_FROM_ELSEWHERE
