"""Ordered refits: jobs with an id."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

from service.errors import UnknownIdError
from service.tracking import events as ev
from service.tracking.events import Effect, Event
from service.tracking.products import MatrixState

REFITS_KEPT = 100
"""Newest jobs that are remembered, until the service ends."""


class RefitState(StrEnum):
    """States of a refit."""

    RUNNING = "running"
    """The reconstructor is being computed and judged."""

    MADE = "made"
    """There is a reconstructor; its own state says what becomes of it."""

    REFUSED = "refused"
    """There is one, and the gate refuses it."""

    FAILED = "failed"
    """There is none, for a reason."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RefitJob:
    """An order to compute a reconstructor for the registration of now."""

    id: str
    state: RefitState
    n_modes: int
    """Modes asked for."""

    asked_ns_utc: int
    reconstructor: str | None = None
    """Id of the one that was made; None: there is none, or not yet."""

    reason: str = ""
    """What came of it, in words."""


class Refits:
    """The refits that the service remembers; belongs to the event loop."""

    def __init__(self) -> None:
        self._jobs: dict[str, RefitJob] = {}

    def begin(self, effects: Iterable[Effect], now_ns: int) -> None:
        """Remember a job from the moment its computation begins; its id is the order's."""
        made = next(effect for effect in effects if isinstance(effect, ev.MakeMatrix))
        self._jobs[made.cause] = RefitJob(
            id=made.cause, state=RefitState.RUNNING, n_modes=made.n_modes, asked_ns_utc=now_ns
        )
        while len(self._jobs) > REFITS_KEPT:
            del self._jobs[next(iter(self._jobs))]

    def end(self, effect: Effect, event: Event | None) -> None:
        """Note what came of an effect, if a job waits for it."""
        job = self._jobs.get(effect.cause)
        if job is None or job.state is not RefitState.RUNNING:
            return
        if not isinstance(effect, ev.MakeMatrix):
            return
        match event:
            case ev.MatrixMade(record=record):
                verdict = record.reason if record.gate is None else record.gate.reason
                text = f"{record.id}, {record.n_modes} modes: {verdict}"
                refused = record.state is MatrixState.REFUSED
                state = RefitState.REFUSED if refused else RefitState.MADE
                job = replace(job, state=state, reconstructor=record.id, reason=text)
            case ev.JobFailed(text=text):
                job = replace(job, state=RefitState.FAILED, reason=text)
            case _:
                job = replace(job, state=RefitState.FAILED, reason="it was given up")
        self._jobs[job.id] = job

    def job(self, refit_id: str) -> RefitJob:
        """Return what is known of a job.

        Raises
        ------
        UnknownIdError
            If there is none of this id.
        """
        if refit_id not in self._jobs:
            raise UnknownIdError(f"refit {refit_id}: this service has begun no such refit")
        return self._jobs[refit_id]
