"""Settings of the service, and the tables on the link that other programs share.

They are TOML, read strictly: an unknown key, a wrong type or a number out of range is one
``ConfigurationError`` of one line that names the file and the key.
"""

from service.config.settings import Settings, load_settings

__all__ = ["Settings", "load_settings"]
