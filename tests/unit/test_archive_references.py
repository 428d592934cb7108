"""Reference slopes in the archive: kept with their fate, and read back as they were sent."""

import sqlite3
from dataclasses import replace

import numpy as np
import pytest

from service.archive import Archive
from service.errors import ArchiveError, UnknownIdError
from service.model.misregistration import Misregistration
from service.records.products import MatrixState, ReferencesRecord
from service.wire import checksum

OFFSET = np.linspace(-0.1, 0.1, 24).astype(np.float32)
RECORD = ReferencesRecord(
    id="ref-1",
    state=MatrixState.PROPOSED,
    created_ns_utc=5,
    shape="shape-1",
    coefficients_m=(0.0, 6e-8),
    alpha=Misregistration(shift_x_subap=0.1),
    gain=0.6,
    sha256=checksum(OFFSET),
)


@pytest.fixture
def archive(tmp_path):
    with Archive(tmp_path) as archive:
        archive.open()
        archive.references.store(RECORD, OFFSET)
        yield archive


def test_an_offset_comes_back_with_its_record(archive):
    np.testing.assert_array_equal(archive.references.matrix("ref-1"), OFFSET)
    (record,) = archive.references.records()
    assert (record.coefficients_m, record.alpha, record.gain) == ((0.0, 6e-8), RECORD.alpha, 0.6)


def test_what_became_of_references_outlives_the_index(archive, tmp_path):
    used = replace(RECORD, state=MatrixState.APPLIED, applied_ns_utc=9)
    archive.record((used,), ())
    archive.close()
    (tmp_path / "index.sqlite").unlink()
    with Archive(tmp_path) as again:
        again.open()
        (record,) = again.references.records()
        assert (record.state, record.applied_ns_utc) == (MatrixState.APPLIED, 9)


def test_other_numbers_than_the_record_says_are_refused(archive):
    with pytest.raises(ArchiveError, match="checksum"):
        archive.references.store(replace(RECORD, id="ref-2"), 2.0 * OFFSET)


def test_an_archive_from_before_references_is_listed(archive, tmp_path):
    archive.close()
    with sqlite3.connect(tmp_path / "index.sqlite") as index:
        index.execute("DROP TABLE reference_slopes")
    with Archive(tmp_path) as again:
        again.look()
        assert again.references.records() == ()
        with pytest.raises(UnknownIdError):
            again.references.matrix("ref-1")
