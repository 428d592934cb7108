"""Files on a file system without locks, as NFS without a lock service is."""

import errno
import fcntl
import os

import h5py
import numpy as np
import pytest

from service.archive.archive import Archive
from service.errors import ConfigurationError, StorageError
from service.files.recording import RecordedKind, Recording, RecordingWriter
from service.files.whole import open_hdf5, write_whole
from service.web.keys import KeyFile, KeyScope


@pytest.fixture
def no_locks(monkeypatch):
    """flock answers ENOLCK, to Python and to HDF5, which leaves the file that it created."""

    def refuse(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    opened = h5py.File

    def open_file(name, mode="r", *, locking=None, **options):
        if isinstance(name, h5py.h5f.FileID) and not name.get_access_plist().get_file_locking()[0]:
            return opened(name)
        if locking is False:
            return opened(name, mode, locking=False, **options)
        opened(name, mode, **options).close()
        return refuse()

    monkeypatch.setattr(fcntl, "flock", refuse)
    monkeypatch.setattr("service.files.whole.h5py.File", open_file)


@pytest.mark.usefixtures("no_locks")
def test_a_recording_is_written_and_read(tmp_path):
    path = tmp_path / "r.h5"
    with RecordingWriter(path, system="bench") as recorder:
        recorder.put(RecordedKind.LIVELINESS, b"\x01")
    with Recording(path) as recording:
        assert [one.payload for one in recording.messages()] == [b"\x01"]
    with pytest.raises(ConfigurationError, match="exists already"):
        RecordingWriter(path, system="bench").__enter__()


@pytest.mark.usefixtures("no_locks")
def test_a_file_is_written_whole(tmp_path):
    path = tmp_path / "fit.h5"
    write_whole(path, lambda file: file.create_dataset("x", data=np.arange(3)))
    with open_hdf5(path) as file:
        assert file["x"][2] == 2
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("no_locks")
def test_what_needs_locks_names_folder_and_remedy(tmp_path):
    """Keys, and the folder of a service: two programs that write them spoil them."""
    for use in (
        lambda: KeyFile(tmp_path).add("ada", KeyScope.OPERATE),
        lambda: Archive(tmp_path).open(),
    ):
        with pytest.raises(StorageError) as refused:
            use()
        assert str(tmp_path) in str(refused.value)
        assert os.strerror(errno.ENOLCK) in str(refused.value)


def test_a_file_that_exists_is_not_created_again(tmp_path):
    with open_hdf5(tmp_path / "a.h5", "x"):
        pass
    with pytest.raises(FileExistsError):
        open_hdf5(tmp_path / "a.h5", "x")
