"""Closed-loop poles."""

from __future__ import annotations

import numpy as np
import pytest

from service.control.loop import pole_radius
from tests.support.loop import integrator_limit


def test_an_integrator_of_two_frames_loses_stability_at_a_gain_of_one():
    """z² - z + g: |z|² = g once the poles are complex, so g = 1 is the edge."""
    assert pole_radius(np.array([1.0]))[0] == pytest.approx(1.0)
    assert pole_radius(np.array([0.5]))[0] == pytest.approx(np.sqrt(0.5))
    assert integrator_limit(np.array([0.0]))[0] == pytest.approx(1.0)


def test_an_integrator_of_one_frame_loses_stability_at_a_gain_of_two():
    """z - 1 + g."""
    found = pole_radius(np.array([0.5, 1.0, 2.0]), delay_frames=1.0)
    np.testing.assert_allclose(found, [0.5, 0.0, 1.0], atol=1e-12)


def test_a_mode_without_gain_keeps_what_the_leak_keeps():
    assert pole_radius(np.array([0.0]), leak=0.99)[0] == pytest.approx(0.99)


def test_an_eigenvalue_of_the_wrong_sign_diverges_at_any_gain():
    assert np.all(pole_radius(np.array([-0.01, -0.5])) > 1.0)
    assert integrator_limit(np.array([np.pi]))[0] < 0


def test_a_leak_gives_margin_to_a_slow_mode_whose_eigenvalue_is_turned():
    """A small λ sits near z = 1, where the leak pulls; at |λ| = 1 the product of the poles is λ."""
    turned = np.array([0.05 * np.exp(1.5j)])
    assert pole_radius(turned)[0] > 1.0
    assert pole_radius(turned, leak=0.95)[0] < 1.0
    assert pole_radius(np.array([1.0]), leak=0.9)[0] == pytest.approx(1.0)


def test_the_shape_of_the_eigenvalues_is_kept():
    assert pole_radius(np.zeros((3, 5))).shape == (3, 5)
    assert pole_radius(np.float64(0.5)).shape == ()
