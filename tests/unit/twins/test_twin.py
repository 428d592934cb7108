"""``pyrcal twin`` on the files of a simulated bench whose registration is known."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import scipy

import pyrcal
from service.errors import ConfigurationError, MatrixError
from service.instrument import instrument_path, load_instrument

DATA = Path(os.environ.get("PYRCAL_BENCH_DATA", "../shared/data"))
DUMP = DATA / "failing" / "whole_detector.npz"
pytestmark = pytest.mark.skipif(not DUMP.is_file(), reason="needs the data of a simulated bench")

TRUE = (0.0, -1.333, 0.0, 1.12)
"""Registration of the bench: subapertures, degrees, ratio."""

QUICK = {"diameter_m": 0.6, "unit": "m", "wavelength_m": 640e-9, "modulation": 0.0}
"""With these the fit has little to find."""


@pytest.fixture
def bench(tmp_path):
    """Return a folder with the bench's arrays as NumPy and MATLAB files."""
    folder = tmp_path / "bench"
    folder.mkdir()
    with np.load(DUMP) as dump:
        np.save(folder / "int_mat.npy", dump["calib.D"])
        np.save(folder / "pupil.npy", dump["tel.pupil"])
        for name, values in (("M2C", dump["M2C"]), ("influence_functions", dump["dm.modes"])):
            scipy.io.savemat(folder / f"{name}.mat", {name: values})
    return folder


def test_the_files_of_a_bench_become_its_twin(bench, tmp_path):
    made = pyrcal.twin(bench, tmp_path / "twin", diameter_m=0.6, unit="m")
    fit, values = made.report.fit, json.loads((made.folder / "twin.json").read_text("utf-8"))
    found = np.array(list(fit.alpha.to_boundary().values()))
    sigma = np.array([values["fit"]["sigma"][name] for name in fit.alpha.to_boundary()])
    assert np.all(np.abs(found - TRUE) < 3.0 * sigma)
    # OOPAO's own grid is found from the points of its influence functions.
    assert fit.residual_fraction < 0.015
    by_name = {one["name"]: one for one in values["values"]}
    assert by_name["modulation_lambda_over_d"]["origin"].startswith("measured")
    assert float(by_name["modulation_lambda_over_d"]["value"]) == 0.0
    assert by_name["instrument.diameter_m"]["origin"] == "told"
    assert float(by_name["wavelength_m"]["value"]) == pytest.approx(640e-9, rel=0.01)
    assert by_name["stroke"]["value"] == pytest.approx(1.0, abs=0.02)
    assert (made.folder / "twin.html").stat().st_size > 1e4
    assert [one.path.name for one in made.exported] == ["oopao_model.py", "specula_model.yml"]
    assert all(one.path.is_file() for one in made.exported)


def test_service_and_fit_take_the_folder_of_a_twin(bench, tmp_path):
    made = pyrcal.twin(bench, tmp_path / "twin", **QUICK)
    assert instrument_path(made.folder) == made.folder / "instrument.toml"
    # The service's RTC sends slopes, and the arrays are found where the folder is moved to.
    moved = shutil.move(made.folder, tmp_path / "moved")
    assert load_instrument(f"{moved}/live.toml").frames is None
    assert load_instrument(moved).frames is not None
    # An earlier twin is replaced, other files are not.
    pyrcal.twin(bench, moved, **QUICK)
    with pytest.raises(ConfigurationError, match="other files"):
        pyrcal.twin(bench, bench, diameter_m=0.6, unit="m")


@pytest.mark.parametrize(
    ("name", "shape", "named"),
    [
        ("M2C", (241, 30), "(241, 30)"),
        ("M2C", (97, 60), "--modes"),
        ("valid_pixel", (240, 240), "(240, 240)"),
        ("pupil", (72, 71), "(72, 71)"),
    ],
)
def test_files_that_do_not_belong_together_are_named(bench, tmp_path, name, shape, named):
    for one in bench.glob(f"{name}.*"):
        one.unlink()
    rng = np.random.default_rng(1)
    values = rng.random(shape) if name == "M2C" else np.ones(shape, bool)
    np.save(bench / f"{name}.npy", values)
    with pytest.raises((ConfigurationError, MatrixError)) as refusal:
        pyrcal.twin(bench, tmp_path / "twin", diameter_m=0.6, unit="m")
    assert named in str(refusal.value)
    assert name in str(refusal.value) or named == "--modes"
    assert [one.name for one in tmp_path.iterdir()] == ["bench"]
