from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.fitting.uncertainty import (
    EXACT_RESIDUAL,
    FAR_SHARE,
    STRANGE_RESIDUAL,
    misplacement_sigma,
)
from pyrcal_studies.drawn_fits import Condition, Draw, fitted, measured
from service.errors import ModelError
from service.estimation.reference import Reference
from service.model.instrument import Mirror, TabulatedModes
from service.model.kinds import Method, Stop
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import Illumination
from tests.support.bench import ELSEWHERE, GRID, PLAIN, error, fit, instrument, matrix
from tests.support.numerics import small_basis


def from_here(*steps: float) -> FitOptions:
    """Options with a start that is off by subapertures, subapertures, degrees, ratio."""
    start = ELSEWHERE.vector + np.array(steps) * [1.0, 1.0, np.pi / 180, 1.0]
    return FitOptions(start=Misregistration.from_vector(start), orientation=PLAIN)


@pytest.mark.parametrize("stop", list(Stop))
def test_a_noise_free_matrix_of_a_finer_grid_is_recovered(stop):
    about = replace(instrument(), stop=stop)
    found = fit(matrix(about=about), about)
    assert found.accepted
    assert found.converged
    assert np.all(np.abs(error(found)) < GRID)
    np.testing.assert_allclose(found.gains, 1.0, atol=0.02)
    assert found.residual_fraction < 0.01


def test_errors_of_noisy_matrices_are_those_that_sigma_says():
    chi = []
    for seed in range(6):
        found = fit(matrix(noise=0.2, seed=seed), options=from_here(0.1, 0.1, 0.2, 0.0))
        chi.append(error(found) @ np.linalg.solve(found.covariance, error(found)))
    # 6 draws of a chi-squared of 4 degrees: mean 4 +- 1.2; the floor makes it smaller
    assert 0.8 < np.mean(chi) < 7.6


def test_a_place_of_the_grid_that_is_not_known_is_in_sigma_of_a_shift():
    options = from_here(0.1, 0.1, 0.2, 0.0)
    found = [
        fit_matrix(
            instrument(),
            Reference(matrix=matrix(), place_sigma_subap=sigma),
            options,
            basis=small_basis(),
        ).sigma
        for sigma in (0.0, 0.03)
    ]
    assert np.allclose(found[1][:2], np.hypot(found[0][:2], 0.03), rtol=0.01)
    assert np.allclose(found[1][2:], found[0][2:])


def test_far_shifts_are_less_sure_by_a_share_of_themselves_where_the_mirror_may_be_another():
    """The errors of a model whose mirror is of another kind grow with the shift."""
    far = replace(ELSEWHERE, shift_x_subap=0.9, shift_y_subap=0.3)
    near = replace(ELSEWHERE, shift_x_subap=0.0, shift_y_subap=0.0)
    strange = 1.2 * STRANGE_RESIDUAL
    sigma = [np.sqrt(fit(matrix(alpha, noise=strange)).covariance[0, 0]) for alpha in (near, far)]
    assert sigma[1] > FAR_SHARE[0] * np.hypot(0.9, 0.3)
    assert sigma[0] < sigma[1]


def test_a_far_shift_of_a_mirror_that_is_no_other_is_as_sure_as_it_is_right():
    """A matrix of the very modes of the file, as other codes make them, leaves next to nothing."""
    far = replace(ELSEWHERE, shift_x_subap=0.9, shift_y_subap=0.3)
    found = fit(matrix(far))
    assert found.residual_fraction < STRANGE_RESIDUAL / 5.0
    sigma = np.sqrt(found.covariance[0, 0])
    assert abs(error(found, far)[0]) < 2.0 * sigma
    # other diameters, light and places of the pupil, which the matrix does not exclude, are in it
    assert found.registration.sigma_statistical[0] < 0.5 * FAR_SHARE[0] * np.hypot(0.9, 0.3)
    assert sigma < 0.002


@pytest.mark.parametrize("signs", [(1, 1, 1, 1), (-1, 1, 1, -1)])
def test_starts_at_the_corners_of_the_capture_range_lead_to_the_same_place(signs):
    found = fit(matrix(), options=from_here(*(np.array(signs) * [1.5, 1.5, 6.0, 0.05])))
    assert found.accepted
    assert np.all(np.abs(error(found)) < GRID)


def test_a_start_from_which_nothing_is_found_is_refused():
    found = fit(matrix(), options=from_here(0.0, 0.0, 60.0, 0.0))
    assert not found.accepted
    assert found.verdict.startswith("refused: ")
    assert not found.converged


def test_few_modes_suffice():
    found = fit(matrix(noise=0.05)[:, :9])
    assert found.accepted
    assert list(found.modes) == list(range(9))
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(error(found)) < 3.0 * sigma)


def test_modes_may_be_any_of_those_measured():
    kept = np.array([30, 2, 17, 5, 9, 12, 21, 33])
    found = fit(matrix(), options=FitOptions(modes=kept))
    assert list(found.modes) == list(kept)
    assert np.all(np.abs(error(found)) < 2.0 * GRID)


def test_a_mode_that_was_not_measured_cannot_be_used():
    with pytest.raises(ModelError, match="modes: 35 "):
        fit(matrix()[:, :30], options=FitOptions(modes=np.array([1, 35])))


@pytest.mark.parametrize("method", [Method.PAPER, Method.SENSITIVITY])
def test_the_other_methods_find_the_same(method):
    options = replace(from_here(0.1, -0.15, 0.3, 0.004), method=method)
    found = fit(matrix(), options=options)
    assert found.accepted
    # the scans end with steps of 2 % of a subaperture on a coarser grid
    assert np.all(np.abs(error(found)) < 4.0 * GRID)
    assert (found.paper_table is not None) == (method is Method.PAPER)


def test_an_rtc_that_turns_its_slope_axes_does_not_turn_the_registration():
    along_x, along_y = np.split(matrix(), 2)
    angle = np.deg2rad(1.0)
    turned = np.concatenate(
        [
            np.cos(angle) * along_x - np.sin(angle) * along_y,
            np.sin(angle) * along_x + np.cos(angle) * along_y,
        ]
    )
    found = fit(turned)
    assert abs(np.rad2deg(error(found)[2])) < 0.005


def test_known_light_takes_its_error_away():
    coordinates = np.linspace(-7.0, 7.0, 57)
    x, y = np.meshgrid(coordinates, coordinates)
    light = Illumination(
        coordinates=coordinates, intensity=1.0 + 0.3 * np.sin(1.07 * x + 0.38 * y + 0.7)
    )
    measured = matrix(illumination=light)
    even, lit = FitOptions(find_light=False), FitOptions(illumination=light)
    assumed_even, known = (fit(measured, options=one) for one in (even, lit))
    assert assumed_even.residual_fraction > 0.15
    assert known.residual_fraction < 0.01
    assert np.all(np.abs(error(known)) < GRID)


def test_nine_modes_under_thirty_percent_of_static_structure_are_accepted_with_an_honest_sigma():
    coordinates = np.linspace(-7.0, 7.0, 57)
    x, y = np.meshgrid(coordinates, coordinates)
    light = Illumination(
        coordinates=coordinates, intensity=1.0 + 0.3 * np.sin(1.07 * x + 0.38 * y + 0.7)
    )
    found = fit(matrix(illumination=light)[:, :9])
    assert found.accepted
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(error(found)) < 2.5 * sigma)


GAIN_SHAPES = {
    "along x": lambda x, y: x,
    "along the diagonal": lambda x, y: (x + y) / np.sqrt(2.0),
    "defocus": lambda x, y: x**2 + y**2 - 0.5,
    "astigmatism": lambda x, y: x**2 - y**2,
    "coma": lambda x, y: (3.0 * (x**2 + y**2) - 2.0) * x,
}
"""Odd and even over the pupil; x and y reach 1 at its edge."""


@pytest.mark.parametrize("shape", GAIN_SHAPES)
def test_a_large_smooth_gain_moves_nothing_by_its_sigma_when_a_map_is_fitted(shape):
    """Multiplied by D of the start, the map left magnification 8 and anamorphosis 21 sigma off."""
    valid = fit(matrix()).valid
    y, x = (np.stack(np.nonzero(valid)) - (len(valid) - 1) / 2) / (len(valid) / 2)
    gain = 1.0 + 0.5 * GAIN_SHAPES[shape](x, y)
    found = fit(matrix() * np.tile(gain, 2)[:, None], options=FitOptions(gain_map=True))
    assert found.accepted
    assert np.all(np.abs(error(found)) < 1.5 * found.sigma)
    assert np.all(np.abs(found.alpha.stretches) < 1.5 * found.anamorphosis_sigma)
    np.testing.assert_allclose(found.gain_map[valid], gain / gain.mean(), atol=0.02)


@pytest.mark.parametrize("stretches", [(-0.003, 0.002), (0.02, -0.02)])
def test_a_stretched_image_of_the_mirror_is_found_unasked(stretches):
    """2.8 % is more than any telescope's; the largest of GPAO is 1.9 %."""
    found = fit(matrix(ELSEWHERE.with_anamorphosis(np.array(stretches))))
    assert found.accepted
    np.testing.assert_allclose(found.anamorphosis, stretches, atol=2e-4)
    assert np.all(np.abs(found.anamorphosis - stretches) < 3.0 * found.anamorphosis_sigma)
    assert np.all(np.abs(error(found)) < GRID)


@pytest.mark.parametrize("seed", [306, 311, 324])
def test_sigma_of_the_anamorphosis_holds_errors_of_the_model_on_the_diffractive_plant(seed):
    """No anamorphosis there; with the scatter of regions alone it was 4.2 to 4.9 sigma off."""
    unmodulated = Condition(modulation_lambda_over_d=0.0)
    draw = Draw(code="diffractive", condition=unmodulated, seed=seed)
    found = fitted(draw, next(measured([draw]))[1])
    assert np.all(np.abs(found.alpha.stretches) < 3.0 * found.anamorphosis_sigma)


def test_the_fit_of_a_stretched_mirror_begins_where_the_file_says():
    about = instrument()
    mount = replace(about.mirror, nominal_anamorphosis=(0.02, -0.01))
    about = replace(about, mirror=mount)
    found = fit(matrix(about=about), about, FitOptions(anamorphosis=False))
    assert found.anamorphosis is None
    assert found.alpha.anamorphosis == (0.02, -0.01)
    assert np.all(np.abs(error(found)) < GRID)


def test_noisy_tip_and_tilt_alone_tell_of_no_anamorphosis():
    """They look almost alike however the image is stretched: the fit says that it cannot tell."""
    stretched = ELSEWHERE.with_anamorphosis(np.array([0.01, 0.0]))
    found = fit(matrix(stretched, noise=0.5)[:, :2], options=from_here(0.0, 0.0, 0.0, 0.0))
    assert found.anamorphosis is None
    assert np.all(found.anamorphosis_sigma > 0.01)


def test_silent_subapertures_do_not_count():
    silent = matrix()
    silent[[7, 7 + len(silent) // 2]] = 0.0
    found = fit(silent)
    assert np.all(np.abs(error(found)) < GRID)
    assert any(sentence.startswith("2 of") for sentence in found.left_out)


def test_double_pass_is_divided_out():
    found = fit(2.0 * matrix(), double_pass=True)
    assert found.accepted
    np.testing.assert_allclose(found.gains, 1.0, atol=0.02)


@pytest.mark.parametrize(("images", "most"), [(((0.0, 0.0),) * 4, 40), (None, 80)])
def test_the_number_of_evaluations_is_small(images, most):
    """Places of the pupil images that the file does not state are fitted as well, in twice."""
    about = instrument()
    about = replace(about, wfs=replace(about.wfs, image_offsets_subap=images))
    found = fit(matrix(), about, options=from_here(0.2, 0.1, 0.5, 0.01))
    assert (found.image_offsets_px is None) == (images is not None)
    assert found.n_evaluations < most


def test_misplaced_actuators_are_in_sigma_as_far_as_the_residual_has_room_for_them():
    """Rotation of n points, each wrong by p: p / (sqrt(n) r), here 4 points at radius 2."""
    corners = np.array([[2.0, 0.0], [0.0, 2.0], [-2.0, 0.0], [0.0, -2.0]])
    mirror = Mirror(positions_m=corners, pitch_m=1.0, position_error_pitch=0.05)
    sigma = misplacement_sigma(mirror, 1.5, 0.5, residual=0.1)
    np.testing.assert_allclose(sigma, [0.05, 0.05, 0.0125, 0.0125])
    assert not misplacement_sigma(mirror, 0.5, 0.5, residual=0.1).any()
    room = np.sqrt(0.03**2 - EXACT_RESIDUAL**2) / 0.05
    np.testing.assert_allclose(misplacement_sigma(mirror, 1.5, 0.5, residual=0.03), sigma * room)
    assert not misplacement_sigma(mirror, 1.5, 0.5, residual=EXACT_RESIDUAL).any()
    unstated = replace(mirror, position_error_pitch=None)
    np.testing.assert_allclose(misplacement_sigma(unstated, 1.5, 0.5, residual=0.1), sigma * 0.4)


# --- tables


FAR = Misregistration(
    shift_x_subap=0.55, shift_y_subap=-0.3, rotation_rad=np.deg2rad(1.0), magnification=0.995
)

STEP_SUBAP = 0.25


@pytest.mark.parametrize("half_subap", [6.0, 7.5])
def test_a_table_that_ends_at_the_pupil_costs_slopes_and_no_accuracy(half_subap):
    line = np.arange(-7.5, 7.51, STEP_SUBAP)
    x, y = np.meshgrid(line, line)
    shapes = small_basis().render(np.column_stack([x.ravel(), y.ravel()]))
    known = np.hypot(x, y) <= half_subap
    cube = np.where(known, shapes.T.reshape(-1, *x.shape), 0.0)
    about = instrument()
    table = TabulatedModes(cube=cube, pitch_m=STEP_SUBAP * about.subaperture_m, known=known)
    about = replace(about, mirror=table)
    found = fit_matrix(about, Reference(matrix=matrix(FAR)), basis=modal_basis(about))
    assert found.accepted
    # 0.06 % of a subaperture was seen with every filling of the unknown part
    assert np.all(np.abs(error(found, FAR)[:2]) < 2e-3)
    assert bool(found.left_out) == (half_subap < 7.0)


def test_single_actuators_are_a_basis_too():
    strokes = small_basis().mode_to_actuator
    poked = small_basis().combine_modes(np.linalg.pinv(strokes)[:, ::3])
    found = fit_matrix(instrument(None), Reference(matrix=matrix(FAR, basis=poked)), basis=poked)
    assert found.accepted
    assert np.all(np.abs(error(found, FAR)[:2]) < 2e-3)
