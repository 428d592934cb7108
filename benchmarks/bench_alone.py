"""Figures of ``benchmarks.bench`` without a peer: floors, memory, telemetry, the ELT."""

from __future__ import annotations

import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.bench_page import Alone
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import Basis, modal_basis

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


def elt_section() -> str:
    """Return what ``pyrcal_studies.elt`` says: five minutes of processor time, and 4 GB."""
    command = [sys.executable, "-m", "pyrcal_studies.elt"]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return f"\n## A telescope of 39 m\n\n{said.strip()}\n"


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
