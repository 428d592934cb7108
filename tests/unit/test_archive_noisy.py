"""Noisy interaction matrices that outlive the service, and never look like reconstructors."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from pyrcal.fitting.recorded import read_recorded
from service.archive import Archive
from service.archive.products import NoisyNumbers
from service.archive.serialisation import to_json
from service.errors import ArchiveError, UnknownIdError
from service.model.misregistration import Misregistration
from service.tracking.operation_records import MeasurementRecord, MeasureState, NoisyFinding
from service.wire import checksum

MATRIX = np.arange(12, dtype=np.float32).reshape(4, 3) * 1e6
NUMBERS = NoisyNumbers(
    matrix=MATRIX,
    noise=np.full((4, 3), 3e6, np.float32),
    synthetic=MATRIX + np.float32(1e5),
    optical_gain=np.array([0.5, 0.6, 0.7]),
    gain_sigma=np.array([0.1, 0.1, 0.2]),
    snr=np.array([1.0, 2.0, 3.0]),
)


def record_of(name="noisy-1", matrix=MATRIX, **changes):
    finding = NoisyFinding(
        n_slopes=4,
        n_frames=29_994,
        n_missing=6,
        snr=1.4,
        alpha=Misregistration(shift_x_subap=0.1, rotation_rad=0.003, magnification=1.002),
        covariance=np.diag([1e-4, 1e-4, 1e-7, 1e-6]),
        optical_gain=0.6,
        misfit=1.01,
        cm_id="cm-1",
        session="s-1",
        created_ns_utc=1_000,
        sha256=checksum(matrix),
    )
    record = MeasurementRecord(
        id=name,
        state=MeasureState.STORED,
        pattern=None,
        modes=(0, 7, 3),
        amplitude_m=(5e-9 / 3**0.5,) * 3,
        duration_s=30.0,
        window_s=5.0,
        seed=77,
        asked_ns_utc=900,
        basis_id="kl",
        config_id="b1",
        finding=finding,
    )
    return replace(record, **changes)


def product(tmp_path, name="noisy-1"):
    return tmp_path / "noisy_matrices" / f"{name}.h5"


def same(one, other):
    return to_json(one) == to_json(other)


def test_the_file_says_how_it_was_measured_and_what_it_says(archive, tmp_path):
    archive.noisy.store(record_of(), NUMBERS, "flao-lbt")
    with h5py.File(product(tmp_path)) as file:
        np.testing.assert_array_equal(file["interaction_matrix"], MATRIX)
        np.testing.assert_array_equal(file["element_noise"], NUMBERS.noise)
        np.testing.assert_array_equal(file["synthetic"], NUMBERS.synthetic)
        np.testing.assert_allclose(file["noise"], 3e6)
        found = dict(file.attrs)
    assert found["modes"].tolist() == [0, 7, 3]
    assert found["amplitude_m"] == pytest.approx(5e-9 / np.sqrt(3))
    assert (found["seed"], found["n_frames"], found["element_snr"]) == (77, 29_994, 1.4)
    assert (found["session"], found["basis_id"], found["cm_id"]) == ("s-1", "kl", "cm-1")
    assert found["rotation_deg"] == pytest.approx(np.rad2deg(0.003))


def test_a_fit_reads_it_like_any_measured_matrix(archive, tmp_path):
    archive.noisy.store(record_of(), NUMBERS, "flao-lbt")
    recorded = read_recorded(product(tmp_path))
    np.testing.assert_array_equal(recorded.values, MATRIX)
    assert recorded.modes.tolist() == [0, 7, 3]
    np.testing.assert_allclose(recorded.noise, 3e6)


def test_records_come_back_after_a_restart_oldest_first(tmp_path):
    later, older = record_of("a", asked_ns_utc=2), record_of("b", asked_ns_utc=1)
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
    archive.noisy.store(record_of(), NUMBERS, "flao-lbt")
    assert archive.reconstructors.records() == ()
    assert archive.measured.records() == ()
    for ask in (archive.reconstructors.matrix, archive.measured.matrix):
        with pytest.raises(UnknownIdError):
            ask("noisy-1")


@pytest.mark.parametrize(
    ("record", "numbers", "words"),
    [
        (record_of(modes=(0, 7)), NUMBERS, r"matrix of shape \(4, 3\), expected .* \(4, 2\)"),
        (record_of(), replace(NUMBERS, noise=NUMBERS.noise * np.nan), "found noise of shape"),
        (record_of(matrix=MATRIX + 1), NUMBERS, "found a matrix of checksum"),
        (record_of(finding=None), NUMBERS, "found it stored with nothing"),
        (record_of(state=MeasureState.RUNNING), NUMBERS, "found it running with a finding"),
    ],
)
def test_numbers_that_are_not_what_the_record_says_are_refused(archive, record, numbers, words):
    with pytest.raises(ArchiveError, match=words):
        archive.noisy.store(record, numbers, "flao-lbt")
    assert archive.noisy.records() == ()
