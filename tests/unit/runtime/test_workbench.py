"""The heavy work on a small instrument."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, cached_property

import numpy as np
import pytest

from pyrcal_studies.campaign.observatory import OwnHands
from service.control.dither import COARSE_BAND, FINE_BAND
from service.errors import ModelError, UnknownIdError, WorkerError
from service.estimation import passive
from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInPlan
from service.estimation.slope_convention import identify_from_response
from service.model.interaction import InteractionModel, RtcInteractionModel
from service.model.kinds import Normalisation, SlopeOrder
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import rtc_valid_subapertures
from service.model.sensors.pyramid.description import FrameWindows
from service.model.slopes import Orientation, SlopeRecipe, to_rtc
from service.records.estimates import RefusalKind, WideCaptureEstimate, WindowRefused
from service.records.events import ModesRecognised
from service.records.products import MatrixState, ReconstructorRecord
from service.records.state import ModelState
from service.runtime.estimates import read_own_matrix
from service.runtime.worker import OpticsWorker, run_job
from tests.support.lamps import counts_of
from tests.support.small import (
    COMPUTE,
    N_CONTROLLED,
    SIGMA,
    conditions,
    loop_settings,
    small_instrument,
)
from tests.support.states import tracker_state
from tests.support.workbench import ALPHA, FAR, dithered_window, open_loop, window


@pytest.fixture(scope="module")
def bench():
    return OpticsWorker(small_instrument(), COMPUTE)


@pytest.fixture(scope="module")
def aligned(bench):
    return bench.make(
        conditions(Misregistration(), np.diag(SIGMA**2), loop_settings(), 0.95)
    ).matrix


def test_it_describes_the_telemetry_it_expects(bench):
    description = bench.describe()
    assert (description.n_slopes, description.n_modes) == (224, 90)
    assert description.mode_variance_m2.shape == (90,)
    assert np.all(description.mode_variance_m2 > 0.0)


@pytest.mark.parametrize("start", [Misregistration(), ALPHA, replace(ALPHA, shift_x_subap=0.4)])
def test_a_window_gives_back_the_registration_it_was_made_with(bench, aligned, start):
    window = dithered_window(bench, ALPHA, gain=0.6)
    estimate = bench.fit(window, open_loop(aligned), start)
    error = estimate.alpha.vector - ALPHA.vector
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert np.all(np.abs(error) < 4 * sigma + 2e-4)
    np.testing.assert_allclose(np.abs(estimate.optical_gain), 0.6, atol=0.02)


@pytest.mark.parametrize("offset", [0.0, 0.005, 0.011, 0.015, 0.019, 0.03])
def test_no_distance_from_the_last_linearisation_keeps_a_fit_from_settling(bench, aligned, offset):
    bench.fit(dithered_window(bench, ALPHA), open_loop(aligned), ALPHA)
    there = replace(ALPHA, shift_x_subap=ALPHA.shift_x_subap + offset)
    estimate = bench.fit(dithered_window(bench, there, noise=1e-6), open_loop(aligned), ALPHA)
    assert not isinstance(estimate, WindowRefused)
    assert estimate.alpha.shift_x_subap == pytest.approx(there.shift_x_subap, abs=1e-3)


def test_a_second_workbench_finds_the_first_linearisation_prepared(tmp_path, monkeypatch):
    compute = replace(COMPUTE, cache=tmp_path)
    first = OpticsWorker(small_instrument(), compute)
    described = first.describe()
    monkeypatch.setattr(RtcInteractionModel, "linearise", lambda *_: pytest.fail("again"))
    second = OpticsWorker(small_instrument(), compute)
    again = second.describe()
    np.testing.assert_array_equal(again.mode_information, described.mode_information)
    np.testing.assert_array_equal(
        second._sensor.near(Misregistration()).derivatives,
        first._sensor.near(Misregistration()).derivatives,
    )


@pytest.fixture
def linearised(bench, monkeypatch):
    """Where the fine model was linearised."""
    model, taken = bench._sensor._model, []
    linearise = model.linearise
    monkeypatch.setattr(model, "linearise", lambda alpha: taken.append(alpha) or linearise(alpha))
    return taken


def test_a_mirror_that_stays_is_linearised_once_however_windows_scatter(bench, aligned, linearised):
    starts = np.random.default_rng(4).normal(0.0, 0.005, (6, 2))
    for seed, (x, y) in enumerate(starts):
        start = replace(
            ALPHA, shift_x_subap=ALPHA.shift_x_subap + x, shift_y_subap=ALPHA.shift_y_subap + y
        )
        window = dithered_window(bench, ALPHA, noise=0.3, seed=seed)
        estimate = bench.fit(window, open_loop(aligned), start)
        assert np.all(np.abs(estimate.alpha.vector - ALPHA.vector) < [0.1, 0.1, 0.02, 0.01])
    assert len(linearised) <= 1


def test_a_faint_star_does_not_ask_for_a_linearisation_finer_than_its_noise(
    bench, aligned, linearised
):
    start = replace(ALPHA, shift_x_subap=ALPHA.shift_x_subap + 0.05)
    bench._sensor.linearise(start)
    estimate = bench.fit(dithered_window(bench, ALPHA, noise=3.0), open_loop(aligned), start)
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert sigma[0] > 0.02
    assert len(linearised) == 1
    error = estimate.alpha.vector - ALPHA.vector
    assert np.all(np.abs(error) < 4 * sigma)


def test_noise_without_a_signal_is_refused_in_words(bench, aligned):
    window = dithered_window(bench, ALPHA, gain=0.0, noise=1.0)
    outcome = bench.fit(window, open_loop(aligned), Misregistration())
    if not isinstance(outcome, WindowRefused):
        assert np.any(np.sqrt(np.diag(outcome.covariance)) > 0.1)
    else:
        kinds = {"window.unsettled": RefusalKind.OUT_OF_REACH, "window.no-fit": RefusalKind.OTHER}
        assert outcome.kind is kinds[outcome.reason.code]


def test_a_reconstructor_inverts_the_interaction_matrix_of_its_registration(bench):
    made = bench.make(conditions(ALPHA, np.diag(SIGMA**2), loop_settings(), 0.95))
    product = made.matrix @ bench._model.interaction_matrix(ALPHA)[:, :N_CONTROLLED]
    np.testing.assert_allclose(product, np.eye(N_CONTROLLED), atol=1e-3)
    assert made.gate.accepted
    assert 1.0 < made.condition_number < 20.0


def test_the_gate_sees_through_a_reconstructor_for_another_place(bench, aligned):
    far = replace(ALPHA, rotation_rad=np.deg2rad(25.0))
    verdict = bench.judge(aligned, conditions(far, np.diag(SIGMA**2), loop_settings(), 0.95))
    assert not verdict.accepted
    assert verdict.worst_pole_radius > 1.0
    near = bench.judge(
        aligned, conditions(Misregistration(), np.diag(SIGMA**2), loop_settings(), 0.95)
    )
    assert near.accepted


def test_a_gain_beyond_stability_is_refused_however_good_the_matrix(bench):
    made = bench.make(conditions(ALPHA, np.diag(SIGMA**2), loop_settings(gain=1.2), 0.95))
    assert not made.gate.accepted
    assert "unstable" in made.gate.reason


def test_the_watchdog_says_nothing_of_nothing(bench):
    empty = passive.Passive(n_modes=N_CONTROLLED, memory_frames=1000.0)
    assert bench.fit_passive(empty, Misregistration()) is None


def test_a_job_outside_a_worker_process_is_a_programming_error():
    with pytest.raises(RuntimeError, match="not in a worker process"):
        run_job(ModelState(), {}, OpticsWorker.describe)


# --- far from the nominal registration


def test_two_sets_of_modes_find_the_same_place_one_after_the_other(bench):
    first = bench.find(window(bench), None, None)
    assert isinstance(first, WideCaptureEstimate)
    assert np.all(np.abs(first.estimate.alpha.vector - FAR.vector) < COARSE_BAND.floor)
    second = bench.find(window(bench, FINE_BAND), first.estimate.alpha, None)
    assert isinstance(second, WideCaptureEstimate)
    assert np.all(np.abs(second.estimate.alpha.vector - FAR.vector) < FINE_BAND.floor)


def test_light_saves_steps_and_changes_nothing(bench):
    flux = counts_of(small_instrument(), (-1.2, 0.8)).astype("<f4").tobytes()
    lit, dark = bench.find(window(bench), None, flux), bench.find(window(bench), None, None)
    assert isinstance(lit, WideCaptureEstimate)
    assert isinstance(dark, WideCaptureEstimate)
    difference = np.abs(lit.estimate.alpha.vector - dark.estimate.alpha.vector)
    # both are steps to the same minimum of the same window, each ended when it is shorter than this
    assert np.all(difference < [2e-3, 2e-3, 1e-4, 1e-4])


def test_noise_alone_is_no_registration(bench):
    spectra = window(bench, noise=30.0)
    assert isinstance(bench.find(spectra, None, None), WindowRefused)


# --- RTCs with an order, axes, signs and a mounting of their own


NOMINAL_RAD = np.deg2rad(64.5)
DIALECT_ALPHA = Misregistration(
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
def answering_bench(instrument):
    return OpticsWorker(instrument, COMPUTE)


@pytest.fixture(scope="module")
def seen(instrument):
    """The true matrix as such an RTC sees it, from the model in the conventions' axes."""
    model = InteractionModel(instrument, modal_basis(instrument))
    matrix = model.interaction_matrix(DIALECT_ALPHA)
    mask = rtc_valid_subapertures(instrument)
    return to_rtc(matrix, RECIPE, mask)


class Sensor:
    """What ``dithered_window`` asks a workbench for."""

    def __init__(self, matrix):
        self._model = self
        self._matrix = matrix

    def interaction_matrix(self, _alpha):
        return self._matrix


def test_its_telemetry_gives_the_registration_from_the_nominal_rotation(answering_bench, seen):
    reconstructor = answering_bench.make(
        conditions(DIALECT_ALPHA, np.diag(SIGMA**2), loop_settings(), 0.95)
    ).matrix
    answering_bench.describe()
    estimate = answering_bench.fit(
        dithered_window(Sensor(seen), DIALECT_ALPHA), open_loop(reconstructor), None
    )
    error = estimate.alpha.vector - DIALECT_ALPHA.vector
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert np.all(np.abs(error) < 4 * sigma + 2e-4)


def test_its_reconstructor_takes_slopes_as_it_lists_them(answering_bench, seen):
    made = answering_bench.make(conditions(DIALECT_ALPHA, np.diag(SIGMA**2), loop_settings(), 0.95))
    product = made.matrix @ seen[:, :N_CONTROLLED]
    np.testing.assert_allclose(product, np.eye(N_CONTROLLED), atol=1e-3)
    assert made.gate.accepted


def test_what_can_only_be_fitted_offline_is_refused(instrument):
    unknown = replace(instrument, mirror=replace(instrument.mirror, stroke_known=False))
    with pytest.raises(ModelError, match=r"found mirror\.stroke = unknown"):
        OpticsWorker(unknown, COMPUTE)
    with pytest.raises(ModelError, match=r"found wfs\.input = frames"):
        OpticsWorker(replace(instrument, frames=FrameWindows()), COMPUTE)


ALPHA_SMALL = replace(DIALECT_ALPHA, rotation_rad=0.004)


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
    convention = rtc.told.read_slope_convention(rtc.own, None)
    assert named in convention.wrong
    assert convention.found == rtc.setting
    assert not convention.adopted


def test_slopes_of_the_other_sign_are_named_by_the_answer_to_the_dither():
    rtc = Mistold(sign_x=-1, sign_y=-1)
    window = dithered_window(Sensor(rtc.seen), ALPHA_SMALL)
    refused = rtc.told.fit(window, open_loop(rtc.own), None)
    assert refused.kind is RefusalKind.MISDESCRIBED
    assert "slopes have the other sign" in str(refused.reason)
    assert "orientation.sign = -1" in str(refused.reason)


def test_slopes_in_another_order_are_named_by_the_answer_to_the_dither():
    rtc = Mistold(order="interleaved")
    window = dithered_window(Sensor(rtc.seen), ALPHA_SMALL)
    refused = rtc.told.fit(window, open_loop(rtc.own), None)
    assert refused.kind is RefusalKind.MISDESCRIBED
    assert 'slopes.order = "interleaved"' in str(refused.reason)


def test_slopes_two_frames_late_are_not_taken_for_slopes_of_the_other_sign():
    rtc = Mistold()
    window = dithered_window(Sensor(rtc.seen), ALPHA_SMALL)
    turns = 2 * np.pi * np.array(window.plan.bins_hz) / window.plan.frame_rate_hz
    late = window.slopes * np.exp(-2j * turns)[:, :, None]
    outcome = rtc.told.fit(replace(window, slopes=late), open_loop(rtc.own), None)
    assert getattr(outcome, "kind", None) is not RefusalKind.MISDESCRIBED


def test_an_orientation_left_open_is_found_in_the_rtcs_own_matrix_and_taken_over():
    rtc = Mistold(order="yx", flip_y=True, sign_x=-1)
    convention = rtc.auto.read_slope_convention(rtc.own, None)
    assert convention.adopted
    assert convention.found == rtc.setting
    made = rtc.auto.make(conditions(ALPHA_SMALL, np.diag(SIGMA**2), loop_settings(), 0.95))
    product = made.matrix @ rtc.seen[:, :N_CONTROLLED]
    np.testing.assert_allclose(product, np.eye(N_CONTROLLED), atol=1e-3)


def test_a_matrix_that_no_orientation_explains_leaves_nothing_to_take_over():
    rtc = Mistold()
    noise = np.random.default_rng(1).normal(size=rtc.own.shape).astype(np.float32)
    convention = rtc.auto.read_slope_convention(noise * np.abs(rtc.own).mean(), None)
    assert "no orientation explains" in convention.wrong
    assert convention.found is None


@pytest.mark.parametrize(
    ("metres", "named"),
    [(1e-9, "nanometres"), (2.0, "surface")],
)
def test_commands_in_another_unit_are_named_by_the_rtcs_own_matrix(metres, named):
    rtc = Mistold()
    convention = rtc.told.read_slope_convention((rtc.own / metres).astype(np.float32), None)
    assert named in convention.wrong


@pytest.mark.parametrize(
    ("ratio", "said"),
    [
        (1.9, "wavelength_m or modulation_lambda_over_d is too large"),
        (2.7, "wavelength_m or modulation_lambda_over_d is too large"),
        (120, "wavelength_m or modulation_lambda_over_d is too large"),
        (1 / 15, "wavelength_m or modulation_lambda_over_d is too small"),
        (1 / 120, "slopes have another unit"),
    ],
)
def test_a_factor_names_every_cause_that_makes_it(ratio, said):
    """Slopes in another unit, or a pyramid's wavelength or modulation: the factor is the same."""
    rtc = Mistold()
    wrong = rtc.told.read_slope_convention((rtc.own / ratio).astype(np.float32), None).wrong
    assert "slopes" in wrong.partition("model's slopes")[2]
    assert said in wrong


def test_commands_in_another_unit_are_named_by_the_answer_to_the_dither():
    rtc = Mistold()
    window = dithered_window(Sensor(rtc.seen), ALPHA_SMALL)
    in_nm = replace(window, commands=window.commands * 1e9, dither=window.dither * 1e9)
    refused = rtc.told.fit(in_nm, open_loop(rtc.own), None)
    assert refused.kind is RefusalKind.MISDESCRIBED
    assert "nanometres" in str(refused.reason)


def test_what_is_as_told_is_not_complained_of():
    rtc = Mistold()
    for answering_bench in (rtc.told, rtc.auto):
        assert not answering_bench.read_slope_convention(rtc.own, None).wrong
        found = answering_bench.fit(
            dithered_window(Sensor(rtc.seen), ALPHA_SMALL), open_loop(rtc.own), None
        )
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


# --- what the RTC's own matrix tells of its modes goes into every matrix that is made from then


@pytest.fixture
def plain_bench():
    return OpticsWorker(small_instrument(), COMPUTE)


def made_by(plain_bench):
    return plain_bench.make(conditions(ALPHA, np.diag(SIGMA**2), loop_settings(), 0.95))


def own(plain_bench, scale):
    """The RTC's matrix by day, elsewhere, for modes that answer so many times as drawn."""
    response = plain_bench.response(Misregistration())[:, :N_CONTROLLED].astype(float)
    return np.linalg.pinv(response * scale).astype(np.float32)


@pytest.mark.parametrize("scale", [0.5, np.where(np.arange(N_CONTROLLED) == 10, 3.0, 1.0)])
def test_a_matrix_acts_as_strongly_as_the_rtcs_own(plain_bench, scale):
    theirs, plain = own(plain_bench, scale), made_by(plain_bench)
    truth = plain_bench.response(ALPHA)[:, :N_CONTROLLED] * scale
    found = plain_bench.recognise(theirs, None, None)
    response = plain_bench.state.response
    assert found.wrong == ""
    np.testing.assert_allclose(response[:N_CONTROLLED], scale * np.ones(N_CONTROLLED), rtol=0.02)
    made = made_by(plain_bench)
    np.testing.assert_allclose(np.diag(made.matrix @ truth), 1.0, atol=0.02)
    # judged with the response it has, the loop is the one of before
    assert made.gate.worst_pole_radius == pytest.approx(plain.gate.worst_pole_radius, abs=5e-3)


def test_telemetry_is_then_compared_with_that_response(plain_bench):
    window = dithered_window(plain_bench, ALPHA, gain=0.5)
    reconstructor = own(plain_bench, 0.5)
    plain_bench.recognise(reconstructor, None, None)
    estimate = plain_bench.fit(window, open_loop(reconstructor), None)
    np.testing.assert_allclose(np.abs(estimate.optical_gain), 1.0, atol=0.05)
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert np.all(np.abs(estimate.alpha.vector - ALPHA.vector) < 4 * sigma + 2e-4)


def test_a_matrix_that_answers_as_drawn_changes_nothing(plain_bench):
    before = plain_bench.response(ALPHA)
    found = plain_bench.recognise(own(plain_bench, 1.05), None, None)
    assert plain_bench.state.response is None
    assert found.known.all()
    np.testing.assert_array_equal(plain_bench.response(ALPHA), before)


def test_a_wide_modulation_on_few_subapertures_takes_nothing_over_from_an_exact_matrix():
    """With two pupil points per subaperture 7 lambda/D alias: responses were wrong by up to 2.7."""
    small = small_instrument()
    wfs = replace(small.wfs, n_subapertures=10, modulation_lambda_over_d=7.0)
    wide = OpticsWorker(replace(small, wfs=wfs), COMPUTE)
    found = wide.recognise(own(wide, 1.0), None, None)
    assert wide.state.response is None
    assert found.known.all()
    assert found.typical_misfit < 0.05
    np.testing.assert_allclose(found.alpha.vector, [0.0, 0.0, 0.0, 1.0], atol=2e-3)


def test_nothing_is_taken_over_from_a_matrix_of_other_modes(plain_bench):
    turned = np.where(np.arange(N_CONTROLLED) == 10, -0.5, 0.5)
    found = plain_bench.recognise(own(plain_bench, turned), None, None)
    assert "mode 10 has the other sign" in found.wrong
    assert plain_bench.state.response is None


def test_a_new_worker_is_told_what_the_last_one_found(plain_bench):
    plain_bench.recognise(own(plain_bench, 0.5), None, None)
    another = OpticsWorker(small_instrument(), COMPUTE)
    another.restore(plain_bench.state, plain_bench.arrays)
    np.testing.assert_allclose(another.response(ALPHA), plain_bench.response(ALPHA), rtol=1e-5)


def test_a_new_worker_judges_loops_with_the_measured_response_too(plain_bench):
    """What the model does not explain of the RTC's own matrix weakens the loop of its inverse."""
    rng = np.random.default_rng(4)
    response = plain_bench.response(Misregistration())[:, :N_CONTROLLED].astype(float)
    error = rng.standard_normal(response.shape)
    error *= 0.4 * np.linalg.norm(response, axis=0) / np.linalg.norm(error, axis=0)
    plain_bench.recognise(np.linalg.pinv(response + error).astype(np.float32), None, None)
    another = OpticsWorker(small_instrument(), COMPUTE)
    plain = made_by(another).gate.worst_pole_radius
    another.restore(plain_bench.state, plain_bench.arrays)
    radius = made_by(plain_bench).gate.worst_pole_radius
    assert made_by(another).gate.worst_pole_radius == pytest.approx(radius, abs=1e-3)
    assert radius > plain + 0.01


async def test_after_a_restart_the_rtcs_own_matrix_is_read_and_not_the_one_made_of_the_model(
    plain_bench,
):
    """The one in use agrees with the model in everything: it tells nothing of its error."""
    rng = np.random.default_rng(4)
    response = plain_bench.response(Misregistration())[:, :N_CONTROLLED].astype(float)
    error = rng.standard_normal(response.shape)
    error *= 0.3 * np.linalg.norm(response, axis=0) / np.linalg.norm(error, axis=0)
    matrices = {
        "own": np.linalg.pinv(response + error).astype(np.float32),
        "made": made_by(plain_bench).matrix,
    }
    theirs, made = (
        ReconstructorRecord(
            id=name,
            state=MatrixState.APPLIED,
            n_modes=N_CONTROLLED,
            created_ns_utc=0,
            parent=parent,
        )
        for name, parent in (("own", None), ("made", "own"))
    )
    state = tracker_state(system="small", reconstructors=(theirs, made), in_use="made")

    async def read(known):
        workers = OwnHands(OpticsWorker(small_instrument(), COMPUTE))
        found = await read_own_matrix(made, matrices["made"], state, workers, known)
        return next(event for event in found if isinstance(event, ModesRecognised))

    assert (await read(matrices.__getitem__)).misfit == pytest.approx(0.3, abs=0.03)

    def lost(name):
        raise UnknownIdError(name)

    assert (await read(lost)).misfit < 0.02


async def test_a_worker_that_dies_of_the_rtcs_own_matrix_takes_no_slope_order_with_it():
    """The next one recognises the modes, by the order that the dead one has found."""
    rtc = Mistold(order="yx", flip_y=True, sign_x=-1)
    record = ReconstructorRecord(
        id="own", state=MatrixState.APPLIED, n_modes=N_CONTROLLED, created_ns_utc=0
    )
    state = tracker_state(system="small", reconstructors=(record,), in_use="own")

    class Dying(OwnHands):
        died = False

        async def call(self, job, *args, **kwargs):
            if job is OpticsWorker.recognise and not self.died:
                self.died = True
                self._workbench = OpticsWorker(rtc.auto._file, COMPUTE)
                raise WorkerError("the worker process died during recognise")
            return await super().call(job, *args, **kwargs)

    workers = Dying(rtc.auto)
    found = await read_own_matrix(record, rtc.own, state, workers, None)
    (recognised,) = (event for event in found if isinstance(event, ModesRecognised))
    assert (recognised.strange, recognised.misfit < 0.05) == ((), True)
    assert workers.model().slopes[0] == "yx"
    assert workers.model().own_matrix_read


N_MORE = 79
"""Modes of a matrix that controls more than the RTC's own; beyond, the edge would slip."""


def a_window_of_free_modes(response, noise=1e-3):
    """Two seconds of an open loop whose modes 45 to 89 are dithered together."""
    rng, time = np.random.default_rng(2), np.arange(2000) / 1000.0
    modes = tuple(range(N_CONTROLLED, 90))
    lines = tuple(160.0 + 6.0 * k for k in range(len(modes)))
    dither = np.zeros((len(time), 90), np.float32)
    for mode, line in zip(modes, lines, strict=True):
        dither[:, mode] = 1e-9 * np.sqrt(2) * np.sin(2 * np.pi * line * time)
    scatter = noise * rng.standard_normal((len(time), len(response)))
    block = FrameBlock(
        session="s1",
        first_seq=0,
        t0_ns_utc=0,
        dt_ns=1_000_000,
        slopes=(dither @ response.T + scatter).astype(np.float32),
        commands_m=dither,
        dither_m=dither,
        cm_id="initial",
    )
    plan = LockInPlan(
        modes=modes,
        frequencies_hz=lines,
        amplitude_m=(1e-9,) * len(modes),
        frame_rate_hz=1000.0,
        n_frames=len(time),
        first_seq=0,
    )
    _, (window,) = LockIn(plan=plan).accumulate(block)
    return window


def test_a_loop_is_judged_with_the_dithered_response_of_modes_that_the_rtc_does_not_control(
    plain_bench,
):
    """The model's error of the modes above those of the RTC's own matrix makes the loop unstable.

    The error of pairs of modes exchanges them in part: each responds as the other, too, with
    opposite signs, so that the eigenvalues of g R D are about 0.4 (1 ± 1.3 i).
    """
    start = Misregistration()
    model = plain_bench.response(start).astype(float)
    first, second = np.arange(N_CONTROLLED, 89, 2), np.arange(N_CONTROLLED + 1, 90, 2)
    truth = model.copy()
    # Of random sense, because a rotation of the mirror exchanges all pairs in one sense.
    ratio = 1.3 * np.random.default_rng(3).choice([-1.0, 1.0], len(first))
    truth[:, first] += ratio * model[:, second]
    truth[:, second] -= ratio * model[:, first]
    own = np.linalg.pinv(truth[:, :N_CONTROLLED]).astype(np.float32)
    found = plain_bench.recognise(own, None, None)
    assert found.known.all()
    more = conditions(start, np.diag(SIGMA**2), loop_settings(N_MORE), 0.95)
    inverse = np.linalg.pinv(model[:, :N_MORE]).astype(np.float32)
    assert plain_bench.judge(inverse, more).accepted
    plain_bench.fit(a_window_of_free_modes(truth), open_loop(own), start)
    verdict = plain_bench.judge(inverse, more)
    poles = loop_settings(N_MORE).pole_radius(np.linalg.eigvals(0.4 * inverse @ truth[:, :N_MORE]))
    assert poles.max() > 1.0
    assert verdict.worst_pole_radius >= poles.max()
    assert not verdict.accepted
    # a matrix of the RTC's own modes alone is judged as before
    fewer = conditions(start, np.diag(SIGMA**2), loop_settings(), 0.95)
    assert plain_bench.judge(inverse[:N_CONTROLLED], fewer).accepted


def test_a_window_of_a_right_model_changes_no_verdict(plain_bench):
    start = Misregistration()
    truth = plain_bench.response(start).astype(float)
    own = np.linalg.pinv(truth[:, :N_CONTROLLED]).astype(np.float32)
    plain_bench.recognise(own, None, None)
    more = conditions(start, np.diag(SIGMA**2), loop_settings(N_MORE), 0.95)
    inverse = np.linalg.pinv(truth[:, :N_MORE]).astype(np.float32)
    before = plain_bench.judge(inverse, more).worst_pole_radius
    plain_bench.fit(a_window_of_free_modes(truth), open_loop(own), start)
    assert plain_bench.judge(inverse, more).worst_pole_radius == pytest.approx(before, abs=0.02)


@pytest.mark.parametrize(("error", "counts"), [(0.02, False), (0.3, True)])
def test_where_the_model_is_poor_the_noise_of_a_dither_counts_as_its_error(
    plain_bench, error, counts
):
    start, rng = Misregistration(), np.random.default_rng(4)
    truth = plain_bench.response(start).astype(float)
    part = rng.standard_normal((len(truth), N_CONTROLLED))
    part *= error * np.linalg.norm(truth[:, :N_CONTROLLED], axis=0) / np.linalg.norm(part, axis=0)
    truth[:, :N_CONTROLLED] += part
    plain_bench.recognise(np.linalg.pinv(truth[:, :N_CONTROLLED]).astype(np.float32), None, None)
    more = conditions(start, np.diag(SIGMA**2), loop_settings(N_MORE), 0.95)
    inverse = np.linalg.pinv(plain_bench.response(start)[:, :N_MORE]).astype(np.float32)
    before = plain_bench.judge(inverse, more).worst_pole_radius
    own = np.zeros((0, len(truth)), np.float32)
    plain_bench.fit(a_window_of_free_modes(truth, noise=0.1), open_loop(own), start)
    raised = plain_bench.judge(inverse, more).worst_pole_radius - before
    assert raised > 0.1 if counts else raised < 0.02
