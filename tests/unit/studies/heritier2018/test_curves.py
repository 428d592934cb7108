from __future__ import annotations

import numpy as np
import pytest

from pyrcal_studies.heritier2018.curves import COSTLY_NM, Curve, border_tolerances
from pyrcal_studies.heritier2018.plan import FULL, QUICK, SWEEPS
from pyrcal_studies.heritier2018.reconstructors import Kind

ROTATION, SHIFT, MAGNIFICATION = SWEEPS


def curve(values: tuple[float, ...], errors_nm: tuple[float, ...]) -> Curve:
    return Curve(
        sweep=ROTATION, n_modes=400, kind=Kind.TRUNCATED, values=values, errors_nm=errors_nm
    )


def test_one_degree_moves_the_border_by_a_quarter_subaperture() -> None:
    assert ROTATION.border_subap(1.0) == pytest.approx(0.2618, abs=1e-4)
    assert SHIFT.border_subap(25.0) == 0.25
    assert MAGNIFICATION.border_subap(2.0) == pytest.approx(0.3)


def test_a_sweep_moves_its_own_parameter_alone() -> None:
    assert ROTATION.alpha(0.8).to_boundary()["rotation_deg"] == pytest.approx(0.8)
    assert SHIFT.alpha(40.0).vector == pytest.approx([0.4, 0.0, 0.0, 1.0])
    assert MAGNIFICATION.alpha(2.0).vector == pytest.approx([0.0, 0.0, 0.0, 1.02])
    assert SHIFT.step(-50.0) == (-0.5, 0.0, 0.0, 0.0)
    assert ROTATION.step(2.0) == (0.0, 0.0, 2.0, 0.0)


def test_a_rehearsal_keeps_the_registered_loop_and_the_papers_marked_values() -> None:
    for sweep in SWEEPS:
        assert sweep.at(FULL) == sweep.values
        assert {0.0, *sweep.marked} <= set(sweep.at(QUICK))


def test_the_tolerance_lies_where_the_error_has_grown_by_50_nm_in_quadrature() -> None:
    limit = float(np.hypot(100.0, COSTLY_NM))
    assert curve((0.0, 1.0, 2.0), (100.0, limit, 900.0)).tolerance() == pytest.approx(1.0)
    between = curve((0.0, 1.0, 2.0), (100.0, limit / 2, 2 * limit)).tolerance()
    assert between == pytest.approx(1.5)


def test_a_tolerance_that_is_not_reached_is_none() -> None:
    assert curve((0.0, 1.0), (100.0, 105.0)).tolerance() is None


def test_tolerances_are_compared_at_the_border() -> None:
    found = (curve((0.0, 1.0, 2.0), (100.0, 100.0, 400.0)),)
    value = found[0].tolerance()
    assert value is not None
    assert border_tolerances(found, 400) == {"α_rot": pytest.approx(15 * np.deg2rad(value))}
    assert border_tolerances(found, 594) == {}
