"""Laws of inversion and stability for any numbers."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from service.control.loop import pole_radius
from service.control.reconstructor import invert
from tests.support.loop import integrator_limit

arguments = st.floats(-np.pi, np.pi)
moduli = st.floats(1e-3, 3.0)
leaks = st.floats(0.5, 1.0)


def characteristic(value: complex, leak: float, delay_frames: float) -> np.ndarray:
    """Coefficients of z^(n+1) - leak z^n + λ ((1-f) z + f), highest first, d = n + f."""
    whole = int(delay_frames)
    share = delay_frames - whole
    polynomial = np.zeros(whole + 2, complex)
    polynomial[0] = 1.0
    polynomial[1] = -leak
    polynomial[-2] += value * (1 - share)
    polynomial[-1] += value * share
    return polynomial


@given(moduli, arguments, leaks, st.floats(1.0, 4.0))
def test_the_radius_is_that_of_the_roots_of_the_loops_polynomial(modulus, argument, leak, delay):
    """1e-5: a triple root moves by the cube root of rounding."""
    value = modulus * np.exp(1j * argument)
    roots = np.roots(characteristic(value, leak, delay))
    found = pole_radius(np.array([value]), leak=leak, delay_frames=delay)[0]
    np.testing.assert_allclose(found, np.abs(roots).max(), rtol=1e-5, atol=1e-5)


@given(moduli, arguments)
def test_two_frames_without_leak_obey_the_closed_form(modulus, argument):
    """Stable iff g |λ| < 2 sin((π/2 - |arg λ|) / 3)."""
    limit = integrator_limit(np.array([argument]))[0]
    assume(abs(modulus - limit) > 1e-6)
    radius = pole_radius(np.array([modulus * np.exp(1j * argument)]))[0]
    assert (radius < 1.0) == (modulus < limit)


@given(moduli, arguments, leaks, st.integers(1, 4), st.floats(0.0, 1.0))
def test_a_fractional_delay_joins_its_whole_neighbours_without_a_step(
    modulus, argument, leak, whole, share
):
    """1e-3 of a frame changes no polynomial coefficient by more than 3e-3, hence no radius by
    more than the fifth root of it.
    """
    values = np.array([modulus * np.exp(1j * argument)])
    here, there = (
        pole_radius(values, leak=leak, delay_frames=delay)[0]
        for delay in (whole + share * 0.999, whole + share * 0.999 + 1e-6)
    )
    assert abs(here - there) < 0.1
    for exact in (whole, whole + 1):
        beside = [
            pole_radius(values, leak=leak, delay_frames=exact + step)[0]
            for step in (-1e-12, 0.0, 1e-12)
            if exact + step >= 1.0
        ]
        np.testing.assert_allclose(beside, beside[0], atol=5e-3)


@given(moduli, arguments, leaks)
def test_a_conjugate_eigenvalue_has_the_same_radius(modulus, argument, leak):
    value = modulus * np.exp(1j * argument)
    pair = pole_radius(np.array([value, value.conjugate()]), leak=leak)
    np.testing.assert_allclose(pair[0], pair[1], rtol=1e-6)


def random_matrix(seed: int, n_modes: int, extra_slopes: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n_modes + extra_slopes, n_modes))


matrices = st.builds(
    random_matrix, st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(0, 10)
)


@settings(deadline=None)
@given(matrices, st.floats(1.5, 1e4))
def test_a_truncated_inverse_obeys_the_laws_of_a_pseudo_inverse(matrix, max_condition):
    """R D is a projector of the rank that was kept; R D R = R; R D is symmetric."""
    found = invert(matrix, matrix.shape[1], max_condition=max_condition)
    inverse = found.matrix.astype(float)
    product = inverse @ matrix
    scale = max(1.0, found.condition_number) * 1e-5
    rank = matrix.shape[1] - found.n_truncated
    np.testing.assert_allclose(product, product.T, atol=scale)
    np.testing.assert_allclose(product @ product, product, atol=scale)
    np.testing.assert_allclose(np.trace(product), rank, atol=12 * scale)


@settings(deadline=None)
@given(matrices, st.floats(1.5, 1e4))
def test_no_reconstructor_amplifies_more_than_its_condition_allows(matrix, max_condition):
    largest = np.linalg.norm(matrix, 2)
    found = invert(matrix, matrix.shape[1], max_condition=max_condition)
    assert np.linalg.norm(found.matrix, 2) <= max_condition / largest * (1 + 1e-5)


@settings(deadline=None)
@given(matrices, st.floats(1e-9, 1e9))
def test_the_inverse_of_a_scaled_matrix_is_scaled_the_other_way(matrix, factor):
    plain, scaled = invert(matrix, matrix.shape[1]), invert(factor * matrix, matrix.shape[1])
    assert plain.n_truncated == scaled.n_truncated
    np.testing.assert_allclose(
        scaled.matrix * factor, plain.matrix, atol=1e-5 * np.abs(plain.matrix).max()
    )
