"""Slopes over each subaperture's own flux, and pixels: exact Jacobians, against an FFT pyramid."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal_studies import image_offsets
from pyrcal_studies.fft_pyramid import FftPyramid
from service.estimation.reference import Reference
from service.model.interaction import InteractionModel
from service.model.kinds import Normalisation, SlopeOrder, Stop
from service.model.misregistration import Misregistration
from service.model.slopes import SlopeRecipe
from tests.support.numerics import SOMEWHERE, small_basis, small_instrument

MODES = [0, 1, 2, 5, 11, 23, 39]
STROKE_M = 1e-9
LOCAL = SlopeRecipe(normalisation=Normalisation.LOCAL)
PIXELS = SlopeRecipe(order=SlopeOrder.IMAGES)
LOCAL_PIXELS = replace(LOCAL, order=SlopeOrder.IMAGES)


def model_of(*, nodes=2, dtype=np.float32, recipe=LOCAL):
    instrument = replace(small_instrument(), slopes=recipe)
    return InteractionModel(
        instrument,
        small_basis(),
        pupil_sampling=3,
        detector_nodes=nodes,
        dtype=dtype,
    )


def fft_pyramid(model):
    wfs = model.instrument.wfs
    return FftPyramid(
        amplitude=model.pupil.amplitude,
        sampling=3,
        wavelength_m=wfs.wavelength_m,
        n_subapertures=wfs.n_subapertures,
        image_separation_subap=wfs.pupil_separation_subap,
        padded_subap=160,
    )


def local_slopes(images, valid):
    """Differences over each subaperture's own flux, written as textbooks do."""
    flux = images.sum(axis=(0, 2))
    across_x = (images[:, :, 0] - images[:, :, 1]).sum(axis=0)
    across_y = (images[0] - images[1]).sum(axis=1)
    return np.concatenate([(across_x / flux)[valid], (across_y / flux)[valid]])


def pixels(images, valid):
    """The light over the mean of a subaperture, image after image, as they lie on the detector."""
    mean = images.sum(axis=(0, 2))[valid].mean()
    return np.concatenate([images[y, :, x][valid] for y in (0, 1) for x in (0, 1)]) / mean


def local_pixels(images, valid):
    """The same over the light of each subaperture's own four pixels."""
    own = images.sum(axis=(0, 2))[valid]
    return np.concatenate([images[y, :, x][valid] / own for y in (0, 1) for x in (0, 1)])


@cache
def poked(alpha):
    """What an FFT pyramid sees of the modes, poked by a nanometre to either side."""
    model = model_of()
    sensor = fft_pyramid(model)
    shift = (alpha.shift_x_subap, alpha.shift_y_subap)
    opds = np.zeros((len(MODES), *model.pupil.amplitude.shape))
    opds[:, model.pupil.lit] = model.basis.render(model._mirror_points(alpha))[:, MODES].T
    return [[sensor.images(sign * STROKE_M * opd, shift) for sign in (1, -1)] for opd in opds]


def push_pull(model, alpha, signals):
    """The matrix that comes of it."""
    columns = [
        (signals(push, model.valid) - signals(pull, model.valid)) / (2 * STROKE_M)
        for push, pull in poked(alpha)
    ]
    return np.stack(columns, axis=1)


@pytest.mark.parametrize(
    ("recipe", "signals"),
    [(LOCAL, local_slopes), (PIXELS, pixels), (LOCAL_PIXELS, local_pixels)],
    ids=["local", "pixels", "local pixels"],
)
def test_the_matrix_is_what_an_fft_pyramid_measures_push_pull(recipe, signals):
    """0.4 %: light that the FFT wraps around, as with global normalisation."""
    model = model_of(recipe=recipe)
    expected = push_pull(model, SOMEWHERE, signals)
    found = model.interaction_matrix(SOMEWHERE)[:, MODES]
    assert np.linalg.norm(found - expected) < 4e-3 * np.linalg.norm(expected)


def test_it_is_not_the_matrix_of_global_normalisation():
    """Else the test above proves nothing: by some 10 % of the matrix."""
    both = [
        model_of(recipe=recipe).interaction_matrix(Misregistration())
        for recipe in (LOCAL, SlopeRecipe())
    ]
    assert np.linalg.norm(both[0] - both[1]) > 0.03 * np.linalg.norm(both[1])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("recipe", [LOCAL, LOCAL_PIXELS], ids=["slopes", "pixels"])
def test_derivatives_agree_with_central_differences(axis, recipe):
    """At 4 nodes edges and area agree to 0.2 % of a shift's derivative; a rotation's is exact."""
    model = model_of(nodes=4, dtype=np.float64, recipe=recipe)
    step = 1e-4 * np.eye(4)[axis]
    ahead, behind = (
        model.interaction_matrix(Misregistration.from_vector(SOMEWHERE.vector + s * step))
        for s in (1, -1)
    )
    expected = (ahead - behind) / 2e-4
    found = model.derivatives(SOMEWHERE)[axis]
    allowed = 2e-3 if axis < 2 else 1e-5
    assert np.linalg.norm(found - expected) < allowed * np.linalg.norm(expected)


@pytest.mark.parametrize(
    ("normalisation", "modulation", "floor"),
    [(Normalisation.GLOBAL, 3.0, 1e-4), (Normalisation.LOCAL, 3.0, 1e-3), ("global", 1.0, 1e-3)],
)
def test_no_magnification_is_surer_than_models_of_its_kind_agree(normalisation, modulation, floor):
    about = image_offsets.bench(Stop.MIRROR)
    about = replace(
        about,
        slopes=replace(about.slopes, normalisation=Normalisation(normalisation)),
        wfs=replace(about.wfs, modulation_lambda_over_d=modulation),
    )
    matrix = image_offsets.model_of(about).interaction_matrix(image_offsets.TRUTH)
    fit = fit_matrix(about, Reference(matrix=matrix), FitOptions(), basis=image_offsets.basis())
    assert floor <= fit.sigma[3] < 3.0 * floor
    assert any("floor of 0.1%" in one for one in fit.remarks) is (floor == 1e-3)
