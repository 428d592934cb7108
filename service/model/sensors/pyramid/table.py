"""Keys of a pyramid in an instrument file: quick to import, no arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen

from service.model.kinds import Count, Positive, Read

USUAL_SEPARATION = 1.2
"""Default distance of neighbouring pupil images over their diameter."""

MAX_OFFSET_PX = 4.0
"""Largest displacement of a pupil image from its place on the pixel grid, detector pixels. Whole
pixels belong into the windows that cut the images."""

Across = Annotated[int, Ge(4), Le(1000)]
Modulation = Annotated[float, Ge(0.0), Le(100.0)]
Pixel = Annotated[float, Ge(0.0)]
Centre = tuple[Pixel, Pixel]
Centres = tuple[Centre, Centre, Centre, Centre]
Offset = tuple[
    Annotated[float, Ge(-MAX_OFFSET_PX), Le(MAX_OFFSET_PX)],
    Annotated[float, Ge(-MAX_OFFSET_PX), Le(MAX_OFFSET_PX)],
]
Offsets = tuple[Offset, Offset, Offset, Offset]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PyramidNumbers(Read):
    """The modulated pyramid wavefront sensor and its sampling."""

    n_subapertures: Across
    """Subapertures across the sensor grid."""

    wavelength_m: Annotated[float, Gt(1e-7), Lt(1e-4)]
    """Sensing wavelength, metres; may be "unknown" until a matrix is fitted."""

    modulation_lambda_over_d: Modulation
    """Radius of the modulation circle, λ/D; may be "unknown" until a matrix is fitted."""

    pupil_separation_subap: Positive | None = None
    """Distance between the centres of neighbouring pupil images, subapertures; None: 1.2 diameters
    of the pupil."""

    pupil_diameter_subap: Positive | None = None
    """Diameter of the pupil image, subapertures; None: ``n_subapertures``."""

    flux_threshold: Annotated[float, Gt(0.0), Le(1.0)] = 0.5
    """Smallest flux of a valid subaperture, relative to a full one."""

    @property
    def pupil_diameter(self) -> float:
        """Diameter of the pupil image, in subapertures."""
        return float(self.pupil_diameter_subap or self.n_subapertures)

    @property
    def image_separation_subap(self) -> float:
        """Distance between the centres of neighbouring pupil images, in subapertures."""
        return float(self.pupil_separation_subap or USUAL_SEPARATION * self.pupil_diameter)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PyramidMode(Read):
    """``[[wfs.mode]]``: a mode that the RTC may change to at night, as another binning is."""

    config_id: Annotated[str, MinLen(1), MaxLen(128)]
    """The RTC's name of it: a mode is a configuration of its own."""

    binning: Count = 1
    """Subapertures of ``[wfs]`` that are one along each axis."""

    n_subapertures: Across | None = None
    """Subapertures across the binned grid; None: those of ``[wfs]`` over ``binning``, which must
    divide them."""

    modulation_lambda_over_d: Modulation | None = None
    """Radius of the modulation circle, λ/D; None: that of ``[wfs]``."""

    valid_subapertures: str = "auto"
    """"auto": by ``flux_threshold``; else a mask ``path:/dataset``."""

    frame_rate_hz: Positive | None = None
    """Frames per second, for work without an RTC; None: that of ``[loop]``."""

    n_controlled: Count | None = None
    """Largest number of controlled modes; None for the number in the settings."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PyramidTable(PyramidNumbers):
    """``[wfs]``: the pyramid sensor."""

    kind: Literal["pyramid"]

    valid_subapertures: str = "auto"
    """"auto": by ``flux_threshold``; else a mask ``path:/dataset``."""

    input: Literal["slopes", "frames"] = "slopes"
    """Signals that the RTC sends."""

    pupil_centres_px: Centres | None = None
    """Centres of the four pupil images, row and column; "auto" to find them in a flux frame. Frames
    only."""

    pixels_per_subaperture: Count = 1
    """Frames only."""

    image_offsets_px: Offsets | None = None
    """Displacement [x, y] of each pupil image from its place on the pixel grid, detector pixels,
    in the RTC's axes, in the order of the images' places: -x -y, +x -y, -x +y, +x +y. With
    ``stop = "mirror"`` only differences from their mean count: the mean is the shift itself. Not
    given: fitted to a measured matrix. "unknown": so, and the uncertainty of live estimates allows
    for 0.15 pixel."""

    mode: tuple[PyramidMode, ...] = ()
    """A table ``[[wfs.mode]]`` for each; the service begins with the first."""
