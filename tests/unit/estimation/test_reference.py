"""Which columns of a measured matrix count, and how much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.estimation.reference import Reference, target_of
from service.model.instrument import Instrument
from service.model.kinds import BasisKind
from service.model.pupil import valid_subapertures
from tests.support.bench import instrument


def weights(about: Instrument, scale: list[float]) -> list[float]:
    """Return the weights of columns of random slopes with these sizes."""
    n_slopes = 2 * int(valid_subapertures(about).sum())
    columns = np.random.default_rng(1).choice([-1.0, 1.0], (n_slopes, len(scale)))
    target = target_of(Reference(matrix=columns * np.array(scale)), about)
    return list(target.weights / target.weights.max())


def by_actuator(about: Instrument) -> Instrument:
    return replace(about, mirror=replace(about.analytic_mirror, basis=BasisKind.ZONAL))


def test_actuators_that_are_hardly_seen_do_not_count_as_much_as_others():
    found = weights(by_actuator(instrument(None)), [1.0, 1.0, 1.0, 2.0, 0.1])
    assert np.allclose(found, [1.0, 1.0, 1.0, 0.25, 1.0])


def test_modes_count_by_the_share_that_is_left_over():
    found = weights(instrument(None), [1.0, 1.0, 1.0, 2.0, 0.1])
    assert np.allclose(found, [0.01, 0.01, 0.01, 0.0025, 1.0])
