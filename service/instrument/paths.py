"""Paths of instrument files, packaged ones included; quick to import."""

from __future__ import annotations

from pathlib import Path

from service.errors import ConfigurationError

_PACKAGED = Path(__file__).parent / "packaged"

TWIN_FILE, TWIN_LIVE_FILE = "instrument.toml", "live.toml"
TWIN_MATRIX, TWIN_FIT = "matrix.h5", "fit.h5"
"""Files of a folder that ``pyrcal twin`` wrote: instrument, instrument of an RTC that sends slopes,
matrix, and its fit."""


def instrument_path(name_or_path: str | Path) -> Path:
    """Return the file of a packaged instrument or of a twin's folder, or the path as it is.

    Raises
    ------
    ConfigurationError
        If it is a name, and no packaged one.
    """
    name, _ = and_sensor_mode(name_or_path)
    path = Path(name)
    if (path / TWIN_FILE).is_file():
        return path / TWIN_FILE
    is_name = path.suffix != ".toml" and path.name == name
    return packaged_file(path.name) if is_name else path


def and_sensor_mode(name_or_path: str | Path) -> tuple[str, str | None]:
    """Return an instrument's name or path, and the mode of its sensor behind an ``@``, or None."""
    name, at, mode = str(name_or_path).rpartition("@")
    if not at or Path(name_or_path).exists():
        return str(name_or_path), None
    return name, mode


def packaged_file(name: str) -> Path:
    """Return where the file of a packaged instrument is.

    Raises
    ------
    ConfigurationError
        If none has this name.
    """
    known = {path.stem: path for path in _PACKAGED.glob("*.toml")}
    if name not in known:
        raise ConfigurationError(
            f"instrument {name}: neither a packaged name ({', '.join(sorted(known))}) "
            "nor the path of a .toml file"
        )
    return known[name]
