"""The non-linear pyramid against an FFT pyramid that shares no code with it, at any phase."""

from __future__ import annotations

import numpy as np
import pytest

from pyrcal_studies.fft_pyramid import FftPyramid
from service.instrument import load_instrument
from service.model.pupil import valid_subapertures
from service.model.sensors.pyramid.optics import PyramidOptics
from service.model.sensors.pyramid.signals import differentiate_signals, reference_slopes
from sim_rtc.telescope.diffractive import DiffractivePyramid, Quadrature, build_centred_pupil
from tests.support.numerics import flao_basis

MODES = [0, 1, 2, 5, 12, 35, 110, 230, 400, 593]
"""Ten modes from the tilts to the last one."""

SHIFT = (0.23, -0.31)
N_MODULATION = 24


@pytest.fixture(scope="module")
def instrument():
    return load_instrument("flao-lbt")


@pytest.fixture(scope="module")
def pupil(instrument):
    return build_centred_pupil(instrument, 3)


@pytest.fixture(scope="module")
def valid(instrument, pupil):
    return valid_subapertures(instrument)


@pytest.fixture(scope="module")
def shapes(instrument, pupil):
    """``(n_modes, n_points)``, unit RMS."""
    return flao_basis().render(pupil.points)[:, MODES].T


@pytest.fixture(scope="module")
def reference(instrument, pupil):
    return FftPyramid(
        amplitude=pupil.amplitude,
        sampling=pupil.sampling,
        wavelength_m=instrument.wfs.wavelength_m,
        n_modulation=N_MODULATION,
        padded_subap=160,
    )


def slopes_of(sensor, valid, opd_m):
    return reference_slopes(sensor.images(opd_m), valid)[0]


def on_grid(pupil, opd_m):
    grid = np.zeros_like(pupil.amplitude)
    grid[pupil.lit] = opd_m
    return grid


@pytest.mark.parametrize("rms_m", [pytest.param(1e-9, marks=pytest.mark.long), 50e-9])
def test_ten_modes_are_seen_as_an_fft_pyramid_sees_them(
    instrument, pupil, valid, shapes, reference, rms_m
):
    """50 nm is far from linear; light that the FFT wraps around makes 0.2 % at 160 subapertures."""
    sensor = DiffractivePyramid(instrument.wfs, pupil, SHIFT)
    flat = np.zeros(len(pupil.points))
    rest, expected_rest = slopes_of(sensor, valid, flat), None
    for shape in shapes if rms_m > 1e-8 else shapes[::3]:
        if expected_rest is None:
            expected_rest = reference.slopes(on_grid(pupil, flat), valid, SHIFT)
        found = slopes_of(sensor, valid, rms_m * shape) - rest
        expected = reference.slopes(on_grid(pupil, rms_m * shape), valid, SHIFT) - expected_rest
        correlation = found @ expected / np.linalg.norm(found) / np.linalg.norm(expected)
        assert correlation > 0.9999
        assert found @ expected / (expected @ expected) == pytest.approx(1.0, abs=0.004)


def test_one_nanometre_is_seen_as_the_linear_jacobian_says(instrument, pupil, valid, shapes):
    """0.1 % on the same grid, push-pull."""
    linear = PyramidOptics(wfs=instrument.wfs, pupil=pupil, n_nodes=2, n_modulation=28)
    jacobian = differentiate_signals(linear.response(valid, SHIFT), valid)
    jacobian *= np.float32(2 * np.pi / instrument.wfs.wavelength_m)
    sensor = DiffractivePyramid(instrument.wfs, pupil, SHIFT, Quadrature(n_modulation=28))
    for shape in shapes:
        opd_m = 1e-9 * shape
        found = (slopes_of(sensor, valid, opd_m) - slopes_of(sensor, valid, -opd_m)) / 2
        expected = jacobian @ opd_m
        assert np.linalg.norm(found - expected) < 1e-3 * np.linalg.norm(expected)
