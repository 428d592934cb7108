"""SPECULA's modulated pyramid, its calibrated pupils, its own slopes.

Run by an interpreter that has SPECULA, from the repository's root:
``python -m pyrcal_studies.peers_specula job.npz product.npz``.
"""

from __future__ import annotations

import logging
import tempfile
from importlib.metadata import version

import numpy as np
import specula
from numpy.typing import NDArray

specula.init(device_idx=-1, precision=0, log_level=logging.WARNING)

from specula.data_objects.electric_field import ElectricField  # noqa: E402 - after init alone
from specula.data_objects.pixels import Pixels  # noqa: E402
from specula.data_objects.pupdata import PupData  # noqa: E402
from specula.data_objects.simul_params import SimulParams  # noqa: E402
from specula.processing_objects.modulated_pyramid import ModulatedPyramid  # noqa: E402
from specula.processing_objects.pyr_pupdata_calibrator import (  # noqa: E402
    PyrPupdataCalibrator,
)
from specula.processing_objects.pyr_slopec import PyrSlopec  # noqa: E402

from pyrcal_studies.peers_pushpull import (  # noqa: E402
    Array,
    Bench,
    job_and_product,
    push_pull,
    read_job,
    roof,
    write_product,
)

_RAD_TO_ARCSEC = 180 / np.pi * 3600
_MARGIN_SUBAP = 1
"""Dark border of the pupil grid, in which the pupil is moved."""

_FFT_RESOLUTION = 2.5
"""Padding of the focal plane: makes whole pixels and an easy FFT for 30 subapertures."""

_LIGHTS = -1
"""Its faces light the quadrants opposite."""

_LIGHT_RATIO = 0.45
"""Of the brightest pixel: its own default takes the light diffracted between images for pupil."""


class Specula:
    """A grey pupil, its pyramid without noise, its pupils found by its own calibrator."""

    def __init__(self, bench: Bench) -> None:
        self.version = version("specula")
        self.wavelength_m = bench.wavelength_m
        self._bench = bench
        self._pitch_m = bench.diameter_m / bench.n_pupil
        self._margin = _MARGIN_SUBAP * bench.sampling
        n = bench.n_pupil + 2 * self._margin
        self._field = ElectricField(n, n, self._pitch_m, S0=1e6)
        self._amplitude, self._moved = bench.amplitude(), (0, 0)
        self._pixels = Pixels(bench.n_detector, bench.n_detector)
        self._now = 0
        self._pyramid = self._make_pyramid()
        pupils = self._find_pupils()
        self._slopes = PyrSlopec(pupils, norm_factor=None)
        self._slopes.inputs["in_pixels"].set(self._pixels)
        self._slopes.setup()
        quadrant = np.array(pupils.single_mask()) > 0
        margin = (len(quadrant) - bench.n_subapertures) // 2
        inner = slice(margin, margin + bench.n_subapertures)
        self.valid: NDArray[np.bool_] = quadrant[inner, inner]
        if self.valid.sum() != quadrant.sum():
            raise ValueError("SPECULA: valid subapertures outside the pupil's square")

    def move_images(self, columns_px: float, rows_px: float) -> None:
        """Move the pupil, and what is in it, by whole samples.

        Its own ``pup_shifts`` also stretches the images and adds an eighth of a subaperture; the
        faces of ``pyr_tlt_coeff`` no longer meet at the edges.
        """
        samples = np.array([rows_px, columns_px]) * self._bench.sampling
        whole = np.rint(samples).astype(int)
        if np.abs(samples - whole).max() > 1e-9 or np.abs(whole).max() > self._margin:
            raise ValueError(
                f"SPECULA: found a move of {samples.tolist()} samples; expected whole ones, "
                f"at most {self._margin}"
            )
        self._moved = (int(whole[0]), int(whole[1]))

    def tilt_faces(self, offsets_px: Array) -> None:
        """Give the pyramid another face for each image: its own coefficients part the faces."""
        pyramid, separation = self._pyramid, self._bench.pupil_separation_subap
        n = len(pyramid.pyr_tlt)
        along = (np.arange(n) - (n - 1) / 2) / (pyramid.tilt_scale * separation / 2)
        high = roof(along, along[:, None], separation, offsets_px, _LIGHTS)
        faces = np.exp(2j * np.pi * (high - high.max()))
        pyramid.shifted_masked_exp = np.fft.fftshift(faces * pyramid.fp_mask)

    def frame(self, opd_m: Array) -> Array:
        """Return the intensity on its detector."""
        self._now += 1
        self._field.A = self._placed(self._amplitude)
        self._field.phaseInNm = self._placed(opd_m * 1e9)
        self._field.generation_time = self._now
        _run(self._pyramid, self._now)
        return np.array(self._pyramid.outputs["out_i"].i)

    def slopes(self, opd_m: Array) -> Array:
        """Return the vector of its slope computer."""
        self._pixels.pixels = self.frame(opd_m)
        self._pixels.generation_time = self._now
        _run(self._slopes, self._now)
        return np.array(self._slopes.outputs["out_slopes"].slopes)

    def _placed(self, on_pupil: Array) -> Array:
        return np.roll(np.pad(on_pupil, self._margin), self._moved, axis=(0, 1))

    def _make_pyramid(self) -> ModulatedPyramid:
        bench = self._bench
        across_subap = bench.n_subapertures + 2 * _MARGIN_SUBAP
        pyramid = ModulatedPyramid(
            SimulParams(pixel_pupil=len(self._field.A), pixel_pitch=self._pitch_m),
            wavelengthInNm=bench.wavelength_m * 1e9,
            fov=bench.wavelength_m / self._pitch_m * _RAD_TO_ARCSEC,
            pup_diam=across_subap,
            output_resolution=bench.n_detector,
            # Its tilts rise by the wavelength from the first sample to the last.
            mod_amp=bench.modulation_lambda_over_d * (len(self._field.A) - 1) / bench.n_pupil,
            mod_step=bench.n_modulation,
            pup_dist=bench.pupil_separation_subap,
            pup_margin=1,
            fft_res=_FFT_RESOLUTION,
        )
        pyramid.inputs["in_ef"].set(self._field)
        pyramid.setup()
        return pyramid

    def _find_pupils(self) -> PupData:
        self._pixels.pixels = self.frame(np.zeros((self._bench.n_pupil, self._bench.n_pupil)))
        self._pixels.generation_time = self._now
        with tempfile.TemporaryDirectory() as folder:
            calibrator = PyrPupdataCalibrator(folder, thr1=_LIGHT_RATIO, save_on_exit=False)
            calibrator.inputs["in_pixels"].set(self._pixels)
            calibrator.setup()
            _run(calibrator, self._now)
        pupils: PupData = calibrator.outputs["out_pupdata"]
        return pupils


def _run(step: object, now: int) -> None:
    step.check_ready(now)  # type: ignore[attr-defined]
    step.trigger()  # type: ignore[attr-defined]
    step.post_trigger()  # type: ignore[attr-defined]


def main() -> None:
    """Measure what the job asks for."""
    job, product = job_and_product()
    bench, arrays = read_job(job)
    write_product(product, push_pull(Specula(bench), arrays["shapes_m"], bench))


if __name__ == "__main__":
    main()
