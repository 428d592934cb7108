import dataclasses
import functools

import numpy as np
import pytest

from service.errors import ModelError
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.sensors.pyramid.working_point import Halo, working_point
from tests.numerics import small_basis, small_instrument, small_model

ALIGNED = Misregistration()


@pytest.fixture(scope="module")
def flao_halo():
    return working_point(load_instrument("flao-lbt"), n_controlled=400, sampling=3)


@functools.cache
def small_halo(r0_m):
    return working_point(small_instrument(), n_controlled=30, r0_m=r0_m, sampling=3)


def small_matrix(halo):
    model = InteractionModel(small_instrument(), small_basis(), working_point=halo)
    return model.interaction_matrix(ALIGNED)


def gains(halo):
    """How much of the flat response each mode keeps."""
    flat = small_model().interaction_matrix(ALIGNED)
    return np.einsum("sm,sm->m", flat, small_matrix(halo)) / np.einsum("sm,sm->m", flat, flat)


def test_the_core_is_what_a_residual_of_130_nm_leaves_coherent(flao_halo):
    # Marechal: exp(-(2 pi 130 / 750)^2) = 0.31; fitting 110 nm and servo 70 nm add to 130
    assert flao_halo.core_weight == pytest.approx(0.31, abs=0.02)


def test_nearly_nine_tenths_of_the_light_stay_on_the_grid(flao_halo):
    # the design study kept 0.887 at the same sampling
    assert flao_halo.core_weight + flao_halo.weights.sum() == pytest.approx(0.887, abs=0.02)


def test_without_residual_the_source_is_the_modulation_circle():
    perfect = small_halo(50.0)
    assert perfect.core_weight > 0.99
    np.testing.assert_allclose(gains(perfect), 1.0, atol=0.03)


def test_a_halo_of_no_light_changes_nothing():
    dark = Halo(core_weight=1.0, radii=np.array([2.0]), weights=np.array([0.0]), n_points=(20,))
    flat = small_model().interaction_matrix(ALIGNED)
    np.testing.assert_allclose(small_matrix(dark), flat, atol=1e-5 * np.abs(flat).max())


def test_worse_seeing_lowers_the_optical_gain_of_every_mode():
    good, bad = (gains(small_halo(r0_m)) for r0_m in (0.4, 0.15))
    assert np.all(bad < good)
    assert np.all((bad > 0.0) & (good < 1.0))


@pytest.mark.parametrize(("n_controlled", "r0_m"), [(0, 0.1), (30, 0.0), (30, -1.0)])
def test_no_loop_or_no_r0_is_refused(n_controlled, r0_m):
    with pytest.raises(ModelError, match="working point"):
        working_point(small_instrument(), n_controlled=n_controlled, r0_m=r0_m, sampling=3)


def shift_derivative_error(n_nodes):
    """How far the analytic shift derivative is from central differences, relative."""
    whole = small_halo(0.2)
    halo = dataclasses.replace(  # every third ring
        whole,
        radii=whole.radii[1::3],
        weights=3.0 * whole.weights[1::3],
        n_points=whole.n_points[1::3],
    )
    model = InteractionModel(
        small_instrument(),
        small_basis(),
        working_point=halo,
        detector_nodes=n_nodes,
        dtype=np.float64,
    )
    step = 1e-3
    ahead, behind = (
        model.interaction_matrix(dataclasses.replace(ALIGNED, shift_x_subap=x))
        for x in (step, -step)
    )
    numeric = (ahead - behind) / (2 * step)
    return np.linalg.norm(model.derivatives(ALIGNED)[0] - numeric) / np.linalg.norm(numeric)


@pytest.mark.long
def test_the_derivatives_follow_the_matrix_at_the_working_point_too():
    # the halo's finer structure needs more nodes than the flat response, but only those
    coarse, fine = (shift_derivative_error(n_nodes) for n_nodes in (3, 6))
    assert coarse < 0.04
    assert fine < coarse / 4


def test_long_rings_need_their_points_more_than_short_ones():
    halo = small_halo(0.2)
    n_rings = len(halo.n_points)
    even = dataclasses.replace(halo, n_points=(sum(halo.n_points) // n_rings,) * n_rings)
    finer = dataclasses.replace(halo, n_points=tuple(4 * n for n in halo.n_points))
    graded, equal, fine = (small_matrix(h) for h in (halo, even, finer))
    assert np.linalg.norm(graded - fine) < np.linalg.norm(equal - fine)
