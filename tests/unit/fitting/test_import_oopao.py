"""OOPAO's own objects, saved by OOPAO 1.0.0, become an instrument file, modes and a matrix.

``pyrcal/samples/data`` holds a pyramid and a Shack-Hartmann of 8 subapertures, whose mirror OOPAO
has moved by 0.2 of its subapertures and turned by 2 degrees: saved as docs/tutorials/oopao.md says.
"""

import re
from argparse import Namespace
from dataclasses import replace
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import scipy

import pyrcal
from pyrcal.__main__ import main
from pyrcal.fitting.models import choose_sampling
from pyrcal.importers.imported import Imported, orient_matrix
from pyrcal.importers.oopao import (
    SAVED,
    from_oopao,
    from_saved,
    registration_of,
    to_oopao,
)
from pyrcal.importers.saved import read_npz
from pyrcal.twins.bench import read_bench
from pyrcal.twins.make import STATED
from service.errors import ConfigurationError, MatrixError
from service.files.toml import read_toml
from service.model.instrument import PupilMap
from service.model.misregistration import Misregistration
from tests.support.repository import ROOT

DATA = ROOT / "pyrcal" / "samples" / "data"
TRUE = np.array([-0.2 * 31 / 32, 0.0, np.deg2rad(2.0), 1.0])
"""OOPAO's pupil of 32 points has its mirror on 31 steps."""


@pytest.fixture(scope="module")
def saved():
    return read_npz(DATA / "oopao-pyramid.npz")


def imported_of(saved, **other):
    return from_saved({**saved, **{name.replace("__", "."): v for name, v in other.items()}}, "it")


@pytest.mark.parametrize(("kind", "gain"), [("pyramid", 1.02), ("lenslets", 1.24)])
def test_what_oopao_saved_is_imported_and_fitted(kind, gain, tmp_path, capsys):
    folder = tmp_path / "bench"
    assert main(["import", "oopao", str(DATA / f"oopao-{kind}.npz"), "--output", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "α = (-0.1938, +0.0000 subap, +2.0000 deg, 1.0000)" in said
    assert f"next: pyrcal fit {folder / 'instrument.toml'} {folder / 'matrix.h5'}" in said
    instrument = pyrcal.load_instrument(folder / "instrument.toml")
    fit = pyrcal.fit_file(instrument, folder / "matrix.h5", pyrcal.FitOptions()).fit
    assert fit.accepted, fit.verdict
    assert np.median(fit.gains) == pytest.approx(gain, abs=0.01)
    assert np.all(np.abs(fit.alpha.vector - TRUE) < 3 * fit.sigma)
    # 8 subapertures and 30 modes do not exclude another stop or diameter, which is in sigma
    assert np.all(fit.sigma < [0.005, 0.002, np.deg2rad(0.02), 0.003])
    assert np.all(fit.registration.sigma_statistical < [0.001, 0.001, np.deg2rad(0.01), 0.001])


@pytest.mark.parametrize("source", ["oopao", "files", "twin"])
def test_fields_of_matlab_structs_are_read_like_names_with_dots(source, saved, tmp_path):
    structs = {}
    for name, values in saved.items():
        *owners, field = name.split(".")
        place = structs
        for owner in owners:
            place = place.setdefault(owner, {})
        place[field] = values
    assert isinstance(structs["dm"]["misReg"], dict)
    scipy.io.savemat(tmp_path / "it.mat", structs)
    np.savez(tmp_path / "it.npz", **saved)
    found = []
    for name in ("it.npz", "it.mat"):
        if source == "twin":
            given = {**STATED, "files": [(None, tmp_path / name)], "diameter_m": 1.8}
            found.append(read_bench(Namespace(**given)).imported[0])
            continue
        words = ["import", source, str(tmp_path / name), "--output", str(tmp_path / name[3:])]
        assert main(words + ["--diameter-m", "1.8"] * (source == "files")) == 0
        with h5py.File(tmp_path / name[3:] / "matrix.h5") as file:
            arrays = {key: file[key][()] for key in file}
        tables = read_toml(tmp_path / name[3:] / "instrument.toml")
        found.append(SimpleNamespace(arrays=arrays, tables=tables))
    first, second = found
    assert first.tables == second.tables
    assert first.arrays.keys() == second.arrays.keys()
    assert all(np.array_equal(first.arrays[key], second.arrays[key]) for key in first.arrays)
    assert first.arrays["interaction_matrix"].shape == (104, 30)


def test_geometric_lenslets_are_mean_gradients(tmp_path):
    saved = read_npz(DATA / "oopao-lenslets.npz")
    found = imported_of(saved, wfs__is_geometric=np.array(True))
    assert found.tables["wfs"]["centroid"] == "gradient"
    pyrcal.load_instrument(found.save(tmp_path / "geometric").instrument)


def test_a_black_and_white_pupil_decides_on_its_own_points(saved, tmp_path):
    """Four for each of 8 subapertures; a grey one, or one of very many, is as fine as usual."""
    instrument = pyrcal.load_instrument(imported_of(saved).save(tmp_path / "bench").instrument)
    assert choose_sampling(instrument) == 4
    lit = instrument.pupil.lit.copy()
    lit[lit.shape[0] // 2, 0] = 0.5
    grey = replace(instrument, pupil=replace(instrument.pupil, lit=lit))
    assert choose_sampling(grey) == 3
    finer = PupilMap(
        lit=np.kron(instrument.pupil.lit, np.ones((6, 6))), pitch_m=instrument.pupil.pitch_m / 6
    )
    assert choose_sampling(replace(instrument, pupil=finer)) == 3


def test_the_notes_stand_in_the_instrument_file(saved):
    assert "without its misReg, which is α" in imported_of(saved).instrument_text()


def test_a_zonal_calibration_has_the_actuators_for_modes(saved):
    zonal = {name: values for name, values in saved.items() if name != "M2C"}
    n_actuators = saved["dm.modes"].shape[1]
    found = imported_of(zonal, calib__D=np.ones((len(saved["calib.D"]), n_actuators)))
    assert found.tables["mirror"]["basis"] == "zonal"


def test_matrices_that_are_listed_the_other_way_round_are_turned_and_it_is_said(saved):
    found = imported_of(saved, calib__D=saved["calib.D"].T, M2C=saved["M2C"].T)
    np.testing.assert_array_equal(found.arrays["interaction_matrix"], saved["calib.D"])
    np.testing.assert_array_equal(found.arrays["mode_to_actuator"], saved["M2C"])
    assert sum("the other way round" in note for note in found.notes) == 2


def test_a_mirror_that_is_not_gaussian_becomes_a_cube(saved, tmp_path):
    found = imported_of(saved, dm__modes=saved["dm.modes"] ** 2)
    assert any("taken as a cube" in note for note in found.notes)
    side = int(saved["tel.resolution"])
    assert found.arrays["influence_functions"].shape[1:] == (side, side)
    instrument = pyrcal.load_instrument(found.save(tmp_path / "cube").instrument)
    assert instrument.modes.n_modes == saved["M2C"].shape[1]


def test_a_mirror_that_oopao_drew_flipped_is_drawn_flipped(saved):
    side = int(saved["tel.resolution"])
    cube = saved["dm.modes"].reshape(side, side, -1)[:, ::-1].reshape(side**2, -1)
    found = imported_of(saved, dm__modes=cube, dm__flip_lr=np.array(True))
    np.testing.assert_allclose(
        found.arrays["positions"], imported_of(saved).arrays["positions"] * [-1, 1]
    )


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ({"calib__D": np.ones((7, 30))}, "found shape (7, 30), expected (n_slopes, n_modes)"),
        ({"M2C": np.ones((7, 30))}, "M2C: found shape (7, 30), expected (n_actuators, n_modes)"),
        ({"calib__D": np.full((104, 30), np.nan)}, "expected finite numbers"),
        ({"wfs__postProcessing": np.array("quadCell")}, "expected 'slopesMaps', 'fullFrame'"),
        ({"wfs__postProcessing": np.array("fullFrame")}, "found no wfs.validSignal"),
        ({"wfs__tag": np.array("bioEdge")}, "found 'bioEdge', expected 'pyramid'"),
        ({"dm__altitude": np.array(8e3)}, "expected None: a mirror in the pupil"),
        ({"dm__modes": np.ones((7, 68))}, "expected (tel.resolution ** 2, n_actuators)"),
    ],
)
def test_what_does_not_belong_together_is_refused_with_its_name(saved, other, says):
    with pytest.raises((ConfigurationError, MatrixError), match=re.escape(says)):
        imported_of(saved, **other)


def whole_detector(saved, moved=((0, 0), (0, 0), (0, 0), (0, 0)), **other):
    """Save four discs of light that respond, on a detector of 24 pixels, as of the whole detector.

    ``moved`` are rows and columns of the images at -y -x, -y +x, +y -x, +y +x.
    """
    row, column = np.mgrid[:24, :24]
    lit = np.zeros((24, 24))
    for (y, x), (down, right) in zip(np.ndindex(2, 2), moved, strict=True):
        lit += np.hypot(row - 5.5 - 12 * y - down, column - 5.5 - 12 * x - right) < 4.0
    response = np.random.default_rng(3).normal(size=(576, 30)) * lit.reshape(-1, 1)
    kept = {name: values for name, values in saved.items() if name != "wfs.validI4Q"}
    return imported_of(
        kept,
        wfs__postProcessing=np.array("fullFrame_sum_flux"),
        wfs__n_pix_separation=np.array(4),
        **{"calib__D": response} | other,
    )


def test_a_signal_of_the_whole_detector_becomes_frames_over_their_sum(saved, tmp_path):
    found = whole_detector(saved)
    sensor = found.tables["wfs"]
    assert (sensor["input"], sensor["n_subapertures"]) == ("normalised-frames", 8)
    grid = {"points_per_subaperture": 4, "width_subap": 24.0, "modulation_points": 20}
    assert sensor["fft_grid"] == grid
    assert sensor["pupil_centres_px"] == [[5.5, 5.5], [5.5, 17.5], [17.5, 5.5], [17.5, 17.5]]
    assert found.arrays["interaction_matrix"].shape == (30, 24, 24)
    assert "flux_frame" not in found.arrays
    instrument = pyrcal.load_instrument(found.save(tmp_path / "whole").instrument)
    assert instrument.frames.normalised
    assert instrument.wfs.valid_subapertures.sum() == 52


def test_pupil_images_off_their_quadrants_are_cut_where_the_response_is(saved):
    moved = ((1, 2), (0, 2), (1, 0), (0, 0))
    found = whole_detector(saved, moved)
    assert found.tables["wfs"]["pupil_centres_px"] == [
        [6.5, 7.5],
        [5.5, 19.5],
        [18.5, 5.5],
        [17.5, 17.5],
    ]
    assert any("off OOPAO's own quadrants" in note for note in found.notes)


def test_the_reference_signal_of_a_whole_detector_is_its_mean_frame(saved):
    mean = np.random.default_rng(4).uniform(size=(24, 24))
    found = whole_detector(saved, wfs__referenceSignal_2D=mean)
    np.testing.assert_array_equal(found.arrays["flux_frame"], mean)
    assert found.tables["wfs"]["pupil_centres_px"] == "auto"


def test_valid_pixels_of_a_whole_detector_are_put_in_their_places(saved):
    lit = np.random.default_rng(5).uniform(size=(24, 24)) < 0.5
    response = np.random.default_rng(6).normal(size=(int(lit.sum()), 30))
    found = whole_detector(saved, calib__D=response, wfs__validSignal=lit.astype(int))
    cube = found.arrays["interaction_matrix"]
    np.testing.assert_array_equal(cube[:, lit], response.T)
    assert not cube[:, ~lit].any()


def test_the_grid_of_oopaos_fft_is_known_by_the_pixels_at_its_edge(saved, tmp_path):
    assert "fft_grid" not in imported_of(saved).tables["wfs"]
    found = imported_of(saved, wfs__n_pix_edge=np.array(1), wfs__n_pix_separation=np.array(3))
    grid = {"points_per_subaperture": 4, "width_subap": 21.0, "modulation_points": 20}
    assert found.tables["wfs"]["fft_grid"] == grid
    instrument = pyrcal.load_instrument(found.save(tmp_path / "bench").instrument)
    assert choose_sampling(instrument) == 4
    binned = imported_of(saved, wfs__n_pix_edge=np.array(1), wfs__binning=np.array(2))
    assert "fft_grid" not in binned.tables["wfs"]


def modulated_on(saved, *axes, angle_deg=0.0, middle=0.0):
    t = np.arange(24) * np.pi / 12
    path = np.exp(1j * np.deg2rad(angle_deg)) * (axes[0] * np.cos(t) + 1j * axes[1] * np.sin(t))
    own = np.column_stack([path.real + middle, path.imag])
    return imported_of(saved, wfs__user_modulation_path=own)


def test_an_elliptic_path_is_an_elliptic_modulation(saved, tmp_path):
    found = modulated_on(saved, 4.0, 5.0, angle_deg=30.0)
    ellipse = found.tables["wfs"]["modulation_ellipse"]
    np.testing.assert_allclose(ellipse["axes_lambda_over_d"], [5.0 * 32 / 31, 4.0 * 32 / 31])
    assert ellipse["angle_deg"] == pytest.approx(120.0)
    assert not any("user_modulation_path" in note for note in found.notes)
    longer, shorter, _ = pyrcal.load_instrument(
        found.save(tmp_path / "bench").instrument
    ).wfs.modulation_axes
    assert (longer, shorter) == pytest.approx((5.0 * 32 / 31, 4.0 * 32 / 31))


def test_a_rooftop_is_the_length_of_its_edge(saved, tmp_path):
    """OOPAO's number times 32 points over pi times the 11 pixels between two images."""
    about = {"wfs__n_pix_separation": np.array(3), "wfs__rooftop": np.array(-1.0)}
    found = imported_of(saved, **about)
    expected = pytest.approx(-32.0 / (11.0 * np.pi))
    assert found.tables["wfs"]["rooftop_lambda_over_d"] == expected
    bench = pyrcal.load_instrument(found.save(tmp_path / "bench").instrument)
    assert bench.wfs.rooftop_lambda_over_d == expected
    old = imported_of(saved, **about, wfs__old_mask=np.array(True))
    assert "rooftop_lambda_over_d" not in old.tables["wfs"]
    turned = imported_of(saved, wfs__theta_rotation=np.array(0.1))
    assert any("theta_rotation" in note for note in turned.notes)


def test_a_round_path_is_a_circle_and_another_one_is_said_to_be_none(saved):
    assert modulated_on(saved, 3.0, 3.0).tables["wfs"]["modulation_lambda_over_d"] == pytest.approx(
        3.0 * 32 / 31
    )
    assert any("no ellipse" in note for note in modulated_on(saved, 3.0, 4.0, middle=0.5).notes)
    with pytest.raises(ConfigurationError, match="expected pairs"):
        modulated_on(saved, 0.0, 0.0)


def test_what_was_not_saved_is_named(saved):
    left_out = {name: v for name, v in saved.items() if name not in {"tel.D", "wfs.modulation"}}
    with pytest.raises(ConfigurationError, match=r"it: found no tel\.D, wfs\.modulation"):
        from_saved(left_out, "it")


def test_the_page_saves_what_is_looked_at():
    page = (ROOT / "docs" / "tutorials" / "oopao.md").read_text("utf-8")
    (names,) = re.findall(r"^names = (\{.*?^\})", page, re.M | re.S)
    told = {owner: set(of_it.split()) for owner, of_it in eval(names).items()}
    assert told == {owner: set(of_it) for owner, of_it in SAVED.items()}


@pytest.mark.parametrize("stretches", [(0.0, 0.0), (0.01, -0.004), (-0.01, 0.0)])
def test_a_registration_there_and_back(stretches):
    tel, wfs = SimpleNamespace(D=8.0, resolution=80), SimpleNamespace(nSubap=20)
    alpha = Misregistration(
        shift_x_subap=0.3, shift_y_subap=-0.1, rotation_rad=0.3, magnification=1.02
    ).with_anamorphosis(np.array(stretches))
    moved = SimpleNamespace(**to_oopao(alpha, tel, wfs))
    assert moved.shiftX < 0.0 < moved.shiftY
    found = registration_of(moved, tel, 20)
    np.testing.assert_allclose(found.vector, alpha.vector)
    np.testing.assert_allclose(found.stretches, stretches, atol=1e-12)


def test_oopao_scales_along_its_angle_then_turns():
    """Its own formulas, of OOPAO 1.0.0: anamorphosis_coordinates, rotate_coordinates."""
    moved = SimpleNamespace(
        **{"anamorphosisAngle": 20.0, "radialScaling": 0.03, "tangentialScaling": -0.01},
        **{"rotationAngle": 12.0, "shiftX": 0.0, "shiftY": 0.0},
    )
    angle, turn, (x, y) = np.deg2rad(20.0), np.deg2rad(12.0), (0.7, -1.3)
    radial, tangential = 1.03, 0.99
    mixed = (tangential - radial) * np.sin(2 * angle) / 2
    u = x * (radial * np.cos(angle) ** 2 + tangential * np.sin(angle) ** 2) + y * mixed
    v = y * (radial * np.sin(angle) ** 2 + tangential * np.cos(angle) ** 2) + x * mixed
    there = [u * np.cos(turn) - v * np.sin(turn), v * np.cos(turn) + u * np.sin(turn)]
    alpha = registration_of(moved, SimpleNamespace(D=8.0, resolution=80), 20)
    np.testing.assert_allclose(alpha.image @ [x, y], there)


def test_a_square_matrix_is_taken_as_it_is_and_it_is_said():
    notes: list[str] = []
    values = orient_matrix(np.arange(9.0).reshape(3, 3), 3, 3, "M2C", "(a, b)", notes)
    assert values[0, 1] == 1.0
    assert "M2C is square" in notes[0]


def test_python_objects_and_what_is_no_npz_are_refused(tmp_path):
    objects, text = tmp_path / "objects.npz", tmp_path / "text.npz"
    np.savez(objects, thing=np.array([{}], dtype=object))
    text.write_text("no archive")
    for path in (objects, text, tmp_path / "missing.npz"):
        with pytest.raises(MatrixError, match=path.name):
            read_npz(path)


def test_a_folder_that_cannot_be_written_is_named(saved, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(pyrcal.PyrcalError, match="cannot be written"):
        imported_of(saved).save(tmp_path / "file")
    assert isinstance(imported_of(saved), Imported)


RIM = 5
"""Dark points around the pupil of a padded telescope."""


def padded(saved):
    """The same telescope in an array that is wider by a dark rim, as ``tel.pad`` makes it."""
    side = int(saved["tel.resolution"])
    wide, diameter_m = side + 2 * RIM, float(saved["tel.D"])
    # its mirror is drawn on points of which the first and the last are tel.D apart
    stretch = (wide / side) * (side - 1) / (wide - 1)
    cube = np.zeros((wide, wide, saved["dm.modes"].shape[1]))
    inner = slice(RIM, RIM + side)
    cube[inner, inner] = saved["dm.modes"].reshape(side, side, -1)
    return {
        "tel__D": np.array(diameter_m * wide / side),
        "tel__resolution": np.array(wide),
        "tel__pupil": np.pad(saved["tel.pupil"], RIM),
        "tel__pupilReflectivity": np.array(1.0),
        "dm__modes": cube.reshape(wide**2, -1),
        "dm__initial_coordinates": saved["dm.initial_coordinates"] * stretch,
    }


def test_the_dark_rim_of_a_padded_telescope_is_cut(saved, tmp_path):
    plain, found = imported_of(saved), imported_of(saved, **padded(saved))
    about, expected = (one.tables["instrument"] for one in (found, plain))
    assert about["diameter_m"] == pytest.approx(expected["diameter_m"])
    np.testing.assert_array_equal(found.arrays["pupil"].shape, plain.arrays["pupil"].shape)
    wide = int(saved["tel.resolution"]) + 2 * RIM
    share = int(saved["tel.resolution"]) / wide
    n = found.tables["wfs"]["n_subapertures"]
    assert found.tables["wfs"]["pupil_diameter_subap"] == pytest.approx(n * share)
    # OOPAO counts its modulation in wavelengths over tel.D, on the points' steps
    modulation = float(saved["wfs.modulation"]) * wide / (wide - 1) * share
    assert found.tables["wfs"]["modulation_lambda_over_d"] == pytest.approx(modulation)
    assert any("padded" in note for note in found.notes)
    pyrcal.load_instrument(found.save(tmp_path / "padded").instrument)


def test_selected_actuators_are_those_that_validact_lists(saved):
    """A scalar ``actuator_selection`` drops functions and leaves the coordinates as they were."""
    kept = np.delete(np.arange(saved["dm.modes"].shape[1]), [0, 3])
    chosen = {"dm__modes": saved["dm.modes"][:, kept], "M2C": saved["M2C"][kept]}
    found = imported_of(saved, **chosen, dm__validAct=kept)
    np.testing.assert_array_equal(
        found.arrays["positions"], imported_of(saved).arrays["positions"][kept]
    )
    unknown = imported_of(saved, **chosen)
    assert "influence_functions" in unknown.arrays
    assert any("dm.initial_coordinates is the longer one" in note for note in unknown.notes)


def test_influence_functions_of_its_own_class_are_taken(saved):
    side = int(saved["tel.resolution"])
    cube = np.moveaxis((saved["dm.modes"] ** 2).reshape(side, side, -1), -1, 0)
    objects = {name: {} for name in ("tel", "wfs", "ngs")}
    for name, values in saved.items():
        owner, _, attribute = name.rpartition(".")
        if owner in objects:
            objects[owner][attribute] = values.item() if values.ndim == 0 else values
    tel, wfs, ngs = (SimpleNamespace(**objects[name]) for name in ("tel", "wfs", "ngs"))
    functions = SimpleNamespace(influence_function_2D=cube, sign=1)
    found = from_oopao(tel, functions, wfs, saved["calib.D"], saved["M2C"], ngs)
    np.testing.assert_allclose(found.arrays["influence_functions"], cube, rtol=1e-6)


def test_an_influence_function_without_numbers_is_named_and_does_not_move(saved, tmp_path):
    """One broken measurement of 68 leaves the surface known to the others."""
    functions = saved["dm.modes"] ** 2
    functions[:, 7] = np.nan
    found = imported_of(saved, dm__modes=functions)
    instrument = pyrcal.load_instrument(found.save(tmp_path / "nan").instrument)
    assert any("function 7 is not finite: left out" in remark for remark in instrument.remarks)
    assert not any("0%" in remark for remark in instrument.remarks)
