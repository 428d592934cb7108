"""OOPAO's pyramid, and its own deformable mirror with its own mis-registration.

Run by an interpreter that has OOPAO, from the repository's root:
``python -m pyrcal_studies.peers_oopao job.npz product.npz``.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray
from OOPAO.DeformableMirror import DeformableMirror
from OOPAO.MisRegistration import MisRegistration
from OOPAO.Pyramid import Pyramid
from OOPAO.Source import Source
from OOPAO.Telescope import Telescope

from pyrcal_studies.peers_pushpull import (
    Array,
    Bench,
    job_and_product,
    push_pull,
    read_job,
    write_product,
)

COUPLING = 0.35
"""Of OOPAO's Gaussian influence functions."""

_FACES = ([1, 1, 0, 0], [1, 0, 0, 1])
"""Row and column of the quadrant that each of its faces lights."""


class Oopao:
    """Its telescope, its pyramid, its own choice of valid pixels."""

    def __init__(self, bench: Bench) -> None:
        self.version = version("OOPAO")
        self._moved_px = np.zeros(2)
        self.telescope = _telescope(bench)
        star = Source(optBand="I", magnitude=0)
        star * self.telescope
        self.wavelength_m = float(star.wavelength)
        self.sensor = Pyramid(
            nSubap=bench.n_subapertures,
            telescope=self.telescope,
            modulation=_modulation(bench),
            lightRatio=0.5,
            n_pix_separation=bench.pupil_separation_subap - bench.n_subapertures,
            nTheta_user_defined=bench.n_modulation,
        )
        self.sensor.nJobs = 1
        self.sensor.compute_focal_plane = False
        self.valid: NDArray[np.bool_] = np.asarray(self.sensor.validI4Q)

    def frame(self, opd_m: Array) -> Array:
        """Return the frame of its detector."""
        self.slopes(opd_m)
        return np.array(self.sensor.cam.frame)

    def slopes(self, opd_m: Array) -> Array:
        """Return its slopes maps, cropped to its valid pixels."""
        self.sensor.wfs_measure(phase_in=2 * np.pi / self.wavelength_m * opd_m)
        return np.array(self.sensor.signal)

    def move_images(self, columns_px: float, rows_px: float) -> None:
        """Tilt the faces of the pyramid together."""
        self._moved_px = np.array([columns_px, rows_px])
        self.tilt_faces(np.zeros((2, 2, 2)))

    def tilt_faces(self, offsets_px: Array) -> None:
        """Tilt each face of the pyramid by itself."""
        columns, rows = (offsets_px + self._moved_px)[_FACES].T
        self.sensor.apply_shift_wfs(sx=list(columns), sy=list(-rows))


def _telescope(bench: Bench) -> Telescope:
    if bench.as_shipped:
        return Telescope(
            resolution=bench.n_pupil,
            diameter=bench.diameter_m,
            centralObstruction=bench.obscuration_ratio,
        )
    amplitude = bench.amplitude()
    return Telescope(
        resolution=bench.n_pupil,
        diameter=bench.diameter_m,
        pupil=amplitude > 0.0,
        pupilReflectivity=amplitude**2,
    )


def _modulation(bench: Bench) -> float:
    """Return the radius in its unit: its tilts rise by the wavelength from first to last sample."""
    if bench.as_shipped:
        return bench.modulation_lambda_over_d
    return bench.modulation_lambda_over_d * (bench.n_pupil - 1) / bench.n_pupil


def mirror_of(peer: Oopao, bench: Bench, positions_m: Array, pitch_m: float) -> DeformableMirror:
    """Return its own mirror, with its Gaussian influence functions."""
    return DeformableMirror(
        telescope=peer.telescope,
        nSubap=round(bench.diameter_m / pitch_m),
        coordinates=positions_m,
        pitch=pitch_m,
        mechCoupling=COUPLING,
        print_dm_properties=False,
    )


def subaperture_m(bench: Bench) -> float:
    """Return the width of a subaperture in its metres.

    Its pixels are 1 / (n - 1) of the pupil wide, so that its mirror and its shifts come out smaller
    by (n - 1) / n.
    """
    return bench.diameter_m / bench.n_subapertures * bench.n_pupil / (bench.n_pupil - 1)


def misregistration(bench: Bench, alpha: Sequence[float]) -> MisRegistration:
    """Return shift x, y (subapertures), rotation (degrees) and magnification as it has them.

    Its shifts are in metres and move the mirror the other way.
    """
    x_subap, y_subap, rotation_deg, magnification = alpha
    moved = MisRegistration()
    moved.shiftX, moved.shiftY = -x_subap * subaperture_m(bench), -y_subap * subaperture_m(bench)
    moved.rotationAngle, moved.magnification = rotation_deg, magnification - 1.0
    return moved


def from_misregistration(bench: Bench, found: MisRegistration) -> list[float]:
    """Return what it has for a registration as ``misregistration`` takes it."""
    shifts = [-float(m) / subaperture_m(bench) for m in (found.shiftX, found.shiftY)]
    return [*shifts, float(found.rotationAngle), 1.0 + float(found.magnification)]


def own_mirror(
    peer: Oopao, bench: Bench, positions_m: Array, pitch_m: float
) -> tuple[Array, Array]:
    """Return its influence functions ``(n_actuators, n, n)``: registered, and misregistered."""
    if bench.misregistration is None:
        raise ValueError("OOPAO's own mirror: found no misregistration in the job")
    mirror = mirror_of(peer, bench, positions_m, pitch_m)
    elsewhere = mirror.apply_mis_registration(misregistration(bench, bench.misregistration))
    shape = (-1, bench.n_pupil, bench.n_pupil)
    return mirror.modes.T.reshape(shape), elsewhere.modes.T.reshape(shape)


def main() -> None:
    """Measure what the job asks for."""
    job, product = job_and_product()
    bench, arrays = read_job(job)
    peer = Oopao(bench)
    if bench.misregistration is None:
        write_product(product, push_pull(peer, arrays["shapes_m"], bench))
        return
    registered, elsewhere = own_mirror(peer, bench, arrays["positions_m"], float(arrays["pitch_m"]))
    shapes_m = np.tensordot(arrays["mode_to_actuator"].T, elsewhere, axes=1)
    measured = push_pull(peer, shapes_m, bench)
    write_product(product, measured, influence_functions=registered.astype(np.float32))


if __name__ == "__main__":
    main()
