"""Closed loops of the diffractive telescope, and what they leave of the wavefront."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from service.model.misregistration import Misregistration
from sim_rtc.computer.feed import BATCH_FRAMES, PhaseBlock
from sim_rtc.computer.loop import LoopTerms, ModalLoop
from sim_rtc.telescope.diffractive import DiffractiveOptics
from studies.heritier2018 import telescope
from studies.heritier2018.calibration import FRAME_COST_S
from studies.heritier2018.psf import Camera
from studies.heritier2018.reconstructors import AnyReconstructor
from studies.heritier2018.store import Record, Store, Task
from studies.heritier2018.telescope import Occasion

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

SETTLING_FRAMES = 200
DELAY_FRAMES = 2
LEAK = 0.999
STROKE_M = 10e-6
"""Largest command of a mode: a loop that diverges stays finite."""

_OVERHEAD_S = 2.5


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopRun:
    """One closed loop, from rest."""

    occasion: Occasion
    alpha: Misregistration
    """The truth."""

    reconstructor: AnyReconstructor
    gain: float
    """Of every mode."""

    n_frames: int
    """After it has settled."""

    @property
    def label(self) -> str:
        """What the progress bar shows."""
        shown = self.alpha.to_boundary()
        return f"loop at {shown['rotation_deg']:.2f} deg, {self.reconstructor.label}"

    @property
    def cost_s(self) -> float:
        """Rough time on one idle core, seconds."""
        return self.n_frames_run * FRAME_COST_S + _OVERHEAD_S

    @property
    def needs(self) -> tuple[Task, ...]:
        """The reconstructor."""
        return (self.reconstructor,)

    @property
    def n_frames_run(self) -> int:
        """Frames computed, those of settling in among them."""
        return SETTLING_FRAMES + self.n_frames

    def compute(self, store: Store) -> Record:
        """Return the residual's error in time and by mode, nm, and its H-band image."""
        seen = telescope.optics(self.occasion, self.alpha)
        phases, played = telescope.incoming(self.occasion, self.n_frames_run)
        block = PhaseBlock(
            first_frame=0,
            optics=seen,
            phases_m=phases,
            played_m=played,
            detector=telescope.pixels(self.occasion, seen),
            rng=telescope.photons(self.occasion),
        )
        matrix = store.read(self.reconstructor)["matrix"]
        residual, n_clipped = self._closed(block, matrix)
        coming = phases[SETTLING_FRAMES::BATCH_FRAMES]
        if played is not None:
            coming = coming + played[SETTLING_FRAMES::BATCH_FRAMES] @ seen.opd_per_command.T
        plant = telescope.plant(self.occasion)
        found = statistics(seen, plant.weights, residual, coming)
        image = Camera(plant).image(residual)
        return {**found, "image": image, "n_clipped": np.array(n_clipped)}

    def _closed(self, block: PhaseBlock, matrix: Array32) -> tuple[Array32, int]:
        """Return each batch's first residual ``(n, n_points)``, and clipped commands."""
        n_basis = block.optics.opd_per_command.shape[1]
        loop = ModalLoop(n_modes=n_basis, delay_frames=DELAY_FRAMES, stroke_m=STROKE_M)
        terms = LoopTerms.of(
            block.optics, matrix, np.full(len(matrix), self.gain, np.float32), LEAK
        )
        residual, n_clipped = [], 0
        for row in range(0, self.n_frames_run, BATCH_FRAMES):
            result = block.run(row, loop, terms, None)
            n_clipped += result.n_clipped
            if row >= SETTLING_FRAMES:
                mirror = block.optics.mirror_opd_m(result.commands_m[0])
                residual.append(block.phase_at(row) + mirror)
        return np.array(residual), n_clipped


def statistics(
    seen: DiffractiveOptics, weights: Array, residual_m: Array32, incoming_m: Array32
) -> Record:
    """Return wavefront errors of what is left and of what came in, piston apart.

    ``error_nm`` ``(n,)`` at each snapshot; ``modal_nm2`` and ``incoming_nm2`` ``(n_modes,)``
    variance in the telescope's own modes where they truly lie, made orthonormal in their order;
    ``total_nm2`` and ``incoming_total_nm2``, over all there is.
    """
    projection = orthonormal(seen.opd_per_command, weights)
    left, came = (_piston_free(opd_m, weights) for opd_m in (residual_m, incoming_m))
    squared = left**2 @ weights
    return {
        "error_nm": np.sqrt(squared) * 1e9,
        "total_nm2": np.array(squared.mean() * 1e18),
        "modal_nm2": np.mean((left @ projection) ** 2, axis=0) * 1e18,
        "incoming_total_nm2": np.array(np.mean(came**2 @ weights) * 1e18),
        "incoming_nm2": np.mean((came @ projection) ** 2, axis=0) * 1e18,
    }


def orthonormal(modes: Array32, weights: Array) -> Array:
    """Return ``(n_points, n_modes)`` that take a wavefront to its modal content.

    Modes are made orthonormal over the pupil one after the other, so that the first n describe
    what the first n could.
    """
    shapes = _piston_free(modes.T.astype(np.float64), weights)
    weighted = shapes * weights
    lower = cholesky(weighted @ shapes.T, lower=True)
    return np.asarray(solve_triangular(lower, weighted, lower=True).T)


def _piston_free(opd_m: NDArray[np.floating], weights: Array) -> Array:
    opd_m = opd_m.astype(np.float64)
    return np.asarray(opd_m - (opd_m @ weights)[:, None])


def wavefront_error_nm(record: Record, *, without_first: int = 0) -> float:
    """Return the RMS over pupil and time, nm, the first modes left out."""
    variance = float(record["total_nm2"]) - float(record["modal_nm2"][:without_first].sum())
    return float(np.sqrt(max(variance, 0.0)))
