from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.matrix import fit_matrix
from service.estimation.reference import Reference
from service.model.kinds import SlopeOrder
from service.model.misregistration import Misregistration
from service.model.slopes import Orientation
from tests.support.bench import ELSEWHERE, GRID, error, fit, instrument, listed, matrix
from tests.support.numerics import small_basis

UNKNOWN = instrument(None)


def turned(degrees: float) -> Misregistration:
    return replace(ELSEWHERE, rotation_rad=np.deg2rad(degrees))


@pytest.mark.parametrize("degrees", [65.0, -130.0])
def test_any_rotation_of_the_mirror_comes_out(degrees):
    alpha = turned(degrees)
    found = fit(matrix(alpha, noise=0.05), UNKNOWN)
    assert found.accepted
    assert found.orientation == Orientation()
    assert abs(np.rad2deg(error(found, alpha)[2])) < 0.05


@pytest.mark.parametrize(
    ("signs", "n_modes"), [((-1, -1), 9), ((-1, 1), 9), ((1, -1), 9), ((-1, -1), 40)]
)
def test_signs_of_the_components_come_out(signs, n_modes):
    orientation = Orientation(sign_x=signs[0], sign_y=signs[1])
    rows = listed(matrix(turned(65.0))[:, :n_modes], SlopeOrder.XY, orientation)
    found = fit(rows, UNKNOWN)
    assert found.orientation == orientation
    assert np.rad2deg(found.alpha.rotation_rad) == pytest.approx(65.0, abs=0.05)


def test_exchanged_components_come_out():
    rows = listed(matrix(), SlopeOrder.YX, Orientation())
    found = fit(rows, UNKNOWN)
    assert found.order is SlopeOrder.YX
    assert np.all(np.abs(error(found)) < GRID)


def test_a_mirror_seen_from_behind_is_a_flip():
    found = fit(matrix(basis=replace(small_basis(), y_sign=-1.0)), UNKNOWN)
    axes = found.orientation
    assert axes.flip_x + axes.flip_y + axes.swap_xy == 1
    assert found.accepted


@pytest.mark.parametrize(
    "orientation",
    [
        Orientation(swap_xy=True, flip_x=True),
        Orientation(flip_x=True, flip_y=True, sign_y=-1),
        Orientation(swap_xy=True, flip_y=True),
    ],
)
def test_the_nominal_rotation_chooses_among_equivalent_axes(orientation):
    rows = listed(matrix(), SlopeOrder.XY, orientation)
    mounted = replace(UNKNOWN.mirror, nominal_rotation_rad=0.0)
    found = fit(rows, replace(UNKNOWN, mirror=mounted))
    assert found.orientation == orientation
    assert np.all(np.abs(error(found)) < GRID)


def test_without_it_the_fewest_flips_are_reported_and_alpha_holds_the_turn():
    rows = listed(matrix(), SlopeOrder.XY, Orientation(flip_x=True, flip_y=True))
    found = fit(rows, UNKNOWN)
    assert found.orientation == Orientation()
    assert abs(np.rad2deg(found.alpha.rotation_rad)) == pytest.approx(178.7, abs=0.05)


def test_tip_and_tilt_alone_are_refused_with_the_tie_named():
    found = fit(matrix()[:, :2], UNKNOWN)
    assert not found.accepted
    assert "ambiguous" in found.verdict
    assert "sign = -1" in found.verdict


def test_a_mixture_of_the_modes_is_a_basis_like_any_other():
    mixture, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(40, 40)))
    basis = small_basis().combine_modes(mixture)
    rows = listed(matrix(turned(65.0)) @ mixture, SlopeOrder.XY, Orientation(sign_y=-1))
    found = fit_matrix(UNKNOWN, Reference(matrix=rows), basis=basis)
    assert found.accepted
    assert found.orientation == Orientation(sign_y=-1)
    assert np.rad2deg(found.alpha.rotation_rad) == pytest.approx(65.0, abs=0.02)


def test_the_lists_of_an_interleaving_rtc_are_read():
    orientation = Orientation(sign_x=-1)
    rows = listed(matrix(), SlopeOrder.INTERLEAVED, orientation)
    found = fit(rows, instrument(None, SlopeOrder.INTERLEAVED))
    assert found.orientation == orientation
    assert np.all(np.abs(error(found)) < GRID)
