"""A fit together with what it was made from: what every way of telling it begins with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.fit.options import Fit, Method
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.model.slopes import Orientation, SlopeOrder


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitReport:
    """What was found, from which file, for which instrument."""

    fit: Fit
    """What was found."""

    method: Method
    """How."""

    instrument: str
    """Name of the instrument."""

    instrument_sha256: str
    """Of everything that is known of the instrument, arrays included."""

    reference: str
    """File and array that were fitted."""

    reference_sha256: str
    """Of the whole file."""

    double_pass: bool
    """Whether the matrix was taken as twice the model's."""

    seconds: float
    """Time of the fit, the optical model included and reading not."""

    notes: tuple[str, ...] = ()
    """What was decided on the way and should be known, one sentence each."""


def document(report: FitReport) -> dict[str, Any]:
    """Return the fit as one JSON object, in boundary units; a number that is not finite is None.

    ``gains`` belong to the modes used, in the order of the basis. What was left out is named in
    ``verdict``, which begins with "accepted" or "refused".
    """
    fit = report.fit
    sigma = np.sqrt(np.diag(fit.covariance)) * BOUNDARY_SCALE
    return {
        **fit.alpha.to_boundary(),
        "sigma": _four(sigma),
        "covariance": _plain(fit.covariance * np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)),
        "gains": _plain(fit.gains),
        "residual_fraction": _plain(fit.residual_fraction),
        "condition_number": _plain(fit.condition_number),
        "n_modes_used": len(fit.modes),
        "orientation": orientation_words(fit.orientation, fit.order),
        "subset_scatter": _four(fit.subset_scatter * BOUNDARY_SCALE),
        "converged": bool(fit.converged),
        "verdict": verdict_line(fit),
        "notes": list(report.notes),
        "seconds": round(report.seconds, 3),
    }


def verdict_line(fit: Fit) -> str:
    """Return the verdict and what was left out, in one line."""
    if not fit.left_out:
        return fit.verdict
    return f"{fit.verdict}; left out: {'; '.join(fit.left_out)}"


def orientation_words(orientation: Orientation, order: SlopeOrder) -> dict[str, Any]:
    """Return order and orientation as the instrument file would say them."""
    both = [orientation.sign_x, orientation.sign_y]
    return {
        "order": str(order),
        "swap_xy": orientation.swap_xy,
        "flip_x": orientation.flip_x,
        "flip_y": orientation.flip_y,
        "sign": both[0] if both[0] == both[1] else both,
    }


def _four(values: NDArray[np.float64]) -> dict[str, float | None]:
    return dict(zip(PARAMETERS, _plain(values), strict=True))


def _plain(values: float | NDArray[np.float64]) -> Any:  # noqa: ANN401 - as nested as the array
    """Return numbers or nested lists of them, None for what is not finite."""
    array = np.asarray(values, dtype=np.float64)
    plain = array.astype(object)
    plain[~np.isfinite(array)] = None
    return plain.tolist()
