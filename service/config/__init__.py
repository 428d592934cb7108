"""What the user decides: the service's settings and the description of the instrument.

Both are TOML, read strictly: an unknown key, a wrong type or a number out of range is one
``ConfigurationError`` of one line that names the file and the key.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.config.instrument import load_instrument, packaged_instrument
    from service.config.settings import Settings, load_settings

__all__ = ["Settings", "load_instrument", "load_settings", "packaged_instrument"]


def __getattr__(name: str) -> object:
    """Import what is asked for: settings need none of the mathematics of an instrument."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "settings" if name in {"Settings", "load_settings"} else "instrument"
    return getattr(import_module(f"{__name__}.{module}"), name)
