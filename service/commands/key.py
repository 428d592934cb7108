"""``pyrcal key``: make, list and revoke the keys of those who may ask a service."""

from __future__ import annotations

import argparse
import os
import tomllib
from datetime import UTC, datetime
from pathlib import Path

from service.commands.terminal import say
from service.errors import ConfigurationError
from service.keys import KeyFile, KeyScope

DONE = 0

DATA_DIR = "var"
"""The settings' own default; reading all of them would take three times as long."""

_WITHOUT = {
    False: "on loopback none is needed: pyrcal key add NAME makes one",
    True: "nobody may ask: pyrcal key add makes one, without the file loopback needs none",
}
"""What that means, by whether there is a file."""


def main(options: argparse.Namespace) -> int:
    """Do what is asked with the file of keys; return the exit status.

    Raises
    ------
    ConfigurationError, UnknownIdError
        If it cannot be done; nothing is changed then.
    """
    file = KeyFile(data_dir(options))
    if options.action == "add":
        secret = file.add(options.name, KeyScope(options.scope))
        say(f"{file.path}: {options.name} may {options.scope}; this is the key, shown only now:")
        print(secret)
    elif options.action == "revoke":
        file.revoke(options.name)
        say(f"{file.path}: the key of {options.name} is worthless from now on")
    else:
        keys = file.all()
        for key in keys:
            made = datetime.fromtimestamp(key.created_ns_utc / 1e9, UTC)
            print(f"{key.name:24} {key.scope:8} made {made:%Y-%m-%dT%H:%M:%SZ}")
        if not keys:
            say(f"{file.path}: no keys; {_WITHOUT[file.path.exists()]}")
    return DONE


def data_dir(options: argparse.Namespace) -> Path:
    """Return where the service keeps its keys: command line > environment > TOML file > default.

    Raises
    ------
    ConfigurationError
        If the file cannot be read.
    """
    given = options.data_dir or os.environ.get("PYRCAL_SERVICE__DATA_DIR")
    if given is None and options.config is not None:
        try:
            settings = tomllib.loads(options.config.read_text(encoding="utf-8"))
            given = settings.get("service", {}).get("data_dir")
        except (OSError, ValueError, AttributeError) as error:
            raise ConfigurationError(f"{options.config}: cannot be read: {error}") from error
    return Path(given or DATA_DIR)
