"""Telemetry kept on request: begin a recording, see how far it is, end it, take it away."""

from __future__ import annotations

from collections.abc import Awaitable
from dataclasses import dataclass, replace
from typing import Annotated, TypeVar

from fastapi import APIRouter, Path, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse

from service.archive.recordings import RecordingRecord
from service.errors import PyrcalError
from service.runtime.telemetry_recorder import RecordingChoice
from service.tracking.commands import Instruction
from service.web.commands import AcceptedView, Client, ClientDep, Said, body
from service.web.problems import COMMAND, INVALID, UNKNOWN
from service.web.unchanged import not_modified, tag_of
from service.web.views import ServiceDep, answer, define_view, found_or_refuse, shows

T = TypeVar("T")

router = APIRouter(prefix="/v1", tags=["what it has kept"], responses={**INVALID})

RecordingId = Annotated[str, Path(alias="id", max_length=128, description="Id of a recording")]

RECORDING = define_view("RecordingView", RecordingRecord)


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingList:
    """Telemetry that was kept on request."""

    recordings: tuple[RecordingRecord, ...]
    """Oldest first."""


RECORDINGS = define_view("RecordingsView", RecordingList)


class RecordingAcceptedView(AcceptedView):
    """A recording that has begun."""

    id: str
    """Of the recording."""


async def _tried(client: Client, name: str, instruction: Instruction, order: Awaitable[T]) -> T:
    """Wait for an order; it is on record, and so is why it is refused."""
    entry = client.actor.entry(name, by=instruction.by, why=instruction.reason)
    try:
        done = await order
    except PyrcalError as error:
        client.service.audit(replace(entry, name=f"{name}.refused", answer=str(error)))
        raise
    client.service.audit(replace(entry, text=getattr(done, "id", "")))
    return done


@router.post("/recordings", status_code=202, responses={**COMMAND})
async def begin(
    client: ClientDep, choice: Annotated[RecordingChoice, body(RecordingChoice)]
) -> RecordingAcceptedView:
    """Keep the telemetry that comes from now on, for a time, and what came just before.

    The service holds the last seconds in memory: with ``before_s`` they are in it, and with a
    ``duration_s`` of 0 nothing else.
    The file is what ``pyrcal sim --replay`` plays and ``pyrcal archive aot`` reads.
    """
    who = client.actor.entry("", by=choice.by).who
    recordings = client.service.recordings
    begun = recordings.begin(choice.duration_s, who, choice.reason, choice.before_s)
    made = await _tried(client, "recording.begin", choice, begun)
    past = f"the last {made.before_s:.1f} s, and " if choice.before_s else ""
    text = f"{made.id} keeps {past}telemetry for {made.duration_s:g} s"
    accepted = client.accepted(text, recording=f"/v1/recordings/{made.id}")
    return RecordingAcceptedView(id=made.id, **accepted.model_dump())


@router.get("/recordings", responses={200: shows(RECORDINGS)})
async def recordings(service: ServiceDep) -> Response:
    """Return the telemetry that was kept on request, oldest first."""
    return answer(RecordingList(recordings=await run_in_threadpool(service.recordings.all)))


@router.get("/recordings/{id}", responses={200: shows(RECORDING), **UNKNOWN})
async def recording(service: ServiceDep, recording_id: RecordingId) -> Response:
    """Return how far a recording is."""
    every = await run_in_threadpool(service.recordings.all)
    found = next((one for one in every if one.id == recording_id), None)
    return answer(found_or_refuse(found, f"unknown recording {recording_id}"))


@router.post("/recordings/{id}/end", status_code=202, responses={**COMMAND, **UNKNOWN})
async def end(client: ClientDep, recording_id: RecordingId, instruction: Said) -> AcceptedView:
    """End a recording before its time; what is in it is kept."""
    recordings = client.service.recordings
    reason = f"{instruction.by or client.actor.key or 'an operator'} has ended it"
    record = await _tried(
        client, "recording.end", instruction, recordings.end(reason, recording_id)
    )
    text = f"{recording_id} has ended: {record.n_bytes / 1e6:.0f} MB"
    return client.accepted(text, recording=f"/v1/recordings/{recording_id}")


@router.delete("/recordings/{id}", status_code=202, responses={**COMMAND, **UNKNOWN})
async def remove(client: ClientDep, recording_id: RecordingId, instruction: Said) -> AcceptedView:
    """Remove a recording that has ended: it is gone for good."""
    removed = client.service.recordings.remove(recording_id)
    await _tried(client, "recording.remove", instruction, removed)
    return client.accepted(f"{recording_id} is removed", recordings="/v1/recordings")


@router.get(
    "/recordings/{id}/file",
    response_class=Response,
    responses={
        200: {
            "description": "HDF5, as docs/rtc.md and pyrcal sim have recordings",
            "content": {"application/x-hdf5": {"schema": {"type": "string", "format": "binary"}}},
        },
        **COMMAND,
        **UNKNOWN,
    },
)
async def file(request: Request, service: ServiceDep, recording_id: RecordingId) -> Response:
    """Return a recording that has ended."""
    path = await run_in_threadpool(service.recordings.file, recording_id)
    tag = tag_of(recording_id).removeprefix("W/")  # a download may be resumed by a strong one
    headers = {"ETag": tag}
    return not_modified(request, tag) or FileResponse(
        path, media_type="application/x-hdf5", filename=path.name, headers=headers
    )
