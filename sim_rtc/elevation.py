"""Where the simulated telescope looks: it tracks, and it slews."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from service.wire import PointingStatus

SLEW_DEG_PER_S: Final = 1.0
"""A large telescope crosses the sky in minutes."""

_HIGHEST_DEG: Final = 90.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Elevation:
    """The elevation over a run; the azimuth stays, and neither moves the registration."""

    start_deg: float = 60.0
    rate_deg_per_minute: float = 0.0
    """Of tracking; the sky turns by 0.25."""

    slews: tuple[tuple[float, float], ...] = ()
    """When each begins, seconds of loop time, and by how many degrees it goes up."""

    azimuth_deg: float = 180.0

    def at(self, time_s: float) -> PointingStatus:
        """Return where the telescope looks at this time; it goes no further than the zenith."""
        elevation = self.start_deg + self.rate_deg_per_minute * time_s / 60.0
        for begin_s, by_deg in self.slews:
            done_deg = min(max(time_s - begin_s, 0.0) * SLEW_DEG_PER_S, abs(by_deg))
            elevation += done_deg if by_deg > 0.0 else -done_deg
        return PointingStatus(
            elevation_deg=min(max(elevation, 0.0), _HIGHEST_DEG), azimuth_deg=self.azimuth_deg
        )
