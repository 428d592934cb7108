"""The separable interaction matrix against an FFT pyramid that shares no code with it."""

from __future__ import annotations

import numpy as np
import pytest

from pyrcal_studies.fft_pyramid import FftPyramid
from service.instrument.reader import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import ModalBasis
from tests.support.numerics import flao_basis

AGREEMENT = 0.003
"""Relative Frobenius norm of the difference when the reference is padded to 160 subapertures.

Nearly all of it is light that leaves the reference's detector plane on one side and comes back on
the other: 0.22 % at 160 subapertures, 0.06 % at 320, 0.03 % at 480.
"""

MODES = [0, 1, 2, 3, 5, 8, 12, 18, 25, 35, 50, 75, 110, 160, 230, 300, 400, 501, 550, 593]
"""Twenty modes from the tilts to the last one."""

REGISTRATIONS = {
    "aligned": Misregistration(),
    "shifted by parts of a subaperture": Misregistration(shift_x_subap=0.23, shift_y_subap=-0.31),
    "turned and scaled": Misregistration(rotation_rad=np.deg2rad(-1.5), magnification=1.02),
    "everything at once": Misregistration(
        shift_x_subap=-0.7, shift_y_subap=0.4, rotation_rad=np.deg2rad(65.08), magnification=0.985
    ),
}


@pytest.fixture(scope="module")
def basis() -> ModalBasis:
    return flao_basis()


def optics(
    basis: ModalBasis, sampling: int, n_nodes: int, padded_subap: int = 160
) -> tuple[InteractionModel, FftPyramid]:
    """The model and the reference with the same sampling, quadrature and modulation."""
    instrument = load_instrument("flao-lbt")
    model = InteractionModel(instrument, basis, pupil_sampling=sampling, detector_nodes=n_nodes)
    reference = FftPyramid(
        amplitude=model.pupil.amplitude,
        sampling=sampling,
        wavelength_m=instrument.wfs.wavelength_m,
        n_subapertures=instrument.wfs.n_subapertures,
        n_modulation=28,
        n_nodes=n_nodes,
        padded_subap=padded_subap,
    )
    return model, reference


def moved_modes(
    basis: ModalBasis, reference: FftPyramid, alpha: Misregistration, modes: list[int]
) -> np.ndarray:
    """OPD maps ``(n_maps, n, n)`` of the mirror turned and scaled about the pupil centre."""
    u = reference.coordinates
    x, y = (axis.ravel() for axis in np.meshgrid(u, u))
    cosine, sine = np.cos(alpha.rotation_rad), np.sin(alpha.rotation_rad)
    on_mirror = np.column_stack([cosine * x + sine * y, cosine * y - sine * x])
    maps = basis.render(on_mirror / alpha.magnification)[:, modes]
    return maps.T.reshape(len(modes), len(u), len(u))


def disagreement(
    model: InteractionModel,
    reference: FftPyramid,
    alpha: Misregistration,
    modes: list[int] = MODES,
) -> float:
    maps = moved_modes(model.basis, reference, alpha, modes)
    expected = reference.jacobian(maps, model.valid, (alpha.shift_x_subap, alpha.shift_y_subap))
    found = model.interaction_matrix(alpha)[:, modes]
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def test_the_reference_is_the_pyramid_of_textbooks(basis):
    """Plane by plane, in two dimensions: the light where no modulation is and one node looks."""
    amplitude = optics(basis, 2, 2)[0].pupil.amplitude
    unmodulated = FftPyramid(
        amplitude=amplitude,
        sampling=2,
        wavelength_m=750e-9,
        modulation_lambda_over_d=0.0,
        n_modulation=1,
        n_nodes=1,
    )
    opd_m = 30e-9 * np.random.default_rng(1).normal(size=amplitude.shape)
    n, frequencies = 2 * 160, np.fft.fftfreq(2 * 160, 0.5)
    padded = np.zeros((n, n), complex)
    padded[: len(amplitude), : len(amplitude)] = amplitude * np.exp(2j * np.pi * opd_m / 750e-9)
    faces = np.abs(frequencies[:, None]) + np.abs(frequencies)
    on_detector = np.fft.ifft2(np.fft.fft2(padded) * np.exp(36j * np.pi * faces))
    # a quarter of a subaperture aside the middles of its subapertures are points of the grid
    middles = np.array([-18.0, 18.0])[:, None] + np.arange(30) - 14.5 - 0.25
    at = np.rint(2 * (middles - unmodulated.coordinates[0])).astype(int).ravel()
    expected = np.abs(on_detector[np.ix_(at, at)]) ** 2
    found = unmodulated.images(opd_m, (0.25, 0.25)).reshape(60, 60)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_interaction_matrix_agrees_with_the_fft_pyramid(basis):
    """At the registration that leaves nothing as it was, by ten of the modes."""
    alpha = REGISTRATIONS["everything at once"]
    assert disagreement(*optics(basis, 2, 2), alpha, MODES[1::2]) <= AGREEMENT


@pytest.mark.long
@pytest.mark.parametrize("alpha", list(REGISTRATIONS.values())[:-1], ids=list(REGISTRATIONS)[:-1])
def test_it_agrees_at_simpler_registrations_too(basis, alpha):
    """By the other ten."""
    assert disagreement(*optics(basis, 2, 2), alpha, MODES[::2]) <= AGREEMENT


@pytest.mark.slow
@pytest.mark.parametrize("alpha", REGISTRATIONS.values(), ids=REGISTRATIONS)
def test_agreement_holds_at_the_sampling_of_the_service(basis, alpha):
    assert disagreement(*optics(basis, 3, 3), alpha) <= AGREEMENT


@pytest.mark.long
def test_most_of_the_disagreement_goes_away_when_the_reference_is_padded_more(basis):
    alpha = REGISTRATIONS["everything at once"]
    near, far = (disagreement(*optics(basis, 2, 2, w), alpha, MODES[::6]) for w in (160, 320))
    assert far <= near / 3


def test_a_wavefront_rising_along_an_axis_gives_positive_mean_slopes_on_that_axis_only(basis):
    model, reference = optics(basis, 2, 2)
    u = reference.coordinates
    n_valid = model.n_slopes // 2
    for axis, tilt in enumerate(np.broadcast_arrays(u, u[:, None])):
        jacobian = reference.jacobian(tilt[None], model.valid)[:, 0]
        mean = np.array([jacobian[:n_valid].mean(), jacobian[n_valid:].mean()])
        assert mean[axis] > 0
        assert abs(mean[1 - axis]) < 1e-4 * mean[axis]


def test_the_model_sees_the_tilt_modes_rise_along_their_axes(basis):
    """Mode 0 is the tilt along +x, mode 1 the one along +y."""
    model, _ = optics(basis, 2, 2)
    tilts = model.interaction_matrix(Misregistration())[:, :2]
    mean = tilts.reshape(2, -1, 2).mean(axis=1)
    assert mean[0, 0] > 0
    assert mean[1, 1] > 0
    assert abs(mean[1, 0]) < 0.01 * mean[0, 0]
    assert abs(mean[0, 1]) < 0.01 * mean[1, 1]


def test_a_shift_of_one_subaperture_along_x_moves_the_images_by_one_column(basis):
    _, reference = optics(basis, 2, 2)
    flat = np.zeros_like(reference.amplitude)
    at_rest, moved = reference.images(flat), reference.images(flat, (1.0, 0.0))
    np.testing.assert_allclose(moved[..., 1:], at_rest[..., :-1], rtol=1e-9)
