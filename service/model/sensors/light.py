"""Find the pupil in the mean light of a sensor, without a matrix."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from service.model.pupil import Illumination


@dataclass(frozen=True, slots=True, kw_only=True)
class PupilPosition:
    """Where the image of the pupil lies."""

    at: tuple[float, float]
    """x and y of their centre from that of the sensor's grid, subapertures."""

    sigma: tuple[float, float]
    """1 σ of both."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CannotTell:
    """The map does not say; a value, because it may well happen."""

    reason: str
    """What was found, and what would help."""


class Light(Protocol):
    """The light of one instrument's sensor; counts are in the axes of conventions.md."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the counts."""

    def counts_of(self, flux: bytes) -> NDArray[Any]:
        """Return the counts that a status carries.

        Raises
        ------
        ModelError
            If they are not this sensor's.
        """

    def counts(self, light: NDArray[Any]) -> NDArray[Any]:
        """Return a response's light as counts are laid out."""

    def turned(self, counts: NDArray[Any]) -> NDArray[Any]:
        """Return counts in the RTC's axes, in those of conventions.md."""

    def find_pupil(self, counts: NDArray[Any]) -> PupilPosition | CannotTell:
        """Return where the image of the pupil lies, at any shift that light can tell.

        Raises
        ------
        ModelError
            If the counts have another shape.
        """

    def illumination(self, counts: NDArray[Any], position: PupilPosition) -> Illumination:
        """Return how evenly the beam is lit.

        Raises
        ------
        ModelError
            If the counts have another shape, or are dark.
        """

    def relative(
        self, counts: NDArray[Any], position: PupilPosition
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the light over that of an even beam, ``(n, n)`` on the sensor, and where known."""
