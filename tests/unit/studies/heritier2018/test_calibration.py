from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.calibration import STROKE_M, Measurement
from pyrcal_studies.heritier2018.reconstructors import MeasuredReconstructor, synthetic_matrix
from pyrcal_studies.heritier2018.store import Store, in_order
from pyrcal_studies.heritier2018.telescope import Occasion
from service.model.misregistration import Misregistration

ALPHA = Misregistration(shift_x_subap=0.2, rotation_rad=0.01, magnification=0.99)
DAY = Occasion(daytime=True, seed=3, imperfections="ideal", vibrations=True, magnitude=2.0)
MEASUREMENT = Measurement(occasion=DAY, alpha=ALPHA, n_modes=10, n_average=2)

pytestmark = pytest.mark.usefixtures("small_telescope")


def measured(tmp_path: Path, measurement: Measurement) -> NDArray[np.float64]:
    store = Store(tmp_path)
    for part in measurement.parts:
        store.write(part, part.compute(store))
    return measurement.reference(store).matrix


def noise_free() -> NDArray[np.float64]:
    """What the telescope answers to the same strokes in endless light and a still dome."""
    seen = telescope.optics(DAY, ALPHA)
    rng = np.random.default_rng(0)
    columns = []
    for mode in range(MEASUREMENT.n_modes):
        stroke = STROKE_M * seen.opd_per_command[:, mode]
        push, pull = (seen.slopes(sign * stroke, None, rng) for sign in (1, -1))
        columns.append((push - pull) / (2 * STROKE_M))
    return np.array(columns, dtype=np.float64).T


def test_a_bright_fibre_in_a_still_dome_measures_what_the_telescope_answers(
    tmp_path: Path,
) -> None:
    truth = noise_free()
    matrix = measured(tmp_path, replace(MEASUREMENT, occasion=replace(DAY.still, magnitude=-5.0)))
    assert np.linalg.norm(matrix - truth) < 1e-3 * np.linalg.norm(truth)


def test_a_shaking_dome_costs_less_the_more_often_it_is_averaged(tmp_path: Path) -> None:
    truth = noise_free()
    few, many = (
        np.linalg.norm(measured(tmp_path / str(n), replace(MEASUREMENT, n_average=n)) - truth)
        for n in (2, 10)
    )
    assert many < 0.8 * few


def test_by_day_slopes_are_twice_the_models_at_the_true_registration(tmp_path: Path) -> None:
    matrix = measured(tmp_path, MEASUREMENT)
    there, elsewhere = (synthetic_matrix(a)[:, :10] for a in (ALPHA, Misregistration()))
    gains = (matrix * there).sum(axis=0) / (there**2).sum(axis=0)
    # the mirror's influence functions are not the model's: some per cent
    assert gains == pytest.approx(np.full(10, 2.0), rel=0.1)
    left, left_elsewhere = (
        np.linalg.norm(matrix - 2.0 * one, axis=0).max() for one in (there, elsewhere)
    )
    assert left < left_elsewhere


def test_a_fainter_fibre_measures_a_noisier_matrix(tmp_path: Path) -> None:
    truth = noise_free()
    bright, faint = (
        np.linalg.norm(measured(tmp_path / str(m), replace(MEASUREMENT, occasion=day)) - truth)
        for m, day in ((2, DAY), (9, replace(DAY, magnitude=9.0)))
    )
    assert faint > 2 * bright


def test_the_inverse_of_a_measured_matrix_undoes_it(tmp_path: Path) -> None:
    store = Store(tmp_path)
    task = MeasuredReconstructor(measurement=MEASUREMENT)
    for step in in_order((task,)):
        store.write(step, step.compute(store))
    undone = store.read(task)["matrix"] @ MEASUREMENT.matrix(store)
    assert undone == pytest.approx(np.eye(10), abs=1e-3)


def test_the_parts_cover_every_mode_once() -> None:
    parts = replace(MEASUREMENT, n_modes=123).parts
    covered = [m for part in parts for m in range(part.first_mode, part.first_mode + part.n_modes)]
    assert covered == list(range(123))
    assert sum(part.n_frames for part in parts) == 123 * (2 * 2 + 2)
