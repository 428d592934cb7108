"""The simulator's truth file, read while it grows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

Line = dict[str, Any]


class TruthFile:
    """Reader of the truth file that follows it across a restart of the simulator."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self._inode: int | None = None
        self.lines: list[Line] = []

    def read(self) -> None:
        """Read the complete lines written since the last call."""
        if not self._path.exists():
            return
        status = self._path.stat()
        # A simulator that was started again writes another file, or this one from its beginning.
        if status.st_size < self._offset or status.st_ino != self._inode:
            self._offset, self._inode = 0, status.st_ino
        with self._path.open("rb") as file:
            file.seek(self._offset)
            text = file.read()
        # The simulator may be in the middle of writing the last line.
        whole = text[: text.rfind(b"\n") + 1]
        self._offset += len(whole)
        self.lines += [json.loads(line) for line in whole.splitlines()]

    @property
    def last(self) -> Line | None:
        """Latest truth line; None if there is none."""
        return next((line for line in reversed(self.lines) if line["kind"] == "truth"), None)

    @property
    def swaps(self) -> list[Line]:
        """Swaps of reconstructors whose effect has been measured."""
        return [line for line in self.lines if line["kind"] == "swap"]

    def wavefront_error_nm(self, cm_id: str, settling_s: float = 1.0) -> float | None:
        """Return the RMS wavefront error with one reconstructor, without its first moments."""
        under = [line for line in self.lines if line["kind"] == "truth" and line["cm_id"] == cm_id]
        if not under:
            return None
        # The integrator has not settled in the first moments of a matrix.
        begin_ns = under[0]["t_ns_utc"] + settling_s * 1e9
        squares = [
            line["wavefront_error_nm"] ** 2 for line in under if line["t_ns_utc"] >= begin_ns
        ]
        return float((sum(squares) / len(squares)) ** 0.5) if squares else None
