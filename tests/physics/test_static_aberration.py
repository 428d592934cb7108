"""A pyramid that sees a static aberration, against an FFT pyramid that shares no code with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal_studies.fft_pyramid import FftPyramid
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import analytic_basis
from service.model.pupil import instrument_pupil
from service.model.sensors.pyramid.description import draw_aberration
from service.model.slopes import Orientation, SlopeRecipe, rtc_mask
from tests.support.numerics import small_basis, small_instrument
from tests.support.repository import ROOT

ABERRATION_RAD = (0.1, -0.05, 0.2, -0.3, 0.1, 0.15, 0.0, -0.1, 0.0, 0.2)
"""From tilt along x to spherical aberration, 0.48 rad RMS."""

TRUE = Misregistration(
    shift_x_subap=0.1, shift_y_subap=-0.05, rotation_rad=0.01, magnification=1.01
)


def aberrated(bench, aberration_rad=ABERRATION_RAD):
    return replace(bench, wfs=replace(bench.wfs, aberration_rad=aberration_rad))


def measure(bench, basis, alpha, sampling):
    """Return the matrix of an FFT pyramid behind the aberrated pupil."""
    model = InteractionModel(aberrated(bench), basis, pupil_sampling=sampling)
    pupil, wfs = model.pupil, bench.wfs
    shapes = np.zeros((basis.n_modes, *pupil.amplitude.shape))
    shapes[:, pupil.lit] = model.render_modes(alpha).T
    fft = FftPyramid(
        amplitude=pupil.amplitude * np.exp(1j * draw_aberration(aberrated(bench), pupil)),
        sampling=sampling,
        wavelength_m=wfs.wavelength_m,
        n_subapertures=wfs.n_subapertures,
        image_separation_subap=wfs.image_separation_subap,
        modulation_lambda_over_d=wfs.modulation_lambda_over_d,
        n_modulation=40,
        n_nodes=3,
        padded_subap=10 * wfs.n_subapertures,
    )
    shift = tuple(alpha.vector[:2]) if bench.stop == "mirror" else (0.0, 0.0)
    return fft.jacobian(shapes, model.valid, shift)


@pytest.mark.parametrize("modes", [[0, 5, 39], list(range(30))], ids=["few", "many"])
@pytest.mark.parametrize("modulation", [0.0, 3.0])
def test_the_matrix_is_that_of_an_fft_pyramid(modes, modulation):
    bench = small_instrument()
    bench = replace(bench, wfs=replace(bench.wfs, modulation_lambda_over_d=modulation))
    basis = small_basis().subset(np.array(modes))
    expected = measure(bench, basis, Misregistration(), 3)

    def relative(about):
        model = InteractionModel(about, basis, pupil_sampling=3, detector_nodes=3)
        found = model.interaction_matrix(Misregistration())
        return np.linalg.norm(found - expected) / np.linalg.norm(expected)

    # most of it light that the FFT wraps around
    assert relative(aberrated(bench)) < 0.01
    assert relative(bench) > 0.03


@pytest.mark.parametrize(
    "orientation",
    [
        Orientation(),
        Orientation(flip_x=True),
        Orientation(swap_xy=True, flip_y=True),
        Orientation(swap_xy=True, sign_x=-1, sign_y=-1),
    ],
)
def test_the_aberration_turns_with_the_axes_of_the_rtc(orientation):
    plain = aberrated(small_instrument())
    bench = replace(plain, slopes=SlopeRecipe(orientation=orientation))
    pupil = instrument_pupil(plain, 2)
    seen = rtc_mask(pupil.lit, orientation)
    turned = rtc_mask(draw_aberration(bench, pupil), orientation) * orientation.sign_x
    np.testing.assert_allclose(turned[seen], draw_aberration(plain, pupil)[seen], atol=1e-9)


@pytest.fixture(scope="module")
def bench():
    """A bench with a pyramid that is not modulated, and the FFT pyramid's matrix."""
    about = load_instrument(ROOT / "tests" / "system" / "small.toml")
    about = replace(about, wfs=replace(about.wfs, modulation_lambda_over_d=0.0))
    modes = np.arange(40)
    basis = analytic_basis(about).subset(modes)
    return about, Reference(matrix=measure(about, basis, TRUE, 4), modes=modes)


def test_a_fit_finds_it_where_the_file_calls_it_unknown(bench):
    about, reference = bench
    unknown = replace(about, unknown=("wfs.static_aberration_nm",))
    found = fit_matrix(unknown, reference, FitOptions())
    assert found.accepted
    assert np.all(np.abs(found.alpha.vector - TRUE.vector) < 3.0 * found.sigma)
    entry = found.corrections["wfs.static_aberration_nm"]
    unit_nm = about.wfs.wavelength_m / (2.0 * np.pi * 1e-9)
    assert np.array(entry)[:10] == pytest.approx(np.array(ABERRATION_RAD) * unit_nm, abs=2.0)
    assert np.array(entry)[10:] == pytest.approx(0.0, abs=2.0)


def test_an_aberration_that_the_file_does_not_have_is_named(bench):
    found = fit_matrix(*bench, FitOptions())
    key = 'static_aberration_nm = "unknown"'
    (named,) = (one for one in found.alternatives if one.key == key)
    assert named.preferred
    assert key in found.recommendation
    # and sigma allows for it
    assert np.all(np.abs(found.alpha.vector - TRUE.vector) < 3.0 * found.sigma)
