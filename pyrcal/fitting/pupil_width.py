"""Measure the diameter of the pupil image from the subapertures that respond.

Outside the light a subaperture hardly responds to any mode. A mask that is wider than the image, as
some RTCs cut out of the detector by default, looks like a smaller mirror with uneven light:
everything fits, but the resulting matrix belongs to another pupil.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SILENT_SHARE = 0.3
"""Response over that of the others below which a subaperture has no light. One that the pupil's
border cuts has half or more."""

BRIGHT_QUANTILE = 0.8
"""Quantile of the responses used as their typical value, because most may be silent."""

MIN_SILENT_SHARE = 0.08
"""Smallest share of silent subapertures; fewer are dead pixels or a spider."""

MAX_STRAY_SHARE = 0.2
"""Largest number of misplaced subapertures (silent inside, responding outside) over the silent
ones."""

NARROWER_SUBAP = 1.0
"""Smallest difference of diameters that is reported, subapertures."""

BORDER_SUBAP = 2.0
"""Width of the ring of partly illuminated subapertures."""

STEP_SUBAP = 0.25
"""Step between trial diameters, subapertures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenPupil:
    """A pupil image that is narrower than the mask of valid subapertures."""

    diameter_subap: float
    """Diameter across the responding subapertures."""

    n_silent: int
    n_valid: int

    @property
    def words(self) -> str:
        """Sentence on the silent subapertures and the diameter."""
        return (
            f"{self.n_silent} of {self.n_valid} subapertures, those at the border, hardly answer: "
            f"the pupil's image looks {self.diameter_subap:.0f} subapertures wide"
        )


def measure_pupil(answers: Array, stated_subap: float) -> SeenPupil | None:
    """Return the responding pupil, or None if it is as wide as stated.

    Parameters
    ----------
    answers
        ``(n, n)`` response of each subaperture over the expected one; NaN if unknown or none is
        expected.
    stated_subap
        Stated diameter of the pupil image, subapertures.
    """
    known = np.isfinite(answers)
    if not known.any():
        return None
    silent = known & (
        np.nan_to_num(answers) < SILENT_SHARE * np.quantile(answers[known], BRIGHT_QUANTILE)
    )
    n_silent = int(silent.sum())
    if n_silent < MIN_SILENT_SHARE * known.sum():
        return None
    # the diameter whose circle misclassifies the fewest subapertures
    places = np.argwhere(known)
    away = np.hypot(*(places - places.mean(axis=0)).T)
    # a narrower pupil leaves silent subapertures outside a circle, dead pixels are scattered
    quiet = silent[known]
    diameters = np.arange(2.0, 2.0 * float(away.max()), STEP_SUBAP)
    outside = away > diameters[:, None] / 2.0
    wrong = np.sum(outside != quiet, axis=1)
    if not len(wrong) or wrong.min() > MAX_STRAY_SHARE * n_silent:
        return None
    found = _diameter(answers, float(np.mean(diameters[wrong == wrong.min()])))
    if found > stated_subap - NARROWER_SUBAP:
        return None
    return SeenPupil(diameter_subap=found, n_silent=n_silent, n_valid=int(known.sum()))


def _diameter(answers: Array, about: float) -> float:
    """Return the diameter of equal illuminated area; border subapertures count in part."""
    known = np.isfinite(answers)
    centre = np.argwhere(known).mean(axis=0)
    rows, columns = np.indices(answers.shape)
    beyond = np.hypot(rows - centre[0], columns - centre[1]) - about / 2.0
    shares = np.clip(
        np.nan_to_num(answers) / np.quantile(answers[known], BRIGHT_QUANTILE), 0.0, 1.0
    )
    # Responses far outside are stray and gaps far inside are dead pixels: neither changes the area.
    at_border = np.where(beyond > BORDER_SUBAP, 0.0, shares)
    area = float(np.sum(np.where(beyond < -BORDER_SUBAP, 1.0, at_border)))
    return 2.0 * float(np.sqrt(area / np.pi))


def compute_responses(measured: Array, expected: Array, valid: NDArray[np.bool_]) -> Array:
    """Return the response of each subaperture over the expected one, ``(n, n)``.

    Parameters
    ----------
    measured, expected
        ``(n_slopes,)`` sums over the modes of squared slopes, one plane after the other; NaN for
        unused slopes.
    valid
        ``(n, n)`` mask of the subapertures in both.
    """
    found, due = (
        np.sqrt(one.reshape(-1, int(valid.sum())).sum(axis=0)) for one in (measured, expected)
    )
    known = np.isfinite(found) & np.isfinite(due)
    answers = np.full(valid.shape, np.nan)
    if known.any():
        # Where hardly any response is expected, the ratio would be one of noise.
        known &= np.nan_to_num(due) > SILENT_SHARE * np.median(due[known])
        answers[valid] = np.divide(found, due, out=np.full(len(due), np.nan), where=known)
    return answers
