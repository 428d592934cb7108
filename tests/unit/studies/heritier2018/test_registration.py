from __future__ import annotations

import numpy as np
import pytest

from pyrcal_studies.heritier2018.plan import FULL, TRUTH, capture_fits, joint_fit
from pyrcal_studies.heritier2018.registration import errors, fitted_alpha, is_right, random_starts
from service.model.kinds import Method
from service.model.misregistration import BOUNDARY_SCALE, Misregistration


def found(alpha: Misregistration) -> dict[str, np.ndarray]:
    return {"alpha": alpha.vector * BOUNDARY_SCALE}


def test_errors_are_in_per_cent_degrees_and_per_cent() -> None:
    step = np.array([0.01, -0.02, np.deg2rad(0.1), 0.001])
    off = errors(found(Misregistration.from_vector(TRUTH.vector + step)), TRUTH)
    assert off == pytest.approx([1.0, -2.0, 0.1, 0.1])


def test_a_fit_is_right_only_when_every_parameter_is() -> None:
    assert is_right(found(TRUTH), TRUTH)
    for axis, step in enumerate((0.06, -0.06, np.deg2rad(0.4), 0.006)):
        moved = TRUTH.vector
        moved[axis] += step
        assert not is_right(found(Misregistration.from_vector(moved)), TRUTH)
    assert not is_right({"alpha": np.full(4, np.nan)}, TRUTH)


def test_a_kept_fit_gives_back_its_registration() -> None:
    assert fitted_alpha(found(TRUTH)).vector == pytest.approx(TRUTH.vector)


def test_starts_are_corners_of_the_papers_rough_estimate() -> None:
    starts = random_starts(TRUTH, 2.0, 50, np.random.default_rng(1))
    off = np.array([start.vector - TRUTH.vector for start in starts])
    corner = 2.0 * np.array([1.0, 1.0, np.deg2rad(2.0), 0.02])
    np.testing.assert_allclose(np.abs(off), np.tile(corner, (50, 1)))
    assert len(np.unique(np.sign(off), axis=0)) == 16


def test_both_methods_begin_at_the_same_starts_and_with_the_same_matrix() -> None:
    joint, scans = (capture_fits(FULL, method) for method in (Method.JOINT, Method.PAPER))
    for distance, fits in joint.items():
        assert [fit.start for fit in fits] == [fit.start for fit in scans[distance]]
        assert {fit.source for fit in (*fits, *scans[distance])} == {joint_fit(FULL, 1).source}
