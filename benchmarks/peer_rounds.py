"""A peer that works on demand: a line of JSON comes in, a line of JSON goes out.

Run by an interpreter that has the peer, from the repository's root:
``python -m benchmarks.peer_rounds oopao job.npz``. ``{"do": "push", "modes": [0, 50]}`` pushes and
pulls modes of the job; ``{"do": "sprint", "alpha": [x, y, deg, magnification]}`` has OOPAO's SPRINT
find a registration of its own mirror. Both write the matrix to the file that ``matrix`` names.
``{"do": "estimate"}`` has SPRINT estimate the registration of the matrix in that file. What they
took is processor time.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pyrcal_studies.peers_pushpull import Array, Bench, Peer, read_job

if TYPE_CHECKING:
    from pyrcal_studies.peers_oopao import Oopao

Result = TypeVar("Result")

PEERS = {"oopao": "Oopao", "hcipy": "Hcipy", "specula": "Specula"}
N_SPRINT = 20
"""Lowest modes that SPRINT is given, as its authors use it."""

SPRINT_ITERATIONS = 6
SPRINT_DIGITS = 6
"""To which it rounds, metres and degrees: its default of a millimetre is .4 % of a subaperture."""


def main() -> None:
    """Answer until the lines end."""
    # peers print: only answers go where they are read
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    name, job = sys.argv[1], Path(sys.argv[2])
    bench, arrays = read_job(job)
    peer = getattr(import_module(f"pyrcal_studies.peers_{name}"), PEERS[name])(bench)
    print(json.dumps({"version": peer.version}), file=answers)
    sprint = None
    for line in sys.stdin:
        asked = json.loads(line)
        if asked["do"] == "push":
            answer = _pushed(peer, arrays["shapes_m"], bench, asked)
        else:
            sprint = sprint or Sprint(peer, arrays, bench)
            matrix = Path(asked["matrix"])
            if asked["do"] == "sprint":
                answer = sprint.found(asked["alpha"], matrix)
            else:
                with np.load(matrix) as product:
                    answer = sprint.estimated(product["matrix"])
        print(json.dumps(answer), file=answers)


def _pushed(peer: Peer, shapes_m: Array, bench: Bench, asked: dict[str, Any]) -> dict[str, Any]:
    """Return what each mode took, seconds."""
    took_s, columns = [], []
    for mode in asked["modes"]:
        opd_m = bench.stroke_m * shapes_m[mode].astype(float)
        begun = time.process_time()
        columns.append((peer.slopes(opd_m) - peer.slopes(-opd_m)) / (2 * bench.stroke_m))
        took_s.append(time.process_time() - begun)
    matrix = np.stack(columns, axis=1)
    np.savez(asked["matrix"], matrix=matrix, valid=peer.valid, wavelength_m=peer.wavelength_m)
    return {"seconds": took_s}


def cpu_s(work: Callable[[], Result]) -> tuple[float, Result]:
    """Return the processor time that something takes, and what comes of it."""
    begun = time.process_time()
    done = work()
    return time.process_time() - begun, done


class Sprint:
    """OOPAO's SPRINT on its own mirror: four parameters, sensitivities at the origin."""

    def __init__(self, peer: Oopao, arrays: dict[str, Array], bench: Bench) -> None:
        from OOPAO.SPRINT import SPRINT

        from pyrcal_studies import peers_oopao

        self._oopao, self._bench, self._valid = peers_oopao, bench, peer.valid
        self.tel, self.ngs, self.wfs = peer.telescope, peer.telescope.src, peer.sensor
        self.dm = peers_oopao.mirror_of(
            peer, bench, arrays["positions_m"], float(arrays["pitch_m"])
        )
        self._basis = type("Basis", (), {"modes": arrays["mode_to_actuator"][:, :N_SPRINT]})()
        self._basis.extra = "KL"
        self.setup_s, self._sprint = cpu_s(lambda: SPRINT(self, self._basis, n_mis_reg=4))

    def found(self, alpha: list[float], matrix: Path) -> dict[str, Any]:
        """Move the mirror, measure, write the matrix, and have SPRINT find where it is."""
        from OOPAO.mis_registration_identification_algorithm import computeMetaSensitivyMatrix

        moved = self._oopao.misregistration(self._bench, alpha)
        measured = computeMetaSensitivyMatrix.interaction_matrix(
            self.ngs, self.tel, self.dm.apply_mis_registration(moved), self.wfs, self._basis.modes
        ).D
        np.savez(matrix, matrix=measured, valid=self._valid, wavelength_m=self.ngs.wavelength)
        return self.estimated(measured)

    def estimated(self, measured: Array) -> dict[str, Any]:
        """Return where SPRINT finds the mirror by a matrix of this sensor."""
        seconds, out = cpu_s(
            lambda: self._sprint.estimate(
                self,
                measured,
                n_iteration=SPRINT_ITERATIONS,
                precision=SPRINT_DIGITS,
                display=False,
                plot=False,
            )
        )
        return {
            "setup_s": self.setup_s,
            "seconds": seconds,
            "alpha": self._oopao.from_misregistration(self._bench, out),
            "converged": bool(self._sprint.validity_flag),
        }


if __name__ == "__main__":
    main()
