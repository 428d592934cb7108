"""The page of the tracker: what takes in each event, and which operation looks for it."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
from typing import get_args

from service.tracker import REACTIONS
from service.tracking.commands import Command
from service.tracking.events import Event
from studies.contract_tables import table

ROOT = Path(__file__).parents[1]


def page() -> str:
    """Return docs/understand/tracker.md: what each event and command does."""
    commands = get_args(Command)
    events = [kind for kind in get_args(Event) if kind not in commands]
    parts = [
        "# What each event and command does",
        "Written by `python -m studies.pages` from `REACTIONS` of `service/tracker.py`; change "
        "that.",
        "The table takes an event in. Then each operation that runs is given it: what it looks for "
        "is in the last column, and it decides on the state after the table. Nobody else is "
        "given the event.",
    ]
    for title, kinds in (("Events", events), ("Commands", commands)):
        rows = [(f"`{kind.__name__}`", *_reaction(kind)) for kind in kinds]
        parts += [f"## {title}", table(("what", "taken in by", "which does", "operations"), rows)]
    return "\n\n".join(parts) + "\n"


def _reaction(kind: type) -> tuple[str, str, str]:
    """Return who takes an event in, what that does, and the operations that look for it."""
    seen = ", ".join(
        name for name, looked_for in _operations().items() if kind.__name__ in looked_for
    )
    function = REACTIONS.get(kind)
    if function is None:
        return "", "", seen
    place = function.__module__.removeprefix("service.").removeprefix("tracking.")
    does = (function.__doc__ or "").partition("\n")[0]
    return f"`{place}.{function.__name__.lstrip('_')}`", does, seen


@cache
def _operations() -> dict[str, set[str]]:
    """Return the names of the events and commands that each operation tells apart."""
    return {
        path.stem.replace("_", " "): {
            ast.unparse(seen).partition(".")[2]
            for node in ast.walk(ast.parse(path.read_text("utf-8")))
            for seen in _told_apart(node)
        }
        for path in sorted((ROOT / "service" / "tracking" / "operations").glob("*.py"))
        if path.stem not in {"__init__", "running", "acquisition_stages"}
    }


def _told_apart(node: ast.AST) -> tuple[ast.expr, ...]:
    """Return the types that a pattern or an ``isinstance`` asks for."""
    match node:
        case ast.MatchClass(cls=asked):
            return (asked,)
        case ast.Call(func=ast.Name(id="isinstance"), args=[_, asked]):
            return (asked,)
        case _:
            return ()
