"""The flow as a pupil sees it, against the theory of von Karman turbulence.

A functional of the phase over the pupil (a difference between two points, a tilt) with weights w_j
at points x_j passes the spectrum through
``|W(k)|² = |sum_j w_j exp(2πi k·x_j)|²``. Under frozen flow along x its temporal spectrum is
``(2 / v) ∫ Φ(f / v, ky) |W(f / v, ky)|² dky`` (f > 0): exact, whatever the pupil looks like.
"""

from itertools import pairwise

import numpy as np
import pytest
import scipy

from service.model.kinds import KarhunenLoeve
from service.model.turbulence import von_karman_covariance
from sim_rtc.telescope.atmosphere import ExtrudedScreen, FrozenLayer, Layer
from sim_rtc.telescope.imperfections import FOCUS, TILT, TIP, low_orders

TURBULENCE = KarhunenLoeve(r0_m=0.1, outer_scale_m=10.0)
PITCH_M = 0.1
SPEED_M_S = 10.0
DIRECTION_DEG = 35.0
N_STEPS = 40_000
"""4 km of turbulence, 400 outer scales."""

_ANGLE = np.deg2rad(DIRECTION_DEG)
ALONG = np.array([np.cos(_ANGLE), np.sin(_ANGLE)])
ACROSS = np.array([-np.sin(_ANGLE), np.cos(_ANGLE)])

# A pupil of 1.6 m on a grid that is neither the screen's nor aligned with it.
_AXIS = np.arange(-0.75, 0.76, 0.1)
_X, _Y = (grid.ravel() for grid in np.meshgrid(_AXIS, _AXIS))
POINTS_M = np.column_stack([_X, _Y])[np.hypot(_X, _Y) <= 0.8]
AREA = np.full(len(POINTS_M), 1 / len(POINTS_M))
PAIRS_M = np.array([0.2, 0.4, 0.8, 1.4])
_HALF_M = np.concatenate([PAIRS_M[:, None] * ALONG / 2, PAIRS_M[:, None] * ACROSS / 2])
PROBES_M = np.concatenate([_HALF_M, -_HALF_M])


@pytest.fixture(scope="module")
def flow():
    """Phase ``(N_STEPS, n)`` at the pupil's points, and at the probes behind them."""
    layer = FrozenLayer(
        Layer(fraction=1.0, speed_m_s=SPEED_M_S, direction_deg=DIRECTION_DEG),
        points_m=np.concatenate([POINTS_M, PROBES_M]),
        pitch_m=PITCH_M,
        turbulence=TURBULENCE,
        rng=np.random.default_rng(5),
    )
    assert layer.steps_per_second == pytest.approx(SPEED_M_S / PITCH_M)
    layer.reach(0, N_STEPS - 1)
    some = [np.arange(k, k + 400)[:, None] for k in range(0, N_STEPS, 400)]
    return np.concatenate([layer.phases(step, np.ones_like(step, np.float32)) for step in some])


def spectrum_m2(k):
    """Return von Karman's power spectrum, m² of OPD per (cycle/m)², integral = variance."""
    phase = 0.0229 * TURBULENCE.r0_m ** (-5 / 3)
    phase = phase * (k**2 + TURBULENCE.outer_scale_m**-2) ** (-11 / 6)
    return phase * (500e-9 / (2 * np.pi)) ** 2


def temporal_spectrum_m2_hz(frequency_hz, points_m, weights):
    """Return the one-sided spectrum of ``weights · phase`` by quadrature over ky."""
    along, across = points_m @ ALONG, points_m @ ACROSS
    kx, ky = frequency_hz / SPEED_M_S, np.concatenate([[0.0], np.logspace(-4, 1.5, 800)])
    by_y = np.exp(2j * np.pi * ky[:, None] * across)
    by_x = weights[:, None] * np.exp(2j * np.pi * kx * along[:, None])
    passed = np.abs(by_y @ by_x) ** 2 + np.abs(by_y.conj() @ by_x) ** 2
    density = spectrum_m2(np.hypot(kx, ky[:, None])) * passed
    return 2.0 / SPEED_M_S * np.trapezoid(density, ky, axis=0)


def measured_spectrum(series):
    return scipy.signal.welch(
        series, fs=SPEED_M_S / PITCH_M, nperseg=2048, window="hann", detrend="constant"
    )


def band_means(frequency_hz, power, edges_hz):
    return np.array(
        [
            power[(frequency_hz >= low) & (frequency_hz < high)].mean()
            for low, high in pairwise(edges_hz)
        ]
    )


def test_the_spectrum_of_the_theory_is_that_of_the_covariance():
    """The constant .0229 is rounded: 0.5 %."""
    k = np.logspace(-5, 3, 200_000)
    variance = np.trapezoid(2 * np.pi * k * spectrum_m2(k), k)
    assert variance == pytest.approx(
        float(von_karman_covariance(np.array(0.0), TURBULENCE)), rel=0.01
    )


@pytest.mark.parametrize("direction", [0, 1], ids=["along the wind", "across the wind"])
@pytest.mark.parametrize("k", range(4))
def test_the_structure_function_over_the_pupil_is_von_karmans(flow, direction, k):
    first = len(POINTS_M) + 4 * direction + k
    difference = flow[:, first] - flow[:, first + 8]
    pieces = (difference.astype(float) ** 2).reshape(40, -1).mean(axis=1)
    covariance = von_karman_covariance(np.array([0.0, PAIRS_M[k]]), TURBULENCE)
    expected = 2 * (covariance[0] - covariance[1])
    # 4 standard errors of 40 pieces of 10 outer scales; 3 % for the thinned-out older rows, and
    # what the cubic interpolation between points of the screen takes off: 2 % at 2 pitches.
    tolerance = 4 * pieces.std() / np.sqrt(40) + (0.03 + 0.02 * (k == 0)) * expected
    assert pieces.mean() == pytest.approx(expected, abs=tolerance)
    assert tolerance < 0.2 * expected


@pytest.mark.parametrize("shape", [TIP, TILT, FOCUS], ids=["tip", "tilt", "focus"])
def test_the_temporal_spectrum_is_that_of_frozen_flow(flow, shape):
    edges_hz = [0.3, 1.0, 2.0, 4.0, 7.0, 12.0]
    weights = AREA * low_orders(POINTS_M, AREA, 2)[:, shape]
    frequency, power = measured_spectrum(flow[:, : len(weights)].astype(float) @ weights)
    theory = temporal_spectrum_m2_hz(frequency[1:], POINTS_M, weights)
    seen = band_means(frequency[1:], power[1:], edges_hz)
    expected = band_means(frequency[1:], theory, edges_hz)
    n_bins = np.diff(edges_hz) / (frequency[1] - frequency[0])
    # 39 half-overlapping segments are 30 independent ones; neighbouring bins share 2/3 of a Hann
    # line. Cubic interpolation between rows and columns takes 10 % off at a fifth of the sampling.
    tolerance = 4 / np.sqrt(30 * n_bins / 1.5) + 0.05 + 0.10 * (np.array(edges_hz[1:]) / 20) ** 2
    np.testing.assert_array_less(np.abs(seen / expected - 1), tolerance)
    # It falls by more than that: the shape is what is tested, not the strength alone.
    assert expected.max() / expected.min() > 10
    assert tolerance.max() < 0.35


def test_the_phase_of_a_point_has_its_frozen_flow_spectrum():
    """One column of the strip, which has its piston still."""
    screen = ExtrudedScreen(
        n_columns=16,
        n_kept=16,
        pitch_m=PITCH_M,
        turbulence=TURBULENCE,
        rng=np.random.default_rng(8),
    )
    series = np.empty(N_STEPS)
    for k in range(N_STEPS):
        screen.extrude()
        series[k] = screen.window(1)[0, 8]
    frequency, power = measured_spectrum(series)
    edges_hz = [0.3, 1.0, 2.0, 4.0, 8.0, 16.0]
    point = temporal_spectrum_m2_hz(frequency[1:], np.zeros((1, 2)), np.ones(1))
    ratio = band_means(frequency[1:], power[1:], edges_hz) / band_means(
        frequency[1:], point, edges_hz
    )
    n_bins = np.diff(edges_hz) / (frequency[1] - frequency[0])
    # As above; a Hann line leaks a steep spectrum's lowest band by a few per cent, and sampling
    # folds f^(-8/3) back: (84 / 16)^(-8/3) = 1.2 % at the end.
    np.testing.assert_array_less(np.abs(ratio - 1), 4 / np.sqrt(30 * n_bins / 1.5) + 0.06)


def test_nothing_repeats_within_ten_minutes():
    """10 minutes at 10 m/s are 6 km: the strip's own noise is never used again.

    A repeated stretch would show as a correlation of ~1 at its distance. Independent stretches of
    n coherence lengths correlate by 1 / sqrt(n).
    """
    screen = ExtrudedScreen(
        n_columns=8,
        n_kept=8,
        pitch_m=PITCH_M,
        turbulence=TURBULENCE,
        rng=np.random.default_rng(9),
    )
    rows = np.empty((60_000, 8))
    for row in rows:
        screen.extrude()
        row[:] = screen.window(1)[0]
    # Differences along the flow have no long memory; a stretch of 2 s is 200 rows.
    whole = np.diff(rows, axis=0).mean(axis=1)
    stretch = whole[-200:]
    sums = np.correlate(whole[:-400], stretch, mode="valid")
    norm = np.sqrt(np.convolve(whole[:-400] ** 2, np.ones(200), mode="valid") * (stretch @ stretch))
    assert np.abs(sums / norm).max() < 0.6
    # The same measure finds a repetition when there is one.
    assert np.correlate(whole[-200:], stretch)[0] / (stretch @ stretch) == pytest.approx(1.0)
