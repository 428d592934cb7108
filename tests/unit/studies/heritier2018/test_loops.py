from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.loops import (
    RAMP_GAINS,
    GainTuning,
    LoopRun,
    Over,
    statistics,
    strehl,
    wavefront_error_nm,
)
from pyrcal_studies.heritier2018.reconstructors import ModelReconstructor
from pyrcal_studies.heritier2018.store import Record, Store, Task, in_order
from pyrcal_studies.heritier2018.telescope import Occasion
from service.model.misregistration import Misregistration

NIGHT = Occasion(daytime=False, seed=1, imperfections="ideal", magnitude=5.0, seeing_arcsec=0.3)
"""Calm enough for 30 modes."""

pytestmark = pytest.mark.usefixtures("small_telescope")


def closed(tmp_path: Path, alpha: Misregistration) -> Record:
    task = LoopRun(
        occasion=NIGHT,
        alpha=alpha,
        reconstructor=ModelReconstructor(occasion=NIGHT, alpha=Misregistration(), n_modes=30),
        gain=0.6,
        n_frames=50,
    )
    return done(tmp_path, task)


def done(tmp_path: Path, task: Task) -> Record:
    store = Store(tmp_path)
    for step in in_order((task,)):
        store.write(step, step.compute(store))
    return store.read(task)


def test_a_registered_loop_leaves_a_fraction_of_the_modes_it_controls(tmp_path: Path) -> None:
    record = closed(tmp_path, Misregistration())
    assert record["modal_nm2"][:30].sum() < 0.1 * record["incoming_nm2"][:30].sum()
    assert record["modal_nm2"][30:] == pytest.approx(record["incoming_nm2"][30:], rel=0.3)
    assert 0.0 < strehl(record["image"]) < 1.0


def test_a_quarter_turn_of_the_mirror_is_worse_than_no_loop(tmp_path: Path) -> None:
    record = closed(tmp_path, Misregistration(rotation_rad=np.pi / 2))
    assert record["total_nm2"] > record["incoming_nm2"].sum()


def test_a_residual_is_taken_over_what_is_asked_for() -> None:
    modal = np.zeros(60)
    modal[[0, 10, 55]] = 16.0, 9.0, 25.0
    record = {
        "modal_nm2": modal,
        "total_nm2": np.array(modal.sum() + 144.0),
        "mirror_nm2": np.full(60, 4.0),
        "n_controlled": np.array(58),
    }
    assert wavefront_error_nm(record) == pytest.approx(np.sqrt(194.0))
    assert wavefront_error_nm(record, without_first=2) == pytest.approx(np.sqrt(178.0))
    assert wavefront_error_nm(record, over=Over.CONTROLLED) == pytest.approx(np.sqrt(50.0))
    shown = wavefront_error_nm(record, without_first=50, over=Over.MIRROR)
    assert shown == pytest.approx(np.sqrt(8 * 4.0))


def played_by_day(tmp_path: Path, *, vibrations: bool = False) -> Record:
    day = replace(NIGHT, daytime=True, vibrations=vibrations)
    model = ModelReconstructor(occasion=day, alpha=Misregistration(), n_modes=30)
    task = LoopRun(
        occasion=day,
        alpha=Misregistration(),
        reconstructor=model,
        gain=0.6,
        n_frames=50,
    )
    return done(tmp_path, task)


def test_in_a_still_dome_the_mirrors_positions_are_the_residual(tmp_path: Path) -> None:
    still = played_by_day(tmp_path)
    true, shown = (wavefront_error_nm(still, over=o) for o in (Over.CONTROLLED, Over.MIRROR))
    # one value is of every frame, the other of each tenth
    assert shown == pytest.approx(true, rel=0.15)


def test_the_mirrors_positions_hold_the_correction_of_vibrations(tmp_path: Path) -> None:
    """So tip and tilt seem large where they are small: the paper's section 5."""
    still, shaken = (played_by_day(tmp_path, vibrations=word) for word in (False, True))
    low = [float(np.sqrt(record["mirror_nm2"][:2].sum())) for record in (still, shaken)]
    # 60 nm of tip and 40 nm of tilt
    assert low[1] > low[0] + 30.0
    assert low[1] > 1.5 * np.sqrt(shaken["modal_nm2"][:2].sum())
    added = shaken["mirror_nm2"][:30] - still["mirror_nm2"][:30]
    assert added[5:].sum() < 0.1 * added[:2].sum()


def test_a_matrix_made_by_day_closes_the_same_loop_by_night(tmp_path: Path) -> None:
    """Its light met the mirror twice, so it would give half of every command."""
    day, night = (
        ModelReconstructor(
            occasion=replace(NIGHT, daytime=by_day), alpha=Misregistration(), n_modes=30
        )
        for by_day in (True, False)
    )
    one, other = (
        done(
            tmp_path,
            LoopRun(
                occasion=NIGHT, alpha=Misregistration(), reconstructor=model, gain=0.6, n_frames=50
            ),
        )
        for model in (day, night)
    )
    assert one["total_nm2"] == pytest.approx(other["total_nm2"], rel=1e-3)


def test_the_ramp_finds_gains_for_every_group_of_modes(tmp_path: Path) -> None:
    model = ModelReconstructor(occasion=NIGHT, alpha=Misregistration(), n_modes=30)
    ramp = GainTuning(
        occasion=NIGHT, alpha=Misregistration(), reconstructor=model, frames_per_gain=20
    )
    assert ramp.request(400).groups == ((0, 1), (2, 99), (100, 399))
    assert ramp.request(30).groups == ((0, 1), (2, 29))
    found = done(tmp_path, ramp)
    assert found["gains"].shape == (30,)
    assert set(found["gains"]) <= set(RAMP_GAINS)
    for group in (0, 1):
        tried = found["group"] == group
        best = found["gain"][tried][np.argmin(found["residual_nm"][tried])]
        assert found["by_group"][group] == best


def test_gains_tuned_on_one_reconstructor_serve_another(tmp_path: Path) -> None:
    """As the paper uses the gains of the measured matrix for the synthetic one."""
    model = ModelReconstructor(occasion=NIGHT, alpha=Misregistration(), n_modes=30)
    ramp = GainTuning(
        occasion=NIGHT, alpha=Misregistration(), reconstructor=model, frames_per_gain=10
    )
    more = LoopRun(
        occasion=NIGHT,
        alpha=Misregistration(),
        reconstructor=replace(model, n_modes=40),
        gain=ramp,
        n_frames=20,
    )
    assert ramp in more.needs
    assert int(done(tmp_path, more)["n_controlled"]) == 40


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
