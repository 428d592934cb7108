"""RTCs with an order, axes, signs and a mounting of their own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, cached_property

import numpy as np
import pytest

from service.errors import ModelError
from service.estimation.slope_convention import identify_from_response
from service.estimation.windows import RefusalKind
from service.model.interaction import InteractionModel
from service.model.kinds import Normalisation, SlopeOrder
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import rtc_valid_subapertures
from service.model.sensors.pyramid.description import FrameWindows
from service.model.slopes import Orientation, SlopeRecipe, to_rtc
from service.runtime.worker import OpticsWorker
from tests.unit.runtime.small import (
    COMPUTE,
    N_CONTROLLED,
    SIGMA,
    conditions,
    loop_settings,
    small_instrument,
)
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
    return OpticsWorker(instrument, COMPUTE)


@pytest.fixture(scope="module")
def seen(instrument):
    """The true matrix as such an RTC sees it, from the model in the conventions' axes."""
    model = InteractionModel(instrument, modal_basis(instrument))
    matrix = model.interaction_matrix(ALPHA)
    mask = rtc_valid_subapertures(instrument)
    return to_rtc(matrix, RECIPE, mask)


class Sensor:
    """What ``dithered_window`` asks a workbench for."""

    def __init__(self, matrix):
        self._model = self
        self._matrix = matrix

    def interaction_matrix(self, _alpha):
        return self._matrix


def test_its_telemetry_gives_the_registration_from_the_nominal_rotation(bench, seen):
    reconstructor = bench.make(conditions(ALPHA, np.diag(SIGMA**2), loop_settings(), 0.95)).matrix
    bench.describe()
    estimate = bench.fit(dithered_window(Sensor(seen), ALPHA), open_loop(reconstructor), None)
    error = estimate.alpha.vector - ALPHA.vector
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert np.all(np.abs(error) < 4 * sigma + 2e-4)


def test_its_reconstructor_takes_slopes_as_it_lists_them(bench, seen):
    made = bench.make(conditions(ALPHA, np.diag(SIGMA**2), loop_settings(), 0.95))
    product = made.matrix @ seen[:, :N_CONTROLLED]
    np.testing.assert_allclose(product, np.eye(N_CONTROLLED), atol=1e-3)
    assert made.gate.accepted


def test_what_can_only_be_fitted_offline_is_refused(instrument):
    unknown = replace(instrument, mirror=replace(instrument.mirror, stroke_known=False))
    with pytest.raises(ModelError, match=r"found mirror\.stroke = unknown"):
        OpticsWorker(unknown, COMPUTE)
    with pytest.raises(ModelError, match=r"found wfs\.input = frames"):
        OpticsWorker(replace(instrument, frames=FrameWindows()), COMPUTE)


ALPHA_SMALL = replace(ALPHA, rotation_rad=0.004)


@cache
def matrix_at(alpha):
    """The small instrument's, in the conventions' axes."""
    small = small_instrument()
    return InteractionModel(small, modal_basis(small)).interaction_matrix(alpha)


class Mistold:
    """A workbench whose instrument file says another listing of the slopes than the RTC's."""

    def __init__(self, order="xy", **axes):
        self.setting = SlopeRecipe(order=SlopeOrder(order), orientation=Orientation(**axes))
        mask = rtc_valid_subapertures(small_instrument())
        self.seen = to_rtc(matrix_at(ALPHA_SMALL), self.setting, mask)
        at_rest = to_rtc(matrix_at(Misregistration()), self.setting, mask)
        self.own = np.linalg.pinv(at_rest[:, :N_CONTROLLED]).astype(np.float32)

    @cached_property
    def told(self):
        slopes = SlopeRecipe(orientation=Orientation())
        return OpticsWorker(replace(small_instrument(), slopes=slopes), COMPUTE)

    @cached_property
    def auto(self):
        return OpticsWorker(small_instrument(), COMPUTE)


@pytest.mark.parametrize(
    ("axes", "named"),
    [
        ({"sign_x": -1, "sign_y": -1}, "orientation.sign = -1"),
        ({"order": "yx"}, 'slopes.order = "yx"'),
        ({"flip_x": True}, "orientation.flip_x = true"),
        ({"swap_xy": True, "flip_y": True}, "orientation.swap_xy = true, orientation.flip_y"),
    ],
)
def test_another_listing_of_the_slopes_than_told_is_named_by_the_rtcs_own_matrix(axes, named):
    rtc = Mistold(**axes)
    dialect = rtc.told.read_slope_convention(rtc.own, None)
    assert named in dialect.wrong
    assert dialect.found == rtc.setting
    assert not dialect.adopted


def test_slopes_of_the_other_sign_are_named_by_the_answer_to_the_dither():
    rtc = Mistold(sign_x=-1, sign_y=-1)
    window = dithered_window(Sensor(rtc.seen), ALPHA_SMALL)
    refused = rtc.told.fit(window, open_loop(rtc.own), None)
    assert refused.kind is RefusalKind.MISTOLD
    assert "slopes have the other sign" in refused.reason
    assert "orientation.sign = -1" in refused.reason


def test_slopes_in_another_order_are_named_by_the_answer_to_the_dither():
    rtc = Mistold(order="interleaved")
    window = dithered_window(Sensor(rtc.seen), ALPHA_SMALL)
    refused = rtc.told.fit(window, open_loop(rtc.own), None)
    assert refused.kind is RefusalKind.MISTOLD
    assert 'slopes.order = "interleaved"' in refused.reason


def test_slopes_two_frames_late_are_not_taken_for_slopes_of_the_other_sign():
    rtc = Mistold()
    window = dithered_window(Sensor(rtc.seen), ALPHA_SMALL)
    turns = 2 * np.pi * np.array(window.plan.bins_hz) / window.plan.frame_rate_hz
    late = window.slopes * np.exp(-2j * turns)[:, :, None]
    outcome = rtc.told.fit(replace(window, slopes=late), open_loop(rtc.own), None)
    assert getattr(outcome, "kind", None) is not RefusalKind.MISTOLD


def test_an_orientation_left_open_is_found_in_the_rtcs_own_matrix_and_taken_over():
    rtc = Mistold(order="yx", flip_y=True, sign_x=-1)
    dialect = rtc.auto.read_slope_convention(rtc.own, None)
    assert dialect.adopted
    assert dialect.found == rtc.setting
    made = rtc.auto.make(conditions(ALPHA_SMALL, np.diag(SIGMA**2), loop_settings(), 0.95))
    product = made.matrix @ rtc.seen[:, :N_CONTROLLED]
    np.testing.assert_allclose(product, np.eye(N_CONTROLLED), atol=1e-3)


def test_a_matrix_that_no_orientation_explains_leaves_nothing_to_take_over():
    rtc = Mistold()
    noise = np.random.default_rng(1).normal(size=rtc.own.shape).astype(np.float32)
    dialect = rtc.auto.read_slope_convention(noise * np.abs(rtc.own).mean(), None)
    assert "no orientation explains" in dialect.wrong
    assert dialect.found is None


@pytest.mark.parametrize(
    ("metres", "named"),
    [(1e-9, "nanometres"), (2.0, "surface")],
)
def test_commands_in_another_unit_are_named_by_the_rtcs_own_matrix(metres, named):
    rtc = Mistold()
    dialect = rtc.told.read_slope_convention((rtc.own / metres).astype(np.float32), None)
    assert named in dialect.wrong


@pytest.mark.parametrize("ratio", [1.9, 3.2])
def test_a_modulation_that_is_too_large_may_be_why_the_own_matrix_expects_more(ratio):
    """A pyramid's response grows as its modulation shrinks, as if light met the mirror twice."""
    rtc = Mistold()
    wrong = rtc.told.read_slope_convention((rtc.own / ratio).astype(np.float32), None).wrong
    assert "modulation_lambda_over_d" in wrong


def test_commands_in_another_unit_are_named_by_the_answer_to_the_dither():
    rtc = Mistold()
    window = dithered_window(Sensor(rtc.seen), ALPHA_SMALL)
    in_nm = replace(window, commands=window.commands * 1e9, dither=window.dither * 1e9)
    refused = rtc.told.fit(in_nm, open_loop(rtc.own), None)
    assert refused.kind is RefusalKind.MISTOLD
    assert "nanometres" in refused.reason


def test_what_is_as_told_is_not_complained_of():
    rtc = Mistold()
    for bench in (rtc.told, rtc.auto):
        assert not bench.read_slope_convention(rtc.own, None).wrong
        found = bench.fit(dithered_window(Sensor(rtc.seen), ALPHA_SMALL), open_loop(rtc.own), None)
        assert np.all(np.abs(found.alpha.vector - ALPHA_SMALL.vector) < 0.01)


def told_upright():
    return replace(small_instrument(), slopes=SlopeRecipe(orientation=Orientation()))


def seen_mirrored():
    """The small matrix, as it is and as an RTC with y counted downwards lists it, by mode."""
    mask, mirrored = rtc_valid_subapertures(small_instrument()), Orientation(flip_y=True)
    matrix = matrix_at(Misregistration())
    upright = to_rtc(matrix, SlopeRecipe(orientation=Orientation()), mask)
    return upright.T, to_rtc(matrix, SlopeRecipe(orientation=mirrored), mask).T


def parities(upright, other):
    """How each mode correlates with itself, y counted the other way."""
    size = np.linalg.norm(upright, axis=1) * np.linalg.norm(other, axis=1)
    return np.sum(upright * other, axis=1) / size


def test_one_mode_of_the_other_sign_is_not_taken_for_other_axes():
    """Three modes look the same with y counted downwards, the fourth is turned over by it."""
    upright, other = seen_mirrored()
    alike = parities(upright, other)
    modes = [*np.argsort(alike)[-3:], np.argmin(alike)]
    expected = upright[modes].astype(complex)
    slopes = expected * np.array([1.0, 1.0, 1.0, -1.0])[:, None]
    noise = np.random.default_rng(3).normal(size=(3, expected.shape[1]))
    slopes[:3] += 0.75 * noise * np.sqrt(np.mean(np.abs(expected[:3]) ** 2, axis=1))[:, None]
    assert identify_from_response(slopes, expected, np.zeros(4), told_upright()).wrong == ""


def test_axes_that_turn_half_of_the_modes_over_are_named():
    upright, other = seen_mirrored()
    alike = parities(upright, other)
    modes = [*np.argsort(alike)[-2:], *np.argsort(alike)[:2]]
    expected = upright[modes].astype(complex)
    found = identify_from_response(
        other[modes].astype(complex), expected, np.zeros(4), told_upright()
    )
    assert "orientation.flip_y = true" in found.wrong
