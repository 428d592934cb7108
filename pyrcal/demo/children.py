"""Start and end the two processes of the demo together."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

GRACE_S = 3.0
"""Longest time for both processes to end by themselves, seconds; then they are killed."""

_POLL_S = 0.05
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True, slots=True, kw_only=True)
class Child:
    """A process in a session of its own, its output in a file."""

    name: str
    log: Path
    process: subprocess.Popen[bytes]

    @property
    def ended(self) -> str | None:
        """Exit status and last output of the process; None while it runs."""
        status = self.process.poll()
        if status is None:
            return None
        # Its last line, because a program says why it ends just before.
        words = self.log.read_text(encoding="utf-8", errors="replace").split("\n")
        last = next((line.strip() for line in reversed(words) if line.strip()), "without a message")
        how = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        return f"the {self.name} {how}: {last}"


@contextmanager
def run_children(directory: Path, commands: Mapping[str, Sequence[str]]) -> Iterator[list[Child]]:
    """Run processes of this Python by name while the ``with`` block lasts."""
    started: list[Child] = []
    try:
        for name, words in commands.items():
            started.append(_start_child(name, words, directory))
        yield started
    finally:
        _end_children(started)


def _start_child(name: str, words: Sequence[str], directory: Path) -> Child:
    path = directory / f"{name}.log"
    with path.open("wb") as log:
        # A session of its own: Ctrl-C in the terminal does not reach it, and SIGKILL ends its
        # group.
        process = subprocess.Popen(
            [sys.executable, *words], stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )
    return Child(name=name, log=path, process=process)


def _end_children(started: list[Child]) -> None:
    """End all processes within ``GRACE_S``; a repeated Ctrl-C cannot interrupt this."""
    with _handle_ending(signal.SIG_IGN):
        # All are signalled before any is awaited, so that they share one period of grace.
        for child in started:
            child.process.send_signal(signal.SIGINT)
        until_s = time.monotonic() + GRACE_S
        while time.monotonic() < until_s and any(c.process.poll() is None for c in started):
            time.sleep(_POLL_S)
        # Those that ended in time too: their own children may still run.
        for child in started:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.process.pid, signal.SIGKILL)
            child.process.wait()


@contextmanager
def interrupt_on_end() -> Iterator[None]:
    """Let a closed terminal, or ``kill``, end the ``with`` block like Ctrl-C."""

    def interrupt(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    with _handle_ending(interrupt):
        yield


@contextmanager
def _handle_ending(handler: Callable[[int, object], None] | signal.Handlers) -> Iterator[None]:
    """Have a handler receive the signals that end a program while the ``with`` block lasts."""
    before = {number: signal.signal(number, handler) for number in _ENDING}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)
