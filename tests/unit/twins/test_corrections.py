"""What ``pyrcal twin`` corrects of what the files of a bench say."""

import numpy as np
import pytest

import pyrcal
from pyrcal.twins.report import list_values
from service.instrument import load_instrument
from service.instrument.paths import TWIN_LIVE_FILE
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import analytic_basis
from service.model.pupil import rtc_valid_subapertures

TRUE = (0.1, -0.05, 0.5, 1.01)
"""Registration of the bench: subapertures, degrees, ratio."""


def test_a_hole_of_the_pupil_and_an_unknown_modulation_are_in_the_twin(tmp_path):
    """A hole of 0.1 of the diameter darkens no subaperture, so that the mask does not show it."""
    bench = load_instrument("tests/system/small.toml")
    basis, n = analytic_basis(bench), bench.wfs.n_subapertures
    model = RtcInteractionModel(bench, basis, pupil_sampling=4, detector_nodes=4)
    alpha = Misregistration.from_vector(np.array(TRUE) / BOUNDARY_SCALE)
    matrix = model.interaction_matrix(alpha)[:, :40]
    noise = np.random.default_rng(1).standard_normal(matrix.shape)
    noise *= 0.03 * np.linalg.norm(matrix, axis=0) / np.sqrt(len(matrix))
    side = 6 * n
    along = ((np.arange(side) + 0.5) / side - 0.5) * n
    y, x = np.meshgrid(along, along, indexing="ij")
    shapes = basis.render(np.column_stack([x.ravel(), y.ravel()]))[:, :40]
    folder = tmp_path / "bench"
    folder.mkdir()
    np.save(folder / "interaction_matrix.npy", matrix + noise)
    np.save(folder / "valid.npy", rtc_valid_subapertures(bench))
    np.save(folder / "influence_functions.npy", shapes.T.reshape(-1, side, side))

    made = pyrcal.twin(
        folder,
        tmp_path / "twin",
        diameter_m=bench.diameter_m,
        wavelength_m=bench.wfs.wavelength_m,
        stop=str(bench.stop),
        unit="m",
        threads=1,
    )
    assert made.before is not None
    assert made.residual < 0.7 * made.before.fit.residual_fraction
    error = made.report.fit.alpha.vector * BOUNDARY_SCALE - TRUE
    assert np.all(np.abs(error) < 3.0 * made.report.fit.sigma * BOUNDARY_SCALE)
    values = {one.name: one for one in list_values(made)}
    origin = "measured: it explains the matrix better; the files say 0.0"
    assert values["instrument.obscuration_ratio"].origin == origin
    assert values["instrument.diameter_m"].origin == "stated"
    # 3 m over 12 subapertures
    assert values["shift_x_mm"].value == pytest.approx(250.0 * values["shift_x_subap"].value)
    assert values["shift_x_mm"].sigma == pytest.approx(250.0 * values["shift_x_subap"].sigma)
    live = load_instrument(made.folder / TWIN_LIVE_FILE)
    assert live.obscuration_ratio == pytest.approx(bench.obscuration_ratio, abs=0.01)
    assert live.wfs.modulation_lambda_over_d == pytest.approx(3.0, rel=0.02)
