"""Optical gain of every mode on the diffractive telescope, and what its loop then reaches.

Closes the loop twice: once with one gain for all modes, to measure the optical gain on snapshots
of its residual wavefront; then with every mode's gain divided by its optical gain. Prints the
wavefront error and its budget; ``--plot`` draws the optical gain against the mode, beside what a
prototype saw, and needs the extra ``plots``.
Run: ``python -m pyrcal_studies.optical_gain --seconds 1 --plot optical_gain.png``.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from service.instrument import load_instrument
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.computer.feed import BATCH_FRAMES
from sim_rtc.computer.loop import LoopTerms, ModalLoop
from sim_rtc.options import Options, parse_options
from sim_rtc.telescope.diffractive import DiffractiveOptics

Array32 = NDArray[np.float32]

PROBE_M = 5e-9
SETTLING_FRAMES = 200
SNAPSHOT_FRAMES = 50
RUN_GAIN = 0.8
"""Of all modes in the first run, before the optical gain is known: about 0.45 in effect."""

PROTOTYPE = {0: 0.48, 20: 0.44, 150: 0.57, 501: 0.67}
"""Optical gains a prototype of the simulator had, at 1" and with some 125 nm left."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """A closed loop, settled."""

    optics: DiffractiveOptics
    turbulence_m: Array32
    """``(n_frames, n_points)``, piston-free."""

    residual_m: Array32
    """``(n_frames, n_points)``, piston-free."""

    def error_m(self, weights: NDArray[np.float64]) -> float:
        """Return the RMS of the residual over pupil and time."""
        return float(np.sqrt(np.mean(self.residual_m.astype(np.float64) ** 2 @ weights)))


def closed_loop(telescope: Telescope, gains: Array32, n_frames: int) -> Run:
    """Run the loop with these gains ``(n_controlled,)``, from the first frame of its feed on."""
    weights = telescope.weights.astype(np.float32)
    loop = ModalLoop(n_modes=len(telescope.settings.gains), delay_frames=2, stroke_m=1e-5)
    turbulence, residual = [], []
    for block in telescope.feed.blocks():
        terms = LoopTerms.of(
            block.optics, telescope.reconstructor.matrix, gains, telescope.settings.leak
        )
        for row in range(0, block.n_frames, BATCH_FRAMES):
            commands = block.run(row, loop, terms, None).commands_m
            for k, command in enumerate(commands):
                phase = block.phase_at(row + k)
                turbulence.append(phase - weights @ phase)
                left = phase + block.optics.opd_per_command @ command
                residual.append(left - weights @ left)
        if len(residual) >= n_frames + SETTLING_FRAMES:
            break
    optics = block.optics
    if not isinstance(optics, DiffractiveOptics):
        raise TypeError(f"study: found {type(optics).__name__}; expected --plant diffractive")
    return Run(
        optics=optics,
        turbulence_m=np.array(turbulence[SETTLING_FRAMES:]),
        residual_m=np.array(residual[SETTLING_FRAMES:]),
    )


def optical_gains(run: Run, modes: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return ``(n_modes,)`` mean response to each mode over that around a flat wavefront.

    The response is push-pull, noise-free, projected on the flat one: the diagonal of the gain.
    """
    rng = np.random.default_rng(0)
    snapshots = run.residual_m[::SNAPSHOT_FRAMES]

    def response(mode: int, residual: Array32) -> Array32:
        probe = PROBE_M * run.optics.opd_per_command[:, mode]
        push, pull = (run.optics.slopes(residual + s * probe, None, rng) for s in (1, -1))
        return np.asarray(push - pull)

    gains = []
    for mode in modes:
        flat = response(mode, np.zeros_like(snapshots[0]))
        seen = np.mean([response(mode, residual) for residual in snapshots], axis=0)
        gains.append(float(seen @ flat / (flat @ flat)))
    return np.array(gains)


def modal_residual(signal_m: NDArray[np.float64], gain: float, *, noise: bool) -> float:
    """Return the RMS over time, all modes together, that an integrator of delay 2 leaves.

    ``signal_m`` is ``(n_frames, n_modes)``: turbulence to correct, or noise that is measured.
    """
    command = np.zeros((len(signal_m) + 2, signal_m.shape[1]))
    for k, incoming in enumerate(signal_m):
        command[k + 2] = command[k + 1] - gain * (command[k] + incoming)
    left = command[:-2] if noise else command[:-2] + signal_m
    return float(np.sqrt(np.mean((left[SETTLING_FRAMES:] ** 2).sum(axis=1))))


def budget_nm(
    run: Run, telescope: Telescope, gain: float, optical_gain: NDArray[np.float64]
) -> dict[str, float]:
    """Return wavefront error and its parts, nm RMS: what is left over is named as such."""
    weights = telescope.weights
    n_controlled = len(telescope.reconstructor.matrix)
    modes = run.optics.opd_per_command[:, :n_controlled].astype(np.float64)
    weighted = modes * weights[:, None]
    content = np.linalg.solve(modes.T @ weighted, weighted.T) @ run.turbulence_m.T
    fitting = run.turbulence_m.T - modes @ content
    rng = np.random.default_rng(1)
    slope_noise = telescope.detector.noise(1000, rng).astype(np.float64)
    noise = slope_noise @ telescope.reconstructor.matrix.T / optical_gain
    parts = {
        "fitting": float(np.sqrt(np.mean(weights @ fitting**2))),
        "temporal": modal_residual(content.T, gain, noise=False),
        "noise": modal_residual(noise, gain, noise=True),
    }
    total = run.error_m(weights)
    rest = total**2 - sum(part**2 for part in parts.values())
    parts["aliasing, non-linearity, other"] = float(np.sqrt(max(rest, 0.0)))
    return {name: value * 1e9 for name, value in ({"wavefront error": total} | parts).items()}


def telescope_of(options: Options) -> Telescope:
    """Return a fresh telescope: the same sky every time."""
    return build_telescope(options, load_instrument(options.instrument))


def main() -> None:
    """Print optical gains and budget."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seconds", type=float, default=1.0, help="of each run, after settling")
    parser.add_argument("--mag", default="8")
    parser.add_argument("--seeing", default="1.0")
    parser.add_argument("--gain", type=float, default=0.5, help="in effect, second run")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="optical gain against mode")
    given = parser.parse_args()
    options = parse_options(
        f"--plant diffractive --alpha 0,0,0,1 --seed 3 --mag {given.mag} "
        f"--seeing {given.seeing}".split()
    )
    n_frames = round(given.seconds * options.frame_rate_hz)
    with threadpool_limits(1):
        telescope = telescope_of(options)
        n_modes = len(telescope.settings.gains)
        n_controlled = len(telescope.reconstructor.matrix)
        first = closed_loop(telescope, np.full(n_controlled, RUN_GAIN, np.float32), n_frames)
        spread = np.geomspace(1, n_modes - 1, 24).astype(np.intp)
        modes = np.unique(np.append(spread, [mode for mode in PROTOTYPE if mode < n_modes]))
        gains = optical_gains(first, modes)
        everywhere = np.interp(np.arange(n_controlled), modes, gains)
        second = closed_loop(
            telescope_of(options), (given.gain / everywhere).astype(np.float32), n_frames
        )
        left_nm = 1e9 * first.error_m(telescope.weights)
        budget = budget_nm(second, telescope, given.gain, everywhere)
    for mode, gain in zip(modes, gains, strict=True):
        sys.stdout.write(f"mode {mode:4d}  optical gain {gain:.3f}\n")
    sys.stdout.write(f"measured while the loop left {left_nm:.1f} nm; with compensated gains:\n")
    for name, value in budget.items():
        sys.stdout.write(f"{name:32s} {value:7.1f} nm\n")
    if given.plot is not None:
        title = f'optical gain at {given.seeing}" seeing, magnitude {given.mag}'
        plot(given.plot, modes, gains, title, left_nm)


def plot(
    path: Path,
    modes: NDArray[np.intp],
    gains: NDArray[np.float64],
    title: str,
    left_nm: float,
) -> None:
    """Draw the optical gain against the mode, the prototype's figures beside it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    # tip is mode 0, which a logarithm does not show
    axes.semilogx(modes + 1, gains, ".-", label=f"measured, loop closed at {left_nm:.0f} nm")
    axes.semilogx(
        np.array(list(PROTOTYPE)) + 1,
        list(PROTOTYPE.values()),
        "D",
        color="tab:red",
        fillstyle="none",
        label="a prototype, loop closed at 125 nm",
    )
    axes.set(xlabel="mode, counted from 1", ylabel="optical gain", ylim=(0, 1))
    axes.set_title(title, fontsize="medium")
    axes.grid(which="both", alpha=0.25)
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
