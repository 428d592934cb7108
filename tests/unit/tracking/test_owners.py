"""Whose each part of the state is: one module writes it, whoever wants it changed asks there."""

import ast
from collections import defaultdict
from dataclasses import fields
from pathlib import Path

from service import tracking
from service.tracking.state import TrackerState

NAMES = {field.name for field in fields(TrackerState)}
PACKAGE = Path(tracking.__file__).parent
STATES = ("context.state", "self.state", "state")


def written(tree):
    """The fields of the state that a module writes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                if isinstance(target, ast.Attribute) and ast.unparse(target.value) == "context":
                    yield target.attr
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "replace":
            of_state = ast.unparse(node.args[0]) in STATES
            yield from (keyword.arg for keyword in node.keywords if of_state)


def test_every_field_of_the_state_is_written_by_one_module():
    owners = defaultdict(set)
    through_the_context = {"acquisition", "dither", "dither_policy", "registration"}
    for path in PACKAGE.rglob("*.py"):
        for name in written(ast.parse(path.read_text(encoding="utf-8"))):
            if name in NAMES and not (path.stem == "step_context" and name in through_the_context):
                owners[name].add(path.stem)
    assert {name: modules for name, modules in owners.items() if len(modules) > 1} == {}
    assert NAMES - set(owners) == {"system"}


def test_outside_the_package_the_state_is_written_nowhere():
    """What the service does between two events must not change what it knows."""
    for path in PACKAGE.parent.rglob("*.py"):
        if PACKAGE not in path.parents:
            tree = ast.parse(path.read_text(encoding="utf-8"))
            assert not {name for name in written(tree) if name in NAMES}, path
