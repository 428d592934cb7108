from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pyrcal_studies.heritier2018.calibration import Answer
from pyrcal_studies.heritier2018.plan import AROUND, FULL, TRUTH, around_run, simulator_pair
from pyrcal_studies.heritier2018.reconstructors import synthetic_matrix
from pyrcal_studies.heritier2018.registration import Found, resolved
from pyrcal_studies.heritier2018.store import Store
from pyrcal_studies.heritier2018.telescope import DRAWN, Occasion, ShakenOccasion
from service.model.kinds import Method
from service.model.misregistration import BOUNDARY_SCALE, Misregistration

NIGHT = Occasion(daytime=False, seed=1, imperfections=DRAWN)


@pytest.mark.usefixtures("small_telescope")
def test_the_simulators_mirror_is_the_models(tmp_path: Path) -> None:
    """As the paper's simulator and its synthetic matrix are one code; the others' are not."""
    alpha = Misregistration(rotation_rad=0.05, magnification=0.95)
    ours = synthetic_matrix(alpha)[:, :30]
    off = {}
    for imperfections in (DRAWN, "ideal"):
        occasion = Occasion(daytime=False, seed=1, imperfections=imperfections)
        task = Answer(occasion=occasion, alpha=alpha, n_modes=30)
        theirs = task.compute(Store(tmp_path))["matrix"]
        off[imperfections] = np.linalg.norm(theirs - ours) / np.linalg.norm(ours)
    # two grids of the pupil, and quadratures of their own: a per cent
    assert off[DRAWN] < 0.012
    assert off["ideal"] > 1.5 * off[DRAWN]


@pytest.mark.usefixtures("small_telescope")
def test_a_telescopes_answer_is_for_one_pass_by_day_too(tmp_path: Path) -> None:
    by_night, by_day = (
        Answer(
            occasion=Occasion(daytime=daytime, seed=1, imperfections="ideal"),
            alpha=Misregistration(),
            n_modes=5,
        ).compute(Store(tmp_path))
        for daytime in (False, True)
    )
    # strokes of 1 nm in light of single precision: a thousandth
    difference = np.linalg.norm(by_day["matrix"] - by_night["matrix"])
    assert difference < 2e-3 * np.linalg.norm(by_night["matrix"])
    assert by_day["singular"] == pytest.approx(by_night["singular"], rel=1e-3)


def test_a_sweep_of_the_measured_matrix_begins_where_table_1s_procedure_found_the_mirror(
    tmp_path: Path,
) -> None:
    store = Store(tmp_path)
    _, run = simulator_pair(FULL, 1)
    assert isinstance(run.alpha, Found)
    assert run.alpha.fit.method is Method.PAPER
    store.write(run.alpha.fit, {"alpha": TRUTH.vector * BOUNDARY_SCALE})
    assert resolved(run.alpha, store).vector == pytest.approx(TRUTH.vector)
    rotation = AROUND[0]
    away = around_run(FULL, rotation, 2.0)
    moved = resolved(away.alpha, store).vector - TRUTH.vector
    assert moved == pytest.approx([0.0, 0.0, np.deg2rad(2.0), 0.0])
    assert away.reconstructor == run.reconstructor
    assert around_run(FULL, rotation, 0.0) == run
    assert run.occasion.imperfections == DRAWN


def test_an_occasion_may_shake_more_or_have_uneven_light() -> None:
    usual, strong = (
        kind(daytime=True, seed=1, vibrations=True, **more).options().vibrations
        for kind, more in ((Occasion, {}), (ShakenOccasion, {"times": 2.5}))
    )
    assert [2.5 * line.rms_m for line in usual] == pytest.approx([one.rms_m for one in strong])
    assert Occasion(daytime=True, seed=1).options().vibrations == ()
    uneven = Occasion(daytime=True, seed=1, imperfections=f"{DRAWN}-uneven-0.3").options()
    assert uneven.imperfections.unevenness == 0.3
    assert uneven.imperfections.position_error == 0.0
