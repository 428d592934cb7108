"""What kinds of telescope, mirror and slopes there are, by the names of an instrument file."""

from __future__ import annotations

from enum import StrEnum


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


class BasisKind(StrEnum):
    """Modes of a mirror whose user brings none."""

    KARHUNEN_LOEVE = "KL"
    """Karhunen-Loeve modes of von Karman turbulence."""

    ZONAL = "zonal"
    """The actuators themselves, in their order."""


class SlopeOrder(StrEnum):
    """How the two components follow one another in the RTC's slope vector."""

    XY = "xy"
    """All Sx, then all Sy."""

    YX = "yx"
    """All Sy, then all Sx."""

    INTERLEAVED = "interleaved"
    """Sx and Sy of one subaperture, then of the next."""


class Normalisation(StrEnum):
    """What the differences of intensity are divided by."""

    GLOBAL = "global"
    """The mean flux per valid subaperture."""

    LOCAL = "local"
    """Each subaperture's own flux."""
