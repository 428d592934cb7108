"""Settings and instrument files.

Both are TOML, read strictly: an unknown key, a wrong type or a number out of range is one
``ConfigurationError`` of one line that names the file and the key.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from service.errors import ConfigurationError

if TYPE_CHECKING:
    from service.config.settings import Settings, load_settings
    from service.instrument.reader import load_instrument, packaged_instrument

__all__ = ["Settings", "load_instrument", "load_settings", "packaged_instrument"]


_PACKAGED = Path(__file__).parents[1] / "instruments"


def instrument_path(name_or_path: str | Path) -> Path:
    """Return the file of a packaged instrument, or the path as it is; nothing is read yet.

    Raises
    ------
    ConfigurationError
        If it is a name, and no packaged one.
    """
    name, _ = and_sensor_mode(name_or_path)
    path = Path(name)
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


def __getattr__(name: str) -> object:
    """Import a name when it is first used: settings need no mathematics of an instrument."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "settings" if name in {"Settings", "load_settings"} else "instrument"
    return getattr(import_module(f"{__name__}.{module}"), name)
