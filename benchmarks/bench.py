"""pyrcal beside OOPAO, HCIPy and SPECULA: the same work, alternating, in one run.

Run: ``make bench``, or ``python -m benchmarks.bench [--rounds 5] [--elt] [--page FILE.md]``. Each
peer comes from its package into an environment of its own under ``var/peers`` and works in a
process of its own; all have one thread, and processor time is counted: a machine that others use is
slower for all. Writes the page of results and its plot.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from benchmarks import plant
from benchmarks.bench_alone import alone_rows, elt_section, peak_mb
from benchmarks.bench_page import Row, page, plot
from benchmarks.peer_rounds import cpu_s
from pyrcal.fitting.fit_file import fit_file, make_reference
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.fitting.recorded import read_recorded
from pyrcal.fitting.report import FitReport
from pyrcal_studies.peers import ROOT, environment, measured, variables
from pyrcal_studies.peers_cases import (
    N_MODES,
    SMALL,
    Case,
    bench,
    in_degrees,
    instrument,
    job_arrays,
)
from pyrcal_studies.peers_files import LISTINGS, write_instrument, write_reference
from pyrcal_studies.peers_fits import error
from pyrcal_studies.peers_pushpull import Array, Measured, read_product, write_job
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import PARAMETERS, Misregistration
from service.model.modes import ModalBasis, karhunen_loeve_basis

PEERS = ("oopao", "hcipy", "specula")
MODES = (0, 50, 100, 200, 300, 399)
"""Modes that peers push in each round: every one costs the same."""

N_ALL = 594
N_SPRINT = 20
FAR = (
    (0.1, 0.05, 0.2, 1.002),
    (0.3, 0.15, 0.5, 1.005),
    (0.7, 0.4, 1.0, 1.01),
    (1.3, 0.8, 2.0, 1.02),
    (2.5, 1.5, 3.0, 1.03),
)
"""Registrations that SPRINT and the fit are asked for: subapertures, degrees, ratio."""

FOUND = (0.01, 0.01, 0.03, 0.002)
"""What is off by less has been found."""

PRODUCT = 2000
PAGE = ROOT / "docs" / "results" / "bench.md"


class PeerProcess:
    """A peer in a process of its own, which answers one question after the other."""

    def __init__(self, peer: str, folder: Path) -> None:
        self.peer = peer
        self._matrix = folder / f"{peer}.npz"
        case = Case(peer=peer, stop=Stop.TELESCOPE, alpha=SMALL)
        job = folder / f"{peer}-job.npz"
        own = job_arrays(Case(peer=peer, stop=Stop.TELESCOPE, alpha=SMALL, own_mirror=True))
        write_job(job, bench(case), **job_arrays(case), **own)
        self._process = subprocess.Popen(
            [str(environment(peer)), "-m", "benchmarks.peer_rounds", peer, str(job)],
            cwd=ROOT,
            env=variables(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self.version: str = self._answer()["version"]

    @property
    def peak_mb(self) -> float:
        """Most memory that the process has had."""
        return peak_mb(self._process.pid)

    def __enter__(self) -> PeerProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()

    def ask(self, **question: object) -> tuple[dict[str, Any], Measured]:
        """Return an answer, and the matrix that was measured for it."""
        if self._process.stdin is None:
            raise RuntimeError(f"{self.peer}: it takes no questions")
        print(json.dumps({**question, "matrix": str(self._matrix)}), file=self._process.stdin)
        self._process.stdin.flush()
        answer = self._answer()
        with np.load(self._matrix) as product:
            found = Measured(
                matrix=product["matrix"],
                valid=product["valid"],
                wavelength_m=float(product["wavelength_m"]),
                version=self.version,
                seconds=0.0,
                detector_from_pupil=np.eye(2),
            )
        return answer, found

    def _answer(self) -> dict[str, Any]:
        line = self._process.stdout.readline() if self._process.stdout else ""
        if not line:
            raise RuntimeError(
                f"{self.peer}: its process has ended; run benchmarks.peer_rounds by hand to see why"
            )
        answer: dict[str, Any] = json.loads(line)
        return answer


@dataclass(slots=True)
class Rounds:
    """What each side took, round by round."""

    own_s: dict[str, list[float]] = field(default_factory=dict)
    peer_s: dict[str, list[float]] = field(default_factory=dict)
    """Of one mode."""

    frame_ms: dict[str, list[float]] = field(default_factory=dict)
    gflops: list[float] = field(default_factory=list)


def play(n_rounds: int, peers: Sequence[PeerProcess]) -> tuple[Rounds, dict[str, Measured]]:
    """Have all do the same, one after the other, again and again."""
    whole = load_instrument("flao-lbt")
    bases = {n: karhunen_loeve_basis(_with_modes(n)) for n in (N_MODES, N_ALL)}
    models = {n: InteractionModel(whole, bases[n]) for n in bases}
    for model in models.values():
        model.interaction_matrix(Misregistration())
    rounds, seen = Rounds(), {}
    factor = np.ones((PRODUCT, PRODUCT), dtype=np.float32)
    for k in range(n_rounds):
        step = 0.01 * (k + 1)
        few, every = models[N_MODES], models[N_ALL]
        every.interaction_matrix(Misregistration())  # only the shift is new for the next one
        jobs: dict[str, Callable[[], object]] = {
            "first594": partial(_first, whole, bases[N_ALL], _shifted(step)),
            "shift400": partial(few.interaction_matrix, _shifted(step)),
            "shift594": partial(every.interaction_matrix, _shifted(step)),
            "turn594": partial(every.interaction_matrix, _turned(step)),
            "slopes594": partial(every.linearise, _turned(-step)),
        }
        for name, job in jobs.items():
            rounds.own_s.setdefault(name, []).append(cpu_s(job)[0])
        rounds.gflops.append(2 * PRODUCT**3 / cpu_s(lambda: factor @ factor)[0] / 1e9)
        for peer in peers:
            answer, seen[peer.peer] = peer.ask(do="push", modes=MODES)
            rounds.peer_s.setdefault(peer.peer, []).append(float(np.median(answer["seconds"])))
        rounds.frame_ms.setdefault("pyrcal", []).append(plant.measure(1).step_ms)
        oopao = plant.measure_oopao(str(environment("oopao")), 4)
        rounds.frame_ms.setdefault("oopao", []).append(oopao.step_ms)
        print(f"round {k + 1} of {n_rounds} done", file=sys.stderr, flush=True)
    return rounds, seen


def left_over(peer: str, found: Measured, folder: Path) -> float:
    """Return the share of a peer's columns that the model does not explain at its registration."""
    wide = np.zeros((len(found.matrix), N_MODES))
    wide[:, MODES] = found.matrix
    chosen = FitOptions(modes=np.array(MODES))
    case = Case(peer=peer, stop=Stop.TELESCOPE, alpha=SMALL)
    report = _fit(case, replace(found, matrix=wide), None, folder, chosen)[0]
    return float(report.fit.residual_fraction)


def registrations(oopao: PeerProcess, folder: Path) -> list[Row]:
    """Return SPRINT and the fit on the same 20 modes, and the fit of 400."""
    case = Case(peer="oopao", stop=Stop.TELESCOPE, alpha=SMALL, own_mirror=True)
    product, beside = read_product(measured(case))
    cube = beside["influence_functions"]
    every, every_s = _fit(case, product, cube, folder, FitOptions())
    judged, judged_s = _judged(case, product, cube, folder)
    few = FitOptions(modes=np.arange(N_SPRINT))
    rows, setup_s = [], 0.0
    for alpha in FAR:
        answer, found = oopao.ask(do="sprint", alpha=alpha)
        setup_s = answer["setup_s"]
        wide = np.zeros((len(found.matrix), N_MODES))
        wide[:, :N_SPRINT] = found.matrix
        report, took_s = _fit(case, replace(found, matrix=wide), cube, folder, few)
        off = np.array(answer["alpha"]) - np.array(alpha)
        rows.append(
            Row(
                what=f"α of {N_SPRINT} modes, {', '.join(f'{value:g}' for value in alpha)}",
                peer="OOPAO SPRINT, its sensitivities made before",
                own_s=(took_s,),
                peer_s=(answer["seconds"],),
                remark=f"{_off(off)}; the fit {_off(error(_told(report.fit), alpha))}",
            )
        )
    sprint_s = setup_s + float(np.median([row.peer_s[0] for row in rows]))
    told = {
        "axes, registration, σ, verdict": (judged, judged_s),
        "the same and rival explanations, as `pyrcal fit` prints it": (every.fit, every_s),
    }
    rows += [
        Row(
            what=f"α of 400 modes: {what}",
            peer=f"OOPAO SPRINT with {N_SPRINT} modes, sensitivities and estimate",
            own_s=(took_s,),
            peer_s=(sprint_s,),
            remark=f"the fit {_off(error(_told(fit), in_degrees(SMALL)))}",
        )
        for what, (fit, took_s) in told.items()
    ]
    return rows


def _told(fit: Fit) -> dict[str, Any]:
    alpha = fit.alpha
    values = (*alpha.vector[:2], np.rad2deg(alpha.rotation_rad), alpha.magnification)
    return dict(zip(PARAMETERS, values, strict=True))


def _off(off: Array) -> str:
    """Return how far an answer is off, or that it is none."""
    verdict = "found" if np.all(np.abs(off) <= FOUND) else "**not found**"
    return (
        f"{verdict}: off by {100 * off[0]:+.2f}, {100 * off[1]:+.2f} % subap, {off[2]:+.4f} deg, "
        f"{100 * off[3]:+.3f} %"
    )


def _fit(
    case: Case, found: Measured, cube: Array | None, folder: Path, options: FitOptions
) -> tuple[FitReport, float]:
    """Return what ``pyrcal fit`` makes of a matrix, and the processor time it took."""
    toml, reference = _written(case, found, cube, folder)
    took_s, report = cpu_s(
        lambda: fit_file(load_instrument(str(toml)), reference, options, threads=1)
    )
    return report, took_s


def _judged(case: Case, found: Measured, cube: Array | None, folder: Path) -> tuple[Fit, float]:
    """Return a fit and its verdict, and the processor time that they took from the files on."""
    toml, path = _written(case, found, cube, folder)

    def fitted() -> Fit:
        told = load_instrument(str(toml))
        reference, _ = make_reference(read_recorded(path), told)
        return fit_matrix(told, reference)

    took_s, fit = cpu_s(fitted)
    return fit, took_s


def _written(case: Case, found: Measured, cube: Array | None, folder: Path) -> tuple[Path, Path]:
    """Return an instrument file and the file of a matrix, written."""
    reference, toml = folder / "reference.h5", folder / "instrument.toml"
    write_reference(reference, found, cube)
    write_instrument(toml, reference, case, found, LISTINGS[case.peer], case.stop)
    return toml, reference


def matrix_rows(rounds: Rounds, seen: dict[str, Measured], folder: Path) -> list[Row]:
    """Return the rows about interaction matrices."""
    jobs = {
        "first594": ("D of 594 modes, nothing kept from before", N_ALL),
        "shift400": ("D of 400 modes at a new shift", N_MODES),
        "shift594": ("D of 594 modes at a new shift", N_ALL),
        "turn594": ("D of 594 modes, turned and magnified anew", N_ALL),
        "slopes594": ("D of 594 modes and its four derivatives", 9 * N_ALL),
    }
    names = {"oopao": "OOPAO", "hcipy": "HCIPy", "specula": "SPECULA"}
    rest = {peer: left_over(peer, found, folder) for peer, found in seen.items()}
    return [
        Row(
            what=what,
            peer=f"{names[peer]}, push-pull",
            own_s=tuple(rounds.own_s[job]),
            peer_s=tuple(n_pushed * one_s for one_s in mode_s),
            remark=f"{100 * rest[peer]:.1f} % differ",
        )
        for job, (what, n_pushed) in jobs.items()
        for peer, mode_s in rounds.peer_s.items()
    ]


def frame_row(rounds: Rounds) -> Row:
    """Return the row about a frame of a simulated telescope."""
    return Row(
        what="a frame of the diffractive telescope, 24 points of modulation",
        peer="OOPAO, 4 points a subaperture (ours 3)",
        own_s=tuple(1e-3 * ms for ms in rounds.frame_ms["pyrcal"]),
        peer_s=tuple(1e-3 * ms for ms in rounds.frame_ms["oopao"]),
        remark="atmosphere, mirror, pyramid, noise, control",
    )


def facts(rounds: Rounds, peers: Sequence[PeerProcess]) -> list[str]:
    """Return what the figures are of: versions, machine, floor."""
    ours = [f"pyrcal {version('pyrcal')}", f"numpy {np.__version__}", f"scipy {version('scipy')}"]
    theirs = [f"{peer.peer} {peer.version}" for peer in peers]
    gflops = np.array(rounds.gflops)
    kernels = {
        f"{blas['internal_api']} {blas['version']} with kernels for {blas.get('architecture', '?')}"
        for blas in threadpool_info()
        if blas["user_api"] == "blas"
    }
    return [
        ", ".join([*ours, *theirs, *sorted(kernels)]),
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; one "
        f"thread each; a product of {PRODUCT} x {PRODUCT} float32 at {np.median(gflops):.0f} "
        f"GFLOPS ({gflops.min():.0f} to {gflops.max():.0f} over the rounds)",
        f"{len(gflops)} rounds; processor time; load of {os.getloadavg()[2]:.1f} over the last "
        "quarter of an hour",
    ]


def main() -> int:
    """Measure, write the page and the plot, print the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bench")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--elt", action="store_true", help="the steps of pyrcal_studies.elt as well"
    )
    parser.add_argument("--page", type=Path, default=PAGE)
    given = parser.parse_args()
    with ExitStack() as stack, threadpool_limits(1):
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        peers = [stack.enter_context(PeerProcess(name, folder)) for name in PEERS]
        rounds, seen = play(given.rounds, peers)
        rows = [*matrix_rows(rounds, seen, folder), *registrations(peers[0], folder)]
        rows.append(frame_row(rounds))
        told = facts(rounds, peers)
        alone = alone_rows(
            float(np.median(rounds.gflops)),
            {n: float(np.median(rounds.own_s[f"shift{n}"])) for n in (N_MODES, N_ALL)},
            {peer.peer: peer.peak_mb for peer in peers},
        )
    text = page(rows, alone, told)
    if given.elt:
        text += elt_section()
    given.page.write_text(text, encoding="utf-8")
    plot(given.page.with_suffix(".png"), rows)
    print(given.page.read_text(encoding="utf-8"))
    return 0


def _with_modes(n_modes: int) -> Instrument:
    shared = instrument()
    return replace(shared, modes=replace(shared.modes, n_modes=n_modes))


def _first(telescope: Instrument, modes: ModalBasis, alpha: Misregistration) -> Array:
    return InteractionModel(telescope, modes).interaction_matrix(alpha)


def _shifted(step: float) -> Misregistration:
    return Misregistration(shift_x_subap=step)


def _turned(step: float) -> Misregistration:
    return Misregistration(shift_x_subap=step, rotation_rad=step, magnification=1.0 + step / 10)


if __name__ == "__main__":
    sys.exit(main())
