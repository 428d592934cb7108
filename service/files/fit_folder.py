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
"""Upload: a measured matrix, or a zip archive of it and an instrument."""

REQUEST = "request.json"
"""A :class:`FitRequest`."""

STAGE = "stage"
"""One word of :data:`STAGES`."""

STAGES = ("reading", "modes", "orientation", "fit", "verdict", "figures")
"""Stages of a fit, in order."""

DOCUMENT = "document.json"
"""Result: the document that ``pyrcal fit --json`` prints."""

FIGURES = "figures.json"
"""Data of its figures."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitRequest:
    """A fit to run, its options, and its limits on this machine."""

    asked: Mapping[str, Any]
    """Options named as in ``POST /v1/fits``: dataset, method, modes, start, gain_map, anamorphosis,
    instrument, reference."""

    own_instrument: str
    """Instrument of the service: a packaged name, or a file."""

    own_sha256: str
    """Checksum of the instrument as the service has read it: the file may have changed since."""

    max_bytes: int
    """Limit of the files of an archive together."""

    threads: int
    """Number of threads."""

    nice: int
    """Priority of the process: the telescope goes first."""

    memory_mb: int
    """Memory that the process may allocate."""

    def write(self, folder: Path) -> None:
        """Put it into the folder of its fit."""
        (folder / REQUEST).write_text(json.dumps(asdict(self)), encoding="utf-8")


def read_request(folder: Path) -> FitRequest:
    """Return what the service asks for."""
    return FitRequest(**json.loads((folder / REQUEST).read_text(encoding="utf-8")))
