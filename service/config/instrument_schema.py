"""Every key an instrument file may hold, with its type, range and default."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from service.config import instrument_path
from service.config.sources import Id, Named, Table, in_file, read_toml, validated
from service.model.kinds import BasisKind, Influence, Normalisation, SignalKind, SlopeOrder, Stop

Positive = Annotated[float, Field(gt=0.0)]
Count = Annotated[int, Field(ge=1)]
Sign = Literal[-1, 1]
Pixel = Annotated[float, Field(ge=0.0)]
Centre = tuple[Pixel, Pixel]
Centres = tuple[Centre, Centre, Centre, Centre]


def _auto_is_none(value: object) -> object:
    return None if value == "auto" else value


def _signs(value: object) -> object:
    pair = value if isinstance(value, list) else [value, value]
    if len(pair) != 2 or not all(type(sign) is int and abs(sign) == 1 for sign in pair):
        raise ValueError(f"found {value!r}, expected 1, -1 or two of them: [sign_x, sign_y]")
    return tuple(pair)


def _centres(value: object) -> object:
    if value == "auto":
        return None
    points = value if isinstance(value, list) else []
    pairs = [point for point in points if isinstance(point, list) and len(point) == 2]
    if len(points) != 4 or len(pairs) != 4:
        raise ValueError(f'found {value!r}, expected "auto" or four pairs [row, column]')
    return tuple(tuple(point) for point in pairs)


class AboutTable(Table):
    """``[instrument]``: the telescope as a whole."""

    name: Id
    """Also the ``{system}`` of the wire unless configured otherwise."""

    diameter_m: Positive
    """Pupil diameter, metres."""

    obscuration_ratio: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Linear central obscuration."""

    stop: Named[Stop]
    """Which element limits the beam."""

    double_pass: bool = False
    """Whether a measured matrix sees the mirror twice."""

    basis_id: Id | None = None
    """Pins the RTC's basis."""

    config_id: Id | None = None
    """Pins the RTC's sensor configuration."""


class WfsTable(Table):
    """``[wfs]``: the pyramid sensor."""

    kind: Literal["pyramid"]

    n_subapertures: int = Field(ge=4, le=1000)
    """Subapertures across."""

    pupil_separation_subap: Positive = 36.0
    """Distance between the centres of neighbouring pupil images, subapertures."""

    wavelength_m: float = Field(gt=1e-7, lt=1e-4)
    """Sensing wavelength, metres."""

    modulation_lambda_over_d: float = Field(ge=0.0, le=100.0)
    """Radius of the modulation circle, λ/D."""

    valid_subapertures: str = "auto"
    """"auto": by ``flux_threshold``; else a mask ``path:/dataset``."""

    flux_threshold: float = Field(default=0.5, gt=0.0, le=1.0)
    """Least flux of a valid subaperture, relative to a full one."""

    pupil_diameter_subap: Positive | None = None
    """Diameter of the pupil image; None: ``n_subapertures``."""

    input: Literal["slopes", "frames"] = "slopes"
    """What the RTC sends."""

    pupil_centres_px: Annotated[Centres | None, BeforeValidator(_centres)] = None
    """Of the four pupil images, row and column; "auto": from a flux frame. Frames only."""

    pixels_per_subaperture: Count = 1
    """Frames only."""


class MirrorTable(Table):
    """``[mirror]``: analytic (``layout``) or measured (``modes``, ``influence_functions``)."""

    layout: Literal["rings", "grid", "positions"] | None = None
    """How the actuators of an analytic mirror are placed."""

    pitch_m: Positive | None = None
    """Distance between neighbours, metres; None: 0.30 for rings, measured for positions."""

    first_ring: Count = 2
    """Rings only."""

    last_ring: Annotated[int, Field(ge=1, le=500)] = 14
    """Rings only."""

    n_across: Annotated[int, Field(ge=2, le=1000)] | None = None
    """Grid only: actuators along a diameter."""

    diameter_m: Positive | None = None
    """Grid only: actuators beyond this circle do not exist."""

    positions: str | None = None
    """Positions only: ``path:/dataset`` of ``(n_actuators, 2)``, x and y in metres."""

    influence: Named[Influence] = Influence.THIN_PLATE
    """Shape of an influence function."""

    coupling: float = Field(default=0.35, gt=0.0, lt=1.0)
    """Gaussian only: height at the neighbour."""

    mode_to_actuator: str | None = None
    """``path:/dataset`` of the user's modes, ``(n_actuators, n_modes)``."""

    basis: Named[BasisKind] = BasisKind.KARHUNEN_LOEVE
    """Modes of an analytic mirror without ``mode_to_actuator``."""

    nominal_rotation_deg: float | None = None
    """Where a fit starts; None: found from tip and tilt."""

    parity: Sign | None = None
    """-1: the mirror is seen from behind; None: found from tip and tilt."""

    stroke: Literal["known", "unknown"] = "known"
    """"unknown": only shapes are compared."""

    modes: str | None = None
    """``path:/dataset`` of measured modes, ``(n_modes, ny, nx)``."""

    modes_pitch_m: Positive | None = None
    """Grid step of the measured modes."""

    modes_kind: Literal["opd", "surface"] = "opd"
    """What the user's own modes are heights of."""

    influence_functions: str | None = None
    """``path:/dataset`` of measured influence functions, ``(n_actuators, ny, nx)``."""


class ModesTable(Table):
    """``[modes]``: the Karhunen-Loeve basis of an analytic mirror."""

    n_modes: Count = 594
    """Modes of the basis."""

    r0_m: Positive = 0.10
    """Fried parameter at 500 nm, metres."""

    outer_scale_m: Positive = 25.0
    """Outer scale, metres."""


class OrientationTable(Table):
    """``orientation``: how the RTC's slopes map to the conventions' axes."""

    swap_xy: bool = False
    flip_x: bool = False
    flip_y: bool = False
    sign: Annotated[tuple[int, int], BeforeValidator(_signs)] = (1, 1)
    """Of both components on the RTC's own grid, or of Sx and Sy each."""


class SlopesTable(Table):
    """``[slopes]``: the RTC's own signals: kind, order, sign and recipe."""

    kind: Named[SignalKind] = SignalKind.XY
    """Two slopes for each subaperture, or its four normalised pixels."""

    order: Named[SlopeOrder] | None = None
    """`xy`, `yx`, `interleaved` of slopes, the others of pixels; None: `xy`, or `images`."""

    orientation: Annotated[OrientationTable | None, BeforeValidator(_auto_is_none)] = None
    normalisation: Named[Normalisation] = Normalisation.GLOBAL
    """By the mean flux of a subaperture, or by each one's own: of its four pixels together."""


class LoopTable(Table):
    """``[loop]``: what the RTC's status would say."""

    frame_rate_hz: Positive | None = None
    delay_frames: Annotated[float, Field(ge=1.0)] | None = None
    n_controlled: Count | None = None


class InstrumentFile(Table):
    """The whole file."""

    instrument: AboutTable
    wfs: WfsTable
    mirror: MirrorTable
    modes: ModesTable = Field(default_factory=ModesTable)
    slopes: SlopesTable = Field(default_factory=SlopesTable)
    loop: LoopTable = Field(default_factory=LoopTable)


def read_instrument_file(name_or_path: str | Path) -> tuple[InstrumentFile, Path]:
    """Return what the file of a packaged instrument or of a user's own says, and where it is.

    Raises
    ------
    ConfigurationError
        If there is no such file, or one line with the key that cannot be used.
    """
    path = instrument_path(name_or_path)
    return validated(InstrumentFile, read_toml(path), in_file(path)), path
