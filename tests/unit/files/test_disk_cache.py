"""What is prepared once: found again, never out of date, safe to lose, safe between processes."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pyrcal.fitting.design import interaction_matrix
from service.files import disk_cache
from service.files.disk_cache import DiskCache, usual_folder
from service.model.modes import modal_basis
from tests.support.numerics import small_instrument

PARTS = ("mode_to_actuator", "coefficients", "variance_m2")


@pytest.fixture
def counted(monkeypatch):
    """How often modes were computed."""
    made = []
    monkeypatch.setattr(
        disk_cache,
        "modal_basis",
        lambda instrument: made.append(instrument) or modal_basis(instrument),
    )
    return made


def same(one, other):
    for part in PARTS:
        np.testing.assert_array_equal(getattr(one, part), getattr(other, part))
    points = np.random.default_rng(1).uniform(-5.0, 5.0, (20, 2))
    np.testing.assert_array_equal(one.render(points), other.render(points))


def test_modes_are_computed_once_for_all_who_share_the_folder(tmp_path, counted):
    first = DiskCache(tmp_path).basis(small_instrument())
    second = DiskCache(tmp_path).basis(small_instrument())
    assert len(counted) == 1
    same(first, second)
    same(second, modal_basis(small_instrument()))


def test_without_a_folder_everything_is_computed(counted):
    for _ in range(2):
        DiskCache(None).basis(small_instrument())
    assert len(counted) == 2


def test_another_instrument_has_other_modes_whatever_its_name(tmp_path, counted):
    for instrument in (small_instrument(), small_instrument(obscuration_ratio=0.2)):
        same(DiskCache(tmp_path).basis(instrument), modal_basis(instrument))
    assert len(counted) == 2


def test_another_version_of_the_model_finds_nothing(tmp_path, counted, monkeypatch):
    DiskCache(tmp_path).basis(small_instrument())
    monkeypatch.setattr(disk_cache, "code_sha256", lambda *_: "another")
    DiskCache(tmp_path).basis(small_instrument())
    assert len(counted) == 2


@pytest.mark.parametrize("what", ["emptied", "cut", "a flipped byte", "text"])
def test_a_damaged_file_is_made_again(tmp_path, counted, what):
    DiskCache(tmp_path).basis(small_instrument())
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    middle = len(whole) // 2
    path.write_bytes(
        {
            "emptied": b"",
            "cut": whole[:middle],
            "a flipped byte": whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :],
            "text": b"not a file of ours",
        }[what]
    )
    same(DiskCache(tmp_path).basis(small_instrument()), modal_basis(small_instrument()))
    assert len(counted) == 2
    DiskCache(tmp_path).basis(small_instrument())
    assert len(counted) == 2


def test_a_folder_that_cannot_be_is_no_error(tmp_path, counted):
    (tmp_path / "file").write_text("in the way")
    for _ in range(2):
        DiskCache(tmp_path / "file" / "cache").basis(small_instrument())
    assert len(counted) == 2


def test_a_full_disk_is_no_error_and_leaves_nothing_behind(tmp_path, counted, monkeypatch):
    def full(file, **_):
        file.write(b"half of")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    DiskCache(tmp_path).basis(small_instrument())
    assert not list(tmp_path.iterdir())


def test_the_files_used_least_recently_make_room(tmp_path):
    kept = DiskCache(tmp_path, max_bytes=30_000)
    compute = {"numbers": np.ones(1000)}
    for k in range(5):
        kept.arrays(small_instrument(), ("numbers", k), lambda: compute)
        for age, path in enumerate(sorted(tmp_path.iterdir(), key=os.path.getmtime)):
            os.utime(path, (age, age))
        kept.arrays(small_instrument(), ("numbers", 0), lambda: compute)  # it is used
    files = list(tmp_path.iterdir())
    assert sum(path.stat().st_size for path in files) <= 30_000
    assert len(files) == 3
    never = kept.arrays(small_instrument(), ("numbers", 0), lambda: {"numbers": np.zeros(1)})
    assert never["numbers"].any()


def test_what_is_too_large_is_not_kept(tmp_path):
    kept = DiskCache(tmp_path, max_bytes=1000)
    kept.arrays(small_instrument(), ("numbers",), lambda: {"numbers": np.ones(1000)})
    assert not list(tmp_path.iterdir())


def test_what_a_dead_process_left_is_swept_out_and_what_a_living_one_writes_stays(tmp_path):
    for name, age_s in ((".dead.npz", 7200.0), (".alive.npz", 10.0)):
        path = tmp_path / name
        path.write_bytes(b"half of")
        os.utime(path, (path.stat().st_mtime - age_s,) * 2)
    DiskCache(tmp_path).arrays(small_instrument(), ("numbers",), lambda: {"numbers": np.ones(1)})
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == [".alive.npz"]


WRITER = """
import sys
from pathlib import Path
import numpy as np
from service.instrument import load_instrument
from service.files.disk_cache import DiskCache
instrument, kept = load_instrument(sys.argv[2]), DiskCache(Path(sys.argv[1]))
for k in range(60):
    found = kept.arrays(instrument, ("numbers",), lambda: {"numbers": np.full(50_000, 7.0)})
    assert (found["numbers"] == 7.0).all() and len(found["numbers"]) == 50_000
    if k % 3 == 0:
        for path in Path(sys.argv[1]).glob("small-*"):
            path.unlink(missing_ok=True)
"""


def test_processes_that_write_read_and_delete_at_once_do_not_disturb_each_other(tmp_path):
    root = Path(__file__).parents[3]
    environment = os.environ | {"PYTHONPATH": str(root)}
    small = root / "tests" / "system" / "small.toml"
    command = [sys.executable, "-c", WRITER, str(tmp_path), str(small)]
    running = [
        subprocess.Popen(command, cwd=root, env=environment, stderr=subprocess.PIPE)
        for _ in range(2)
    ]
    for process in running:
        _, error = process.communicate(timeout=100)
        assert process.returncode == 0, error.decode()


def test_the_folder_is_the_users_unless_the_environment_says_otherwise(tmp_path):
    assert usual_folder({"PYRCAL_SERVICE__CACHE_DIR": str(tmp_path)}) == tmp_path
    assert usual_folder({"XDG_CACHE_HOME": "/x"}) == Path("/x/pyrcal")
    assert usual_folder({}) == Path.home() / ".cache" / "pyrcal"


def test_modes_of_the_users_own_are_computed_once_too(tmp_path, counted):
    """Their strokes are given; the statistics of turbulence still take seconds."""
    instrument = small_instrument()
    strokes = np.random.default_rng(2).normal(size=(len(instrument.mirror.positions_m), 7))
    own = replace(instrument, mirror=replace(instrument.mirror, mode_to_actuator=strokes))
    other = replace(instrument, mirror=replace(instrument.mirror, mode_to_actuator=2.0 * strokes))
    for _ in range(2):
        same(DiskCache(tmp_path).basis(own), modal_basis(own))
    assert len(counted) == 1
    same(DiskCache(tmp_path).basis(other), modal_basis(other))
    assert len(counted) == 2


def test_what_people_call_uses_the_folder_of_the_environment(tmp_path, counted, monkeypatch):
    monkeypatch.setenv("PYRCAL_SERVICE__CACHE_DIR", str(tmp_path))
    matrices = [interaction_matrix(small_instrument()) for _ in range(2)]
    np.testing.assert_array_equal(*matrices)
    assert len(counted) == 1
    assert list(tmp_path.glob("small-modes-*.npz"))
