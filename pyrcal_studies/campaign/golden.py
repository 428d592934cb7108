"""Golden nights: the events of recorded short nights, and what the tracker made of each.

``service.tracker.step`` is a function of state, event and time, so a changed tracker can be given
the same nights again: effects, refusals, lines of the log and what an operator sees must be the
same. ``pyrcal_studies.campaign.golden_nights`` records them.

Frozen records are written as JSON, ``{"is": class name, field: value}`` with the fields that are
not at their defaults. Only the name of a class is written, so that it may move to another module.
"""

from __future__ import annotations

import base64
import json
import lzma
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, Field, fields, is_dataclass, replace
from enum import Enum
from functools import cache
from itertools import zip_longest
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from service.config import load_settings
from service.errors import PyrcalError
from service.model.misregistration import Misregistration
from service.records.events import Effect, Event
from service.records.state import (
    MatrixStates,
    Mode,
    OperatorState,
    ReferenceStates,
    TrackerState,
)
from service.runtime.policy import policy_of
from service.tracker import step
from service.tracking.operations.running import running_operations
from service.tracking.policy import Policy
from service.tracking.resume import restored, restored_references, resumed, saved_of
from service.tracking.step_context import new_lines

Json = Any
"""None, bool, int, float, str, and lists and dictionaries of them."""

Value = Any
"""Of whatever type is asked for."""

_PLAIN = frozenset({NoneType, bool, int, float, str})
"""What JSON has as it is."""

LEFT_OUT = frozenset({("Status", "flux")})
"""Fields that the tracker carries and does not read, besides those that make no record another:
class and field."""


def encoded(value: object) -> Json:  # noqa: C901 - one case for each kind of value
    """Return a value as JSON, every digit of its numbers kept.

    Raises
    ------
    TypeError
        If there is no way to write it.
    """
    if type(value) in _PLAIN:
        return value
    match value:
        case Enum():
            return value.value
        case np.generic():
            return encoded(value.item())
        case bytes():
            return {"bytes": base64.b64encode(value).decode()}
        case np.ndarray():
            return _array_encoded(value)
        case dict():
            return {name: encoded(item) for name, item in value.items()}
        case tuple() | list():
            return [item if type(item) in _PLAIN else encoded(item) for item in value]
        case _ if is_dataclass(value):
            return {"is": type(value).__name__} | {
                field.name: encoded(getattr(value, field.name))
                for field in fields(value)
                if not _left_out(value, field)
            }
        case _:
            raise TypeError(f"found {type(value).__name__}; expected a record, a number or a text")


def decoded(hint: object, value: Json) -> Value:
    """Return the value of this type that was encoded.

    Raises
    ------
    TypeError
        If the type does not have such values.
    """
    if value is None or type(value) is hint:
        return value
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return _of_union(hint, value)
    if isinstance(value, dict):
        return _of_mapping(hint, value)
    if origin is tuple:
        args = get_args(hint)
        hints = args[:1] * len(value) if args[1:] == (...,) else args
        return tuple(
            item if type(item) is each else decoded(each, item)
            for each, item in zip(hints, value, strict=True)
        )
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(value)
    if hint is float and not isinstance(value, str):
        return float(value)
    if origin is Literal or (hint in (bool, int, str) and isinstance(value, hint)):
        return value
    raise TypeError(f"found {value!r}; expected {hint}")


def _left_out(record: object, field: Field[Any]) -> bool:
    if not field.compare or (type(record).__name__, field.name) in LEFT_OUT:
        return True
    value = getattr(record, field.name)
    if isinstance(value, np.ndarray) or field.default is MISSING:
        return False
    return type(value) is type(field.default) and bool(value == field.default)


def _array_encoded(value: np.ndarray[Any, Any]) -> Json:
    flat = np.ascontiguousarray(value).ravel()
    if flat.dtype.kind == "c":
        flat = flat.view(flat.real.dtype)
    return {"array": flat.tolist(), "type": value.dtype.str, "shape": list(value.shape)}


def _array_decoded(value: dict[str, Json]) -> np.ndarray[Any, Any]:
    dtype = np.dtype(value["type"])
    flat = np.array(value["array"], dtype=np.empty(0, dtype).real.dtype)
    return flat.view(dtype).reshape(value["shape"])


def _of_mapping(hint: object, value: dict[str, Json]) -> Value:
    if "is" in value:
        return _record(hint, value)
    if "array" in value:
        return _array_decoded(value)
    if "bytes" in value:
        return base64.b64decode(value["bytes"])
    if get_origin(hint) is Mapping:
        return {name: decoded(get_args(hint)[1], item) for name, item in value.items()}
    raise TypeError(f"found {sorted(value)}; expected {hint}")


def _record(hint: object, value: dict[str, Json]) -> Value:
    if not isinstance(hint, type) or hint.__name__ != value["is"]:
        raise TypeError(f"found a {value['is']}; expected {hint}")
    hints = _hints(hint)
    given = {name: item for name, item in value.items() if name != "is"}
    return hint(**{name: decoded(hints[name], item) for name, item in given.items()})


def _of_union(hint: object, value: Json) -> Value:
    """Return the value of the first type of a union that has such values."""
    for one in _members(hint):
        if (
            isinstance(value, dict)
            and "is" in value
            and getattr(one, "__name__", "") != value["is"]
        ):
            continue
        try:
            return decoded(one, value)
        except (TypeError, ValueError):
            if isinstance(value, dict) and "is" in value:
                raise
    raise TypeError(f"found {value!r}; expected {hint}")


@cache
def _hints(record: type) -> dict[str, Any]:
    return get_type_hints(record)


@cache
def _members(hint: object) -> tuple[Value, ...]:
    """Return the types of a union, the texts and numbers that anything could be last."""
    plain = (bool, int, float, str)
    args = [one for one in get_args(hint) if one is not NoneType]
    return tuple(sorted(args, key=lambda one: plain.index(one) + 1 if one in plain else 0))


FOLDER = Path("tests/data/golden")

INSTRUMENT = "instrument.jsonl.xz"
"""File of what the nights know of their telescope; the others are named after their nights."""

COMPARED = ("effects", "refused", "log", "seen")

TOLERANCE = 1e-9
"""Relative, of numbers: another processor rounds otherwise."""

Entry = dict[str, Json]


class Teller:
    """Tells events to the tracker and notes what comes of them."""

    def __init__(self, state: TrackerState, policy: Policy) -> None:
        self.state = state
        self.entries: list[Entry] = []
        self._policy = policy
        self._seen: dict[str, Json] = {}

    def tell(self, event: Event, now_ns: int, cause: str = "") -> tuple[Effect, ...]:
        """Replace the state and return what is to be done.

        ``cause``: id of what has led to the event; empty: nobody knows, or it stands for itself.

        Raises
        ------
        PyrcalError
            What the tracker refuses, noted as well.
        """
        entry: Entry = {"t": now_ns, "event": encoded(event)} | ({"cause": cause} if cause else {})
        before = self.state
        try:
            self.state, effects = step(before, event, self._policy, now_ns, cause)
        except PyrcalError as error:
            self.entries.append(entry | {"refused": f"{type(error).__name__}: {error}"})
            raise
        self._note(entry, before, now_ns, effects)
        return effects

    def restart(self, mode: Mode, now_ns: int) -> None:
        """End the service and begin it anew, in the mode of its settings."""
        before, saved = self.state, saved_of(self.state, now_ns)
        fresh = TrackerState(
            system=before.system,
            operator=OperatorState(mode=mode),
            matrices=MatrixStates(reconstructors=restored(before.matrices.reconstructors)),
            references=ReferenceStates(records=restored_references(before.references.records)),
        )
        self.state = fresh if saved is None else resumed(fresh, saved, self._policy, now_ns)
        self._note({"t": now_ns, "restart": mode.value}, fresh, now_ns, ())

    def _note(
        self, entry: Entry, before: TrackerState, now_ns: int, effects: Sequence[Effect]
    ) -> None:
        if effects:
            entry["effects"] = encoded(tuple(effects))
        lines = [[line.name, line.text, line.level.value] for line in new_lines(before, self.state)]
        if lines:
            entry["log"] = lines
        seen = seen_by_operator(self.state, now_ns)
        news = {name: value for name, value in seen.items() if self._seen.get(name) != value}
        if news:
            entry["seen"] = news
        self._seen = seen
        self.entries.append(entry)


def seen_by_operator(state: TrackerState, now_ns: int) -> dict[str, Json]:
    """Return what an operator sees of a state."""
    registration = state.alpha.registration
    return {
        "mode": state.operator.mode.value,
        "runs": [running.kind.name for running in running_operations(state, now_ns)],
        "acquisition": state.operations.acquisition.stage.value,
        "alarms": {alarm.name: alarm.text for alarm in state.alarms.active},
        "alpha": None if registration is None else registration.alpha.vector.tolist(),
        "sigma": None if registration is None else registration.sigma.tolist(),
        "validity": None if registration is None else registration.validity.level.value,
        "in use": state.matrices.in_use,
        "matrices": {record.id: record.state.value for record in state.matrices.reconstructors},
        "measured": {record.id: record.state.value for record in state.by_rtc},
        "noisy": {record.id: record.state.value for record in state.noisy},
        "dither": None if state.dithers.dither is None else state.dithers.dither.id,
        "phase": [state.dithers.policy.phase.value, state.dithers.policy.reason],
        "loop": None if state.loop.command is None else state.loop.command.state.value,
        "windows": [state.windows.accepted, state.windows.refused, state.windows.outlying],
    }


def retold(night: Sequence[Entry], instrument: Entry) -> list[Entry]:
    """Return a recorded night as the tracker would have it: the same events, told to it again.

    The first entry of a night says how it began.
    """
    begin, *expected = night
    policy = with_instrument(policy_of(load_settings(None, {}, begin["settings"])), instrument)
    teller = Teller(
        TrackerState(system=begin["system"], operator=OperatorState(mode=Mode(begin["mode"]))),
        policy,
    )
    for entry in expected:
        if "restart" in entry:
            teller.restart(Mode(entry["restart"]), entry["t"])
        else:
            # the refusal is in the entry
            with suppress(PyrcalError):
                cause = entry.get("cause", "")
                teller.tell(decoded(Event, entry["event"]), entry["t"], cause)
    return [begin, *teller.entries]


def replayed(night: Sequence[Entry], instrument: Entry) -> str | None:
    """Return the first difference between a recorded night and it retold; None: there is none."""
    begin, *expected = night
    _, *again = retold(night, instrument)
    for k, (entry, found) in enumerate(zip(expected, again, strict=True)):
        difference = first_difference(
            {name: found.get(name) for name in COMPARED},
            {name: entry.get(name) for name in COMPARED},
        )
        if difference is not None:
            what = entry["event"]["is"] if "event" in entry else "restart"
            since_s = (entry["t"] - expected[0]["t"]) / 1e9
            return f"{begin['night']}, event {k} after {since_s:.2f} s, {what}: {difference}"
    return None


def first_difference(found: Json, expected: Json, where: str = "") -> str | None:
    """Return the first difference between two values, and where it is; None: they are equal."""
    if isinstance(found, dict) and isinstance(expected, dict):
        for name in dict.fromkeys((*expected, *found)):
            inside = f"{where}.{name}" if where else name
            difference = first_difference(found.get(name), expected.get(name), inside)
            if difference is not None:
                return difference
        return None
    if isinstance(found, list) and isinstance(expected, list):
        for k, (one, other) in enumerate(zip_longest(found, expected)):
            difference = first_difference(one, other, f"{where}[{k}]")
            if difference is not None:
                return difference
        return None
    if found == expected or _are_close(found, expected):
        return None
    return f"{where}: found {found!r}; expected {expected!r}"


def with_instrument(policy: Policy, instrument: Entry) -> Policy:
    """Return the policy with what only the model of the telescope tells."""
    return replace(
        policy,
        mode_information=decoded(np.ndarray, instrument["mode_information"]),
        start=decoded(Misregistration, instrument["start"]),
    )


def written(entries: Iterable[Entry], path: Path) -> None:
    """Write entries, one on a line, compressed: the same entries make the same bytes."""
    lines = (json.dumps(entry, ensure_ascii=False, separators=(",", ":")) for entry in entries)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(lzma.compress("\n".join(lines).encode(), preset=9))


def read(path: Path) -> list[Entry]:
    """Return the entries of a file."""
    return [json.loads(line) for line in lzma.decompress(path.read_bytes()).split(b"\n")]


def nights_in(folder: Path) -> list[Path]:
    """Return the recorded nights of a folder."""
    return sorted(path for path in folder.glob("*.jsonl.xz") if path.name != INSTRUMENT)


def _are_close(found: Json, expected: Json) -> bool:
    if not (isinstance(found, float) and isinstance(expected, float)):
        return False
    if math.isnan(found) and math.isnan(expected):
        return True
    return math.isclose(found, expected, rel_tol=TOLERANCE)
