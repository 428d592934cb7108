"""How wide the pupil's image is, told by the subapertures that answer.

Outside the light a subaperture hardly answers to any mode. A mask that is wider than the image,
as those are that some RTCs cut out of the detector by default, looks like a smaller mirror under
uneven light: everything fits, and the matrix made from it is another pupil's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SILENT = 0.3
"""A subaperture that answers by less than this share of what the others do has no light. One that
the pupil's border cuts answers by half or more."""

BRIGHT = 0.8
"""Quantile of the answers that stands for them: most may be silent."""

FEWEST = 0.08
"""Share of the subapertures that must be silent: fewer are dead pixels or a spider."""

STRAY = 0.2
"""Share of the silent ones that may lie inside, or of as many others outside."""

NARROWER_SUBAP = 1.0
"""Of a diameter, by which it is worth a word."""

BORDER_SUBAP = 2.0
"""Width of the ring in which subapertures may be lit in part."""

STEP_SUBAP = 0.25
"""Between two diameters that are tried."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenPupil:
    """A pupil's image that is narrower than the subapertures said to be valid."""

    diameter_subap: float
    """Across the subapertures that answer."""

    n_silent: int
    n_valid: int

    @property
    def words(self) -> str:
        """What was found, and how wide the image looks."""
        return (
            f"{self.n_silent} of {self.n_valid} subapertures, those at the border, hardly answer: "
            f"the pupil's image looks {self.diameter_subap:.0f} subapertures wide"
        )


def seen_pupil(answers: Array, told_subap: float) -> SeenPupil | None:
    """Return the pupil that answers, or None where it is as wide as it is said to be.

    Parameters
    ----------
    answers
        ``(n, n)`` how much each subaperture answers, over what is expected of it; NaN where
        nothing is known or expected.
    told_subap
        Diameter of the pupil's image as it is said to be, subapertures.
    """
    known = np.isfinite(answers)
    if not known.any():
        return None
    silent = known & (np.nan_to_num(answers) < SILENT * np.quantile(answers[known], BRIGHT))
    n_silent = int(silent.sum())
    if n_silent < FEWEST * known.sum():
        return None
    places = np.argwhere(known)
    away = np.hypot(*(places - places.mean(axis=0)).T)
    quiet = silent[known]
    diameters = np.arange(2.0, 2.0 * float(away.max()), STEP_SUBAP)
    outside = away > diameters[:, None] / 2.0
    wrong = np.sum(outside != quiet, axis=1)
    if not len(wrong) or wrong.min() > STRAY * n_silent:
        return None
    found = _diameter(answers, float(np.mean(diameters[wrong == wrong.min()])))
    if found > told_subap - NARROWER_SUBAP:
        return None
    return SeenPupil(diameter_subap=found, n_silent=n_silent, n_valid=int(known.sum()))


def _diameter(answers: Array, about: float) -> float:
    """Return the diameter of as much light: subapertures that the border cuts count in part."""
    known = np.isfinite(answers)
    centre = np.argwhere(known).mean(axis=0)
    rows, columns = np.indices(answers.shape)
    beyond = np.hypot(rows - centre[0], columns - centre[1]) - about / 2.0
    shares = np.clip(np.nan_to_num(answers) / np.quantile(answers[known], BRIGHT), 0.0, 1.0)
    at_border = np.where(beyond > BORDER_SUBAP, 0.0, shares)
    area = float(np.sum(np.where(beyond < -BORDER_SUBAP, 1.0, at_border)))
    return 2.0 * float(np.sqrt(area / np.pi))


def answers_of(measured: Array, expected: Array, valid: NDArray[np.bool_]) -> Array:
    """Return how much each subaperture answers over what is expected of it, ``(n, n)``.

    Parameters
    ----------
    measured, expected
        ``(n_slopes,)`` sums over the modes of squared slopes, planes one after the other; NaN where
        a slope does not count.
    valid
        ``(n, n)`` mask that lists both.
    """
    found, due = (
        np.sqrt(one.reshape(-1, int(valid.sum())).sum(axis=0)) for one in (measured, expected)
    )
    known = np.isfinite(found) & np.isfinite(due)
    answers = np.full(valid.shape, np.nan)
    if known.any():
        known &= np.nan_to_num(due) > SILENT * np.median(due[known])
        answers[valid] = np.divide(found, due, out=np.full(len(due), np.nan), where=known)
    return answers
