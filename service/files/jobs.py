"""Fits that were asked of the service: what is known of each, and how many may be known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from service.fit.options import FitOptions

UPLOAD = "upload"
"""Name of what was uploaded, in the folder of its fit."""


class FitState(StrEnum):
    """How far a fit is."""

    RECEIVING = "receiving"
    """The upload is on its way."""

    WAITING = "waiting"
    """It stands in the queue."""

    RUNNING = "running"
    DONE = "done"
    """There is a document; its verdict may be a refusal."""

    FAILED = "failed"
    """There is none; the reason says why."""


UNFINISHED = frozenset({FitState.RECEIVING, FitState.WAITING, FitState.RUNNING})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitAsked:
    """What was asked for, besides the measured matrix itself."""

    options: FitOptions
    """As for any fit."""

    dataset: str | None = None
    """Name of the matrix in its file; None: the usual one."""

    instrument: str | None = None
    """A packaged instrument; None: the service's own, or the one that was uploaded."""

    reference: str | None = None
    """The measured file in an upload of several; None: the only one that can be it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitJob:
    """One fit the service was asked for."""

    id: str
    """Never reused while the service runs."""

    state: FitState
    """How far it is."""

    asked_ns_utc: int
    """When it was asked for, the service's clock."""

    n_bytes: int = 0
    """Of the upload so far."""

    sha256: str = ""
    """Of the upload; empty until it is whole."""

    reason: str = ""
    """Why it failed."""

    document: Mapping[str, Any] | None = None
    """What was found, as ``service.files.report.document`` says it."""
