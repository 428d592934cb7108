"""Declare options and operands of a command line; quick to import."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, NamedTuple


class Words(NamedTuple):
    """An option or an operand: ``--name VALUE``, a flag ``--name``, ``operand VALUE``."""

    form: str
    purpose: str | None
    how: dict[str, Any]
    """Further keyword arguments of argparse."""


def words(form: str, purpose: str | None = None, **how: Any) -> Words:  # noqa: ANN401 - argparse's own
    """Return an option or an operand; one with ``choices`` is not a flag."""
    return Words(form, purpose, how)


def add(to: Any, *every: Words) -> None:  # noqa: ANN401 - argparse's own, whose type is private
    """Add options and operands to a command, or to a group of them."""
    for form, purpose, how in every:
        name, _, value = form.partition(" ")
        flag = name.startswith("-") and not value and "choices" not in how
        named = {"metavar": value} if value else {"action": "store_true"} if flag else {}
        to.add_argument(name, help=purpose, **named, **how)


def collect_arguments(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """Return those of the named options that were given."""
    given = {name: getattr(options, name, None) for name in names}
    return {name: value for name, value in given.items() if value is not None}
