"""What outlives the service of its tracking."""

from __future__ import annotations

from dataclasses import dataclass

from service.state.acquisition import Acquisition
from service.state.pointing import Pointing
from service.state.registration import Registration


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Saved:
    """What a service leaves to the one after it, besides its products."""

    system: str
    """The ``{system}`` of the wire."""

    saved_ns_utc: int
    """When, by the service's clock."""

    session: str | None
    """The RTC's; None: none was there."""

    in_use: str | None
    """Id of the matrix the RTC multiplied with; None: unknown."""

    pointing: Pointing | None
    """Of the telescope; None: nobody had told."""

    registration: Registration | None
    """Without the window that may be waiting for another: that one will not come. None: an
    acquisition has forgotten it, and found no other yet."""

    acquisition: Acquisition | None = None
    """One under way, or over without an α; None: neither."""
