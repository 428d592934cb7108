"""Keys of a pyramid in an instrument file: quick to import, no arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen, MultipleOf

from service.model.kinds import Count, Positive, Read

USUAL_SEPARATION = 1.2
"""Default distance of neighbouring pupil images over their diameter."""

IMAGE_KEY = "image_offsets_px"
"""Key of the displacements of the pupil images."""

ELLIPSE_KEY = "modulation_ellipse"
"""Key of an elliptic modulation."""

ROOFTOP_KEY = "rooftop_lambda_over_d"
"""Key of the edge in place of the pyramid's tip."""

ABERRATION_KEY = "static_aberration_nm"
"""Key of a static aberration."""

N_ABERRATIONS = 14
"""Number of Zernike polynomials of a static aberration: Noll's numbers 2 to 15, which are all up to
the fourth radial order."""

MAX_OFFSET_PX = 4.0
"""Largest displacement of a pupil image from its place on the pixel grid, detector pixels. Whole
pixels belong into the windows that cut the images."""

Across = Annotated[int, Ge(4), Le(1000)]
Modulation = Annotated[float, Ge(0.0), Le(100.0)]
Axis = Annotated[float, Gt(0.0), Le(100.0)]
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
    """Sensing wavelength; "unknown" until a matrix is fitted."""

    modulation_lambda_over_d: Modulation
    """Radius of the modulation, λ/D; "unknown" until a matrix is fitted."""

    rooftop_lambda_over_d: Annotated[float, Ge(-5.0), Le(5.0)] = 0.0
    """Length of the edge that takes the place of the pyramid's tip, λ/D; 0 for a tip. It runs from
    -x +y to +x -y of the RTC's axes, or from -x -y to +x +y if the length is negative. "unknown"
    until a matrix is fitted."""

    pupil_separation_subap: Positive | None = None
    """Distance of the centres of neighbouring pupil images; None: 1.2 diameters of the pupil."""

    pupil_diameter_subap: Positive | None = None
    """Diameter of the pupil image; None: ``n_subapertures``."""

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
class Ellipse(Read):
    """``modulation_ellipse``: an elliptic modulation."""

    axes_lambda_over_d: tuple[Axis, Axis]
    """Semi-axes, λ/D."""

    angle_deg: float = 0.0
    """Direction of the first one, from +x towards +y in the RTC's axes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FftGrid(Read):
    """``fft_grid``: the grid on which a simulation with an FFT has made the matrix."""

    points_per_subaperture: Annotated[int, Ge(1), Le(64)]
    """Points of the pupil along a subaperture, and of the detector along its pixel."""

    width_subap: Positive
    """Width of the whole grid, zeros around the pupil included; light that leaves it on one side
    comes back on the other."""

    modulation_points: Annotated[int, Ge(4), Le(1000), MultipleOf(4)] | None = None
    """Points on the circle of the modulation, the first one along x; None: as many as a smooth
    circle needs."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PyramidMode(Read):
    """``[[wfs.mode]]``: a configuration that the RTC may use instead, such as a binning."""

    config_id: Annotated[str, MinLen(1), MaxLen(128)]
    """Name that the RTC gives it."""

    binning: Count = 1
    """Subapertures of ``[wfs]`` that become one along each axis."""

    n_subapertures: Across | None = None
    """Subapertures across the binned grid; None: those of ``[wfs]`` over ``binning``."""

    modulation_lambda_over_d: Modulation | None = None
    """Radius of the modulation, λ/D; None: that of ``[wfs]``."""

    valid_subapertures: str = "auto"
    """"auto": by ``flux_threshold``; or a mask ``path:/dataset``."""

    frame_rate_hz: Positive | None = None
    """Frame rate without an RTC; None: that of ``[loop]``."""

    n_controlled: Count | None = None
    """Largest number of controlled modes; None: that of the settings."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PyramidTable(PyramidNumbers):
    """``[wfs]``: the pyramid sensor."""

    kind: Literal["pyramid"]

    modulation_ellipse: Ellipse | None = None
    """Elliptic modulation ``{ axes_lambda_over_d = [4.0, 5.0], angle_deg = 30.0 }``, instead of
    ``modulation_lambda_over_d``: its semi-axes, and the direction of the first one from +x towards
    +y in the RTC's axes. None: a circle. "unknown" together with a radius: fitted to a measured
    matrix."""

    valid_subapertures: str = "auto"
    """"auto": by ``flux_threshold``; or a mask ``path:/dataset``."""

    input: Literal["slopes", "frames", "normalised-frames"] = "slopes"
    """Signals that the RTC sends. A measured matrix of frames comes with a mean frame in the same
    counts; "normalised-frames" are divided by their sum over the detector, and need none."""

    fft_grid: FftGrid | None = None
    """Grid ``{ points_per_subaperture = 2, width_subap = 52.0 }`` of a simulation that has made the
    matrix with an FFT. Such a matrix differs by per cents from that of a real sensor. None: a
    real sensor, or a grid that is not known."""

    static_aberration_nm: Annotated[tuple[float, ...], MaxLen(N_ABERRATIONS)] | None = None
    """Static aberration of the beam in which the matrix was measured: coefficients of the Zernike
    polynomials of Noll's numbers 2 (tilt along x) to 15 at most, nm RMS, in the RTC's axes; a
    positive one rises where a positive command does. None: a flat wavefront. "unknown": fitted to a
    measured matrix."""

    pupil_centres_px: Centres | None = None
    """Frames only: centres of the four pupil images, row and column; "auto": found in a flux
    frame."""

    pixels_per_subaperture: Count = 1
    """Frames only."""

    image_offsets_px: Offsets | None = None
    """Displacement [x, y] of each pupil image from the pixel grid, in the RTC's axes, in the order
    -x -y, +x -y, -x +y, +x +y. None: fitted to a measured matrix, and σ that the service shows
    allows for 0.15 pixel; "unknown": likewise, and the stability gate allows for it. With ``stop =
    "mirror"`` their mean is the shift and does not count."""

    mode: tuple[PyramidMode, ...] = ()
    """Sensor modes; the service begins with the first."""
