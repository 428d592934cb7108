"""Measured interaction matrices that outlive the service: real files and a real index."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from service.archive import Archive
from service.errors import ArchiveError, UnknownIdError
from service.tracking.operation_records import MeasurementRecord, MeasureState
from service.wire import Pattern, checksum

MATRIX = np.arange(12, dtype=np.float32).reshape(4, 3) * 1e6


def record_of(name="im-1", matrix=MATRIX, **changes):
    record = MeasurementRecord(
        id=name,
        state=MeasureState.STORED,
        pattern=Pattern.HADAMARD,
        modes=(0, 7, 3),
        amplitude_m=(1e-8, 2e-8, 2e-8),
        n_average=5,
        created_ns_utc=1_000,
        n_slopes=4,
        double_pass=True,
        session="s-1",
        basis_id="kl",
        config_id="b1",
        sha256=checksum(matrix),
    )
    return replace(record, **changes)


def product(tmp_path, name="im-1"):
    return tmp_path / "interaction_matrices" / f"{name}.h5"


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
