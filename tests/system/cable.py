"""TCP ports that nobody else takes meanwhile, and a connection that a test can cut."""

import fcntl
import os
import socket
import tempfile
import threading
from contextlib import suppress
from pathlib import Path

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


class Cable:
    """A TCP connection through here that can be cut, and kept from coming back."""

    def __init__(self, to_port: int) -> None:
        self.to_port, self.plugged = to_port, threading.Event()
        self.plugged.set()
        self.ends: list[socket.socket] = []
        self.door = socket.create_server(("127.0.0.1", 0))
        self.port = int(self.door.getsockname()[1])
        threading.Thread(target=self._serve, daemon=True).start()

    def cut(self) -> None:
        self.plugged.clear()
        for end in self.ends:
            end.close()

    def _serve(self) -> None:
        while True:
            near, _ = self.door.accept()
            if not self.plugged.is_set():
                near.close()
                continue
            far = socket.create_connection(("127.0.0.1", self.to_port))
            self.ends += [near, far]
            for a, b in ((near, far), (far, near)):
                threading.Thread(target=self._carry, args=(a, b), daemon=True).start()

    @staticmethod
    def _carry(source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                sink.sendall(data)
        except OSError:
            pass
        finally:
            for end in (source, sink):
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
