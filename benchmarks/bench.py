"""pyrcal beside OOPAO, HCIPy and SPECULA: the same work, alternating, in one run.

Run: ``make bench``, or ``python -m benchmarks.bench [--rounds 5] [--page FILE.md]``. Each
peer comes from its package into an environment of its own under ``var/peers`` and works in a
process of its own; all have one thread, and processor time is counted: a machine that others use is
slower for all. Writes the section ``bench`` of docs/results/speed.md and its plot.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from benchmarks import plant
from benchmarks.peer_rounds import cpu_s
from pyrcal.fitting.fit_file import fit_file, make_reference
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.fitting.recorded import read_recorded
from pyrcal.fitting.report import FitReport
from pyrcal_studies.peers import (
    LISTINGS,
    N_MODES,
    ROOT,
    SMALL,
    Case,
    bench,
    environment,
    error,
    in_degrees,
    instrument,
    job_arrays,
    measured,
    variables,
    write_instrument,
    write_reference,
)
from pyrcal_studies.peers_pushpull import Array, Measured, read_product, write_job
from pyrcal_studies.shared import RESULTS, study_parser, write_section
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import PARAMETERS, Misregistration
from service.model.modes import Basis, ModalBasis, karhunen_loeve_basis, modal_basis


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One piece of work, by pyrcal and by a peer."""

    what: str
    peer: str
    own_s: tuple[float, ...]
    """Of pyrcal, round by round."""

    peer_s: tuple[float, ...]
    """Of the peer, in the same rounds."""

    remark: str
    """How far the two differ."""

    @property
    def spread(self) -> tuple[float, float, float]:
        """Time of the peer over ours: median over the rounds, least and most."""
        ratios = np.array(self.peer_s) / np.array(self.own_s)
        return float(np.median(ratios)), float(ratios.min()), float(ratios.max())


@dataclass(frozen=True, slots=True, kw_only=True)
class Alone:
    """One figure of pyrcal's that no peer has."""

    what: str
    found: str
    asked: str


def section(rows: Sequence[Row], alone: Sequence[Alone], facts: Sequence[str]) -> str:
    """Return the section of docs/results/speed.md in Markdown: one row for each piece of work."""
    lines = [
        "| Work | pyrcal, s | Other code, s | Ratio: median (range over rounds) |",
        "| --- | --- | --- | --- |",
    ]
    for what, group in groupby(rows, lambda row: row.what):
        compared = list(group)
        own = _figure(float(np.median(compared[0].own_s)))
        peers = "; ".join(f"{row.peer} {_figure(float(np.median(row.peer_s)))}" for row in compared)
        lines.append(f"| {what} | {own} | {peers} | {'; '.join(map(_ratio, compared))} |")
    remarks = list(dict.fromkeys(f"{row.peer}: {row.remark}" for row in rows))
    remarks += [f"{one.what}: {one.found}; target {one.asked}" for one in alone]
    return "\n".join([*lines, "", *(f"- {line}" for line in [*remarks, *facts])])


def plot(path: Path, rows: Sequence[Row]) -> None:
    """Draw how many times faster pyrcal is, row by row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 0.36 * len(rows) + 1.0), layout="constrained")
    axes = figure.subplots()
    at = np.arange(len(rows))[::-1]
    middle, low, high = np.array([row.spread for row in rows]).T
    axes.barh(
        at,
        middle,
        xerr=(middle - low, high - middle),
        color="#4477aa",
        ecolor="#222222",
        height=0.7,
    )
    axes.set_yticks(at, [f"{row.what}: {row.peer.split(',')[0]}" for row in rows], fontsize=8)
    axes.set_xscale("log")
    axes.axvline(1.0, color="#222222", linewidth=0.8)
    axes.set_xlabel("processor time of the peer over pyrcal's")
    axes.grid(axis="x", alpha=0.4)
    figure.savefig(path, dpi=90)


def _ratio(row: Row) -> str:
    middle, low, high = row.spread
    spread = f" ({_figure(low)} to {_figure(high)})" if len(row.own_s) > 1 else ""
    return f"{_figure(middle)}{spread}"


def _figure(value: float) -> str:
    """Return a figure with as many digits as it is worth."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


INGEST_S = 20
COPIED = 64 * 2**20
"""Numbers that are copied to see what memory can do, float32."""


def alone_rows(
    gflops: float, shift_s: Mapping[int, float], peers_mb: Mapping[str, float]
) -> list[Alone]:
    """Return the figures; ``shift_s`` is what D at a new shift took, by its number of modes."""
    model = InteractionModel(*_flao())
    n_bytes = 4.0 * model.n_slopes * int(model.pupil.lit.sum())
    copy_s = _copy_s_per_byte() * n_bytes
    rows = []
    for n_modes, took_s in shift_s.items():
        floor_s = model.sensor.work(n_modes).flop / gflops / 1e9
        rows.append(
            Alone(
                what=f"D of {n_modes} modes at a new shift: its products at this machine's rate",
                found=f"{floor_s:.3f} s, took {took_s / floor_s:.2f} times as long; to copy the "
                f"sensor's Jacobian once, {n_bytes / 1e6:.0f} MB, takes {copy_s:.4f} s",
                asked="2 times",
            )
        )
    others = ", ".join(f"{peer} {mb:.0f}" for peer, mb in peers_mb.items())
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        own_mb = pool.submit(_own_peak_mb).result()
    rows.append(
        Alone(
            what="memory of a process with FLAO's modes, D and four derivatives",
            found=f"{own_mb:.0f} MB; peers that have pushed some modes, MB: {others}",
            asked="-",
        )
    )
    return [*rows, _ingest()]


def peak_mb(pid: int | str) -> float:
    """Return the most memory that a process has had, as Linux counts it."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    return float(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e6


def _flao() -> tuple[Instrument, Basis]:
    instrument = load_instrument("flao-lbt")
    return instrument, modal_basis(instrument)


def _own_peak_mb() -> float:
    InteractionModel(*_flao()).linearise(Misregistration(shift_x_subap=0.1, rotation_rad=0.01))
    return peak_mb("self")


def _copy_s_per_byte() -> float:
    """Return what a byte takes that is read and written."""
    numbers, out = np.ones(COPIED, np.float32), np.empty(COPIED, np.float32)
    took_s = []
    for _ in range(5):
        begun = time.process_time()
        np.copyto(out, numbers)
        took_s.append(time.process_time() - begun)
    return min(took_s) / numbers.nbytes


def _ingest() -> Alone:
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "ingest.json"
        command = [sys.executable, "-m", "benchmarks.ingest", "--seconds", str(INGEST_S)]
        subprocess.run([*command, "--json", str(answer)], check=True, stdout=subprocess.DEVNULL)
        seen = json.loads(answer.read_text(encoding="utf-8"))
    return Alone(
        what=f"telemetry at {seen['frame_rate_hz']:.0f} Hz, {seen['bytes_per_frame'] / 1e3:.1f} kB "
        f"a frame, {INGEST_S} s, beside a worker that computes without pause",
        found=f"{seen['frames_lost']} of {seen['frames_sent']} frames lost, "
        f"{seen['frames_overwritten']} overwritten; {1e3 * seen['latency_p50_s']:.1f} ms late, "
        f"{1e3 * seen['latency_p99_s']:.0f} ms at 99 %",
        asked="none lost",
    )


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
PAGE = RESULTS / "speed.md"


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
        rounds.frame_ms.setdefault("pyrcal", []).append(plant.measure(1))
        oopao_ms = plant.measure_oopao(str(environment("oopao")))
        rounds.frame_ms.setdefault("oopao", []).append(oopao_ms)
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
                peer="SPRINT, sensitivities made before",
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
            peer=f"SPRINT with {N_SPRINT} modes, sensitivities included",
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
        "first594": ("D of 594 modes, nothing cached", N_ALL),
        "shift400": ("D of 400 modes at a new shift", N_MODES),
        "shift594": ("D of 594 modes at a new shift", N_ALL),
        "turn594": ("D of 594 modes at a new rotation and magnification", N_ALL),
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
    """Measure, then write the section and the plot."""
    parser = study_parser("benchmarks.bench", __doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--page", type=Path, default=PAGE, help="page with a section 'bench'")
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
    text = section(rows, alone, told)
    print(text)
    write_section(given.page, "bench", text)
    plot(given.page.with_name("bench.png"), rows)
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
