import numpy as np
import pytest
import scipy

from sim_rtc.telescope.sky import Shape, VibrationLine, Vibrations

RATE_HZ = 500.0
AXIS = np.linspace(-1.0, 1.0, 41)
X, Y = (grid.ravel() for grid in np.meshgrid(AXIS, AXIS))
INSIDE = np.hypot(X, Y) <= 1.0
POINTS = np.column_stack([X, Y])[INSIDE]
WEIGHTS = np.full(len(POINTS), 1 / len(POINTS))


def vibrations(*lines, seed=1):
    return Vibrations(
        lines,
        points=POINTS,
        weights=WEIGHTS,
        frame_rate_hz=RATE_HZ,
        rng=np.random.default_rng(seed),
    )


def test_tip_rises_along_x_tilt_along_y_and_focus_outwards():
    shapes = vibrations(
        *(VibrationLine(shape=shape, frequency_hz=10.0, rms_m=1e-9) for shape in Shape)
    ).phase_per_line
    # Zernike's tilt is 2 x, Zernike's focus sqrt(3) (2 r² - 1); 1245 points make the disc.
    radius2 = (POINTS**2).sum(axis=1)
    expected = np.column_stack([2 * POINTS, np.sqrt(3) * (2 * radius2 - 1)])
    np.testing.assert_allclose(shapes, expected, atol=0.08)
    np.testing.assert_allclose(WEIGHTS @ shapes**2, 1.0, rtol=1e-5)
    np.testing.assert_allclose(WEIGHTS @ shapes, 0.0, atol=1e-5)


def test_a_pure_sine_has_its_frequency_and_strength_across_calls():
    line = VibrationLine(shape=Shape.TIP, frequency_hz=25.0, rms_m=30e-9, damping=0.0)
    source = vibrations(line)
    strength = np.concatenate([source.frames(n)[:, 0] for n in (10, 490, 1500)])
    spectrum = np.abs(np.fft.rfft(strength)) / len(strength) * np.sqrt(2)
    assert spectrum.argmax() == 25 * 4
    assert spectrum.max() == pytest.approx(30e-9, rel=1e-4)
    assert np.delete(spectrum, 100).max() < 1e-12


def test_a_shaken_oscillator_has_its_rms_its_frequency_and_its_width():
    damping, frequency_hz = 0.02, 60.0
    line = VibrationLine(shape=Shape.FOCUS, frequency_hz=frequency_hz, rms_m=20e-9, damping=damping)
    source = vibrations(line)
    strength = np.concatenate([source.frames(500)[:, 0] for _ in range(400)]).astype(float)
    # 400 s, coherent for 1 / (damping 2 pi f) = 0.13 s: 2.6 % on the variance.
    assert strength.var() == pytest.approx((20e-9) ** 2, rel=0.08)
    frequency, power = scipy.signal.welch(strength, fs=RATE_HZ, nperseg=4096)
    peak = frequency[power.argmax()]
    assert peak == pytest.approx(frequency_hz, rel=damping)
    # The half-power width of a resonance is 2 damping f.
    above = frequency[power > power.max() / 2]
    assert np.ptp(above) == pytest.approx(2 * damping * frequency_hz, rel=0.5)


def test_a_shaken_oscillator_starts_in_its_steady_state():
    line = VibrationLine(shape=Shape.TIP, frequency_hz=20.0, rms_m=1.0, damping=0.01)
    first = np.array([vibrations(line, seed=seed).frames(40)[:, 0] for seed in range(600)])
    # 600 runs: 6 % on a variance; 0.04 s is a small part of the 0.8 s it takes to build up.
    np.testing.assert_allclose(first.var(axis=0), 1.0, rtol=0.25)
    assert first[:, -1].var() == pytest.approx(first[:, 0].var(), rel=0.3)


def test_two_lines_on_one_shape_are_independent():
    line = VibrationLine(shape=Shape.TIP, frequency_hz=20.0, rms_m=1.0, damping=0.05)
    both = vibrations(line, line).frames(20_000)
    # Coherence time 0.16 s in 40 s: 250 independent samples.
    assert abs(np.corrcoef(both.T)[0, 1]) < 4 / np.sqrt(250)


def test_no_line_is_no_vibration():
    assert vibrations().frames(10).shape == (10, 0)
