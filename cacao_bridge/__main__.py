"""``pyrcal cacao``: run the bridge."""

from __future__ import annotations

import argparse
import queue
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import structlog
from numpy.typing import NDArray
from typing_extensions import override

from cacao_bridge.calibration import apply, consent, roll_back
from cacao_bridge.computer import Cacao
from cacao_bridge.settings import Settings, load
from pyrcal.rtc.background import Background
from pyrcal.rtc.link import STATUS_PERIOD_S, RtcConnection, RtcLink
from pyrcal.terminal import print_lines
from service.config.link_tables import Router, client_security, secret_of
from service.parser import OneLineParser, words
from service.program import leave, log_to_terminal, status_of, stop_signal
from service.wire import FrameHeader

_REPORT_PERIOD_S: Final = 10.0
_UNLINKED_PAUSE_S: Final = 0.2
_LEAST_BATCH_S: Final = 0.02
_BACKLOG: Final = 64
"""Messages that wait to be sent; beyond it they are dropped, with a line in the log."""
_log = structlog.get_logger("cacao")


def arguments_parser() -> OneLineParser:
    """Return the parser of the command line."""
    return OneLineParser(
        prog="pyrcal cacao",
        description="Run the bridge between a cacao loop and the service, until it is stopped.",
        epilog="Exit status: 0 done; 2 it cannot be done. docs/howto/cacao.md explains the "
        "settings.",
        examples=("--config bridge.toml", "--config bridge.toml --apply"),
        options=(
            words("--config FILE", "settings, TOML", type=Path, required=True),
            words(
                "--apply ID",
                "have a running bridge write the waiting matrix",
                nargs="?",
                const="waiting",
            ),
            words("--bundle FILE", "have a running bridge write a bundle", type=Path),
            words("--rollback", "have a running bridge restore what was there before"),
            words("--seconds S", "end after this time", type=float),
        ),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the bridge until a signal stops it; return the exit status."""
    options = arguments_parser().parse_args(arguments)
    log_to_terminal()
    stopped = stop_signal()
    return status_of(lambda: _run(options, stopped), "pyrcal cacao")


def _run(options: argparse.Namespace, stopped: threading.Event) -> int:
    settings = load(options.config)
    if options.apply is not None:
        applied = consent(settings, options.apply)
        print_lines([f"{applied}: the bridge writes it; restart cacao's loop"])
        return 0
    if options.bundle is not None or options.rollback:
        ordered = roll_back(settings) if options.rollback else apply(settings, options.bundle)
        print_lines([f"{ordered}: the bridge writes it; restart cacao's loop"])
        return 0
    bridge = Bridge(settings)
    if options.seconds is not None:
        threading.Timer(options.seconds, stopped.set).start()
    bridge.run(stopped)
    return 0


class Sender(Background):
    """Sends rows in a thread of its own while a ``with`` block lasts: a put may wait."""

    def __init__(self, link: RtcLink) -> None:
        super().__init__("sender")
        self._link = link
        self._waiting: queue.Queue[tuple[FrameHeader, NDArray[np.float32]]] = queue.Queue(_BACKLOG)

    def offer(self, header: FrameHeader, rows: NDArray[np.float32]) -> None:
        """Queue rows; never waits."""
        try:
            self._waiting.put_nowait((header, rows))
        except queue.Full:
            _log.warning("frames.dropped", n=header.n, first=header.seq0, waiting=_BACKLOG)

    @override
    def _work(self) -> None:
        while not self._stopped.is_set():
            try:
                header, rows = self._waiting.get(timeout=_UNLINKED_PAUSE_S)
            except queue.Empty:
                continue
            self._link.publish_frames(header, rows)


class Bridge:
    """Streams on one side, the contract on the other."""

    def __init__(self, settings: Settings) -> None:
        """Raise ``ConfigurationError`` if a file of the settings is not what it should be."""
        self._settings = settings
        self._router = Router(
            endpoint=settings.wire.connect,
            security=client_security(settings.zenoh),
            secret=secret_of(settings.zenoh),
        )
        self._cacao = Cacao(settings)
        self._n_sent = 0

    def run(self, stopped: threading.Event) -> None:
        """Bridge until ``stopped`` is set; the service may come and go."""
        try:
            while not self._cacao.known and not stopped.is_set():
                # the service may ask for the matrix in use as soon as the link is open
                self._cacao.poll()
                stopped.wait(_UNLINKED_PAUSE_S)
            connection = RtcConnection(
                self._cacao, self._router, batches_per_s=1.0 / _LEAST_BATCH_S
            )
            while not stopped.is_set():
                with connection.open(stopped) as link:
                    if link is not None:
                        self._publish(link, stopped)
        finally:
            self._cacao.close()

    def _publish(self, link: RtcLink, stopped: threading.Event) -> None:
        """Publish telemetry and status until ``stopped`` is set or the link is lost."""
        next_status_s, next_report_s, last_session = 0.0, 0.0, ""
        with Sender(link) as sender:
            while not stopped.is_set():
                for header, rows in self._cacao.poll():
                    sender.offer(header, rows)
                    self._n_sent += header.n
                if self._cacao.has_news:
                    link.report_matrices()
                now_s = time.monotonic()
                # A new session is announced at once: frames of it count only after its status.
                if now_s >= next_status_s or self._cacao.session != last_session:
                    link.publish_status(self._cacao.status())
                    last_session, next_status_s = self._cacao.session, now_s + STATUS_PERIOD_S
                    if link.is_lost():
                        return
                if now_s >= next_report_s:
                    self._report()
                    next_report_s = now_s + _REPORT_PERIOD_S
                stopped.wait(_UNLINKED_PAUSE_S if self._cacao.unlinked else self._cacao.pause_s)

    def _report(self) -> None:
        _log.info(
            "bridge.report",
            frames=self._n_sent,
            lost=self._cacao.n_lost,
            unpaired=self._cacao.n_unpaired,
            cm_id=self._cacao.reconstructor.manifest.id,
            cpu_s=round(time.process_time(), 2),
            wrong=self._cacao.complaint,
        )


if __name__ == "__main__":
    leave(main())
