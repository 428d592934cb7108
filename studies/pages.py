"""Writes what docs repeat of the code: states, files, the tables of rtc.md, the reference pages.

Run: ``python -m studies.pages``, then ``git diff``; a test compares.
"""

from __future__ import annotations

import ast
import json
from enum import StrEnum
from pathlib import Path
from typing import Any, get_args

from service.api import create_app
from service.tracking.acquisition_state import AcquisitionStage
from service.tracking.alarms import AlarmState, Interlock, Severity
from service.tracking.commands import Command
from service.tracking.interlocks import ALLOWS
from service.tracking.operations.running import OPERATION_OF, CurrentOperation, ServiceState
from service.tracking.products import MatrixState, MeasureState, ProbationState
from service.tracking.registration import Validity
from service.tracking.state import Mode
from studies import dispatch, reference
from studies.contract_tables import described, table, with_tables

ROOT = Path(__file__).parents[1]

_STATES: dict[str, type[StrEnum]] = {
    "What the service is in": ServiceState,
    "What it does": CurrentOperation,
    "Modes": Mode,
    "What α is worth": Validity,
    "An acquisition's way": AcquisitionStage,
    "A reconstructor's way": MatrixState,
    "The probation of a matrix": ProbationState,
    "A measured matrix's way": MeasureState,
    "How much an alarm matters": Severity,
    "What operators have done about an alarm": AlarmState,
}


def states() -> str:
    """Return docs/reference/states.md: what the service can be in, from its own tables."""
    parts = [
        "# What the service can be in",
        "Written by `python -m studies.pages` from the tables that the service goes by; "
        "change those.",
        "## What runs, and which commands that refuses",
        "Two may run at a time: what refuses a command says so, and how to end it. `permitted` in "
        "`GET /v1/state` says the same of every order as it is now.",
        table(("while", "refused", "the service is"), _refusals()),
    ]
    for title, kind in _STATES.items():
        rows = [(f"`{state}`", text) for state, text in _described(kind).items()]
        parts += [f"## {title}", table(("state", "meaning"), rows)]
    parts += [
        "## Alarms",
        "An alarm lasts as long as what it tells of. It is acknowledged, not dismissed; one that "
        "goes unseen stays as stale until somebody acknowledges it; one that becomes worse has to "
        "be acknowledged again; one that an operator's order ends has been seen. A muted one "
        "is not shown for a time, of twelve hours at most, and forbids what it "
        "forbids. Operators' acknowledgements and mutes outlive a restart.",
        "[The runbook](../operate/runbook.md) has each: what is the matter, what to do, what it "
        "forbids.",
    ]
    return "\n\n".join(parts) + "\n"


def house() -> str:
    """Return docs/reference/house.md: every file of every program by its first line."""
    parts = [
        "# Which file has what",
        "Written by `python -m studies.pages` from the first line of each file; change those.",
    ]
    for top in ("service", "pyrcal", "check_rtc", "sim_rtc", "cacao_bridge"):
        # packages: the built manual holds copies of the examples
        folders = sorted(path.parent for path in (ROOT / top).rglob("__init__.py"))
        for folder in folders:
            lines = [
                f"- `{path.name}`: {text.partition(chr(10))[0]}"
                for path in sorted(folder.glob("*.py"))
                for text in (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "",)
            ]
            parts += [f"## {folder.relative_to(ROOT)}", "\n".join(lines)]
    return "\n\n".join(parts) + "\n"


def rtc() -> str:
    """Return docs/rtc.md with the tables of the messages' keys as the records have them."""
    return with_tables((ROOT / "docs" / "rtc.md").read_text(encoding="utf-8"))


def openapi() -> str:
    """Return what REST answers, with the desk for fits."""
    nobody: Any = object()  # neither is asked anything
    described = json.dumps(create_app(nobody, nobody).openapi())
    # typing keeps one of two limits that are equal, 0 or 0.0: whichever was written first
    document = json.loads(described, parse_float=_whole)
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def _whole(number: str) -> float:
    value = float(number)
    return int(value) if value.is_integer() else value


def rest() -> str:
    """Return docs/integrate/rest.md."""
    return reference.rest(json.loads(openapi()))


def runbook() -> str:
    """Return docs/operate/runbook.md."""
    acts = {act: _lower(text) for act, text in _described(Interlock).items()}
    return reference.runbook(acts)


PAGES = {
    "reference/states.md": states,
    "reference/house.md": house,
    "rtc.md": rtc,
    "openapi.json": openapi,
    "reference/settings.md": reference.settings,
    "reference/instrument.md": reference.instrument,
    "reference/cli.md": reference.commands,
    "understand/tracker.md": dispatch.page,
    "integrate/rest.md": rest,
    "operate/runbook.md": runbook,
}


def _refusals() -> list[tuple[str, ...]]:
    every = get_args(Command)
    return [
        (
            activity.value,
            ", ".join(f"`{each.__name__}`" for each in every if each not in allowed),
            OPERATION_OF.get(activity, ""),
        )
        for activity, allowed in ALLOWS.items()
    ]


def _described(kind: type[StrEnum]) -> dict[str, str]:
    """Return the values of an enumeration with the text that follows each in its source."""
    return {kind[name].value: text for name, text in described(kind).items()}


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:].rstrip(".")


if __name__ == "__main__":
    for name, page in PAGES.items():
        (ROOT / "docs" / name).write_text(page(), encoding="utf-8")
