"""A calibration as one file comes back as it was written, or not at all."""

import h5py
import numpy as np
import pytest

from pyrcal.__main__ import main
from service.archive import Archive
from service.errors import ConfigurationError, MatrixError
from service.files.bundle import DESCRIBED, Bundle, read_bundle, write_bundle
from service.model.misregistration import Misregistration
from service.records.products import MatrixState, ReconstructorRecord
from service.wire import checksum

RNG = np.random.default_rng(1)
ARRAYS = {
    "reconstructor": RNG.normal(size=(6, 20)).astype(np.float32),
    "interaction_matrix": RNG.normal(size=(20, 6)).astype(np.float32),
    "reference_slopes": RNG.normal(size=20).astype(np.float32),
    "reference_offset": RNG.normal(size=20).astype(np.float32),
    "optical_gain": RNG.uniform(0.5, 1.0, 6),
    "gain_factor": RNG.uniform(1.0, 2.0, 6),
    "mode_to_actuator": RNG.normal(size=(9, 6)),
    "covariance": np.diag([1e-4, 2e-4, 3e-4, 1e-6]),
}
BUNDLE = Bundle(id="cm-1", arrays=ARRAYS, facts={"alpha": {"rotation_deg": 0.3}, "why": "é"})
ENDINGS = ["h5", "fits"]


def assert_same(found, expected):
    assert (found.id, found.facts, found.sha256) == (expected.id, expected.facts, expected.sha256)
    assert found.arrays.keys() == expected.arrays.keys()
    for name, values in expected.arrays.items():
        assert found.arrays[name].dtype == values.dtype
        assert found.arrays[name].tobytes() == values.tobytes(), name


def written(folder, ending, bundle=BUNDLE):
    if ending == "fits":
        pytest.importorskip("astropy")
    path = folder / f"it.{ending}"
    write_bundle(path, bundle)
    return path


@pytest.mark.parametrize("ending", ENDINGS)
def test_it_comes_back_as_it_was(tmp_path, ending):
    assert set(ARRAYS) == set(DESCRIBED)
    assert_same(read_bundle(written(tmp_path, ending)), BUNDLE)


@pytest.mark.parametrize("ending", ENDINGS)
def test_from_one_kind_of_file_to_the_other_and_back_nothing_changes(tmp_path, ending):
    there, back = written(tmp_path, ending), tmp_path / "back"
    other = ENDINGS[1 - ENDINGS.index(ending)]
    back.mkdir()
    assert_same(read_bundle(written(back, other, read_bundle(there))), BUNDLE)


@pytest.mark.parametrize("name", [*ARRAYS, "manifest"])
@pytest.mark.parametrize("ending", ENDINGS)
def test_one_flipped_bit_is_refused_by_the_name_of_its_array(tmp_path, ending, name):
    path = written(tmp_path, ending)
    data = bytearray(path.read_bytes())
    if name == "manifest":
        at = data.index(b'"why"') + 10
    else:
        kept = ARRAYS[name].astype(
            ARRAYS[name].dtype.newbyteorder(">" if ending == "fits" else "<")
        )
        at = data.index(kept.tobytes()[:8]) + 1
    data[at] ^= 1
    path.chmod(0o644)
    path.write_bytes(data)
    with pytest.raises(MatrixError, match=f"{name} is not as it was written"):
        read_bundle(path)


@pytest.mark.parametrize("what", ["missing", "more", "version", "no bundle"])
def test_what_is_no_whole_bundle_is_refused(tmp_path, what):
    path = written(tmp_path, "h5")
    path.chmod(0o644)
    with h5py.File(path, "r+") as file:
        if what == "missing":
            del file["gain_factor"]
        elif what == "more":
            file["another"] = np.zeros(3)
        elif what == "no bundle":
            del file["manifest"]
        else:
            text = file["manifest"][()].tobytes().replace(b'"version": 1', b'"version": 7')
            del file["manifest"]
            file["manifest"] = np.frombuffer(text, np.uint8)
    expected = {
        "missing": "gain_factor is missing",
        "more": "found another, not in its manifest",
        "version": "version 7, expected pyrcal-bundle of version 1",
        "no bundle": "expected a bundle's manifest",
    }
    with pytest.raises(MatrixError, match=expected[what]):
        read_bundle(path)


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        ({}, "no reconstructor"),
        ({"reconstructor": np.zeros((2, 3)), "other": np.zeros(2)}, "found other"),
        ({"reconstructor": np.full((2, 3), np.nan)}, "finite"),
        ({"reconstructor": np.zeros(3)}, r"shape \(3,\)"),
        ({"reconstructor": np.zeros((2, 3), int)}, "found int64"),
    ],
)
def test_what_is_none_is_not_written(tmp_path, arrays, expected):
    with pytest.raises(MatrixError, match=expected):
        write_bundle(tmp_path / "it.h5", Bundle(id="cm-1", arrays=arrays, facts={}))
    assert not list(tmp_path.iterdir())


def test_one_that_is_there_is_never_written_over(tmp_path):
    written(tmp_path, "h5")
    with pytest.raises(ConfigurationError, match="never overwritten"):
        write_bundle(tmp_path / "it.h5", BUNDLE)


@pytest.fixture
def archive(tmp_path):
    matrix = RNG.normal(size=(60, 224)).astype(np.float32)
    record = ReconstructorRecord(
        id="cm-9",
        state=MatrixState.APPLIED,
        n_modes=60,
        created_ns_utc=1,
        alpha=Misregistration(shift_x_subap=0.1),
        sha256=checksum(matrix),
    )
    with Archive(tmp_path / "data") as opened:
        opened.open()
        opened.reconstructors.store(record, matrix, np.eye(4), {"instrument": "small"})
        opened.record((record,), ())
    return tmp_path, matrix


def test_what_is_in_use_is_written_from_the_archive_and_checked(archive, capsys):
    folder, matrix = archive
    words = ["--data-dir", str(folder / "data"), "--instrument", "tests/system/small.toml"]
    assert main(["bundle", "write", "in-use", str(folder / "it.h5"), *words]) == 0
    product = folder / "data" / "reconstructors" / "cm-9.h5"
    assert main(["bundle", "write", str(product), str(folder / "same.h5"), *words]) == 0
    found = read_bundle(folder / "it.h5")
    np.testing.assert_array_equal(found.arrays["reconstructor"], matrix)
    assert found.arrays["mode_to_actuator"].shape[1] == 90
    assert found.facts["record"]["alpha"]["shift_x_subap"] == 0.1
    assert main(["bundle", "check", str(folder / "same.h5")]) == 0
    assert "sound; cm-9 of small" in capsys.readouterr().out


def test_of_another_instrument_or_of_none_it_is_refused_in_a_line(archive, capsys):
    folder, _ = archive
    words = ["--data-dir", str(folder / "data"), "--instrument"]
    target = str(folder / "it.h5")
    assert main(["bundle", "write", "in-use", target, *words, "flao-lbt"]) == 2
    assert main(["bundle", "write", "cm-7", target, *words, "tests/system/small.toml"]) == 2
    assert main(["bundle", "check", str(folder / "data" / "lock")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert "was made for small; found the instrument flao-lbt" in lines[0]
    assert "cm-7: no such reconstructor" in lines[1]
    assert len(lines) == 3
