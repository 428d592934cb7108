"""``pyrcal key``: make, list and revoke API keys."""

from __future__ import annotations

import argparse
import getpass
import os
import time
import tomllib
from datetime import UTC, datetime
from pathlib import Path

from service.cli.running import data_dir_of_the_one
from service.errors import ArchiveError, ConfigurationError, say
from service.web.keys import KeyFile, KeyScope

DONE = 0

DATA_DIR = "var"
"""The settings' own default; reading all of them would take three times as long."""

_WITHOUT = {
    False: "on loopback none is needed: pyrcal key add NAME makes one",
    True: (
        "there is no key, so nobody may ask: pyrcal key add makes one; without the file this "
        "machine needs none"
    ),
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
        _recorded(file, "key.added", f"{options.name} may {options.scope}")
        say(f"{file.path}: {options.name} may {options.scope}; this is the key, shown only now:")
        print(secret)
    elif options.action == "revoke":
        file.revoke(options.name)
        _recorded(file, "key.revoked", options.name)
        say(f"{file.path}: the key of {options.name} is worthless from now on")
    else:
        keys = file.all()
        for key in keys:
            made = datetime.fromtimestamp(key.created_ns_utc / 1e9, UTC)
            print(f"{key.name:24} {key.scope:8} made {made:%Y-%m-%dT%H:%M:%SZ}")
        if not keys:
            say(f"{file.path}: no keys; {_WITHOUT[file.path.exists()]}")
    return DONE


def _recorded(file: KeyFile, name: str, text: str) -> None:
    """Write into the audit trail, beside a service that may be running, what was done.

    Before the first start of a service there is no trail. What the disk refuses is only said: what
    was done is done.
    """
    path = file.path.with_name("index.sqlite")
    if not path.is_file():
        return
    from service.archive.index import AuditEntry, Index

    index, now_ns = Index(path), time.time_ns()
    try:
        index.open()
        entry = AuditEntry(t_ns_utc=now_ns, who=_login(), name=name, text=text, channel="cli")
        index.record((), (entry,))
    except ArchiveError as error:
        say(f"pyrcal: the audit trail does not have it: {error}")
    finally:
        index.close()


def _login() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container may run under a number that has no name
        return ""


def data_dir(options: argparse.Namespace) -> Path:
    """Return where the service keeps its keys.

    Command line > environment > TOML file > the service of this user that runs > default.

    Raises
    ------
    ConfigurationError
        If the file cannot be read, or several services run and nobody says which is meant.
    """
    given = options.data_dir or os.environ.get("PYRCAL_SERVICE__DATA_DIR")
    if given is None and options.config is not None:
        try:
            settings = tomllib.loads(options.config.read_text(encoding="utf-8"))
            given = settings.get("service", {}).get("data_dir")
        except (OSError, ValueError, AttributeError) as error:
            raise ConfigurationError(f"{options.config}: cannot be read: {error}") from error
    return Path(given or data_dir_of_the_one() or DATA_DIR)
