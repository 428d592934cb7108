"""When the outer ring of the mirror slips, and whether the service's watch sees it.

Runs mis-registered loops on the diffractive telescope, prints the wavefront error of every half
second, when the watch on the outer ring speaks, and what the gate knew beforehand: the worst pole
radius and the motion of the outer ring per unit of slope noise. A case is modes:registration:leak;
without one all of docs/results/reliability.md are run. The matrix is that of a registered mirror,
or with ``--registered`` the right one.
Run: ``python -m pyrcal_studies.edge_slip --case 594:0,0,0,1.025:1.0 --case 400:0.3,0,0,1:1.0``.
"""

from __future__ import annotations

import argparse
import sys
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from service.control.gains import gain_table
from service.control.gate import compute_edge_motion_m
from service.control.loop import ControlLoop, pole_radius
from service.control.reconstructor import invert
from service.estimation.description import Actuators, edge_watch
from service.estimation.frames import FrameBlock
from service.estimation.health import EdgeHealth, observe_edge
from service.files import parse_alpha
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import ModalBasis, karhunen_loeve_basis
from service.records.registration import ModeGain
from sim_rtc.assembly import build_telescope
from sim_rtc.computer.feed import BATCH_FRAMES
from sim_rtc.computer.loop import LoopTerms, ModalLoop
from sim_rtc.options import parse_options

CASES = (
    "400:0,0,0,1:1.0",
    "400:0.3,0,0,1:1.0",
    "400:0,0,0,1.035:1.0",
    "500:0,0,0,1:0.999",
    "500:0,0,0,1.02:0.999",
    "594:0,0,0,1:1.0",
    "594:0,0,0,1.015:1.0",
    "594:0,0,0,1.025:1.0",
    "594:0,0,0,1:0.999",
    "594:0,0,0,1.025:0.999",
    "594:0,0,0,1.025:0.99",
)
STROKE_M = 3e-5
N_MEASURED = 4
"""Dithered modes, the highest controlled ones, whose optical gains the gate is given."""


class Case(NamedTuple):
    """One loop."""

    n_controlled: int
    alpha: str
    leak: float


class Outcome(NamedTuple):
    """What became of it."""

    wavefront_nm: NDArray[np.float64]
    """RMS of each half second."""

    first_slip_s: float | None
    """When the watch first spoke."""

    highest_ratio: float
    """Of the watch, after the first half second."""


def parse_case(text: str) -> Case:
    """Return the case that ``modes:registration:leak`` means."""
    n_controlled, alpha, leak = text.split(":")
    return Case(int(n_controlled), alpha, float(leak))


@cache
def modes_of(instrument: Instrument) -> ModalBasis:
    """Return the modes, which take seconds to make."""
    return karhunen_loeve_basis(instrument)


def actuators_of(instrument: Instrument) -> Actuators:
    """Return where the actuators are, and how far each mode moves them."""
    return Actuators(
        positions=instrument.analytic_mirror.positions_m,
        strokes=modes_of(instrument).mode_to_actuator,
    )


def foreseen(
    case: Case, gain: float, model: InteractionModel, matrix: NDArray[np.float32]
) -> tuple[float, float]:
    """Return the pole radius and the motion of the outer ring, metres per unit of slope noise.

    With the optical gains that the gate takes: the highest that the loop may have after a dither of
    a few modes at 1".
    """
    n = case.n_controlled
    coupling = matrix @ model.interaction_matrix(parse_alpha(case.alpha))[:, :n]
    usual = gain_table((), n).optical_gain
    measured = [
        ModeGain(mode=k, gain=float(usual[k]), sigma=0.01, scatter=0.01, t_ns_utc=0)
        for k in range(n - N_MEASURED, n)
    ]
    gains = gain * gain_table(measured, n).highest
    eigenvalues = np.linalg.eigvals(gains[:, None] * coupling)
    actuators = actuators_of(model.instrument)
    outer = actuators.strokes[actuators.outer]
    loop = ControlLoop(gains=gains, leak=case.leak, delay_frames=2.0, frame_rate_hz=1.0)
    motion = compute_edge_motion_m(matrix, coupling, gains, outer, loop)
    return float(pole_radius(eigenvalues, leak=case.leak).max()), motion


def run(
    case: Case, given: argparse.Namespace, instrument: Instrument, matrix: NDArray[np.float32]
) -> Outcome:
    """Run one loop and its watch."""
    options = parse_options(
        f"--plant diffractive --alpha {case.alpha} --seed {given.seed} --mag {given.mag} "
        f"--n-controlled {case.n_controlled} --wind {given.wind},40".split()
    )
    actuators, variance_m2 = actuators_of(instrument), modes_of(instrument).variance_m2
    watch = edge_watch(actuators, variance_m2, np.arange(case.n_controlled))
    if watch is None:
        raise SystemExit(f"{case.n_controlled} modes are too few to watch")
    telescope = build_telescope(options, instrument)
    weights = telescope.weights.astype(np.float32)
    loop = ModalLoop(n_modes=len(telescope.settings.gains), delay_frames=2, stroke_m=STROKE_M)
    gains = np.full(case.n_controlled, given.gain, np.float32)
    health = EdgeHealth()
    errors: list[float] = []
    ratios: list[float] = []
    slips: list[bool] = []
    for block in telescope.feed.blocks():
        terms = LoopTerms.of(block.optics, matrix, gains, case.leak)
        for row in range(0, block.n_frames, BATCH_FRAMES):
            rows = block.run(row, loop, terms, None)
            health = observe_edge(health, _frames(len(errors), rows.slopes, rows.commands_m), watch)
            left = block.phase_at(row + len(rows.commands_m) - 1)
            left = left + block.optics.opd_per_command @ rows.commands_m[-1]
            errors.append(float(weights @ (left - weights @ left) ** 2))
            ratios.append(health.ratio)
            slips.append(health.slipped)
        if len(errors) * BATCH_FRAMES >= given.seconds * options.frame_rate_hz:
            break
    half = round(options.frame_rate_hz / 2 / BATCH_FRAMES)
    whole = np.array(errors[: len(errors) // half * half]).reshape(-1, half)
    first = int(np.argmax(slips)) if any(slips) else None
    return Outcome(
        wavefront_nm=np.sqrt(whole.mean(axis=1)) * 1e9,
        first_slip_s=None if first is None else first * BATCH_FRAMES / options.frame_rate_hz,
        highest_ratio=max(ratios[half:]),
    )


def _frames(batch: int, slopes: NDArray[np.float32], commands_m: NDArray[np.float32]) -> FrameBlock:
    return FrameBlock(
        session="study",
        first_seq=batch * BATCH_FRAMES,
        t0_ns_utc=0,
        dt_ns=1_000_000,
        slopes=slopes,
        commands_m=commands_m,
        dither_m=None,
        cm_id=None,
    )


def main() -> None:
    """Print one line per case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--case", type=parse_case, action="append", metavar="MODES:ALPHA:LEAK")
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--registered", action="store_true", help="matrix of the registration")
    parser.add_argument("--gain", type=float, default=0.8, help="about 0.5 in effect")
    parser.add_argument("--wind", type=float, default=15.0)
    parser.add_argument("--mag", default="8")
    parser.add_argument("--seed", type=int, default=3)
    given = parser.parse_args()
    sys.stdout.write(
        "| modes, registration, leak | pole radius | edge, nm | slip seen | highest ratio "
        "| nm RMS per half second |\n|---|---|---|---|---|---|\n"
    )
    with threadpool_limits(1):
        instrument = load_instrument("flao-lbt")
        model = InteractionModel(instrument, modes_of(instrument))
        for case in given.case or [parse_case(text) for text in CASES]:
            made_for = parse_alpha(case.alpha) if given.registered else Misregistration()
            matrix = invert(model.interaction_matrix(made_for), case.n_controlled).matrix
            radius, motion = foreseen(case, given.gain, model, matrix)
            found = run(case, given, instrument, matrix)
            when = "no slip" if found.first_slip_s is None else f"{found.first_slip_s:.2f} s"
            errors = " ".join(f"{error:.0f}" for error in found.wavefront_nm)
            sys.stdout.write(
                f"| {case.n_controlled}, {case.alpha}, {case.leak:g} | {radius:.3f} "
                f"| {motion * 1e9:.0f} | {when} | {found.highest_ratio:.1f} | {errors} |\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main()
