"""Measured matrices of the small instrument: the model at another sampling, with noise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from service.estimation.reference import Reference
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import SlopeOrder
from service.model.misregistration import Misregistration
from service.model.modes import Basis
from service.model.pupil import rtc_valid_subapertures
from service.model.slopes import Orientation, SlopeRecipe, to_rtc
from tests.support.numerics import small_basis, small_instrument

PLAIN = Orientation()

ELSEWHERE = Misregistration(
    shift_x_subap=0.31, shift_y_subap=-0.22, rotation_rad=np.deg2rad(1.3), magnification=1.012
)

GRID = np.array([1e-3, 1e-3, np.deg2rad(5e-3), 2e-4])
"""What the fit's grid does to a matrix of a finer one: measured at 0.02 % of a subaperture."""


@cache
def instrument(orientation: Orientation | None = PLAIN, order: SlopeOrder = SlopeOrder.XY):
    return replace(small_instrument(), slopes=SlopeRecipe(order=order, orientation=orientation))


def matrix(
    alpha: Misregistration = ELSEWHERE,
    about: Instrument | None = None,
    *,
    noise: float = 0.0,
    basis=None,
    seed: int = 1,
    **model,
) -> np.ndarray:
    """D on a finer grid than the fit's own; ``noise`` is a share of each column's RMS."""
    exact = _exact(alpha, about or instrument(), basis or small_basis(), **model)
    scatter = np.random.default_rng(seed).normal(size=exact.shape) * exact.std(axis=0)
    return exact + noise * scatter


@cache
def _exact(alpha: Misregistration, about: Instrument, basis: Basis, **model) -> np.ndarray:
    sampled = InteractionModel(about, basis, pupil_sampling=4, detector_nodes=4, **model)
    return sampled.interaction_matrix(alpha).astype(np.float64)


def listed(values: np.ndarray, order: SlopeOrder, orientation: Orientation) -> np.ndarray:
    """The same slopes as such an RTC lists them."""
    mask = rtc_valid_subapertures(instrument(orientation))
    return to_rtc(values, SlopeRecipe(order=order, orientation=orientation), mask)


def fit(
    values: np.ndarray, about: Instrument | None = None, options: FitOptions | None = None, **given
) -> Fit:
    return fit_matrix(
        about or instrument(),
        Reference(matrix=values, **given),
        options,
        basis=small_basis(),
    )


def error(found: Fit, alpha: Misregistration = ELSEWHERE) -> np.ndarray:
    return found.alpha.vector - alpha.vector
