"""Push-pull on a peer's own sensor; needs numpy alone, and so runs inside the peer's environment.

A peer is told the mirror's shape on its pupil grid, ``[y, x]``. Which way its detector looks at
that grid is found by poking the pupil, never assumed: only so can its images be moved by a known
amount along the pupil's own axes.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

JOB = "-job.npz"
"""End of the name of a job's file."""

_POKE_SUBAP = 7.0
_POKE_WIDTH_SUBAP = 1.5
_POKE_M = 20e-9

_FINE = 16
"""Points across a cell of the grey pupil."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """The telescope and the pyramid that a peer shall imitate."""

    diameter_m: float
    """Pupil diameter, metres."""

    obscuration_ratio: float
    """Linear central obscuration."""

    n_subapertures: int
    """Across the pupil image."""

    pupil_separation_subap: int
    """Between the centres of neighbouring pupil images."""

    wavelength_m: float
    """Sensing wavelength, metres."""

    modulation_lambda_over_d: float
    """Radius of the modulation circle."""

    n_modulation: int
    """Points of the modulation circle."""

    sampling: int
    """Pupil points per subaperture."""

    stroke_m: float = 1e-9
    """Push and pull, metres RMS."""

    as_shipped: bool = False
    """Whether the peer keeps its own pupil and its own reading of the modulation radius."""

    image_shift_subap: tuple[float, float] = (0.0, 0.0)
    """How far the pupil images lie from nominal, along the pupil's own x and y."""

    misregistration: tuple[float, float, float, float] | None = None
    """Shift x, y (subapertures), rotation (degrees) and magnification for the peer's own mirror."""

    image_offsets_px: tuple[tuple[float, float], ...] = ()
    """Displacement (columns, rows) of each pupil image, pixels, in the order of the detector's
    quadrants, row by row. Empty if the images lie on the pixel grid."""

    arm_subap: float = 0.0
    """Width of the four arms of a spider along x and y, subapertures; 0 without."""

    @property
    def n_pupil(self) -> int:
        """Pupil points across."""
        return self.n_subapertures * self.sampling

    def amplitude(self) -> Array:
        """Return the pupil's grey amplitude ``(n_pupil, n_pupil)``: the lit fraction of a cell."""
        fine = self.n_pupil * _FINE
        along = (np.arange(fine) - (fine - 1) / 2) / (fine / 2)
        radius = np.hypot(along, along[:, None])
        lit = (radius <= 1.0) & (radius >= self.obscuration_ratio)
        across = np.minimum(np.abs(along), np.abs(along[:, None]))
        lit &= across >= self.arm_subap / self.n_subapertures
        return np.asarray(lit.reshape(self.n_pupil, _FINE, self.n_pupil, _FINE).mean(axis=(1, 3)))

    @property
    def n_detector(self) -> int:
        """Detector pixels across: four quadrants, a pupil image in the middle of each."""
        return 2 * self.pupil_separation_subap


class Peer(Protocol):
    """A code that has a pyramid of its own."""

    version: str
    """Of the package."""

    wavelength_m: float
    """What it really senses at."""

    valid: NDArray[np.bool_]
    """``(n_subapertures, n_subapertures)`` mask in the peer's own axes."""

    def frame(self, opd_m: Array) -> Array:
        """Return the detector's frame for an OPD ``(n_pupil, n_pupil)`` [y, x], metres."""

    def slopes(self, opd_m: Array) -> Array:
        """Return the peer's slopes, in its own order."""

    def move_images(self, columns_px: float, rows_px: float) -> None:
        """Move the four pupil images together on the detector."""

    def tilt_faces(self, offsets_px: Array) -> None:
        """Displace each pupil image ``(2, 2, 2)``: quadrant's row, column; (columns, rows)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measured:
    """An interaction matrix, as the peer made it."""

    matrix: Array
    """``(n_slopes, n_modes)`` in the peer's own order and signs, slope per metre OPD."""

    valid: NDArray[np.bool_]
    """The peer's mask, its own axes."""

    wavelength_m: float
    """What the peer senses at, metres."""

    version: str
    """Of the peer."""

    seconds: float
    """Wall time of the push-pull."""

    detector_from_pupil: Array
    """``(2, 2)`` signed permutation: a pupil vector (x, y) seen as (columns, rows)."""


def push_pull(peer: Peer, shapes_m: Array, bench: Bench) -> Measured:
    """Measure the matrix of ``shapes_m`` ``(n_modes, n_pupil, n_pupil)``, metres OPD per metre.

    Raises
    ------
    ValueError
        If the detector does not see the pupil along its axes, or the images do not move as told.
    """
    looks = detector_from_pupil(peer, bench)
    if any(bench.image_shift_subap):
        _move(peer, looks @ np.array(bench.image_shift_subap), bench)
    if bench.image_offsets_px:
        _move_each(peer, np.reshape(bench.image_offsets_px, (2, 2, 2)), bench)
    start = time.perf_counter()
    columns = []
    for shape in shapes_m:
        opd_m = bench.stroke_m * shape.astype(float)
        pushed, pulled = peer.slopes(opd_m), peer.slopes(-opd_m)
        columns.append((pushed - pulled) / (2 * bench.stroke_m))
    return Measured(
        matrix=np.stack(columns, axis=1),
        valid=peer.valid,
        wavelength_m=peer.wavelength_m,
        version=peer.version,
        seconds=time.perf_counter() - start,
        detector_from_pupil=looks,
    )


def detector_from_pupil(peer: Peer, bench: Bench) -> Array:
    """Return how the detector sees the pupil's axes: poke it off centre, see what lights up."""
    at_rest = peer.frame(np.zeros((bench.n_pupil, bench.n_pupil)))
    seen = []
    for towards in ((1.0, 0.0), (0.0, 1.0)):
        frame = peer.frame(_POKE_M * _poke(towards, bench))
        seen.append(_centroid(np.abs(fold(frame - at_rest, absolute=True))) / _POKE_SUBAP)
    looks = np.array(seen).T
    axes = np.rint(looks)
    if not np.array_equal(np.abs(axes) @ np.abs(axes).T, np.eye(2)):
        raise ValueError(f"poking along x and y lit up {looks.T.tolist()}; expected the axes")
    return axes


def fold(frame: Array, *, absolute: bool = False) -> Array:
    """Return the sum of the four quadrants of a frame."""
    half = len(frame) // 2
    quadrants = (np.abs(frame) if absolute else frame).reshape(2, half, 2, half)
    return np.asarray(quadrants.sum(axis=(0, 2)))


def _centroid(image: Array) -> Array:
    """Return the centroid (columns, rows) of an image from its middle, pixels."""
    along = np.arange(len(image)) - (len(image) - 1) / 2
    centre = np.array([image.sum(axis=0) @ along, image.sum(axis=1) @ along])
    return np.asarray(centre / image.sum())


def _poke(towards: tuple[float, float], bench: Bench) -> Array:
    along = (np.arange(bench.n_pupil) - (bench.n_pupil - 1) / 2) / bench.sampling
    x, y = along - _POKE_SUBAP * towards[0], along[:, None] - _POKE_SUBAP * towards[1]
    return np.asarray(np.exp(-(x**2 + y**2) / (2 * _POKE_WIDTH_SUBAP**2)))


def _move(peer: Peer, pixels: Array, bench: Bench) -> None:
    flat = np.zeros((bench.n_pupil, bench.n_pupil))
    before = _centroid(fold(peer.frame(flat)))
    peer.move_images(float(pixels[0]), float(pixels[1]))
    moved = _centroid(fold(peer.frame(flat))) - before
    if np.abs(moved - pixels).max() > 0.1:
        raise ValueError(f"the images were to move by {pixels} pixels; they moved by {moved}")


def roof(x: Array, y: Array, separation: float, offsets: Array, lights: int) -> Array:
    """Return the height of a pyramid's four planes, which meet where the higher one begins.

    Parameters
    ----------
    x, y
        Coordinates in the focal plane, of the same shape.
    separation
        Distance between the centres of neighbouring images.
    offsets
        ``(2, 2, 2)`` displacement of each image: quadrant's row, column; (columns, rows).
    lights
        1 if a face lights the quadrant at its own side, -1 if that opposite.
    """
    planes = []
    for row, column in np.ndindex(2, 2):
        columns, rows = separation * (np.array([column, row]) - 0.5) + offsets[row, column]
        planes.append(lights * (columns * x + rows * y))
    return np.asarray(np.max(planes, axis=0))


def _move_each(peer: Peer, offsets_px: Array, bench: Bench) -> None:
    flat = np.zeros((bench.n_pupil, bench.n_pupil))
    before = _image_centres(peer.frame(flat), bench)
    peer.tilt_faces(offsets_px)
    moved = _image_centres(peer.frame(flat), bench) - before
    # light that an edge diffracts moves the centroids as well
    if np.linalg.norm(moved - offsets_px) > 0.05 + 0.5 * np.linalg.norm(offsets_px):
        raise ValueError(f"the images were to move by {offsets_px} pixels; they moved by {moved}")


def _image_centres(frame: Array, bench: Bench) -> Array:
    """Return the centroid (columns, rows) of each image ``(2, 2, 2)`` in its quadrant, pixels."""
    half = bench.n_detector // 2
    quadrants = frame.reshape(2, half, 2, half).transpose(0, 2, 1, 3)
    return np.array([[_centroid(one) for one in row] for row in quadrants])


def write_job(path: Path, bench: Bench, **arrays: Array) -> None:
    """Write what a peer's process shall measure."""
    np.savez(path, bench=json.dumps(asdict(bench)), **arrays)  # type: ignore[arg-type]


def read_job(path: Path) -> tuple[Bench, dict[str, Array]]:
    """Read it back."""
    with np.load(path) as job:
        bench = json.loads(str(job["bench"]))
        arrays = {name: job[name] for name in job.files if name != "bench"}
    bench["image_shift_subap"] = tuple(bench["image_shift_subap"])
    bench["image_offsets_px"] = tuple(map(tuple, bench["image_offsets_px"]))
    if bench["misregistration"] is not None:
        bench["misregistration"] = tuple(bench["misregistration"])
    return Bench(**bench), arrays


def job_and_product() -> tuple[Path, Path]:
    """Return the two paths on the command line of a peer's process."""
    parser = argparse.ArgumentParser(description="Measure an interaction matrix with a peer.")
    parser.add_argument("job", type=Path)
    parser.add_argument("product", type=Path)
    given = parser.parse_args(sys.argv[1:])
    return given.job, given.product


def write_product(path: Path, measured: Measured, **arrays: Array) -> None:
    """Write what a peer measured, whole or not at all."""
    part = path.with_suffix(".part.npz")
    product: dict[str, Any] = asdict(measured) | arrays
    np.savez(part, **product)
    part.rename(path)


def read_product(path: Path) -> tuple[Measured, dict[str, Array]]:
    """Read it back, with whatever else the peer wrote beside it."""
    with np.load(path) as product:
        arrays = {name: product[name] for name in product.files}
    measured = Measured(
        matrix=arrays.pop("matrix"),
        valid=arrays.pop("valid"),
        wavelength_m=float(arrays.pop("wavelength_m")),
        version=str(arrays.pop("version")),
        seconds=float(arrays.pop("seconds")),
        detector_from_pupil=arrays.pop("detector_from_pupil"),
    )
    return measured, arrays


def main() -> None:
    """Measure every job of a folder in one process, and remove each job when it is done."""
    name, folder = sys.argv[1], Path(sys.argv[2])
    peer = getattr(import_module(f"pyrcal_studies.peers_{name}"), name.capitalize())
    for job in sorted(folder.glob(f"*{JOB}")):
        bench, arrays = read_job(job)
        product = job.with_name(job.name.removesuffix(JOB) + ".npz")
        write_product(product, push_pull(peer(bench), arrays["shapes_m"], bench))
        job.unlink()


if __name__ == "__main__":
    main()
