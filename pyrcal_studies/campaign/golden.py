"""Golden nights: what the tracker heard in short nights, and what it wanted done about it.

``service.tracker.step`` is a function of state, event and time, so whoever takes it apart and puts
it together again can have the same nights told to it: effects, refusals, lines of the log and what
an operator sees must come out as they did. ``pyrcal_studies.campaign.golden_nights`` records them.
"""

from __future__ import annotations

import json
import lzma
import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from pyrcal_studies.campaign.golden_codec import Json, decoded, encoded
from service.config import load_settings
from service.errors import PyrcalError
from service.model.misregistration import Misregistration
from service.runtime.policy import policy_of
from service.tracker import step
from service.tracking.events import Effect, Event
from service.tracking.operations.running import running_operations
from service.tracking.policy import Policy
from service.tracking.resume import restored, resumed, saved_of
from service.tracking.state import MatrixStates, Mode, OperatorState, TrackerState
from service.tracking.step_context import new_lines

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
