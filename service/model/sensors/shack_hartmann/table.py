"""Keys of a Shack-Hartmann in an instrument file: quick to import, no arrays."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt

from service.model.kinds import Positive, Read


class Centroid(StrEnum):
    """Computation of a spot's position from its pixels."""

    CENTRE_OF_GRAVITY = "cog"
    """Each pixel counts with its light."""

    WEIGHTED = "weighted"
    """Each pixel counts with its light times what a flat wavefront leaves there."""

    THRESHOLD = "threshold"
    """Pixels below ``threshold`` do not count."""

    GRADIENT = "gradient"
    """None: the mean gradient over the lenslet's light, which no pixels cut."""


class PartlyLit(StrEnum):
    """Treatment of subapertures that the edge of the pupil cuts."""

    USE = "use"
    LEAVE_OUT = "leave out"


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserStar(Read):
    """``[wfs.laser]``: a laser star in the sodium layer, elongated on each lenslet."""

    height_m: Annotated[float, Ge(1e3), Le(1e6)]
    """Distance of the middle of the layer along the line of sight."""

    thickness_m: Annotated[float, Ge(0.0), Le(1e5)]
    """Full width at half maximum of the layer along the line of sight."""

    spot_arcsec: Annotated[float, Gt(0.0), Le(60.0)]
    """Full width at half maximum of the star."""

    launcher_m: tuple[float, float]
    """Launcher, x and y from the middle of the pupil, in the sensor's axes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShackHartmannNumbers(Read):
    """The lenslets, their pixels and their centroids."""

    n_subapertures: Annotated[int, Ge(4), Le(1000)]
    """Subapertures across the sensor grid."""

    wavelength_m: Annotated[float, Gt(1e-7), Lt(1e-4)]
    """Sensing wavelength, to which slopes are relative; "unknown" until a matrix is fitted."""

    pupil_diameter_subap: Positive | None = None
    """Diameter of the pupil image; None: ``n_subapertures``."""

    flux_threshold: Annotated[float, Gt(0.0), Le(1.0)] = 0.5
    """Smallest flux of a valid subaperture, relative to a full one."""

    pixels_per_subaperture: Annotated[int, Ge(2), Le(64)] = 6
    """Pixels across a subaperture."""

    pixel_scale_arcsec: Positive | None = None
    """Width of a pixel on the sky; None: λ/d, d the width of a subaperture."""

    centroid: Centroid = Centroid.CENTRE_OF_GRAVITY
    """Centroid: `cog`, of all pixels; `weighted`, by the spot of a flat wavefront; `threshold`,
    without faint pixels; `gradient`, the mean gradient of the wavefront, without pixels, as in a
    geometric simulator."""

    threshold: Annotated[float, Gt(0.0), Lt(1.0)] | None = None
    """With `threshold` only: faintest pixel used, relative to the brightest."""

    partly_lit: PartlyLit | None = None
    """Treatment of subapertures at the pupil's edge in fits; None: used, except with a threshold,
    which makes their centroids nonlinear."""

    laser: LaserStar | None = None
    """Laser star; None: a point at infinity."""

    @property
    def pupil_diameter(self) -> float:
        """Diameter of the pupil image, in subapertures."""
        return float(self.pupil_diameter_subap or self.n_subapertures)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShackHartmannTable(ShackHartmannNumbers):
    """``[wfs]``: the Shack-Hartmann sensor."""

    kind: Literal["shack-hartmann"]

    valid_subapertures: str = "auto"
    """"auto": by ``flux_threshold``; or a mask ``path:/dataset``."""

    guide_star_height_m: Literal["infinity"] = "infinity"
    """Natural star only; a laser star has `[wfs.laser]`."""
