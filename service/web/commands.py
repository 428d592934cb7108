"""What an operator asks of the service, and what the observatory tells it.

A body is read straight into the record that the tracker obeys, all faults at once. Each answer is
202 and says in one sentence what was done and, where an RTC answers within some seconds, what it
said. What takes longer is seen in the state and in the events.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Depends, Path, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Discriminator, TypeAdapter, ValidationError
from pydantic_core import from_json
from starlette.datastructures import MutableHeaders

from service.archive import Actor
from service.errors import StaleError, UntaggedError
from service.runtime.supervisor import Supervisor
from service.tracking.commands import (
    AbortAcquisition,
    AcknowledgeAlarm,
    Acquire,
    Approve,
    Command,
    Instruction,
    MuteAlarm,
    MuteTime,
    Publish,
    Ramp,
    Reject,
    ReportedValue,
    Resume,
    Rollback,
    SeenAlarm,
    SetLoop,
    SetMode,
    SetPointing,
    SetValue,
    StartDither,
    StopDither,
    StopEverything,
    UnmuteAlarm,
)
from service.tracking.state import TrackerState
from service.web.authentication import actor_of
from service.web.numbers import MatrixId
from service.web.problems import COMMAND, DECISION, INVALID, UNKNOWN
from service.web.views import RECONSTRUCTORS, ServiceDep, found_or_refuse, tagged

# --- what is asked: JSON, read into a record


JSON = "application/json"

Asked = TypeVar("Asked", bound=Instruction)


class Body:
    """What a request has to say, as a command; a dependency of a route.

    Parameters
    ----------
    kind
        The command, or a union of several told apart by their ``action``.
    """

    def __init__(self, kind: Any) -> None:  # noqa: ANN401  of the type of a type
        self.adapter = TypeAdapter[Any](kind)
        self.required = not self._reads(b"{}")

    async def __call__(self, request: Request) -> Any:  # noqa: ANN401  the command
        """Return the command; without a body, one that leaves all to the service.

        Raises
        ------
        RequestValidationError
            If it is none: every fault, and where it is.
        """
        raw = await request.body()
        if not raw:
            if self.required:
                raise RequestValidationError([{"type": "missing", "loc": ("body",)}])
            raw = b"{}"
        elif request.headers.get("content-type", "").partition(";")[0].strip().lower() != JSON:
            # a page from elsewhere may send anything else without being asked
            raise RequestValidationError([{"type": "not_json", "loc": ("body",), "input": raw}])
        try:
            return self.adapter.validate_json(raw)
        except ValidationError as error:
            raise RequestValidationError(_faults(error, raw)) from None

    def _reads(self, raw: bytes) -> bool:
        try:
            self.adapter.validate_json(raw)
        except ValidationError:
            return False
        return True


def body(kind: Any) -> Any:  # noqa: ANN401  as FastAPI has it
    """Return what makes a parameter of a route the body of the request."""
    return Depends(Body(kind))


Said = Annotated[Instruction, body(Instruction)]
"""The body of a request whose path says all the rest."""


def about(kind: type[Asked], instruction: Instruction, **more: str) -> Asked:
    """Return the command that says the same, and what the path or the service adds."""
    return kind(**instruction.as_fields(), **more)


Where = tuple[int | str, ...]


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a fault is in the JSON."""

    path: Where
    tried: tuple[tuple[Where, int | str], ...]
    """Alternatives of unions that led there, and where each union is."""


def _faults(error: ValidationError, raw: bytes) -> list[dict[str, Any]]:
    """Return all faults, each where it is in the body.

    Of a union only the alternatives count that fit best; pydantic names them all.
    """
    try:
        whole = from_json(raw)
    except ValueError:
        whole = None
    found = [
        (_place(fault["loc"], whole, missing=fault["type"] == "missing"), fault)
        for fault in error.errors(include_url=False)
    ]
    depths: dict[Where, dict[int | str, int]] = {}
    for place, _ in found:
        for where, branch in place.tried:
            deepest = depths.setdefault(where, {})
            deepest[branch] = max(deepest.get(branch, 0), len(place.path))
    joined: dict[Where, dict[str, Any]] = {}
    for place, fault in found:
        if any(depths[where][one] < max(depths[where].values()) for where, one in place.tried):
            continue
        before = joined.get(place.path)
        if before is None or (_is_of_type(before) and not _is_of_type(fault)):
            joined[place.path] = {**fault, "loc": ("body", *place.path)}
        elif _is_of_type(before):
            before["msg"] += f" or {fault['msg'].removeprefix('Input should be ')}"
    return list(joined.values())


def _place(loc: Where, value: Any, *, missing: bool) -> _Place:  # noqa: ANN401  as JSON has it
    path: Where = ()
    tried: list[tuple[Where, int | str]] = []
    for k, part in enumerate(loc):
        inside = isinstance(value, dict) and part in value
        if inside or (isinstance(value, list) and isinstance(part, int) and part < len(value)):
            value = value[part]
        elif not missing or k < len(loc) - 1:
            tried.append((path, part))
            continue
        path = (*path, part)
    return _Place(path, tuple(tried))


def _is_of_type(fault: Mapping[str, Any]) -> bool:
    """Return whether a fault is that the value is something else altogether."""
    kind: str = fault["type"]
    return kind == "enum" or kind.endswith("_type")


# --- who asks, and for what


router = APIRouter(
    prefix="/v1",
    tags=["what an operator asks of it"],
    responses={**COMMAND, **INVALID},
)

observatory = APIRouter(
    prefix="/v1", tags=["what the observatory tells it"], responses={**COMMAND, **INVALID}
)

_BY_ACTION = Discriminator("action")
_DITHER = body(Annotated[StartDither | StopDither, _BY_ACTION])
_ACQUISITION = body(Annotated[Acquire | AbortAcquisition, _BY_ACTION])


class AcceptedView(BaseModel):
    """What came of an order."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    text: str
    """What was done, and what the RTC has said to it within some seconds."""

    links: dict[str, str]
    """Where to look for what becomes of it."""


@dataclass(frozen=True, slots=True)
class Client:
    """Whoever gives orders in a request."""

    service: Supervisor
    """That is to obey."""

    actor: Actor
    seen: str | None
    """ETags of what the order was decided on; None: not told."""

    strict: bool
    """Whether an order that decides about something is refused without them."""

    headers: MutableHeaders
    """Of the answer."""

    async def orders(self, command: Command, **links: str) -> AcceptedView:
        """Hand a command on; say what was done, and where to look for what becomes of it."""
        return await self._orders(command, self.actor, links)

    async def decides(
        self, command: Command, *shown: Callable[[TrackerState], Response], **links: str
    ) -> AcceptedView:
        """Do the same, if one of what is ``shown`` is still what whoever decides has seen."""
        actor = replace(self.actor, check=lambda: self._check(shown))
        return await self._orders(command, actor, links)

    def _check(self, shown: Sequence[Callable[[TrackerState], Response]]) -> None:
        if self.seen is None:
            if self.strict:
                raise UntaggedError("found no If-Match, expected the ETag of what is decided on")
            return
        state = self.service.snapshot().tracker
        now = [each(state).headers["ETag"] for each in shown]
        if self.seen != "*" and not {tag.strip() for tag in self.seen.split(",")} & {*now}:
            told = " or ".join(now)
            raise StaleError(f"found If-Match {self.seen:.80}, it is {told} now: look again")

    async def _orders(self, command: Command, actor: Actor, links: dict[str, str]) -> AcceptedView:
        if actor.key:
            by = f"{command.by} ({actor.key})" if command.by else actor.key
            command = replace(command, by=by)
        text = await self.service.submit(command, actor)
        usual = {"state": "/v1/state", "events": "/v1/events"}
        accepted = self.accepted(text, **(links or usual))
        return accepted.model_copy(update={"links": usual | links})

    def accepted(self, text: str, **links: str) -> AcceptedView:
        """Return what came of an order; the first link is where to look for what was begun."""
        self.headers["Location"] = next(iter(links.values()))
        return AcceptedView(text=text, links=links)


async def _client_of(request: Request, response: Response, service: ServiceDep) -> Client:
    sent = request.headers
    strict = "handling=strict" in sent.get("prefer", "").replace(" ", "").lower()
    return Client(service, actor_of(request), sent.get("if-match"), strict, response.headers)


ClientDep = Annotated[Client, Depends(_client_of)]
"""Whoever gives the order."""


def _link(matrix_id: str) -> str:
    return f"/v1/reconstructors/{matrix_id}"


_ALL = "/v1/reconstructors"

AlarmName = Annotated[str, Path(max_length=128)]


@router.post("/dither", status_code=202)
async def dither(
    client: ClientDep, command: Annotated[StartDither | StopDither, _DITHER]
) -> AcceptedView:
    """Start or stop the dither."""
    return await client.orders(command)


def _one(matrix_id: str) -> Callable[[TrackerState], Response]:
    """Return what shows a reconstructor."""
    return lambda state: tagged(
        found_or_refuse(state.reconstructor(matrix_id), f"unknown reconstructor {matrix_id}")
    )


def _all(state: TrackerState) -> Response:
    return tagged(state, RECONSTRUCTORS)


def _before(state: TrackerState) -> Response:
    """Return what shows the reconstructor that was in use before; where there is none, all.

    It stays as it is while the one in use is judged and others are proposed.
    """
    before = state.reconstructor(state.previous or "")
    return _all(state) if before is None else tagged(before)


_DECIDES: dict[int | str, Any] = {**UNKNOWN, **DECISION}


@router.post("/reconstructors/{id}/approve", status_code=202, responses=_DECIDES)
async def approve(client: ClientDep, matrix_id: MatrixId, instruction: Said) -> AcceptedView:
    """Publish a proposed reconstructor."""
    command = about(Approve, instruction, id=matrix_id)
    return await client.decides(command, _one(matrix_id), reconstructor=_link(matrix_id))


@router.post("/reconstructors/{id}/reject", status_code=202, responses=_DECIDES)
async def reject(client: ClientDep, matrix_id: MatrixId, instruction: Said) -> AcceptedView:
    """Discard a proposed reconstructor; the reason is kept with it."""
    command = about(Reject, instruction, id=matrix_id)
    return await client.decides(command, _one(matrix_id), reconstructor=_link(matrix_id))


@router.post("/reconstructors/{id}/publish", status_code=202, responses=_DECIDES)
async def publish(client: ClientDep, matrix_id: MatrixId, instruction: Said) -> AcceptedView:
    """Send a known reconstructor again, under a new id, unless the gate refuses it now.

    What has been in use is sent even where the gate cannot judge it: α unknown, or the loop open.
    """
    command = about(Publish, instruction, id=matrix_id)
    return await client.decides(command, _one(matrix_id), reconstructors=_ALL)


@router.post("/rollback", status_code=202, responses={**DECISION})
async def rollback(client: ClientDep, command: Annotated[Rollback, body(Rollback)]) -> AcceptedView:
    """Go back to the one in use before, unless the gate refuses it; with ``anyway`` even then.

    It is sent even where the gate cannot judge it: α unknown, or the loop open.
    """
    return await client.decides(command, _all, _before, reconstructors=_ALL)


@router.post("/stop", status_code=202)
async def stop(
    client: ClientDep, command: Annotated[StopEverything, body(StopEverything)]
) -> AcceptedView:
    """Stop everything: whatever runs is ended, no dither, nothing made or sent until released.

    The service goes on to look at telemetry. A restart releases nothing. Of the RTC nothing is
    asked but that a dither ends and, at once, what gives back a loop that was opened for an
    acquisition. It is carried out even where the disk refuses to record it.
    """
    return await client.orders(command)


@router.post("/resume", status_code=202)
async def resume(client: ClientDep, command: Annotated[Resume, body(Resume)]) -> AcceptedView:
    """Release what was stopped: mode and dither are as they were ordered before."""
    return await client.orders(command)


@router.post("/alarms/{name}/acknowledge", status_code=202, responses={**UNKNOWN})
async def acknowledge(
    client: ClientDep, name: AlarmName, instruction: Annotated[SeenAlarm, body(SeenAlarm)]
) -> AcceptedView:
    """Say that an alarm is known of: it stays while it lasts; one that is over goes."""
    return await client.orders(about(AcknowledgeAlarm, instruction, name=name), alarms="/v1/alarms")


@router.post("/alarms/{name}/mute", status_code=202, responses={**UNKNOWN})
async def mute(
    client: ClientDep, name: AlarmName, instruction: Annotated[MuteTime, body(MuteTime)]
) -> AcceptedView:
    """Show an alarm no more for a time; what it forbids, it goes on to forbid."""
    return await client.orders(about(MuteAlarm, instruction, name=name), alarms="/v1/alarms")


@router.post("/alarms/{name}/unmute", status_code=202, responses={**UNKNOWN})
async def unmute(client: ClientDep, name: AlarmName, instruction: Said) -> AcceptedView:
    """Show an alarm again."""
    return await client.orders(about(UnmuteAlarm, instruction, name=name), alarms="/v1/alarms")


@router.put("/mode", status_code=202)
async def mode(client: ClientDep, command: Annotated[SetMode, body(SetMode)]) -> AcceptedView:
    """Choose how much the service may do by itself."""
    return await client.orders(command)


@router.post("/loop", status_code=202)
async def loop(client: ClientDep, command: Annotated[SetLoop, body(SetLoop)]) -> AcceptedView:
    """Open or close the loop, set gains by groups of modes, its leak, how many modes it controls.

    The answer comes when the RTC has accepted; 409 with its reason when it refuses. The state shows
    the loop as the RTC's next status tells it.
    """
    return await client.orders(command)


@router.post("/loop/ramp", status_code=202)
async def ramp(client: ClientDep, command: Annotated[Ramp, body(Ramp)]) -> AcceptedView:
    """Have the RTC find, for each group of modes, the gain of least residual slopes.

    The answer comes when the RTC has begun; 409 with its reason when it refuses. What it chose is
    seen in the gains of the state, which change while it tries, too.
    """
    return await client.orders(command)


@router.post("/acquisition", status_code=202)
async def acquisition(
    client: ClientDep, command: Annotated[Acquire | AbortAcquisition, _ACQUISITION]
) -> AcceptedView:
    """Find the registration from nothing, in any mode: its matrices need no further approval.

    The loop is opened, smooth modes are dithered to find the mirror and others to confirm it, and
    the loop closes on as many modes as the gate allows, then on more.
    """
    return await client.orders(command)


@observatory.put("/values/{name}", status_code=202, responses={**UNKNOWN})
async def value(
    client: ClientDep, name: AlarmName, said: Annotated[ReportedValue, body(ReportedValue)]
) -> AcceptedView:
    """Tell a value that operators' own rules ask for; it counts for the time that is said.

    What is told again unchanged is not written into the audit trail again.
    """
    return await client.orders(about(SetValue, said, name=name), alarms="/v1/alarms")


@observatory.put("/pointing", status_code=202)
async def pointing(
    client: ClientDep, command: Annotated[SetPointing, body(SetPointing)]
) -> AcceptedView:
    """Say where the telescope looks, at least whenever it has moved by a degree.

    The registration moves with it. An RTC that says so in its status overrules this.
    """
    return await client.orders(command)
