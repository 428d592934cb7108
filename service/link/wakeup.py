"""One bell between zenoh's threads and whoever consumes what they bring."""

from __future__ import annotations

from collections.abc import Callable


class Wakeup:
    """Rings at most once between two visits of the consumer, from whatever thread."""

    __slots__ = ("_callback", "_rung")

    def __init__(self) -> None:
        self._callback: Callable[[], object] | None = None
        self._rung = False

    def connect(self, callback: Callable[[], object] | None) -> None:
        """Call ``callback`` from now on; None: nothing."""
        self._callback = callback
        self._rung = False

    def ring(self) -> None:
        """Say that something new is there."""
        callback = self._callback
        if callback is not None and not self._rung:
            self._rung = True
            callback()

    def answer(self) -> None:
        """Say that the consumer is about to look: what comes from now on rings again."""
        self._rung = False
