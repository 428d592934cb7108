"""Read a system file: sensors with their stars, mirrors with their altitudes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pyrcal.fitting.guide_star import GuideStar, Similarity
from pyrcal.fitting.system import ARCSEC_RAD, PlacedMirror, PlacedSensor, System
from service.errors import ConfigurationError, ModelError
from service.files.toml import Id, Table, in_file, read_toml, refuse, validated
from service.instrument import load_instrument
from service.model.instrument import Instrument, Mirror
from service.model.kinds import BasisKind, Positive, Stop

SAME_DIAMETER = 1e-6

MAX_STAR_ARCSEC = 1800.0
"""Largest distance of a guide star from the axis; a larger one is in milliarcseconds."""

MIN_STAR_ARCSEC = 0.01
"""Smallest distance of a guide star that is not on the axis; a smaller one is in radians: 0.01 rad
are 2000 arcseconds."""

StarHeight = Annotated[float, Field(gt=0.0, le=1e7)]
"""Height of a laser star, metres. They are below 1e6; a larger one is at infinity, or in mm."""

ShiftSubap = Annotated[float, Field(ge=-1e3, le=1e3)]
"""Shift of the pupil on a sensor, subapertures; sensors have fewer than 1000 across."""


class PlaceTable(Table):
    """Keys common to sensors and mirrors: a name, an instrument file, a nominal position."""

    name: Id
    """Name in results and in the names of matrices."""

    instrument: str | None = None
    """Instrument file, relative to this one, or packaged name; None: that of ``[system]``."""

    rotation_deg: float | None = None
    """Nominal rotation; None: 0, or that of a mirror's instrument file."""

    magnification: Positive = 1.0
    """Nominal magnification."""

    fixed: bool = False
    """True if the nominal position is exact, as a reference for others."""


class SensorTable(PlaceTable):
    """``[[sensors]]``: one sensor and its star."""

    star_arcsec: tuple[float, float] = (0.0, 0.0)
    """Direction of its guide star, x and y in the pupil's axes."""

    star_height_m: StarHeight | Literal["infinity"] = "infinity"
    """Height of a laser star, along the line of sight."""

    shift_subap: tuple[ShiftSubap, ShiftSubap] = (0.0, 0.0)
    """Nominal position of the pupil's centre on the sensor's grid."""


class MirrorTable(PlaceTable):
    """``[[mirrors]]``: one mirror."""

    altitude_m: float = 0.0
    """Conjugate altitude along the line of sight."""

    shift_m: tuple[float, float] = (0.0, 0.0)
    """Nominal position of the mirror's centre at its altitude."""


class AboutTable(Table):
    """``[system]``: keys common to all sensors and mirrors."""

    name: Id
    instrument: str | None = None
    """Instrument file of sensors and mirrors that name none."""

    stars: Literal["known", "direction", "direction and height"] = "known"
    """Properties of the stars that are fitted, too."""


class SystemFile(Table):
    """A whole system file."""

    system: AboutTable
    sensors: Annotated[tuple[SensorTable, ...], Field(min_length=1)]
    mirrors: Annotated[tuple[MirrorTable, ...], Field(min_length=1)]


def load_system(path: Path) -> System:
    """Return the system that a file describes.

    Raises
    ------
    ConfigurationError
        One line with the file and the key.
    """
    document = validated(SystemFile, read_toml(path), in_file(path))
    _check_names(path, (*document.sensors, *document.mirrors))
    known: dict[str, Instrument] = {}

    def instrument(table: PlaceTable, where: str) -> Instrument:
        named = table.instrument or document.system.instrument
        if named is None:
            raise ConfigurationError(
                f"{path}: {where}.instrument: missing, and system.instrument is, too"
            )
        if named not in known:
            is_file = named.endswith(".toml") or "/" in named
            known[named] = load_instrument(path.parent / named if is_file else named)
        return known[named]

    system = System(
        name=document.system.name,
        sensors=tuple(
            _sensor(table, instrument(table, f"sensors.{k}"))
            for k, table in enumerate(document.sensors)
        ),
        mirrors=tuple(
            _mirror(table, instrument(table, f"mirrors.{k}"))
            for k, table in enumerate(document.mirrors)
        ),
        stars_move=document.system.stars != "known",
        heights_move=document.system.stars == "direction and height",
    )
    _check_telescope(path, system)
    for number, table in enumerate(document.sensors):
        _check_star(f"{path}: sensors.{number}.star_arcsec", math.hypot(*table.star_arcsec))
    for number, mirror in enumerate(system.mirrors):
        _check_mirror(f"{path}: mirrors.{number}", mirror, system)
    return system


def _check_names(path: Path, tables: Sequence[PlaceTable]) -> None:
    names = [table.name for table in tables]
    for name in names:
        if names.count(name) > 1:
            refuse(f"{path}: name", f"{name!r} {names.count(name)} times", "each name once")


def _sensor(table: SensorTable, instrument: Instrument) -> PlacedSensor:
    height = table.star_height_m
    return PlacedSensor(
        name=table.name,
        instrument=instrument,
        star=GuideStar(
            direction_rad=complex(*table.star_arcsec) * ARCSEC_RAD,
            height_m=math.inf if isinstance(height, str) else height,
        ),
        place=_place(table, table.shift_subap, 0.0),
        fixed=table.fixed,
    )


def _check_star(where: str, off_axis_arcsec: float) -> None:
    """Raise if the size of a direction indicates radians or milliarcseconds."""
    if off_axis_arcsec > MAX_STAR_ARCSEC:
        refuse(
            where,
            f"a star {off_axis_arcsec:g} arcseconds off the axis, like milliarcseconds",
            f"arcseconds, at most {MAX_STAR_ARCSEC:g}",
        )
    if 0.0 < off_axis_arcsec < MIN_STAR_ARCSEC:
        refuse(
            where,
            f"a star {off_axis_arcsec:g} arcseconds off the axis, like radians "
            f"({off_axis_arcsec / ARCSEC_RAD:.3g} arcseconds)",
            "arcseconds, or 0 on the axis",
        )


def _mirror(table: MirrorTable, instrument: Instrument) -> PlacedMirror:
    nominal_rad = instrument.mirror.nominal_rotation_rad or 0.0
    return PlacedMirror(
        name=table.name,
        instrument=instrument,
        altitude_m=table.altitude_m,
        place=_place(table, table.shift_m, nominal_rad),
        fixed=table.fixed,
    )


def _place(table: PlaceTable, shift: tuple[float, float], nominal_rad: float) -> Similarity:
    degrees = table.rotation_deg
    angle_rad = nominal_rad if degrees is None else math.radians(degrees)
    turn = table.magnification * complex(np.exp(1j * angle_rad))
    return Similarity(turn=turn, shift=complex(*shift))


def _check_telescope(path: Path, system: System) -> None:
    """Raise if the instruments belong to different telescopes."""
    every: list[PlacedSensor | PlacedMirror] = [*system.sensors, *system.mirrors]
    first = every[0].instrument
    for one in every[1:]:
        other = one.instrument
        if abs(other.diameter_m / first.diameter_m - 1.0) > SAME_DIAMETER:
            found = f"diameter_m = {other.diameter_m:g} of {one.name}"
            refuse(f"{path}: instrument", found, f"{first.diameter_m:g}, as {every[0].name} has it")
        if other.stop is not first.stop:
            found = f'stop = "{other.stop}" of {one.name}'
            refuse(f"{path}: instrument", found, f'"{first.stop}", as {every[0].name} has it')


def _check_mirror(where: str, mirror: PlacedMirror, system: System) -> None:
    """Refuse a mirror that no star is above, or of which at its altitude too little is known."""
    for sensor in system.sensors:
        try:
            sensor.star.project_plane(mirror.altitude_m)
        except ModelError as error:
            raise ConfigurationError(f"{where}.altitude_m: {error} of {sensor.name}") from error
    about = mirror.instrument
    if mirror.altitude_m == 0.0:
        return
    found = f"{mirror.altitude_m:g}"
    if about.stop is Stop.MIRROR:
        refuse(f"{where}.altitude_m", found, f'0 where {about.name} says stop = "mirror"')
    own = about.mirror
    if not isinstance(own, Mirror):
        expected = "0 where mirror.modes or influence_functions are tables: name a layout"
        refuse(f"{where}.altitude_m", found, expected)
    if own.mode_to_actuator is None and own.basis is not BasisKind.ZONAL:
        expected = (
            '0, or mirror.basis = "zonal" or mode_to_actuator: its KL modes are those of the pupil'
        )
        refuse(f"{where}.altitude_m", found, expected)
