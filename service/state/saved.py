"""What outlives the service of its tracking."""

from __future__ import annotations

from dataclasses import dataclass

from service.state.acquisition import Acquisition
from service.state.pointing import Pointing
from service.state.registration import Registration
from service.state.tracker import Mode


@dataclass(frozen=True, slots=True, kw_only=True)
class Orders:
    """What an operator has ordered that a restart of the service does not undo."""

    mode: Mode | None = None
    """None: that of the settings holds."""

    settings_mode: Mode | None = None
    """What the settings said then; where they say something else now, they have the last word."""

    dither_stopped: bool = False


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

    orders: Orders | None = None
    """None: nothing was ordered that the settings do not say."""

    @property
    def tells_of_alpha(self) -> bool:
        """Whether it says what α was, or why it is not known."""
        return self.registration is not None or self.acquisition is not None
