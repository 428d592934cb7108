"""An instrument as frozen records.

What the file says as it is comes from ``service.model.kinds``; arrays are added here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model import kinds
from service.model.misregistration import Misregistration
from service.model.pointing_law import PointingLaw
from service.model.slopes import SlopeRecipe

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


class SensorDescription(Protocol):
    """Properties that a sensor of any kind has; each kind has its own frozen dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]
    kind: ClassVar[str]
    """``wfs.kind`` of an instrument file: ``sensors.registry`` knows what may be asked of it."""

    @property
    def n_subapertures(self) -> int:
        """Subapertures across the sensor grid."""

    @property
    def wavelength_m(self) -> float:
        """Sensing wavelength, metres."""

    @property
    def pupil_diameter(self) -> float:
        """Diameter of the pupil image, in subapertures."""

    @property
    def flux_threshold(self) -> float:
        """Smallest flux of a valid subaperture, relative to a full one."""

    @property
    def valid_subapertures(self) -> NDArray[np.bool_] | None:
        """Mask ``(n_subapertures, n_subapertures)`` [y, x], the RTC's own axes; None: by flux."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mount:
    """Nominal rotation and parity of a mirror, if its owner states them.

    α acts on a point ``p`` of the mirror's own coordinates after ``diag(1, parity) p``.
    """

    nominal_rotation_rad: float | None = None
    """Rotation at which a fit starts, radians; None if not stated. α always reports the whole
    rotation."""

    parity: int | None = None
    """-1 if the mirror is seen from behind, so that its y axis is reversed, else 1; None if not
    stated."""

    stroke_known: bool = True
    """True if a unit command has a known height; otherwise only shapes can be compared."""

    nominal_anamorphosis: tuple[float, float] | None = None
    """Anamorphosis at which a fit starts, in α's units; None if not stated."""

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

    shape: kinds.InfluenceShape = field(default_factory=kinds.InfluenceShape)
    """Shape of the influence functions."""

    basis: kinds.BasisKind = kinds.BasisKind.KARHUNEN_LOEVE
    """Modes where ``mode_to_actuator`` is None."""

    segments_deg: tuple[float, ...] = ()
    """Direction of each gap between segments from the centre outwards, ascending, degrees from +x
    towards +y; empty for a mirror of one piece."""

    mode_to_actuator: NDArray[np.float64] | None = None
    """The user's own modes ``(n_actuators, n_modes)``: strokes in metres OPD per unit command."""

    position_error_pitch: float | None = None
    """RMS error of an actuator's position along each axis, in pitches; None: not stated."""

    @property
    def flat_modes(self) -> NDArray[np.intp]:
        """Modes that do not move the surface, by number."""
        strokes = self.mode_to_actuator
        return np.zeros(0, np.intp) if strokes is None else np.flatnonzero(~strokes.any(axis=0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalFunctions:
    """Measured influence functions that end: of each the samples that are not nothing."""

    heights: NDArray[np.floating]
    """``(n_samples,)`` metres of OPD per unit stroke, function after function."""

    places: NDArray[np.intp]
    """Index of each sample in the row-major table, ``(n_samples,)``."""

    ends: NDArray[np.intp]
    """``(n_functions + 1,)`` where the samples of each begin, and those of the last end."""

    strokes: NDArray[np.floating] | None
    """``(n_functions, n_modes)`` of each mode; None: each function is one."""

    floor: float
    """Share of a function's height below which it is nothing."""

    @property
    def n_functions(self) -> int:
        """Functions, one of each actuator."""
        return len(self.ends) - 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TabulatedModes(Mount):
    """Modes measured on a grid, centred on the pupil, in the units of their owner."""

    cube: NDArray[np.floating] | None
    """``(n_modes, ny, nx)``: metres of OPD per unit command, finite; float32 or float64. None: see
    ``local``."""

    pitch_m: float
    """Step of the grid along both axes, metres in the pupil plane."""

    known: NDArray[np.bool_]
    """``(ny, nx)``: where the table says something about the surface."""

    local: LocalFunctions | None = None
    """The functions that modes are made of, where these end; None: the modes are in ``cube``."""

    @property
    def n_modes(self) -> int:
        """Modes of the mirror."""
        if self.cube is not None:
            return len(self.cube)
        if self.local is None:
            return 0
        strokes = self.local.strokes
        return self.local.n_functions if strokes is None else int(strokes.shape[1])

    @property
    def flat_modes(self) -> NDArray[np.intp]:
        """Modes that do not move the surface, by number."""
        if self.cube is not None:
            return np.flatnonzero([not mode.any() for mode in self.cube])
        if self.local is None:
            return np.zeros(0, np.intp)
        moves = np.asarray(np.diff(self.local.ends) > 0)
        if self.local.strokes is not None:
            moves = np.asarray(self.local.strokes[moves].any(axis=0))
        return np.flatnonzero(~moves)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PupilMap:
    """A pupil that no circle describes, centred on the middle of its array."""

    lit: NDArray[np.float64]
    """``(ny, nx)`` [y, x]: share of each point's area that is lit, 0 to 1."""

    pitch_m: float
    """Step of the grid along both axes, metres in the pupil plane."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SensorMode:
    """One way in which the RTC reads its sensor: mirror, modes and order of slopes are the same."""

    config_id: str
    """The RTC's name of it."""

    binning: int
    """Number of the finest subapertures, along each axis, that are binned to one."""

    wfs: SensorDescription
    """The sensor, so read."""

    loop: kinds.LoopFacts
    """Properties of the loop in this mode."""

    def of(self, instrument: Instrument) -> Instrument:
        """Return an instrument that has this mode, in it."""
        return replace(instrument, wfs=self.wfs, config_id=self.config_id, loop=self.loop)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Instrument(kinds.Telescope):
    """One telescope, its mirror and its wavefront sensor."""

    wfs: SensorDescription
    mirror: Mirror | TabulatedModes
    modes: kinds.KarhunenLoeve = field(default_factory=kinds.KarhunenLoeve)
    slopes: SlopeRecipe = field(default_factory=SlopeRecipe)
    frames: object | None = None
    """The RTC delivers detector frames, of which the sensor's kind makes slopes like this; None: it
    delivers slopes."""

    loop: kinds.LoopFacts | None = None
    """Properties of the loop that are known without an RTC; None if none are."""

    unknown: tuple[str, ...] = ()
    """Keys of the file, like ``mirror.coupling``, whose values are only where a fit begins."""

    remarks: tuple[str, ...] = ()
    """Remarks for users of this description: one sentence each, with the key."""

    basis_id: str | None = None
    """Required basis of the RTC; None: the first one is adopted."""

    config_id: str | None = None
    """Required sensor configuration; None: the first one is adopted."""

    pupil: PupilMap | None = None
    """Outline and obscurations as they are; None: a ring, with the spider's arms."""

    pupil_shift_subap: tuple[float, float] | None = None
    """Position of the pupil's centre on the sensor's grid with the telescope as stop, (x, y) in
    subapertures; None for the middle of the grid."""

    law: PointingLaw | None = None
    """Misregistration as a function of the pointing; None if it does not depend on it."""

    sensor_modes: tuple[SensorMode, ...] = ()
    """Modes that the RTC may change to; ``config_id`` says which one ``wfs`` is of. Empty: it has
    one alone."""

    @property
    def collecting_area_m2(self) -> float:
        """Area of the pupil that light comes through."""
        if self.pupil is not None:
            return float(self.pupil.lit.sum()) * self.pupil.pitch_m**2
        # From the obscuration to the rim: what lies before the obscuration hides nothing.
        arm_m = self.diameter_m / 2 * (1 - self.obscuration_ratio)
        arms_m2 = len(self.spiders_deg) * (self.spiders_m or 0.0) * arm_m
        return np.pi / 4 * self.diameter_m**2 * (1 - self.obscuration_ratio**2) - arms_m2

    @property
    def binning(self) -> int:
        """Number of the finest subapertures, along each axis, that are binned to one."""
        # Without modes the subapertures are the finest there are.
        now = (mode.binning for mode in self.sensor_modes if mode.config_id == self.config_id)
        return next(now, 1)

    @property
    def finest(self) -> Instrument:
        """The same in its mode of the smallest subapertures."""
        if not self.sensor_modes:
            return self
        return min(self.sensor_modes, key=lambda mode: mode.binning).of(self)

    def in_mode(self, config_id: str) -> Instrument:
        """Return the same, its sensor read in another mode.

        Raises
        ------
        ModelError
            If it has no such mode.
        """
        mode = next((mode for mode in self.sensor_modes if mode.config_id == config_id), None)
        if mode is None:
            known = ", ".join(mode.config_id for mode in self.sensor_modes) or "no mode"
            raise ModelError(f"{self.name}: found mode {config_id}, expected one of: {known}")
        return mode.of(self)

    @property
    def subaperture_m(self) -> float:
        """Width of a subaperture in the pupil plane, metres."""
        return self.diameter_m / self.wfs.pupil_diameter

    @property
    def start(self) -> Misregistration:
        """Start of a fit: the mirror's nominal rotation, nothing else."""
        return Misregistration(rotation_rad=self.mirror.nominal_rotation_rad or 0.0)

    def with_anamorphosis(self, alpha: Misregistration) -> Misregistration:
        """Return α with the mirror's nominal anamorphosis, where it has none of its own."""
        nominal = self.mirror.nominal_anamorphosis
        if nominal is None or alpha.anamorphosis is not None:
            return alpha
        return replace(alpha, anamorphosis=nominal)

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


_Sensor = TypeVar("_Sensor", bound=SensorDescription)


def sensor_of_kind(instrument: Instrument, kind: type[_Sensor]) -> _Sensor:
    """Return the sensor of an instrument that has one of this kind.

    Raises
    ------
    ModelError
        If its sensor is another.
    """
    if not isinstance(instrument.wfs, kind):
        raise ModelError(
            f"{instrument.name}: found wfs.kind = {instrument.wfs.kind}, expected {kind.kind}"
        )
    return instrument.wfs


_LATER_FIELDS = frozenset(
    {
        "unknown",
        "sensor_modes",
        "law",
        "pupil",
        "pupil_shift_subap",
        "spiders_m",
        "spiders_deg",
        "segments_deg",
        "nominal_anamorphosis",
        "laser",
        "local",
        "image_offsets_subap",
        "position_error_pitch",
        "normalised",
        "fft_grid",
        "modulation_stretch",
        "rooftop_lambda_over_d",
        "aberration_rad",
    }
)
"""Fields without which an instrument has the digest that it has always had."""


def instrument_sha256(instrument: Instrument) -> str:
    """Return the SHA-256 of every field of an instrument, arrays included, as hex.

    Two files that describe the same instrument, one with the defaults spelt out, are the same.
    """
    # Records of the archive refer to an instrument by this digest.
    digest = hashlib.sha256()
    # Remarks contain paths, which do not change the instrument.
    _add(digest, replace(instrument, remarks=()))
    return digest.hexdigest()


def _add(digest: hashlib._Hash, value: object) -> None:
    if is_dataclass(value) and not isinstance(value, type):
        digest.update(f"{type(value).__name__}(".encode())
        for name, part in _parts(value):
            digest.update(f"{name}=".encode())
            _add(digest, part)
        digest.update(b")")
    elif isinstance(value, np.ndarray):
        # The same bytes mean other numbers in another type or shape.
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, tuple):
        for item in value:
            _add(digest, item)
        # The length ends a tuple: (1, 2), 3 and 1, (2, 3) must differ.
        digest.update(f"{len(value)};".encode())
    else:
        digest.update(f"{value!r};".encode())


def _parts(record: DataclassInstance) -> Iterator[tuple[str, object]]:
    """Yield fields by name; those of an influence function are listed as fields of the mirror.

    Both this flattening and the omission of newer fields that are empty keep the digest of an older
    description unchanged.
    """
    for one in fields(record):
        value = getattr(record, one.name)
        if one.name in _LATER_FIELDS and not value:
            continue
        if isinstance(value, kinds.InfluenceShape):
            yield from _parts(value)
        else:
            yield one.name, value
