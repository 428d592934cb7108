"""SynIM's geometry of several sensors and mirrors, and its interaction matrices.

Run by an interpreter that has SynIM, from the repository's root:
``python -m pyrcal_studies.systems_synim job.npz product.npz``. Nothing of the service's is
imported.
"""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import synim
from numpy.typing import NDArray

synim.init(device_idx=-1, precision=0)

from synim.registration.analysis import covariance_from_noise  # noqa: E402 - after init alone
from synim.registration.model import DM, WFS, GuideStar, System  # noqa: E402
from synim.registration.reconstruction import (  # noqa: E402
    ParameterSpec,
    gauss_newton_invert,
    jacobian,
    local_params_vector,
)
from synim.synim import interaction_matrix  # noqa: E402

Array = NDArray[np.float64]

DOF = ("shift_x", "shift_y", "rotation", "magnification")
"""What a pair's fit tells, lengths in ``pitch_m``, degrees."""


def system(job: dict[str, Array], sensors: Array, mirrors: Array) -> System:
    """Return a system: shift x, y, rotation, magnification of each; stars as the job has them."""
    found = System(pixel_pitch=float(job["pitch_m"]))
    for k, (star, (x, y, turned, size)) in enumerate(zip(job["stars"], sensors, strict=True)):
        guide = GuideStar(name=f"star{k}", position=tuple(star[:2]), height=float(star[2]))
        place = {"shift": (x, y), "rotation": turned, "magnification": size}
        found.add_wfs(WFS(name=f"wfs{k}", guide_star=guide, **place))
    for k, (height, (x, y, turned, size)) in enumerate(
        zip(job["altitudes_m"], mirrors, strict=True)
    ):
        place = {"shift": (x, y), "rotation": turned, "magnification": size}
        found.add_dm(DM(name=f"dm{k}", height=float(height), **place))
    return found


def specs(job: dict[str, Array]) -> list[Any]:
    """Return what is to be found: all four numbers of sensors and mirrors that the job names."""
    return [
        ParameterSpec(kind, f"{kind}{k}", field, component)
        for kind, numbers in (("wfs", job["free_sensors"]), ("dm", job["free_mirrors"]))
        for k in numbers
        for field, component in (
            ("shift", 0), ("shift", 1), ("rotation", None), ("magnification", None)
        )
    ]  # fmt: skip


def geometry(job: dict[str, Array]) -> dict[str, Array]:
    """Return α of every pair for each draw; of the first one, what comes back of it, and σ."""
    drawn = [
        system(job, sensors, mirrors)
        for sensors, mirrors in zip(job["sensors"], job["mirrors"], strict=True)
    ]
    pairs = drawn[0].pairs()
    nominal, wanted = system(job, job["sensors"][0] * 0 + [0, 0, 0, 1],
                             job["mirrors"][0] * 0 + [0, 0, 0, 1]), specs(job)  # fmt: skip
    alphas = [local_params_vector(one, pairs, dof=DOF).reshape(-1, 4) for one in drawn]
    found, _, _ = gauss_newton_invert(nominal, wanted, pairs, alphas[0].ravel(), dof=DOF)
    rates = jacobian(nominal, wanted, pairs, dof=DOF)
    _, sigma = covariance_from_noise(rates, np.tile(job["sigma"], len(pairs)))
    return {"alphas": np.array(alphas), "found": found, "sigma": sigma}


def matrices(job: dict[str, Array]) -> dict[str, Array]:
    """Return the interaction matrix of each pair, ``(n_slopes, n_modes)``."""
    pupil = job["pupil"]
    made = {}
    for s, (star, place) in enumerate(zip(job["stars"], job["matrix_sensors"], strict=True)):
        for m, height in enumerate(job["altitudes_m"]):
            cube = np.moveaxis(job[f"shapes{m}"], 0, -1)
            made[f"matrix_{s}_{m}"] = np.asarray(
                interaction_matrix(
                    float(job["diameter_m"]), pupil, cube, np.ones(cube.shape[:2]),
                    float(height), float(job["matrix_turned"][m]), int(job["n_subapertures"]),
                    4.0, (np.hypot(*star[:2]), np.rad2deg(np.arctan2(star[0], star[1]))),
                    float(star[2]), float(place[2]), tuple(place[:2]), float(place[3]),
                    idx_valid_sa=job["valid"], slope_method=str(job["slope_method"]),
                    specula_convention=False,
                )
            )  # fmt: skip
    return made


def main() -> None:
    """Read a job and write what SynIM says to it."""
    with np.load(Path(sys.argv[1])) as file:
        job = dict(file)
    told = geometry(job) | (matrices(job) if "pupil" in job else {})
    product: dict[str, Any] = {"version": version("synim"), **told}
    np.savez(Path(sys.argv[2]), **product)


if __name__ == "__main__":
    main()
