"""Arrays of an instrument that a file describes: PAPYRUS' three files with one command."""

import os
import re
from pathlib import Path

import numpy as np
import pytest

import pyrcal
import pyrcal.fitting.recorded
from pyrcal.__main__ import main
from pyrcal.importers.described import from_described
from service.errors import ConfigurationError, MatrixError
from service.instrument import packaged_file
from tests.support.discs import four_discs

PAPYRUS = Path(os.environ.get("PYRCAL_BENCH_DATA", "../shared/data")) / "papyrus"

CENTRES = [(53.62, 53.06), (50.35, 183.12), (186.03, 55.68), (182.60, 187.29)]
LIT = four_discs(240, CENTRES, 74.0) > 0.5
RNG = np.random.default_rng(1)
FRAMES = (RNG.normal(size=(3, 240, 240)) * LIT).astype(np.float32)
STROKES = RNG.normal(size=(241, 8)).astype(">f4")


def arrays(**other):
    flat = FRAMES.reshape(3, -1).T
    return {"matrix": flat, "valid": LIT, "mode_to_actuator": STROKES, **other}


def imported(columns=(1, 5, 7), **other):
    return from_described("bench", arrays(**other), "papyrus", None, np.array(columns))


def test_a_folder_of_frames_mask_and_modes_is_one_command(tmp_path, capsys):
    folder = tmp_path / "data"
    folder.mkdir()
    for name, values in (("int_mat", FRAMES.reshape(3, -1).T), ("valid_pixel", LIT)):
        np.save(folder / f"{name}.npy", values)
    np.save(folder / "M2C.npy", STROKES)
    np.save(folder / "notes.npy", np.zeros(3))
    words = ["import", "files", str(folder), "--instrument", "papyrus", "--modes", "1,5,7"]
    assert main([*words, "--output", str(tmp_path / "bench")]) == 0
    assert "took" in capsys.readouterr().out
    instrument = pyrcal.load_instrument(tmp_path / "bench" / "instrument.toml")
    assert instrument.modes.n_modes == 8
    np.testing.assert_allclose(instrument.frames.centres_px, CENTRES, atol=0.05)
    assert instrument.frames.pixels_per_subaperture == 2
    with pyrcal.fitting.recorded.opened(tmp_path / "bench" / "matrix.h5") as file:
        np.testing.assert_array_equal(file.find("interaction_matrix").read(), FRAMES)
        np.testing.assert_array_equal(file.find("modes").read(), [1, 5, 7])


def test_the_modes_of_the_columns_may_stand_in_the_name_of_the_file(tmp_path, capsys):
    for name, values in (("int_mat_1_5_7", FRAMES.reshape(3, -1).T), ("valid_pixel", LIT)):
        np.save(tmp_path / f"{name}.npy", values)
    np.save(tmp_path / "M2C.npy", STROKES)
    words = ["import", "files", str(tmp_path), "--instrument", "papyrus"]
    assert main([*words, "--output", str(tmp_path / "bench")]) == 0
    assert "from the name of int_mat_1_5_7.npy: 1,5,7" in capsys.readouterr().out
    with pyrcal.fitting.recorded.opened(tmp_path / "bench" / "matrix.h5") as file:
        np.testing.assert_array_equal(file.find("modes").read(), [1, 5, 7])


def test_frames_of_lit_pixels_alone_are_put_into_their_frame():
    found = imported(matrix=FRAMES[:, LIT].T)
    np.testing.assert_array_equal(found.arrays["interaction_matrix"], FRAMES)


def test_columns_and_modes_that_cannot_be_used_are_named_and_left_out():
    broken, strokes = FRAMES.copy(), STROKES.copy()
    broken[1] = np.nan
    strokes[:, 2] = strokes[:, 0]
    found = imported(matrix=broken, mode_to_actuator=strokes)
    assert "column 1 is not finite: left out" in found.notes
    assert "mode 2 (of 0) is a copy: left out" in found.notes
    # modes 1 and 7 of eight, of which the third is gone
    np.testing.assert_array_equal(found.arrays["modes"], [1, 6])
    assert found.arrays["mode_to_actuator"].shape == (241, 7)
    assert found.arrays["interaction_matrix"].shape == (2, 240, 240)


def test_light_beside_the_centres_of_a_file_is_said(tmp_path):
    centres = [list(at) for at in CENTRES]
    frames = f'input = "frames"\npixels_per_subaperture = 2\npupil_centres_px = {centres}'
    text = packaged_file("papyrus").read_text("utf-8")
    text = re.sub(r"pupil_separation_subap.*", frames, text).replace('"papyrus"', '"bench"')
    path = tmp_path / "bench.toml"
    path.write_text(text, "utf-8")

    def notes(valid):
        found = from_described("bench", arrays(valid=valid), str(path), None, np.arange(3))
        return [note for note in found.notes if "pupil_centres_px" in note]

    (note,) = notes(np.roll(LIT, 1, axis=0))
    assert "0.5" in note
    assert not notes(LIT)


@pytest.mark.parametrize(
    ("other", "columns", "refusal", "says"),
    [
        ({}, (1, 5), ConfigurationError, "found 2 numbers"),
        ({}, (1, 5, 8), ConfigurationError, "expected numbers below 8"),
        ({"mode_to_actuator": STROKES[:200]}, (1, 5, 7), MatrixError, r"found shape \(200, 8\)"),
        ({"valid": LIT[:200]}, (1, 5, 7), MatrixError, r"expected a mask \(n, n\)"),
    ],
)
def test_what_does_not_belong_to_the_instrument_is_refused(other, columns, refusal, says):
    with pytest.raises(refusal, match=says):
        imported(columns, **other)


@pytest.mark.skipif(not PAPYRUS.is_dir(), reason="the measured data are not there")
def test_papyrus_is_imported_as_it_is(tmp_path):
    modes = "1,5,10,20,30,50,80,100,150"
    words = ["import", "files", str(PAPYRUS), "--instrument", "papyrus", "--modes", modes]
    assert main([*words, "--output", str(tmp_path / "bench")]) == 0
