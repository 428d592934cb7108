"""The light source: a star through the atmosphere, or a fibre in the dome.

By night (``onsky``) a star is seen through turbulence, once over the mirror, past the spider. By
day (``daytime``) a fibre's light goes over the mirror, to a retro-reflector and back over the
mirror: a command counts twice. There is no atmosphere, so a turbulence is played on the mirror
(Heritier et al. 2018, section 5), and what the sensor sees besides are vibrations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.errors import ConfigurationError
from service.model.pupil import PupilGrid
from service.wire import Pointing
from sim_rtc.telescope.atmosphere import PhaseResponse
from sim_rtc.telescope.mirror import modal_content

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_CELL_SAMPLES = 4
"""Samples across a cell of the pupil, each of them grey at the edge of a shadow."""


class SceneKind(StrEnum):
    """Kinds of scenes."""

    ONSKY = "onsky"
    """A star: atmosphere, the mirror seen once, spider arms if any."""

    DAYTIME = "daytime"
    """A fibre and a retro-reflector: the mirror seen twice, turbulence played on it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spiders:
    """Arms that hold the secondary: straight shadows from the centre outwards, evenly spread."""

    n_arms: int
    width_m: float
    """Width of each shadow in the pupil plane, metres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """The light source and the air before it."""

    kind: SceneKind = SceneKind.ONSKY
    spiders: Spiders | None = None

    def __post_init__(self) -> None:
        """Refuse settings that no dome allows.

        Raises
        ------
        ConfigurationError
            If the fibre is to shine through spider arms.
        """
        if self.kind is SceneKind.DAYTIME and self.spiders is not None:
            raise ConfigurationError(
                "--spiders: the fibre by day shines past no arm; expected --scene onsky"
            )

    @property
    def passes(self) -> int:
        """Number of times the light meets the mirror; a command's slopes grow by it."""
        return 2 if self.kind is SceneKind.DAYTIME else 1

    def light(self, pupil: PupilGrid, subaperture_m: float) -> PupilGrid:
        """Return the pupil with less light where an arm obstructs it."""
        if self.spiders is None:
            return pupil
        return replace(
            pupil,
            amplitude=pupil.amplitude * (1.0 - _shadow(pupil, self.spiders, subaperture_m)),
        )


class PlayedTurbulence:
    """Converts turbulence over the pupil into modal commands that play it on the mirror.

    The light meets the mirror twice, so half of it is played: the sensor then sees the requested
    seeing. The commands are those of an aligned mirror, as a file of them would be.
    """

    def __init__(self, modes: Array32, weights: Array, *, passes: int) -> None:
        """Take the modes ``(n_points, n_modes)``, metres per metre of command, seen once."""
        content = modal_content(modes, weights)
        self.commands_per_phase: Array32 = (content / passes).astype(np.float32)
        """``(n_modes, n_points)`` metres of command per metre of turbulence."""
        self.response = PhaseResponse(self.commands_per_phase)


def _shadow(pupil: PupilGrid, spiders: Spiders, subaperture_m: float) -> Array:
    """Return the share of every cell ``(n, n)`` that an arm hides."""
    inside = ((np.arange(_CELL_SAMPLES) + 0.5) / _CELL_SAMPLES - 0.5) / pupil.sampling
    fine = (pupil.coordinates[:, None] + inside).reshape(-1) * subaperture_m
    x, y = fine[None, :], fine[:, None]
    hidden = np.zeros((len(fine), len(fine)))
    step = fine[1] - fine[0]
    for k in range(spiders.n_arms):
        # The first arm points up, as one of a telescope's does.
        angle = np.pi / 2 + 2 * np.pi * k / spiders.n_arms
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        covered = np.clip((spiders.width_m / 2 - np.abs(across)) / step + 0.5, 0.0, 1.0)
        hidden = np.maximum(hidden, np.where(along >= 0.0, covered, 0.0))
    n = len(pupil.coordinates)
    return np.asarray(hidden.reshape(n, _CELL_SAMPLES, n, _CELL_SAMPLES).mean(axis=(1, 3)))


SLEW_DEG_PER_S: Final = 1.0
"""A large telescope crosses the sky in minutes."""

_HIGHEST_DEG: Final = 90.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Elevation:
    """The pointing over a run; it moves the registration where the instrument has a law of it."""

    start_deg: float = 60.0
    rate_deg_per_minute: float = 0.0
    """Rate of tracking, degrees per minute; the sky turns by 0.25."""

    slews: tuple[tuple[float, float], ...] = ()
    """Start of each slew, seconds of loop time, and its change of elevation, degrees."""

    azimuth_deg: float = 180.0
    azimuth_rate_deg_per_minute: float = 0.0

    @property
    def corners_s(self) -> tuple[float, ...]:
        """Times at which it begins or ceases to slew."""
        ends = (begin_s + abs(by_deg) / SLEW_DEG_PER_S for begin_s, by_deg in self.slews)
        return tuple(sorted((*(begin_s for begin_s, _ in self.slews), *ends)))

    def at(self, time_s: float) -> Pointing:
        """Return the pointing at this time; it goes no further than the zenith."""
        elevation = self.start_deg + self.rate_deg_per_minute * time_s / 60.0
        for begin_s, by_deg in self.slews:
            done_deg = min(max(time_s - begin_s, 0.0) * SLEW_DEG_PER_S, abs(by_deg))
            elevation += done_deg if by_deg > 0.0 else -done_deg
        azimuth = self.azimuth_deg + self.azimuth_rate_deg_per_minute * time_s / 60.0
        return Pointing(elevation_deg=min(max(elevation, 0.0), _HIGHEST_DEG), azimuth_deg=azimuth)
