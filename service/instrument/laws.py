"""``[law]`` of an instrument file: the nominal registration as a law of pointing."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass, fields
from functools import partial
from typing import Annotated, Any

from pydantic import PlainValidator

from service.errors import ModelError
from service.model.kinds import Read
from service.model.pointing_law import ANGLES, PointingLaw, Term

_MISSPELT_SIMILARITY = 0.75
"""Similarity above which a name is taken for a misspelt angle, and not for a value of the
observatory."""

_FORM = '{ of = "elevation", at = [20, 80], values = [0.1, -0.1] }'


NORTH_STEP_SUBAP = 0.02
"""Largest change of a law after a whole turn of azimuth: a tenth of what a matrix bears."""

NORTH_STEP_DEG = 0.05
NORTH_STEP_MAGNIFICATION = 0.001


def _term(value: object, *, north_step: float, turn: float = 0.0) -> Term:
    """Return a term as a file has it: a number, an expression or a table.

    It may differ by ``north_step`` after a whole turn of azimuth, or by a multiple of ``turn``.
    """
    try:
        term = _convert_term(value)
        step = term.north_step()
    except ModelError as error:
        raise ValueError(str(error)) from error
    # A rotation that grows by whole turns with azimuth comes back to the same angle.
    left = math.remainder(step, turn) if turn else step
    if abs(left) > north_step:
        raise ValueError(
            f"found a law that is {step:.4g} more after a whole turn of azimuth: it would leap at "
            f"north; expected the same, to {north_step:g}, as of sin(azimuth) or of a table whose "
            "first and last values agree"
        )
    return term


def _convert_term(value: object) -> Term:
    match value:
        # Before int(): a bool of Python is an int.
        case bool():
            raise ModelError(f"found {value}, expected a number, an expression or {_FORM}")
        # repr() keeps all digits of a float.
        case int() | float():
            return Term(repr(float(value)))
        case str():
            term = Term(value)
        case {"of": str(of), "at": [*at], "values": [*values], **more} if not more:
            if not all(type(number) in {int, float} for number in (*at, *values)):
                raise ModelError(f"found {value}, expected numbers in at and values")
            term = Term(of, tuple(map(float, at)), tuple(map(float, values)))
        case _:
            raise ModelError(f"found {value!r}, expected a number, an expression or {_FORM}")
    for name in sorted(term.names - set(ANGLES)):
        close = difflib.get_close_matches(name, ANGLES, n=1, cutoff=_MISSPELT_SIMILARITY)
        if close:
            raise ModelError(f"found {name}, did you mean {close[0]}?")
    return term


_INPUT = float | str | dict[str, Any]
_Shift = Annotated[
    Term | None,
    PlainValidator(
        partial(_term, north_step=NORTH_STEP_SUBAP),
        json_schema_input_type=_INPUT,
    ),
]
_Rotation = Annotated[
    Term | None,
    PlainValidator(
        partial(_term, north_step=NORTH_STEP_DEG, turn=360.0),
        json_schema_input_type=_INPUT,
    ),
]
_Magnification = Annotated[
    Term | None,
    PlainValidator(
        partial(_term, north_step=NORTH_STEP_MAGNIFICATION),
        json_schema_input_type=_INPUT,
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class LawTable(Read):
    """``[law]``: the nominal registration as a function of the pointing.

    α is tracked as the deviation from it. Each parameter is a number, an expression of `azimuth`
    and `elevation` (degrees) and of names of the observatory's values, or a table `{ of =
    "elevation", at = [20, 80], values = [0.1, -0.1] }` with linear interpolation. A whole turn of
    azimuth must not change it, except by whole turns of the rotation.
    """

    shift_x_subap: _Shift = None
    """None: 0."""

    shift_y_subap: _Shift = None
    """None: 0."""

    rotation_deg: _Rotation = None
    """Such as `azimuth - 12.98`; None: 0."""

    magnification: _Magnification = None
    """None: 1."""


def law_of(table: LawTable) -> PointingLaw | None:
    """Return the law; None: the file has none."""
    terms = {field.name: getattr(table, field.name) for field in fields(table)}
    return PointingLaw(**terms) if any(terms.values()) else None
