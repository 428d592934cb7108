"""The interaction matrix as one RTC would measure it: its own order, axes and signs of slopes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.slopes import rtc_mask, to_rtc

Array = NDArray[Any]


class RtcInteractionModel(InteractionModel):
    """Interaction matrices whose rows stand as the RTC lists its slopes.

    What travels to and from the RTC (telemetry, measured matrices, reconstructors) stays as it is;
    only the model speaks two languages.
    """

    @override
    def interaction_matrix(self, alpha: Misregistration) -> Array:
        """Return D(α), ``(n_slopes, n_modes)``, rows in the RTC's order and signs."""
        return self._listed(super().interaction_matrix(alpha))

    @override
    def derivatives(self, alpha: Misregistration) -> Array:
        """Return dD/dα ``(4, n_slopes, n_modes)``, rows in the RTC's order and signs."""
        return np.stack([self._listed(matrix) for matrix in super().derivatives(alpha)])

    @override
    def unknown_rows(self, alpha: Misregistration) -> NDArray[np.bool_]:
        """Return which of the RTC's slopes lie near unknown surface, ``(n_slopes,)``."""
        marks = self._listed(super().unknown_rows(alpha).astype(np.float32))
        return np.asarray(marks != 0.0)

    def _listed(self, rows: Array) -> Array:
        recipe = self.instrument.slopes
        mask = rtc_mask(self.valid, recipe.assumed_orientation)
        return to_rtc(rows, recipe.order, recipe.assumed_orientation, mask)
