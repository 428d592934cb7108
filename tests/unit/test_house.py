"""The house: one name for one thing, one place for one name.

What is not so yet is listed here by name. No list may grow, and what has been mended leaves it.
"""

import ast
import re
from collections import defaultdict
from pathlib import Path

import service
from service.tracking.alarms import ALARMS

ROOT = Path(service.__file__).parent.parent
HELD = ("service", "pyrcal", "check_rtc")

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
