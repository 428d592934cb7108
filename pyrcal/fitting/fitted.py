"""The record of a fit: the registration, its uncertainty and evidence, and other findings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.budget import Cause
from pyrcal.fitting.comparison import Alternative
from pyrcal.fitting.control_check import ReconstructorVerdict
from pyrcal.fitting.disjoint_sets import DisjointSets, Distortion
from pyrcal.fitting.fitted_matrix import FittedMatrix
from pyrcal.fitting.instrument_checks import FoundOptic
from pyrcal.fitting.origins import FoundStroke, Origin
from pyrcal.fitting.solver import ANAMORPHOSIS_SIGMA
from service.model.slopes import Orientation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from service.model.instrument import Instrument

MAX_STRETCH_SIGMA_RATIO = 0.5
"""Largest 1 σ of an anamorphosis, over its prior σ, at which the anamorphosis is reported."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """Verdict on the registration, and the two parts of its σ."""

    determined: bool
    """True if the data determine the registration; the same as ``Fit.accepted``."""

    reason: str
    """Reason of the verdict, in one sentence."""

    sigma_statistical: NDArray[np.float64]
    """``(4,)`` 1 σ from noise and from the scatter of disjoint sets, numeric units."""

    sigma_systematic: NDArray[np.float64]
    """``(4,)`` 1 σ from model errors and from alternatives that the data do not exclude, numeric
    units."""

    sets: tuple[DisjointSets, ...] = ()
    """Disjoint sets of modes, actuators and subapertures, each fitted separately."""

    distortion: Distortion | None = None
    """Smooth distortion of the mirror that explains the most; None for a fit constructed by hand.
    """


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit(FittedMatrix):
    """A fitted registration with its σ and verdict.

    The covariance includes noise, the scatter of disjoint sets and the floor of model errors.
    """

    condition_number: float
    """Condition number of the synthetic matrix at ``alpha``, with the modes used."""

    orientation: Orientation
    """Orientation of the slopes, given or found."""

    subset_scatter: NDArray[np.float64]
    """``(4,)`` 1 σ scatter of disjoint sets of modes, units of ``alpha.vector``."""

    accepted: bool
    """True if the data determine the registration."""

    converged: bool = True
    """True if the steps converged."""

    remarks: tuple[str, ...] = ()
    """Further notes on the fit, one sentence each."""

    n_evaluations: int = 1
    """Number of interaction matrices computed, those for derivatives included."""

    gain_map: NDArray[np.float64] | None = None
    """``(n, n)`` gain over the pupil common to all modes, mean 1; None if it was not fitted."""

    anamorphosis_sigma: NDArray[np.float64] | None = None
    """``(2,)`` 1 σ of the anamorphosis of ``alpha``; None if it was not fitted."""

    image_offsets_px: NDArray[np.float64] | None = None
    """``(4, 2)`` [x, y] offsets of the pupil images from their nominal positions on the pixel grid,
    as in the instrument file's key. A matrix does not determine which of two opposite images is
    displaced, and α does not depend on it. None if the file gives the offsets, or the sensor has
    one image."""

    optics: tuple[FoundOptic, ...] = ()
    """Optical quantities that were fitted: coupling or width, modulation."""

    alternatives: tuple[Alternative, ...] = ()
    """Alternative explanations of the matrix, with the change of α that each would cause."""

    registration: Registration | None = None
    """Verdict on the registration; None for a fit constructed by hand."""

    reconstructor: ReconstructorVerdict | None = None
    """Result of the closed-loop check with the model's reconstructor; None for a fit constructed by
    hand."""

    origins: tuple[Origin, ...] = ()
    """Instrument quantities that the fit determined."""

    stroke: FoundStroke | None = None
    """Unit and sign of the commands; None for a fit that explains too little."""

    causes: tuple[Cause, ...] = ()
    """Causes of the power that is left over, the largest first; empty if hardly any is."""

    unknown_not_found: tuple[str, ...] = ()
    """Keys marked as unknown in the file that the matrix does not determine."""

    corrections: Mapping[str, Any] = field(default_factory=dict)
    """Values that the recommendation asks to write into the instrument file, by table and key, such
    as ``wfs.modulation_lambda_over_d``; None removes a key. That of ``instrument.pupil`` describes
    how the map is to be turned or mirrored."""

    @property
    def anamorphosis(self) -> NDArray[np.float64] | None:
        """``(2,)`` stretches of α; None if the modes do not determine them."""
        sigma = self.anamorphosis_sigma
        is_observable = sigma is not None and bool(
            np.all(sigma < MAX_STRETCH_SIGMA_RATIO * ANAMORPHOSIS_SIGMA)
        )
        return self.alpha.stretches if is_observable else None

    def plot(self, instrument: Instrument | None = None) -> Figure:
        """Return the figures of this fit, as ``pyrcal fit --plot`` draws them.

        With the ``instrument``, its mirror is drawn over the subapertures as well. Save them with
        ``fit.plot().savefig("fit.png")``.

        Raises
        ------
        ConfigurationError
            If matplotlib, the extra ``plots``, is not installed.
        """
        from pyrcal.fitting.figures import draw_sheet  # a fit without a figure does not need it

        return draw_sheet(self, "" if instrument is None else instrument.name, instrument)
