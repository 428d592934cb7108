"""RTCs with an order, axes, signs and a mounting of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.errors import ModelError
from service.model.instrument import FrameWindows
from service.model.interaction import InteractionModel, rtc_valid_subapertures
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.slopes import Normalisation, Orientation, SlopeOrder, SlopeRecipe, to_rtc
from service.worker import Workbench
from tests.unit.runtime.small import COMPUTE, N_CONTROLLED, SIGMA, loop_settings, small_instrument
from tests.unit.runtime.test_workbench import dithered_window, open_loop

NOMINAL_RAD = np.deg2rad(64.5)
ALPHA = Misregistration(
    shift_x_subap=0.12,
    shift_y_subap=-0.08,
    rotation_rad=NOMINAL_RAD + 0.01,
    magnification=1.003,
)
RECIPE = SlopeRecipe(
    order=SlopeOrder.INTERLEAVED,
    orientation=Orientation(swap_xy=True, flip_y=True, sign_x=-1),
    normalisation=Normalisation.LOCAL,
)


@pytest.fixture(scope="module")
def instrument():
    small = small_instrument()
    mirror = replace(small.mirror, nominal_rotation_rad=NOMINAL_RAD)
    return replace(small, slopes=RECIPE, mirror=mirror)


@pytest.fixture(scope="module")
def bench(instrument):
    return Workbench(instrument, COMPUTE)


@pytest.fixture(scope="module")
def seen(instrument):
    """The true matrix as such an RTC sees it, from the model in the conventions' axes."""
    model = InteractionModel(instrument, modal_basis(instrument))
    matrix = model.interaction_matrix(ALPHA)
    mask = rtc_valid_subapertures(instrument)
    return to_rtc(matrix, RECIPE.order, RECIPE.orientation, mask)


class Sensor:
    """What ``dithered_window`` asks a workbench for."""

    def __init__(self, matrix):
        self._model = self
        self._matrix = matrix

    def interaction_matrix(self, _alpha):
        return self._matrix


def test_its_telemetry_gives_the_registration_from_the_nominal_rotation(bench, seen):
    reconstructor = bench.make(ALPHA, np.diag(SIGMA**2), loop_settings(), 0.95).matrix
    bench.describe()
    estimate = bench.fit(dithered_window(Sensor(seen), ALPHA), open_loop(reconstructor), None)
    error = estimate.alpha.vector - ALPHA.vector
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert np.all(np.abs(error) < 4 * sigma + 2e-4)


def test_its_reconstructor_takes_slopes_as_it_lists_them(bench, seen):
    made = bench.make(ALPHA, np.diag(SIGMA**2), loop_settings(), 0.95)
    product = made.matrix @ seen[:, :N_CONTROLLED]
    np.testing.assert_allclose(product, np.eye(N_CONTROLLED), atol=1e-3)
    assert made.gate.accepted


def test_what_can_only_be_fitted_offline_is_refused(instrument):
    unknown = replace(instrument, mirror=replace(instrument.mirror, stroke_known=False))
    with pytest.raises(ModelError, match=r"found mirror\.stroke = unknown"):
        Workbench(unknown, COMPUTE)
    with pytest.raises(ModelError, match=r"found wfs\.input = frames"):
        Workbench(replace(instrument, frames=FrameWindows()), COMPUTE)
