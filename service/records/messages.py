"""Messages: a code and values for programs, a sentence for people.

The sentences are in messages.toml, by code. Programs compare codes: nothing reads a sentence.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Final, NamedTuple

from typing_extensions import override

ABOUT: Final = "about"
"""Value that is not merely another number or id, but makes a message another one of its code."""


class Range(NamedTuple):
    """Range of a number in messages that repeat."""

    low: float
    high: float

    @override
    def __format__(self, spec: str) -> str:
        """Return it as text: both numbers if they differ as they are shown."""
        low, high = format(self.low, spec), format(self.high, spec)
        return low if low == high else f"{low} to {high}"


Value = float | int | str


@dataclass(frozen=True, slots=True)
class Message:
    """Message about an event: a code, and the values that differ from one time to the next."""

    code: str
    """Key of the sentence in messages.toml; a code without one has its text in ``about``."""

    values: Mapping[str, Value]
    """Values in the sentence; ``about`` names one of the cases that share the code."""

    @override
    def __str__(self) -> str:
        """Return the sentence."""
        return self.format_ranges({})

    def format_ranges(self, ranges: Mapping[str, Range]) -> str:
        """Return the sentence with ranges of some of its numbers."""
        return SENTENCES.get(self.code, f"{{{ABOUT}}}").format(**{**self.values, **ranges})

    @property
    def key(self) -> str:
        """Key that is the same in messages that differ in numbers and ids only."""
        about = self.values.get(ABOUT)
        return self.code if about is None else f"{self.code}: {about}"


def compose(code: str, about: str | None = None, /, **values: Value) -> Message:
    """Return the message of a code with the values of its sentence."""
    return Message(code, values if about is None else {ABOUT: about, **values})


def as_message(code: str, text: str | Message) -> Message:
    """Return a text, whose words are its only identity, as a message; a message stays as it is."""
    return text if isinstance(text, Message) else compose(code, text)


def widen(ranges: Mapping[str, Range], new: Message) -> Mapping[str, Range]:
    """Return the ranges of the numbers of messages with one key after another one of them."""
    numbers = {name: n for name, n in new.values.items() if not isinstance(n, str)}
    before = {name: ranges.get(name, Range(n, n)) for name, n in numbers.items()}
    return {
        name: Range(min(before[name].low, n), max(before[name].high, n))
        for name, n in numbers.items()
    }


def _read() -> dict[str, str]:
    text = files(__package__).joinpath("messages.toml").read_text(encoding="utf-8")
    tables: dict[str, dict[str, str]] = tomllib.loads(text)
    return {
        f"{table}.{name}": line for table, texts in tables.items() for name, line in texts.items()
    }


SENTENCES: Final = _read()
"""Sentences with the names of their values, by code, from messages.toml."""
