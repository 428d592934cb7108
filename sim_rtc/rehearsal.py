"""The instrument of a rehearsal, from the instrument file of a measured matrix.

The instrument file of a matrix may speak of detector frames, unknown strokes and single actuators.
The simulated RTC sends slopes and takes modal commands in metres, as every RTC does, and the
service needs an instrument file that says so.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeGuard

from service.errors import ConfigurationError
from service.files.toml import read_toml
from service.instrument import instrument_path, load_instrument
from service.model.instrument import Instrument, Mirror, TabulatedModes
from service.model.kinds import BasisKind

_OF_FRAMES = ("input", "pupil_centres_px", "pixels_per_subaperture")
"""Keys of ``[wfs]`` that describe detector frames."""


def with_modes(instrument: Instrument, n_modes: int | None) -> Instrument:
    """Return the instrument with modes in which a loop can be controlled.

    A basis of single actuators has no order, and the first ones of it are no basis of their own:
    Karhunen-Loeve modes take its place, ``n_modes`` of them or, if that is None, half as many as
    there are actuators.

    Raises
    ------
    ConfigurationError
        If ``n_modes`` is given for an instrument with modes of its own.
    """
    mirror = instrument.mirror
    if not _is_zonal(mirror):
        if n_modes is not None:
            raise ConfigurationError(
                f"--modes: {instrument.name} has {instrument.modes.n_modes} modes of its own; "
                'expected mirror.basis = "zonal"'
            )
        return instrument
    n_actuators = len(mirror.positions_m)
    n_modes = n_modes or n_actuators // 2
    if not 2 <= n_modes < n_actuators:
        raise ConfigurationError(
            f"--modes: found {n_modes}; expected 2 to {n_actuators - 1}: {instrument.name} has "
            f"{n_actuators} actuators"
        )
    return replace(
        instrument,
        mirror=replace(mirror, basis=BasisKind.KARHUNEN_LOEVE),
        modes=replace(instrument.modes, n_modes=n_modes),
    )


def _is_zonal(mirror: Mirror | TabulatedModes) -> TypeGuard[Mirror]:
    return (
        isinstance(mirror, Mirror)
        and mirror.mode_to_actuator is None
        and mirror.basis is BasisKind.ZONAL
    )


def write_live_instrument(instrument: str | Path, path: Path, n_modes: int | None = None) -> None:
    """Write an instrument file like another one, for an RTC that sends slopes.

    Files that it refers to are named by their absolute paths, so that it can be moved.
    ``n_modes`` is as in ``with_modes``.

    Raises
    ------
    ConfigurationError
        If the instrument file cannot be read, or the new one cannot be written.
    """
    given = instrument_path(instrument)
    described = load_instrument(given)
    controlled = with_modes(described, n_modes)
    tables = {name: dict(table) for name, table in read_toml(given).items()}
    pyramid = tables["wfs"].get("kind") == "pyramid"
    for key in _OF_FRAMES if pyramid else ():
        tables["wfs"].pop(key, None)
    tables["mirror"].pop("stroke", None)
    if controlled is not described:
        tables["mirror"].pop("basis")
        tables["modes"] = {**tables.get("modes", {}), "n_modes": controlled.modes.n_modes}
    about = f"# As {given.name}, for an RTC that sends slopes and takes commands in metres.\n"
    try:
        path.write_text(about + "\n".join(_lines(tables, given.parent)) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(
            f"--write-instrument: cannot write {path}: {error.strerror or error}"
        ) from error
    # Read back, so that a file that the service would refuse is reported now.
    load_instrument(path)


def _lines(tables: Mapping[str, Any], folder: Path, above: str = "") -> Iterator[str]:
    """Yield the lines of tables and of the tables inside them."""
    for name, table in tables.items():
        yield f"\n[{above}{name}]"
        inside = {key: value for key, value in table.items() if isinstance(value, Mapping)}
        lists = {key: value for key, value in table.items() if _is_list_of_tables(value)}
        for key, value in table.items():
            if key not in inside and key not in lists:
                yield f"{key} = {_format_value(value, folder)}"
        yield from _lines(inside, folder, f"{above}{name}.")
        for key, rows in lists.items():
            for row in rows:
                yield f"\n[[{above}{name}.{key}]]"
                yield from (
                    f"{each} = {_format_value(value, folder)}" for each, value in row.items()
                )


def _is_list_of_tables(value: object) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], Mapping)


def _format_value(value: object, folder: Path) -> str:
    """Return a value as TOML has it; a reference to a file by its absolute path."""
    if isinstance(value, Mapping):
        inside = (f"{key} = {_format_value(each, folder)}" for key, each in value.items())
        return "{ " + ", ".join(inside) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_format_value(each, folder) for each in value) + "]"
    if isinstance(value, str):
        name, colon, inside_file = value.partition(":/")
        file = folder / name
        referred = f"{file.resolve()}{colon}{inside_file}" if name and file.is_file() else value
        # A basic string of TOML has the escapes of JSON.
        return json.dumps(referred, ensure_ascii=False)
    # TOML writes true and false as JSON does; repr() of a float keeps all its digits.
    return json.dumps(value) if isinstance(value, bool) else repr(value)
