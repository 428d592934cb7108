"""The folder of an uploaded fit: request and answer as files.

The service writes :data:`UPLOAD` and :data:`REQUEST` and starts the program with the folder as its
only word. While it runs it names its stage in :data:`STAGE`. When it ends with status 0 there are
:data:`DOCUMENT` and :data:`FIGURES`; with another one, the last line on standard error says why.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

UPLOAD = "upload"
"""The uploaded file: a measured matrix, or a zip archive of a matrix and an instrument."""

REQUEST = "request.json"
"""A :class:`FitRequest`."""

STAGE = "stage"
"""One word of :data:`STAGES`."""

STAGES = ("reading", "modes", "orientation", "fit", "verdict", "figures")
"""Stages of a fit, in this order."""

DOCUMENT = "document.json"
"""Result of the fit, as printed by ``pyrcal fit --json``."""

FIGURES = "figures.json"
"""Data of the figures."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitRequest:
    """A fit to run, its options, and its limits on this machine."""

    asked: Mapping[str, Any]
    """As ``POST /v1/fits`` names it: dataset, method, modes, start, gain_map, anamorphosis,
    instrument, reference."""

    own_instrument: str
    """Instrument of the service: a packaged name or a file."""

    own_sha256: str
    """Digest of the instrument as the service read it; the file may have changed since."""

    max_bytes: int
    """Largest size of all files of an archive together."""

    threads: int
    """Threads that share the work."""

    nice: int
    """Niceness of the process, so that the telescope has priority."""

    memory_mb: int
    """Memory that the process may allocate."""

    def write(self, folder: Path) -> None:
        """Put it into the folder of its fit."""
        (folder / REQUEST).write_text(json.dumps(asdict(self)), encoding="utf-8")


def read_request(folder: Path) -> FitRequest:
    """Return what the service asks for."""
    return FitRequest(**json.loads((folder / REQUEST).read_text(encoding="utf-8")))
