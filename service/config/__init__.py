"""What the user decides: the service's settings and the description of the instrument.

Both are TOML, read strictly: an unknown key, a wrong type or a number out of range is one
``ConfigurationError`` of one line that names the file and the key.
"""

from service.config.instrument import load_instrument, packaged_instrument
from service.config.settings import Settings, load_settings

__all__ = ["Settings", "load_instrument", "load_settings", "packaged_instrument"]
