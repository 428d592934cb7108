"""What an operator asks of the service.

Each answer is 202: the command was accepted and set in motion. Whether it has come to its end
is seen in the state and in the events.
"""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Body, Path
from pydantic import BaseModel, ConfigDict, Field, model_validator

from service.events import (
    Approve,
    Command,
    Publish,
    Refit,
    Reject,
    Rollback,
    SetMode,
    StartDither,
    StopDither,
)
from service.reactions.dither_choice import total_m
from service.routes.modes import Modes
from service.routes.problems import COMMAND, INVALID, UNKNOWN
from service.routes.service import Service, ServiceDep
from service.routes.views import View
from service.state import DitherKind, Mode, ModeSet

router = APIRouter(
    prefix="/v1",
    tags=["what an operator asks of it"],
    responses={**COMMAND, **INVALID},
)

MatrixId = Annotated[str, Path(alias="id", description="Id of a reconstructor")]
Positive = Annotated[float, Field(gt=0.0)]

MOST_SINES = 64


class Request(BaseModel):
    """The body of a command; an unknown field is refused."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )


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


class AcceptedView(View):
    """A command that was set in motion."""

    text: str
    """What was."""

    links: dict[str, str]
    """Where to look for what becomes of it."""


async def accepted(service: Service, command: Command, **links: str) -> AcceptedView:
    """Hand a command on; say what was set in motion and where to look for what becomes of it."""
    text = await service.submit(command)
    return AcceptedView(text=text, links={"state": "/v1/state", "events": "/v1/events", **links})


def _link(matrix_id: str) -> str:
    return f"/v1/reconstructors/{matrix_id}"


_ALL = "/v1/reconstructors"


@router.post("/refit", status_code=202)
async def refit(service: ServiceDep, body: RefitRequest | None = None) -> AcceptedView:
    """Compute a reconstructor for the current registration; gate and mode apply as always."""
    n_modes = None if body is None else body.n_modes
    return await accepted(service, Refit(n_modes=n_modes), reconstructors=_ALL)


@router.post("/dither", status_code=202)
async def dither(
    service: ServiceDep,
    body: Annotated[StartDitherRequest | StopDitherRequest, Body(discriminator="action")],
) -> AcceptedView:
    """Start or stop the dither."""
    if isinstance(body, StopDitherRequest):
        return await accepted(service, StopDither())
    modes = body.modes
    command = StartDither(
        kind=body.kind,
        modes=tuple(modes) if isinstance(modes, list) else modes,
        amplitude_m=body.amplitude_m,
        total_m=body.total_amplitude_m,
        frequency_hz=None if body.frequency_hz is None else tuple(body.frequency_hz),
        duration_s=body.duration_s,
        over_budget=body.over_budget,
    )
    answer = await accepted(service, command)
    state = service.snapshot().tracker
    if state.dither is None:
        return answer
    cost = f"{1e9 * total_m(state.dither):.3g} nm RMS in all"
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
    command = Reject(id=matrix_id, reason="" if body is None else body.reason)
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
