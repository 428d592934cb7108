"""Files of SPECULA, pyRTC, cacao and arrays by name become an instrument and its matrix.

``pyrcal/samples/data`` holds what SPECULA 1.1.0 saved of a pyramid of 14 subapertures whose images
it has moved by 0.25 of one, 20 Zernike modes, and what pyRTC 2.1 saved of random numbers.
"""

import contextlib
import re
import shutil
import warnings
from dataclasses import replace

import h5py
import numpy as np
import pytest
import scipy
from astropy.io import fits
from hypothesis import given
from hypothesis import strategies as st

import pyrcal
import pyrcal.fitting.recorded
from pyrcal.__main__ import main
from pyrcal.fitting.specula import write_specula
from pyrcal.importers.aot import from_aot
from pyrcal.importers.cacao import from_cacao
from pyrcal.importers.files import Reported, calibration_of, from_arrays
from pyrcal.importers.frames import frames_of
from pyrcal.importers.layouts import by_role, cube_of, maps_of, mask_of
from pyrcal.importers.saved import read_npz
from pyrcal.importers.specula import from_specula
from service.errors import MatrixError
from service.files.container import opened
from tests.support.import_files import CUBE, MATRIX, VALID, N, aot_file
from tests.support.repository import ROOT

DATA = ROOT / "pyrcal" / "samples" / "data"
SPECULA = [DATA / f"specula-{name}.fits" for name in ("im", "pup", "ifunc")]
REPORTED = Reported(
    diameter_m=2.0, sensor="pyramid", stop="mirror", obscuration_ratio=0.2, unit="nm"
)

MAPS = np.zeros((2, N, N, 5))
MAPS[:, VALID] = MATRIX.reshape(2, -1, 5)


def arrays(**other):
    return {"matrix": MATRIX, "valid": VALID, "modes": CUBE, **other}


def test_what_specula_saved_is_imported_and_fitted_with_an_unknown_sensor(tmp_path, capsys):
    folder = tmp_path / "bench"
    reported = ["--diameter-m", "2", "--stop", "mirror", "--obscuration", "0.2"]
    words = ["import", "specula", *map(str, SPECULA), *reported, "--output", str(folder)]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "note: wavelength_m is unknown" in said
    assert "note: modulation_lambda_over_d is unknown" in said
    instrument = pyrcal.load_instrument(folder / "instrument.toml")
    fit = pyrcal.fit_file(instrument, folder / "matrix.h5", pyrcal.FitOptions()).fit
    assert fit.accepted, fit.verdict
    assert np.all(np.abs(fit.alpha.vector - [0.25, 0.0, 0.0, 1.0]) < 3 * fit.sigma)
    found = {one.key: one.found for one in fit.optics}
    assert found["modulation_lambda_over_d"] == pytest.approx(3.0, abs=0.03)
    # places of the pupil images, which the file leaves open, blur as modulation does: 1 %
    (wavelength_m,) = re.findall(r"wavelength_m = (\S+) was found", "\n".join(fit.remarks))
    assert float(wavelength_m) == pytest.approx(7.5e-7, rel=0.015)


def changed(path, to, change):
    """Write a file of SPECULA's with its arrays changed."""
    with fits.open(path) as file:
        change(file)
        file.writeto(to, overwrite=True)
    return to


def test_an_old_intmat_and_one_that_is_interleaved_are_the_same_matrix(tmp_path):
    as_it_is = from_specula(SPECULA, REPORTED)
    matrix = as_it_is.arrays["interaction_matrix"]

    def old(file):
        file[1].data = file[1].data.T.copy()

    def interleaved(file):
        both = np.split(file[1].data, 2)
        file[1].data = np.stack(both, axis=1).reshape(file[1].data.shape)
        file[0].header["INTRLVD"] = True

    for change in (old, interleaved):
        im = changed(SPECULA[0], tmp_path / "im.fits", change)
        found = from_specula([im, *SPECULA[1:]], REPORTED)
        np.testing.assert_allclose(found.arrays["interaction_matrix"], matrix)
    assert (
        "the other way round"
        in from_specula(
            [changed(SPECULA[0], tmp_path / "im.fits", old), *SPECULA[1:]], REPORTED
        ).notes[-1]
    )


def test_subapertures_in_another_order_are_sorted(tmp_path):
    as_it_is = from_specula(SPECULA, REPORTED)
    order = np.random.default_rng(3).permutation(len(fits.getdata(SPECULA[1], 1)))

    def shuffled(file):
        file[1].data = file[1].data[order]

    def matrix_too(file):
        both = np.stack(np.split(file[1].data, 2))
        file[1].data = both[:, order].reshape(file[1].data.shape)

    pup = changed(SPECULA[1], tmp_path / "pup.fits", shuffled)
    im = changed(SPECULA[0], tmp_path / "im.fits", matrix_too)
    found = from_specula([im, pup, SPECULA[2]], REPORTED)
    np.testing.assert_array_equal(
        found.arrays["interaction_matrix"], as_it_is.arrays["interaction_matrix"]
    )
    np.testing.assert_array_equal(
        found.arrays["valid_subapertures"], as_it_is.arrays["valid_subapertures"]
    )
    assert any("row by row" in note for note in found.notes)


@pytest.mark.parametrize(
    ("files", "says"),
    [
        (SPECULA[:1] + SPECULA[2:], "found no PupData or SubapData"),
        (SPECULA[1:], "found no Intmat"),
        (SPECULA[:2], "neither modes nor positions"),
        ([*SPECULA, SPECULA[0]], "found a second matrix"),
    ],
)
def test_a_file_that_is_missing_or_twice_there_is_named(files, says):
    with pytest.raises(MatrixError, match=says):
        from_specula(files, REPORTED)


def test_calibrations_of_pyrtc_are_known_by_their_record(tmp_path):
    np.save(tmp_path / "modes.npy", CUBE)
    calibrations = [str(DATA / f"pyrtc-{name}.npz") for name in ("im", "valid")]
    words = ["import", "pyrtc", *calibrations, f"modes={tmp_path / 'modes.npy'}"]
    folder = tmp_path / "bench"
    assert main([*words, "--diameter-m", "2", "--output", str(folder)]) == 0
    text = (folder / "instrument.toml").read_text("utf-8")
    assert 'stroke = "unknown"' in text
    assert "listed twice, for x and y" in text
    recorded = read_npz(DATA / "pyrtc-im.npz")["data"]
    with pyrcal.fitting.recorded.opened(folder / "matrix.h5") as file:
        np.testing.assert_array_equal(file.find("interaction_matrix").read(), recorded)


@pytest.mark.parametrize("told", [None, 8.0])
def test_a_mask_that_is_wider_than_the_pupil_is_said_and_a_diameter_that_is_told_is_taken(told):
    rows, columns = np.mgrid[:12, :12] - 5.5
    away = np.hypot(rows, columns)[None, :, :, None]
    maps = np.where(away < 4.0, 1.0, 0.05) * np.ones((2, 12, 12, 5))
    maps[:, away[0, :, :, 0] > 6.0] = 0.0
    reported = replace(REPORTED, pupil_diameter_subap=told)
    imported = from_arrays("bench", {"matrix": maps, "modes": CUBE}, reported)
    (note,) = [n for n in imported.notes if "--pupil-subap" in n] or [None]
    if told is None:
        assert "the pupil's image looks 8 subapertures wide, the mask has 12" in note
        assert "pupil_diameter_subap" not in imported.tables["wfs"]
    else:
        assert note is None
        assert imported.tables["wfs"]["pupil_diameter_subap"] == told


@pytest.mark.parametrize("way", ["absent", "zeros", "NaN"])
def test_the_grid_stays_where_the_file_has_it(way):
    rows, columns = np.mgrid[:16, :16] - 7.5
    valid = np.hypot(rows, columns) <= 8.0
    matrix = np.random.default_rng(1).normal(size=(2, int(valid.sum()), 5))
    gone = (columns < -6) | (rows + columns > 10)
    kept = valid & ~gone
    if way == "absent":
        matrix, valid = matrix[:, ~gone[valid]], kept
    else:
        matrix[:, gone[valid]] = 0.0 if way == "zeros" else np.nan
    given = arrays(matrix=matrix.reshape(-1, 5), valid=valid)
    imported = from_arrays("x", given, REPORTED)
    assert np.array_equal(imported.arrays["valid_subapertures"], kept)
    assert imported.tables["wfs"]["n_subapertures"] == 16
    assert "pupil_diameter_subap" not in imported.tables["wfs"]
    # A dark ring around it means a narrower pupil, also where a part is missing.
    imported = from_arrays("x", {**given, "valid": np.pad(valid, 2)}, REPORTED)
    wfs = imported.tables["wfs"]
    assert (wfs["n_subapertures"], wfs["pupil_diameter_subap"]) == (20, 16.0)
    assert any("--pupil-subap" in note for note in imported.notes)


@pytest.mark.parametrize(("across", "read"), [(16, 16), (8, None)])
def test_a_whole_mask_beside_one_line_more_shows_the_width_of_the_pupil(across, read):
    """A disc of 8 subapertures that lacks a row and a column looks like one of 7."""
    rows, columns = np.mgrid[:across, :across] - (across - 1) / 2.0
    valid = np.hypot(rows, columns) <= across / 2.0 + 0.1
    if read is None:
        valid[0] = valid[:, 0] = False
    else:
        valid = np.pad(valid, ((1, 0), (0, 1)))
    matrix = np.random.default_rng(1).normal(size=(2 * int(valid.sum()), 5))
    imported = from_arrays("x", arrays(matrix=matrix, valid=valid), REPORTED)
    assert imported.tables["wfs"].get("pupil_diameter_subap") == read
    assert sum("--pupil-subap" in note for note in imported.notes) == 1


def test_slopes_of_as_many_modes_as_subapertures_are_no_frames():
    n = int(VALID.sum())
    matrix = np.random.default_rng(1).normal(size=(2 * n, n))
    assert frames_of(matrix, None, VALID) is None
    assert frames_of(matrix[:n, :9], None, VALID).cube.shape == (9, N, N)


def save_matlab73(path, given):
    """Write arrays as MATLAB 7.3 does: HDF5 behind a header, all axes reversed, no vectors."""
    with h5py.File(path, "w", userblock_size=512) as file:
        structs = {f"bench/{field}": one for field, one in given.pop("bench", {}).items()}
        for name, values in {**given, **structs}.items():
            file[name] = np.atleast_2d(values).astype(np.uint8 if name == "valid" else float).T
        file["#refs#/modes"] = np.ones((3, 3))
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def save_matlab5(path, given):
    scipy.io.savemat(path, {**given, "made_by": "a text"}, do_compression=True)


@pytest.mark.parametrize("save", [save_matlab73, save_matlab5])
@pytest.mark.parametrize("together", ["variables", "struct", ""])
def test_files_of_matlab_are_the_same_as_npz(save, together, tmp_path):
    valid = VALID.copy()
    valid[0] = False  # exchanging x and y must show
    cube = CUBE.copy()
    cube[:, 3:, 7:] = 0.0
    given = {
        "im": np.random.default_rng(3).normal(size=(2 * valid.sum(), 4)),
        "valid": valid,
        "cube": cube,
        "M2C": np.random.default_rng(4).normal(size=(5, 4)),
    }
    both = {"bench": dict(given)} if together == "struct" else given
    np.savez(tmp_path / "all.npz", **given)
    (tmp_path / "matlab").mkdir()
    if together:
        save(tmp_path / "matlab" / "of the bench.mat", both)
    else:
        for name, values in given.items():
            save(tmp_path / "matlab" / f"{name}.mat", {name: values})
    found = []
    for name in ("all.npz", "matlab"):
        words = ["import", "files", str(tmp_path / name), "--diameter-m", "2", "--output"]
        assert main([*words, str(tmp_path / f"of {name}")]) == 0
        with h5py.File(tmp_path / f"of {name}" / "matrix.h5") as file:
            found.append({key: file[key][()] for key in file})
    assert found[0].keys() == found[1].keys()
    assert all(np.array_equal(found[0][key], found[1][key]) for key in found[0])
    save(tmp_path / "fit.mat", {"interaction_matrix": given["im"], "modes": np.array([3, 0, 1, 4])})
    recorded = pyrcal.fitting.recorded.read_recorded(tmp_path / "fit.mat")
    assert np.array_equal(recorded.values, given["im"])
    assert recorded.modes.tolist() == [3, 0, 1, 4]


@pytest.mark.parametrize("cut", [60, 140, 300, -20])
def test_a_damaged_file_of_matlab_is_refused(cut, tmp_path):
    path = tmp_path / "im.mat"
    save_matlab5(path, {"im": MATRIX})
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(MatrixError, match=re.escape(str(path))), opened(path) as container:
        container.arrays["im"].read()


@pytest.mark.parametrize("lossy", [True, False])
def test_an_image_that_was_compressed_with_loss_is_named(lossy, tmp_path, capsys):
    path = tmp_path / "im.fits.fz"
    image = fits.CompImageHDU(
        MATRIX.astype(np.float32), compression_type="GZIP_2", quantize_level=4.0 * lossy
    )
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(path)
    np.save(tmp_path / "valid.npy", VALID)
    np.save(tmp_path / "modes.npy", CUBE)
    words = ["import", "files", str(tmp_path), "--diameter-m", "2", "--output"]
    assert main([*words, str(tmp_path / "out")]) == 0
    assert ("with loss" in capsys.readouterr().out) is lossy
    assert bool(pyrcal.fitting.recorded.read_recorded(path).remark) is lossy


def spoil_nothing(_):
    """Let an import fail by what it reads or by its name."""


@pytest.mark.parametrize(
    ("changed", "where", "spoil"),
    [
        ({"matrix": MATRIX[:-1]}, "new/out", spoil_nothing),
        ({"matrix": MATRIX[:, :0]}, "new/out", spoil_nothing),
        ({"valid": VALID * 2}, "out", spoil_nothing),
        ({"cube": CUBE[0]}, "out", spoil_nothing),
        ({"cube": np.zeros_like(CUBE)}, "new/out", spoil_nothing),
        ({"cube": CUBE[:, :7, :7]}, "new/out", spoil_nothing),
        ({}, "new/" + 300 * "x", spoil_nothing),
        ({}, "all.npz/out", spoil_nothing),
        ({}, "out", lambda folder: (folder / "out" / "instrument.toml").mkdir(parents=True)),
        ({}, "out", lambda folder: (folder / "out" / "matrix.h5").mkdir(parents=True)),
        ({}, "out", lambda folder: (folder / "out").write_text("a file")),
    ],
)
def test_an_import_that_fails_leaves_nothing(changed, where, spoil, tmp_path, capsys):
    np.savez(tmp_path / "all.npz", **({"matrix": MATRIX, "valid": VALID, "cube": CUBE} | changed))
    spoil(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    words = ["import", "files", str(tmp_path / "all.npz"), "--diameter-m", "2", "--output"]
    assert main([*words, str(tmp_path / where)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_bare_array_has_no_record_and_is_refused_without_its_role(tmp_path, capsys):
    np.save(tmp_path / "im.npy", MATRIX)
    words = ["import", "pyrtc", str(tmp_path / "im.npy"), "--diameter-m", "2"]
    assert main([*words, "--output", str(tmp_path / "bench")]) == 2
    assert "no record of pyRTC 2" in capsys.readouterr().err


def test_arrays_are_known_by_their_names(tmp_path):
    np.savez(tmp_path / "bench.npz", D=MATRIX, valid=VALID, modes=CUBE)
    folder = tmp_path / "bench"
    words = ["import", "files", str(tmp_path / "bench.npz"), "--diameter-m", "2", "--unit", "um"]
    assert main([*words, "--output", str(folder)]) == 0
    with pyrcal.fitting.recorded.opened(folder / "matrix.h5") as file:
        np.testing.assert_allclose(file.find("interaction_matrix").read(), MATRIX * 1e6)
    with pytest.raises(MatrixError, match="found D and im, expected one matrix"):
        by_role({"D": MATRIX, "im": MATRIX}, "it")


def test_what_an_import_wrote_is_imported_again_the_same(tmp_path):
    """From .npz to matrix.h5, from that to .npz and once more: the same numbers and keys."""
    reported = replace(REPORTED, unit="m")
    given = arrays(positions=np.random.default_rng(6).normal(size=(5, 2)))
    for left_out in ("positions", "modes"):
        np.savez(tmp_path / "it.npz", **{k: v for k, v in given.items() if k != left_out})
        first = from_arrays("it", by_role(read_npz(tmp_path / "it.npz"), "it"), reported)
        saved = first.save(tmp_path / "bench").matrix
        with pyrcal.fitting.recorded.opened(saved) as file:
            np.savez(tmp_path / "it.npz", **{k: v.read() for k, v in file.arrays.items()})
        again = from_arrays("it", by_role(read_npz(tmp_path / "it.npz"), "it"), reported)
        assert again.tables == first.tables
        assert again.arrays.keys() == first.arrays.keys()
        for name, values in first.arrays.items():
            np.testing.assert_array_equal(again.arrays[name], values, strict=True)


@pytest.mark.parametrize(
    "listed",
    [
        MATRIX.T,
        MAPS,
        np.moveaxis(MAPS, -1, 0),
        np.moveaxis(np.concatenate(MAPS, axis=1), -1, 0),
        np.concatenate(MAPS, axis=0),
    ],
)
@pytest.mark.parametrize("masked", [True, False])
def test_a_matrix_is_the_same_in_every_layout(listed, masked):
    given = arrays(matrix=listed)
    if listed.ndim > 2 and not masked:
        del given["valid"]
    found = from_arrays("it", given, REPORTED)
    np.testing.assert_allclose(found.arrays["interaction_matrix"], MATRIX * 1e9)
    np.testing.assert_array_equal(found.arrays["valid_subapertures"], VALID)
    assert found.notes


def test_a_cube_with_its_modes_last_is_turned():
    notes = []
    np.testing.assert_array_equal(cube_of(np.moveaxis(CUBE, 0, -1), notes), CUBE)
    assert notes


def test_fewer_columns_than_modes_are_the_first_ones(tmp_path):
    found = from_arrays("it", arrays(matrix=MATRIX[:, :3]), REPORTED)
    assert found.arrays["modes"].tolist() == [0, 1, 2]
    found.save(tmp_path / "bench")


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ({"matrix": MATRIX[1:]}, "found shape (63, 5)"),
        ({"matrix": np.zeros((3, 4, 5))}, "it fits none of them"),
        ({"matrix": np.zeros((2, 5, 6, 2))}, "expected maps of slopes"),
        ({"valid": np.ones((5, 6))}, "expected a mask (n, n) of 0 and 1"),
        ({"valid": np.zeros((6, 6))}, "found no valid subaperture"),
        ({"valid": 0.5 * VALID}, "found values 0.5, expected a mask of 0 and 1"),
        ({"valid": np.where(VALID, -127, -128)}, "found values -128 and -127"),
        ({"modes": np.zeros((12, 12, 12))}, "n_modes other than n"),
        ({"modes": np.zeros((3, 4, 5))}, "n_modes other than n"),
        ({"modes": np.zeros((12, 12))}, "expected numbers (n_modes, n, n)"),
        ({"mode_to_actuator": np.zeros((7, 5))}, "found 7 modes of 5 actuators"),
    ],
)
def test_what_fits_no_layout_or_several_is_refused(other, says):
    with pytest.raises(MatrixError, match=re.escape(says)):
        from_arrays("it", arrays(**other), REPORTED)


def test_maps_that_fit_two_layouts_are_refused():
    with pytest.raises(MatrixError, match="it fits"):
        maps_of(np.zeros((6, 12, 6)), None, [])


def test_a_mask_that_differs_for_x_and_y_is_refused():
    with pytest.raises(MatrixError, match="expected a mask"):
        mask_of(np.hstack([VALID, np.ones_like(VALID)]), [])


def test_a_matrix_of_another_instrument_is_not_saved(tmp_path):
    found = from_arrays("it", arrays(), REPORTED)
    wrong = replace(found, arrays={**found.arrays, "interaction_matrix": MATRIX[2:]})
    with pytest.raises(MatrixError, match=r"found shape \(62, 5\), expected \(n_slopes"):
        wrong.save(tmp_path / "bench")


def test_a_loop_of_cacao_has_modes_of_actuators_without_a_unit(tmp_path):
    actuators = np.ones((7, 7), np.float32)
    actuators[0, 0] = 0.0
    modes = np.random.default_rng(4).normal(size=(5, 7, 7)).astype(np.float32)
    maps = np.moveaxis(np.concatenate(MAPS, axis=1), -1, 0).astype(np.float32)
    for name, values in (
        ("CMmodesWFS", maps),
        ("CMmodesDM", modes),
        ("wfsmask", np.hstack([VALID, VALID]).astype(np.float32)),
        ("dmmask", actuators[None]),
    ):
        fits.writeto(tmp_path / f"aol1_{name}.fits", values)
    found = from_cacao(tmp_path, replace(REPORTED, unit=None))
    assert found.tables["mirror"]["stroke"] == "unknown"
    assert found.arrays["positions"].shape == (48, 2)
    np.testing.assert_allclose(found.arrays["positions"][0], [-2 / 3, -1.0])
    np.testing.assert_array_equal(found.arrays["mode_to_actuator"][0], modes[:, 0, 1])
    np.testing.assert_allclose(found.arrays["interaction_matrix"], MATRIX, rtol=1e-6)
    found.save(tmp_path / "bench")
    (tmp_path / "aol1_dmmask.fits").unlink()
    # the modes are maps of a grid: without a mask all of its actuators exist
    assert from_cacao(tmp_path, REPORTED).arrays["positions"].shape == (49, 2)


@pytest.mark.parametrize(
    "listed", [MATRIX, MATRIX.reshape(2, -1, 5), MATRIX.reshape(2, -1, 5).swapaxes(0, 1)]
)
def test_an_aot_file_says_telescope_and_wavelength_itself(listed, tmp_path):
    aot_file(tmp_path / "it.fits", interaction_matrix=listed)
    words = ["import", "aot", str(tmp_path / "it.fits"), "--diameter-m", "99"]
    assert main([*words, "--output", str(tmp_path / "bench")]) == 0
    instrument = pyrcal.load_instrument(tmp_path / "bench" / "instrument.toml")
    assert (instrument.diameter_m, instrument.obscuration_ratio) == (2.0, 0.2)
    assert instrument.wfs.wavelength_m == 750e-9
    assert not instrument.mirror.stroke_known
    with pyrcal.fitting.recorded.opened(tmp_path / "bench" / "matrix.h5") as file:
        np.testing.assert_array_equal(file.find("interaction_matrix").read(), MATRIX)


def test_an_aot_file_without_a_matrix_and_what_is_none_are_refused(tmp_path):
    aot_file(tmp_path / "it.fits")
    with pytest.raises(MatrixError, match="found no loop with an interaction matrix"):
        from_aot(tmp_path / "it.fits", REPORTED)
    with pytest.raises(MatrixError, match="expected an AOT file"):
        from_aot(SPECULA[0], REPORTED)


def test_a_matrix_without_columns_is_refused(tmp_path):
    aot_file(tmp_path / "it.fits", interaction_matrix=MATRIX.reshape(2, -1, 5)[..., :0])
    with pytest.raises(MatrixError, match="found no column"):
        from_aot(tmp_path / "it.fits", REPORTED)


def test_subapertures_of_an_aot_file_are_where_its_mask_says(tmp_path):
    listed = np.random.default_rng(5).permutation(int(VALID.sum()))
    matrix = MATRIX.reshape(2, -1, 5)[:, np.argsort(listed)].swapaxes(0, 1)
    aot_file(tmp_path / "it.fits", listed=listed, interaction_matrix=matrix)
    imported = from_aot(tmp_path / "it.fits", replace(REPORTED, unit=None))
    np.testing.assert_array_equal(imported.arrays["interaction_matrix"], MATRIX)
    aot_file(tmp_path / "two.fits", listed=0 * listed, interaction_matrix=matrix)
    with pytest.raises(MatrixError, match="expected -1 or the place of each"):
        from_aot(tmp_path / "two.fits", REPORTED)


def test_a_matrix_of_actuators_leaves_modes_of_an_aot_file_out(tmp_path):
    strokes = np.eye(5)[:, :3]
    aot_file(tmp_path / "it.fits", interaction_matrix=MATRIX, modes_to_commands=strokes)
    imported = from_aot(tmp_path / "it.fits", REPORTED)
    assert "mode_to_actuator" not in imported.arrays
    assert "modes are left out" in " ".join(imported.notes)


def test_alpha_of_an_aot_file_starts_the_fit_and_is_said(tmp_path, capsys):
    turn, subaperture_m = np.deg2rad([20.0, 30.0]), 2.0 / N
    matrices = np.zeros((3, 3, 2))
    for k, angle in enumerate(turn):
        matrices[:2, :2, k] = 1.01 * np.array(
            [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        )
        matrices[:, 2, k] = 0.2 * subaperture_m, -0.1 * subaperture_m, 1.0
    aot_file(tmp_path / "it.fits", interaction_matrix=MATRIX, moved=matrices)
    words = ["import", "aot", str(tmp_path / "it.fits"), "--diameter-m", "2"]
    assert main([*words, "--output", str(tmp_path / "bench")]) == 0
    said = "the file's own alpha: 2 times, last (+0.20, -0.10 subap, +30.00 deg, 1.0100); a fit"
    assert said in capsys.readouterr().out
    instrument = pyrcal.load_instrument(tmp_path / "bench" / "instrument.toml")
    assert instrument.mirror.nominal_rotation_rad == pytest.approx(turn[1])
    assert instrument.mirror.parity == 1
    with pyrcal.fitting.recorded.opened(tmp_path / "bench" / "matrix.h5") as file:
        found = file.find("registration").read()
    np.testing.assert_allclose(found, [[0.2, -0.1, 20, 1.01], [0.2, -0.1, 30, 1.01]], rtol=1e-12)


def test_an_aot_file_that_moves_its_sensor_too_is_refused(tmp_path):
    eye = np.eye(3)[..., np.newaxis]
    moved = {"interaction_matrix": MATRIX, "moved": eye}
    aot_file(tmp_path / "plain.fits", sensor_moved=eye, **moved)
    assert "registration" in from_aot(tmp_path / "plain.fits", REPORTED).arrays
    aot_file(tmp_path / "it.fits", sensor_moved=np.diag([1.0, -1.0, 1.0])[..., np.newaxis], **moved)
    with pytest.raises(MatrixError, match="transformation_matrix of the sensor, too"):
        from_aot(tmp_path / "it.fits", REPORTED)


@given(cut=st.integers(0, 3000), flipped=st.integers(0, 3000))
def test_a_damaged_npz_is_read_or_refused_and_nothing_else(cut, flipped, tmp_path_factory):
    whole = bytearray((DATA / "pyrtc-im.npz").read_bytes())
    if flipped < len(whole):
        whole[flipped] ^= 0xFF
    path = tmp_path_factory.mktemp("npz") / "it.npz"
    path.write_bytes(whole[: len(whole) - cut] if cut < len(whole) else b"")
    with contextlib.suppress(MatrixError):
        calibration_of(read_npz(path), "it")


@pytest.mark.parametrize(("at", "bit"), [(8, 0x40), (6, 0x20), (6, 0x01), (4, 0x80)])
def test_a_member_that_cannot_be_unpacked_is_refused(at, bit, tmp_path):
    """Its method, patched or encrypted data, a version to come: in both of a member's headers."""
    whole = bytearray((DATA / "pyrtc-im.npz").read_bytes())
    for begins, beside in ((b"PK\x03\x04", 0), (b"PK\x01\x02", 2)):
        whole[whole.index(begins) + at + beside] ^= bit
    (tmp_path / "it.npz").write_bytes(whole)
    with pytest.raises(MatrixError, match=r"it\.npz"):
        read_npz(tmp_path / "it.npz")


@pytest.fixture
def four_loops(tmp_path):
    """An AOT file as a laser system's: four sensors of one mirror, listed column by column."""
    aotpy = pytest.importorskip("aotpy")
    places = np.full(VALID.T.shape, -1, dtype=np.int32)
    places[VALID.T] = np.arange(VALID.sum())
    places = places.T
    by_columns = MATRIX.reshape(2, -1, 5)[:, np.argsort(places[VALID])].swapaxes(0, 1)
    telescope = aotpy.MainTelescope(uid="t", enclosing_diameter=2.0, obstruction_diameter=0.4)
    mirror = aotpy.DeformableMirror(uid="dsm", telescope=telescope, n_valid_actuators=5)
    sensors, loops = [], []
    for number in range(1, 5):
        sensor = aotpy.ShackHartmann(
            uid=f"LGS{number}",
            source=aotpy.NaturalGuideStar(uid=f"star {number}"),
            n_valid_subapertures=int(VALID.sum()),
            subaperture_mask=aotpy.Image(f"mask {number}", places),
            wavelength=589e-9,
            centroiding_algorithm="cog",
        )
        sensors.append(sensor)
        loops.append(
            aotpy.ControlLoop(
                uid=f"loop {number}",
                input_sensor=sensor,
                commanded_corrector=mirror,
                interaction_matrix=aotpy.Image(f"matrix {number}", number * by_columns),
            )
        )
    system = aotpy.AOSystem(
        ao_mode="GLAO",
        name="it",
        main_telescope=telescope,
        sources=[sensor.source for sensor in sensors],
        wavefront_sensors=sensors,
        wavefront_correctors=[mirror],
        loops=loops,
    )
    path = tmp_path / "four.fits"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        system.write_to_file(path, "fits")
    return path


def test_one_of_four_loops_is_chosen_and_a_mirror_without_places_given_some(
    four_loops, tmp_path, capsys
):
    places = np.random.default_rng(8).normal(size=(5, 2))
    np.savetxt(tmp_path / "xy.txt", places)
    words = ["import", "aot", str(four_loops), "--diameter-m", "2"]
    more = ["--positions", str(tmp_path / "xy.txt"), "--output", str(tmp_path / "bench")]
    assert main([*words, *more]) == 2
    said = capsys.readouterr().err
    assert "found 4 loops" in said
    assert "3 loop 3 (ShackHartmann LGS3" in said
    for loop in ("3", "loop 3"):
        assert main([*words, "--loop", loop, *more]) == 0
        with pyrcal.fitting.recorded.opened(tmp_path / "bench" / "matrix.h5") as file:
            np.testing.assert_array_equal(file.find("interaction_matrix").read(), 3 * MATRIX)
            np.testing.assert_allclose(file.find("positions").read(), places)
    assert pyrcal.load_instrument(tmp_path / "bench" / "instrument.toml").wfs.n_subapertures == 6
    assert main([*words, "--loop", "5", *more]) == 2
    assert "--loop: found 5" in capsys.readouterr().err
    assert main([*words, "--loop", "3", "--output", str(tmp_path / "other")]) == 2
    assert "--positions FILE" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("width", [None, "x", 0, -1, True, 1e30, 1])
def test_speculas_pixels_are_counted_with_the_width_of_its_image(width, tmp_path):
    """One pixel of width would make hundreds of rows of subapertures."""
    pup = tmp_path / "pup.fits"
    shutil.copy(SPECULA[1], pup)
    with fits.open(pup, mode="update") as units:
        if width is None:
            units[0].header.remove("FSIZEY")
        else:
            units[0].header["FSIZEY"] = width
    with pytest.raises(MatrixError, match="fsizey"):
        from_specula([SPECULA[0], pup, SPECULA[2]], REPORTED)


def test_a_matrix_goes_back_into_speculas_own_files(tmp_path):
    """Shuffled subapertures: the Intmat that is written is the one that was read."""
    order = np.random.default_rng(9).permutation(len(fits.getdata(SPECULA[1], 1)))

    def shuffled(file):
        file[1].data = file[1].data[order]

    def matrix_too(file):
        both = np.stack(np.split(file[1].data, 2))
        file[1].data = both[:, order].reshape(file[1].data.shape)

    pup = changed(SPECULA[1], tmp_path / "pup.fits", shuffled)
    im = changed(SPECULA[0], tmp_path / "im.fits", matrix_too)
    matrix = from_specula([im, pup, SPECULA[2]], REPORTED).arrays["interaction_matrix"]
    inverse = np.linalg.pinv(matrix)
    files = tmp_path / "back_im.fits", tmp_path / "back_rec.fits"
    write_specula(pup, *files, matrix, inverse, stroke_known=True)
    back, given = fits.getdata(files[0], "INTMAT"), fits.getdata(im, 1)
    np.testing.assert_allclose(back, given, rtol=1e-6, atol=1e-7 * np.abs(given).max())
    identity = fits.getdata(files[1], 1).astype(float) @ back
    np.testing.assert_allclose(identity, np.eye(20), atol=1e-4)
    with pytest.raises(MatrixError, match="found 136 subapertures, expected the 135"):
        write_specula(pup, *files, matrix[:270], inverse, stroke_known=True)


def test_the_kind_of_sensor_is_that_of_its_subapertures():
    synim = [DATA / f"synim-{name}.fits" for name in ("im", "subap", "ifunc")]
    found = from_specula(synim, replace(REPORTED, sensor=None), "SynIM")
    assert found.tables["wfs"]["kind"] == "shack-hartmann"
    with pytest.raises(MatrixError, match="subapertures of a shack-hartmann"):
        from_specula(synim, replace(REPORTED, sensor="pyramid"))


def test_fewer_columns_than_actuators_must_be_explained(tmp_path):
    """Forty KL modes of 140 actuators are not the first forty actuators."""
    places = np.random.default_rng(10).normal(size=(9, 2))
    given = {"matrix": MATRIX, "valid": VALID, "positions": places}
    with pytest.raises(MatrixError, match="found 5 columns of 9 actuators"):
        from_arrays("it", given, REPORTED)
    modal = from_arrays("it", given, replace(REPORTED, basis="KL"))
    assert "basis" not in modal.tables["mirror"]
    assert modal.tables["modes"] == {"n_modes": 5}
    assert pyrcal.load_instrument(modal.save(tmp_path / "kl").instrument).modes.n_modes == 5
    some = np.array([0, 2, 3, 5, 8])
    zonal = from_arrays("it", given, replace(REPORTED, basis="zonal", columns=some))
    np.testing.assert_array_equal(zonal.arrays["modes"], some)
    with pytest.raises(MatrixError, match="--basis"):
        from_arrays("it", arrays(), replace(REPORTED, basis="KL"))
