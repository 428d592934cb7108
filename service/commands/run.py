"""``pyrcal run``: what the user decides, read and checked before the service is put together."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
import sys
from typing import TextIO, cast

import structlog
from structlog.typing import EventDict
from threadpoolctl import threadpool_limits
from typing_extensions import override

from service.config import load_instrument, load_settings
from service.errors import shown

_OPTIONS = {
    "instrument": "service.instrument",
    "mode": "service.mode",
    "data_dir": "service.data_dir",
    "listen": "zenoh.listen",
    "connect": "zenoh.connect",
    "host": "api.host",
    "port": "api.port",
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
    instrument = load_instrument(settings.service.instrument)
    from service.worker import begin_early  # the rest of the program takes seconds to import

    if options.own_process:
        begin_early()
    from service.commands.serve import serve

    # the event loop's own products are small; a second BLAS thread would only fight the RTC link
    threadpool_limits(1)
    log_to_the_terminal()
    for remark in instrument.remarks:
        structlog.get_logger().warning("instrument.remark", text=remark)
    return asyncio.run(serve(settings, instrument))


def log_to_the_terminal() -> None:
    """Have everything that is logged, by libraries too, written to standard error."""
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            _harmless,
            structlog.dev.ConsoleRenderer(
                colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback
            ),
        ],
        logger_factory=structlog.PrintLoggerFactory(cast(TextIO, _Forgiving(sys.stderr))),
    )
    logging.getLogger().handlers = [_IntoStructlog()]


class _Forgiving:
    """A file for the log: a disk that refuses it must not end what is logged."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> None:
        """Write it if that can be."""
        with contextlib.suppress(OSError):
            self._file.write(text)

    def flush(self) -> None:
        """Have it on the disk if that can be."""
        with contextlib.suppress(OSError):
            self._file.flush()


def _harmless(_logger: object, _method: str, event: EventDict) -> EventDict:
    """Write out the control characters in what the RTC, files and clients have said."""
    return {
        key: shown(value, keep="\n" if key == "exception" else "")
        if isinstance(value, str)
        else value
        for key, value in event.items()
    }


class _IntoStructlog(logging.Handler):
    """Takes what libraries log."""

    @override
    def emit(self, record: logging.LogRecord) -> None:
        log = structlog.get_logger()
        log.log(record.levelno, record.getMessage(), exc_info=record.exc_info or None)
