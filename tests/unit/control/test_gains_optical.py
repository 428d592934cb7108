import numpy as np
import pytest

from service.control.gains import GAIN_FACTOR_RANGE, REFERENCE_GAINS, REFERENCE_MODES, gain_table
from service.errors import ModelError
from service.records.registration import ModeGain

HIGH = np.array([509, 527, 545, 563])
NONE = np.array([])


def table_of(modes, gains, sigma, n_modes):
    each = zip(modes, gains, sigma, strict=True)
    return gain_table(
        [ModeGain(mode=m, gain=g, sigma=s, scatter=s, t_ns_utc=0) for m, g, s in each], n_modes
    )


def reference(modes):
    return np.interp(np.log1p(modes), np.log1p(REFERENCE_MODES), REFERENCE_GAINS)


def test_with_nothing_measured_it_is_the_reference_and_says_how_little_it_knows():
    table = table_of(NONE, NONE, NONE, 594)
    np.testing.assert_allclose(table.optical_gain[list(REFERENCE_MODES)], REFERENCE_GAINS)
    assert table.relative_sigma[0] > 0.3


def test_four_high_modes_leave_the_low_ones_uncertain():
    table = table_of(HIGH, reference(HIGH), np.full(4, 0.01), 594)
    np.testing.assert_allclose(table.optical_gain, reference(np.arange(594)), rtol=0.02)
    assert table.relative_sigma[500] < 0.03
    assert table.relative_sigma[20] > 3 * table.relative_sigma[500]
    assert np.all(np.diff(table.relative_sigma[20:500:60]) < 0.0)


def test_a_stronger_residual_lowers_low_modes_more():
    """The logarithm scales with the residual: half as much again, for all modes."""
    table = table_of(HIGH, reference(HIGH) ** 1.5, np.full(4, 0.01), 594)
    truth = reference(np.arange(594)) ** 1.5
    departure = np.abs(np.log(table.optical_gain / truth)) / table.relative_sigma
    assert departure.max() < 2.0
    assert table.optical_gain[20] < reference(20) - 0.1


def test_a_measured_low_mode_decides_over_the_expectation():
    modes = np.append(HIGH, 20)
    gains = np.append(reference(HIGH), 0.4)
    table = table_of(modes, gains, np.full(5, 0.005), 594)
    assert table.optical_gain[20] == pytest.approx(0.4, rel=0.03)
    assert table.relative_sigma[20] < 0.03


LOOPS = [
    # modes 0, 7, 11, 22, 42, 80, 150, 200, 330, 399, and 409, 427, 445, 463 that are dithered:
    # true gains on the diffractive telescope at 0.6 arcsec, magnitudes 8 and 11, and at 1.2
    [0.751, 0.745, 0.743, 0.735, 0.743, 0.761, 0.785, 0.790, 0.803, 0.811,
     0.817, 0.818, 0.828, 0.834],
    [0.633, 0.628, 0.621, 0.602, 0.622, 0.663, 0.721, 0.737, 0.767, 0.776,
     0.790, 0.796, 0.806, 0.805],
    [0.374, 0.351, 0.346, 0.318, 0.351, 0.410, 0.481, 0.505, 0.551, 0.568,
     0.582, 0.586, 0.604, 0.600],
]  # fmt: skip
TRUE_MODES = np.array([0, 7, 11, 22, 42, 80, 150, 200, 330, 399, 409, 427, 445, 463])


@pytest.mark.parametrize("true", LOOPS)
def test_with_one_low_mode_the_curve_is_within_three_per_cent_of_the_true_gains(true):
    true, dithered = np.array(true), np.isin(TRUE_MODES, [11, 409, 427, 445, 463])
    table = table_of(TRUE_MODES[dithered], true[dithered], np.full(5, 0.005), 594)
    error = table.optical_gain[TRUE_MODES] / true - 1.0
    assert np.abs(error).max() < 0.03
    assert 0.2 < np.sqrt(np.mean((error / table.relative_sigma[TRUE_MODES]) ** 2)) < 1.5


def test_many_gains_of_a_former_seeing_do_not_outweigh_those_of_today():
    """Sixty modes were dithered once, two minutes before the residual grew by a fifth."""
    older, now = np.arange(0, 300, 5), np.append(HIGH, 11)
    measured = [
        ModeGain(mode=mode, gain=gain, sigma=0.03 * gain, scatter=0.02, t_ns_utc=t_ns)
        for modes, power, t_ns in ((older, 1.0, 0), (now, 1.2, round(120e9)))
        for mode, gain in zip(modes.tolist(), reference(modes) ** power, strict=True)
    ]
    found = gain_table(measured, 594).optical_gain
    truth, before = (reference(np.arange(594)) ** power for power in (1.2, 1.0))
    share = np.log(found / before) / np.log(truth / before)
    assert share.min() > 0.7


def test_a_flat_wavefront_needs_no_compensation():
    table = table_of(HIGH, np.ones(4), np.full(4, 0.005), 594)
    assert np.all(table.optical_gain > 0.85)
    assert table.factors.min() > 0.9
    assert table.factors.max() < 1.1


def test_light_that_met_the_mirror_twice_is_twice_an_optical_gain():
    once = table_of(HIGH, reference(HIGH), np.full(4, 0.01), 594)
    twice = table_of(HIGH, 2 * reference(HIGH), np.full(4, 0.02), 594)
    np.testing.assert_allclose(twice.optical_gain, 2 * once.optical_gain)
    np.testing.assert_allclose(twice.factors, once.factors)


def test_factors_have_mean_one_and_stay_within_bounds():
    table = table_of(HIGH, reference(HIGH), np.full(4, 0.01), 594)
    assert table.factors.mean() == pytest.approx(1.0)
    steep = table_of(np.array([0, 300]), np.array([0.1, 1.0]), np.full(2, 1e-3), 594)
    assert (
        GAIN_FACTOR_RANGE[0] <= steep.factors.min() <= steep.factors.max() == GAIN_FACTOR_RANGE[1]
    )


def test_the_gains_act_alike_on_every_mode():
    table = table_of(HIGH, reference(HIGH), np.full(4, 0.01), 594)
    np.testing.assert_allclose(table.loop_gains(0.4) * table.optical_gain, 0.4)


def test_the_gate_is_told_more_than_is_expected():
    table = table_of(HIGH, reference(HIGH), np.full(4, 0.01), 594)
    assert np.all(table.highest > 1.1 * table.optical_gain)
    assert table.highest[20] / table.optical_gain[20] > table.highest[520] / table.optical_gain[520]


@pytest.mark.parametrize(
    ("gains", "sigma", "match"),
    [
        ([0.0], [0.1], "expected positive numbers"),
        ([0.5], [-0.1], "expected positive numbers"),
        ([float("nan")], [0.1], "expected positive numbers"),
    ],
)
def test_what_is_no_gain_is_refused(gains, sigma, match):
    with pytest.raises(ModelError, match=match):
        table_of(np.array([3]), np.array(gains), np.array(sigma), 10)
