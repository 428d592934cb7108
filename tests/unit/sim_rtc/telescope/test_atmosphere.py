import numpy as np
import pytest

from service.model.kinds import KarhunenLoeve
from service.model.turbulence import von_karman_covariance
from sim_rtc.telescope.atmosphere import ExtrudedScreen, compute_fried_parameter_m

TURBULENCE = KarhunenLoeve(r0_m=0.1, outer_scale_m=10.0)
PITCH_M = 0.1


@pytest.fixture(scope="module")
def strip():
    """A strip of 2.5 km, 250 outer scales."""
    screen = ExtrudedScreen(
        n_columns=64,
        n_kept=64,
        pitch_m=PITCH_M,
        turbulence=TURBULENCE,
        rng=np.random.default_rng(11),
    )
    rows = np.empty((25_000, 64))
    for row in rows:
        screen.extrude()
        row[:] = screen.window(1)[0]
    return rows


@pytest.mark.parametrize("separation", [1, 2, 5, 15, 50])
@pytest.mark.parametrize("axis", [0, 1], ids=["along", "across"])
def test_the_structure_function_is_von_karmans(strip, separation, axis):
    moved = np.swapaxes(strip, 0, 1) if axis else strip
    difference = (moved[separation:] - moved[:-separation]) ** 2
    difference = np.swapaxes(difference, 0, 1) if axis else difference
    # Pieces of 10 outer scales are as good as independent.
    pieces = difference[: len(difference) // 25 * 25].reshape(25, -1).mean(axis=1)
    covariance = von_karman_covariance(np.array([0.0, separation * PITCH_M]), TURBULENCE)
    expected = 2 * (covariance[0] - covariance[1])
    # 4 standard errors, and 3 % for the older rows, of which the extrusion sees every fourth point.
    tolerance = 4 * pieces.std() / np.sqrt(len(pieces)) + 0.03 * expected
    assert pieces.mean() == pytest.approx(expected, abs=tolerance)
    assert tolerance < 0.25 * expected


def test_the_variance_is_finite_and_the_analytic_one(strip):
    pieces = (strip**2).reshape(25, -1).mean(axis=1)
    expected = float(von_karman_covariance(np.array(0.0), TURBULENCE))
    assert pieces.mean() == pytest.approx(expected, abs=4 * pieces.std() / 5)


def test_the_same_seed_gives_the_same_screen():
    def first_row(seed):
        screen = ExtrudedScreen(
            n_columns=16,
            n_kept=16,
            pitch_m=PITCH_M,
            turbulence=TURBULENCE,
            rng=np.random.default_rng(seed),
        )
        return screen.window(1)[0].copy()

    np.testing.assert_array_equal(first_row(1), first_row(1))
    assert not np.array_equal(first_row(1), first_row(2))


def test_one_arcsecond_is_a_fried_parameter_of_ten_centimetres():
    assert compute_fried_parameter_m(1.0) == pytest.approx(0.101, abs=0.001)
    assert compute_fried_parameter_m(0.5) == pytest.approx(2 * compute_fried_parameter_m(1.0))
