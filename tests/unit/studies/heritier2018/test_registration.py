from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pyrcal_studies.heritier2018.plan import FULL, TRUTH, capture_fits, telescope_sources
from pyrcal_studies.heritier2018.reconstructors import synthetic_matrix
from pyrcal_studies.heritier2018.registration import (
    CriterionMinimum,
    errors,
    fitted_alpha,
    is_right,
    random_starts,
)
from pyrcal_studies.heritier2018.store import Store
from service.estimation.reference import Reference
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


def test_both_methods_begin_at_the_same_starts_and_with_the_same_matrices() -> None:
    joint, scans = (capture_fits(FULL, method) for method in (Method.JOINT, Method.PAPER))
    assert len(telescope_sources(FULL)) == 6
    for distance, fits in joint.items():
        assert [fit.start for fit in fits] == [fit.start for fit in scans[distance]]
        assert [fit.source for fit in fits] == [fit.source for fit in scans[distance]]


SAID = Misregistration(shift_x_subap=0.1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelMatrix:
    """A matrix of the model at a registration a small step away from the one it is said to have."""

    step: tuple[float, float, float, float]
    gain: float
    n_modes: int = 24
    alpha: Misregistration = SAID
    parts: tuple[()] = ()

    def reference(self, store: Store) -> Reference:
        moved = Misregistration.from_vector(self.alpha.vector + np.array(self.step))
        gains = np.linspace(1.0, self.gain, self.n_modes)
        return Reference(matrix=synthetic_matrix(moved)[:, : self.n_modes] * gains)


@pytest.mark.usefixtures("small_telescope")
@pytest.mark.parametrize(("gain", "name"), [(1.0, "alpha"), (0.95, "alpha_gains")])
def test_the_minimum_of_the_criterion_moves_with_the_registration(
    tmp_path: Path, gain: float, name: str
) -> None:
    step = np.array([2e-3, -1e-3, 2e-4, 1e-4])
    found = []
    for sign in (1.0, -1.0):
        source = ModelMatrix(step=tuple(sign * step), gain=gain)
        record = CriterionMinimum(source=source).compute(Store(tmp_path))  # type: ignore[arg-type]
        found.append(fitted_alpha({"alpha": record[name]}).vector)
    # the difference is free of what the two samplings of the pupil differ by
    # and the step of a column with a gain is counted with that gain
    assert (found[0] - found[1]) / 2.0 == pytest.approx(step, rel=0.01 + (1.0 - gain))
