"""Fits of matrices whose four pupil images lie beside the pixel grid.

``python -m pyrcal_studies.image_offsets`` draws displacements of the images, measures a matrix of
each draw with an FFT pyramid that shares no code with the model, and fits it: slopes with the
displacements in the instrument file and without, and detector frames whose images are located in
the mean frame. It prints the table of docs/results/image_offsets.md, a row for each size of the
displacements as soon as it is done. A draw takes 2 to 3 seconds of processor time.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.fit_file import fit
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal_studies.fft_pyramid import DisplacedPyramid
from service.estimation.reference import Reference
from service.model.instrument import Instrument, Mirror
from service.model.interaction import InteractionModel
from service.model.kinds import Influence, InfluenceShape, KarhunenLoeve, Stop
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import Basis, modal_basis
from service.model.sensors.pyramid.description import FrameWindows, Pyramid
from service.model.slopes import Orientation, SlopeRecipe

Array = NDArray[np.float64]

N = 12
SEPARATION = 17.0
WAVELENGTH_M = 750e-9
TRUTH = Misregistration(
    shift_x_subap=0.2, shift_y_subap=-0.15, rotation_rad=np.deg2rad(0.7), magnification=1.005
)

RMS_SUBAP = (0.0, 0.05, 0.1, 0.2, 0.3)
"""RMS displacement of the images along either axis; a subaperture is one pixel."""

EVERY = 2
"""Every second one of the 40 modes is measured: it halves the time of a draw."""

STROKE_M = 1e-9
"""Stroke of a push and of a pull."""


def bench(stop: Stop) -> Instrument:
    """Return a telescope of 12 subapertures with 13 x 13 Gaussian actuators and 40 modes."""
    side = np.linspace(-2.0, 2.0, N + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    inside = np.hypot(x, y) < 2.2
    return Instrument(
        name="bench",
        diameter_m=4.0,
        obscuration_ratio=0.2,
        stop=stop,
        double_pass=False,
        wfs=Pyramid(
            n_subapertures=N,
            wavelength_m=WAVELENGTH_M,
            modulation_lambda_over_d=3.0,
            pupil_separation_subap=SEPARATION,
        ),
        mirror=Mirror(
            positions_m=np.column_stack([x, y])[inside],
            pitch_m=4.0 / N,
            shape=InfluenceShape(influence=Influence.GAUSSIAN, coupling=0.35),
            nominal_rotation_rad=0.0,
            parity=1,
        ),
        modes=KarhunenLoeve(n_modes=40),
        slopes=SlopeRecipe(orientation=Orientation()),
    )


@cache
def basis() -> Basis:
    """Return the modes of the bench."""
    return modal_basis(bench(Stop.MIRROR))


def displacements(seed: int, rms: float = 0.1) -> Array:
    """Return displacements ``(2, 2, 2)`` of mean zero: side along y, side along x, (x, y)."""
    drawn = np.random.default_rng(seed).normal(size=(2, 2, 2))
    drawn -= drawn.mean(axis=(0, 1))
    return np.asarray(drawn * rms / np.sqrt(np.mean(drawn**2)))


def model_of(instrument: Instrument) -> InteractionModel:
    """Return the model whose pupil the FFT pyramid has."""
    return InteractionModel(instrument, basis(), pupil_sampling=4, detector_nodes=3)


def measured(instrument: Instrument, offsets: Array, every: int = 1) -> Array:
    """Return the slopes ``(n_slopes, n_modes)`` of every so many modes at the true registration."""
    model = model_of(instrument)
    camera = _camera(model, offsets, N)
    shift = _shift(instrument)
    maps = _maps(camera, shift + offsets.mean(axis=(0, 1)), every)
    return camera.jacobian(maps, model.valid, shift)


def filmed(instrument: Instrument, offsets: Array, every: int) -> tuple[Array, Array]:
    """Return detector frames per metre of every so many modes, and the mean frame."""
    wide = int(SEPARATION)  # the quadrants of the frame touch each other
    camera = _camera(model_of(instrument), offsets, wide)
    shift = _shift(instrument)
    maps = _maps(camera, shift + offsets.mean(axis=(0, 1)), every)
    side = 2 * wide
    rest = camera.images(np.zeros_like(maps[0]), shift).reshape(side, side)
    pushed = [
        (camera.images(STROKE_M * one, shift) - camera.images(-STROKE_M * one, shift))
        / (2 * STROKE_M)
        for one in maps
    ]
    return np.array(pushed).reshape(-1, side, side), rest


def _camera(model: InteractionModel, offsets: Array, n: int) -> DisplacedPyramid:
    """Return the FFT pyramid, each image ``n`` subapertures wide."""
    return DisplacedPyramid(
        amplitude=model.pupil.amplitude,
        sampling=4,
        wavelength_m=WAVELENGTH_M,
        n_subapertures=n,
        image_separation_subap=SEPARATION,
        modulation_lambda_over_d=3.0 * n / N,
        n_nodes=3,
        padded_subap=6 * N,
        offsets=offsets,
    )


def _shift(instrument: Instrument) -> tuple[float, float]:
    """Return how far the pupil images move with the mirror."""
    x, y = TRUTH.vector[:2] if instrument.stop is Stop.MIRROR else (0.0, 0.0)
    return float(x), float(y)


def _maps(camera: DisplacedPyramid, carried: Array, every: int) -> Array:
    """Return the modes ``(n_modes, n, n)``; the mirror moves with the images, α with neither."""
    u = camera.coordinates
    points = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    on_mirror = TRUTH.on_mirror(points - (TRUTH.vector[:2] - carried))
    rendered = basis().render(on_mirror)[:, ::every]
    return rendered.T.reshape(-1, len(u), len(u))


def as_told(instrument: Instrument, offsets: Array) -> Instrument:
    """Return the instrument with the places of its images in its file."""
    places = tuple((float(x), float(y)) for x, y in offsets.reshape(4, 2))
    return replace(instrument, wfs=replace(instrument.wfs, image_offsets_subap=places))


def fit_told(seed: int, rms: float) -> Fit:
    """Return the fit of slopes with the displacements in the instrument file."""
    return _fit_slopes(seed, rms, as_told(_bench(seed), _drawn(seed, rms)))


def fit_untold(seed: int, rms: float) -> Fit:
    """Return the fit of slopes without the displacements in the instrument file."""
    return _fit_slopes(seed, rms, _bench(seed))


def fit_frames(seed: int, rms: float) -> Fit:
    """Return the fit of frames, their images located in the mean frame, telescope as stop."""
    instrument = replace(bench(Stop.TELESCOPE), frames=FrameWindows())
    frames, rest = filmed(instrument, _drawn(seed, rms), EVERY)
    modes = np.arange(0, basis().n_modes, EVERY)
    return fit(instrument, frames, modes=modes, flux_frame=rest, threads=1)


FITS: dict[str, Callable[[int, float], Fit]] = {
    "slopes, in the file": fit_told,
    "slopes, not in the file": fit_untold,
    "frames, located in the light": fit_frames,
}
"""By what is known of the images' places."""


def main() -> None:
    """Print a line for each size of the displacements and each way to know them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--draws", type=int, default=8, help="of each size")
    parser.add_argument("--rms", type=float, nargs="+", default=RMS_SUBAP, help="pixels")
    parser.add_argument("--ways", nargs="+", choices=FITS, default=list(FITS))
    options = parser.parse_args()
    for rms in options.rms:
        for way in options.ways:
            found = [FITS[way](seed, rms) for seed in range(options.draws)]
            print(_row(rms, way, found), flush=True)


def _row(rms: float, way: str, found: list[Fit]) -> str:
    errors = np.array([one.alpha.vector - TRUTH.vector for one in found]) * BOUNDARY_SCALE
    sigmas = np.array([one.sigma for one in found]) * BOUNDARY_SCALE
    worst = np.abs(errors / sigmas).max(axis=1)
    accepted = sum(one.accepted for one in found)
    wrong = sum(one.accepted and off >= 3.0 for one, off in zip(found, worst, strict=True))
    return (
        f"| {rms} | {way} | {accepted} of {len(found)} | {np.sum(worst < 3.0)} | {wrong} "
        f"| {worst.max():.1f} | {np.abs(errors[:, :2]).max():.4f} | {sigmas[:, :2].max():.4f} "
        f"| {np.abs(errors[:, 2]).max():.4f} | {np.abs(errors[:, 3]).max():.5f} |"
    )


def _drawn(seed: int, rms: float) -> Array:
    return displacements(seed, rms) if rms else np.zeros((2, 2, 2))


def _bench(seed: int) -> Instrument:
    """Return the bench with either stop in turn."""
    return bench(list(Stop)[seed % 2])


@cache
def _slopes(seed: int, rms: float) -> Array:
    return measured(_bench(seed), _drawn(seed, rms), EVERY)


def _fit_slopes(seed: int, rms: float, about: Instrument) -> Fit:
    modes = np.arange(0, basis().n_modes, EVERY)
    reference = Reference(matrix=_slopes(seed, rms), modes=modes)
    return fit_matrix(about, reference, FitOptions(), basis=basis())


if __name__ == "__main__":
    main()
