"""What may be asked of a fit, and all that it answers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import Misregistration
from service.model.pupil import Illumination
from service.model.slopes import Orientation, SlopeOrder

Array = NDArray[Any]


class Method(StrEnum):
    """How the registration is found."""

    JOINT = "joint"
    """All four parameters together, by variable projection over a free gain per mode."""

    PAPER = "paper"
    """One parameter at a time, with parabolas through scans (Heritier et al. 2018, section 4)."""

    SENSITIVITY = "sensitivity"
    """Projection on sensitivity matrices about the start, iterated."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitOptions:
    """What may be asked of a fit."""

    method: Method = Method.JOINT
    """How the registration is found."""

    modes: NDArray[np.intp] | None = None
    """Basis indices to use; None: all that the reference has."""

    start: Misregistration | None = None
    """Where to begin; None: a rough rotation from the lowest orders, the rest nominal."""

    orientation: Orientation | None = None
    """Of the slopes; None: the instrument's, or found when that does not say either."""

    gain_map: bool = False
    """Whether a smooth gain over the pupil, common to all modes, is unknown too."""

    anamorphosis: bool = False
    """Whether stretches of the mirror's image along and across 0 and 45 deg are unknown too."""

    illumination: Illumination | None = None
    """Measured light of the beam, in the axes of conventions.md; None: even."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanStep:
    """One line of the paper's Table 1: one parameter scanned, the others held."""

    parameter: str
    """Name at the boundary, as in ``PARAMETERS``."""

    step: float
    """Distance of two samples, in boundary units (subaperture, degree, ratio)."""

    samples: NDArray[np.float64]
    """``(n_samples,)`` values tried, in boundary units."""

    chi: NDArray[np.float64]
    """``(n_samples,)`` χ² at each."""

    minimum: float
    """Lowest point of the parabola, in boundary units: where the next line begins."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """Where the mirror is, how sure that is, and whether to believe it."""

    alpha: Misregistration
    """The registration found."""

    covariance: NDArray[np.float64]
    """``(4, 4)`` of ``alpha.vector`` (subaperture, subaperture, radian, ratio): noise, the
    disagreement of subsets and the model-error floor."""

    gains: NDArray[np.float64]
    """``(n_used,)`` size of each measured column over the model's, passes accounted for."""

    residual_fraction: float
    """RMS of what is left over RMS of the measurement, each mode counted alike."""

    residual_map: NDArray[np.float64]
    """``(2, n, n)`` [x or y, row, column] RMS over modes of what is left, in units of the
    measurement's own RMS; NaN outside the valid subapertures."""

    residual_by_mode: NDArray[np.float64]
    """``(n_used,)`` the same fraction for each mode."""

    condition_number: float
    """Of the synthetic matrix at ``alpha``, modes used."""

    modes: NDArray[np.intp]
    """``(n_used,)`` basis indices."""

    orientation: Orientation
    """Of the slopes, given or found."""

    order: SlopeOrder
    """Order of the components, given or found."""

    subset_scatter: NDArray[np.float64]
    """``(4,)`` 1 σ scatter of disjoint sets of modes, units of ``alpha.vector``."""

    accepted: bool
    """Whether this is the registration, as far as the data tell."""

    converged: bool
    """Whether the steps came to rest."""

    verdict: str
    """One line: accepted and how well, or refused, why and what to do."""

    left_out: tuple[str, ...]
    """Columns and slopes that were not used, one sentence for each kind."""

    remarks: tuple[str, ...]
    """What should be known beside the verdict, one sentence each."""

    n_evaluations: int
    """Interaction matrices computed on the way, those for derivatives included."""

    synthetic: Array
    """``(n_slopes, n_used)`` the model at ``alpha``, gains not applied, conventions' axes."""

    measured: Array
    """``(n_slopes, n_used)`` the reference in the same axes and unit (passes divided out)."""

    valid: NDArray[np.bool_]
    """``(n, n)`` [y, x] mask that lists both, in conventions' axes."""

    gain_map: NDArray[np.float64] | None = None
    """``(n, n)`` gain over the pupil common to all modes, mean 1; None: not asked for."""

    anamorphosis: NDArray[np.float64] | None = None
    """``(2,)`` half the stretch along x over that along y, and along 45 deg over 135 deg."""

    paper_table: tuple[ScanStep, ...] | None = None
    """The scans, in their order; None for the other methods."""
