"""Kinds and numbers that an instrument file names; quick to import.

What needs arrays, or more than one table of the file, is in ``service.model.instrument``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, ClassVar

from annotated_types import Ge, Gt, Lt


class Stop(StrEnum):
    """The element that limits the beam."""

    MIRROR = "mirror"
    """The adaptive mirror is the stop: pupil edge and obscuration move with the shift (FLAO)."""

    TELESCOPE = "telescope"
    """The pupil is fixed; only the influence functions move (the ELT, most simulators)."""


class Influence(StrEnum):
    """Shape of an analytic influence function."""

    THIN_PLATE = "thin-plate"
    GAUSSIAN = "gaussian"


class ArrayLibrary(StrEnum):
    """Libraries that may compute rows of D."""

    NUMPY = "numpy"
    TORCH = "torch"
    CUPY = "cupy"


class BasisKind(StrEnum):
    """Modes of a mirror whose user brings none."""

    KARHUNEN_LOEVE = "KL"
    """Karhunen-Loeve modes of von Karman turbulence."""

    ZONAL = "zonal"
    """The actuators themselves, in their order."""


class SignalKind(StrEnum):
    """Kinds of signals of a subaperture; each kind of sensor says which it has."""

    XY = "xy"
    """Two slopes for each subaperture."""

    INTENSITY = "intensity"
    """Four pixels of each subaperture of a pyramid, normalised, those of a flat wavefront
    subtracted."""

    @property
    def n_planes(self) -> int:
        """Signals of a subaperture."""
        return 2 if self is SignalKind.XY else 4

    @property
    def noise(self) -> float:
        """1 σ of a signal over that of a slope, which four pixels make."""
        return 1.0 if self is SignalKind.XY else 0.5

    @property
    def orders(self) -> tuple[SlopeOrder, ...]:
        """Orders in which they may be listed; the first is the default."""
        return tuple(order for order in SlopeOrder if order.kind is self)


class SlopeOrder(StrEnum):
    """Order of the signals in the RTC's vector.

    Subapertures always follow one another row by row.
    """

    XY = "xy"
    """All Sx, then all Sy."""

    YX = "yx"
    """All Sy, then all Sx."""

    INTERLEAVED = "interleaved"
    """Sx and Sy of one subaperture, then of the next."""

    IMAGES = "images"
    """One pupil image after the other, by position: at -x -y, +x -y, -x +y, +x +y."""

    IMAGES_YX = "images-yx"
    """The same, along y first: at -x -y, -x +y, +x -y, +x +y."""

    AROUND = "around"
    """The same, going round: at -x -y, +x -y, +x +y, -x +y."""

    PIXELS = "pixels"
    """The four pixels of one subaperture, as in ``images``, then of the next."""

    DETECTOR = "detector"
    """Order of the detector's rows: a row of two images, and so on."""

    @property
    def kind(self) -> SignalKind:
        """Kind of the signals in this order."""
        slopes = {SlopeOrder.XY, SlopeOrder.YX, SlopeOrder.INTERLEAVED}
        return SignalKind.XY if self in slopes else SignalKind.INTENSITY


class Normalisation(StrEnum):
    """Divisor of the intensities and their differences."""

    GLOBAL = "global"
    """The mean flux per valid subaperture."""

    LOCAL = "local"
    """Each subaperture's own flux."""


class Method(StrEnum):
    """Methods of finding the registration."""

    JOINT = "joint"
    """All four parameters together, by variable projection over a free gain per mode."""

    PAPER = "paper"
    """One parameter at a time: the ten scans of Heritier et al. 2018, Table 1."""

    SENSITIVITY = "sensitivity"
    """Projection on sensitivity matrices about the start, iterated."""


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
    """Also the ``{system}`` of the contract's keys."""

    diameter_m: Positive
    """Pupil diameter."""

    obscuration_ratio: Annotated[float, Ge(0.0), Lt(1.0)] = 0.0
    """Linear central obscuration."""

    stop: Stop
    """Element that limits the beam."""

    double_pass: bool = False
    """True if the light meets the mirror twice in a measured matrix."""

    spiders_m: Positive | None = None
    """Width of the spider's shadows on the pupil; None: no spider."""

    spiders_deg: tuple[float, ...] = ()
    """Direction of each arm outwards, from +x towards +y."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InfluenceShape(Read):
    """Shape of an analytic mirror's influence functions."""

    influence: Influence = Influence.THIN_PLATE
    """Shape of an influence function."""

    coupling: Annotated[float, Gt(0.0), Lt(1.0)] = 0.35
    """Gaussian only: height at one pitch; "unknown" until a matrix is fitted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KarhunenLoeve(Read):
    """The modal basis: Karhunen-Loeve modes of von Karman turbulence.

    Your own basis takes only the turbulence from here.
    """

    n_modes: Count = 594
    """Modes of the basis, controlled or not. Left out: at most nine tenths of what the actuators
    make."""

    r0_m: Positive = 0.10
    """Fried parameter at 500 nm."""

    outer_scale_m: Positive = 25.0
    """Outer scale."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopFacts(Read):
    """The loop: used without an RTC."""

    frame_rate_hz: Positive | None = None
    """Frame rate."""

    delay_frames: Annotated[float, Ge(1.0)] | None = None
    """Frames from an exposure to its correction."""

    n_controlled: Count | None = None
    """Controlled modes, the first ones."""
