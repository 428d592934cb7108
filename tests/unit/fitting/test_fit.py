import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import structlog

from pyrcal.__main__ import main
from pyrcal.fitting import fit
from pyrcal.fitting.fit_file import fit_file
from tests.data.tiny.make import ALPHA
from tests.support.fit_keys import KEYS

DATA = Path(__file__).parents[2] / "data" / "tiny"
TINY, MATRIX = str(DATA / "tiny.toml"), str(DATA / "tiny.h5")


@pytest.fixture(autouse=True)
def empty_folder(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True)
def nobody_elses_log():
    """Leave out what a thread that an earlier test has left behind may still log."""

    def dropped(*_):
        raise structlog.DropEvent

    structlog.configure(processors=[dropped])


FITTED = {}


def fitted_once(instrument, path, options, *, dataset, **_):
    """The same fit of the same file, made once for all tests."""
    content = Path(path).read_bytes() if Path(path).is_file() else None
    key = (path, content, repr(options), dataset)
    if key not in FITTED:
        FITTED[key] = fit_file(instrument, path, options, dataset=dataset)
    return FITTED[key]


@pytest.fixture
def run(capsys, monkeypatch):
    """Run ``pyrcal fit`` with few modes; return the status and both streams."""
    monkeypatch.setattr(fit, "fit_file", fitted_once)

    def go(*words, modes="0:20"):
        status = main(["fit", TINY, *map(str, words), "--modes", modes])
        return status, *capsys.readouterr()

    return go


@pytest.fixture(scope="module")
def matrix():
    with h5py.File(MATRIX, "r") as file:
        return np.asarray(file["interaction_matrix"][()], dtype=np.float64)


def stored(values, name="interaction_matrix", path="im.h5"):
    with h5py.File(path, "w") as file:
        file[name] = values
    return path


def test_json_is_one_object_with_the_keys_promised_and_nothing_else(run):
    status, out, err = run(MATRIX, "--json")
    assert status == 0
    assert out.endswith("}\n")
    found = json.loads(out)
    assert set(found) == KEYS
    assert found["n_modes_used"] == len(found["gains"]) == 20
    assert np.array(found["covariance"]).shape == (4, 4)
    assert abs(found["rotation_deg"] - ALPHA["rotation_deg"]) < 0.1
    lines = err.splitlines()
    assert all(line.startswith("note: ") for line in lines), "progress is for terminals"


def test_without_json_it_is_a_table_that_begins_with_what_to_do_and_the_verdict(run):
    status, out, _ = run(MATRIX)
    assert status == 0
    first, second, *_ = out.splitlines()
    assert first.startswith("use it")
    assert second.startswith("accepted")
    assert "shift x" in out


def test_a_refused_fit_is_status_1_with_all_its_numbers(run, matrix):
    status, out, _ = run(stored(matrix / 2), "--json")
    found = json.loads(out)
    assert status == 1
    assert found["verdict"].startswith("refused")
    assert "double_pass" in found["verdict"]
    assert set(found) == KEYS


def test_holes_are_left_out_and_named(run, matrix):
    holed = matrix.copy()
    holed[:, 5], holed[:, 12] = np.nan, 0.0
    status, out, _ = run(stored(holed), "--json")
    found = json.loads(out)
    assert status == 0
    assert found["n_modes_used"] == 18
    assert "not finite: mode 5" in found["verdict"]
    assert "dead (no response): mode 12" in found["verdict"]


@pytest.mark.parametrize("method", ["paper", "sensitivity"])
def test_every_method_comes_to_the_same_place(run, method):
    status, out, _ = run(MATRIX, "--json", "--method", method)
    found = json.loads(out)
    assert status == 0
    assert abs(found["shift_x_subap"] - ALPHA["shift_x_subap"]) < 0.03
    assert abs(found["magnification"] - ALPHA["magnification"]) < 0.004


def test_the_papers_method_prints_its_table(run):
    _, out, _ = run(MATRIX, "--method", "paper")
    lines = out[out.index("step  parameter") :].splitlines()[1:11]
    units = {(line[6:21].strip(), line.split()[-1]) for line in lines}
    assert units == {
        ("shift x", "subapertures"),
        ("shift y", "subapertures"),
        ("rotation", "deg"),
        ("magnification", "ratio"),
    }


def test_a_start_may_begin_with_a_negative_number(run):
    status, out, _ = run(MATRIX, "--json", "--start", "-0.2,0.1,64,1.0")
    assert status == 0
    assert abs(json.loads(out)["shift_x_subap"] - ALPHA["shift_x_subap"]) < 0.03


def test_more_unknowns_are_told_in_the_table(run):
    _, out, _ = run(MATRIX, "--gain-map", "--anamorphosis")
    assert "anamorphosis" in out
    assert "gain over the pupil" in out


def test_without_an_anamorphosis_the_file_is_believed(run):
    _, out, _ = run(MATRIX, "--json", "--no-anamorphosis")
    assert json.loads(out)["anamorphosis_sigma"] is None


def test_what_was_found_is_kept_and_drawn_on_request(run):
    pytest.importorskip("matplotlib")
    status, _, _ = run(MATRIX, "--output", "fit.h5", "--plot", "fit.png")
    assert status == 0
    assert Path("fit.png").read_bytes().startswith(b"\x89PNG")
    with h5py.File("fit.h5", "r") as file:
        assert file["measured"].shape == (224, 20)
        assert json.loads(file.attrs["document"])["verdict"].startswith("accepted")


def test_another_name_and_byte_order_are_no_matter(run, matrix):
    plain = json.loads(run(MATRIX, "--json")[1])
    big = json.loads(run(stored(matrix.astype(">f4"), "D"), "--json", "--dataset", "D")[1])
    assert big["shift_x_subap"] == pytest.approx(plain["shift_x_subap"], abs=1e-9)


def test_a_fits_file_is_fitted(run, matrix):
    fits = pytest.importorskip("astropy.io.fits")
    fits.PrimaryHDU(matrix.astype(">f4")).writeto("im.fits")
    status, out, _ = run("im.fits", "--json")
    assert status == 0
    assert abs(json.loads(out)["rotation_deg"] - ALPHA["rotation_deg"]) < 0.1


def test_notes_go_beside_the_answer(run, matrix):
    path = stored(matrix)
    with h5py.File(path, "a") as file:
        file.attrs["modes"] = np.arange(40)
    _, out, err = run(path, "--json")
    json.loads(out)
    assert err.startswith("note: columns belong to the 40 modes")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda m: m.T, "transposed"),
        (lambda m: m[:-2], "found shape (222, 40)"),
        (lambda m: m * 1e-9, "per nanometre"),
        (lambda m: m * np.nan, "no usable column"),
        (lambda m: m[:, 0], "found shape (224,)"),
        (lambda m: np.hstack([m, m]), "found modes 0 to 79"),
        (lambda m: m[:, :10], "modes"),
    ],
)
def test_a_matrix_that_cannot_be_used_is_one_sentence_and_status_2(capsys, matrix, change, said):
    path = stored(change(matrix))
    words = ["--modes", "30:40"] if said == "modes" else []
    assert main(["fit", TINY, path, "--json", *words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("pyrcal: ")
    assert err.count("\n") == 1
    assert said in err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("none.h5",), "No such file"),
        ((MATRIX, "--dataset", "D"), "it holds interaction_matrix (224, 40)"),
        ((MATRIX, "--plot", "none/fit.png"), "found no folder none"),
        ((MATRIX, "--output", "none/fit.h5"), "found no folder none"),
        ((TINY,), "expected HDF5, FITS, NumPy or MATLAB"),
    ],
)
def test_other_input_that_cannot_be_used_is_one_sentence_and_status_2(run, words, said):
    status, out, err = run(*words)
    assert (status, out) == (2, "")
    assert err.startswith("pyrcal: ")
    assert err.count("\n") == 1
    assert said in err


@pytest.mark.parametrize(
    "words", [("--modes", "3:1"), ("--start", "1,2"), ("--method", "guess"), ("--threads", "0")]
)
def test_an_option_that_means_nothing_is_named(capsys, words):
    with pytest.raises(SystemExit) as end:
        main(["fit", TINY, MATRIX, *words])
    assert end.value.code == 2
    assert words[0] in capsys.readouterr().err


def test_a_reference_for_the_light_wants_the_light(run):
    status, _, err = run(MATRIX, "--arms", "0.9:90,210,330")
    assert status == 2
    assert "expected --flux-map" in err
