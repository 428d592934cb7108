"""An acquisition as it leaves over REST."""

from __future__ import annotations

from pydantic import Field

from service.routes.views import FourView, View
from service.state import AcquisitionStage


class AcquisitionView(View):
    """Finding the registration from nothing: under way, or how the last one ended."""

    stage: AcquisitionStage
    """"idle", "opening", "coarse", "confirming", "partial", "widening", "tracking", "failed",
    "aborted" or "interrupted" by the end of the service or of the link."""

    text: str
    """What it does, or how it ended and what to do."""

    under_way: bool
    """Whether the loop is its own."""

    started_ns_utc: int
    """0: there was none."""

    since_ns_utc: int
    """Since when it is in this stage."""

    held_off: bool
    """An operator ended it: none begins by itself; the text says until when."""

    commanded: bool
    """An operator asked for it."""

    n_attempts: int = Field(validation_alias="attempt")
    """How often the loop has been opened for it."""

    alpha: FourView | None
    """Found with the loop open; null: not yet."""

    n_modes: int
    """Modes of its reconstructor."""
