"""How the night went: what was known every few seconds, for charts of any time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import Field

from service.archive.trends import TREND_S, TrendSample
from service.web.problems import INVALID
from service.web.reading import TimeParameters
from service.web.views import ServiceDep, answer, define_view, shows

router = APIRouter(prefix="/v1", tags=["what the service knows"], responses={**INVALID})


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


define_view("TrendSampleView", TrendSample)
TRENDS = define_view("TrendsView", TrendList)


@router.get("/trends", responses={200: shows(TRENDS)})
async def trends(service: ServiceDep, parameters: Annotated[TrendParameters, Query()]) -> Response:
    """Return wavefront error, margin, gain, flux, pointing and α as they were known over a time.

    A sample is taken every few seconds while the service runs, with or without telemetry.
    """
    first_ns, last_ns = parameters.between
    found = await run_in_threadpool(
        service.archive.trends.between, first_ns, last_ns, parameters.points
    )
    interval_s = TREND_S
    if len(found) > parameters.points // 2:  # there may have been more
        span_s = (found[-1].t_ns_utc - found[0].t_ns_utc) / 1e9
        interval_s = max(TREND_S, 2.0 * span_s / parameters.points)
    return answer(TrendList(interval_s=interval_s, samples=found))
