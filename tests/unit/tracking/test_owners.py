"""Whose each part of the state is: one module writes it, whoever wants it changed asks there."""

import ast
from collections import defaultdict
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

from service import tracking
from service.records.state import TrackerState

RECORDS = {field.name for field in fields(TrackerState)}
BLANK = TrackerState(system="")
PARTS = {
    f"{record}.{part.name}"
    for record in RECORDS
    if is_dataclass(getattr(BLANK, record))
    for part in fields(getattr(BLANK, record))
}
PACKAGE = Path(tracking.__file__).parent
ATTRIBUTES = {
    "acquisition": "operations.acquisition",
    "dither": "dithers.dither",
    "probation": "operations.probation",
    "dither_policy": "dithers.policy",
}
"""Parts that have a name of their own in the context."""

STATES = ("context", "context.state", "self", "self.state", "state")


def written(tree):
    """The parts of the state that a module writes, as ``record.part``."""
    for node in ast.walk(tree):
        match node:
            case ast.Call(ast.Name("replace"), [ast.Attribute(of, record), *_], keywords):
                of_state = record in RECORDS and ast.unparse(of) in STATES
                yield from (f"{record}.{keyword.arg}" for keyword in keywords if of_state)
            case ast.Call(ast.Name("replace"), [of, *_], keywords) if ast.unparse(of) in STATES:
                # the context replaces a record that it is given as a whole
                yield from (keyword.arg or "" for keyword in keywords)
            case ast.Assign([ast.Attribute(ast.Name("context"), name)]) if name in ATTRIBUTES:
                yield ATTRIBUTES[name]
            case ast.Assign([ast.Attribute(ast.Name("context"), "model")]):
                # the worker changes it as a whole
                yield from (part for part in PARTS if part.startswith("model."))
            case _:
                continue


@pytest.mark.parametrize(
    ("line", "parts"),
    [
        ("context.alpha = replace(context.alpha, history=(), offload=None)", 2),
        ("context.alpha = replace(context.alpha, registration=found)", 1),
        ("replace(state.windows, run=run + 1)", 1),
        ("replace(self.state.alarms, active=())", 1),
        ("replace(state, log=())", 1),
        ("context.model = event.model", len(fields(BLANK.model))),
        ("context.dither_policy = replace(context.dither_policy, phase=phase)", 1),
        ("replace(record, state=done)", 0),
        ("state.alpha.history", 0),
    ],
)
def test_what_writes_a_part_is_seen(line, parts):
    assert len([name for name in written(ast.parse(line)) if name in PARTS | RECORDS]) == parts


def test_every_part_of_the_state_is_written_by_one_module():
    owners = defaultdict(set)
    for path in PACKAGE.rglob("*.py"):
        for name in written(ast.parse(path.read_text(encoding="utf-8"))):
            if name in PARTS | {"log"}:
                owners[name].add(path.stem)
    assert {name: modules for name, modules in owners.items() if len(modules) > 1} == {}
    assert PARTS - set(owners) == set()


def test_outside_the_package_the_state_is_written_nowhere():
    """What the service does between two events must not change what it knows."""
    for path in PACKAGE.parent.rglob("*.py"):
        if PACKAGE not in path.parents:
            tree = ast.parse(path.read_text(encoding="utf-8"))
            assert not {name for name in written(tree) if name in PARTS | RECORDS}, path
