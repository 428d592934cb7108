"""What an operator asks of the service, and what the observatory tells it.

Each answer is 202: the command was accepted and set in motion. Whether it has come to its end
is seen in the state and in the events.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Literal

from fastapi import APIRouter, Body
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidatorFunctionWrapHandler,
    WithJsonSchema,
    WrapValidator,
    model_validator,
)

from service.routes.problems import COMMAND, INVALID, UNKNOWN
from service.routes.views import MatrixId, ServiceDep
from service.runtime.supervisor import Supervisor
from service.tracking.dither_request import total_m
from service.tracking.events import (
    AbortAcquisition,
    Acquire,
    Approve,
    Command,
    GainGroup,
    Publish,
    Ramp,
    Refit,
    Reject,
    Rollback,
    SetLoop,
    SetMode,
    SetPointing,
    StartDither,
    StopDither,
)
from service.tracking.products import ModeSet
from service.tracking.state import Mode
from service.wire import DitherKind, Pointing

router = APIRouter(
    prefix="/v1",
    tags=["what an operator asks of it"],
    responses={**COMMAND, **INVALID},
)

observatory = APIRouter(
    prefix="/v1", tags=["what the observatory tells it"], responses={**COMMAND, **INVALID}
)

Positive = Annotated[float, Field(gt=0.0)]

MOST_SINES = 64
MOST_MODES = 100_000
MOST_GROUPS = 1000

BasisMode = Annotated[int, Field(ge=0)]


def _named_or_listed(value: object, listed: ValidatorFunctionWrapHandler) -> object:
    if isinstance(value, str):
        try:
            return ModeSet(value)
        except ValueError:
            raise ValueError("'controlled', 'all' or a list of basis indices") from None
    modes: list[int] = listed(value)
    if len(set(modes)) < len(modes):
        raise ValueError("modes without any of them twice")
    return modes


_SCHEMA = {
    "anyOf": [
        {
            "type": "array",
            "items": {"type": "integer", "minimum": 0},
            "minItems": 1,
            "maxItems": MOST_MODES,
        },
        {"type": "string", "enum": [name.value for name in ModeSet]},
    ]
}

if TYPE_CHECKING:
    Modes = list[int] | ModeSet
else:
    # a union of pydantic's own would name its branches in every message
    Modes = Annotated[
        Annotated[list[BasisMode], Field(min_length=1, max_length=MOST_MODES)],
        WrapValidator(_named_or_listed),
        WithJsonSchema(_SCHEMA),
    ]


class Request(BaseModel):
    """The body of a command; an unknown field is refused."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )

    def fields(self) -> dict[str, Any]:
        """Return what was asked as a command of the tracker has it: a list is a tuple there."""
        return {name: tuple(v) if isinstance(v, list) else v for name, v in self}


class NoFields(Request):
    """A command that needs nothing else."""


class RefitRequest(Request):
    """Compute a reconstructor for the current registration now."""

    n_modes: int | None = Field(default=None, ge=1)
    """Modes to control; null: as many as now."""


class StartDitherRequest(Request):
    """Start a dither; what is left out, the service chooses."""

    action: Literal["start"]
    kind: DitherKind = Field(default=DitherKind.SINE, strict=False)
    """"sine", or "binary": random signs, on hundreds of modes if need be."""

    modes: Modes | None = None
    """0-based basis indices, none twice; of a binary dither also "controlled" or "all"."""

    amplitude_m: Positive | None = None
    """RMS of each mode of a sine, metres OPD."""

    total_amplitude_m: Positive | None = None
    """RMS of all modes of a binary dither together, metres OPD."""

    frequency_hz: list[Positive] | None = Field(default=None, min_length=1, max_length=64)
    """One for each mode of a sine."""

    duration_s: Positive | None = None
    over_budget: bool = False
    """Allow more than the budget of the settings."""

    @model_validator(mode="after")
    def _consistent(self) -> StartDitherRequest:
        listed = [] if self.modes is None or isinstance(self.modes, ModeSet) else self.modes
        if self.kind is DitherKind.BINARY:
            if self.amplitude_m is not None or self.frequency_hz is not None:
                raise ValueError(
                    "no amplitude_m and no frequency_hz with binary: total_amplitude_m"
                )
            return self
        if isinstance(self.modes, ModeSet) or len(listed) > MOST_SINES:
            raise ValueError(f"at most {MOST_SINES} modes with sine")
        if self.total_amplitude_m is not None:
            raise ValueError("no total_amplitude_m with sine: amplitude_m of each mode")
        if self.frequency_hz is not None and len(self.frequency_hz) != len(listed):
            raise ValueError(
                f"one frequency_hz for each of modes: {len(self.frequency_hz)} given for "
                f"{len(listed)}"
            )
        return self


class StopDitherRequest(Request):
    """Stop the dither, and start no other until told to."""

    action: Literal["stop"]


class RejectRequest(Request):
    """Discard a proposed reconstructor."""

    reason: str = Field(default="", max_length=500)
    """Kept with the reconstructor."""


class ModeRequest(Request):
    """How much the service may do by itself."""

    mode: Mode = Field(strict=False)
    """"auto", "propose" or "hold"."""


class AcceptedView(BaseModel):
    """A command that was set in motion."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    text: str
    """What was."""

    links: dict[str, str]
    """Where to look for what becomes of it."""


class ModeGroup(Request):
    """A range of modes."""

    first: BasisMode
    """0-based basis index of the first mode."""

    last: BasisMode
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
        _none_twice(self.gains or ())
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
        _none_twice(self.groups or ())
        return self


def _none_twice(groups: Sequence[ModeGroup]) -> None:
    ranges = sorted((group.first, group.last) for group in groups)
    for before, after in pairwise(ranges):
        if after[0] <= before[1]:
            raise ValueError(f"no mode in two groups: mode {after[0]} is")


class AcquisitionBody(Request):
    """Begin an acquisition, or end one."""

    action: Literal["start", "abort"] = Field()
    """"start" opens the loop; "abort" leaves it as it was found if that held, else open or closed
    on a matrix that has passed the gate."""


class PointingRequest(Request):
    """Where the telescope looks now."""

    elevation_deg: float = Field(ge=-90.0, le=90.0)
    """Above the horizon, degrees."""

    azimuth_deg: float = Field(ge=-720.0, le=720.0)
    """From north over east, degrees; only differences count."""


async def accepted(service: Supervisor, command: Command, **links: str) -> AcceptedView:
    """Hand a command on; say what was set in motion and where to look for what becomes of it."""
    text = await service.submit(command)
    return AcceptedView(text=text, links={"state": "/v1/state", "events": "/v1/events", **links})


def _link(matrix_id: str) -> str:
    return f"/v1/reconstructors/{matrix_id}"


_ALL = "/v1/reconstructors"


@router.post("/refit", status_code=202)
async def refit(service: ServiceDep, body: RefitRequest | None = None) -> AcceptedView:
    """Compute a reconstructor for the current registration; gate and mode apply as always."""
    return await accepted(service, Refit(**(body or RefitRequest()).fields()), reconstructors=_ALL)


@router.post("/dither", status_code=202)
async def dither(
    service: ServiceDep,
    body: Annotated[StartDitherRequest | StopDitherRequest, Body(discriminator="action")],
) -> AcceptedView:
    """Start or stop the dither."""
    if isinstance(body, StopDitherRequest):
        return await accepted(service, StopDither())
    asked = body.fields()
    asked.pop("action")
    command = StartDither(total_m=asked.pop("total_amplitude_m"), **asked)
    answer = await accepted(service, command)
    state = service.snapshot().tracker
    if state.dither is None:
        return answer
    cost = f"{1e9 * total_m(state.dither.request):.3g} nm RMS in all"
    budget = f"budget {1e9 * state.dithering.budget_m:.3g} nm"
    return answer.model_copy(update={"text": f"{answer.text}: {cost}, {budget}"})


@router.post("/reconstructors/{id}/approve", status_code=202, responses={**UNKNOWN})
async def approve(
    service: ServiceDep, matrix_id: MatrixId, _body: NoFields | None = None
) -> AcceptedView:
    """Publish a proposed reconstructor."""
    return await accepted(service, Approve(id=matrix_id), reconstructor=_link(matrix_id))


@router.post("/reconstructors/{id}/reject", status_code=202, responses={**UNKNOWN})
async def reject(
    service: ServiceDep, matrix_id: MatrixId, body: RejectRequest | None = None
) -> AcceptedView:
    """Discard a proposed reconstructor."""
    command = Reject(id=matrix_id, **(body or RejectRequest()).fields())
    return await accepted(service, command, reconstructor=_link(matrix_id))


@router.post("/reconstructors/{id}/publish", status_code=202, responses={**UNKNOWN})
async def publish(
    service: ServiceDep, matrix_id: MatrixId, _body: NoFields | None = None
) -> AcceptedView:
    """Send a known reconstructor again, under a new id, unless the gate refuses it now.

    What has been in use is sent even where the gate cannot judge it: α unknown, or the loop open.
    """
    return await accepted(service, Publish(id=matrix_id), reconstructors=_ALL)


@router.post("/rollback", status_code=202)
async def rollback(service: ServiceDep, _body: NoFields | None = None) -> AcceptedView:
    """Go back to the one in use before, unless the gate refuses it.

    It is sent even where the gate cannot judge it: α unknown, or the loop open.
    """
    return await accepted(service, Rollback(), reconstructors=_ALL)


@router.put("/mode", status_code=202)
async def mode(service: ServiceDep, body: ModeRequest) -> AcceptedView:
    """Choose how much the service may do by itself."""
    return await accepted(service, SetMode(mode=body.mode))


@router.post("/loop", status_code=202)
async def loop(service: ServiceDep, body: LoopBody) -> AcceptedView:
    """Open or close the loop, set gains by groups of modes, its leak, how many modes it controls.

    The answer comes when the RTC has accepted; 409 with its reason when it refuses. The state shows
    the loop as the RTC's next status tells it.
    """
    asked = body.fields()
    loop = asked.pop("loop")
    if body.gains is not None:
        asked["gains"] = tuple(GainGroup(**group.fields()) for group in body.gains)
    return await accepted(service, SetLoop(closed=loop and loop == "closed", **asked))


@router.post("/loop/ramp", status_code=202)
async def ramp(service: ServiceDep, body: RampBody | None = None) -> AcceptedView:
    """Have the RTC find, for each group of modes, the gain of least residual slopes.

    The answer comes when the RTC has begun; 409 with its reason when it refuses. What it chose is
    seen in the gains of the state, which change while it tries, too.
    """
    asked = (body or RampBody()).fields()
    if asked["groups"] is not None:
        asked["groups"] = tuple((group.first, group.last) for group in asked["groups"])
    return await accepted(service, Ramp(**asked))


@router.post("/acquisition", status_code=202)
async def acquisition(service: ServiceDep, body: AcquisitionBody) -> AcceptedView:
    """Find the registration from nothing, in any mode: its matrices need no further approval.

    The loop is opened, smooth modes are dithered to find the mirror and others to confirm it, and
    the loop closes on as many modes as the gate allows, then on more.
    """
    command = Acquire() if body.action == "start" else AbortAcquisition()
    return await accepted(service, command)


@observatory.put("/pointing", status_code=202)
async def pointing(service: ServiceDep, body: PointingRequest) -> AcceptedView:
    """Say where the telescope looks, at least whenever it has moved by a degree.

    The registration moves with it. An RTC that says so in its status overrules this.
    """
    return await accepted(service, SetPointing(pointing=Pointing(**body.fields())))
