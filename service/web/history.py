"""Routes of the past: α, nights, marks, trends, notes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Annotated, Self

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import AfterValidator, AwareDatetime, BeforeValidator, Field, model_validator

from service.archive import Archive, Mark, Night
from service.archive.nights import CHARTED, FOREVER_NS, TREND_S, Annotation, TrendSample
from service.records.messages import compose
from service.records.registration import HistoryEntry
from service.runtime.snapshot import ModeGainTable
from service.runtime.supervisor import Supervisor
from service.runtime.telemetry_recorder import AnnotationChoice
from service.web import commands, connections, problems, views
from service.web.views import ServiceDep, answer, define_view, shows

router = APIRouter(prefix="/v1", tags=["state"], responses={**problems.INVALID})
notes = APIRouter(prefix="/v1", tags=["archive"], responses={**problems.INVALID})

Points = Annotated[int, Field(ge=8, le=2000)]
Nanoseconds = Annotated[int, Field(ge=0, le=(1 << 63) - 1)]


def _require_clock_time(value: object) -> object:
    if isinstance(value, str) and "T" not in value.upper():  # "2026" would be seconds since 1970
        raise ValueError(f"found {value!r:.40}, expected a time such as 2026-03-01T21:14:03Z")
    return value


_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_LATEST = _EPOCH + timedelta(microseconds=FOREVER_NS // 1000)


def _in_nanoseconds(time: datetime) -> datetime:
    if not _EPOCH <= time <= _LATEST:
        expected = f"{_EPOCH:%Y-%m-%dT%H:%M:%SZ} to {_LATEST:%Y-%m-%dT%H:%M:%SZ}, in nanoseconds"
        raise ValueError(f"found {time.isoformat()}, expected a time from {expected}")
    return time


Clock = Annotated[
    AwareDatetime, BeforeValidator(_require_clock_time), AfterValidator(_in_nanoseconds)
]


class TimeParameters(views.Parameters):
    """A time, from its beginning to its end."""

    since_ns: Nanoseconds | None = None
    """From this time on, nanoseconds since the Unix epoch, UTC."""

    until_ns: Nanoseconds | None = None
    """Up to this time, which belongs to it."""

    since: Clock | None = None
    """``since_ns`` as RFC 3339 says it, such as 2026-03-01T21:14:03Z."""

    until: Clock | None = None
    """``until_ns`` as RFC 3339 says it."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        both = {self.since_ns, self.since}, {self.until_ns, self.until}
        if any(None not in pair for pair in both):
            raise ValueError("a time in nanoseconds or as RFC 3339, not both")
        first, last = self.between
        if first > last:
            raise ValueError(f"since <= until: since {first} ns, until {last} ns")
        return self

    @property
    def between(self) -> tuple[int, int]:
        """First and last time, nanoseconds."""
        first = _nanoseconds(self.since) if self.since_ns is None else self.since_ns
        last = _nanoseconds(self.until) if self.until_ns is None else self.until_ns
        return first or 0, FOREVER_NS if last is None else last


class RangeParameters(TimeParameters):
    """Which part of a history to return."""

    limit: int = Field(default=200, ge=1, le=5000)
    """At most so many entries, the newest ones."""

    after: Nanoseconds | None = None
    """``t_ns_utc`` of the last entry of the page before: the ``limit`` entries that follow it,
    instead of the newest ones; one more where two are of the same time."""

    points: Points | None = None
    """At most so many entries of the whole range, whatever the limit: the lowest and the highest of
    each parameter in each part of it."""


def _nanoseconds(time: datetime | None) -> int | None:
    return None if time is None else (time - _EPOCH) // timedelta(microseconds=1) * 1000


@router.get("/alpha/history", responses={200: shows(views.HISTORY)})
async def alpha_history(
    request: Request, service: ServiceDep, parameters: Annotated[RangeParameters, Query()]
) -> Response:
    """Return the last estimates, or those of a time, oldest first.

    Those of the last hours are in memory; what is older, or of the run before, is in the archive.
    """
    # a night takes a quarter of a second, in which telemetry is taken in
    return await run_in_threadpool(_history, request, service, parameters)


def _history(request: Request, service: Supervisor, asked: RangeParameters) -> Response:
    """Return a part of the history, unless nothing of it has come since the client asked last."""
    tracker = service.snapshot().tracker
    first_ns, last_ns = asked.between
    first_ns = first_ns if asked.after is None else max(first_ns, asked.after + 1)
    found = tuple(entry for entry in tracker.alpha.history if first_ns <= entry.t_ns_utc <= last_ns)
    n_older = service.archive.nights.n_estimates(first_ns, last_ns)
    ends = [entry.t_ns_utc for entry in (*found[:1], *found[-1:])]
    tag = connections.tag_of(asked, n_older, len(found), *ends)
    if (same := connections.not_modified(request, tag)) is not None:
        return same
    if asked.points or asked.after is not None or len(found) < asked.limit:
        # Only what is older than memory is read from the disk, or entries would come twice.
        last_ns = min([last_ns, *(entry.t_ns_utc - 1 for entry in tracker.alpha.history)])
        found = (*_older(service.archive, first_ns, last_ns, asked), *found)
    response = answer(
        replace(tracker, alpha=replace(tracker.alpha, history=_cut(found, asked))), views.HISTORY
    )
    response.headers["ETag"] = tag
    return response


History = tuple[HistoryEntry, ...]

OF_ONE_TIME = 10
"""Estimates of one time in which a page may end."""


def _older(archive: Archive, first_ns: int, last_ns: int, asked: RangeParameters) -> History:
    """Return what the archive has of a time before all that is in memory."""
    if first_ns > last_ns:
        return ()
    if asked.points is not None:
        return archive.nights.downsampled(first_ns, last_ns, asked.points)
    n_most = asked.limit + OF_ONE_TIME
    return archive.nights.estimates(first_ns, last_ns, n_most, newest=asked.after is None)


def _cut(found: History, asked: RangeParameters) -> History:
    """Return the requested part of what was found."""
    if asked.points is not None:
        return downsample(found, asked.points)
    if asked.after is None:
        return found[-asked.limit :]
    page = found[: asked.limit]
    rest = found[asked.limit :]
    # The next page begins after the last time of this one: entries of the same time must not be cut
    # apart.
    return (*page, *(entry for entry in rest if entry.t_ns_utc == page[-1].t_ns_utc))


def downsample(history: History, n_points: int) -> History:
    """Return at most so many entries, with the extremes of each parameter in equal parts of time.

    A line drawn through them looks like one through all, however short a jump was.
    """
    if len(history) <= n_points:
        return history
    values = np.array([entry.filtered.vector for entry in history])
    times_s = np.array([entry.t_ns_utc - history[0].t_ns_utc for entry in history]) * 1e-9
    n_parts = n_points // (2 * values.shape[1])
    # Clipped, because the last entry lies exactly at the end of the last part.
    part = (times_s / (np.ptp(times_s) or 1.0) * n_parts).clip(0, n_parts - 1).astype(int)
    kept: set[int] = set()
    for members in (np.flatnonzero(part == k) for k in range(n_parts)):
        if members.size:
            kept.update(members[values[members].argmin(axis=0)].tolist())
            kept.update(members[values[members].argmax(axis=0)].tolist())
    return tuple(history[k] for k in sorted(kept))


@dataclass(frozen=True, slots=True, kw_only=True)
class NightList:
    """The nights of which something is in the archive."""

    nights: tuple[Night, ...]
    """Oldest first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkList:
    """Marks for a chart of α."""

    marks: tuple[Mark, ...]
    """Oldest first."""


class NewestParameters(TimeParameters):
    """A time, and how much of it to return."""

    limit: int = Field(default=500, ge=1, le=2000)
    """At most so many, the newest ones."""


define_view("NightView", Night)
define_view("MarkView", Mark)
NIGHTS = define_view("NightsView", NightList)
MARKS = define_view("MarksView", MarkList)


@router.get("/nights", responses={200: shows(NIGHTS)})
async def nights(service: ServiceDep, parameters: Annotated[TimeParameters, Query()]) -> Response:
    """Return the nights of a time, from noon to noon, with their contents."""
    found = await run_in_threadpool(service.archive.nights.between, *parameters.between)
    return answer(NightList(nights=found))


@router.get("/marks", responses={200: shows(MARKS)})
async def marks(service: ServiceDep, parameters: Annotated[NewestParameters, Query()]) -> Response:
    """Return swaps, jumps, alarms and starts of a time."""
    found = await run_in_threadpool(
        service.archive.nights.marks, *parameters.between, parameters.limit
    )
    return answer(MarkList(marks=found))


@dataclass(frozen=True, slots=True, kw_only=True)
class TrendList:
    """The samples of a time."""

    interval_s: float
    """From one sample to the next at the most; where they are further apart nothing ran."""

    samples: tuple[TrendSample, ...]
    """Oldest first."""


class TrendParameters(TimeParameters):
    """Which samples to return."""

    points: int = Field(default=2000, ge=8, le=2000)
    """At most so many of the whole time: of more, the last and the worst in each part of it."""


define_view("TrendSampleView", TrendSample, " ".join(CHARTED))
TRENDS = define_view("TrendsView", TrendList)


@router.get("/trends", responses={200: shows(TRENDS)})
async def trends(service: ServiceDep, parameters: Annotated[TrendParameters, Query()]) -> Response:
    """Return samples of wavefront error, margin, gain, flux, pointing and α.

    A sample is taken every few seconds while the service runs, with or without telemetry.
    """
    first_ns, last_ns = parameters.between
    found = await run_in_threadpool(
        service.archive.nights.samples, first_ns, last_ns, parameters.points
    )
    interval_s = TREND_S
    if len(found) > parameters.points // 2:  # there may have been more
        span_s = (found[-1].t_ns_utc - found[0].t_ns_utc) / 1e9
        # Each part of the time has two samples, the last and the worst.
        interval_s = max(TREND_S, 2.0 * span_s / parameters.points)
    return answer(TrendList(interval_s=interval_s, samples=found))


@dataclass(frozen=True, slots=True, kw_only=True)
class GainHistory:
    """Optical gains of all modes at some times."""

    entries: tuple[ModeGainTable, ...]
    """Oldest first."""


class GainParameters(TimeParameters):
    """Which gains to return."""

    limit: int = Field(default=50, ge=1, le=200)
    """At most so many entries, the newest ones."""

    after: Nanoseconds | None = None
    """``t_ns_utc`` of the last entry of the page before: the ``limit`` entries that follow it."""


GAIN_HISTORY = define_view("GainHistoryView", GainHistory)


@router.get("/gains/history", responses={200: shows(GAIN_HISTORY)})
async def gain_history(
    service: ServiceDep, parameters: Annotated[GainParameters, Query()]
) -> Response:
    """Return the optical gains of all modes of a time, oldest first.

    An entry is kept every few seconds in which a dithered window was measured. Its curve is
    inferred from the measured modes by the present rules.
    """
    first_ns, last_ns = parameters.between
    after = parameters.after
    found = await run_in_threadpool(
        service.archive.nights.gains,
        first_ns if after is None else max(first_ns, after + 1),
        last_ns,
        parameters.limit,
        newest=after is None,
    )
    return answer(GainHistory(entries=tuple(map(ModeGainTable.of, found))))


@dataclass(frozen=True, slots=True, kw_only=True)
class AnnotationList:
    """Notes of operators."""

    annotations: tuple[Annotation, ...]
    """Oldest first."""


define_view("AnnotationView", Annotation)
ANNOTATIONS = define_view("AnnotationsView", AnnotationList)


class AnnotationAcceptedView(commands.AcceptedView):
    """A note that is kept."""

    id: int
    """Id of the note."""


@notes.get("/annotations", responses={200: shows(ANNOTATIONS)})
async def list_annotations(
    service: ServiceDep, parameters: Annotated[NewestParameters, Query()]
) -> Response:
    """Return operators' notes about a time, oldest first."""
    found = await run_in_threadpool(
        service.archive.nights.notes, *parameters.between, parameters.limit
    )
    return answer(AnnotationList(annotations=found))


@notes.post("/annotations", status_code=201, responses={**problems.COMMAND})
async def annotate(
    client: commands.ClientDep, choice: Annotated[AnnotationChoice, commands.body(AnnotationChoice)]
) -> AnnotationAcceptedView:
    """Note something about a moment, for ever."""
    entry = client.actor.entry("annotation", choice.note, by=choice.by, why=choice.reason)
    t_ns = entry.t_ns_utc if choice.t_ns_utc is None else choice.t_ns_utc
    note = Annotation(t_ns_utc=t_ns, written_ns_utc=entry.t_ns_utc, who=entry.who, note=choice.note)
    number = await run_in_threadpool(client.service.archive.nights.add_note, note)
    await client.service.audited(replace(entry, answer=f"note {number}"))
    where = f"/v1/annotations?since_ns={t_ns}&until_ns={t_ns}"
    accepted = client.accepted(compose("archive.annotated"), annotation=where)
    return AnnotationAcceptedView(id=number, **accepted.model_dump())
