"""The same interaction matrix from other codes, by push-pull, on one thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.fft_pyramid import FftPyramid
from service.model.interaction import InteractionModel
from service.model.sensors.pyramid.description import pyramid_in
from service.model.sensors.pyramid.optics import enough_modulation_points
from service.model.sensors.sensor import Fineness

MODES = (0, 50, 200, 400)
"""The modes timed: every one costs the same."""

STROKE_M = 1e-9
"""Push and pull, metres RMS."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measured:
    """What a peer took, and what it found."""

    seconds: tuple[float, ...]
    """For each of ``MODES``."""

    columns: NDArray[np.float64]
    """``(n_slopes, n_timed)`` of the interaction matrix."""


def fft_reference(model: InteractionModel) -> Measured:
    """Run the FFT pyramid of ``tests/physics``: same sampling, quadrature and modulation."""
    wfs = pyramid_in(model.instrument)
    reference = FftPyramid(
        amplitude=model.pupil.amplitude,
        sampling=model.pupil.sampling,
        wavelength_m=wfs.wavelength_m,
        n_subapertures=wfs.n_subapertures,
        image_separation_subap=wfs.image_separation_subap,
        modulation_lambda_over_d=wfs.modulation_lambda_over_d,
        n_modulation=enough_modulation_points(wfs),
        n_nodes=Fineness().n_nodes,
    )
    return _push_pull(lambda opd_m: reference.slopes(opd_m, model.valid), model)


def hcipy_pyramid(model: InteractionModel) -> Measured:
    """Run HCIPy's modulated pyramid, fast modulation, detector pixels binned to subapertures."""
    return _push_pull(hcipy_slopes(model), model)


def hcipy_slopes(
    model: InteractionModel,
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return HCIPy's slopes as a function of the OPD ``(n, n)`` on the model's pupil grid."""
    import hcipy

    wfs, diameter_m = pyramid_in(model.instrument), model.instrument.diameter_m
    n_detector = round(wfs.n_subapertures + wfs.image_separation_subap)
    pupil = hcipy.make_pupil_grid(len(model.pupil.coordinates), diameter_m)
    detector = hcipy.make_pupil_grid(
        n_detector * model.pupil.sampling, n_detector * model.instrument.subaperture_m
    )
    sensor = hcipy.ModulatedPyramidWavefrontSensorOptics(
        hcipy.PyramidWavefrontSensorOptics(
            pupil,
            detector,
            separation=wfs.image_separation_subap * model.instrument.subaperture_m,
            pupil_diameter=diameter_m,
            wavelength_0=wfs.wavelength_m,
        ),
        wfs.modulation_lambda_over_d * wfs.wavelength_m / diameter_m,
        num_steps=enough_modulation_points(wfs),
        fast_modulation_method=True,
    )
    amplitude = model.pupil.amplitude

    def slopes(opd_m: NDArray[np.float64]) -> NDArray[np.float64]:
        field = amplitude * np.exp(2j * np.pi * opd_m / wfs.wavelength_m)
        wavefront = hcipy.Wavefront(hcipy.Field(field.ravel(), pupil), wfs.wavelength_m)
        power = sum(image.power for image in sensor.forward(wavefront))
        binned = np.asarray(power).reshape(n_detector, model.pupil.sampling, n_detector, -1)
        # A second forward transform: the images are turned by 180 degrees and change sides.
        return -_slopes(binned.sum(axis=(1, 3))[::-1, ::-1], model.valid)

    return slopes


def _slopes(detector: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return Sx and Sy of a detector frame whose four images fill its corners."""
    n = len(valid)
    low, high = slice(None, n), slice(-n, None)
    images = [[detector[y, x][valid] for x in (low, high)] for y in (low, high)]
    (a, b), (c, d) = images
    return np.asarray(np.concatenate([a + c - b - d, a + b - c - d]) / np.mean(a + b + c + d))


def _push_pull(
    slopes: Callable[[NDArray[np.float64]], NDArray[np.float64]], model: InteractionModel
) -> Measured:
    shapes = model.basis.render(model.pupil.points)[:, MODES]
    seconds, columns = [], []
    with threadpool_limits(limits=1):
        for shape in shapes.T:
            opd_m = np.zeros_like(model.pupil.amplitude)
            opd_m[model.pupil.lit] = STROKE_M * shape
            start = time.perf_counter()
            columns.append((slopes(opd_m) - slopes(-opd_m)) / (2 * STROKE_M))
            seconds.append(time.perf_counter() - start)
    return Measured(seconds=tuple(seconds), columns=np.stack(columns, axis=1))


PEERS: dict[str, Callable[[InteractionModel], Measured]] = {
    "FFT pyramid of tests/physics": fft_reference,
    "HCIPy": hcipy_pyramid,
}
"""By name; a peer that is not installed raises ImportError."""
