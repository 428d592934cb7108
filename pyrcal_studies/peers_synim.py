"""SynIM's lenslets: mean gradients of shapes on its pupil, without light or spots.

Run by an interpreter that has SynIM, from the repository's root:
``python -m pyrcal_studies.peers_synim job.npz product.npz``. Nothing is pushed: SynIM
differentiates.
"""

from __future__ import annotations

import time
from importlib.metadata import version

import numpy as np
import synim
from numpy.typing import NDArray

synim.init(device_idx=-1, precision=0)

from synim.synim import interaction_matrix  # noqa: E402 - after init alone

from pyrcal_studies.peers_pushpull import (  # noqa: E402
    Array,
    Bench,
    Measured,
    job_and_product,
    read_job,
    write_product,
)

_LIT = 0.5
"""Share of a full subaperture's light that a valid one has, and of a point's that is pupil."""

_FIELD_ARCSEC = 4.0
"""Of a lenslet: SynIM's slopes are shares of half of it."""

_ON_AXIS, _INFINITELY_FAR, _AT_THE_PUPIL = (0.0, 0.0), float("inf"), 0.0


def valid(bench: Bench) -> NDArray[np.bool_]:
    """Return the lenslets that have half their light, ``(n, n)``."""
    n, step = bench.n_subapertures, bench.sampling
    light = np.square(bench.amplitude()).reshape(n, step, n, step).mean(axis=(1, 3))
    return np.asarray(light >= _LIT)


def matrix(bench: Bench, shapes_m: Array) -> Array:
    """Return SynIM's matrix ``(n_slopes, n_modes)`` of shapes that lie where they are."""
    cube = np.moveaxis(shapes_m, 0, -1)
    made = interaction_matrix(
        bench.diameter_m,
        (bench.amplitude() >= _LIT).astype(float),
        cube,
        np.ones(cube.shape[:2]),
        _AT_THE_PUPIL,
        0.0,
        bench.n_subapertures,
        _FIELD_ARCSEC,
        _ON_AXIS,
        _INFINITELY_FAR,
        0.0,
        (0.0, 0.0),
        1.0,
        idx_valid_sa=np.flatnonzero(valid(bench)),
        slope_method="derivatives",
        specula_convention=False,
    )
    return np.asarray(made) * 1e9  # its commands are nanometres


def main() -> None:
    """Make what the job asks for."""
    job, product = job_and_product()
    bench, arrays = read_job(job)
    begun = time.perf_counter()
    made = matrix(bench, arrays["shapes_m"])
    write_product(
        product,
        Measured(
            matrix=made,
            valid=valid(bench),
            wavelength_m=bench.wavelength_m,
            version=version("synim"),
            seconds=time.perf_counter() - begun,
            detector_from_pupil=np.eye(2),
        ),
    )


if __name__ == "__main__":
    main()
