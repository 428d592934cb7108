"""The Shack-Hartmann's D and its derivatives against spots: transformed, on pixels, centroids."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import Misregistration, rotation
from service.model.modes import modal_basis
from service.model.sensors.shack_hartmann.table import Centroid
from tests.support.fft_spots import pushed, sampled

FILE = Path(__file__).parents[1] / "data" / "lenslets.toml"
ALPHA = Misregistration(
    shift_x_subap=0.18, shift_y_subap=-0.12, rotation_rad=np.deg2rad(1.5), magnification=1.01
)
COUNTED = {
    Centroid.CENTRE_OF_GRAVITY: np.ones_like,
    Centroid.WEIGHTED: lambda spot: spot,
    Centroid.THRESHOLD: lambda spot: spot >= 0.05 * spot.max(),
}
STEPS = np.array([1 / 16, 1 / 16, 0.005, 0.005])
"""Twice the width of a fine cell: a shift then moves light by whole cells."""


@pytest.fixture(scope="module", params=Stop)
def lenslets(request):
    return replace(load_instrument(FILE), stop=request.param)


@pytest.fixture(scope="module")
def basis(lenslets):
    return modal_basis(lenslets).subset(np.array([0, 5, 20, 60]))


@pytest.fixture(scope="module")
def shapes(basis):
    return sampled(basis, 8)


def by_brute_force(instrument, shapes, alpha, counted, width=1):
    """Return slopes ``(2, n, n, n_modes)`` of the mirror's modes at a registration.

    Pixels are ``width`` λ/d wide.
    """
    moved = instrument.stop is Stop.MIRROR
    shift = alpha.vector[:2]

    def opd_at(points):
        on_pupil = points if moved else points - shift
        return shapes(on_pupil @ rotation(alpha.rotation_rad) / alpha.magnification)

    return pushed(instrument, opd_at, shift if moved else (0.0, 0.0), counted, width=width)


def errors(model, ours, brute, lit):
    """Return the relative error of each column in the subapertures that are lit so."""
    rows = np.tile(lit[model.valid], 2)
    theirs = brute[:, model.valid].reshape(len(ours), -1)
    return np.linalg.norm((ours - theirs)[rows], axis=0) / np.linalg.norm(theirs[rows], axis=0)


@pytest.mark.parametrize("centroid", COUNTED)
def test_the_matrix_is_that_of_spots_transformed(lenslets, basis, shapes, centroid):
    """Full lenslets: 0.5 % are the sums over pixels here, 1 % of mode 60 the model's three points.

    Where the edge cuts, the fine cells here are black or white, and the model goes on beyond it.
    """
    wfs = replace(lenslets.wfs, centroid=centroid, threshold=0.05)
    about = replace(lenslets, wfs=wfs)
    model = InteractionModel(about, basis, dtype=np.float64)
    brute = by_brute_force(about, shapes, ALPHA, COUNTED[centroid])
    shift = ALPHA.vector[:2] if lenslets.stop is Stop.MIRROR else (0.0, 0.0)
    light = model.sensor.at(tuple(shift)).light.sum(axis=(1, 3))
    light /= light.max()
    ours = model.interaction_matrix(ALPHA)
    full = errors(model, ours, brute, light > 0.999)
    assert np.all(full < [0.006, 0.006, 0.007, 0.018]), full
    cut = errors(model, ours, brute, (light <= 0.999) & (light > 0.5))
    assert np.all(cut < [0.009, 0.009, 0.010, 0.03]), cut


def test_a_finer_pupil_is_nearer_to_them(lenslets, basis, shapes):
    """Six points instead of three: what is left is the brute force's own, alike in all modes."""
    brute = by_brute_force(lenslets, shapes, ALPHA, np.ones_like)
    fine = InteractionModel(lenslets, basis, pupil_sampling=6, dtype=np.float64)
    well_lit = np.hypot(*np.indices((12, 12)) - 5.5)
    lit = (well_lit < 4.7) & (well_lit > 2.2)
    assert np.all(errors(fine, fine.interaction_matrix(ALPHA), brute, lit) < 0.003)


def test_derivatives_are_the_differences_of_spots_transformed(lenslets, basis, shapes):
    """Smooth modes: 0.5 %; a slope of a slope is seen worse, mode 60 on three points to 4 %."""
    model = InteractionModel(lenslets, basis, dtype=np.float64)
    radius = np.hypot(*np.indices((12, 12)) - 5.5)
    full = (radius < 4.7) & (radius > 2.2)
    for k, (ours, step) in enumerate(zip(model.derivatives(ALPHA), np.diag(STEPS), strict=True)):
        less, more = (
            by_brute_force(
                lenslets,
                shapes,
                Misregistration.from_vector(ALPHA.vector + side * step),
                np.ones_like,
            )
            for side in (-1.0, 1.0)
        )
        found = errors(model, ours, (more - less) / (2.0 * STEPS[k]), full)
        assert np.all(found < [0.006, 0.006, 0.016, 0.045]), (k, found)


@pytest.mark.parametrize("lenslets", [Stop.TELESCOPE], indirect=True)
def test_a_spot_half_a_pixel_wide_is_fitted_to_a_thousandth_and_accepted(lenslets):
    """Sets of modes are 6 sigma apart, and 0.001 subaperture: once refused."""
    modes = np.arange(0, 60, 3)
    basis = modal_basis(lenslets)
    x, y, turn, size = np.random.default_rng([36, 2, 6, 16]).uniform(-1.0, 1.0, 4)
    vector = np.array([0.6 * x, 0.6 * y, np.deg2rad(3.0 * turn), 1.0 + 0.02 * size])
    alpha = Misregistration.from_vector(vector)
    found = by_brute_force(lenslets, sampled(basis.subset(modes), 8), alpha, np.ones_like, width=2)
    pixel = 2.0 * lenslets.wfs.wavelength_m / lenslets.subaperture_m
    about = replace(
        lenslets, wfs=replace(lenslets.wfs, pixel_scale_arcsec=np.rad2deg(pixel) * 3600.0)
    )
    matrix = found[:, InteractionModel(about, basis).valid].reshape(-1, len(modes))
    fit = fit_matrix(about, Reference(matrix=matrix, modes=modes), FitOptions(), basis=basis)
    error = np.abs(fit.alpha.vector - vector)
    assert fit.accepted
    assert np.all(error < 3.0 * fit.sigma)
    assert np.all(error < [0.001, 0.001, 1e-4, 3e-4])
