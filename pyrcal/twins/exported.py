"""The record of a model that was written for another program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """A model written for another program."""

    path: Path
    """File that the other program runs."""

    remarks: tuple[str, ...]
    """Assumptions of the model and what it does not contain, one sentence each."""
