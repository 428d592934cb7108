"""The formats of 1.0 are read for good: ``tests/data/archive`` is a folder that 1.0 has written."""

import contextlib
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.archive import Archive, AuditEntry
from service.archive.serialisation import TrackingFile
from service.errors import ArchiveError
from service.records.operations import AcquisitionStage, MeasureState
from service.records.products import MatrixState
from service.records.registration import ModeGain
from service.records.state import Mode, Orders
from service.wire import Pattern

WRITTEN = Path(__file__).parents[1] / "data" / "archive"


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(WRITTEN, tmp_path / "var")
    return tmp_path / "var"


@pytest.fixture
def archive(folder):
    archive = Archive(folder)
    assert archive.open() == ()
    with archive:
        yield archive


def test_reconstructors_are_what_they_were(archive):
    bare, made = archive.reconstructors.records()
    assert (bare.id, bare.state, bare.n_modes) == ("rtc-7", MatrixState.SUPERSEDED, 400)
    assert bare.alpha is bare.sigma is bare.gate is None
    assert (made.id, made.state, made.parent) == ("cm-1", MatrixState.APPLIED, "cm-0")
    assert (made.applied_frame_seq, made.published_ns_utc) == (77, 5)
    assert made.alpha.shift_x_subap == 0.2
    np.testing.assert_allclose(made.alpha.vector, [0.2, 0.0, np.deg2rad(0.3), 1.01], rtol=1e-14)
    np.testing.assert_allclose(made.sigma, [0.01, 0.02, np.deg2rad(0.03), 0.004], rtol=1e-14)
    assert made.gate.worst_pole_radius == float("inf")
    assert made.gate.reason == "unstable at +3 sigma: measure longer"
    assert made.optical_gains == (
        ModeGain(mode=2, gain=0.61, sigma=0.02, scatter=0.03, t_ns_utc=7),
    )
    np.testing.assert_array_equal(
        archive.reconstructors.matrix("cm-1"), np.arange(12.0).reshape(3, 4)
    )


def test_they_are_what_they_were_without_the_index_too(archive, folder):
    (with_index,) = (record for record in archive.reconstructors.records() if record.id == "cm-1")
    archive.close()
    for leftover in folder.glob("index.sqlite*"):
        leftover.unlink()
    (told,) = archive.open()
    assert "rebuilt from 1 products" in told
    (made,) = archive.reconstructors.records()
    assert (made.state, made.gate) == (MatrixState.APPLIED, with_index.gate)
    np.testing.assert_array_equal(made.alpha.vector, with_index.alpha.vector)


def test_measured_matrices_are_what_they_were(archive):
    first, second = archive.measured.records()
    assert (first.id, first.pattern, first.modes) == ("im-1", Pattern.HADAMARD, (0, 7, 3))
    assert (first.state, first.n_average, first.double_pass) == (MeasureState.STORED, 5, True)
    assert (second.pattern, second.frequency_hz) == (Pattern.SINE, (50.0, 60.0, 70.0))
    assert archive.measured.matrix("im-1").shape == (4, 3)
    assert archive.measured.file("im-2").read_bytes().startswith(b"\x89HDF")


def test_noisy_matrices_are_what_they_were(archive):
    first, second = archive.noisy.records()
    assert (first.id, first.state, first.modes) == ("noisy-1", MeasureState.STORED, (0, 7, 3))
    np.testing.assert_allclose(first.finding.alpha.vector, [0.1, 0.0, 0.003, 1.002], rtol=1e-14)
    np.testing.assert_allclose(
        first.finding.covariance, np.diag([1e-4, 1e-4, 1e-7, 1e-6]), rtol=1e-14
    )
    assert second.finding.alpha is second.finding.covariance is None
    assert archive.noisy.file("noisy-1").read_bytes().startswith(b"\x89HDF")


def test_the_audit_trail_is_there(archive):
    assert archive.audit_trail() == (
        AuditEntry(t_ns_utc=3, who="operator", name="mode", text="auto α", id=1),
    )


def test_the_audit_trail_goes_on_in_the_same_file(archive, folder):
    order = AuditEntry(
        t_ns_utc=4,
        who="Ada",
        name="Reject.refused",
        text='{"id":"cm-1"}',
        address="10.0.0.7",
        channel="page",
        why="too many modes",
        answer="cm-1 is discarded, not proposed",
    )
    archive.record((), (order,))
    archive.close()
    assert archive.open() == ()
    assert archive.audit_trail()[1] == replace(order, id=2)


def test_the_registration_and_its_bias_are_what_they_were(archive):
    saved = archive.tracking.read()
    assert saved.orders == Orders(mode=Mode.HOLD, settings_mode=Mode.AUTO, dither_stopped=True)
    known = saved.registration
    assert known.covariance.shape == (4, 4)
    assert known.pointing.elevation_deg == 61.0
    assert [gain.mode for gain in known.optical_gains] == [501, 509, 517, 525]
    assert known.bias.excess[0] > 0.0
    assert len(known.bias.loop) > 3
    assert np.array_equal(known.grown, np.zeros(4))


def test_an_acquisition_under_way_is_what_it_was(folder):
    saved = TrackingFile(folder / "acquiring.json").read()
    assert saved.registration is None
    assert saved.acquisition.stage is AcquisitionStage.COARSE
    assert saved.acquisition.found.gains == (0.4,) * 400 + (0.0,) * 194
    assert saved.acquisition.interruption.session == "s2"


def test_an_index_of_before_the_first_release_is_refused_and_left_as_it_is(folder):
    with contextlib.closing(sqlite3.connect(folder / "index.sqlite")) as connection:
        connection.execute("PRAGMA user_version = 4")
    before = (folder / "index.sqlite").read_bytes()
    with pytest.raises(ArchiveError, match="found version 4"):
        Archive(folder).open()
    assert (folder / "index.sqlite").read_bytes() == before
