"""What an RTC's own matrix tells of the modes that it controls, wherever the mirror is."""

from functools import cache

import numpy as np
import pytest

from service.estimation.own_matrix import (
    N_NEIGHBOURS,
    LeftOver,
    find_neighbours,
    left_over,
    recognise_modes,
    weights_of_modes,
)
from service.instrument import load_instrument
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from tests.support.stranger import INSTRUMENT

N_CONTROLLED = 60
ALPHAS = {
    "as drawn": (0.0, 0.0, 0.0, 1.0),
    "as a night leaves it": (0.12, -0.08, 0.2, 1.003),
    "as badly as it may be": (-1.4, 1.2, 6.0, 0.98),
}


def test_neighbours_are_the_nearest_modes_on_either_side_and_not_the_mode_itself():
    modes = np.array([*range(20), 40])
    assert sorted(modes[find_neighbours(modes, 10)]) == [5, 6, 7, 8, 9, 11, 12, 13, 14, 15]
    assert len(find_neighbours(modes, 20)) == N_NEIGHBOURS
    assert list(find_neighbours(np.array([3, 9]), 0)) == [1]


@cache
def model(sampling):
    instrument = load_instrument(str(INSTRUMENT))
    basis = modal_basis(instrument)
    return RtcInteractionModel(instrument, basis, pupil_sampling=sampling, detector_nodes=sampling)


@cache
def true_response(where):
    """By another sampling than it is compared with, and with noise: a matrix as one measures it."""
    x, y, rotation_deg, magnification = ALPHAS[where]
    alpha = Misregistration(
        shift_x_subap=x,
        shift_y_subap=y,
        rotation_rad=np.deg2rad(rotation_deg),
        magnification=magnification,
    )
    clean = model(4).interaction_matrix(alpha).astype(float)
    rng = np.random.default_rng(1)
    return alpha, clean + 0.1 * np.abs(clean).mean(axis=0) * rng.standard_normal(clean.shape)


def told_by(twist, where="as a night leaves it", n_controlled=N_CONTROLLED):
    _, response = true_response(where)
    own = np.linalg.pinv(twist(response)[:, :n_controlled]).astype(np.float32)
    return recognise_modes(own, model(2).linearise, Misregistration())


def times(factor, *modes):
    def twist(response):
        scale = np.ones(response.shape[1])
        scale[list(modes)] = factor
        return response * scale

    return twist


def exchanged(one, other):
    def twist(response):
        order = np.arange(response.shape[1])
        order[[one, other]] = other, one
        return response[:, order]

    return twist


@pytest.mark.parametrize("where", ALPHAS)
def test_every_mode_of_a_measured_matrix_is_recognised(where):
    alpha, _ = true_response(where)
    found = told_by(lambda response: response, where)
    assert found.wrong == found.uneven == ""
    assert found.known.all()
    np.testing.assert_allclose(found.response, 1.0, atol=0.1)
    # the coarse model is off by some thousandths of a subaperture
    assert np.all(np.abs(found.alpha.vector - alpha.vector) < [0.02, 0.02, 0.003, 0.003])


@pytest.mark.parametrize("where", ALPHAS)
def test_a_turned_sign_is_named_and_the_others_stay_known(where):
    found = told_by(times(-1.0, 10, 45), where)
    assert found.wrong == "modes 10, 45 have the other sign by the RTC's own matrix"
    assert found.known.sum() == N_CONTROLLED - 2


@pytest.mark.parametrize(("one", "other"), [(10, 11), (3, 40)])
def test_exchanged_modes_are_named(one, other):
    found = told_by(exchanged(one, other))
    assert found.wrong == f"modes {one} and {other} are exchanged by the RTC's own matrix"


def test_a_mode_exchanged_with_one_that_is_not_controlled_is_named():
    found = told_by(exchanged(50, 70))
    assert "50 is the instrument file's 70" in found.wrong


def test_rolled_modes_are_told_from_permuted_ones():
    rolled = told_by(lambda response: np.roll(response, 1, axis=1))
    assert "rolled by -1" in rolled.wrong
    order = np.random.default_rng(2).permutation(90)
    permuted = told_by(lambda response: response[:, order])
    assert "other places" in permuted.wrong
    assert f"0 is the instrument file's {order[0]}" in permuted.wrong


def test_slopes_in_another_order_are_no_modes_at_all():
    rng = np.random.default_rng(3)
    found = told_by(lambda response: response[rng.permutation(len(response))])
    assert "its slopes are listed in another order, or its modes are another basis" in found.wrong
    assert not found.known.any()


def test_the_size_of_a_response_is_told_and_is_nothing_wrong():
    """Tip three times as strong, one mode at a tenth: the RTC's matrix allows for it."""
    tip, weak = told_by(times(3.0, 0)), told_by(times(0.1, 20))
    assert tip.wrong == weak.wrong == ""
    assert "mode 0 " in tip.uneven
    assert "mode 20 0.1 times" in weak.uneven
    assert tip.response[0] == pytest.approx(3.0, rel=0.1)
    half = told_by(lambda response: 0.5 * response)
    assert half.wrong == half.uneven == ""
    np.testing.assert_allclose(half.response, 0.5, atol=0.05)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_mode_of_half_or_twice_the_strength_is_named(factor):
    found = told_by(times(factor, 20))
    assert found.wrong == ""
    assert "matrix mode 20 " in found.uneven
    assert found.uneven.count("mode ") == 1


def test_a_turned_sign_of_another_size_is_still_a_turned_sign():
    assert told_by(times(-0.5, 15)).wrong == "mode 15 has the other sign by the RTC's own matrix"


def test_a_regularised_matrix_of_fewer_modes_is_recognised():
    """A maximum a posteriori inverse answers less in high modes: no other sign, no other place."""
    _, response = true_response("as a night leaves it")
    columns = response[:, :45]
    power = np.mean(np.sum(columns**2, axis=0))
    own = np.linalg.solve(columns.T @ columns + 0.1 * power * np.eye(45), columns.T)
    found = recognise_modes(own.astype(np.float32), model(2).linearise, Misregistration())
    assert found.wrong == ""
    assert found.known.mean() > 0.9


def test_rows_of_zeros_control_nothing():
    _, response = true_response("as drawn")
    own = np.linalg.pinv(response[:, :30]).astype(np.float32)
    own[7] = 0.0
    found = recognise_modes(own, model(2).linearise, Misregistration())
    assert 7 not in found.columns
    assert found.wrong == ""
    nothing = np.zeros_like(own)
    assert recognise_modes(nothing, model(2).linearise, Misregistration()) is None
    nothing[0, 0] = np.nan
    assert recognise_modes(nothing, model(2).linearise, Misregistration()) is None


def wrong_by(share, seed=5):
    """Each column with an error of this share of its norm, of patterns like neighbouring modes."""

    def twist(response):
        rng = np.random.default_rng(seed)
        norm = np.linalg.norm(response, axis=0)
        place = np.arange(response.shape[1])
        mix = rng.standard_normal((len(place), len(place)))
        mix *= np.exp(-0.5 * ((place[:, None] - place) / 5.0) ** 2)
        np.fill_diagonal(mix, 0.0)
        error = (response / norm) @ mix
        return response + share * norm * error / np.linalg.norm(error, axis=0)

    return twist


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_what_the_model_leaves_of_each_mode_is_told(share):
    """Noise of 0.1 of the mean size per slope comes on top; α takes a little of the error."""
    found = told_by(wrong_by(share))
    assert found.known.all()
    assert found.typical_misfit == pytest.approx(np.hypot(share, 0.08), rel=0.15)
    assert f"{found.typical_misfit:.0%} of their response unexplained" in found.text


def test_the_registration_of_a_wrong_model_is_as_sure_as_its_modes_agree():
    """Over draws of the error α scatters by the σ that one of them tells, in each parameter.

    About its mean: the coarser sampling of the model that is compared moves all draws alike.
    """
    found = [told_by(wrong_by(0.3, seed)) for seed in range(12)]
    vectors = np.array([one.alpha.vector for one in found])
    sigma = np.array([np.sqrt(np.diag(one.covariance)) for one in found])
    ratio = np.std(vectors, axis=0, ddof=1) / np.sqrt(np.mean(sigma**2, axis=0))
    # twelve draws tell a scatter to a fifth of itself
    assert np.all((ratio > 0.4) & (ratio < 2.0))


def test_modes_that_are_explained_well_all_count_alike():
    alpha, _ = true_response("as a night leaves it")
    clean = model(4).interaction_matrix(alpha).astype(float)
    own = np.linalg.pinv(clean[:, :N_CONTROLLED]).astype(np.float32)
    found = recognise_modes(own, model(2).linearise, Misregistration())
    assert weights_of_modes(found, np.ones(90)) == ()
    assert found.model_error is None
    assert "unexplained" not in found.text


def test_modes_that_are_explained_badly_count_less():
    def twist(response):
        worse = wrong_by(0.6)(response)
        return np.where(np.arange(response.shape[1]) < 30, wrong_by(0.15)(response), worse)

    found = told_by(twist)
    weights = np.array(weights_of_modes(found, np.ones(90)))
    assert np.median(weights[:30]) > 3.0 * np.median(weights[30:N_CONTROLLED])
    # those that it does not control are taken for no better than the worst of its own
    assert weights[N_CONTROLLED:].max() < np.median(weights[:30])


def test_what_is_left_over_makes_the_measured_response_of_the_models_own():
    """The gate judges a matrix on it."""
    _, response = true_response("as a night leaves it")
    measured = wrong_by(0.3)(response)
    own = np.linalg.pinv(measured[:, :N_CONTROLLED]).astype(np.float32)
    found = recognise_modes(own, model(2).linearise, Misregistration())
    near = model(2).linearise(found.alpha)
    there = left_over(own, found, near.matrix).add_to(near)
    gain = np.median(found.response)
    np.testing.assert_allclose(
        there.matrix[:, :N_CONTROLLED],
        measured[:, :N_CONTROLLED] / gain,
        atol=2e-3 * np.abs(measured).max(),
    )
    np.testing.assert_array_equal(there.matrix[:, N_CONTROLLED:], near.matrix[:, N_CONTROLLED:])
    none = LeftOver(columns=np.arange(0), slopes=np.zeros((len(own[0]), 0), np.float32))
    np.testing.assert_array_equal(none.add_to(near).matrix, near.matrix)


def test_a_residual_is_large_where_the_model_explains_most_of_the_modes_poorly():
    near = model(2).linearise(Misregistration())
    columns = np.arange(10)
    share = np.where(columns < 6, 0.1, 0.01)
    poor = LeftOver(columns=columns, slopes=near.matrix[:, columns] * share)
    assert poor.is_large(near.matrix)
    assert not LeftOver(columns=columns, slopes=0.5 * poor.slopes).is_large(near.matrix)
    assert not LeftOver(columns=columns[:0], slopes=poor.slopes[:, :0]).is_large(near.matrix)


def test_the_strength_of_a_mode_is_its_norm_where_the_model_does_not_explain_its_shape():
    """Half of the projection, but 0.8 of the norm: the shape differs and not the scale."""
    _, response = true_response("as a night leaves it")
    rng = np.random.default_rng(6)
    strange = rng.standard_normal(len(response))
    shape = response[:, 10] / np.linalg.norm(response[:, 10])
    strange -= shape * (shape @ strange)

    def twist(matrix):
        changed = matrix.copy()
        size = np.linalg.norm(matrix[:, 10])
        changed[:, 10] = size * (0.55 * shape + 0.55 * strange / np.linalg.norm(strange))
        return changed

    found = told_by(twist)
    assert found.response[10] == pytest.approx(0.55, abs=0.05)
    assert found.uneven == ""
    assert "mode 10 0.5" in told_by(times(0.55, 10)).uneven
