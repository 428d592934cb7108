"""Routes of orders and of the observatory's values.

The routes are made of the table of orders, ``service/commands.toml``. A body is read straight into
the record that the tracker obeys, all faults at once. Each answer is 202 and says in one sentence
what was done and, where an RTC replies within some seconds, its reply. What takes longer is seen
in the state and in the events.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from importlib.resources import files
from inspect import Parameter, Signature
from typing import Annotated, Any, ClassVar, Final, Union

from fastapi import APIRouter, Depends, Path, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Discriminator, TypeAdapter, ValidationError
from pydantic_core import from_json
from starlette.datastructures import MutableHeaders

from service.archive import Actor
from service.errors import StaleError, UntaggedError
from service.records import commands as instructions
from service.records.commands import Instruction
from service.records.events import new_id
from service.records.messages import Message
from service.records.operations import RefitJob
from service.records.state import TrackerState
from service.runtime.supervisor import Supervisor
from service.tracking.reconstructors import require_record
from service.tracking.references import require_references
from service.web import keys, matrices, measured, views
from service.web.authentication import actor_of, needs
from service.web.problems import COMMAND, DECISION, INVALID, UNKNOWN

# --- what is asked: JSON, read into a record


JSON = "application/json"


class Body:
    """Dependency of a route that reads a request's body as a command.

    Parameters
    ----------
    kind
        The command, or a union of several that differ in their ``action``.
    """

    def __init__(self, kind: Any) -> None:  # noqa: ANN401  of the type of a type
        self.adapter = TypeAdapter[Any](kind)
        # A command whose fields all have defaults may come without a body.
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


BodyDep = Annotated[Instruction, body(Instruction)]
"""The body of a request whose path says all the rest."""

Where = tuple[int | str, ...]


@dataclass(frozen=True, slots=True)
class _Place:
    """Place of a fault in the JSON."""

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


# --- the table of orders


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderRoute:
    """An order as ``service/commands.toml`` has it: that says what each of these is."""

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid"}

    call: str
    command: str | dict[str, str]
    text: str
    scope: keys.KeyScope = keys.KeyScope.OPERATE
    decides_on: tuple[str, ...] = ()
    follows: Mapping[str, str] = field(default_factory=dict)
    makes: str = ""
    tag: str = "orders"

    @property
    def kinds(self) -> tuple[type[Instruction], ...]:
        """Return the commands of the route, distinguished by ``action``."""
        names = [self.command] if isinstance(self.command, str) else self.command.values()
        return tuple(getattr(instructions, name) for name in names)

    @property
    def path(self) -> str:
        """Path of REST."""
        return self.call.partition(" ")[2]

    @property
    def method(self) -> str:
        """HTTP method."""
        return self.call.partition(" ")[0]

    @property
    def named(self) -> str:
        """The field of the command that the path names; empty: none."""
        return "".join(re.findall(r"{(\w+)}", self.path))

    @property
    def read(self) -> Any:  # noqa: ANN401  the type of a type
        """Type of the body: the command without what path or service fills in."""
        if len(self.kinds) > 1:
            return Annotated[Union[self.kinds], Discriminator("action")]  # noqa: UP007
        filled_in = {self.named, "id" if self.makes else ""}
        bases = self.kinds[0].__mro__
        # The base class without these fields, so that a client that sends them is refused.
        return next(base for base in bases if filled_in.isdisjoint(f.name for f in fields(base)))

    def commanded(self, instruction: Instruction, **given: str) -> Instruction:
        """Return the command of a body, and what path and service say besides."""
        known = {field.name for field in fields(self.kinds[0])}
        more = {name: value for name, value in given.items() if name in known}
        return self.kinds[0](**instruction.as_fields(), **more) if more else instruction


ORDERS: Final = TypeAdapter(dict[str, OrderRoute]).validate_python(
    tomllib.loads(files("service").joinpath("commands.toml").read_text("utf-8"))
)
"""Orders by the name of the operation."""


# --- who asks, and for what


class AcceptedView(BaseModel):
    """Result of an order."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    text: str
    """Result of the command, and the RTC's reply if it came within some seconds."""

    code: str
    """Code of the result."""

    values: dict[str, float | int | str]
    """Values in the text."""

    links: dict[str, str]
    """Paths where the consequences appear."""


class MatrixAcceptedView(AcceptedView):
    """A matrix that is being measured."""

    id: str
    """Id of the future matrix."""


class RefitAcceptedView(AcceptedView):
    """A reconstructor that is being computed."""

    id: str
    """Id of the job: ``GET /v1/refits/{id}`` has its result."""


_ALWAYS = {"state": "/v1/state", "events": "/v1/events"}


@dataclass(frozen=True, slots=True)
class Client:
    """The giver of orders in a request."""

    service: Supervisor
    """Service that executes the order."""

    actor: Actor
    seen: str | None
    """ETags of what the order was decided on; None if not sent."""

    strict: bool
    """True if an order that decides on something is refused without them."""

    headers: MutableHeaders
    """Headers of the response."""

    async def gives(self, order: OrderRoute, instruction: Any, name: str) -> AcceptedView:  # noqa: ANN401
        """Pass an order on; return its result, and the address of its progress.

        An order that decides on something is refused if that has changed since the client read it.
        """
        made = new_id(order.makes, self.service.snapshot().now_ns) if order.makes else ""
        command: Any = order.commanded(instruction, **{order.named or "id": name or made})
        actor = self.actor
        if order.decides_on:
            # Checked later, in the same step of the event loop in which the tracker gets the order.
            actor = replace(actor, check=lambda: self._check(order.decides_on, name))
        if actor.key:
            # The name is only a claim; the key is known.
            by = f"{command.by} ({actor.key})" if command.by else actor.key
            command = replace(command, by=by)
        message = await self.service.submit(command, actor, made)
        about = {order.named or "id": name or made}
        links = {what: where.format(**about) for what, where in order.follows.items()}
        self.headers["Location"] = next(iter((links | _ALWAYS).values()))
        kind = _ANSWERS.get(order.makes, AcceptedView)
        answered = _shown(message) | {"links": _ALWAYS | links, "id": made}
        return kind.model_validate(answered)

    def _check(self, decides_on: Sequence[str], name: str) -> None:
        if self.seen is None:
            if self.strict:
                raise UntaggedError("found no If-Match, expected the ETag of what is decided on")
            return
        state = self.service.snapshot().tracker
        now = [_SHOWN[what](state, name).headers["ETag"] for what in decides_on]
        if self.seen != "*" and not {tag.strip() for tag in self.seen.split(",")} & {*now}:
            current = " or ".join(now)
            raise StaleError(f"found If-Match {self.seen:.80}, it is {current} now: read it again")

    def accepted(self, message: Message, **links: str) -> AcceptedView:
        """Return the result of an order; the first link is to the work begun."""
        self.headers["Location"] = next(iter(links.values()))
        return AcceptedView.model_validate(_shown(message) | {"links": links})


def _shown(message: Message) -> dict[str, object]:
    return {"text": str(message), "code": message.code, "values": message.values}


async def _client_of(request: Request, response: Response, service: views.ServiceDep) -> Client:
    sent = request.headers
    strict = "handling=strict" in sent.get("prefer", "").replace(" ", "").lower()
    return Client(service, actor_of(request), sent.get("if-match"), strict, response.headers)


ClientDep = Annotated[Client, Depends(_client_of)]
"""Sender of the order."""


def _one(state: TrackerState, name: str) -> Response:
    return views.tagged(require_record(state, name))


def _all(state: TrackerState, _: str = "") -> Response:
    return views.tagged(state, views.RECONSTRUCTORS)


def _references(state: TrackerState, name: str) -> Response:
    return views.tagged(require_references(state, name))


def _before(state: TrackerState, _: str) -> Response:
    """Return what shows the reconstructor that was in use before; where there is none, all.

    It stays as it is while the one in use is judged and others are proposed.
    """
    before = state.reconstructor(state.previous or "")
    return _all(state) if before is None else views.tagged(before)


_SHOWN: Mapping[str, Callable[[TrackerState, str], Response]] = {
    "/v1/reconstructors/{id}": _one,
    "/v1/reconstructors": _all,
    "/v1/reconstructors/previous": _before,
    "/v1/references/{id}": _references,
}
"""Resources that an order may be decided on."""

# --- the routes


RefitId = Annotated[str, Path(alias="id", max_length=128, description="Id of a refit")]
_AlarmName = Annotated[str, Path(alias="name", max_length=128)]

_NAMED: Mapping[str, Any] = {
    "reconstructors": matrices.MatrixId,
    "references": matrices.ReferencesId,
    "alarms": _AlarmName,
    "values": _AlarmName,
    "measurements": measured.MeasurementId,
    "noisy-matrix": measured.NoisyId,
}
"""How a path names what an order is about, by what that is."""

_ANSWERS = {"refit": RefitAcceptedView, "im": MatrixAcceptedView, "noisy": MatrixAcceptedView}
"""To an order that begins something with an id, by the beginning of that."""

router = APIRouter(responses={**INVALID})


def _endpoint(order: OrderRoute) -> Callable[..., Awaitable[AcceptedView]]:
    """Return what answers an order, with the parameters that FastAPI is to read."""

    async def give(client: Client, instruction: Instruction, name: str = "") -> AcceptedView:
        return await client.gives(order, instruction, name)

    taken = {"client": ClientDep, "instruction": Annotated[Any, body(order.read)]}
    if order.named:
        taken["name"] = _NAMED[order.path.split("/")[2]]
    signature = Signature(
        [Parameter(name, Parameter.KEYWORD_ONLY, annotation=kind) for name, kind in taken.items()]
    )
    # FastAPI reads parameters from the signature, which differs from order to order.
    vars(give)["__signature__"] = signature
    return give


def _add(name: str, order: OrderRoute) -> None:
    unknown = UNKNOWN if order.named else {}
    decides = DECISION if order.decides_on else {}
    router.add_api_route(
        order.path,
        _endpoint(order),
        name=name,
        methods=[order.method],
        status_code=202,
        response_model=_ANSWERS.get(order.makes, AcceptedView),
        description=order.text,
        tags=[order.tag],
        responses={**COMMAND, **unknown, **decides},
        openapi_extra=dict(needs(order.scope)),
    )


for _name, _order in ORDERS.items():
    _add(_name, _order)


REFIT = views.define_view("RefitView", RefitJob)


@router.get("/v1/refits/{id}", tags=["orders"], responses={200: views.shows(REFIT), **UNKNOWN})
async def refit_job(service: views.ServiceDep, refit_id: RefitId) -> Response:
    """Return the progress of a refit, and the reconstructor it has made."""
    refits = service.snapshot().tracker.operations.refits
    job = next((job for job in refits if job.id == refit_id), None)
    refusal = f"refit {refit_id}: this service has begun no such refit"
    return views.answer(views.found_or_refuse(job, refusal))
