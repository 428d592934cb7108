"""The RTC's loop: open or close it, set its gains, have it try gains."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

from fastapi import APIRouter
from pydantic import Field, model_validator

from service.events import GainGroup, Ramp, SetLoop
from service.routes.operating import AcceptedView, Positive, Request, accepted
from service.routes.problems import COMMAND, INVALID
from service.routes.service import ServiceDep

router = APIRouter(
    prefix="/v1/loop", tags=["what an operator asks of it"], responses={**COMMAND, **INVALID}
)

MOST_GROUPS = 1000

Mode = Annotated[int, Field(ge=0)]


class ModeGroup(Request):
    """A range of modes."""

    first: Mode
    """0-based basis index of the first mode."""

    last: Mode
    """Of the last one; it belongs to the group."""

    @model_validator(mode="after")
    def _in_order(self) -> ModeGroup:
        if self.last < self.first:
            raise ValueError(f"first <= last: first {self.first}, last {self.last}")
        return self


class GainGroupBody(ModeGroup):
    """A range of modes and the loop gain they get."""

    gain: float = Field(ge=0.0)
    """0 leaves these modes uncorrected."""


class LoopBody(Request):
    """Change the loop; what is left out stays as it is."""

    loop: Literal["open", "closed"] | None = None
    """Opening zeroes the integrator, and the RTC begins a new session."""

    gains: list[GainGroupBody] | None = Field(default=None, min_length=1, max_length=MOST_GROUPS)
    """Groups of modes, none twice; modes in no group keep their gain."""

    leak: float | None = Field(default=None, ge=0.0, le=1.0)
    """Per frame; 1 forgets nothing."""

    n_controlled: int | None = Field(default=None, ge=1)
    """Takes effect with the next reconstructor of that many modes."""

    effective_gain: float | None = Field(default=None, gt=0.0, le=2.0)
    """Gains that act as this on every mode, by the table of optical gains (``GET /v1/gains``);
    the gate must accept the reconstructor in use with them."""

    @model_validator(mode="after")
    def _something(self) -> LoopBody:
        if self == LoopBody.model_construct():
            raise ValueError("at least one of loop, gains, leak, n_controlled, effective_gain")
        if self.gains is not None and self.effective_gain is not None:
            raise ValueError("gains or effective_gain, not both")
        _none_twice(self.gains or [])
        return self


class RampBody(Request):
    """Try gains on one group of modes after the other; what is left out, the service chooses."""

    groups: list[ModeGroup] | None = Field(default=None, min_length=1, max_length=MOST_GROUPS)
    """In the order they are tried; null: tip and tilt, to mode 99, the other controlled ones."""

    gains: list[Positive] | None = Field(default=None, min_length=1, max_length=100)
    """Tried in this order on every group; null: 0.1 to 0.6."""

    step_s: Positive | None = Field(default=None, le=60.0)
    """How long each gain is tried, at the nominal frame rate, settling included; null: 1."""

    @model_validator(mode="after")
    def _consistent(self) -> RampBody:
        _none_twice(self.groups or [])
        return self


def _none_twice(groups: list[GainGroupBody] | list[ModeGroup]) -> None:
    ranges = sorted((group.first, group.last) for group in groups)
    for before, after in pairwise(ranges):
        if after[0] <= before[1]:
            raise ValueError(f"no mode in two groups: mode {after[0]} is")


@router.post("", status_code=202)
async def loop(service: ServiceDep, body: LoopBody) -> AcceptedView:
    """Open or close the loop, set gains by groups of modes, its leak, how many modes it controls.

    The answer comes when the RTC has accepted; 409 with its reason when it refuses. The state shows
    the loop as the RTC's next status tells it.
    """
    groups = None
    if body.gains is not None:
        groups = tuple(GainGroup(first=g.first, last=g.last, gain=g.gain) for g in body.gains)
    command = SetLoop(
        closed=None if body.loop is None else body.loop == "closed",
        gains=groups,
        leak=body.leak,
        n_controlled=body.n_controlled,
        effective_gain=body.effective_gain,
    )
    return await accepted(service, command)


@router.post("/ramp", status_code=202)
async def ramp(service: ServiceDep, body: RampBody | None = None) -> AcceptedView:
    """Have the RTC find, for each group of modes, the gain of least residual slopes.

    The answer comes when the RTC has begun; 409 with its reason when it refuses. What it chose is
    seen in the gains of the state, which change while it tries, too.
    """
    body = body or RampBody()
    command = Ramp(
        groups=None if body.groups is None else tuple((g.first, g.last) for g in body.groups),
        gains=None if body.gains is None else tuple(body.gains),
        step_s=body.step_s,
    )
    return await accepted(service, command)
