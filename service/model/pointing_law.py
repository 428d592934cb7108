"""The nominal registration as a law of pointing: expressions and tables of what is reported.

A mirror on a mount that turns, behind a derotator or below a bending tube has no nominal place but
at one pointing. Expressions are arithmetic alone: nothing in them can be called but a few functions
of numbers. Quick to import: mathematics come with the answers.
"""

from __future__ import annotations

import ast
import contextlib
import itertools
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Final

from service.errors import ModelError

if TYPE_CHECKING:
    from service.model.misregistration import Misregistration

ANGLES: Final = ("azimuth", "elevation")
"""Names of the pointing's angles, in degrees."""

MAX_EXPRESSION_LENGTH = 200
"""Letters of an expression."""


def _of_degrees(function: Callable[[float], float]) -> Callable[[float], float]:
    return lambda degrees: function(math.radians(degrees))


FUNCTIONS: Final[Mapping[str, Callable[[float], float]]] = {
    "sin": _of_degrees(math.sin),
    "cos": _of_degrees(math.cos),
    "tan": _of_degrees(math.tan),
    "sqrt": math.sqrt,
    "abs": abs,
}
"""Functions that an expression may call; angles are in degrees."""

_OPERATORS: Final[Mapping[type[ast.AST], Callable[..., float]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}

Reported = Mapping[str, float]
"""Numbers by name: azimuth and elevation, degrees, and what the observatory reports."""


@dataclass(frozen=True, slots=True)
class Term:
    """One number of a registration: an expression, or a table over one."""

    expression: str
    """Expression in the pointing and in values that the observatory reports, by their names."""

    at: tuple[float, ...] = ()
    """Ascending values of the expression at which the table has entries; empty if the expression
    itself is the number."""

    values: tuple[float, ...] = ()
    """The values there, straight lines between them; beyond its ends those of the ends."""

    period: float | None = None
    """Period of the expression: the table repeats itself after it. None if it does not."""

    def __post_init__(self) -> None:
        """Refuse what is no expression, or no table.

        Raises
        ------
        ModelError
            With what was found.
        """
        _parse(self.expression)
        if len(self.at) != len(self.values) or (self.at and len(self.at) < 2):
            raise ModelError(
                f"found {len(self.at)} places and {len(self.values)} values, expected as many of "
                "both, two at least"
            )
        if any(after <= before for before, after in zip(self.at, self.at[1:], strict=False)):
            raise ModelError(f"found places {list(self.at)}, expected rising ones")
        if self.period is not None and not (self.at and self.at[-1] - self.at[0] <= self.period):
            raise ModelError(f"found period {self.period:g}, expected at least the table's length")

    @property
    def closing_step(self) -> float:
        """Step of the table where its expression returns to the beginning; 0 if there is none.

        Without a period that is where the table spans a whole turn, as that of an angle does.
        """
        length = self.at[-1] - self.at[0] if self.at else 0.0
        closes = length > 0.0 and math.isclose(length, self.period or 360.0)
        return self.values[0] - self.values[-1] if closes else 0.0

    @property
    def names(self) -> frozenset[str]:
        """Names of what must be reported."""
        nodes = ast.walk(_parse(self.expression))
        found = {node.id for node in nodes if isinstance(node, ast.Name)}
        return frozenset(found - FUNCTIONS.keys())

    def north_step(self) -> float:
        """Return the change of the term after a whole turn of azimuth, 0 if it has no azimuth.

        The telescope points to the same place then, so any difference is a leap of the law where
        azimuth goes from 360 to 0. Beyond its ends a table keeps the values of its ends, which must
        therefore agree.
        """
        if "azimuth" not in self.names:
            return 0.0
        if self.at and self.expression.strip() == "azimuth":
            return -self.closing_step if self.period else self.values[-1] - self.values[0]
        steps = [0.0]
        # Several pointings, because a step may vanish at one of them.
        for elevation, azimuth in itertools.product((20.0, 50.0, 80.0), (-180.0, 0.0)):
            # Values of the observatory are not known here: any number will do for a difference.
            others = dict.fromkeys(self.names, 1.0) | {"elevation": elevation}
            ends = [others | {"azimuth": azimuth + turn} for turn in (0.0, 360.0)]
            with contextlib.suppress(ModelError):  # of values that nobody has reported yet
                steps.append(self.value(ends[1]) - self.value(ends[0]))
        return max(steps, key=abs)

    def value(self, reported: Reported) -> float:
        """Return the number.

        Raises
        ------
        ModelError
            If it is none: a division by zero, the root of a negative number.
        """
        try:
            found = _evaluate(_parse(self.expression), reported)
        except (ArithmeticError, ValueError, TypeError) as error:
            raise ModelError(f"{self.expression} is no number now: {error}") from error
        # A negative number to a fractional power is complex in Python.
        if isinstance(found, complex) or not math.isfinite(found):
            raise ModelError(f"{self.expression} is no number now: {found}")
        if not self.at:
            return found
        from numpy import interp

        at, values = self.at, self.values
        if self.period is not None:
            found = at[0] + (found - at[0]) % self.period
            if at[-1] < at[0] + self.period:
                at, values = (*at, at[0] + self.period), (*values, values[0])
        return float(interp(found, at, values))


@dataclass(frozen=True, slots=True, kw_only=True)
class PointingLaw:
    """Misregistration at any pointing; a missing term is 0, and 1 for the magnification."""

    shift_x_subap: Term | None = None
    shift_y_subap: Term | None = None
    rotation_deg: Term | None = None
    magnification: Term | None = None

    @property
    def names(self) -> frozenset[str]:
        """Names of what must be reported."""
        terms = (getattr(self, field.name) for field in fields(self))
        return frozenset().union(*(term.names for term in terms if term is not None))

    def at(self, reported: Reported) -> Misregistration:
        """Return the registration; all of ``names`` must be reported.

        Raises
        ------
        ModelError
            If one of its numbers is none, or no registration can have it.
        """
        from service.model.misregistration import Misregistration

        found = {
            field.name: term.value(reported)
            for field in fields(self)
            if (term := getattr(self, field.name)) is not None
        }
        nominal = Misregistration().to_boundary()
        return Misregistration.from_boundary(nominal | found)


@cache
def _parse(text: str) -> ast.expr:
    """Return an expression, of arithmetic alone.

    Raises
    ------
    ModelError
        With what was found and what may be.
    """
    expected = (
        f"numbers, {' and '.join(ANGLES)} (degrees), names of the observatory's values, "
        f"+ - * / ** ( ) and {', '.join(FUNCTIONS)}"
    )
    # Python's parser may exhaust its stack on deeply nested expressions.
    if len(text) > MAX_EXPRESSION_LENGTH:
        raise ModelError(
            f"found {len(text)} letters, expected at most {MAX_EXPRESSION_LENGTH}: {expected}"
        )
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ModelError(f"found {text!r}, expected an expression of {expected}") from error
    for node in ast.walk(tree):
        strange = _strange(node)
        if strange:
            raise ModelError(f"found {strange} in {text!r}, expected {expected}")
    return tree


def _strange(node: ast.AST) -> str:
    """Return what a part of an expression is that may not be; empty: it may."""
    match node:
        case ast.Constant(value=value):
            # type() and not isinstance(): True is an int.
            return "" if type(value) in {int, float} else repr(value)
        case ast.Call(func=ast.Name(id=name), args=[_], keywords=[]):
            return "" if name in FUNCTIONS else f"{name}()"
        case ast.Name() | ast.BinOp() | ast.UnaryOp() | ast.Load():
            return ""
        case _:
            return "" if type(node) in _OPERATORS else type(node).__name__.lower()


def _evaluate(node: ast.expr, reported: Reported) -> float:
    match node:
        case ast.Constant(value=int() | float() as value):
            return float(value)
        case ast.Name(id=name):
            return float(reported[name])
        case ast.Call(func=ast.Name(id=name), args=[argument]):
            return FUNCTIONS[name](_evaluate(argument, reported))
        case ast.UnaryOp(op=op, operand=operand):
            return _OPERATORS[type(op)](_evaluate(operand, reported))
        case ast.BinOp(left=left, op=op, right=right):
            return _OPERATORS[type(op)](_evaluate(left, reported), _evaluate(right, reported))
        case _:
            raise TypeError(f"found {type(node).__name__}")
