"""Every key of an instrument file: type, range, default."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, Literal, NoReturn, TypeVar

from pydantic import BeforeValidator, Field, PlainValidator, create_model

from service.errors import ConfigurationError, ModelError
from service.files.toml import Id, Table, in_file, read_dataset, read_toml, refuse, validated
from service.instrument.paths import instrument_path
from service.model import kinds
from service.model.kinds import Read
from service.model.pointing_law import ANGLES, PointingLaw, Term
from service.model.sensors.kind import SensorKind
from service.model.sensors.registry import KINDS

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MISSPELT_SIMILARITY = 0.75
"""Similarity above which a name is taken for a misspelt angle, and not for a value of the
observatory."""

_FORM = '{ of = "elevation", at = [20, 80], values = [0.1, -0.1] }'


NORTH_STEP_SUBAP = 0.02
"""Largest change of a law after a whole turn of azimuth: a tenth of what a matrix bears."""

NORTH_STEP_DEG = 0.05
NORTH_STEP_MAGNIFICATION = 0.001


def _term(value: object, *, north_step: float, turn: float = 0.0) -> Term:
    """Return a term as a file has it: a number, an expression or a table.

    It may differ by ``north_step`` after a whole turn of azimuth, or by a multiple of ``turn``.
    """
    try:
        term = _convert_term(value)
        step = term.north_step()
    except ModelError as error:
        raise ValueError(str(error)) from error
    # A rotation that grows by whole turns with azimuth comes back to the same angle.
    left = math.remainder(step, turn) if turn else step
    if abs(left) > north_step:
        raise ValueError(
            f"found a law that is {step:.4g} more after a whole turn of azimuth: it would leap at "
            f"north; expected the same, to {north_step:g}, as of sin(azimuth) or of a table whose "
            "first and last values agree"
        )
    return term


def _convert_term(value: object) -> Term:
    match value:
        # Before int(): a bool of Python is an int.
        case bool():
            raise ModelError(f"found {value}, expected a number, an expression or {_FORM}")
        # repr() keeps all digits of a float.
        case int() | float():
            return Term(repr(float(value)))
        case str():
            term = Term(value)
        case {"of": str(of), "at": [*at], "values": [*values], **more} if more.keys() <= {"period"}:
            if not all(type(each) in {int, float} for each in (*at, *values, *more.values())):
                raise ModelError(f"found {value}, expected numbers in at, values and period")
            period: Any = more.get("period")
            term = Term(of, tuple(map(float, at)), tuple(map(float, values)), period)
        case _:
            raise ModelError(f"found {value!r}, expected a number, an expression or {_FORM}")
    for name in sorted(term.names - set(ANGLES)):
        close = difflib.get_close_matches(name, ANGLES, n=1, cutoff=_MISSPELT_SIMILARITY)
        if close:
            raise ModelError(f"found {name}, did you mean {close[0]}?")
    return term


_INPUT = float | str | dict[str, Any]


def _term_of(north_step: float, turn: float = 0.0) -> PlainValidator:
    """Return how a term is read; see ``_term`` for the numbers."""
    read = partial(_term, north_step=north_step, turn=turn)
    return PlainValidator(read, json_schema_input_type=_INPUT)


_Shift = Annotated[Term | None, _term_of(NORTH_STEP_SUBAP)]
_Rotation = Annotated[Term | None, _term_of(NORTH_STEP_DEG, turn=360.0)]
_Magnification = Annotated[Term | None, _term_of(NORTH_STEP_MAGNIFICATION)]


@dataclass(frozen=True, slots=True, kw_only=True)
class LawTable(Read):
    """``[law]``: the nominal registration as a function of the pointing.

    α is tracked as the deviation from it. Each parameter is a number, an expression of `azimuth`
    and `elevation` (degrees) and of names of the observatory's values, or a table `{ of =
    "elevation", at = [20, 80], values = [0.1, -0.1] }` with linear interpolation; `period = 360`
    next to `at` makes the table repeat itself, as that of a derotator's angle must. A whole turn of
    azimuth must not change it, except by whole turns of the rotation.
    """

    shift_x_subap: _Shift = None
    """None: 0."""

    shift_y_subap: _Shift = None
    """None: 0."""

    rotation_deg: _Rotation = None
    """Such as `azimuth - 12.98`; None: 0."""

    magnification: _Magnification = None
    """None: 1."""


def remarks_on_law(file: Section[LawTable]) -> tuple[str, ...]:
    """Return a remark on each table whose ends are the same place and do not agree."""
    largest = (NORTH_STEP_SUBAP, NORTH_STEP_SUBAP, NORTH_STEP_DEG, NORTH_STEP_MAGNIFICATION)
    terms = [(field.name, getattr(file.table, field.name)) for field in fields(LawTable)]
    return tuple(
        f"{file.where(name)}: the table ends with {term.values[-1]:g} and begins with "
        f"{term.values[0]:g}, a whole turn of {term.expression} apart: when it returns, α becomes "
        "predicted, and no reconstructor is made until a window has confirmed it; give both ends "
        f"the same value{'' if term.period else ', and period = 360 if it is an angle'}"
        for (name, term), step in zip(terms, largest, strict=True)
        # A rotation by whole turns is none.
        if term is not None and abs(math.remainder(term.closing_step, 360.0)) > step
    )


def law_of(table: LawTable) -> PointingLaw | None:
    """Return the law; None: the file has none."""
    terms = {field.name: getattr(table, field.name) for field in fields(table)}
    return PointingLaw(**terms) if any(terms.values()) else None


Sign = Literal[-1, 1]

Stretch = Annotated[float, Field(ge=-0.2, le=0.2)]
"""Beyond a fifth the image is another one, and no fit leads there."""


def _auto_is_none(value: object) -> object:
    return None if value == "auto" else value


def _signs(value: object) -> object:
    pair = value if isinstance(value, list) else [value, value]
    if len(pair) != 2 or not all(type(sign) is int and abs(sign) == 1 for sign in pair):
        raise ValueError(f"found {value!r}, expected 1, -1 or two of them: [sign_x, sign_y]")
    return tuple(pair)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AboutTable(kinds.Telescope):
    """``[instrument]``: the telescope."""

    name: Id
    basis_id: Id | None = None
    """Required basis of the RTC; None: the first one is adopted."""

    config_id: Id | None = None
    """Required sensor configuration; None: the first one is adopted."""

    pupil: str | None = None
    """Map of the pupil, ``path:/dataset``, ``path.fits`` or ``path.npy`` of ``(ny, nx)``:
    transmission, centred, in the mirror's plane; None: a ring."""

    pupil_pitch_m: kinds.Positive | None = None
    """Step of that map; None: ``diameter_m`` over its points."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorTable(kinds.InfluenceShape):
    """``[mirror]``: analytic (``layout``) or measured (``modes``, ``influence_functions``)."""

    layout: Literal["rings", "grid", "hexagonal", "positions"] | None = None
    """Actuators of an analytic mirror."""

    pitch_m: kinds.Positive | None = None
    """Distance of neighbours; None: 0.30 for rings, measured for positions. Hexagonal rows are
    along +x, with one actuator in the middle."""

    first_ring: kinds.Count = 2
    """Rings only."""

    last_ring: Annotated[int, Field(ge=1, le=500)] = 14
    """Rings only."""

    ring_actuators: tuple[kinds.Count, ...] | None = None
    """Rings only, instead of ``first_ring`` and ``last_ring``: actuators on each ring, from the
    inside, the first on +x."""

    ring_radii_m: tuple[kinds.Positive, ...] | None = None
    """Radius of each of these rings."""

    n_across: Annotated[int, Field(ge=2, le=1000)] | None = None
    """Grid only: actuators along a diameter."""

    diameter_m: kinds.Positive | None = None
    """Grid and hexagonal: diameter of the circle that contains all actuators."""

    hole_m: kinds.Positive | None = None
    """Hexagonal only: diameter of the middle without actuators."""

    position_error_pitch: Annotated[float, Field(ge=0.0, le=0.2)] | None = None
    """RMS error of actuator positions along each axis, in pitches, that is part of σ of a fit;
    None: 0.02."""

    segments_deg: tuple[float, ...] = ()
    """Gaussian influence only: direction of each gap between segments outwards, from +x towards +y.
    No influence function crosses a gap, no actuator of a grid is on one, and KL modes contain no
    differential piston."""

    positions: str | None = None
    """Positions only: ``path:/dataset`` of ``(n_actuators, 2)``, x and y, metres."""

    mode_to_actuator: str | None = None
    """``path:/dataset`` of your own modes, ``(n_actuators, n_modes)``."""

    basis: kinds.BasisKind = kinds.BasisKind.KARHUNEN_LOEVE
    """Modes of an analytic mirror without ``mode_to_actuator``."""

    nominal_rotation_deg: float | None = None
    """Rotation at which a fit starts; None: found from tip and tilt."""

    nominal_anamorphosis: tuple[Stretch, Stretch] | None = None
    """Anamorphosis (a0, a45) at which a fit starts; None: 0."""

    parity: Sign | None = None
    """-1: mirrored image; None: found from tip and tilt."""

    stroke: Literal["known", "unknown"] = "known"
    """unknown: only shapes are compared."""

    modes: str | None = None
    """``path:/dataset`` of measured modes, ``(n_modes, ny, nx)``."""

    modes_pitch_m: kinds.Positive | None = None
    """Grid step of the measured modes."""

    modes_kind: Literal["opd", "surface"] = "opd"
    """Quantity of your own modes."""

    influence_functions: str | None = None
    """``path:/dataset`` of measured influence functions, ``(n_actuators, ny, nx)``, or cropped, as
    an ELT needs. From 200 on, values below a millionth of the peak are dropped."""

    influence_origin: str | None = None
    """Cropped functions only: ``path:/dataset`` of ``(n_actuators, 2)``, first row and column of
    each in the whole table, which is 0 elsewhere."""

    influence_table: tuple[kinds.Count, kinds.Count] | None = None
    """Cropped functions only: rows and columns of the whole table, centred on the pupil."""


class OrientationTable(Table):
    """``orientation``: how the RTC's slopes map to the conventions' axes."""

    swap_xy: bool = False
    flip_x: bool = False
    flip_y: bool = False
    sign: Annotated[tuple[int, int], BeforeValidator(_signs)] = (1, 1)
    """Sign of both components on the RTC's own grid, or of Sx and Sy each."""


class SlopesTable(Table):
    """``[slopes]``: signals of the RTC."""

    kind: kinds.SignalKind = kinds.SignalKind.XY
    """Two slopes of each subaperture, or its four normalised pixels."""

    order: kinds.SlopeOrder | None = None
    """`xy`, `yx`, `interleaved`: of slopes; others: of pixels; None: `xy`, or `images`."""

    orientation: Annotated[OrientationTable | None, BeforeValidator(_auto_is_none)] = None
    normalisation: kinds.Normalisation = kinds.Normalisation.GLOBAL
    """Normalisation by the mean flux of all subapertures, or by that of each one."""


@cache
def whole_of(kind: SensorKind) -> type[Table]:
    """Return what a file with this kind of sensor is read into, table by table."""
    tables: dict[str, Any] = {
        "instrument": AboutTable,
        "wfs": kind.table,
        "mirror": MirrorTable,
        "law": (LawTable, Field(default_factory=LawTable)),
        "modes": (kinds.KarhunenLoeve, Field(default_factory=kinds.KarhunenLoeve)),
        "slopes": (SlopesTable, Field(default_factory=SlopesTable)),
        "loop": (kinds.LoopFacts, Field(default_factory=kinds.LoopFacts)),
    }
    return create_model("InstrumentFile", __base__=Table, **tables)


def unknown_values(kind: SensorKind) -> dict[str, float | None]:
    """Return keys that may be "unknown", each with the value assumed until it is determined."""
    of_sensor = {f"wfs.{key}": value for key, value in kind.unknown.items()}
    return {**of_sensor, "mirror.coupling": 0.35}


ReadTable = TypeVar("ReadTable")


@dataclass(frozen=True, slots=True)
class Section(Generic[ReadTable]):
    """A table of a file, as it is read and as it is written."""

    table: ReadTable
    given: frozenset[str]
    """Keys that are written."""

    path: Path
    """Path of the file; references are relative to its folder."""

    name: str

    def where(self, key: str) -> str:
        """Return the file and key, for messages."""
        return f"{self.path}: {self.name}.{key}"

    def refuse(self, key: str, found: str, expected: str) -> NoReturn:
        """Refuse the value of a key that the schema alone cannot judge."""
        refuse(self.where(key), found, expected)

    def refuse_useless(self, keys: Iterable[str], context: str) -> None:
        """Refuse each of these keys if it is given, because another setting makes it useless."""
        for key in sorted(self.given.intersection(keys)):
            raise ConfigurationError(f"{self.where(key)}: has no effect {context}; remove it")

    def array(self, key: str) -> NDArray[Any]:
        """Return the array that a key refers to."""
        return read_dataset(getattr(self.table, key), self.path.parent, self.where(key))


@dataclass(frozen=True, slots=True)
class InstrumentFile:
    """An instrument file by its tables."""

    sections: tuple[Section[Any], ...]
    kind: SensorKind
    """Kind of its sensor."""

    unknown: frozenset[str] = frozenset()
    """Keys, with their tables, that the file states as unknown."""

    def section(self, kind: type[ReadTable]) -> Section[ReadTable]:
        """Return the table that is read into this."""
        return next(section for section in self.sections if isinstance(section.table, kind))


def read_instrument_file(name_or_path: str | Path) -> InstrumentFile:
    """Return what the file of a packaged instrument or of a user's own says.

    Raises
    ------
    ConfigurationError
        If there is no such file, or one line with the key that cannot be used.
    """
    path = instrument_path(name_or_path)
    written = read_toml(path)
    kind = _kind(written, path)
    _check_one_sensor(written, kind, path)
    taken = unknown_values(kind)
    unknown = frozenset(key for key in taken if _value(written, key) == "unknown")
    # The schema knows numbers only: a value that is called unknown begins at its default.
    tables = dict(written)
    for key in unknown:
        table, name = key.split(".")
        # "unknown" is replaced before the schema is applied, whose types are numbers.
        tables[table] = {**tables[table], name: taken[key]}
    if isinstance(tables.get("wfs"), dict):
        with refused_at(path, "wfs"):
            tables["wfs"] = kind.as_read(tables["wfs"])
    whole = whole_of(kind)
    parsed = validated(whole, tables, in_file(path))
    return InstrumentFile(
        tuple(
            Section(getattr(parsed, name), frozenset(written.get(name, ())), path, name)
            for name in whole.model_fields
        ),
        kind,
        unknown,
    )


def _kind(written: Mapping[str, Any], path: Path) -> SensorKind:
    """Return the kind of sensor a file is about; the first one where it does not say."""
    name = _value(written, "wfs.kind")
    if name is None:
        return next(iter(KINDS.values()))
    if not isinstance(name, str) or name not in KINDS:
        refuse(f"{path}: wfs.kind", repr(name), " or ".join(repr(known) for known in KINDS))
    return KINDS[name]


def _check_one_sensor(written: Mapping[str, Any], kind: SensorKind, path: Path) -> None:
    """Refuse a file of several sensors, or with keys of two kinds of them."""
    wfs = written.get("wfs", {})
    if isinstance(wfs, list):
        refuse(
            f"{path}: wfs",
            f"{len(wfs)} tables [[wfs]]",
            "one table [wfs]: a service has one sensor, the next one a file and service of its own",
        )
    if not isinstance(wfs, dict):
        return  # refused with the other tables
    # A key of another kind is a file for two sensors, or a forgotten kind: both get their own
    # words.
    known = {name: {field.name for field in fields(one.table)} for name, one in KINDS.items()}
    for key in sorted(set(wfs) - known[kind.name]):
        others = [f'"{name}"' for name, keys in known.items() if key in keys]
        if others:
            found = f'kind = "{kind.name}"' if "kind" in wfs else "no kind"
            raise ConfigurationError(
                f"{path}: wfs.{key}: belongs to kind = {' or '.join(others)}, found {found}: leave "
                "it out, or give the other sensor a file of its own"
            )


@contextmanager
def refused_at(path: Path, table: str) -> Iterator[None]:
    """Add the place in a file to what a kind of sensor rejects."""
    try:
        yield
    except ModelError as error:
        raise ConfigurationError(f"{path}: {table}.{error}") from error


def _value(written: Mapping[str, Any], key: str) -> object:
    """Return what is written under a key of a table; None: nothing."""
    table, name = key.split(".")
    found = written.get(table)
    return found.get(name) if isinstance(found, dict) else None
