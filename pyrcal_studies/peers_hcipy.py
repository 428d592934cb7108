"""HCIPy's modulated pyramid, its detector, its own slopes (normalised in each subaperture).

Run by an interpreter that has HCIPy, from the repository's root:
``python -m pyrcal_studies.peers_hcipy job.npz product.npz``.
"""

from __future__ import annotations

import warnings
from importlib.metadata import version

import hcipy
import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.peers_pushpull import (
    Array,
    Bench,
    fold,
    job_and_product,
    push_pull,
    read_job,
    roof,
    write_product,
)

_LIGHT_RATIO = 0.5
_REFRACTIVE_INDEX = 1.5
"""Of its pyramid, as it has it by default."""

_LIGHTS = -1
"""Its faces light the quadrants opposite."""


class Hcipy:
    """Its grey annulus, its fast modulation, the pixels of its detector each a subaperture."""

    def __init__(self, bench: Bench) -> None:
        self.version = version("hcipy")
        self.wavelength_m = bench.wavelength_m
        self._bench = bench
        self._pupil = hcipy.make_pupil_grid(bench.n_pupil, bench.diameter_m)
        ring = hcipy.make_obstructed_circular_aperture(bench.diameter_m, bench.obscuration_ratio)
        arm_m = bench.arm_subap * bench.diameter_m / bench.n_subapertures

        def lit(grid: hcipy.Grid) -> hcipy.Field:
            return ring(grid) * (np.minimum(np.abs(grid.x), np.abs(grid.y)) >= arm_m / 2.0)

        self._amplitude = hcipy.evaluate_supersampled(lit, self._pupil, 16)
        self.move_images(0.0, 0.0)
        light = fold(self.frame(np.zeros((bench.n_pupil, bench.n_pupil))))
        quadrant = light >= _LIGHT_RATIO * np.median(light[light > light.max() / 2])
        # The estimator is made for the quadrants; a user keeps what holds the pupil.
        self._estimator = hcipy.PyramidWavefrontSensorEstimator(
            hcipy.Field(quadrant.ravel().astype(float), hcipy.make_pupil_grid(len(quadrant), 1.0))
        )
        margin = (len(quadrant) - bench.n_subapertures) // 2
        inner = slice(margin, margin + bench.n_subapertures)
        self.valid: NDArray[np.bool_] = quadrant[inner, inner]
        if self.valid.sum() != quadrant.sum():
            raise ValueError("HCIPy: valid subapertures outside the pupil's square")

    def move_images(self, columns_px: float, rows_px: float) -> None:
        """Move the detector under the images the other way."""
        bench = self._bench
        pixel_m = bench.diameter_m / bench.n_subapertures
        pixels = hcipy.make_pupil_grid(bench.n_detector, bench.n_detector * pixel_m)
        pixels = pixels.shifted((-columns_px * pixel_m, -rows_px * pixel_m))
        self._detector = hcipy.NoiselessDetector(
            hcipy.make_supersampled_grid(pixels, bench.sampling)
        )
        self._pixels = pixels
        self._optics = hcipy.ModulatedPyramidWavefrontSensorOptics(
            hcipy.PyramidWavefrontSensorOptics(
                self._pupil,
                self._detector.input_grid,
                separation=bench.pupil_separation_subap * pixel_m,
                pupil_diameter=bench.diameter_m,
                wavelength_0=bench.wavelength_m,
            ),
            bench.modulation_lambda_over_d * bench.wavelength_m / bench.diameter_m,
            num_steps=bench.n_modulation,
            fast_modulation_method=True,
        )

    def tilt_faces(self, offsets_px: Array) -> None:
        """Give the pyramid another face for each image, at every position of the modulation."""
        bench, optics = self._bench, self._optics
        pixel_m = bench.diameter_m / bench.n_subapertures

        def surface(grid: hcipy.Grid) -> hcipy.Field:
            high = roof(grid.x, grid.y, bench.pupil_separation_subap, offsets_px, _LIGHTS)
            return hcipy.Field(-high * pixel_m / (_REFRACTIVE_INDEX - 1.0), grid)

        apodizers = optics._pyramid_apodizers  # noqa: SLF001 - it has no other access to its faces
        for place, apodizer in zip(optics.modulation_positions, apodizers, strict=True):
            grid = optics.focal_grid.shifted(2 * place)
            sag = hcipy.evaluate_supersampled(surface, grid, 4)
            apodizer.surface_sag = hcipy.Field(sag, optics.focal_grid)

    def frame(self, opd_m: Array) -> Array:
        """Return the frame of its detector."""
        return np.array(self._read_out(opd_m).shaped)

    def slopes(self, opd_m: Array) -> Array:
        """Return what its estimator makes of the frame: x then y."""
        with warnings.catch_warnings():
            # It warns that a later release will compute something else.
            warnings.simplefilter("ignore", RuntimeWarning)
            estimate = self._estimator.estimate(self._read_out(opd_m))
        return np.array(estimate).ravel()

    def _read_out(self, opd_m: Array) -> hcipy.Field:
        field = self._amplitude * np.exp(2j * np.pi / self.wavelength_m * opd_m.ravel())
        wavefront = hcipy.Wavefront(hcipy.Field(field, self._pupil), self.wavelength_m)
        for image in self._optics.forward(wavefront):
            self._detector.integrate(image, 1.0)
        # The detector's own ``subsampling`` is never applied when it is read out.
        return hcipy.subsample_field(
            self._detector.read_out(), self._bench.sampling, self._pixels, statistic="sum"
        )


def main() -> None:
    """Measure what the job asks for."""
    job, product = job_and_product()
    bench, arrays = read_job(job)
    write_product(product, push_pull(Hcipy(bench), arrays["shapes_m"], bench))


if __name__ == "__main__":
    main()
