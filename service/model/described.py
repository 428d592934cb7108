"""Names and numbers of an instrument file; quick to import.

What needs arrays, or more than one table of the file, is in ``service.model.instrument``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from annotated_types import Ge, Gt, Lt

from service.model.kinds import Influence, Stop

Positive = Annotated[float, Gt(0.0)]
Count = Annotated[int, Ge(1)]


class Read:
    """Read strictly: no unknown keys, no guessing between types, finite numbers."""

    __slots__ = ()
    __pydantic_config__: ClassVar[dict[str, object]] = {
        "extra": "forbid",
        "strict": True,
        "allow_inf_nan": False,
    }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Telescope(Read):
    """A telescope as a whole."""

    name: str
    """Also the ``{system}`` of the wire."""

    diameter_m: Positive
    """Pupil diameter, metres."""

    obscuration_ratio: Annotated[float, Ge(0.0), Lt(1.0)] = 0.0
    """Linear central obscuration."""

    stop: Stop
    """Element that limits the beam."""

    double_pass: bool = False
    """A measured matrix sees the mirror twice."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InfluenceShape(Read):
    """Shape of an analytic mirror's influence functions."""

    influence: Influence = Influence.THIN_PLATE
    """Shape of an influence function."""

    coupling: Annotated[float, Gt(0.0), Lt(1.0)] = 0.35
    """Gaussian only: height at a distance of one pitch; "unknown" until a matrix is fitted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KarhunenLoeve(Read):
    """The modal basis: Karhunen-Loeve modes of von Karman turbulence in mirror space.

    A basis of the user's own takes only the turbulence from here.
    """

    n_modes: Count = 594
    """Modes of the basis, controlled or not; of a user's own basis as many as it has. Left out:
    no more than nine tenths of what the actuators make."""

    r0_m: Positive = 0.10
    """Fried parameter at 500 nm, metres."""

    outer_scale_m: Positive = 25.0
    """Outer scale, metres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopFacts(Read):
    """The loop: the loop, for work without an RTC."""

    frame_rate_hz: Positive | None = None
    """Frames per second."""

    delay_frames: Annotated[float, Ge(1.0)] | None = None
    """Frames from an exposure to the first one that sees its correction."""

    n_controlled: Count | None = None
    """Modes in the loop, the first ones."""
