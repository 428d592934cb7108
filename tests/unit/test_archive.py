"""Products that outlive the service: real files, a real index, real processes killed on the way."""

import asyncio
import contextlib
import hashlib
import json
import os
import random
import re
import resource
import signal
import sqlite3
import stat
import subprocess
import sys
import threading
import time
from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from service.archive import Archive, AuditEntry, Pin, Range
from service.archive.nights import TREND_S, TrendSample
from service.archive.serialisation import TrackingFile
from service.errors import ArchiveError, StorageError, UnknownIdError, WireError
from service.estimation.frames import FrameBlock
from service.model.misregistration import Misregistration
from service.records import commands as cmd
from service.records.products import (
    Assessment,
    ExpectedGain,
    Judged,
    MatrixState,
    ModeAnswer,
    ModeProof,
    ReconstructorRecord,
)
from service.records.registration import MeasuredGains, ModeGain, Registration
from service.records.state import Mode, Orders
from service.runtime import telemetry_recorder as of_moments
from service.runtime.telemetry_recorder import TrendSampler, residual_of, sample_of
from service.tracking.resume import saved_of
from service.web.keys import KeyFile, KeyScope
from service.wire import Pointing, checksum
from tests.support.acquiring import Acquiring
from tests.support.api import ALPHA, SECOND, SIGMA, STATE
from tests.support.archived import MATRIX, product, record_of
from tests.support.situations import START_NS, Story, moved
from tests.support.states import changed
from tests.support.watchdog import learnt, watch


def assert_same(found: ReconstructorRecord, expected: ReconstructorRecord) -> None:
    if expected.alpha is None:
        assert found.alpha is found.sigma is None
    else:
        np.testing.assert_allclose(found.alpha.vector, expected.alpha.vector, rtol=1e-14)
        np.testing.assert_allclose(found.sigma, expected.sigma, rtol=1e-14)
    for name in set(ReconstructorRecord.__slots__) - {"alpha", "sigma"}:
        assert getattr(found, name) == getattr(expected, name), name


@pytest.fixture
def archive(tmp_path):
    archive = Archive(tmp_path / "data" / "var")
    archive.open()
    with archive:
        yield archive


def damage(path):
    path.chmod(0o644)
    data = bytearray(path.read_bytes())
    place = data.find(MATRIX.tobytes())
    data[place : place + 4] = b"\x00\x00\x80\x3f"
    path.write_bytes(data)


def test_making_an_archive_touches_nothing(tmp_path):
    Archive(tmp_path / "var")
    assert list(tmp_path.iterdir()) == []


def test_the_folders_it_makes_are_its_owners_alone(tmp_path):
    with contextlib.closing(Archive(tmp_path / "var")) as archive:
        archive.open()
        KeyFile(tmp_path / "of-keys").add("ada", KeyScope.READ)
        made = [path for path in tmp_path.rglob("*") if path.is_dir()]
        assert len(made) >= 6
        assert {stat.S_IMODE(path.stat().st_mode) for path in made} == {0o700}


def test_an_archive_that_is_not_open_says_so(tmp_path):
    with pytest.raises(ArchiveError, match="not open"):
        Archive(tmp_path / "var").reconstructors.records()


def test_a_stored_matrix_comes_back_bit_for_bit(archive):
    matrix = np.random.default_rng(1).normal(size=(3, 50)).astype(np.float32)
    archive.reconstructors.store(record_of(), np.asfortranarray(matrix), np.eye(4), {})
    found = archive.reconstructors.matrix("cm-1")
    assert found.dtype == np.float32
    assert found.tobytes() == matrix.tobytes()


def test_records_come_back_after_a_restart_oldest_first(tmp_path):
    newer, older = record_of("b", created_ns_utc=2), record_of("a", created_ns_utc=1)
    for record in (newer, older):
        archive = Archive(tmp_path)
        archive.open()
        with archive:
            archive.reconstructors.store(record, MATRIX, None, {})
    archive = Archive(tmp_path)
    assert archive.open() == ()
    with archive:
        found = archive.reconstructors.records()
        assert [r.id for r in found] == ["a", "b"]
        assert_same(found[0], older)
        np.testing.assert_array_equal(archive.reconstructors.matrix("b"), MATRIX)


def test_a_record_without_registration_or_verdict_comes_back_as_it_was(archive):
    bare = ReconstructorRecord(id="rtc-7", state=MatrixState.APPLIED, n_modes=400, created_ns_utc=5)
    archive.record((bare,), ())
    assert_same(archive.reconstructors.records()[0], bare)


def test_what_a_verdict_was_of_is_not_kept_and_must_be_found_out_anew(archive):
    then = Judged(
        session="s1",
        gains=(0.4,) * 3,
        leak=0.999,
        delay_frames=2.0,
        alpha=Misregistration(),
        sigma=np.full(4, 1e-3),
    )
    archive.record((record_of(judged=then),), ())
    assert_same(archive.reconstructors.records()[0], record_of())


def test_an_update_changes_the_index_but_not_the_product(archive):
    archive.reconstructors.store(record_of(), MATRIX, None, {})
    before = product(archive).read_bytes()
    applied = record_of(state=MatrixState.APPLIED, applied_frame_seq=77, published_ns_utc=5)
    archive.record((applied,), ())
    assert_same(archive.reconstructors.records()[0], applied)
    assert product(archive).read_bytes() == before
    np.testing.assert_array_equal(archive.reconstructors.matrix("cm-1"), MATRIX)


def test_the_file_says_what_it_is_with_units_in_its_names(archive):
    covariance = np.diag([1e-4, 4e-4, np.deg2rad(0.03) ** 2, 1e-6])
    archive.reconstructors.store(
        record_of(), MATRIX, covariance, {"instrument": "flao-lbt", "n_frames": 5000}
    )
    with h5py.File(product(archive)) as file:
        assert file["reconstructor"].shape == (3, 4)
        assert file["reconstructor"].dtype == np.dtype("<f4")
        attributes = file.attrs
        assert attributes["id"] == "cm-1"
        assert attributes["parent"] == "cm-0"
        assert attributes["shift_x_subap"] == 0.2
        assert attributes["rotation_deg"] == pytest.approx(0.3)
        assert attributes["sigma_rotation_deg"] == pytest.approx(0.03)
        assert attributes["sha256"] == checksum(MATRIX)
        assert attributes["software_version"]
        assert file["covariance"][2, 2] == pytest.approx(0.03**2)
        assert list(file["covariance"].attrs["parameters"])[2] == "rotation_deg"
        assert dict(file["provenance"].attrs) == {"instrument": "flao-lbt", "n_frames": 5000}


def test_an_id_is_never_reused(archive):
    archive.reconstructors.store(record_of(), MATRIX, None, {})
    with pytest.raises(ArchiveError, match="cm-1: already stored, ids are never reused"):
        archive.reconstructors.store(record_of(), MATRIX + 1, None, {})
    np.testing.assert_array_equal(archive.reconstructors.matrix("cm-1"), MATRIX)


def test_a_record_may_be_known_before_its_matrix_is_stored(archive):
    archive.record((record_of(state=MatrixState.REFUSED),), ())
    archive.reconstructors.store(record_of(), MATRIX, None, {})
    assert [r.state for r in archive.reconstructors.records()] == [MatrixState.PROPOSED]
    np.testing.assert_array_equal(archive.reconstructors.matrix("cm-1"), MATRIX)


@pytest.mark.parametrize(
    ("record", "matrix", "expected"),
    [
        (
            record_of(n_modes=5),
            MATRIX,
            r"shape \(3, 4\), expected a finite one of \(5, 4",
        ),
        (record_of(), MATRIX[0], r"shape \(4,\)"),
        (record_of(), np.full((3, 4), np.nan, np.float32), "finite"),
        (record_of(sha256="0" * 64), MATRIX, f"expected {'0' * 64}"),
    ],
)
def test_a_matrix_that_is_not_what_its_record_says_is_not_stored(archive, record, matrix, expected):
    with pytest.raises(ArchiveError, match=expected):
        archive.reconstructors.store(record, matrix, None, {})
    assert archive.reconstructors.records() == ()
    assert list(product(archive).parent.iterdir()) == []


@pytest.mark.parametrize("matrix_id", ["../escape", "a/b", "", "current"])
def test_an_id_that_is_no_id_never_becomes_a_file_name(archive, matrix_id):
    with pytest.raises(WireError):
        archive.reconstructors.store(record_of(matrix_id), MATRIX, None, {})


@pytest.mark.parametrize("matrix_id", ["nobody", "../index", "rtc-7"])
def test_a_matrix_that_was_never_stored_is_unknown(archive, matrix_id):
    archive.record((record_of("rtc-7"),), ())
    with pytest.raises(UnknownIdError, match=f"{matrix_id}: no such matrix in the archive"):
        archive.reconstructors.matrix(matrix_id)


# --- damage


def test_a_changed_byte_is_found_by_the_checksum_and_the_rest_goes_on(archive):
    archive.reconstructors.store(record_of("bad"), MATRIX, None, {})
    archive.reconstructors.store(record_of("good"), MATRIX, None, {})
    damage(product(archive, "bad"))
    with pytest.raises(ArchiveError, match=r"bad\.h5: damaged: found checksum"):
        archive.reconstructors.matrix("bad")
    np.testing.assert_array_equal(archive.reconstructors.matrix("good"), MATRIX)


@pytest.mark.parametrize("keep", [0, 100, 2000])
def test_a_truncated_file_is_named(archive, keep):
    archive.reconstructors.store(record_of(), MATRIX, None, {})
    path = product(archive)
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ArchiveError, match=r"cm-1\.h5: damaged"):
        archive.reconstructors.matrix("cm-1")


def test_a_missing_file_is_named(archive):
    archive.reconstructors.store(record_of(), MATRIX, None, {})
    product(archive).unlink()
    with pytest.raises(ArchiveError, match=r"cm-1\.h5: missing, although it was stored"):
        archive.reconstructors.matrix("cm-1")


def test_the_numbers_of_a_damaged_file_may_be_stored_again_and_no_others(archive):
    archive.reconstructors.store(record_of(), MATRIX, None, {})
    damage(product(archive))
    with pytest.raises(ArchiveError, match="ids are never reused"):
        archive.reconstructors.store(record_of(), MATRIX + 1, None, {})
    archive.reconstructors.store(record_of(), MATRIX, None, {})
    np.testing.assert_array_equal(archive.reconstructors.matrix("cm-1"), MATRIX)


def test_a_damaged_file_that_no_index_knows_is_put_aside_for_what_comes_under_its_id(tmp_path):
    archive = Archive(tmp_path)
    archive.open()
    with archive:
        archive.reconstructors.store(record_of(), MATRIX, None, {})
        damage(product(archive))
    for leftover in tmp_path.glob("index.sqlite*"):
        leftover.unlink()
    archive.open()
    with archive:
        archive.reconstructors.store(record_of(), MATRIX, None, {})
        np.testing.assert_array_equal(archive.reconstructors.matrix("cm-1"), MATRIX)
        assert product(archive).with_suffix(".damaged").exists()


def test_a_lost_index_is_made_anew_from_the_sound_products(tmp_path):
    archive = Archive(tmp_path)
    archive.open()
    with archive:
        for name in ("a", "b", "c", "d"):
            archive.reconstructors.store(record_of(name), MATRIX, None, {})
        damage(product(archive, "a"))
        product(archive, "b").rename(product(archive, "z"))
        product(archive, "c").chmod(0o644)
        product(archive, "c").write_bytes(b"not HDF5")
    for leftover in tmp_path.glob("index.sqlite*"):
        leftover.unlink()
    damaged = archive.open()
    with archive:
        assert [r.id for r in archive.reconstructors.records()] == ["d"]
        np.testing.assert_array_equal(archive.reconstructors.matrix("d"), MATRIX)
    assert len(damaged) == 4
    assert "rebuilt from 1 products" in damaged[3]
    assert "a.h5: damaged: found checksum" in damaged[0]
    assert "c.h5: damaged" in damaged[1]
    assert "z.h5: found reconstructor b in it, expected z" in damaged[2]


def test_a_damaged_index_is_refused_with_what_to_do(tmp_path):
    (tmp_path / "index.sqlite").write_bytes(b"no database at all, but long enough to look" * 50)
    with pytest.raises(ArchiveError, match=r"index\.sqlite: damaged .*move it away"):
        Archive(tmp_path).open()


def test_an_index_of_a_later_version_is_refused_by_name_and_left_as_it_is(tmp_path):
    path = tmp_path / "index.sqlite"
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 99")
        connection.execute("CREATE TABLE audit (t_ns_utc INTEGER)")
    connection.close()
    before = path.read_bytes()
    with pytest.raises(ArchiveError, match=r"found version 99, .*nothing has been changed"):
        Archive(tmp_path).open()
    assert path.read_bytes() == before
    assert not list(tmp_path.glob("index.sqlite-*"))


def test_a_directory_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "var").write_text("a file")
    with pytest.raises(ArchiveError, match="var: cannot be used"):
        Archive(tmp_path / "var").open()


@contextlib.contextmanager
def full_disk():
    """No file of this process may grow, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("is_new", [True, False])
def test_on_a_full_disk_it_is_open_and_records_as_soon_as_there_is_room(tmp_path, is_new):
    if not is_new:
        with contextlib.closing(Archive(tmp_path)) as before:
            before.open()
            before.reconstructors.store(record_of("cm-1"), MATRIX, None, {})
    entry = AuditEntry(t_ns_utc=5, who="ada", name="Stop", text="")
    with contextlib.closing(Archive(tmp_path)) as archive:
        with full_disk():
            assert len(archive.open()) == 1
            assert len(archive.reconstructors.records()) == (not is_new)
            assert archive.nights.between(0, 100) == ()
            for _ in range(2):
                with pytest.raises(StorageError, match="cannot be"):
                    archive.record((), (entry,))
            with pytest.raises(StorageError, match="cannot be"):
                archive.index.pin(Pin(id="cm-1", who="ada", why=""))
        archive.record((), (entry,))
        assert [line.who for line in archive.audit_trail()] == ["ada"]
        archive.reconstructors.store(record_of("cm-2"), MATRIX, None, {})
    with contextlib.closing(Archive(tmp_path)) as after:
        assert after.open() == ()
        assert {record.id for record in after.reconstructors.records()} >= {"cm-2"}
        assert [line.name for line in after.audit_trail()] == ["Stop"]


def test_an_index_that_cannot_be_opened_is_named(tmp_path):
    (tmp_path / "index.sqlite").mkdir()
    with pytest.raises(ArchiveError, match=r"index\.sqlite: cannot be opened"):
        Archive(tmp_path).open()


def test_two_services_cannot_share_a_directory(archive):
    second = Archive(archive.directory)
    with pytest.raises(ArchiveError, match="in use by another service"):
        second.open()
    archive.close()
    second.open()
    second.close()


# --- what is wrong is told at the start, and costs no more than itself


def restart(archive):
    """Close it, as after a restart, and return what the next start tells."""
    archive.close()
    return archive.open()


def test_a_missing_and_a_cut_product_are_told_at_the_start(archive):
    for name in ("cm-1", "cm-2", "cm-3"):
        archive.reconstructors.store(record_of(name), MATRIX, None, {})
    archive.record((record_of("cm-2", state=MatrixState.SUPERSEDED),), ())
    product(archive, "cm-1").unlink()
    cut = product(archive, "cm-2")
    cut.chmod(0o644)
    cut.write_bytes(cut.read_bytes()[:-100])
    told = restart(archive)
    assert len(told) == 2
    assert "cm-1.h5: missing, although it was stored" in told[0]
    assert "cm-2.h5: damaged" in told[1]
    first, second, third = archive.reconstructors.records()
    assert first.state is second.state is MatrixState.FAILED
    assert "missing" in first.reason
    assert "superseded" in second.reason
    assert_same(third, record_of("cm-3"))


def test_a_product_that_is_there_again_is_what_it_was(archive, tmp_path):
    archive.reconstructors.store(record_of(), MATRIX, None, {})
    product(archive).rename(tmp_path / "away.h5")
    assert restart(archive)
    (tmp_path / "away.h5").rename(product(archive))
    assert restart(archive) == ()
    assert_same(archive.reconstructors.records()[0], record_of())


def test_a_record_nobody_understands_is_taken_from_its_product(archive):
    archive.reconstructors.store(record_of(), MATRIX, None, {})
    archive.reconstructors.store(record_of("cm-2", created_ns_utc=2_000), MATRIX, None, {})
    archive.index._connection.execute("UPDATE reconstructor SET record = '{' WHERE id = 'cm-1'")
    (told,) = restart(archive)
    assert "record of reconstructor cm-1 not understood" in told
    assert [record.id for record in archive.reconstructors.records()] == ["cm-1", "cm-2"]


def test_a_record_nobody_understands_and_without_a_product_is_left_out_and_told(archive):
    archive.record((record_of(),), ())
    archive.reconstructors.store(record_of("cm-2"), MATRIX, None, {})
    archive.index._connection.execute("UPDATE reconstructor SET record = '{' WHERE id = 'cm-1'")
    (told,) = restart(archive)
    assert "record of reconstructor cm-1 not understood" in told
    assert [record.id for record in archive.reconstructors.records()] == ["cm-2"]


@pytest.mark.parametrize("folder", ["reconstructors", "interaction_matrices", "noisy_matrices"])
@pytest.mark.parametrize("name", ["old.h5.part", "old.h5"])
def test_a_folder_where_a_file_should_be_is_told_and_left_alone(archive, folder, name):
    made = archive.directory / folder / name
    made.mkdir()
    (told,) = restart(archive)
    assert str(made) in told
    assert made.is_dir()


def test_a_lost_index_is_made_anew_with_what_became_of_every_matrix(archive):
    became = {
        "a": MatrixState.APPLIED,
        "b": MatrixState.REJECTED,
        "c": MatrixState.DISCARDED,
        "d": MatrixState.SUPERSEDED,
    }
    for name, state in became.items():
        archive.reconstructors.store(record_of(name), MATRIX, None, {})
        archive.record(
            (record_of(name, state=state, reason=f"it was {state}", published_ns_utc=7),), ()
        )
    archive.close()
    for leftover in archive.directory.glob("index.sqlite*"):
        leftover.unlink()
    (told,) = archive.open()
    assert "index.sqlite: missing; rebuilt from 4 products" in told
    found = {record.id: record for record in archive.reconstructors.records()}
    assert {name: record.state for name, record in found.items()} == became
    assert found["b"].reason == "it was rejected"
    assert found["b"].published_ns_utc == 7


def test_of_a_matrix_whose_fate_is_lost_with_the_index_it_is_said(archive):
    archive.reconstructors.store(record_of(), MATRIX, None, {})
    archive.record((record_of(state=MatrixState.APPLIED),), ())
    archive.close()
    for leftover in archive.directory.glob("index.sqlite*"):
        leftover.unlink()
    for fate in product(archive).parent.glob("*.json"):
        fate.write_text("{")
    archive.open()
    (record,) = archive.reconstructors.records()
    assert record.state is MatrixState.DISCARDED


def test_a_measurement_nobody_understands_does_not_refuse_the_start(archive):
    archive.index._connection.execute("INSERT INTO measurement VALUES ('im-1', 1, '{', 'x')")
    (told,) = restart(archive)
    assert "record of measurement im-1 not understood" in told
    assert archive.measured.records() == ()


# --- audit trail


def note(archive, t_ns_utc, text):
    entry = AuditEntry(t_ns_utc=t_ns_utc, who="operator", name="mode.set", text=text)
    archive.record((), (entry,))


def test_the_audit_trail_keeps_the_last_entries_oldest_first(archive):
    for i in range(5):
        archive.record(
            (), (AuditEntry(t_ns_utc=i, who="operator", name="mode.set", text=f"entry {i}"),)
        )
    assert archive.audit_trail(Range(limit=2)) == (
        AuditEntry(t_ns_utc=3, who="operator", name="mode.set", text="entry 3", id=4),
        AuditEntry(t_ns_utc=4, who="operator", name="mode.set", text="entry 4", id=5),
    )
    assert len(archive.audit_trail()) == 5


def test_a_part_of_the_audit_trail_is_a_time_or_what_follows_an_entry(archive):
    for i in range(6):
        note(archive, 10 * i, f"entry {i}")

    def texts(**part):
        return [entry.text for entry in archive.audit_trail(Range(**part))]

    assert texts(since_ns=20, until_ns=40) == ["entry 2", "entry 3", "entry 4"]
    assert texts(after=0, limit=2) == ["entry 0", "entry 1"]
    assert texts(after=2, limit=2) == ["entry 2", "entry 3"]
    assert texts(after=6) == []


def test_nothing_in_it_acts_on_a_terminal(archive):
    note(archive, 1, "a\x1b[2Jb\nc \ud800 α")
    (entry,) = archive.audit_trail()
    assert entry.text == r"a\x1b[2Jb\nc \ud800 α"


@pytest.mark.parametrize("statement", ["DELETE FROM audit", "UPDATE audit SET who = 'nobody'"])
def test_the_audit_trail_only_grows(archive, statement):
    note(archive, 1, "auto")
    with pytest.raises(sqlite3.IntegrityError, match="only grows"):
        archive.index._connection.execute(statement)
    assert len(archive.audit_trail()) == 1


def test_calls_from_several_threads_queue_up(archive):
    def work(k):
        archive.reconstructors.store(record_of(f"cm-{k}"), MATRIX + k, None, {})
        note(archive, k, f"cm-{k}")

    threads = [threading.Thread(target=work, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(archive.reconstructors.records()) == len(archive.audit_trail()) == 8
    for k in range(8):
        np.testing.assert_array_equal(archive.reconstructors.matrix(f"cm-{k}"), MATRIX + k)


# --- a service that dies

WRITER = """
import sys
from pathlib import Path
import numpy as np
from service.archive import Archive, AuditEntry, Pin, Range
from service.records.products import Judged, MatrixState, ReconstructorRecord

archive = Archive(Path(sys.argv[1]))
archive.open()
matrix = np.random.default_rng(1).normal(size=(400, 1384)).astype(np.float32)
for k in range(100_000):
    record = ReconstructorRecord(
        id=f"cm-{k:06d}", state=MatrixState.PROPOSED, n_modes=400, created_ns_utc=k
    )
    archive.reconstructors.store(record, matrix, None, {})
    archive.record((), (AuditEntry(t_ns_utc=k, who="service", name="stored", text=record.id),))
    print(record.id, flush=True)
"""


def start_writer(directory, before=""):
    told = (directory / "told.txt").open("w")
    complaint = (directory / "complaint.txt").open("w")
    with told, complaint:
        return subprocess.Popen(
            [sys.executable, "-c", before + WRITER, str(directory / "var")],
            stdout=told,
            stderr=complaint,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        )


def assert_nothing_told_is_lost(directory):
    told = (directory / "told.txt").read_text().split()
    archive = Archive(directory / "var")
    assert archive.open() == ()
    with archive:
        found = [record.id for record in archive.reconstructors.records()]
        assert told == found[: len(told)]
        assert len(found) <= len(told) + 1
        for matrix_id in found:
            assert archive.reconstructors.matrix(matrix_id).shape == (400, 1384)
        assert {path.stem for path in product(archive).parent.iterdir()} == set(found)
        return found


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_service_killed_while_it_writes_loses_nothing_it_was_told_is_stored(tmp_path, seed):
    writer = start_writer(tmp_path)
    deadline = time.monotonic() + 20
    while (tmp_path / "told.txt").read_text().count("\n") < 2:
        assert time.monotonic() < deadline, (tmp_path / "complaint.txt").read_text()
        time.sleep(0.01)
    time.sleep(random.Random(seed).uniform(0.0, 0.05))
    writer.send_signal(signal.SIGKILL)
    writer.wait(timeout=20)
    assert len(assert_nothing_told_is_lost(tmp_path)) >= 2


DIE = "import os, signal\ndie = lambda *_: os.kill(os.getpid(), signal.SIGKILL)\n"


@pytest.mark.parametrize(
    ("death", "found"),
    [
        ("import service.files.whole as w; w.flush = die\n", []),
        ("import service.archive.index as i; i.Index.add = die\n", ["cm-000000"]),
        ("import service.archive.index as i; i.Index.record = die\n", ["cm-000000"]),
    ],
    ids=["before the file has its name", "before the index", "before the audit trail"],
)
def test_a_service_killed_between_two_steps_finds_all_or_nothing(tmp_path, death, found):
    writer = start_writer(tmp_path, before=DIE + death)
    assert writer.wait(timeout=20) == -signal.SIGKILL
    assert assert_nothing_told_is_lost(tmp_path) == found


def test_a_product_that_did_not_reach_the_index_is_taken_in_at_the_next_start(tmp_path):
    archive = Archive(tmp_path)
    archive.open()
    with archive:
        archive.reconstructors.store(record_of(), MATRIX, None, {})
        archive.index._connection.execute("DELETE FROM reconstructor")
        (product(archive).parent / "cm-2.h5.part").write_bytes(b"half")
    assert archive.open() == ()
    with archive:
        assert_same(archive.reconstructors.records()[0], record_of())
        assert os.listdir(product(archive).parent) == ["cm-1.h5"]


def test_a_disk_that_refuses_leaves_nothing_behind(tmp_path):
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n"
    writer = start_writer(tmp_path, before=limit)
    assert writer.wait(timeout=20) == 1
    complaint = (tmp_path / "complaint.txt").read_text()
    assert "StorageError" in complaint
    assert "cm-000000.h5: cannot be written" in complaint
    assert assert_nothing_told_is_lost(tmp_path) == []


# --- what is left for the next service


DATA = Path(__file__).parents[1] / "data" / "archive"


@pytest.fixture(scope="module")
def saved():
    """What a night with windows, looks and a known pointing has left."""
    story = Story(Mode.AUTO).meet()
    story.state = changed(story.state, pointing=Pointing(elevation_deg=61.0, azimuth_deg=120.0))
    story.see(n_windows=3, modes=(501, 509, 517, 525), gain_sigma=np.full(4, 0.01))
    learnt(story, n_looks=3)
    watch(story, moved(shift_x_subap=0.06))
    return saved_of(story.state, story.now_ns)


@pytest.fixture
def file(tmp_path):
    return TrackingFile(tmp_path / "tracking.json")


def same(one, other):
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    if hasattr(one, "__dataclass_fields__"):
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


def test_there_is_nothing_before_the_first_night(file):
    assert file.read() is None


def test_what_is_read_is_what_was_written_but_for_what_depends_on_the_time(file, saved):
    file.write(saved)
    found = file.read()
    fresh = {
        f.name: f.default for f in fields(Registration) if f.name in {"validity", "suspected_jump"}
    }
    expected = replace(saved, registration=replace(saved.registration, grown=np.zeros(4), **fresh))
    for f in fields(Registration):
        left, right = getattr(found.registration, f.name), getattr(expected.registration, f.name)
        assert same(left, right), f.name
    assert same(found, expected)
    assert found.registration.bias is not None
    assert len(found.registration.optical_gains) == 4


def test_what_modes_have_shown_is_read_as_it_was_written(file, saved):
    proof = ModeProof(
        proven=frozenset(range(400)),
        suspected=frozenset({430}),
        answers=(ModeAnswer(mode=430, gain=-0.6, like=77),),
        own_uneven="by the RTC's own matrix mode 3 2.1 times as strongly as its neighbours",
        own_response_ratio=0.7,
    )
    file.write(replace(saved, mode_proof=proof))
    assert file.read().mode_proof == proof


@pytest.fixture(scope="module")
def cut_off():
    """What a service has left that ended while its loop was open."""
    story = Acquiring()
    story.tell(cmd.Acquire())
    story.open()
    return saved_of(story.state, story.now_ns)


def test_an_acquisition_under_way_is_read_as_it_was_written(file, cut_off):
    file.write(cut_off)
    found = file.read()
    assert found.registration is None
    # who began it is known to that service alone
    assert cut_off.acquisition.cause
    assert same(found, replace(cut_off, acquisition=replace(cut_off.acquisition, cause="")))
    assert found.acquisition.found.gains == (0.4,) * 400 + (0.0,) * 194
    assert found.acquisition.interruption.session == "s2"
    assert found.acquisition.interruption.cause == "the service ended"


def test_that_an_operator_ended_one_is_read_as_it_was_written(file, cut_off):
    file.write(replace(cut_off, acquisition=replace(cut_off.acquisition, held_off=True)))
    assert file.read().acquisition.held_off is True


@pytest.mark.parametrize(
    "values",
    [
        {"stage": "lost"},
        {"attempt": "two"},
        {"found": {"gains": [0.4, None]}},
        {"interruption": {"doing": "coarse"}},
        {"shoe_size": 43},
    ],
)
def test_a_damaged_acquisition_is_no_acquisition(file, cut_off, tmp_path, values):
    file.write(cut_off)
    path = tmp_path / "tracking.json"
    found = content_of(path.read_text())
    found["acquisition"] |= values
    path.write_text(signed(found))
    with pytest.raises(ArchiveError, match="damaged"):
        file.read()


def content_of(text):
    """Return what a file says besides its checksum."""
    return {name: value for name, value in json.loads(text).items() if name != "sha256"}


def signed(values):
    """Return the text of a file whose checksum is right."""
    return json.dumps(values | {"sha256": hashlib.sha256(json.dumps(values).encode()).hexdigest()})


ORDERS = Orders(mode=Mode.HOLD, settings_mode=Mode.AUTO, dither_stopped=True)


def test_orders_are_read_as_they_were_given(file, saved):
    file.write(replace(saved, orders=ORDERS))
    assert file.read().orders == ORDERS
    assert file.read().orders.mode is Mode.HOLD


def test_orders_alone_are_worth_a_file(file, saved):
    file.write(replace(saved, registration=None, orders=ORDERS))
    found = file.read()
    assert (found.registration, found.orders) == (None, ORDERS)


@pytest.mark.parametrize(
    "values",
    [{"mode": "fast"}, {"mode": None}, {"dither_stopped": "no"}, {"shoe_size": 43}],
)
def test_damaged_orders_are_none(file, saved, tmp_path, values):
    file.write(replace(saved, orders=ORDERS))
    path = tmp_path / "tracking.json"
    found = content_of(path.read_text())
    found["orders"] |= values
    path.write_text(signed(found))
    with pytest.raises(ArchiveError, match="damaged, moved to"):
        file.read()


def test_the_newest_replaces_what_was_there(file, saved, tmp_path):
    file.write(saved)
    file.write(replace(saved, saved_ns_utc=START_NS + 1))
    assert file.read().saved_ns_utc == START_NS + 1
    assert [path.name for path in tmp_path.iterdir()] == ["tracking.json"]


@pytest.mark.parametrize(("was", "became"), [('"alpha": [0', '"alpha": [1'), ("HOLD", "AUTO")])
def test_one_digit_or_word_that_has_changed_is_damage(file, saved, tmp_path, was, became):
    file.write(replace(saved, orders=ORDERS))
    path = tmp_path / "tracking.json"
    text = path.read_text()
    changed = re.sub(was.replace("[", "\\["), became, text, count=1, flags=re.IGNORECASE)
    assert changed != text
    path.write_text(changed)
    with pytest.raises(ArchiveError, match="found checksum"):
        file.read()


def altered(**values):
    def change(text):
        return signed({**content_of(text), **values})

    return change


def with_registration(**values):
    def change(text):
        found = content_of(text)
        found["registration"] |= values
        return signed(found)

    return change


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: "[]",
        altered(version=7),
        altered(registration=None),
        altered(shoe_size=43),
        with_registration(alpha=[0.1, 0.2, 0.3]),
        with_registration(alpha=[0.1, 0.2, float("nan"), 1.0]),
        with_registration(covariance=np.diag([1.0, 1.0, -1.0, 1.0]).tolist()),
        with_registration(t_ns_utc="yesterday"),
        with_registration(optical_gains=[{"mode": 3}]),
    ],
)
def test_a_damaged_file_is_put_aside_and_the_next_can_be_written(file, saved, tmp_path, damage):
    file.write(saved)
    path = tmp_path / "tracking.json"
    path.write_text(damage(path.read_text()))
    with pytest.raises(ArchiveError, match="damaged, moved to"):
        file.read()
    assert sorted(found.name for found in tmp_path.iterdir()) == ["tracking.damaged"]
    assert file.read() is None
    file.write(saved)
    assert file.read() is not None


def test_a_disk_that_refuses_is_named(tmp_path, saved):
    with pytest.raises(ArchiveError, match="cannot be written"):
        TrackingFile(tmp_path / "nowhere" / "tracking.json").write(saved)


def test_it_lies_in_the_archives_directory(tmp_path, saved):
    with Archive(tmp_path) as archive:
        archive.open()
        archive.tracking.write(saved)
    assert (tmp_path / "tracking.json").exists()


# --- trends


FULL = TrendSample(
    t_ns_utc=SECOND,
    telemetry_ns_utc=7,
    alpha=ALPHA,
    sigma=SIGMA,
    wavefront_m=6e-8,
    residual_m=5e-8,
    margin=0.9,
    optical_gain=0.5,
    n_controlled=400,
    magnitude=11.5,
    flux=3.25,
    elevation_deg=61.0,
    azimuth_deg=-12.0,
    gains=MeasuredGains(
        measured=(ModeGain(mode=3, gain=0.5, sigma=0.01, scatter=0.02, t_ns_utc=7),),
        n_modes=600,
        magnitude=11.5,
    ),
)


def at(t_s, **changes):
    return replace(FULL, t_ns_utc=round(t_s * SECOND), **changes)


def test_a_sample_comes_back_as_it_was(archive):
    nothing = TrendSample(t_ns_utc=2 * SECOND)
    archive.record((), (), (), (FULL, nothing))
    full, bare = archive.nights.samples(0, 2 * SECOND, 10)
    assert isinstance(full.n_controlled, int)
    assert bare == nothing or bare.alpha is bare.sigma is bare.residual_m is None
    assert archive.nights.gains(0, SECOND, 10) == (FULL.gains,)
    for field in (field for field in fields(TrendSample) if field.name != "gains"):
        ours, theirs = getattr(full, field.name), getattr(FULL, field.name)
        if isinstance(theirs, Misregistration):
            ours, theirs = ours.vector, theirs.vector
        np.testing.assert_allclose(ours, theirs, rtol=1e-14, err_msg=field.name)


def test_of_many_the_worst_and_the_ends_remain(archive):
    night = [at(15 * k, residual_m=9e-7 if k == 777 else 5e-8) for k in range(3000)]
    archive.record((), (), (), night)
    found = archive.nights.samples(0, 10**18, 200)
    assert 100 <= len(found) <= 200
    assert found[-1].t_ns_utc == night[-1].t_ns_utc
    assert max(one.residual_m for one in found) == 9e-7
    gaps = np.diff([one.t_ns_utc for one in found]) / SECOND
    assert gaps.max() <= 2 * 15 * 3000 / 200 * 1.5


def block(slopes, cm_id="cm-1", t0_ns=5 * SECOND):
    n = len(slopes)
    return FrameBlock(
        session="s-1",
        first_seq=0,
        t0_ns_utc=t0_ns,
        dt_ns=1_000_000,
        slopes=slopes.astype(np.float32),
        commands_m=np.zeros((n, 2), np.float32),
        dither_m=None,
        cm_id=cm_id,
    )


def test_the_residual_is_what_the_matrix_reads_in_the_slopes():
    matrix = np.array([[1e-7, 0.0, 0.0], [0.0, 2e-7, 0.0]], np.float32)
    slopes = np.array([[0.3, 0.2, 9.0], [-0.3, -0.2, 9.0]], np.float32)
    assert residual_of(slopes, matrix) == pytest.approx(5e-8), "3 and 4 at right angles"
    assert residual_of(slopes[:, :2], matrix) is None


def test_what_is_known_is_in_the_sample():
    expected = ExpectedGain(loss_m=1e-8, wavefront_m=5e-8, pole_radius=0.8, fresh_pole_radius=0.8)
    gains = tuple(ModeGain(mode=k, gain=g, sigma=0.1, scatter=0.1, t_ns_utc=1) for k, g in
                  enumerate((0.4, 0.6)))  # fmt: skip
    state = changed(
        STATE,
        registration=replace(STATE.alpha.registration, optical_gains=gains),
        assessment=Assessment(id="rtc-0", alpha=ALPHA, expected=expected, t_ns_utc=1),
        pointing=Pointing(elevation_deg=61.0, azimuth_deg=120.0),
        rtc=replace(STATE.loop.rtc, magnitude=11.0, flux=np.full(4, 2.5, "<f4").tobytes()),
    )
    found = sample_of(state, 9, 8, 7e-8)
    assert (found.t_ns_utc, found.telemetry_ns_utc, found.residual_m) == (9, 8, 7e-8)
    assert found.wavefront_m == pytest.approx(6e-8)
    assert found.margin == pytest.approx(0.8 / 0.95)
    assert found.optical_gain == pytest.approx(0.5)
    assert (found.n_controlled, found.magnitude, found.flux) == (400, 11.0, 2.5)
    assert (found.elevation_deg, found.azimuth_deg) == (61.0, 120.0)
    np.testing.assert_array_equal(found.sigma, state.alpha.registration.sigma)
    another = changed(state, in_use="cm-9")
    assert sample_of(another, 9, 8, None).wavefront_m is None, "it is of another matrix"


async def test_telemetry_and_gains_that_stand_are_none(monkeypatch):
    monkeypatch.setattr(of_moments, "TREND_S", 0.001)
    taken, frames = [], block(np.ones((4, 3)), cm_id="cm-1")
    gain = ModeGain(mode=3, gain=0.5, sigma=0.01, scatter=0.02, t_ns_utc=7)
    known = replace(STATE.alpha.registration, optical_gains=(gain,))

    def unknown(_):
        raise ArchiveError("nobody has its numbers")

    sampler = TrendSampler(
        state=lambda: changed(STATE, registration=known),
        frames=lambda: frames,
        matrix=unknown,
        keep=taken.append,
    )
    running = asyncio.create_task(sampler.run())
    async with asyncio.timeout(5.0):
        while len(taken) < 3:  # noqa: ASYNC110 - as it goes on
            await asyncio.sleep(0.001)
    running.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await running
    ends = [one.telemetry_ns_utc for one in taken[:3]]
    assert ends == [5 * SECOND + 4_000_000, None, None]
    assert taken[0].residual_m is None
    assert [one.gains and one.gains.measured for one in taken[:3]] == [(gain,), None, None]


async def test_the_trends_are_answered_with_how_far_apart_they_are(client, service):
    service.archive.record((), (), (), [at(15 * k) for k in range(100)])
    told = (await client.get("/v1/trends", params={"since_ns": 15 * SECOND})).json()
    assert (len(told["samples"]), told["interval_s"]) == (99, TREND_S)
    first = told["samples"][0]
    assert first["t_utc"] == "1970-01-01T00:00:15.000000Z"
    assert first["alpha"]["rotation_deg"] == pytest.approx(0.3)
    thin = (await client.get("/v1/trends", params={"points": 8})).json()
    assert len(thin["samples"]) <= 8
    assert thin["interval_s"] > 15 * 100 / 8


PATHS = ("trends", "nights", "marks", "annotations", "audit", "alpha/history")


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("query", ["since=0020-01-01T00:00:00Z", "until=9999-01-01T00:00:00Z"])
async def test_a_time_that_no_clock_here_can_have_is_refused_with_those_that_can(
    client, path, query
):
    told = await client.get(f"/v1/{path}?{query}")
    assert told.status_code == 422, told.text
    expected = "expected a time from 1970-01-01T00:00:00Z to 2262-04-11T23:47:16Z"
    assert expected in told.json()["detail"]


@pytest.mark.parametrize("path", ["trends", "nights", "marks", "annotations"])
async def test_the_first_and_the_last_time_there_can_be_are_answered(client, path):
    query = "since=1970-01-01T00:00:00Z&until=2262-04-11T23:47:16Z"
    assert (await client.get(f"/v1/{path}?{query}")).status_code == 200
