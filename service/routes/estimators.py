"""What each way of looking at telemetry can tell, and what it cannot."""

from __future__ import annotations

from fastapi import APIRouter

from service.routes.problems import INVALID
from service.routes.views import View
from service.state import Source
from service.telemetry.estimator import LOCK_IN, PASSIVE, RANDOM, Determines

router = APIRouter(prefix="/v1", tags=["what the service knows"], responses={**INVALID})

_OF: dict[Source, Determines] = {
    Source.LOCK_IN: LOCK_IN,
    Source.RANDOM: RANDOM,
    Source.PASSIVE: PASSIVE,
}


class EstimatorView(View):
    """One way of looking at telemetry; ``source`` in the history of α names it."""

    source: Source
    """"lock-in", "random" or "passive"."""

    parameters: tuple[str, ...]
    """Which of the four it can tell."""

    missing: tuple[str, ...]
    """Which it cannot, or not as well as a registration needs."""

    text: str
    """What to know of it."""


class EstimatorsView(View):
    """All of them."""

    estimators: tuple[EstimatorView, ...]


@router.get("/estimators")
async def estimators() -> EstimatorsView:
    """Return what the estimators can tell of the registration, and what they cannot."""
    return EstimatorsView(
        estimators=tuple(
            EstimatorView(
                source=source,
                parameters=determines.parameters,
                missing=determines.missing,
                text=determines.text,
            )
            for source, determines in _OF.items()
        )
    )
