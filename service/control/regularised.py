"""A reconstructor that knows how strong each mode and the noise are: MAP, or generalised SVD.

``R = (D^T Cn^-1 D + Cφ^-1)^-1 D^T Cn^-1`` (Gauss-Markov with a prior). It estimates every mode of
the basis, also those the loop does not control: what they show in the slopes is then explained by
them and does not alias into the controlled ones. With no noise and as many modes as are controlled
it is the least-squares inverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.control.reconstructor import Inversion, checked_columns
from service.errors import ModelError

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """What is known before any slope is: how large the modes are, and how noisy the slopes."""

    variance_m2: Array
    """``(n_basis,)`` expected variance of each mode, metres² OPD; a KL basis knows it."""

    slope_noise: Array
    """``(n_slopes,)`` 1 σ of each slope in one frame; 0 nowhere."""

    def __post_init__(self) -> None:
        """Refuse what cannot be divided by.

        Raises
        ------
        ModelError
            If a variance or a noise is not finite and positive.
        """
        for name, values in (("variance_m2", self.variance_m2), ("slope_noise", self.slope_noise)):
            bad = np.flatnonzero(~(np.isfinite(values) & (values > 0.0)))
            if values.ndim != 1 or len(bad):
                where = f", first at {bad[0]}" if len(bad) else ""
                raise ModelError(
                    f"prior: {name}: found shape {values.shape} and {len(bad)} values that are not "
                    f"positive{where}; expected one positive number each"
                )


def invert_with_prior(interaction_matrix: NDArray[Any], n_modes: int, prior: Prior) -> Inversion:
    """Return the MAP reconstructor of the first ``n_modes`` modes.

    As many modes are estimated as both matrix and prior know. Each row is scaled so that its own
    mode comes back whole (the diagonal of ``R D`` is 1): a loop gain then means what it means with
    any other reconstructor, and how much to trust a mode remains the gain's business.

    Raises
    ------
    ModelError
        As :func:`invert`; also if the prior is of other slopes or of fewer modes.

    References
    ----------
    Gilles 2005, Appl. Opt. 44, 993; Correia et al. 2013, JOSA A 30, 1726.
    """
    n_estimated = min(interaction_matrix.shape[1], len(prior.variance_m2))
    controlled = checked_columns(interaction_matrix, n_modes)
    if n_modes > n_estimated or len(prior.slope_noise) != len(controlled):
        raise ModelError(
            f"reconstructor: found a prior of {len(prior.variance_m2)} modes and "
            f"{len(prior.slope_noise)} slopes; expected at least {n_modes} and {len(controlled)}"
        )
    matrix = checked_columns(interaction_matrix, n_estimated)
    amplitude = np.sqrt(prior.variance_m2[:n_estimated])
    # in units of noise and of the prior both matrices are of order one: nothing overflows
    white = matrix * amplitude / prior.slope_noise[:, None]
    system = scipy.linalg.cho_factor(white.T @ white + np.eye(n_estimated))
    estimate = scipy.linalg.cho_solve(system, white.T)[:n_modes] * amplitude[:n_modes, None]
    estimate /= prior.slope_noise
    estimate /= np.einsum("ij,ji->i", estimate, controlled)[:, None]
    singular = scipy.linalg.svdvals(controlled)
    return Inversion(
        matrix=np.ascontiguousarray(estimate, dtype=np.float32),
        condition_number=float(singular[0] / singular[-1]),
        n_truncated=0,
    )
