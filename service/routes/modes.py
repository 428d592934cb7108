"""Modes in a request: by index, or by what they are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import Field, ValidatorFunctionWrapHandler, WithJsonSchema, WrapValidator

from service.state import ModeSet

MOST_MODES = 100_000


def _named_or_listed(value: object, listed: ValidatorFunctionWrapHandler) -> object:
    if isinstance(value, str):
        try:
            return ModeSet(value)
        except ValueError:
            raise ValueError("'controlled', 'all' or a list of basis indices") from None
    modes: list[int] = listed(value)
    if len(set(modes)) < len(modes):
        raise ValueError("modes without any of them twice")
    return modes


_SCHEMA = {
    "anyOf": [
        {
            "type": "array",
            "items": {"type": "integer", "minimum": 0},
            "minItems": 1,
            "maxItems": MOST_MODES,
        },
        {"type": "string", "enum": [name.value for name in ModeSet]},
    ]
}

if TYPE_CHECKING:
    Modes = list[int] | ModeSet
else:
    # a union of pydantic's own would name its branches in every message
    Modes = Annotated[
        Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1, max_length=MOST_MODES)],
        WrapValidator(_named_or_listed),
        WithJsonSchema(_SCHEMA),
    ]
