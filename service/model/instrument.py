"""What pyrcal knows of an instrument: frozen records, filled from a TOML file elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.kinds import BasisKind, Influence, Stop
from service.model.misregistration import Misregistration
from service.model.slopes import SlopeRecipe


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pyramid:
    """The modulated pyramid wavefront sensor."""

    n_subapertures: int
    """Subapertures across the sensor grid."""

    wavelength_m: float
    """Sensing wavelength, metres."""

    modulation_lambda_over_d: float
    """Radius of the modulation circle, in λ/D."""

    pupil_separation_subap: float = 36.0
    """Distance between the centres of neighbouring pupil images, in subapertures."""

    pupil_diameter_subap: float | None = None
    """Diameter of the pupil image, in subapertures; None: ``n_subapertures``."""

    flux_threshold: float = 0.5
    """A subaperture is valid when its flux is at least this fraction of a full one."""

    valid_subapertures: NDArray[np.bool_] | None = None
    """Mask ``(n_subapertures, n_subapertures)``, [y, x] in the RTC's own axes, as its slopes are
    listed; None: by ``flux_threshold`` at α = 0."""

    @property
    def pupil_diameter(self) -> float:
        """Diameter of the pupil image, in subapertures."""
        return float(self.pupil_diameter_subap or self.n_subapertures)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mount:
    """How a mirror is built in, as far as its owner says.

    A point ``p`` of the mirror's drawing lies at ``diag(1, parity) p`` before α acts on it.
    """

    nominal_rotation_rad: float | None = None
    """Rotation at which a fit starts; None: not told. α always reports the whole rotation."""

    parity: int | None = None
    """-1: the mirror is seen from behind, its y axis points backwards; 1: it does not; None: not
    told."""

    stroke_known: bool = True
    """Whether a unit command has a known height; if not, only shapes can be compared."""

    @property
    def y_sign(self) -> float:
        """Sign of the mirror's y axis: 1 unless its owner says otherwise."""
        return float(self.parity or 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mirror(Mount):
    """An analytic deformable mirror: actuator positions and the shape of an influence function."""

    positions_m: NDArray[np.float64]
    """Actuator positions ``(n_actuators, 2)``, columns x and y, metres in the pupil plane."""

    pitch_m: float
    """Typical distance between neighbours, metres in the pupil plane."""

    influence: Influence = Influence.THIN_PLATE
    coupling: float = 0.35
    """Gaussian influence functions only: height at a distance of one pitch, 0..1."""

    basis: BasisKind = BasisKind.KARHUNEN_LOEVE
    """Modes where ``mode_to_actuator`` is None."""

    mode_to_actuator: NDArray[np.float64] | None = None
    """The user's own modes ``(n_actuators, n_modes)``: strokes in metres OPD per unit command."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TabulatedModes(Mount):
    """Modes measured on a grid, centred on the pupil, in the units of their owner."""

    cube: NDArray[np.floating]
    """``(n_modes, ny, nx)``: metres of OPD per unit command, finite; float32 or float64."""

    pitch_m: float
    """Step of the grid along both axes, metres in the pupil plane."""

    known: NDArray[np.bool_]
    """``(ny, nx)``: where the table says something about the surface."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameWindows:
    """Where the four pupil images lie on full detector frames."""

    centres_px: NDArray[np.float64] | None = None
    """``(4, 2)`` row and column of the images' centres, one in each quadrant of the four, in any
    order; pixel centres are whole numbers. None: to be found in a flux frame."""

    pixels_per_subaperture: int = 1
    """Detector pixels along a side of a subaperture."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopFacts:
    """What the RTC's status would say of the loop, for work without an RTC."""

    frame_rate_hz: float | None = None
    """Frames per second."""

    delay_frames: float | None = None
    """From a frame to the first one that sees its correction."""

    n_controlled: int | None = None
    """Modes in the loop, the first ones."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KarhunenLoeve:
    """The modal basis: Karhunen-Loeve modes of von Karman turbulence in mirror space.

    A basis of the user's own takes only the turbulence from here.
    """

    n_modes: int = 594
    """Modes of the basis, controlled or not; of a user's own basis as many as it has."""

    r0_m: float = 0.10
    """Fried parameter at 500 nm, metres: sets the expected variance of each mode."""

    outer_scale_m: float = 25.0
    """Outer scale of the turbulence, metres."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Instrument:
    """One telescope, its mirror and its wavefront sensor."""

    name: str
    """Also the ``{system}`` of the wire unless configured otherwise."""

    diameter_m: float
    """Pupil diameter, metres."""

    obscuration_ratio: float = 0.0
    """Linear central obscuration, 0..1."""

    stop: Stop
    double_pass: bool = False
    """Whether a measured matrix of this instrument sees the mirror twice."""

    wfs: Pyramid
    mirror: Mirror | TabulatedModes
    modes: KarhunenLoeve = field(default_factory=KarhunenLoeve)
    slopes: SlopeRecipe = field(default_factory=SlopeRecipe)
    frames: FrameWindows | None = None
    """The RTC delivers detector frames, cut like this; None: it delivers slopes."""

    loop: LoopFacts | None = None
    """What is known of the loop without an RTC."""

    remarks: tuple[str, ...] = ()
    """What whoever uses this description should be told: one sentence each, with the key."""

    basis_id: str | None = None
    """Pins the RTC's basis; None: the first seen is adopted."""

    config_id: str | None = None
    """Pins the RTC's sensor configuration; None: the first seen is adopted."""

    @property
    def subaperture_m(self) -> float:
        """Width of a subaperture in the pupil plane, metres."""
        return self.diameter_m / self.wfs.pupil_diameter

    @property
    def start(self) -> Misregistration:
        """Where a fit starts: the mirror's nominal rotation, nothing else."""
        return Misregistration(rotation_rad=self.mirror.nominal_rotation_rad or 0.0)

    @property
    def analytic_mirror(self) -> Mirror:
        """The mirror, where actuators are needed and a table of shapes will not do.

        Raises
        ------
        ModelError
            If the modes are tabulated.
        """
        if isinstance(self.mirror, TabulatedModes):
            raise ModelError(
                f"{self.name}: found a table of measured modes; expected an analytic mirror "
                "(mirror.layout), whose actuators are known"
            )
        return self.mirror
