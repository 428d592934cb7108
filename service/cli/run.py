"""``pyrcal run``: read and check the settings, then start."""

from __future__ import annotations

import argparse
import os
from functools import partial

from service.config import Settings, load_settings
from service.errors import ConfigurationError
from service.web.keys import KeyFile, KeyScope, is_loopback

_OPTIONS = {
    "instrument": "service.instrument",
    "mode": "service.mode",
    "data_dir": "service.data_dir",
    "listen": "zenoh.listen",
    "connect": "zenoh.connect",
    "host": "api.host",
    "port": "api.port",
    "log_format": "service.log_format",
}
"""Command-line options that stand for a settings key."""


def main(options: argparse.Namespace) -> int:
    """Run the service until it is asked to stop; return the exit status."""
    given = {
        key: getattr(options, option)
        for option, key in _OPTIONS.items()
        if getattr(options, option) is not None
    }
    for key in ("zenoh.listen", "zenoh.connect"):
        if key in given:
            given[key] = [given[key]]
    settings = load_settings(options.config, os.environ, given)
    from service.config.instrument_schema import read_instrument_file

    read_instrument_file(settings.service.instrument)
    _check_keys(settings)
    # from here on each import takes its time: the worker's first, so that it imports beside them
    from service.runtime.processes import Worker

    early = Worker().begin() if options.own_process else Worker()
    from service.config import load_instrument
    from service.config.policy import compute_of
    from service.runtime.worker import start_worker

    instrument, compute = load_instrument(settings.service.instrument), compute_of(settings)
    start_worker(instrument, compute, early)
    from service.cli.serve import run
    from service.runtime.workers import WorkerPool

    workers = WorkerPool(partial(start_worker, instrument, compute), early)
    return run(settings, instrument, workers)


def _check_keys(settings: Settings) -> None:
    """Refuse to serve other machines before there is a key to give orders with.

    Raises
    ------
    ConfigurationError
        If it would be, or the keys there are cannot be read.
    """
    host, keys = settings.api.host, KeyFile(settings.service.data_dir)
    can_operate = any(key.scope.covers(KeyScope.OPERATE) for key in keys.all())
    if not can_operate and not is_loopback(host):
        raise ConfigurationError(
            f"api.host: found {host}, which other machines can reach, and in {keys.path} no key "
            f"of scope operate or admin; make one first: pyrcal key add NAME --scope operate "
            f"--data-dir {settings.service.data_dir}"
        )
