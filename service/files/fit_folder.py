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
"""What was uploaded: a measured matrix, or a zip archive of it and an instrument."""

REQUEST = "request.json"
"""A :class:`FitRequest`."""

STAGE = "stage"
"""One word of :data:`STAGES`."""

STAGES = ("reading", "modes", "orientation", "fit", "verdict", "figures")
"""What a fit does, in this order."""

DOCUMENT = "document.json"
"""What was found: what ``pyrcal fit --json`` prints."""

FIGURES = "figures.json"
"""What its figures are drawn from."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitRequest:
    """A fit to run, its options, and its limits on this machine."""

    asked: Mapping[str, Any]
    """As ``POST /v1/fits`` names it: dataset, method, modes, start, gain_map, anamorphosis,
    instrument, reference."""

    own_instrument: str
    """That of the service: a packaged name, or a file."""

    own_sha256: str
    """Of the instrument as the service has read it: the file may have changed since."""

    max_bytes: int
    """Of the files of an archive together."""

    threads: int
    """That share the work."""

    nice: int
    """Of the process: the telescope goes first."""

    memory_mb: int
    """That the process may allocate."""

    def write(self, folder: Path) -> None:
        """Put it into the folder of its fit."""
        (folder / REQUEST).write_text(json.dumps(asdict(self)), encoding="utf-8")


def read_request(folder: Path) -> FitRequest:
    """Return what the service asks for."""
    return FitRequest(**json.loads((folder / REQUEST).read_text(encoding="utf-8")))
