"""A TCP connection that can be cut, held, delayed and throttled."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress


class Cable:
    """What comes to ``port`` of loopback goes to ``to_port``, as long as it is plugged."""

    def __init__(self, to_port: int) -> None:
        self.to_port, self.plugged = to_port, threading.Event()
        self.plugged.set()
        self.delay_s = 0.0
        """Between a piece's coming and its going."""

        self.bytes_per_s: float | None = None
        """At most so many go through, either way; None: no limit."""

        self.held = False
        """Nothing goes through, and nobody is told: the other side looks alive and says nothing."""

        self.ends: list[socket.socket] = []
        self.door = socket.create_server(("127.0.0.1", 0))
        self.port = int(self.door.getsockname()[1])
        threading.Thread(target=self._serve, daemon=True).start()

    def cut(self) -> None:
        """End every connection, and let none come until ``plugged`` is set."""
        self.plugged.clear()
        for end in self.ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        self.ends = []

    def close(self) -> None:
        """End it for good."""
        self.cut()
        self.door.close()

    def _serve(self) -> None:
        while True:
            try:
                near, _ = self.door.accept()
                if not self.plugged.is_set():
                    near.close()
                    continue
                far = socket.create_connection(("127.0.0.1", self.to_port))
            except OSError:
                if self.door.fileno() < 0:
                    return
                near.close()  # nobody is at the other end yet
                continue
            self.ends += [near, far]
            for a, b in ((near, far), (far, near)):
                threading.Thread(target=self._carry, args=(a, b), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                while self.held:
                    time.sleep(0.02)
                if self.delay_s:
                    time.sleep(self.delay_s)
                if self.bytes_per_s:
                    time.sleep(len(data) / self.bytes_per_s)
                sink.sendall(data)
        except OSError:
            pass
        finally:
            for end in (source, sink):
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
