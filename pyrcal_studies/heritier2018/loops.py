"""Closed loops of the diffractive telescope, and what they leave of the wavefront."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.calibration import FRAME_COST_S
from pyrcal_studies.heritier2018.closing import OVERHEAD_S, ClosedLoop, GainTuning
from pyrcal_studies.heritier2018.psf import Camera
from pyrcal_studies.heritier2018.reconstructors import Inverse
from pyrcal_studies.heritier2018.registration import Found, resolved
from pyrcal_studies.heritier2018.store import Record, Store, Task
from pyrcal_studies.heritier2018.telescope import Occasion
from service.model.misregistration import Misregistration
from sim_rtc.computer.feed import BATCH_FRAMES
from sim_rtc.computer.gains import by_group
from sim_rtc.telescope.diffractive import DiffractiveOptics

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

N_PARTS = 3
"""Parts of a loop, one after the other, whose difference is chance."""


class Over(StrEnum):
    """What a residual is taken over."""

    PUPIL = "all of the wavefront"
    """As it is, whether a mode of the mirror can make it or not."""

    CONTROLLED = "the controlled modes"
    """As they truly are, what others have leaked into them included."""

    MIRROR = "the controlled modes, from the mirror's positions"
    """What is played and what corrects it, together: the paper's residual. The correction of
    vibrations is in it, the vibrations themselves are not."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopRun:
    """One closed loop, from rest."""

    occasion: Occasion
    alpha: Misregistration | Found
    """The truth."""

    reconstructor: Inverse
    gain: float | GainTuning
    """Gain of every mode, or the ramp that finds one for each group of modes."""

    n_frames: int
    """After it has settled."""

    settling_frames: int = 200
    """From rest until it has settled."""

    played_modes: int | None = None
    """By day: modes of the played turbulence; None: all the mirror can make."""

    @property
    def label(self) -> str:
        """What the progress bar shows."""
        where = "where a fit found it"
        if isinstance(self.alpha, Misregistration):
            where = f"at {self.alpha.to_boundary()['rotation_deg']:.2f} deg"
        return f"loop {where}, {self.reconstructor.label}"

    @property
    def cost_s(self) -> float:
        """Rough time on one idle core, seconds."""
        return self.n_frames_run * FRAME_COST_S + OVERHEAD_S

    @property
    def needs(self) -> tuple[Task, ...]:
        """The reconstructor, its gains, the fit that says where the mirror lies."""
        needed: list[Task] = [self.reconstructor]
        if isinstance(self.gain, GainTuning):
            needed.append(self.gain)
        if isinstance(self.alpha, Found):
            needed.append(self.alpha.fit)
        return tuple(needed)

    @property
    def n_frames_run(self) -> int:
        """Frames computed, those of settling in among them."""
        return self.settling_frames + self.n_frames

    def compute(self, store: Store) -> Record:
        """Return the residual's error in time and by mode, nm, and its H-band image.

        ``mirror_nm2`` ``(n_modes,)`` is the power of the mirror's positions in each mode, as the
        sensor sees it.
        """
        passes = self.occasion.passes
        alpha = resolved(self.alpha, store)
        matrix = store.read(self.reconstructor)["matrix"]
        # a matrix made for two passes gives half the command that a single pass needs
        matrix = (matrix * np.float32(self.reconstructor.passes / passes)).astype(np.float32)
        gains = np.full(len(matrix), self.gain if isinstance(self.gain, float) else np.nan)
        if isinstance(self.gain, GainTuning):
            # tuned on a reconstructor of perhaps fewer modes: its last group is extended
            tip_tilt, *others = store.read(self.gain)["by_group"].tolist()
            middle = others[0] if others else tip_tilt
            rest = others[-1] if others else tip_tilt
            gains = np.array(by_group((tip_tilt, middle, rest), len(matrix)))
        closed = ClosedLoop(
            self.occasion, alpha, matrix, self.n_frames_run, played_modes=self.played_modes
        )
        residual, positions, n_clipped = [], [], 0
        for row in range(0, self.n_frames_run, BATCH_FRAMES):
            result = closed.batch(row, gains)
            n_clipped += result.n_clipped
            if row >= self.settling_frames:
                residual.append(closed.residual_m(row, result))
                positions.append(result.commands_m)
        plant = telescope.plant(self.occasion)
        coming = closed.incoming_m(self.settling_frames)
        found = statistics(closed.optics, plant.weights, np.array(residual), coming)
        power = np.mean(np.concatenate(positions).astype(np.float64) ** 2, axis=0)
        return {
            **found,
            "mirror_nm2": power * (passes * 1e9) ** 2,
            "n_controlled": np.array(len(matrix)),
            "image": Camera(plant).image(np.array(residual)),
            "n_clipped": np.array(n_clipped),
        }


def statistics(
    seen: DiffractiveOptics, weights: Array, residual_m: Array32, incoming_m: Array32
) -> Record:
    """Return wavefront errors of what is left and of what came in, piston apart.

    ``error_nm`` ``(n,)`` at each snapshot; ``modal_nm2`` and ``incoming_nm2`` ``(n_modes,)``
    variance in the telescope's own modes where they truly lie, made orthonormal in their order;
    ``total_nm2`` and ``incoming_total_nm2``, over all there is. Both of what is left are also
    there by parts of the run: ``modal_by_part_nm2`` ``(N_PARTS, n_modes)``, ``total_by_part_nm2``.
    """
    projection = orthonormal(seen.opd_per_command, weights)
    left, came = (_piston_free(opd_m, weights) for opd_m in (residual_m, incoming_m))
    squared, modal = left**2 @ weights, (left @ projection) ** 2
    parts = np.array_split(np.arange(len(left)), min(N_PARTS, len(left)))
    return {
        "error_nm": np.sqrt(squared) * 1e9,
        "total_nm2": np.array(squared.mean() * 1e18),
        "modal_nm2": modal.mean(axis=0) * 1e18,
        "modal_by_part_nm2": np.array([modal[part].mean(axis=0) for part in parts]) * 1e18,
        "total_by_part_nm2": np.array([squared[part].mean() for part in parts]) * 1e18,
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


def wavefront_error_nm(record: Record, *, without_first: int = 0, over: Over = Over.PUPIL) -> float:
    """Return the RMS over time, nm, the first modes left out, of what the residual is taken over.

    ``PUPIL`` has all of the wavefront; the others have the modes that were controlled.
    """
    modal = record["modal_nm2"]
    match over:
        case Over.PUPIL:
            variance = float(record["total_nm2"]) - float(modal[:without_first].sum())
        case Over.CONTROLLED:
            variance = float(modal[without_first : int(record["n_controlled"])].sum())
        case Over.MIRROR:
            shown = record["mirror_nm2"][without_first : int(record["n_controlled"])]
            variance = float(shown.sum())
    return float(np.sqrt(max(variance, 0.0)))
