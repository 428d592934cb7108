import numpy as np
import pytest

from service.errors import ModelError
from service.model.kinds import KarhunenLoeve
from service.model.turbulence import von_karman_covariance
from sim_rtc.telescope.atmosphere import (
    ExtrudedScreen,
    FrozenLayer,
    Layer,
    PhaseResponse,
    build_layers,
    compute_fried_parameter_m,
    cubic_weights,
)

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


# --- frozen flow


def phases_at(layer, step):
    """Return the pupil's phase at steps that were reached."""
    return layer.phases(step[:, None], np.ones((len(step), 1), np.float32))


def steps(layer, n_steps):
    """Return the pupil's phase after each of the first steps."""
    layer.reach(0, n_steps - 1)
    return phases_at(layer, np.arange(n_steps))


@pytest.mark.parametrize("direction_deg", [0.0, 35.0, 200.0])
def test_the_flow_is_frozen_and_goes_where_the_wind_goes(direction_deg):
    angle = np.deg2rad(direction_deg)
    step_m = PITCH_M * np.array([np.cos(angle), np.sin(angle)])
    upwind = np.random.default_rng(3).uniform(-2.0, 2.0, (200, 2))
    layer = FrozenLayer(
        Layer(fraction=1.0, speed_m_s=12.0, direction_deg=direction_deg),
        points_m=np.concatenate([upwind, upwind + 3 * step_m]),
        pitch_m=PITCH_M,
        turbulence=TURBULENCE,
        rng=np.random.default_rng(4),
    )
    phases = steps(layer, 20)
    earlier, later = phases[:-3, :200], phases[3:, 200:]
    # Each window has its own piston taken off.
    difference = later - earlier
    difference -= difference.mean(axis=1, keepdims=True)
    assert np.abs(difference).max() < 1e-4 * phases.std()
    assert layer.steps_per_second == pytest.approx(120.0)


def test_cubic_weights_carry_parabolas_through():
    position = np.linspace(0.0, 1.0, 11)
    taps = np.arange(-1.0, 3.0)
    weights = cubic_weights(position)
    np.testing.assert_allclose(weights.sum(axis=-1), 1.0)
    np.testing.assert_allclose(weights @ (2 * taps**2 - taps + 3), 2 * position**2 - position + 3)


def test_a_response_to_the_flow_is_its_matrix_times_the_phase_of_every_step():
    rng = np.random.default_rng(7)
    layer = FrozenLayer(
        Layer(fraction=0.5, speed_m_s=12.0, direction_deg=35.0),
        points_m=rng.uniform(-2.0, 2.0, (200, 2)),
        pitch_m=PITCH_M,
        turbulence=TURBULENCE,
        rng=rng,
    )
    always, sometimes = (
        PhaseResponse(rng.standard_normal((30, 200), dtype=np.float32)) for _ in range(2)
    )
    # Steps are asked for with an overlap, and beyond what is computed at a time.
    for first in range(0, 2000, 190):
        step = np.arange(first, first + 200)
        layer.reach(first, first + 199)
        phases = phases_at(layer, step)
        for response in (always, sometimes) if first % 3 else (always,):
            seen = layer.responses(first, response)[:200]
            expected = phases @ response.matrix.T
            np.testing.assert_allclose(seen, expected, atol=1e-5 * expected.std())


def test_frames_between_steps_are_the_same_whichever_is_read():
    rng = np.random.default_rng(8)
    layer = FrozenLayer(
        Layer(fraction=1.0, speed_m_s=12.0, direction_deg=35.0),
        points_m=rng.uniform(-2.0, 2.0, (200, 2)),
        pitch_m=PITCH_M,
        turbulence=TURBULENCE,
        rng=rng,
    )
    layer.reach(0, 19)
    taps = rng.integers(1, 17, 30)[:, None] + np.arange(-1, 3)
    weights = rng.standard_normal((30, 4)).astype(np.float32)
    many = layer.phases(taps, weights)
    few = np.concatenate(
        [layer.phases(taps[k : k + 2], weights[k : k + 2]) for k in range(0, 30, 2)]
    )
    np.testing.assert_allclose(few, many, atol=1e-6 * many.std())


def test_shares_of_the_layers_are_normalised():
    points = np.random.default_rng(5).uniform(-2.0, 2.0, (50, 2))
    layers = tuple(
        Layer(fraction=2.0, speed_m_s=10.0, direction_deg=angle) for angle in (0.0, 90.0)
    )

    def phases(chosen):
        layers = build_layers(
            chosen,
            points_m=points,
            pitch_m=PITCH_M,
            turbulence=TURBULENCE,
            rng=np.random.default_rng(6),
        )
        return steps(layers[0], 5)

    np.testing.assert_allclose(
        phases(layers), phases(layers[:1]) * np.sqrt(0.5), rtol=1e-5, atol=1e-12
    )


@pytest.mark.parametrize(
    "layers",
    [
        (),
        (Layer(fraction=0.0, speed_m_s=10.0, direction_deg=0.0),),
        (Layer(fraction=1.0, speed_m_s=0.0, direction_deg=0.0),),
    ],
)
def test_impossible_layers_are_refused(layers):
    with pytest.raises(ModelError, match="expected shares > 0 and speeds > 0"):
        build_layers(
            layers,
            points_m=np.zeros((1, 2)),
            pitch_m=PITCH_M,
            turbulence=TURBULENCE,
            rng=np.random.default_rng(1),
        )
