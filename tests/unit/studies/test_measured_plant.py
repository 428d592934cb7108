"""The service on a plant whose matrix its model explains in part: simulated nights, defaults."""

from functools import cache

import numpy as np

from pyrcal_studies.campaign.measured_plant import (
    N_FIRST,
    Night,
    Plan,
    best_nm,
    came_of,
    fitted_alpha,
    late_nm,
    models_of,
    response_of,
    stable_modes,
)

ERROR = 0.3
"""RMS error of the model per mode, over the norm of its column."""


@cache
def played(mode="auto", seconds=40.0):
    plan = Plan(error=ERROR, mode=mode, seconds=seconds, seed=2)
    response = response_of(plan)
    night = Night(plan, response)
    night.pass_(seconds)
    return night, came_of(plan, night, response, fitted_alpha(plan, response))


def twisted(change, seconds=40.0):
    plan = Plan(error=ERROR, seconds=seconds, seed=2)
    response = response_of(plan).copy()
    change(response)
    night = Night(plan, response)
    night.pass_(seconds)
    return night


def test_the_plant_is_as_wrong_as_it_should_be():
    """The RMS of what is left over the columns' norms is the error asked for, less what α takes."""
    plan = Plan(error=ERROR, seed=2)
    response = response_of(plan)
    assert stable_modes(plan, response, fitted_alpha(plan, response)) == response.shape[1]
    night, _ = played()
    misfit = night.state.matrices.mode_proof.own_misfit_ratio
    assert 0.6 * ERROR < misfit < 1.1 * ERROR


def test_alpha_is_that_of_the_measured_matrix_within_its_sigma():
    _, row = played()
    assert np.abs(row["off_sigma"]).max() < 3.0
    # a σ that is ten times too large would pass the line above
    assert np.abs(row["off_sigma"]).max() > 0.3
    # the fit of the matrix itself is wrong by as much: both believe the same modes
    assert np.abs(row["error_sigma"]).max() < 3.0


def test_the_first_matrix_comes_soon_and_in_the_end_all_modes_are_controlled():
    _, row = played()
    assert row["first_s"] < 30.0
    assert row["n_modes"] == row["n_stable"] == 40
    assert row["closed"]


def test_the_wavefront_error_is_near_that_of_the_measured_matrix():
    _, row = played()
    assert row["late_nm"] < 1.1 * row["best_nm"]
    assert row["late_nm"] < 0.5 * best_nm(Plan(error=ERROR, seed=2), N_FIRST)


def test_nothing_is_the_matter():
    night, row = played()
    assert row["said"] == []
    assert night.state.matrices.hindrance == ""


def test_a_mode_that_is_another_is_never_controlled_where_the_model_is_wrong_too():
    night = twisted(lambda d: d.__setitem__((slice(None), [30, 35]), d[:, [35, 30]]))
    assert night.state.matrices.mode_proof.contrary == {30, 35}
    assert max(swap.n_modes for swap in night.swaps) == 30
    assert "modes-contrary" in {name for name, _ in night.said}
    assert late_nm(night.dome.moments) < 70.0  # 84 nm with the RTC's own 20 modes


def test_a_wrong_mode_in_the_own_matrix_is_named_and_nothing_is_sent():
    night = twisted(lambda d: d.__setitem__((slice(None), 10), -d[:, 10]), seconds=15.0)
    assert not night.swaps
    assert "matrix-mismatch" in {name for name, _ in night.said}
    assert "matrix-mismatch" in night.state.matrices.hindrance


def test_auto_mends_a_loop_that_holds_with_the_nominal_matrix_and_never_opens_it():
    """The mirror is 2.9 deg and a fifth of a subaperture from where the RTC's matrix has it."""
    plan = Plan(error=0.2, seconds=30.0, seed=1)
    response = response_of(plan)
    _, model, _ = models_of(plan.instrument)
    nominal = model.interaction_matrix(model.instrument.start)[:, : plan.n_first]
    night = Night(plan, response, np.linalg.pinv(nominal))
    night.pass_(plan.seconds)
    row = came_of(plan, night, response, fitted_alpha(plan, response))
    assert all(moment.closed for moment in night.dome.moments)
    assert np.abs(row["off_sigma"]).max() < 3.0
    assert row["first_s"] < 30.0
    assert row["n_modes"] == row["n_stable"] == 40
    assert row["said"] == []
