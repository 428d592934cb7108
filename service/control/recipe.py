"""What a reconstructor is made of, carried out and written down.

The recipe says how; the provenance says of what, so that whoever finds the matrix years later can
make it again.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.control.modal_gains import CalibrationGains
from service.control.reconstructor import MAX_CONDITION, Inversion, invert
from service.control.regularised import Prior, invert_with_prior
from service.errors import ModelError
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration


class Method(StrEnum):
    """How an interaction matrix is inverted."""

    SVD = "svd"
    """Least squares; singular values too weak are left out."""

    MAP = "map"
    """Least squares weighted by noise, with the turbulence as prior."""


class Source(StrEnum):
    """Where an interaction matrix comes from."""

    SYNTHETIC = "synthetic"
    """Computed by the model for a registration."""

    MEASURED = "measured"
    """Read off a sensor, noise included."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recipe:
    """How to invert an interaction matrix."""

    n_modes: int
    """Modes to control: the first ones of the basis."""

    method: Method = Method.SVD
    """How."""

    max_condition: float = MAX_CONDITION
    """SVD: singular values below the largest over this are left out."""

    prior: Prior | None = None
    """MAP: what is known of modes and noise."""

    def __post_init__(self) -> None:
        """Refuse a recipe that lacks an ingredient.

        Raises
        ------
        ModelError
            If MAP has no prior.
        """
        if self.method is Method.MAP and self.prior is None:
            raise ModelError("reconstructor: found method map without a prior; expected one")


def reconstruct(interaction_matrix: NDArray[Any], recipe: Recipe) -> Inversion:
    """Return the reconstructor of a single-pass interaction matrix ``(n_slopes, n_columns)``.

    Raises
    ------
    ModelError
        If the matrix cannot be inverted so: see the methods.
    """
    if recipe.method is Method.MAP and recipe.prior is not None:
        return invert_with_prior(interaction_matrix, recipe.n_modes, recipe.prior)
    return invert(interaction_matrix, recipe.n_modes, max_condition=recipe.max_condition)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Provenance:
    """What a reconstructor was made of."""

    source: Source
    """Of the interaction matrix."""

    recipe: Recipe
    """How it was inverted."""

    inversion: Inversion
    """What came of it."""

    alpha: Misregistration | None = None
    """Registration of a synthetic matrix."""

    covariance: NDArray[np.float64] | None = None
    """``(4, 4)`` of that registration, numeric units."""

    gains: CalibrationGains | None = None
    """Folded into the columns; None: the model's own."""

    reference_sha256: str | None = None
    """Digest of the measured matrix that was fitted or inverted."""

    reference_passes: int | None = None
    """How often light met the mirror in it; the reconstructor is for one pass all the same."""

    measured_illumination: bool = False
    """Whether the model's pupil was lit as the flux map says."""

    def attributes(self) -> dict[str, str | int | float | bool]:
        """Return everything as flat, named, scalar facts: for file attributes and JSON."""
        found: dict[str, str | int | float | bool] = {
            "source": str(self.source),
            "method": str(self.recipe.method),
            "n_modes": self.recipe.n_modes,
            "condition_number": self.inversion.condition_number,
            "n_truncated": self.inversion.n_truncated,
            "single_pass": True,
            "measured_illumination": self.measured_illumination,
        }
        if self.recipe.method is Method.SVD:
            found["max_condition"] = self.recipe.max_condition
        elif self.recipe.prior is not None:
            found["prior_n_modes"] = len(self.recipe.prior.variance_m2)
            found["prior_wavefront_m"] = float(np.sqrt(self.recipe.prior.variance_m2.sum()))
            found["prior_slope_noise"] = float(
                np.sqrt(np.mean(np.square(self.recipe.prior.slope_noise)))
            )
        return found | self._registration() | self._reference()

    def _registration(self) -> dict[str, str | int | float | bool]:
        if self.alpha is None:
            return {}
        found: dict[str, str | int | float | bool] = dict(self.alpha.to_boundary())
        if self.covariance is not None:
            sigma = np.sqrt(np.diag(self.covariance)) * BOUNDARY_SCALE
            found |= {
                f"sigma_{name}": float(value) for name, value in zip(PARAMETERS, sigma, strict=True)
            }
        return found

    def _reference(self) -> dict[str, str | int | float | bool]:
        found: dict[str, str | int | float | bool] = {}
        if self.reference_sha256 is not None:
            found["reference_sha256"] = self.reference_sha256
        if self.reference_passes is not None:
            found["reference_passes"] = self.reference_passes
        if self.gains is not None:
            controlled = self.gains.measured[: self.recipe.n_modes]
            found["n_gains_measured"] = int(controlled.sum())
            found["n_gains_extended"] = int((~controlled).sum())
        return found
