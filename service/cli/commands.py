"""The service's own commands: ``run`` it; make, list and revoke a client's ``key``.

Heavy modules are imported after argument parsing, so that usage errors are instant.
"""

from __future__ import annotations

import argparse
import getpass
import os
import time
import tomllib
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from service.errors import ArchiveError, ConfigurationError, say
from service.instrument.paths import TWIN_LIVE_FILE
from service.program import data_dir_of_the_one
from service.web.keys import KeyFile, KeyScope

if TYPE_CHECKING:
    from service.config import Settings

DONE = 0


def main(options: argparse.Namespace) -> int:
    """Do what a command line asks for; return the exit status.

    Raises
    ------
    PyrcalError
        If it cannot be done; nothing is changed then.
    """
    return (_run if options.command == "run" else _key)(options)


# --- run


_OPTIONS = {
    "instrument": "service.instrument",
    "mode": "service.mode",
    "data_dir": "service.data_dir",
    "listen": "zenoh.listen",
    "connect": "zenoh.connect",
    "host": "api.host",
    "port": "api.port",
    "cluster": "compute.cluster",
    "log_format": "service.log_format",
}
"""Command-line options that set a settings key."""


def _run(options: argparse.Namespace) -> int:
    """Run the service until it is asked to stop; return the exit status."""
    from service.config import load_settings

    given = {
        key: getattr(options, option)
        for option, key in _OPTIONS.items()
        if getattr(options, option) is not None
    }
    for key in ("zenoh.listen", "zenoh.connect"):
        if key in given:
            given[key] = [given[key]]
    # The RTC of a bench sends slopes, although its matrix may have been measured as frames.
    named = given.get("service.instrument")
    if named is not None and (live := Path(named) / TWIN_LIVE_FILE).is_file():
        given["service.instrument"] = str(live)
    settings = load_settings(options.config, os.environ, given)
    from service.instrument.schema import read_instrument_file

    read_instrument_file(settings.service.instrument)
    _check_that_a_key_can_operate(settings)
    # from here on each import takes its time: the worker comes first and imports in parallel
    from service.runtime.processes import Worker

    early = Worker("service.runtime.worker")
    if options.own_process:
        early.begin()
    from service.instrument import load_instrument
    from service.runtime.policy import compute_of
    from service.runtime.worker import start_worker

    instrument, compute = load_instrument(settings.service.instrument), compute_of(settings)
    start_worker(instrument, compute, early)
    from service.cli.serve import run
    from service.runtime.workers import WorkerPool

    workers = WorkerPool(partial(start_worker, instrument, compute), early)
    return run(settings, instrument, workers)


def _check_that_a_key_can_operate(settings: Settings) -> None:
    """Refuse to serve other machines before there is a key to give orders with.

    Raises
    ------
    ConfigurationError
        If it would be, or the keys there are cannot be read.
    """
    from service.wire.access import is_loopback  # with NumPy, which `key` does not need

    host, keys = settings.api.host, KeyFile(settings.service.data_dir)
    can_operate = any(key.scope.covers(KeyScope.OPERATE) for key in keys.all())
    if not can_operate and not is_loopback(host):
        raise ConfigurationError(
            f"api.host: found {host}, which other machines can reach, and in {keys.path} no key "
            f"of scope operate or admin; make one first: pyrcal key add NAME --scope operate "
            f"--data-dir {settings.service.data_dir}"
        )


# --- key


DATA_DIR = "var"
"""The settings' own default; reading all of them would take three times as long."""

_WITHOUT = {
    False: "clients on this machine need none; pyrcal key add NAME makes one",
    True: (
        "the file has no key, so every request is refused: make one with pyrcal key add NAME, or "
        "remove the file to admit clients on this machine without a key"
    ),
}
"""Meaning of a missing option, with and without a file."""


def _key(options: argparse.Namespace) -> int:
    """Do what is asked with the file of keys; return the exit status.

    Raises
    ------
    ConfigurationError, UnknownIdError
        If it cannot be done; nothing is changed then.
    """
    file = KeyFile(data_dir(options))
    if options.action == "add":
        secret = file.add(options.name, KeyScope(options.scope))
        _record_in_audit_trail(file, "key.added", f"{options.name} may {options.scope}")
        say(f"{file.path}: {options.name} may {options.scope}; this is the key, shown only now:")
        print(secret)
    elif options.action == "revoke":
        file.revoke(options.name)
        _record_in_audit_trail(file, "key.revoked", options.name)
        say(f"{file.path}: the key of {options.name} is revoked")
    else:
        keys = file.all()
        for key in keys:
            made = datetime.fromtimestamp(key.created_ns_utc / 1e9, UTC)
            print(f"{key.name:24} {key.scope:8} made {made:%Y-%m-%dT%H:%M:%SZ}")
        if not keys:
            say(f"{file.path}: no keys; {_WITHOUT[file.path.exists()]}")
    return DONE


def _record_in_audit_trail(file: KeyFile, name: str, text: str) -> None:
    """Record in the audit trail what was done, while a service may be running.

    Before the first start of a service there is no trail. If the disk refuses, the command says so
    and stays done.
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
    """Return the directory in which the service keeps its keys.

    Command line > environment > TOML file > the running service of this user > default.

    Raises
    ------
    ConfigurationError
        If the file cannot be read, or several services run and no option selects one.
    """
    given = options.data_dir or os.environ.get("PYRCAL_SERVICE__DATA_DIR")
    if given is None and options.config is not None:
        try:
            settings = tomllib.loads(options.config.read_text(encoding="utf-8"))
            given = settings.get("service", {}).get("data_dir")
        except (OSError, ValueError, AttributeError, RecursionError) as error:
            raise ConfigurationError(f"{options.config}: cannot be read: {error}") from error
    return Path(given or data_dir_of_the_one() or DATA_DIR)
