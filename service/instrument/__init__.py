"""The instrument file: its schema, its reading, and the files of known instruments.

An instrument file is TOML, read strictly: an unknown key, a wrong type or a number out of range is
one ``ConfigurationError`` of one line that names the file and the key.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from service.instrument.paths import instrument_path, packaged_file

if TYPE_CHECKING:
    from service.instrument.reader import load_instrument, packaged_instrument

_OF_READER = {"load_instrument", "packaged_instrument"}

__all__ = ["instrument_path", "load_instrument", "packaged_file", "packaged_instrument"]


def __getattr__(name: str) -> object:
    """Import a name when it is first used: a path needs no mathematics of an instrument."""
    if name not in _OF_READER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.reader"), name)
