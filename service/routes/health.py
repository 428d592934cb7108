"""How the service is doing: for orchestrators and Prometheus."""

from __future__ import annotations

from http import HTTPStatus

from fastapi import APIRouter, Request, Response
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder
from pydantic import BaseModel

from service import __version__
from service.routes.metrics import SnapshotCollector
from service.routes.problems import problem, problem_response
from service.routes.service import ServiceDep

router = APIRouter(tags=["how it is doing"])


class HealthView(BaseModel):
    """The process runs and answers."""

    status: str
    version: str
    uptime_s: float


class ReadyView(BaseModel):
    """The service can do its work."""

    ready: bool
    reason: str


@router.get("/healthz")
async def healthz(service: ServiceDep) -> HealthView:
    """Answer as long as the process lives."""
    snapshot = service.snapshot()
    return HealthView(status="ok", version=__version__, uptime_s=snapshot.uptime_s)


@router.get(
    "/readyz",
    response_model=ReadyView,
    responses={503: problem_response("The service cannot do its work yet; the detail says why")},
)
async def readyz(request: Request, service: ServiceDep) -> ReadyView | Response:
    """Say whether the service can do its work, and what it waits for."""
    snapshot = service.snapshot()
    if not snapshot.ready:
        detail = snapshot.ready_reason
        return problem(request, HTTPStatus.SERVICE_UNAVAILABLE, "not-ready", detail)
    return ReadyView(ready=True, reason=snapshot.ready_reason)


@router.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {
            "description": "Prometheus text format, or OpenMetrics where Accept asks for it",
            "content": {"text/plain": {"schema": {"type": "string"}}},
        }
    },
)
async def metrics(request: Request, service: ServiceDep) -> Response:
    """Return everything that can be counted or measured, for Prometheus."""
    encode, content_type = choose_encoder(request.headers.get("accept", ""))
    registry = CollectorRegistry(auto_describe=False)
    registry.register(SnapshotCollector(service.snapshot))
    return Response(encode(registry), headers={"Content-Type": content_type})
