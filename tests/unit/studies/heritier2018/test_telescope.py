from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pyrcal_studies.heritier2018.calibration import Answer
from pyrcal_studies.heritier2018.plan import AROUND, FULL, TRUTH, Variant, around_runs, in_simulator
from pyrcal_studies.heritier2018.reconstructors import synthetic_matrix
from pyrcal_studies.heritier2018.registration import Found, resolved
from pyrcal_studies.heritier2018.store import Store
from pyrcal_studies.heritier2018.telescope import DRAWN, Occasion
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


def test_a_sweep_of_the_measured_matrix_begins_where_the_fit_found_the_mirror(
    tmp_path: Path,
) -> None:
    store = Store(tmp_path)
    run = in_simulator(FULL, 1, Variant.MEASURED)
    assert isinstance(run.alpha, Found)
    assert run.alpha.fit.method is Method.JOINT
    store.write(run.alpha.fit, {"alpha": TRUTH.vector * BOUNDARY_SCALE})
    assert resolved(run.alpha, store).vector == pytest.approx(TRUTH.vector)
    rotation = AROUND[0]
    away, known = around_runs(FULL, rotation, 2.0)
    moved = resolved(away.alpha, store).vector - TRUTH.vector
    assert moved == pytest.approx([0.0, 0.0, np.deg2rad(2.0), 0.0])
    assert away.reconstructor == run.reconstructor
    assert known.alpha == away.alpha
    assert known.reconstructor.label != away.reconstructor.label
    assert around_runs(FULL, rotation, 0.0)[0] == run
    assert run.occasion.imperfections == DRAWN
