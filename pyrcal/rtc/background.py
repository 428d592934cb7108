"""Threads that run for the duration of a ``with`` block."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import Self


class Background(ABC):
    """Base class of work that runs in its own thread for the duration of a ``with`` block.

    The thread is a daemon, so that a stuck network call does not keep the program alive.
    """

    def __init__(self, name: str) -> None:
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()

    @abstractmethod
    def _work(self) -> None:
        """Run in the thread until ``_stopped`` is set."""
