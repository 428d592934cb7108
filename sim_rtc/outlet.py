"""Measured interaction matrices on their way to the service."""

from __future__ import annotations

import threading
import time
from typing import Final

import structlog
import zenoh

from service.wire import Encodings, Keys, encode_measured_manifest, split
from sim_rtc.computer import RealTimeComputer
from sim_rtc.measure import Circumstances, Measured, product

_POLL_S: Final = 0.05
_log = structlog.get_logger("sim_rtc")


class Outlet:
    """Solves and sends what was measured, in a thread of its own while its ``with`` block lasts.

    Solving takes up to half a second and sending waits for the network: telemetry must not wait
    with it.
    """

    def __init__(self, session: zenoh.Session, keys: Keys, computer: RealTimeComputer) -> None:
        self._session = session
        self._keys = keys
        self._computer = computer
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="measured", daemon=True)

    def __enter__(self) -> Outlet:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopped.wait(_POLL_S):
            for measured in self._computer.take_measured():
                self._send(measured)

    def _send(self, measured: Measured) -> None:
        """Send a matrix in parts, then its manifest, or why there is none."""
        identity = self._computer.identity
        circumstances = Circumstances(
            system=identity.system,
            basis_id=identity.basis_id,
            config_id=identity.config_id,
            double_pass=identity.double_pass,
            created_ns=time.time_ns(),
        )
        manifest, matrix = product(measured, circumstances)
        parts = [] if matrix is None else split(matrix, manifest.layout.chunk_bytes)
        for index, part in enumerate(parts):
            self._session.put(
                self._keys.measured_chunk(manifest.id, index),
                part,
                encoding=Encodings.BYTES,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
            )
        self._session.put(
            self._keys.measured_commit(manifest.id),
            encode_measured_manifest(manifest),
            encoding=Encodings.MEASURED_COMMIT,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.DATA_HIGH,
        )
        _log.info(
            "matrix.measured",
            id=manifest.id,
            pattern=str(manifest.pattern),
            shape=manifest.layout.shape,
            reason=manifest.reason or "",
        )
