"""A power cut leaves the file before or the new one, whole: the disk forgets what was not flushed.

The disk here is the real one; what a cut would leave is kept beside: contents as of the last flush
of a file, names as of the last flush of their folder.
"""

import os
from pathlib import Path

import pytest

from service.archive.products import _write_sidecar
from service.errors import StorageError
from service.files.durable import replace_file
from service.files.whole import write_whole
from service.web.keys import KeyFile, KeyScope


class Disk:
    """What would be found in a folder after a power cut."""

    def __init__(self, folder, monkeypatch):
        self.folder, self.contents, self.names = folder, {}, {}
        self.left = []
        for path in folder.iterdir():
            self._flushed(path)
        self._flushed(folder)
        fsync, replace, rename = os.fsync, Path.replace, Path.rename
        monkeypatch.setattr(os, "fsync", lambda number: self._seen(fsync, number))
        monkeypatch.setattr(Path, "replace", lambda path, to: self._cut(replace, path, to))
        monkeypatch.setattr(Path, "rename", lambda path, to: self._cut(rename, path, to))

    def _seen(self, fsync, number):
        self._note()
        fsync(number)
        self._flushed(Path(os.readlink(f"/proc/self/fd/{number}")))
        self._note()

    def _cut(self, moved, path, to):
        self._note()
        moved(path, to)
        self._note()

    def _flushed(self, path):
        if path.is_dir():
            self.names = {one.name: one.stat().st_ino for one in path.iterdir()}
        else:
            self.contents[path.stat().st_ino] = path.read_bytes()

    def _note(self):
        self.left.append({name: self.contents.get(ino, b"") for name, ino in self.names.items()})

    def ever(self, name):
        """What a cut at any moment since would have left of a file."""
        self._note()
        return [left.get(name) for left in self.left]


def _keys(path):
    KeyFile(path.parent).add("someone", KeyScope.READ)


WRITERS = {
    "any file": ("it.json", lambda path: replace_file(path, b"new and longer")),
    "a record beside its matrix": ("it.json", lambda path: _write_sidecar(path, b"new")),
    "a matrix": (
        "it.h5",
        lambda path: write_whole(path, lambda file: file.create_dataset("x", data=[1.0, 2.0])),
    ),
    "keys": ("keys.json", _keys),
}


@pytest.mark.parametrize("what", WRITERS)
def test_whatever_the_moment_the_file_before_or_the_new_one_is_left(tmp_path, monkeypatch, what):
    name, write = WRITERS[what]
    path = tmp_path / name
    if name != "it.h5":
        path.write_bytes(b"[]" if what == "keys" else b"old")
    before = path.read_bytes() if path.exists() else None
    disk = Disk(tmp_path, monkeypatch)
    write(path)
    found = disk.ever(name)
    assert set(found) == {before, path.read_bytes()}
    assert found[-1] == path.read_bytes() != before


def test_the_disk_of_these_tests_forgets_what_was_not_flushed(tmp_path, monkeypatch):
    path = tmp_path / "it.json"
    path.write_bytes(b"old")
    disk = Disk(tmp_path, monkeypatch)
    part = tmp_path / "part"
    part.write_bytes(b"new")
    part.replace(path)
    assert set(disk.ever("it.json")) == {b"old"}
    os.fsync(os.open(tmp_path, os.O_RDONLY))
    assert disk.ever("it.json")[-1] == b""


def test_a_disk_that_refuses_keeps_the_file_before_and_nothing_beside_it(tmp_path, monkeypatch):
    path = tmp_path / "it.json"
    path.write_bytes(b"old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        replace_file(path, b"new")
    with pytest.raises(StorageError, match=r"it\.json: cannot be written"):
        _write_sidecar(path, b"new")
    assert [one.name for one in tmp_path.iterdir()] == ["it.json"]
    assert path.read_bytes() == b"old"


def test_rights_are_those_asked_for(tmp_path):
    replace_file(tmp_path / "secret", b"x", 0o600)
    assert (tmp_path / "secret").stat().st_mode & 0o777 == 0o600
