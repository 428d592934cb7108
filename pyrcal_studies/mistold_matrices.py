"""Zonal matrices of a bench of twenty subapertures, made by three other codes.

The bench has a square grid of Gaussian influence functions, as simulators ship it. Each peer pushes
every actuator where the registration puts it; modes are combinations of these columns.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.peers import KEPT, REQUIREMENTS, ROOT, environment
from pyrcal_studies.peers_cases import in_degrees, mirror_points
from pyrcal_studies.peers_pushpull import Bench, Measured, read_product, write_job
from service.instrument.mirrors import grid
from service.model.kinds import Stop
from service.model.misregistration import Misregistration

Array = NDArray[Any]

COUPLING = 0.35
"""Height of the true influence functions at a distance of one pitch."""

N_ACROSS, PITCH_M, CIRCLE_M = 21, 0.4, 8.6

NEAR = Misregistration(
    shift_x_subap=0.12, shift_y_subap=-0.08, rotation_rad=np.deg2rad(0.5), magnification=1.004
)
FAR = Misregistration(
    shift_x_subap=0.45, shift_y_subap=0.3, rotation_rad=np.deg2rad(-1.2), magnification=0.99
)
WITH_PUPIL = Misregistration(
    shift_x_subap=0.25, shift_y_subap=-0.25, rotation_rad=np.deg2rad(0.8), magnification=1.006
)
"""In quarters of a subaperture: SPECULA's pupil images move by whole samples."""

FRESH = Misregistration(
    shift_x_subap=-0.33, shift_y_subap=0.21, rotation_rad=np.deg2rad(1.4), magnification=1.011
)
FRESH_FAR = Misregistration(
    shift_x_subap=0.07, shift_y_subap=0.62, rotation_rad=np.deg2rad(-0.7), magnification=0.994
)
FRESH_WITH_PUPIL = Misregistration(
    shift_x_subap=-0.5, shift_y_subap=-0.25, rotation_rad=np.deg2rad(-1.7), magnification=1.013
)
"""Measured after every constant of the fit was set."""

_NAMES = {
    NEAR: "near",
    FAR: "far",
    WITH_PUPIL: "with-pupil",
    FRESH: "fresh",
    FRESH_FAR: "fresh-far",
    FRESH_WITH_PUPIL: "fresh-with-pupil",
}

OBSCURATION, OBSCURED = 0.14, 0.25
"""Linear central obscuration of the bench, and of another whose user believes it to be the same."""

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True, slots=True, kw_only=True)
class ZonalCase:
    """One zonal matrix of one peer."""

    peer: str
    """Name of its package."""

    stop: Stop
    """What moves: the mirror alone, or the pupil images with it."""

    alpha: Misregistration
    """The truth."""

    own_mirror: bool = False
    """Whether the peer's own mirror is moved by its own tools."""

    obscuration_ratio: float = OBSCURATION
    """Of the peer's telescope."""

    @property
    def name(self) -> str:
        """Of its files."""
        kind = "-own-mirror" if self.own_mirror else ""
        kind += "-obscured" if self.obscuration_ratio > OBSCURATION else ""
        return f"{self.peer}-{_NAMES[self.alpha]}{kind}"

    @property
    def bench(self) -> Bench:
        """What the peer is told of the optics."""
        alpha = self.alpha
        moved = self.stop is Stop.MIRROR
        return Bench(
            diameter_m=8.0,
            obscuration_ratio=self.obscuration_ratio,
            n_subapertures=20,
            pupil_separation_subap=26,
            wavelength_m=790e-9,
            modulation_lambda_over_d=3.0,
            n_modulation=20,
            sampling=4,
            image_shift_subap=(alpha.shift_x_subap, alpha.shift_y_subap) if moved else (0.0, 0.0),
            misregistration=in_degrees(alpha) if self.own_mirror else None,
        )


def zonal_cases(peer: str) -> tuple[ZonalCase, ...]:
    """Return the matrices a peer is asked for."""
    asked = [
        ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=NEAR),
        ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=FAR),
        ZonalCase(peer=peer, stop=Stop.MIRROR, alpha=WITH_PUPIL),
    ]
    if peer == "oopao":
        asked.append(ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=NEAR, own_mirror=True))
    return tuple(asked)


def fresh_cases(peer: str) -> tuple[ZonalCase, ...]:
    """Return matrices at registrations that no constant of the fit was chosen on."""
    return (
        ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=FRESH),
        ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=FRESH_FAR),
        ZonalCase(peer=peer, stop=Stop.MIRROR, alpha=FRESH_WITH_PUPIL),
    )


def obscured_case(peer: str) -> ZonalCase:
    """Return the matrix of a telescope that is obscured more than its user says."""
    return ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=FRESH, obscuration_ratio=OBSCURED)


def actuators_m() -> NDArray[np.float64]:
    """Return where the actuators are, ``(n_actuators, 2)``, metres in the pupil plane."""
    return grid(N_ACROSS, PITCH_M, CIRCLE_M)


def measured_zonal(case: ZonalCase) -> Measured:
    """Return the peer's matrix, measured now unless it is kept."""
    told = json.dumps([REQUIREMENTS[case.peer], asdict(case.bench), in_degrees(case.alpha)])
    digest = hashlib.sha256(told.encode()).hexdigest()[:10]
    folder = KEPT / case.peer
    kept = folder / f"zonal-{case.name}-{digest}.npz"
    if not kept.exists():
        print(f"{case.name}: measuring", file=sys.stderr, flush=True)
        interpreter = environment(case.peer)
        job = folder / f"zonal-{case.name}-job.npz"
        write_job(job, case.bench, **_pushed(case))
        subprocess.run(
            [str(interpreter), "-m", f"pyrcal_studies.peers_{case.peer}", str(job), str(kept)],
            cwd=ROOT,
            env={**os.environ, **_ONE_THREAD, "MPLBACKEND": "Agg"},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        job.unlink()
    return read_product(kept)[0]


def _pushed(case: ZonalCase) -> dict[str, Array]:
    """Return the actuators' shapes where they lie, or what the peer's own mirror is made of."""
    positions_m = actuators_m()
    if case.own_mirror:
        return {
            "positions_m": positions_m,
            "pitch_m": np.array(PITCH_M),
            "mode_to_actuator": np.eye(len(positions_m)),
        }
    bench = case.bench
    points = mirror_points(bench, case.alpha, case.stop)
    metres = points * bench.diameter_m / bench.n_subapertures
    apart = np.linalg.norm(metres - positions_m[:, None], axis=2)
    shapes = COUPLING ** ((apart / PITCH_M) ** 2)
    return {"shapes_m": shapes.reshape(-1, bench.n_pupil, bench.n_pupil)}


def main() -> int:
    """Measure what is not yet measured, of the peers named."""
    for peer in sys.argv[1:]:
        for case in (*zonal_cases(peer), *fresh_cases(peer), obscured_case(peer)):
            measured = measured_zonal(case)
            print(case.name, measured.matrix.shape, f"{measured.seconds:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
