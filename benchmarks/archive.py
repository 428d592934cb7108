"""What an archive of a 39 m telescope's matrices takes: each step in a process of its own.

Run: ``python -m benchmarks.archive [--folder FOLDER] [--keep 12]``. Matrices of 4300 modes and
24,080 signals, 414 MB each; with 12 reconstructors, a measured and a noisy one the folder takes
7 GB and is removed at the end. Time is of the processor; the peak is all of the process.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service import wire
from service.archive import Archive
from service.archive.products import NoisyNumbers
from service.archive.retention import RetentionPolicy, due, items, remove
from service.link.matrices import Offer
from service.model.misregistration import Misregistration
from service.tracking.operation_records import MeasurementRecord, MeasureState, NoisyFinding
from service.tracking.products import MatrixState, ReconstructorRecord
from service.wire import Pattern, checksum

N_MODES, N_SIGNALS = 4300, 24_080
HERE = Misregistration(shift_x_subap=0.1)

Step = Callable[[Path, int], str]


def _matrix(seed: int, shape: tuple[int, int]) -> NDArray[np.float32]:
    return np.random.default_rng(seed).random(shape, np.float32)


def _reconstructor(name: str) -> ReconstructorRecord:
    return ReconstructorRecord(
        id=name,
        state=MatrixState.SUPERSEDED,
        n_modes=N_MODES,
        created_ns_utc=time.time_ns(),
        alpha=HERE,
    )


def _measurement(name: str, matrix: NDArray[np.float32]) -> MeasurementRecord:
    return MeasurementRecord(
        id=name,
        state=MeasureState.STORED,
        pattern=Pattern.HADAMARD,
        modes=tuple(range(N_MODES)),
        amplitude_m=(1e-8,) * N_MODES,
        n_average=1,
        created_ns_utc=time.time_ns(),
        n_slopes=N_SIGNALS,
        sha256=checksum(matrix),
    )


def _store_one(archive: Archive, number: int) -> None:
    matrix = _matrix(number, (N_MODES, N_SIGNALS))
    record = _reconstructor(f"cm-{number}")
    archive.reconstructors.store(record, matrix, None, {})
    archive.record((record,), ())


def store_reconstructor(folder: Path, keep: int) -> str:
    """Store one reconstructor."""
    with _open(folder) as archive:
        _store_one(archive, 0)
    return ""


def store_others(folder: Path, keep: int) -> str:
    """Store the others."""
    with _open(folder) as archive:
        for number in range(1, keep):
            _store_one(archive, number)
    n_bytes = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return f"{n_bytes / 1e9:.2f} GB of {keep} on the disk"


def store_measured(folder: Path, keep: int) -> str:
    """Store an interaction matrix that the RTC has measured."""
    matrix = _matrix(1, (N_SIGNALS, N_MODES))
    with _open(folder) as archive:
        archive.measured.store(_measurement("im-0", matrix), matrix, "elt")
    return ""


def store_noisy(folder: Path, keep: int) -> str:
    """Store a noisy matrix: three arrays of that size."""
    shape = (N_SIGNALS, N_MODES)
    matrix, ones = _matrix(2, shape), np.ones(N_MODES)
    numbers = NoisyNumbers(
        matrix=matrix,
        noise=_matrix(3, shape),
        synthetic=_matrix(4, shape),
        optical_gain=ones,
        gain_sigma=ones,
        snr=ones,
    )
    finding = NoisyFinding(
        n_slopes=N_SIGNALS,
        n_frames=1,
        n_missing=0,
        snr=1.0,
        alpha=None,
        covariance=None,
        optical_gain=None,
        misfit=None,
        cm_id="cm-0",
        session="s-1",
        created_ns_utc=time.time_ns(),
        sha256=checksum(matrix),
    )
    record = replace(_measurement("noisy-0", matrix), pattern=None, duration_s=30.0, seed=1)
    with _open(folder) as archive:
        archive.noisy.store(replace(record, finding=finding), numbers, "elt")
    return ""


def restart(folder: Path, keep: int) -> str:
    """Open the archive as a service that starts does, and list all that is in it."""
    with _open(folder) as archive:
        return f"{len(items(archive))} products, {len(archive.reconstructors.records())} records"


def restart_without_index(folder: Path, keep: int) -> str:
    """Open it after the index was lost: every file is read."""
    (folder / "index.sqlite").unlink()
    return restart(folder, keep)


def roll_back(folder: Path, keep: int) -> str:
    """Read a matrix back, its checksum verified, and cut it into the parts that are sent."""
    with _open(folder) as archive:
        matrix = archive.reconstructors.matrix("cm-0")
    layout = wire.layout_of(matrix, 4_000_000)
    manifest = wire.Manifest(
        id="cm-0",
        layout=layout,
        alpha=None,
        sigma=None,
        im_id=None,
        parent=None,
        basis_id="kl",
        config_id="b1",
        system="elt",
        created_ns=0,
    )
    return f"{len(Offer.of(manifest, matrix).parts)} parts"


def read_file(folder: Path, keep: int) -> str:
    """Verify the file of the noisy matrix, as whoever downloads it asks for."""
    with _open(folder) as archive:
        return f"{archive.noisy.file('noisy-0').stat().st_size / 1e9:.2f} GB"


def probe(folder: Path, keep: int) -> str:
    """See that the disk takes a matrix, as after it was full."""
    with _open(folder) as archive:
        archive.reconstructors.largest_bytes = 4 * N_MODES * N_SIGNALS
        archive.probe()
    return ""


def prune(folder: Path, keep: int) -> str:
    """Remove what is too much of one gigabyte: all but the newest of each kind."""
    with _open(folder) as archive:
        policy = RetentionPolicy(keep_gb=1.0)
        gone = [remove(archive, *each) for each in due(items(archive), policy, time.time_ns())]
        left = items(archive)
    return f"{len(gone)} removed, {sum(item.n_bytes for item in left) / 1e9:.2f} GB left"


STEPS: tuple[Step, ...] = (
    store_reconstructor,
    store_others,
    store_measured,
    store_noisy,
    restart,
    restart_without_index,
    roll_back,
    read_file,
    probe,
    prune,
)


def _open(folder: Path) -> Archive:
    archive = Archive(folder)
    archive.open()
    return archive


def _run(step: Step, folder: Path, keep: int, line: multiprocessing.connection.Connection) -> None:
    begun_s, begun_cpu_s = time.monotonic(), time.process_time()
    found = step(folder, keep)
    took_s, cpu_s = time.monotonic() - begun_s, time.process_time() - begun_cpu_s
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    line.send(f"{cpu_s:.1f} s of processor, {took_s:.1f} s, peak {peak_gb:.2f} GB; {found}")


def main() -> None:
    """Do all steps, one after the other."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.archive")
    parser.add_argument("--folder", type=Path, help="an empty one, removed at the end")
    parser.add_argument("--keep", type=int, default=12, help="reconstructors")
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp())
    from benchmarks import archive as as_imported  # a process has another __main__

    spawn = multiprocessing.get_context("spawn")
    try:
        for step in as_imported.STEPS:
            ours, theirs = spawn.Pipe()
            work = (step, folder, given.keep, theirs)
            process = spawn.Process(target=as_imported._run, args=work)  # noqa: SLF001
            process.start()
            theirs.close()
            print(f"{(step.__doc__ or '').strip()} {ours.recv()}", flush=True)
            process.join()
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
