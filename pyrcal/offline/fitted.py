"""The record of a fit: the registration, what it rests on, what else was found."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.alternatives import Alternative
from pyrcal.offline.control_check import ReconstructorVerdict
from pyrcal.offline.disjoint_sets import DisjointSets, Distortion
from pyrcal.offline.instrument_checks import FoundOptic
from pyrcal.offline.left_over import LeftOver
from pyrcal.offline.methods import ScanStep
from pyrcal.offline.origins import Origin
from pyrcal.offline.solver import ANAMORPHOSIS_SIGMA
from service.model.kinds import SlopeOrder
from service.model.misregistration import Determination
from service.model.slopes import Orientation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from service.model.instrument import Instrument

TOLD = 0.5
"""1 σ of an anamorphosis over what is expected of any, below which modes tell of it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """Whether the registration is determined, and the two parts of its σ."""

    determined: bool
    """Whether the data determine it; the same as ``Fit.accepted``."""

    reason: str
    """Why, or why not, in one sentence."""

    sigma_statistical: NDArray[np.float64]
    """``(4,)`` 1 σ from noise and the scatter of disjoint sets, numeric units."""

    sigma_systematic: NDArray[np.float64]
    """``(4,)`` 1 σ from errors of the model and explanations that the data do not exclude."""

    sets: tuple[DisjointSets, ...] = ()
    """Disjoint sets of modes, actuators and subapertures, each fitted alone."""

    distortion: Distortion | None = None
    """The smooth distortion of the mirror that explains most; None of a fit made by hand."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit(Determination):
    """A fitted registration with its σ and verdict.

    The covariance is of noise, the disagreement of subsets and the model-error floor.
    """

    gains: NDArray[np.float64]
    """``(n_used,)`` size of each measured column over the model's, passes accounted for."""

    residual_fraction: float
    """RMS of what is left over RMS of the measurement, each mode counted alike."""

    residual_map: NDArray[np.float64]
    """``(n_planes, n, n)`` [x or y, or image; row, column] RMS over modes of what is left, in units
    of the measurement's own RMS; NaN outside the valid subapertures."""

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

    synthetic: NDArray[Any]
    """``(n_slopes, n_used)`` the model at ``alpha``, gains not applied, conventions' axes."""

    measured: NDArray[Any]
    """``(n_slopes, n_used)`` the reference in the same axes and unit (passes divided out)."""

    valid: NDArray[np.bool_]
    """``(n, n)`` [y, x] mask that lists both, in conventions' axes."""

    gain_map: NDArray[np.float64] | None = None
    """``(n, n)`` gain over the pupil common to all modes, mean 1; None: not asked for."""

    anamorphosis_sigma: NDArray[np.float64] | None = None
    """``(2,)`` 1 σ of the anamorphosis of ``alpha``; None: it was not fitted."""

    image_offsets_px: NDArray[np.float64] | None = None
    """``(4, 2)`` [x, y] where the pupil images were found beside their places on the pixel grid, as
    the instrument file's key has it. A matrix cannot tell which of two opposite images is
    displaced, nor does α depend on it. None if the file says where they lie, or the sensor has
    one image."""

    optics: tuple[FoundOptic, ...] = ()
    """What of the instrument was fitted, too: coupling or width, modulation."""

    alternatives: tuple[Alternative, ...] = ()
    """What else might explain the matrix, and how far it would move α."""

    registration: Registration | None = None
    """Whether the registration is determined, and how well; None of a fit made by hand."""

    reconstructor: ReconstructorVerdict | None = None
    """Whether a reconstructor of the model holds the loop of the measured matrix; None as above."""

    origins: tuple[Origin, ...] = ()
    """What of the instrument was found rather than told."""

    unknown_not_found: tuple[str, ...] = ()
    """Keys that the file calls unknown and that the matrix does not determine."""

    left_over: LeftOver | None = None
    """Where the residual is."""

    recommendation: str = ""
    """What to do with it, in one sentence."""

    paper_table: tuple[ScanStep, ...] | None = None
    """The scans, in their order; None for the other methods."""

    @property
    def anamorphosis(self) -> NDArray[np.float64] | None:
        """``(2,)`` as α has it; None where the modes do not tell, or it was not fitted."""
        sigma = self.anamorphosis_sigma
        told = sigma is not None and bool(np.all(sigma < TOLD * ANAMORPHOSIS_SIGMA))
        return self.alpha.stretches if told else None

    def plot(self, instrument: Instrument | None = None) -> Figure:
        """Return the figures of this fit, as ``pyrcal fit --plot`` draws them.

        With the ``instrument``, its mirror is drawn over the subapertures as well. Save them with
        ``fit.plot().savefig("fit.png")``.

        Raises
        ------
        ConfigurationError
            If matplotlib, the extra ``plots``, is not installed.
        """
        figures = import_module("pyrcal.offline.figures")  # it draws this record
        heading = "" if instrument is None else instrument.name
        figure: Figure = figures.draw_sheet(self, heading, instrument)
        return figure
