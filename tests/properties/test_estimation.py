"""Laws of the estimators for any numbers."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from service.estimation import kalman, lockin
from service.estimation.health import LoopHealth, observe
from tests.support.numerics import block_of, part, sines

PLAN = lockin.LockInPlan(
    modes=(1,),
    frequencies_hz=(100.0,),
    amplitude_m=(5e-9,),
    frame_rate_hz=1000.0,
    n_frames=100,
    first_seq=13,
)


def telemetry(n_frames: int = 250):
    rng = np.random.default_rng(5)
    dither = sines(PLAN, n_frames, 3)
    return block_of(rng.normal(size=(n_frames, 4)), dither, dither)


@settings(deadline=None)
@given(st.lists(st.integers(0, 250), max_size=12).map(lambda cuts: sorted({0, 250, *cuts})))
def test_no_split_into_blocks_changes_what_the_lock_in_sums(cuts):
    """1e-4: float32 sums in another order."""
    block = telemetry()
    _, whole = lockin.LockIn(plan=PLAN).accumulate(block)
    state, pieces = lockin.LockIn(plan=PLAN), []
    for start, stop in pairwise(cuts):
        state, ended = state.accumulate(part(block, start, stop))
        pieces += ended
    assert len(pieces) == len(whole) == 2
    for one, other in zip(whole, pieces, strict=True):
        assert one.first_seq == other.first_seq
        np.testing.assert_allclose(one.slopes, other.slopes, atol=1e-4)


@settings(deadline=None)
@given(st.integers(14, 110), st.integers(1, 60))
def test_every_gap_ends_in_one_verdict_for_each_window_that_began_before_it(start, length):
    """Up to 5 % of a window is taken, more is refused; either way the next window comes."""
    block = telemetry(500)
    state, _ = lockin.LockIn(plan=PLAN).accumulate(part(block, 0, start))
    _, ended = state.accumulate(part(block, start + length, 500))
    lost = min(start + length, 113) - start
    first = ended[0]
    assert isinstance(first, lockin.Spectra if lost <= 5 else lockin.WindowRefused)
    assert all(isinstance(window, lockin.Spectra) for window in ended[1:])


vectors = st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).map(np.array)


def covariance(seed: int, scale: float) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(4, 4))
    return scale**2 * (root @ root.T + 0.1 * np.eye(4))


covariances = st.builds(covariance, st.integers(0, 2**32 - 1), st.floats(1e-4, 1e2))


@given(vectors, covariances, st.lists(st.tuples(vectors, covariances), min_size=1, max_size=8))
def test_the_filters_covariance_stays_symmetric_and_positive(mean, prior, measurements):
    """Joseph's form, whatever arrives, dithered and passive in turn; 1e-9 of its largest axis is
    rounding."""
    drift = kalman.Drift(alpha_rate=np.full(4, 1e-3))
    found = kalman.forget(kalman.begin_joint(mean, prior))
    for measured, noise in measurements:
        found = kalman.predict_state(found, drift, 1.0)
        found = kalman.correct_state(
            kalman.correct_state(found, measured, noise), measured, noise, passive=True
        )
    np.testing.assert_array_equal(found.covariance, found.covariance.T)
    power = np.linalg.eigvalsh(found.covariance)
    assert power[0] > -1e-9 * power[-1]


@given(vectors, covariances, vectors, covariances)
def test_a_measurement_never_adds_uncertainty(mean, prior, measured, noise):
    begun = kalman.begin_joint(mean, prior)
    found = kalman.correct_state(begun, measured, noise).alpha_covariance
    slack = 1e-9 * np.trace(prior + noise)
    assert np.linalg.eigvalsh(prior - found)[0] > -slack
    assert np.linalg.eigvalsh(noise - found)[0] > -slack


@given(vectors, covariances, vectors, covariances)
def test_the_innovation_does_not_depend_on_the_units(mean, prior, measured, noise):
    units = np.diag([100.0, 0.01, 57.3, 3.0])
    plain = kalman.begin_joint(mean, prior)
    scaled = kalman.begin_joint(units @ mean, units @ prior @ units)
    there, noisier = units @ measured, units @ noise @ units
    np.testing.assert_allclose(
        kalman.innovation(scaled, there, noisier),
        kalman.innovation(plain, measured, noise),
        rtol=1e-6,
        atol=1e-12,
    )
    np.testing.assert_allclose(
        kalman.correct_state(scaled, there, noisier).alpha,
        units @ kalman.correct_state(plain, measured, noise).alpha,
        rtol=1e-5,
        atol=1e-6,
    )


@given(st.lists(st.floats(0.0, 50.0), min_size=1, max_size=30))
def test_the_health_ratio_stays_between_the_extremes_it_has_seen(factors):
    health = LoopHealth()
    for factor in factors:
        commands = np.full((10, 4), factor)
        health = observe(
            health, block_of(np.zeros((10, 2)), commands, None), np.ones(4), np.arange(4)
        )
        assert 0.0 <= health.ratio <= max(factors) * (1 + 1e-5)
