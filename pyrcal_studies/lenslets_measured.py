"""Push-pull on a peer's own Shack-Hartmann; needs numpy alone, inside the peer's environment.

Run from the repository's root by an interpreter that has the peer:
``python -m pyrcal_studies.lenslets_measured oopao job.npz product.npz``.
"""

from __future__ import annotations

import logging
import sys
import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Measure = Callable[[Array], Array]

PUSH_M = 1e-9
"""Push and pull, metres RMS."""


def oopao(job: dict[str, Array]) -> tuple[Measure, Array]:
    """Return how OOPAO makes slopes ``(2, n_valid)`` of an OPD, and its valid subapertures."""
    from OOPAO.ShackHartmann import ShackHartmann
    from OOPAO.Source import Source
    from OOPAO.Telescope import Telescope

    amplitude = job["amplitude"]
    telescope = Telescope(
        resolution=len(amplitude),
        diameter=float(job["diameter_m"]),
        pupil=amplitude > 0.0,
        pupilReflectivity=amplitude**2,
    )
    star = Source(optBand="I", magnitude=0)
    star * telescope
    if not np.isclose(star.wavelength, job["wavelength_m"]):
        raise ValueError(f"OOPAO: found {star.wavelength}, expected {job['wavelength_m']}")
    sensor = ShackHartmann(
        nSubap=int(job["n_subapertures"]),
        telescope=telescope,
        lightRatio=0.5,
        threshold_cog=float(job["threshold"]),
        n_pixel_per_subaperture=int(job["n_pixels"]),
    )

    def measure(opd_m: Array) -> Array:
        phase = 2 * np.pi / star.wavelength * opd_m
        _, signal, _ = sensor.wfs_measure(star, sensor.sh_data["src_0"], phase_in=phase)
        return np.array(signal)

    return measure, np.array(sensor.valid_subapertures)


def specula(job: dict[str, Array]) -> tuple[Measure, Array]:
    """Return how SPECULA makes slopes of an OPD, and its valid subapertures."""
    import specula as package

    package.init(device_idx=-1, precision=0, log_level=logging.WARNING)
    from specula.data_objects.electric_field import ElectricField
    from specula.data_objects.pixels import Pixels
    from specula.processing_objects.sh import SH
    from specula.processing_objects.sh_slopec import ShSlopec
    from specula.processing_objects.sh_subap_calibrator import ShSubapCalibrator

    side, n = len(job["amplitude"]), int(job["n_subapertures"])
    n_pixels, pitch_m = int(job["n_pixels"]), float(job["diameter_m"]) / side
    scale = np.degrees(float(job["wavelength_m"]) * n / float(job["diameter_m"])) * 3600
    field = ElectricField(side, side, pitch_m, S0=1e6)
    field.A = job["amplitude"]
    sensor = SH(
        wavelengthInNm=float(job["wavelength_m"]) * 1e9,
        subap_wanted_fov=n_pixels * scale,
        sensor_pxscale=scale,
        subap_on_diameter=n,
        subap_npx=n_pixels,
        # twice as fine, its default, it stretches the pupil by a sample and moves it by a quarter
        fov_ovs_coeff=1.0,
    )
    sensor.inputs["in_ef"].set(field)
    sensor.setup()
    pixels, now = Pixels(n * n_pixels, n * n_pixels), 0

    def frame(opd_m: Array) -> Array:
        nonlocal now
        now += 1
        field.phaseInNm = opd_m * 1e9
        field.generation_time = now
        _run(sensor, now)
        return np.array(sensor.outputs["out_i"].i)

    pixels.pixels = frame(np.zeros((side, side)))
    pixels.generation_time = now
    with tempfile.TemporaryDirectory() as folder:
        calibrator = ShSubapCalibrator(n, folder, energy_th=0.5, output_tag="lenslets")
        calibrator.inputs["in_pixels"].set(pixels)
        calibrator.setup()
        _run(calibrator, now)
    slopes = ShSlopec(calibrator.subaps, thr_ratio_value=float(job["threshold"]))
    slopes.inputs["in_pixels"].set(pixels)
    slopes.setup()
    first = np.array(calibrator.subaps.idxs)[:, 0]
    row, column = first // (n * n_pixels) // n_pixels, first % (n * n_pixels) // n_pixels
    listed = np.lexsort((column, row))
    valid = np.zeros((n, n), dtype=bool)
    valid[row, column] = True

    def measure(opd_m: Array) -> Array:
        pixels.pixels = frame(opd_m)
        pixels.generation_time = now
        _run(slopes, now)
        vector = np.array(slopes.outputs["out_slopes"].slopes).reshape(2, -1)
        return vector[:, listed].reshape(-1) * n_pixels / 2

    return measure, valid


def _run(step: Any, now: int) -> None:  # noqa: ANN401 - SPECULA has no types
    step.check_ready(now)
    step.trigger()
    step.post_trigger()


def main() -> None:
    """Measure what the job asks for."""
    peer, job_path, product = sys.argv[1:]
    with np.load(job_path) as file:
        job = dict(file)
    measure, valid = {"oopao": oopao, "specula": specula}[peer](job)
    columns = []
    for shape in job["shapes"]:
        opd_m = PUSH_M * shape.astype(float)
        columns.append((measure(opd_m) - measure(-opd_m)) / (2 * PUSH_M))
    np.savez(product, matrix=np.stack(columns, axis=1), valid=valid)


if __name__ == "__main__":
    main()
