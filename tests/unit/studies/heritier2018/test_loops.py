from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from service.model.misregistration import Misregistration
from studies.heritier2018 import telescope
from studies.heritier2018.loops import LoopRun, statistics, wavefront_error_nm
from studies.heritier2018.psf import strehl
from studies.heritier2018.reconstructors import Kind, ModelReconstructor
from studies.heritier2018.store import Record, Store, in_order
from studies.heritier2018.telescope import Occasion

NIGHT = Occasion(daytime=False, seed=1, imperfections="ideal", magnitude=5.0, seeing_arcsec=0.3)
"""Calm enough for 30 modes."""

pytestmark = pytest.mark.usefixtures("small_telescope")


def closed(tmp_path: Path, alpha: Misregistration, kind: Kind = Kind.TRUNCATED) -> Record:
    task = LoopRun(
        occasion=NIGHT,
        alpha=alpha,
        reconstructor=ModelReconstructor(
            occasion=NIGHT, alpha=Misregistration(), n_modes=30, kind=kind
        ),
        gain=0.6,
        n_frames=50,
    )
    store = Store(tmp_path)
    for step in in_order((task,)):
        store.write(step, step.compute(store))
    return store.read(task)


@pytest.mark.parametrize("kind", list(Kind))
def test_a_registered_loop_leaves_a_fraction_of_the_modes_it_controls(
    tmp_path: Path, kind: Kind
) -> None:
    record = closed(tmp_path, Misregistration(), kind)
    assert record["modal_nm2"][:30].sum() < 0.1 * record["incoming_nm2"][:30].sum()
    assert record["modal_nm2"][30:] == pytest.approx(record["incoming_nm2"][30:], rel=0.3)
    assert 0.0 < strehl(record["image"]) < 1.0


def test_a_quarter_turn_of_the_mirror_is_worse_than_no_loop(tmp_path: Path) -> None:
    record = closed(tmp_path, Misregistration(rotation_rad=np.pi / 2))
    assert record["total_nm2"] > record["incoming_total_nm2"]


def test_modal_errors_of_known_modes_are_theirs() -> None:
    plant = telescope.plant(NIGHT)
    seen = telescope.optics(NIGHT, Misregistration())
    residual = np.zeros((2, len(plant.points_m)), dtype=np.float32)
    residual[0] = 30e-9 * seen.opd_per_command[:, 0] + 1e-6
    residual[1] = 40e-9 * seen.opd_per_command[:, 0]
    found = statistics(seen, plant.weights, residual, residual)
    size = np.sqrt(plant.weights @ (seen.opd_per_command[:, 0] ** 2))
    assert found["error_nm"] == pytest.approx([30 * size, 40 * size], rel=1e-3)
    assert found["modal_nm2"][0] == pytest.approx(1250 * size**2, rel=1e-3)
    assert found["modal_nm2"][1:].max() < 1e-3 * found["modal_nm2"][0]
    assert wavefront_error_nm(found, without_first=1) < 1.0
    assert wavefront_error_nm(found) == pytest.approx(size * np.sqrt(1250), rel=1e-3)
