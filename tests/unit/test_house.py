"""The house: one name for one thing, one place for one name.

What is not so yet is listed here by name. No list may grow, and what has been mended leaves it.
"""

import ast
import re
from collections import defaultdict

import grimp

from service.records.alarms import ALARMS
from tests.support.repository import HELD, ROOT

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
    places = (["service/records/alarms.py"], ["service/tracking/alarm_rules.py"])
    assert {name: found for name, found in where.items() if found not in places} == {}
    assert where


def test_records_lie_at_the_ground():
    """Who names the state imports neither the planner of dithers nor an estimator."""
    imports = grimp.build_graph("service")
    ground = {"numpy", "service.errors", "service.model.misregistration"}
    for module in imports.find_descendants("service.records"):
        for imported in imports.find_modules_directly_imported_by(module):
            if imported.startswith("service.") and imported not in ground:
                assert imported.startswith(("service.records.", "service.wire", "service.files"))
    assert len(imports.find_upstream_modules("service.records.state")) <= 12
    assert len(imports.find_upstream_modules("service.link.intake")) <= 26


def test_no_test_module_imports_another():
    """What tests share is in ``tests/support``."""
    imports = re.compile(
        r"^\s*(from tests\S*\.test_\w+ import|from tests\S* import test_)", re.MULTILINE
    )
    modules = list((ROOT / "tests").rglob("*.py"))
    assert [str(path) for path in modules if imports.search(path.read_text("utf-8"))] == []
    assert len(modules) > 300
