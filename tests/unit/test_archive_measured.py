"""Measured interaction matrices that outlive the service: real files and a real index."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from pyrcal.fitting.recorded import read_recorded
from service.archive import Archive
from service.archive.products import NoisyNumbers
from service.archive.serialisation import to_json
from service.errors import ArchiveError, UnknownIdError
from service.records.operations import MeasureState
from service.wire import Pattern, checksum
from tests.support.api_measured import NOISY, STORED

MATRIX = np.arange(12, dtype=np.float32).reshape(4, 3) * 1e6


def record_of(name="im-1", matrix=MATRIX, **changes):
    values = {"id": name, "pattern": Pattern.HADAMARD, "double_pass": True}
    return replace(STORED, **(values | {"sha256": checksum(matrix)} | changes))


def product(tmp_path, name="im-1"):
    folder = "noisy_matrices" if name.startswith("noisy") else "interaction_matrices"
    return tmp_path / folder / f"{name}.h5"


def test_the_file_says_how_the_matrix_was_measured(archive, tmp_path):
    archive.measured.store(record_of(), MATRIX, "flao-lbt")
    with h5py.File(product(tmp_path)) as file:
        np.testing.assert_array_equal(file["interaction_matrix"], MATRIX)
        found = dict(file.attrs)
    assert found["modes"].tolist() == [0, 7, 3]
    assert found["amplitude_m"].tolist() == [1e-8, 2e-8, 2e-8]
    assert (found["n_average"], found["pattern"], found["created_ns"]) == (5, "hadamard", 1_000)
    assert found["double_pass"].item() is True
    assert (found["session"], found["basis_id"], found["config_id"]) == ("s-1", "kl", "b1")
    assert (found["sha256"], found["instrument"]) == (checksum(MATRIX), "flao-lbt")


def test_the_file_cannot_be_written_to(archive, tmp_path):
    archive.measured.store(record_of(), MATRIX, "flao-lbt")
    assert product(tmp_path).stat().st_mode & 0o222 == 0


def test_the_download_is_the_file(archive, tmp_path):
    archive.measured.store(record_of(), MATRIX, "flao-lbt")
    assert archive.measured.file("im-1") == product(tmp_path)


def test_records_come_back_after_a_restart_oldest_first(tmp_path):
    with_lines = record_of(
        "b",
        created_ns_utc=2,
        pattern=Pattern.SINE,
        n_average=None,
        frequency_hz=(50.0, 60.0, 70.0),
        duration_s=10.0,
    )
    older = record_of("a", created_ns_utc=1)
    for record in (with_lines, older):
        archive = Archive(tmp_path)
        archive.open()
        with archive:
            archive.measured.store(record, MATRIX, "flao-lbt")
    archive = Archive(tmp_path)
    assert archive.open() == ()
    with archive:
        assert archive.measured.records() == (older, with_lines)


def test_the_same_matrix_again_changes_nothing(archive, tmp_path):
    archive.measured.store(record_of(), MATRIX, "flao-lbt")
    before = product(tmp_path).stat()
    archive.measured.store(record_of(), MATRIX, "flao-lbt")
    assert product(tmp_path).stat().st_mtime_ns == before.st_mtime_ns
    assert len(archive.measured.records()) == 1


def test_another_matrix_of_the_same_id_is_refused(archive):
    archive.measured.store(record_of(), MATRIX, "flao-lbt")
    other = MATRIX + 1
    with pytest.raises(ArchiveError, match="im-1: already stored"):
        archive.measured.store(record_of(matrix=other), other, "flao-lbt")
    assert archive.measured.matrix("im-1").tobytes() == MATRIX.tobytes()


@pytest.mark.parametrize(
    ("record", "matrix", "words"),
    [
        (record_of(n_slopes=5), MATRIX, r"shape \(4, 3\), expected a finite one of \(5, 3\)"),
        (record_of(modes=(0, 7)), MATRIX, r"expected a finite one of \(4, 2\)"),
        (record_of(), MATRIX * np.float32(np.nan), "expected a finite one"),
        (record_of(sha256="0" * 64), MATRIX, "expected 0000"),
    ],
)
def test_a_matrix_that_is_not_what_its_record_says_is_refused(archive, record, matrix, words):
    with pytest.raises(ArchiveError, match=words):
        archive.measured.store(record, matrix, "flao-lbt")
    assert archive.measured.records() == ()


def test_an_unknown_matrix_is_unknown(archive):
    for ask in (archive.measured.matrix, archive.measured.file):
        with pytest.raises(UnknownIdError, match="im-9"):
            ask("im-9")


def damage(path):
    path.chmod(0o644)
    data = path.read_bytes()
    place = data.find(MATRIX.tobytes())
    path.write_bytes(data[:place] + b"\x00\x00\x80\x3f" + data[place + 4 :])


def test_a_damaged_file_is_never_handed_out(archive, tmp_path):
    archive.measured.store(record_of(), MATRIX, "flao-lbt")
    damage(product(tmp_path))
    for ask in (archive.measured.matrix, archive.measured.file):
        with pytest.raises(ArchiveError, match="damaged"):
            ask("im-1")


def test_a_file_the_index_missed_is_taken_in_and_a_damaged_one_named(tmp_path):
    archive = Archive(tmp_path)
    archive.open()
    with archive:
        archive.measured.store(record_of("good"), MATRIX, "flao-lbt")
        archive.measured.store(record_of("bad"), MATRIX, "flao-lbt")
    damage(product(tmp_path, "bad"))
    (tmp_path / "index.sqlite").unlink()
    (tmp_path / "interaction_matrices" / "half.h5.part").write_bytes(b"half")
    archive = Archive(tmp_path)
    (line,) = archive.open()
    with archive:
        assert "bad.h5: damaged" in line
        assert archive.measured.records() == (record_of("good"),)
        assert not list(tmp_path.glob("*/*.part"))


# --- noisy interaction matrices that outlive the service, and never look like reconstructors


NUMBERS = NoisyNumbers(
    matrix=MATRIX,
    noise=np.full((4, 3), 3e6, np.float32),
    synthetic=MATRIX + np.float32(1e5),
    optical_gain=np.array([0.5, 0.6, 0.7]),
    gain_sigma=np.array([0.1, 0.1, 0.2]),
    snr=np.array([1.0, 2.0, 3.0]),
)


def noisy_record(matrix=MATRIX, **changes):
    finding = replace(NOISY.finding, sha256=checksum(matrix))
    return replace(NOISY, **({"finding": finding} | changes))


def same(one, other):
    return to_json(one) == to_json(other)


def test_the_file_says_how_it_was_measured_and_what_it_says(archive, tmp_path):
    archive.noisy.store(noisy_record(), NUMBERS, "flao-lbt")
    with h5py.File(product(tmp_path, "noisy-1")) as file:
        np.testing.assert_array_equal(file["interaction_matrix"], MATRIX)
        np.testing.assert_array_equal(file["element_noise"], NUMBERS.noise)
        np.testing.assert_array_equal(file["synthetic"], NUMBERS.synthetic)
        np.testing.assert_allclose(file["noise"], 3e6)
        found = dict(file.attrs)
    assert found["modes"].tolist() == [0, 7, 3]
    assert found["amplitude_m"] == pytest.approx(5e-9 / np.sqrt(3))
    assert (found["seed"], found["n_frames"], found["element_snr"]) == (77, 29_994, 1.4)
    assert (found["session"], found["basis_id"], found["cm_id"]) == ("s-1", "kl", "cm-1")
    assert found["rotation_deg"] == pytest.approx(0.2)


def test_a_fit_reads_it_like_any_measured_matrix(archive, tmp_path):
    archive.noisy.store(noisy_record(), NUMBERS, "flao-lbt")
    recorded = read_recorded(product(tmp_path, "noisy-1"))
    np.testing.assert_array_equal(recorded.values, MATRIX)
    assert recorded.modes.tolist() == [0, 7, 3]
    np.testing.assert_allclose(recorded.noise, 3e6)


def test_noisy_ones_come_back_in_the_order_they_were_asked_for(tmp_path):
    later, older = noisy_record(id="a", asked_ns_utc=2), noisy_record(id="b", asked_ns_utc=1)
    for record in (later, older):
        archive = Archive(tmp_path)
        archive.open()
        with archive:
            archive.noisy.store(record, NUMBERS, "flao-lbt")
    archive = Archive(tmp_path)
    assert archive.open() == ()
    with archive:
        found = archive.noisy.records()
    assert [record.id for record in found] == ["b", "a"]
    assert same(found[1], later)


def test_the_archive_of_reconstructors_does_not_know_it(archive, tmp_path):
    archive.noisy.store(noisy_record(), NUMBERS, "flao-lbt")
    assert archive.reconstructors.records() == ()
    assert archive.measured.records() == ()
    for ask in (archive.reconstructors.matrix, archive.measured.matrix):
        with pytest.raises(UnknownIdError):
            ask("noisy-1")


@pytest.mark.parametrize(
    ("record", "numbers", "words"),
    [
        (noisy_record(modes=(0, 7)), NUMBERS, r"matrix of shape \(4, 3\), expected .* \(4, 2\)"),
        (noisy_record(), replace(NUMBERS, noise=NUMBERS.noise * np.nan), "found noise of shape"),
        (noisy_record(matrix=MATRIX + 1), NUMBERS, "found a matrix of checksum"),
        (noisy_record(finding=None), NUMBERS, "found it stored with nothing"),
        (noisy_record(state=MeasureState.RUNNING), NUMBERS, "found it running with a finding"),
    ],
)
def test_numbers_that_are_not_what_the_record_says_are_refused(archive, record, numbers, words):
    with pytest.raises(ArchiveError, match=words):
        archive.noisy.store(record, numbers, "flao-lbt")
    assert archive.noisy.records() == ()
