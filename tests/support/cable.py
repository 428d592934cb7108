"""TCP ports that nobody else takes meanwhile, and a connection that a test can cut."""

import fcntl
import os
import socket
import tempfile
from pathlib import Path

from pyrcal_studies.live import Cable

__all__ = ["Cable", "free_port"]

PORTS = range(20_000, 32_000)
"""Below those that the system gives to connections on their way out: one of these could have the
port between the moment it is chosen and the moment a service listens on it."""

_mine = []


def free_port() -> int:
    """Return a port that no other test of this machine gets while this process lives."""
    folder = Path(tempfile.gettempdir()) / f"pyrcal-ports-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    first = os.getpid() * 101 % len(PORTS)
    for port in (*PORTS[first:], *PORTS[:first]):
        lock = (folder / str(port)).open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            socket.create_server(("127.0.0.1", port)).close()
        except OSError:
            lock.close()
            continue
        _mine.append(lock)
        return port
    raise AssertionError(f"every port of {PORTS} is taken")
