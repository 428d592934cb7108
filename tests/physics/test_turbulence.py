"""Von Karman turbulence against the published asymptotic forms."""

from __future__ import annotations

import numpy as np
import pytest

from service.model.kinds import KarhunenLoeve
from service.model.modes import karhunen_loeve_basis
from service.model.turbulence import REFERENCE_WAVELENGTH_M, von_karman_covariance
from tests.support.numerics import flao_basis, small_instrument

TURBULENCE = KarhunenLoeve(r0_m=0.10, outer_scale_m=25.0)
RADIANS = 2 * np.pi / REFERENCE_WAVELENGTH_M


def structure_function(separation_m, turbulence=TURBULENCE):
    """Of the phase, radians² at 500 nm."""
    at_zero = von_karman_covariance(0.0, turbulence)
    return 2 * (at_zero - von_karman_covariance(separation_m, turbulence)) * RADIANS**2


def kolmogorov(separation_m, turbulence=TURBULENCE):
    return 6.88 * (separation_m / turbulence.r0_m) ** (5 / 3)


def test_far_inside_the_outer_scale_it_is_kolmogorov():
    """The outer scale takes 1.49 (r / L0)^(1/3): 1.5 % at a millionth of it."""
    separation = 1e-6 * TURBULENCE.outer_scale_m * np.array([0.3, 1.0])
    np.testing.assert_allclose(structure_function(separation), kolmogorov(separation), rtol=0.02)


@pytest.mark.parametrize("ratio", [1e-4, 1e-3, 1e-2, 0.1])
def test_the_outer_scale_takes_its_share_as_published(ratio):
    """1 - 1.485 x^(1/3) + 5.383 x² - 6.281 x^(7/3), x = r / L0 (Conan 2000), to three digits."""
    separation = ratio * TURBULENCE.outer_scale_m
    share = 1 - 1.485 * ratio ** (1 / 3) + 5.383 * ratio**2 - 6.281 * ratio ** (7 / 3)
    assert structure_function(separation) == pytest.approx(kolmogorov(separation) * share, rel=3e-3)


def test_the_variance_is_the_integral_of_the_spectrum():
    """0.0229 r0^(-5/3) (f² + 1/L0²)^(-11/6) over the plane: 0.0229 (6π/5) (L0/r0)^(5/3).

    0.5 %: 0.0229 is known to three digits.
    """
    variance = von_karman_covariance(0.0, TURBULENCE) * RADIANS**2
    assert variance == pytest.approx(0.0229 * 1.2 * np.pi * 250 ** (5 / 3), rel=5e-3)


def test_the_covariance_has_no_step_where_the_formula_changes():
    near = von_karman_covariance(np.array([0.0, 1e-12, 1e-8, 1e-6]), TURBULENCE)
    np.testing.assert_allclose(near, near[0], rtol=1e-9)


def test_the_covariance_falls_to_nothing_beyond_the_outer_scale():
    separation = np.linspace(0.01, 100.0, 200)
    covariance = von_karman_covariance(separation, TURBULENCE)
    assert np.all(np.diff(covariance) < 0)
    assert covariance[-1] < 1e-8 * covariance[0]


def test_stronger_turbulence_scales_every_covariance_alike():
    """r0^(-5/3)."""
    strong = KarhunenLoeve(r0_m=0.05, outer_scale_m=25.0)
    separation = np.array([0.0, 0.1, 3.0, 30.0])
    np.testing.assert_allclose(
        von_karman_covariance(separation, strong),
        2 ** (5 / 3) * von_karman_covariance(separation, TURBULENCE),
    )


def test_an_unobscured_tilt_has_nolls_variance():
    """0.448 (D / r0)^(5/3) rad² for each axis of Kolmogorov turbulence.

    4 %: a KL tilt carries 1.7 % more than Zernike's, an outer scale of 1e7 m takes 1.4 %.
    """
    turbulence = KarhunenLoeve(r0_m=0.10, outer_scale_m=1e7)
    instrument = small_instrument(obscuration_ratio=0.0, turbulence=turbulence)
    variance = karhunen_loeve_basis(instrument).variance_m2[:2] * RADIANS**2
    np.testing.assert_allclose(variance, 0.448 * (8.0 / 0.10) ** (5 / 3), rtol=0.04)


def test_the_full_instruments_modes_fall_off_as_kolmogorov_modes_do():
    """Variance ~ j^(-11/6) (Noll 1976), mode number times four: 12.7; 10 % for the edge."""
    variance = flao_basis().variance_m2
    ratio = variance[60:80].mean() / variance[240:320].mean()
    assert ratio == pytest.approx(4 ** (11 / 6), rel=0.1)
