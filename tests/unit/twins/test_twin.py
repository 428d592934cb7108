"""``pyrcal twin`` on the files of simulated benches whose registration is known."""

import argparse
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import scipy

import pyrcal
from pyrcal.importers.oopao import from_saved
from pyrcal.importers.program import import_files
from pyrcal.importers.saved import read_npz
from pyrcal.twins.bench import measure_spot, read_bench
from pyrcal.twins.make import STATED
from pyrcal.twins.sampled import sample_bench
from service.errors import ConfigurationError, MatrixError
from service.files.container import opened
from service.instrument import instrument_path, load_instrument
from service.model.misregistration import BOUNDARY_SCALE
from sim_rtc.assembly import build_telescope
from sim_rtc.options import parse_options
from tests.support.repository import ROOT
from tests.support.twin import find_interpreter

SAMPLE = ROOT / "pyrcal" / "samples" / "data" / "oopao-pyramid.npz"
DATA = Path(os.environ.get("PYRCAL_BENCH_DATA", "../shared/data"))
WHOLE_DETECTOR = DATA / "failing" / "whole_detector.npz"

QUICK = {"diameter_m": 1.8, "unit": "m", "wavelength_m": 640e-9, "modulation": 3.0}
"""With these the fit of the sample has little to find."""


def split(dump, folder, *others):
    """Write the arrays of OOPAO's objects as NumPy and MATLAB files with names of people."""
    folder.mkdir()
    np.save(folder / "IM_KL.npy", dump["calib.D"])
    np.save(folder / "tel_pupil.npy", dump["tel.pupil"])
    for name, values in (("M2C", dump["M2C"]), ("influence_functions", dump["dm.modes"])):
        scipy.io.savemat(folder / f"{name}.mat", {name: values})
    for name, values in others:
        np.save(folder / f"{name}.npy", values)
    return folder


@pytest.fixture
def bench(tmp_path):
    """Return a folder with the files of a bench of 8 x 8 subapertures and its slopes."""
    with np.load(SAMPLE) as dump:
        return split(dump, tmp_path / "bench", ("my_mask", dump["wfs.validI4Q"]))


def values_of(made):
    """Return α, its σ in the units of files, and the values of the report by name."""
    report = json.loads((made.folder / "twin.json").read_text("utf-8"))
    alpha = made.report.fit.alpha.to_boundary()
    sigma = np.array([report["fit"]["sigma"][name] for name in alpha])
    return np.array(list(alpha.values())), sigma, {one["name"]: one for one in report["values"]}


def test_the_files_of_a_bench_become_its_twin(bench, tmp_path):
    (bench / "influence_functions.mat").rename(bench / "IF_dm.mat")
    made = pyrcal.twin(bench, tmp_path / "twin", diameter_m=1.8, unit="m", modulation=5.0)
    found, sigma, values = values_of(made)
    # The influence functions were saved where the mirror is.
    assert np.all(np.abs(found - (0.0, 0.0, 0.0, 1.0)) < 3.0 * sigma)
    assert made.residual < 0.03
    assert values["instrument.diameter_m"]["origin"] == "stated"
    assert values["modulation_lambda_over_d"]["origin"].startswith("measured")
    # OOPAO's modulation of 3 λ/D is 3 n / (n - 1) in a pupil of n = 32 points.
    assert float(values["modulation_lambda_over_d"]["value"]) == pytest.approx(3.1, abs=0.1)
    # A fit with the corrected value is the second one; the report has what was stated.
    assert "the files say 5" in values["modulation_lambda_over_d"]["origin"]
    assert values["wavelength_m"]["origin"].startswith("measured")
    assert (made.folder / "twin.html").stat().st_size > 1e4
    assert [one.path.name for one in made.exported] == ["oopao_model.py", "specula_model.yml"]
    assert all(one.path.is_file() for one in made.exported)
    remark = "The wavelength is unknown: 750 nm is assumed."
    assert not any(remark in one.remarks for one in made.exported)


def test_the_exported_mirror_has_the_actuators_of_given_influence_functions(bench, tmp_path):
    made = pyrcal.twin(bench, tmp_path / "twin", **QUICK)
    with np.load(made.folder / "oopao_model.npz") as arrays, np.load(SAMPLE) as dump:
        functions, modes = arrays["functions"], arrays["mode_to_actuator"]
        n_points, m2c = int(np.sqrt(len(functions))), dump["M2C"]
    assert np.allclose(modes, m2c)
    assert functions.shape == (n_points**2, len(m2c))
    # The combined functions are the shapes of the modes that the model of the fit has.
    sampled = sample_bench(made.instrument, made.report.fit)
    assert sampled.n_points == n_points
    shapes = sampled.basis.render(sampled.points_on_mirror())
    assert np.abs(functions @ modes - shapes).max() < 1e-6 * np.abs(shapes).max()
    with opened(made.folder / "calibration" / "ifunc" / "bench.fits") as container:
        assert container.find("INFLUENCE_FUNCTION").shape[1] == len(m2c)
    assert not any("instead of its actuators" in one for one in made.exported[0].remarks)
    # Without the functions only the shapes of the modes are left.
    assert [one for one in sampled.remarks if "instead of its actuators" in one]


def test_an_assumed_wavelength_is_in_the_remarks_of_the_exported_models(bench, tmp_path):
    # Without the unit of the commands the matrix does not determine the wavelength.
    made = pyrcal.twin(bench, tmp_path / "twin", diameter_m=1.8, modulation=3.0)
    assert "wfs.wavelength_m" in made.instrument.unknown
    for one in made.exported:
        assert "The wavelength is unknown: 750 nm is assumed." in one.remarks
    assert "WAVELENGTH_M = 7.5e-07\n" in (made.folder / "oopao_model.py").read_text("utf-8")


def draw_mean_frame(pupil):
    """Return the frame ``(120, 120)`` of an unmodulated pyramid, its images 52 pixels apart."""
    points = np.arange(240) - 119.5
    fourier = np.exp(-2j * np.pi * np.outer(points, points) / 240)
    focus = fourier @ np.pad(pupil.astype(float), 84) @ fourier
    faces = np.exp(-2j * np.pi * 52 * np.add.outer(np.abs(points), np.abs(points)) / 240)
    light = np.abs(fourier @ (focus * faces) @ fourier) ** 2
    frame = light.reshape(120, 2, 120, 2).sum(axis=(1, 3))
    return frame / frame.sum()


@pytest.mark.skipif(not WHOLE_DETECTOR.is_file(), reason="the matrices are not here")
def test_a_mean_frame_without_modulation_does_not_move_the_images(tmp_path):
    """The light between the images makes them seem 2.7 pixels closer to the middle."""
    with np.load(WHOLE_DETECTOR) as dump:
        light = ("mean_frame", draw_mean_frame(dump["tel.pupil"]))
        whole = split(dump, tmp_path / "whole", light)
    made = pyrcal.twin(whole, tmp_path / "twin", **{**QUICK, "diameter_m": 0.6, "modulation": 0.0})
    found, sigma, _ = values_of(made)
    assert np.all(np.abs(found - (0.0, -1.333, 0.0, 1.12)) < 3.0 * sigma)
    assert made.residual < 0.015
    # The places of the images are right, and the fit has nothing to add to them.
    assert np.abs(made.report.fit.image_offsets_px).max() < 0.03


@pytest.mark.skipif(not WHOLE_DETECTOR.is_file(), reason="the matrices are not here")
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_simulated_bench_without_a_mean_frame_is_fitted_on_its_own_grid(tmp_path, noise):
    with np.load(WHOLE_DETECTOR) as dump:
        measured = dump["calib.D"] * np.float64(1.0)
        rms = np.sqrt(np.mean(measured**2, axis=0))
        measured += noise * rms * np.random.default_rng(3).standard_normal(measured.shape)
        whole = split({**dump, "calib.D": measured}, tmp_path / "whole")
    made = pyrcal.twin(whole, tmp_path / "twin", diameter_m=0.6, unit="m")
    found, sigma, values = values_of(made)
    assert np.all(np.abs(found - (0.0, -1.333, 0.0, 1.12)) < 3.0 * sigma)
    # Four images have most of the signal in a tenth of the pixels, and so less of the noise.
    assert made.residual < 0.015 + 0.5 * noise
    assert float(values["modulation_lambda_over_d"]["value"]) == 0.0
    assert float(values["wavelength_m"]["value"]) == pytest.approx(640e-9, rel=0.01)
    assert values["stroke"]["value"] == pytest.approx(1.0, abs=0.02)
    assert load_instrument(made.folder).frames is not None
    # The service's RTC sends slopes.
    assert load_instrument(made.folder / "live.toml").frames is None


def test_service_and_fit_take_the_folder_of_a_twin(bench, tmp_path):
    made = pyrcal.twin(bench, tmp_path / "twin", **QUICK)
    assert instrument_path(made.folder) == made.folder / "instrument.toml"
    # The arrays are found where the folder is moved to.
    moved = Path(shutil.move(made.folder, tmp_path / "moved"))
    for name in (moved, moved / "live.toml"):
        assert load_instrument(name).wfs.n_subapertures == 8
    simulated = parse_options(["--instrument", str(moved), "--plant", "measured"])
    assert simulated.matrix == moved / "matrix.h5"
    # The mirror of the simulated RTC is where the fit has found it.
    optics = build_telescope(simulated, load_instrument(moved)).optics.start()
    np.testing.assert_allclose(optics.alpha.vector, made.report.fit.alpha.vector, atol=1e-6)
    # An earlier twin is replaced, other files are not.
    pyrcal.twin(bench, moved, **QUICK)
    with pytest.raises(ConfigurationError, match="other files"):
        pyrcal.twin(bench, bench, **QUICK)


def test_a_stated_role_is_preferred_to_that_of_a_name(bench):
    np.save(bench / "interaction_matrix.npy", np.ones((4, 4)))
    options = argparse.Namespace(**{**STATED, **QUICK})
    options.files = [(None, bench), ("matrix", bench / "IM_KL.npy")]
    found = read_bench(options).imported[-1]
    assert found.arrays["interaction_matrix"].shape == (104, 30)
    options.files = [(None, bench)]
    with pytest.raises(MatrixError, match="a second matrix"):
        read_bench(options)


@pytest.mark.parametrize(
    ("name", "shape", "named"),
    [
        ("M2C", (241, 30), "(241, 30)"),
        ("M2C", (68, 60), "--modes"),
        ("my_mask", (10, 10), "(10, 10)"),
        ("tel_pupil", (32, 31), "(32, 31)"),
    ],
)
def test_files_that_do_not_belong_together_are_named(bench, tmp_path, name, shape, named):
    for one in bench.glob(f"{name}.*"):
        one.unlink()
    rng = np.random.default_rng(1)
    values = rng.random(shape) if name == "M2C" else np.ones(shape, bool)
    np.save(bench / f"{name}.npy", values)
    with pytest.raises((ConfigurationError, MatrixError)) as refusal:
        pyrcal.twin(bench, tmp_path / "twin", **QUICK)
    assert named in str(refusal.value)
    assert name in str(refusal.value) or named == "--modes"
    assert [one.name for one in tmp_path.iterdir()] == ["bench"]


def test_the_axes_of_the_path_of_a_spot_are_seen_in_its_picture():
    """Semi-axes of 50 and 40 pixels, the longer one at 30 deg; a spot of 3 pixels on its path."""
    angles = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)
    path = np.exp(1j * np.pi / 6.0) * (50.0 * np.cos(angles) + 40.0j * np.sin(angles))
    x, y = np.meshgrid(np.arange(160.0) - 80.0, np.arange(160.0) - 80.0)
    # The spot is at each phase for the same time.
    picture = np.exp(-(np.abs(x + 1j * y - path[:, None, None]) ** 2) / 18.0).mean(axis=0)
    noise = np.random.default_rng(1).normal(0.0, 0.03 * picture.max(), x.shape)
    ratio, angle_deg = measure_spot(picture + 0.3 * picture.max() + noise)
    assert ratio == pytest.approx(1.25, abs=0.02)
    assert angle_deg == pytest.approx(30.0, abs=1.0)


def test_import_and_twin_find_the_same_grid_of_a_simulation(bench, tmp_path):
    options = argparse.Namespace(**{**STATED, **QUICK})
    (bench / "IM_KL.npy").rename(bench / "im.npy")
    (bench / "my_mask.npy").rename(bench / "valid.npy")
    (bench / "tel_pupil.npy").rename(bench / "pupil.npy")
    options.files, options.source = [(None, bench)], "files"
    imported = import_files(options)
    assert imported.tables == read_bench(options).imported[0].tables
    # 32 points for 8 subapertures; slopes do not show how wide the simulation's detector was
    grid = {"points_per_subaperture": 4, "width_subap": 20.0}
    assert imported.tables["wfs"]["fft_grid"] == grid
    assert any("remove fft_grid" in note for note in imported.notes)
    # What is no whole number of points is no simulation, and neither are very fine maps.
    for side in (33, 8 * 9):
        maps = np.random.default_rng(1).random((68, side, side))
        scipy.io.savemat(bench / "influence_functions.mat", {"modes": maps})
        np.save(bench / "pupil.npy", np.ones((side, side)))
        assert "fft_grid" not in import_files(options).tables["wfs"]
        assert len(read_bench(options).imported) == 1


@pytest.mark.skipif(not WHOLE_DETECTOR.is_file(), reason="the matrices are not here")
def test_frames_are_imported_as_simulated_if_their_images_are_around_the_middle(tmp_path):
    with np.load(WHOLE_DETECTOR) as dump:
        bench = split(dump, tmp_path / "bench")
        frames = dump["calib.D"].T.reshape(-1, 120, 120)
    options = argparse.Namespace(**{**STATED, "diameter_m": 0.6, "unit": "m"}, source="files")
    files = {"modes": "influence_functions.mat", "mode_to_actuator": "M2C.mat"}
    options.files = [(role, bench / name) for role, name in files.items()]
    options.files.append(("matrix", bench / "IM_KL.npy"))
    wfs = import_files(options).tables["wfs"]
    # Light between unmodulated images makes them seem 39 pixels wide.
    assert wfs["pupil_diameter_subap"] == wfs["n_subapertures"] == 36
    assert wfs["fft_grid"] == {"points_per_subaperture": 2, "width_subap": 120.0}
    np.save(bench / "IM_KL.npy", np.roll(frames, (3, -2), axis=(1, 2)))
    assert "fft_grid" not in import_files(options).tables["wfs"]
    # The twin's fits decide what the place of the images does not.
    assert "fft_grid" in read_bench(options).imported[0].tables["wfs"]


def simulate(name, folder):
    """Return what is saved of one of OOPAO's benches."""
    command = [find_interpreter("OOPAO"), "-m", "pyrcal_studies.oopao_benches", folder, name]
    variables = {**os.environ, "MPLBACKEND": "Agg", "PYTHONDONTWRITEBYTECODE": "1"}
    subprocess.run(command, cwd=ROOT, env=variables, stdout=subprocess.DEVNULL, check=True)
    return read_npz(folder / f"{name}.npz")


@pytest.fixture(scope="module")
def elliptic(tmp_path_factory):
    """Return OOPAO's bench of 4 by 5 λ/D, the longer axis at 120 deg, and its spot."""
    return simulate("ellipse-4-5", tmp_path_factory.mktemp("elliptic"))


@pytest.mark.long
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("name", "left", "within"), [("rooftop", 0.005, 0.005), ("rooftop-three", 0.02, 0.03)]
)
def test_a_rooftop_that_no_file_has_is_in_the_twin(name, left, within, tmp_path):
    """Target: 0.5 % left over without modulation; with it the tip leaves as much."""
    saved = simulate(name, tmp_path)
    stated = from_saved(saved, name).tables["wfs"]["rooftop_lambda_over_d"]
    np.savez(
        tmp_path / "it.npz", **{key: one for key, one in saved.items() if "rooftop" not in key}
    )
    made = pyrcal.twin(
        tmp_path / "it.npz",
        tmp_path / "twin",
        check=True,
        python=find_interpreter("OOPAO"),
        threads=1,
    )
    _, _, values = values_of(made)
    found = values["rooftop_lambda_over_d"]
    assert float(found["value"]) == pytest.approx(stated, abs=3.0 * found["sigma"])
    assert found["sigma"] < within
    assert found["origin"].startswith("measured: fitted")
    assert made.residual < left
    # the exported model has it, too
    (share,) = re.findall(r"its matrix leaves ([0-9.]+)% of the bench", made.checks[0])
    assert float(share) < 100.0 * left


@pytest.mark.long
@pytest.mark.timeout(300)
@pytest.mark.parametrize("with_picture", [True, False])
def test_the_ellipse_of_a_modulation_is_in_the_twin(elliptic, with_picture, tmp_path):
    """Targets: the axes within 1 %, the angle within 1 deg, with a picture of the spot."""
    ratio, angle_deg = measure_spot(elliptic["spot"])
    assert (ratio, angle_deg) == (pytest.approx(1.25, rel=0.01), pytest.approx(120.0, abs=1.0))
    more = [("my_mask", elliptic["wfs.validI4Q"])]
    more += [("modulated_spot", elliptic["spot"])] if with_picture else []
    bench = split(elliptic, tmp_path / "bench", *more)
    made = pyrcal.twin(bench, tmp_path / "twin", diameter_m=0.6, unit="m", threads=1)
    found = load_instrument(made.folder).wfs.modulation_axes
    axes, angle = sorted(found[:2]), found[2] + (np.pi / 2.0 if found[0] < found[1] else 0.0)
    # OOPAO's λ/D is 1 - 1 / n of that of a pupil of n = 36 points.
    assert np.array(axes) * 35 / 36 == pytest.approx([4.0, 5.0], rel=0.01)
    assert np.rad2deg(angle) % 180.0 == pytest.approx(120.0, abs=1.0)
    assert made.residual < 0.01
    _, _, values = values_of(made)
    assert values["modulation_ellipse"]["origin"].startswith("measured: fitted")
    assert "modulation_lambda_over_d" not in values
    # The exported model is modulated on the ellipse, not on a circle.
    assert "ELLIPSE: tuple[float, float, float] | None = (" in (
        made.folder / "oopao_model.py"
    ).read_text("utf-8")


@pytest.mark.long
@pytest.mark.timeout(500)
def test_a_dark_image_of_a_simulation_is_not_taken_for_a_displaced_one(tmp_path):
    """It seemed 4 pixels off, and the shift was 6 sigma wrong."""
    saved = simulate("whole-dark-image", tmp_path)
    # a mask of all pixels shows no image
    bench = split(saved, tmp_path / "bench", ("valid_pixels", saved["wfs.validSignal"]))
    stated = {"wavelength_m": float(saved["ngs.wavelength"]), "modulation": 0.0}
    made = pyrcal.twin(
        bench, tmp_path / "twin", diameter_m=0.6, pupil_subap=36, unit="m", threads=1, **stated
    )
    error = made.report.fit.alpha.vector * BOUNDARY_SCALE - [0.42, -1.1, 0.7, 1.12]
    assert np.all(np.abs(error) < 3.0 * made.report.fit.sigma * BOUNDARY_SCALE)
    assert np.all(np.abs(error) < [0.02, 0.02, 0.05, 0.002])
    assert made.residual < 0.03


CENTRES_PX = np.array([[11.5, 14.5], [13.5, 44.5], [42.5, 13.5], [43.5, 42.5]])
"""Pupil images up to three pixels off a square of 28 pixels."""


@pytest.fixture
def displaced(tmp_path):
    """Return the imports of a whole detector of 56 pixels that responds in four images of 20."""
    rng, along = np.random.default_rng(5), np.arange(56.0)
    lit = [np.hypot(along - x, along[:, None] - y) < 10.0 for y, x in CENTRES_PX]
    np.save(tmp_path / "IM.npy", rng.standard_normal((12, 56, 56)) * np.any(lit, axis=0))
    np.save(tmp_path / "dm_modes.npy", rng.standard_normal((12, 40, 40)))
    np.save(tmp_path / "M2C.npy", np.eye(12))
    np.save(tmp_path / "valid_pixels.npy", np.ones((56, 56)))  # OOPAO's, which shows no image
    options = argparse.Namespace(**{**STATED, "diameter_m": 0.6, "files": [(None, tmp_path)]})
    return read_bench(options).imported


def test_windows_of_a_simulated_bench_are_around_displaced_images(displaced):
    found = np.array(displaced[0].tables["wfs"]["pupil_centres_px"])
    # The outermost images are 32 pixels apart, which those of their square are not.
    assert np.abs(found - CENTRES_PX).max() < 0.51


def test_images_that_seem_displaced_are_also_tried_on_a_square(displaced):
    square = displaced[1].tables["wfs"]
    assert square["pupil_separation_subap"] == 30
    assert square["pupil_centres_px"] == [[y, x] for y in (12.5, 42.5) for x in (12.5, 42.5)]


@pytest.mark.parametrize("number", [0, 1, 2])
def test_the_response_is_no_light_that_frames_are_divided_by(displaced, number):
    assert displaced[number].tables["wfs"]["input"] == "normalised-frames"
    assert "flux_frame" not in displaced[number].arrays


def test_influence_functions_are_known_by_their_shape(bench, tmp_path):
    table = scipy.io.loadmat(bench / "influence_functions.mat")["influence_functions"]
    (bench / "influence_functions.mat").unlink()
    np.save(bench / "X.npy", table)
    with pytest.raises(ConfigurationError, match=r"no file .*nowhere"):
        pyrcal.twin(bench, tmp_path / "twin", diameter_m=1.8, unit="m", python="nowhere")
    options = argparse.Namespace(**{**STATED, "diameter_m": 1.8, "unit": "m"})
    options.files = [(None, bench)]
    assert f"modes, by its shape: {bench / 'X.npy'} {table.shape}" in read_bench(options).inventory
