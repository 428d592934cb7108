"""D(α) = K(shift) Φ(rotation, magnification), its derivatives and its symmetries."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import numpy as np
import pytest

from service.model.interaction import InteractionModel, RtcInteractionModel
from service.model.kinds import SlopeOrder, Stop
from service.model.misregistration import Misregistration, rotation
from service.model.modes import ModalBasis, karhunen_loeve_basis
from service.model.pupil import instrument_pupil
from service.model.sensors.pyramid.optics import PyramidOptics
from service.model.sensors.pyramid.signals import reference_slopes
from service.model.slopes import Orientation, SlopeRecipe, to_conventions
from tests.support.numerics import (
    SOMEWHERE,
    flao_basis,
    flao_matrix,
    flao_model,
    small_basis,
    small_instrument,
    small_linearisation,
    small_model,
)

ALIGNED = Misregistration()


def relative(found, expected):
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def moved(alpha: Misregistration, axis: int, step: float) -> Misregistration:
    return alpha.add_step(step * np.eye(4)[axis])


# --- axes and signs


def test_one_degree_moves_the_border_by_a_quarter_subaperture():
    """15 x 0.01745 = 0.26, the paper's own figure, from +x towards +y."""
    border = np.array([15.0, 0.0])
    step = rotation(np.deg2rad(1.0)) @ border - border
    assert np.linalg.norm(step) == pytest.approx(0.26, abs=0.005)
    assert step[1] == pytest.approx(15 * 0.01745, rel=1e-3)


@pytest.mark.parametrize("stop", Stop)
def test_pupil_points_are_traced_back_to_the_mirror_point_that_lands_on_them(stop):
    """p_wfs = m R p_mirror + shift; with the mirror as stop the images carry the shift."""
    model = small_model(stop)
    mirror = model._mirror_points(SOMEWHERE)
    landed = SOMEWHERE.magnification * mirror @ rotation(SOMEWHERE.rotation_rad).T
    if stop is Stop.TELESCOPE:
        landed = landed + SOMEWHERE.vector[:2]
    np.testing.assert_allclose(landed, model.pupil.points, atol=1e-12)


STRETCHED = SOMEWHERE.with_anamorphosis(np.array([0.03, -0.02]))


@pytest.mark.parametrize("stop", Stop)
def test_a_stretched_image_lands_along_the_sensors_axes(stop):
    """p_wfs = S m R p_mirror + shift: turned first, stretched on the sensor."""
    model = small_model(stop)
    mirror = model._mirror_points(STRETCHED)
    turned = SOMEWHERE.magnification * mirror @ rotation(SOMEWHERE.rotation_rad).T
    landed = turned @ [[1.03, -0.02], [-0.02, 0.97]]
    if stop is Stop.TELESCOPE:
        landed = landed + SOMEWHERE.vector[:2]
    np.testing.assert_allclose(landed, model.pupil.points, atol=1e-12)


@pytest.mark.parametrize("stop", Stop)
def test_nobody_having_told_an_anamorphosis_it_is_the_files(stop):
    model = small_model(stop)
    mirror = replace(model.instrument.mirror, nominal_anamorphosis=(0.03, -0.02))
    told = InteractionModel(replace(model.instrument, mirror=mirror), model.basis)
    np.testing.assert_array_equal(
        told.interaction_matrix(SOMEWHERE), told.interaction_matrix(STRETCHED)
    )
    flat = told.interaction_matrix(SOMEWHERE.with_anamorphosis(np.zeros(2)))
    assert relative(flat, told.interaction_matrix(SOMEWHERE)) > 0.01


@pytest.mark.parametrize("stop", Stop)
@pytest.mark.parametrize("axis", [0, 1])
def test_derivatives_by_a_stretch_are_exact(stop, axis):
    model = small_model(stop, double=True)
    step = 1e-4 * np.eye(2)[axis]
    ahead, behind = (
        model.interaction_matrix(STRETCHED.with_anamorphosis(STRETCHED.stretches + s))
        for s in (step, -step)
    )
    assert relative(model.stretch_derivatives(STRETCHED)[axis], (ahead - behind) / 2e-4) < 1e-5


@pytest.mark.parametrize("stop", Stop)
def test_all_derivatives_together_are_those_one_by_one(stop):
    model = small_model(stop, double=True)
    together = model.derivatives(STRETCHED, with_stretches=True)
    assert relative(together[:4], model.derivatives(STRETCHED)) < 1e-9
    assert relative(together[4:], model.stretch_derivatives(STRETCHED)) < 1e-9


def test_rendered_modes_are_shared_by_models_of_the_same_pupil_only():
    about, basis = small_model(Stop.MIRROR).instrument, small_basis()
    model = InteractionModel(about, basis)
    expected = model.interaction_matrix(SOMEWHERE)
    same = InteractionModel(
        replace(about, wfs=replace(about.wfs, modulation_lambda_over_d=5.0)), basis
    )
    wider = InteractionModel(replace(about, obscuration_ratio=0.5), basis)
    for other, is_shared in ((same, True), (wider, False)):
        alone = other.interaction_matrix(SOMEWHERE)
        other.forget()
        other.share_modes(model)
        assert (other._modes is model._modes) is is_shared
        np.testing.assert_array_equal(other.interaction_matrix(SOMEWHERE), alone)
    model.forget()
    np.testing.assert_array_equal(model.interaction_matrix(SOMEWHERE), expected)


@pytest.mark.parametrize("stop", Stop)
@pytest.mark.parametrize("axis", [0, 1, 2, 3])
def test_the_other_derivatives_are_of_the_stretched_image(stop, axis):
    if stop is Stop.MIRROR and axis < 2:
        pytest.skip("a shift of the images is exact with more nodes only")
    model = small_model(stop, double=True)
    ahead, behind = (model.interaction_matrix(moved(STRETCHED, axis, s)) for s in (1e-4, -1e-4))
    assert relative(model.derivatives(STRETCHED)[axis], (ahead - behind) / 2e-4) < 1e-5


@pytest.mark.parametrize("stop", Stop)
@pytest.mark.parametrize("axis", [0, 1])
def test_a_wavefront_rising_along_an_axis_gives_positive_mean_slopes_on_that_axis_only(stop, axis):
    """1e-4 of cross-talk: float32 sums over a symmetric pupil."""
    model = small_model(stop)
    slopes = model.measure_signals(ALIGNED, model.pupil.points[:, [axis]])
    mean = slopes.reshape(2, -1).mean(axis=1)
    assert mean[axis] > 0
    assert abs(mean[1 - axis]) < 1e-4 * mean[axis]


def test_the_full_instrument_sees_mode_zero_along_x_and_mode_one_along_y():
    mean = flao_matrix()[:, :2].reshape(2, -1, 2).mean(axis=1)
    assert mean[0, 0] > 0
    assert mean[1, 1] > 0
    assert np.abs(mean[[0, 1], [1, 0]]).max() < 0.01 * mean[0, 0]


# --- the full instrument's figures


def test_the_full_instrument_has_1408_slopes():
    assert flao_model().n_slopes == 1408
    assert flao_matrix().shape == (1408, 594)


def test_condition_number_of_400_modes_is_the_papers():
    """8.1 in the paper, 8.26 in an established simulator, 8.32 here."""
    singular = np.linalg.svd(flao_matrix()[:, :400], compute_uv=False)
    assert 8.0 <= singular[0] / singular[-1] <= 9.0


def test_the_full_instrument_spread_over_threads_gives_the_same_matrix():
    model = flao_model()
    with ThreadPoolExecutor(2) as threads:
        spread = InteractionModel(model.instrument, flao_basis(), mapper=threads.map)
        np.testing.assert_array_equal(spread.interaction_matrix(ALIGNED), flao_matrix())


# --- derivatives


def derivative_error(stop: Stop, nodes: int, axis: int) -> float:
    model = small_model(stop, nodes=nodes, double=True)
    step = 1e-4
    ahead, behind = (model.interaction_matrix(moved(SOMEWHERE, axis, s)) for s in (step, -step))
    return relative(model.derivatives(SOMEWHERE)[axis], (ahead - behind) / (2 * step))


@pytest.mark.parametrize("stop", Stop)
@pytest.mark.parametrize("axis", [2, 3], ids=["rotation", "magnification"])
def test_rotation_and_magnification_derivatives_are_exact(stop, axis):
    """0.5 % is the requirement; 1e-5 is the central difference's own error at a step of 1e-4."""
    assert derivative_error(stop, 3, axis) < 1e-5


@pytest.mark.parametrize("axis", [0, 1], ids=["x", "y"])
def test_derivatives_by_a_shift_of_the_modes_are_exact(axis):
    """With the telescope as stop a shift is like a rotation: no pixel edge is involved."""
    assert derivative_error(Stop.TELESCOPE, 3, axis) < 1e-5


@pytest.mark.parametrize("axis", [0, 1], ids=["x", "y"])
def test_derivatives_by_a_shift_of_the_images_get_exact_with_the_quadrature(axis):
    """Pixel edges against nodes inside: 4 % is the requirement at 3 nodes, 0.7 % is seen here,
    where a subaperture sees more of the modulation; 0.15 % on the full one (tests/physics).
    """
    errors = [derivative_error(Stop.MIRROR, nodes, axis) for nodes in (3, 4, 6)]
    assert errors[0] < 0.04
    assert errors[1] < errors[0] / 5
    assert errors[2] < errors[1] / 10


@pytest.mark.parametrize("stop", Stop)
def test_a_linearisation_is_matrix_and_derivatives_at_one_place(stop):
    model = small_model(stop)
    linearisation = model.linearise(SOMEWHERE)
    np.testing.assert_array_equal(linearisation.matrix, model.interaction_matrix(SOMEWHERE))
    np.testing.assert_array_equal(linearisation.derivatives, model.derivatives(SOMEWHERE))
    assert linearisation.matrix.dtype == linearisation.derivatives.dtype == np.float32
    np.testing.assert_array_equal(linearisation.matrix_at(SOMEWHERE), linearisation.matrix)


@pytest.mark.parametrize("stop", Stop)
def test_single_precision_is_far_better_than_the_model_itself(stop):
    # 3e-7 of matrix and derivatives of the full instrument; the model is right to 1e-3
    single, double = (
        InteractionModel(small_instrument(stop=stop), small_basis(), dtype=dtype)
        for dtype in (np.float32, np.float64)
    )
    found, expected = single.linearise(SOMEWHERE), double.interaction_matrix(SOMEWHERE)
    assert relative(found.matrix, expected) < 1e-6
    for rate, exact in zip(found.derivatives, double.derivatives(SOMEWHERE), strict=True):
        assert relative(rate, exact) < 1e-6


def test_far_plates_summed_as_polynomials_move_the_matrix_by_rounding_only():
    # 2e-9 of the full instrument's, of which float32 rounds each number by 6e-8
    basis = flao_basis().subset(np.arange(100))
    points = flao_model().pupil.points @ rotation(0.02)
    direct = basis.surface.basis(points) @ basis.coefficients
    model = flao_model().of_modes(basis)
    seen = model.measure_signals(ALIGNED, basis.render(points).astype(np.float32))
    assert relative(seen, model.measure_signals(ALIGNED, direct.astype(np.float32))) < 6e-8


@pytest.mark.parametrize("stop", Stop)
def test_a_model_of_other_modes_shares_the_optics_and_nothing_else(stop, work):
    model = InteractionModel(small_instrument(stop=stop), small_basis())
    every = model.interaction_matrix(SOMEWHERE)
    work.clear()
    few = model.of_modes(model.basis.subset([3, 1]))
    # 2e-7 of the whole: an element that is small itself is off by more in proportion
    assert relative(few.interaction_matrix(SOMEWHERE), every[:, [3, 1]]) < 1e-6
    assert work["optics"] == 0
    np.testing.assert_array_equal(model.interaction_matrix(SOMEWHERE), every)


def test_the_error_of_a_linearisation_is_of_second_order():
    """Half the step, a quarter of the error (within 10 %: third order and quadrature)."""
    alphas = [
        Misregistration.from_vector([s * 0.1, -s * 0.05, s * 0.005, 1 + s * 0.004]) for s in (1, 2)
    ]
    model = small_model(nodes=6, double=True)
    linearisation = model.linearise(ALIGNED)
    near, far = (
        np.linalg.norm(linearisation.matrix_at(alpha) - model.interaction_matrix(alpha))
        for alpha in alphas
    )
    assert far / near == pytest.approx(4.0, rel=0.1)


# --- stops


def test_a_pupil_that_lies_elsewhere_is_seen_as_one_that_the_mirror_carries_there():
    """Both stops, with pupil and mirror shifted alike: the same D, and known all the same."""
    carried, fixed = small_model(Stop.MIRROR), small_instrument(stop=Stop.TELESCOPE)
    beside = (SOMEWHERE.shift_x_subap, SOMEWHERE.shift_y_subap)
    there = InteractionModel(replace(fixed, pupil_shift_subap=beside), small_basis())
    expected = carried.interaction_matrix(SOMEWHERE)
    np.testing.assert_allclose(
        there.interaction_matrix(SOMEWHERE), expected, atol=1e-6 * np.abs(expected).max()
    )


def test_with_the_telescope_as_stop_the_sensor_does_not_know_of_the_shift():
    model = small_model(Stop.TELESCOPE)
    shapes = small_basis().render(model.pupil.points)
    at_rest = model.measure_signals(ALIGNED, shapes)
    np.testing.assert_array_equal(model.measure_signals(SOMEWHERE, shapes), at_rest)


def test_with_the_mirror_as_stop_the_sensor_sees_the_images_move():
    model = small_model()
    shapes = small_basis().render(model.pupil.points)
    at_rest = model.measure_signals(ALIGNED, shapes)
    assert relative(model.measure_signals(SOMEWHERE, shapes), at_rest) > 0.1


def test_the_two_stops_agree_when_nothing_is_shifted():
    turned = replace(SOMEWHERE, shift_x_subap=0.0, shift_y_subap=0.0)
    mirror, telescope = (small_model(stop).interaction_matrix(turned) for stop in Stop)
    np.testing.assert_array_equal(mirror, telescope)


def test_the_two_stops_differ_by_the_edge_only_when_shifted():
    shifted = Misregistration(shift_x_subap=0.1)
    mirror, telescope = (small_model(stop).interaction_matrix(shifted) for stop in Stop)
    aligned = small_model().interaction_matrix(ALIGNED)
    assert 0.001 < relative(mirror, telescope) < relative(mirror, aligned)


# --- symmetries


def parities(axis: int) -> np.ndarray:
    """+1 or -1 for each mode that is even or odd under a flip of the axis."""
    points = instrument_pupil(small_instrument(), 3).points
    flipped = points * np.where(np.arange(2) == axis, -1.0, 1.0)
    there, back = small_basis().render(points), small_basis().render(flipped)
    cosine = np.einsum("pm,pm->m", there, back) / np.einsum("pm,pm->m", there, there)
    np.testing.assert_allclose(np.abs(cosine), 1.0, atol=1e-6)
    return np.sign(cosine)


@pytest.mark.parametrize("stop", Stop)
def test_mirroring_y_flips_shift_y_rotation_and_the_y_slopes(stop):
    """The rings are their own mirror image under y -> -y. 1e-4: float32."""
    model = small_model(stop)
    mirrored = replace(
        SOMEWHERE,
        shift_y_subap=-SOMEWHERE.shift_y_subap,
        rotation_rad=-SOMEWHERE.rotation_rad,
    )
    order = np.zeros(model.valid.shape, int)
    order[model.valid] = np.arange(model.valid.sum())
    flipped = order[::-1][model.valid]
    slopes_x, slopes_y = np.split(model.interaction_matrix(SOMEWHERE), 2)
    expected = np.concatenate([slopes_x[flipped], -slopes_y[flipped]]) * parities(axis=1)
    assert relative(model.interaction_matrix(mirrored), expected) < 1e-4


@pytest.mark.parametrize("stop", Stop)
def test_a_mode_basis_turned_by_a_right_angle_is_a_rotation_of_a_right_angle(stop):
    """Sx becomes Sy: x -> y, y -> -x. 1e-3: the chords of the grey edge run along one axis."""
    model = small_model(stop)
    quarter = replace(ALIGNED, rotation_rad=np.pi / 2)
    n = len(model.valid)
    order = np.full((n, n), -1)
    order[model.valid] = np.arange(model.valid.sum())
    # the subaperture at (x, y) sees what the one at R^-1 (x, y) = (y, -x) saw
    source = np.rot90(order, -1)[model.valid]
    slopes_x, slopes_y = np.split(model.interaction_matrix(ALIGNED), 2)
    expected = np.concatenate([-slopes_y[source], slopes_x[source]])
    assert relative(model.interaction_matrix(quarter), expected) < 1e-3


# --- the mask


def test_the_valid_subapertures_are_those_half_lit():
    """A subaperture whose centre is well inside the annulus is valid, well outside it is not."""
    valid = small_model().valid
    centres = np.arange(12) - 5.5
    radius = np.hypot(centres[:, None], centres)
    assert valid[(radius > 1.5) & (radius < 5.2)].all()
    assert not valid[radius > 6.8].any()


@pytest.mark.parametrize("diameter", [11.4, 12.0, 12.6, 13.5])
def test_the_mask_is_symmetric_whatever_the_pupils_diameter(diameter):
    instrument = small_instrument(pupil_diameter_subap=diameter)
    valid = InteractionModel(instrument, small_basis()).valid
    np.testing.assert_array_equal(valid, valid[::-1])
    np.testing.assert_array_equal(valid, valid[:, ::-1])


def test_an_instruments_own_mask_is_taken_as_it_is():
    mask = np.zeros((12, 12), bool)
    mask[4:9, 3:7] = True
    instrument = small_instrument()
    instrument = replace(instrument, wfs=replace(instrument.wfs, valid_subapertures=mask))
    model = InteractionModel(instrument, small_basis())
    assert model.n_slopes == 40
    assert model.interaction_matrix(ALIGNED).shape == (40, 40)


def test_reference_slopes_are_differences_over_the_mean_flux():
    """One subaperture: 7 at -x -y, 1 at +x -y, 3 at -x +y, 5 at +x +y."""
    images = np.array([7.0, 1.0, 3.0, 5.0]).reshape(2, 1, 2, 1)
    slopes, flux = reference_slopes(images, np.array([[True]]))
    assert flux == 16.0
    np.testing.assert_allclose(slopes, [(7 + 3 - 1 - 5) / 16, (7 + 1 - 3 - 5) / 16])


# --- caching and threads


@pytest.fixture
def work(monkeypatch):
    """Counts the calls of the two expensive parts."""
    count: Counter[str] = Counter()
    response, render = PyramidOptics.response, ModalBasis.render

    def counted_response(self, *arguments, **named):
        count["optics"] += 1
        return response(self, *arguments, **named)

    def counted_render(self, points):
        count["rendering"] += 1
        return render(self, points)

    monkeypatch.setattr(PyramidOptics, "response", counted_response)
    monkeypatch.setattr(ModalBasis, "render", counted_render)
    return count


def test_a_new_rotation_costs_no_optics_and_a_new_shift_no_rendering(work):
    model = InteractionModel(small_instrument(), small_basis())
    model.interaction_matrix(ALIGNED)
    first = dict(work)
    model.interaction_matrix(replace(ALIGNED, rotation_rad=0.01, magnification=1.01))
    assert work["optics"] == first["optics"] == 1
    assert work["rendering"] == 2 * first["rendering"]
    model.interaction_matrix(replace(SOMEWHERE, rotation_rad=0.01, magnification=1.01))
    assert work["optics"] == 2
    assert work["rendering"] == 2 * first["rendering"]


def test_with_the_telescope_as_stop_no_registration_costs_optics(work):
    model = InteractionModel(small_instrument(stop=Stop.TELESCOPE), small_basis())
    for alpha in (ALIGNED, SOMEWHERE, moved(SOMEWHERE, 0, 0.3)):
        model.interaction_matrix(alpha)
    assert work["optics"] == 1


def test_what_was_computed_before_does_not_change_what_is_computed_now():
    used = InteractionModel(small_instrument(), small_basis())
    for alpha in (SOMEWHERE, ALIGNED, moved(SOMEWHERE, 2, 0.1), moved(SOMEWHERE, 0, 0.1)):
        used.interaction_matrix(alpha)
        used.derivatives(alpha)
    fresh = InteractionModel(small_instrument(), small_basis())
    np.testing.assert_array_equal(
        used.interaction_matrix(SOMEWHERE), fresh.interaction_matrix(SOMEWHERE)
    )


def test_threads_give_the_same_matrix_and_derivatives():
    with ThreadPoolExecutor(2) as threads:
        model = InteractionModel(small_instrument(), small_basis(), mapper=threads.map)
        linearisation = model.linearise(ALIGNED)
    np.testing.assert_array_equal(linearisation.matrix, small_linearisation().matrix)
    np.testing.assert_array_equal(linearisation.derivatives, small_linearisation().derivatives)


def test_a_layout_without_symmetry_has_an_interaction_matrix_too():
    layout = small_instrument().mirror.positions_m
    layout = layout + np.random.default_rng(8).normal(0.0, 0.08, layout.shape)
    instrument = small_instrument(layout)
    model = InteractionModel(instrument, karhunen_loeve_basis(instrument))
    assert np.linalg.cond(model.interaction_matrix(SOMEWHERE)) < 20


def test_a_model_that_was_told_to_forget_finds_the_same_matrix():
    model = InteractionModel(small_instrument(), small_basis())
    before = model.interaction_matrix(SOMEWHERE)
    model.forget()
    np.testing.assert_array_equal(model.interaction_matrix(SOMEWHERE), before)


# --- slopes as the RTC lists them


ORIENTATION = Orientation(swap_xy=True, flip_x=True, sign_y=-1)


def models():
    """Of an RTC with habits of its own, and a mask without any symmetry."""
    mask = np.hypot(np.arange(12)[:, None] - 5.2, np.arange(12) - 6.1) < 5.4
    mask[4, 7] = False
    instrument = small_instrument()
    instrument = replace(
        instrument,
        wfs=replace(instrument.wfs, valid_subapertures=mask),
        slopes=SlopeRecipe(order=SlopeOrder.INTERLEAVED, orientation=ORIENTATION),
    )
    return (
        mask,
        InteractionModel(instrument, small_basis()),
        RtcInteractionModel(instrument, small_basis()),
    )


def test_matrix_and_derivatives_are_the_models_as_the_rtc_lists_its_slopes():
    mask, ours, theirs = models()

    def back(matrix):
        return to_conventions(
            matrix, SlopeRecipe(order=SlopeOrder.INTERLEAVED, orientation=ORIENTATION), mask
        )

    found, expected = theirs.linearise(SOMEWHERE), ours.linearise(SOMEWHERE)
    np.testing.assert_array_equal(back(found.matrix), expected.matrix)
    for there, here in zip(found.derivatives, expected.derivatives, strict=True):
        np.testing.assert_array_equal(back(there), here)
    assert not np.array_equal(found.matrix, expected.matrix)


def test_an_rtc_with_the_conventions_own_habits_gets_the_models_matrix():
    plain = InteractionModel(small_instrument(), small_basis())
    theirs = RtcInteractionModel(small_instrument(), small_basis())
    np.testing.assert_array_equal(
        theirs.interaction_matrix(SOMEWHERE), plain.interaction_matrix(SOMEWHERE)
    )


def test_slopes_near_unknown_surface_are_listed_alike():
    mask, ours, theirs = models()
    unknown = ours.pupil.points[:, 0] > 4.0

    class Partly(type(small_basis())):
        def known(self, points):
            return ~unknown

    basis = Partly(**{one.name: getattr(small_basis(), one.name) for one in fields(small_basis())})
    ours.basis = theirs.basis = basis
    rows = theirs.unknown_rows(SOMEWHERE).astype(float)
    back = (
        to_conventions(
            rows, SlopeRecipe(order=SlopeOrder.INTERLEAVED, orientation=ORIENTATION), mask
        )
        != 0
    )
    np.testing.assert_array_equal(back, ours.unknown_rows(SOMEWHERE))
    assert 0 < back.sum() < len(back)
