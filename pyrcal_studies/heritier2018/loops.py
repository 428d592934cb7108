"""Closed loops of the diffractive telescope: wavefront error, long exposures, gains, poles.

The poles come from the model alone. With D(α) the plant and R the inverse of D(0) they are those of
the eigenvalues of g R D(α): at which misregistration the loop becomes unstable with a gain g.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2, fftshift, next_fast_len
from scipy.linalg import cholesky, solve_triangular

from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.reconstructors import Inverse
from pyrcal_studies.heritier2018.registration import Found, resolved
from pyrcal_studies.heritier2018.store import Record, Store, Task
from pyrcal_studies.heritier2018.telescope import Occasion
from service.control.loop import pole_radius
from service.control.reconstructor import invert
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.wire import RampRequest
from sim_rtc.computer.feed import BATCH_FRAMES, PhaseBlock
from sim_rtc.computer.gains import GROUP_ENDS, GainRamp, by_group
from sim_rtc.computer.loop import LoopBlock, LoopTerms, ModalLoop
from sim_rtc.telescope.diffractive import DiffractiveOptics, DiffractivePlant

Array = NDArray[np.float64]

H_BAND_M = 1.65e-6
OVERSAMPLING = 4
"""Samples per λ/D."""

FIELD = 128
"""Samples across the part that is kept: 32 λ/D."""


class Camera:
    """A perfect camera behind the telescope's pupil."""

    def __init__(self, plant: DiffractivePlant) -> None:
        place = np.round((plant.points_m - plant.points_m.min(axis=0)) / plant.pitch_m)
        self._column, self._row = place.astype(np.intp).T
        # a grey cell of the pupil has the amplitude of its area
        self._amplitude = plant.weights / plant.weights.sum()
        across = int(max(self._row.max(), self._column.max())) + 1
        self._size = next_fast_len(OVERSAMPLING * across)
        self._peak = float(self._exposure(np.zeros(len(self._row))).max())

    def image(self, residuals_m: NDArray[Any]) -> Array:
        """Return the long exposure ``(FIELD, FIELD)`` over these wavefronts, perfect peak 1.

        ``residuals_m`` is ``(n_snapshots, n_points)``; tilt is left in.
        """
        total = np.zeros((FIELD, FIELD))
        for residual in residuals_m:
            total += self._exposure(residual)
        return total / (len(residuals_m) * self._peak)

    def _exposure(self, opd_m: NDArray[Any]) -> Array:
        field = np.zeros((self._size, self._size), dtype=np.complex128)
        phase = 2 * np.pi / H_BAND_M * opd_m
        field[self._row, self._column] = self._amplitude * np.exp(1j * phase)
        power = np.abs(fftshift(fft2(field))) ** 2
        first = self._size // 2 - FIELD // 2
        return np.asarray(power[first : first + FIELD, first : first + FIELD])


def strehl(image: NDArray[Any]) -> float:
    """Return the peak of a long exposure whose perfect peak is 1."""
    return float(image.max())


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
        closed = ClosedLoop(self.occasion, alpha, matrix, self.n_frames_run)
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
    ``total_nm2`` over all that is left, ``total_by_part_nm2`` ``(N_PARTS,)`` by parts of the run.
    """
    projection = orthonormal(seen.opd_per_command, weights)
    left, came = (_piston_free(opd_m, weights) for opd_m in (residual_m, incoming_m))
    squared, modal = left**2 @ weights, (left @ projection) ** 2
    parts = np.array_split(np.arange(len(left)), min(N_PARTS, len(left)))
    return {
        "error_nm": np.sqrt(squared) * 1e9,
        "total_nm2": np.array(squared.mean() * 1e18),
        "modal_nm2": modal.mean(axis=0) * 1e18,
        "total_by_part_nm2": np.array([squared[part].mean() for part in parts]) * 1e18,
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


def wavefront_error_nm(
    record: Record,
    *,
    without_first: int = 0,
    over: Over = Over.PUPIL,
    n_modes: int | None = None,
) -> float:
    """Return the RMS over time, nm, the first modes left out, of what the residual is taken over.

    ``PUPIL`` has all of the wavefront; the others have the first ``n_modes``, by default the modes
    that were controlled.
    """
    modal = record["modal_nm2"]
    end = n_modes
    if n_modes is None and over is not Over.PUPIL:
        end = int(record["n_controlled"])
    match over:
        case Over.PUPIL:
            variance = float(record["total_nm2"]) - float(modal[:without_first].sum())
        case Over.CONTROLLED:
            variance = float(modal[without_first:end].sum())
        case Over.MIRROR:
            variance = float(record["mirror_nm2"][without_first:end].sum())
    return float(np.sqrt(max(variance, 0.0)))


DELAY_FRAMES = 2
LEAK = 0.999
STROKE_M = 10e-6
"""Largest command of a mode: a loop that diverges stays finite."""

RAMP_GAINS = (0.4, 0.6, 0.8, 1.0)
"""Tried in this order on every group."""

RAMP_START = 0.4
"""Of groups whose turn has not come."""


class ClosedLoop:
    """The loop of an occasion, from rest, on the turbulence that all its loops share."""

    def __init__(
        self,
        occasion: Occasion,
        alpha: Misregistration,
        matrix: Array32,
        n_frames: int,
    ) -> None:
        self.optics = telescope.optics(occasion, alpha)
        phases, played = telescope.incoming(occasion, n_frames)
        self.block = PhaseBlock(
            first_frame=0,
            optics=self.optics,
            phases_m=phases,
            played_m=played,
            detector=telescope.pixels(occasion, self.optics),
            rng=telescope.photons(occasion),
        )
        self.matrix = matrix
        self._loop = ModalLoop(
            n_modes=self.optics.opd_per_command.shape[1],
            delay_frames=DELAY_FRAMES,
            stroke_m=STROKE_M,
        )

    def batch(self, row: int, gains: NDArray[np.floating]) -> LoopBlock:
        """Run the batch of frames that begins at ``row`` with these gains, ``(n_controlled,)``."""
        terms = LoopTerms.of(self.optics, self.matrix, gains.astype(np.float32), LEAK)
        return self.block.run(row, self._loop, terms, None)

    def residual_m(self, row: int, result: LoopBlock) -> Array32:
        """Return the OPD ``(n_points,)`` left in the first frame of that batch."""
        return self.block.phase_at(row) + self.optics.mirror_opd_m(result.commands_m[0])

    def incoming_m(self, first: int) -> Array32:
        """Return each batch's first OPD before any correction, ``(n, n_points)``, from a row on."""
        coming = self.block.phases_m[first::BATCH_FRAMES]
        if self.block.played_m is None:
            return coming
        played = self.block.played_m[first::BATCH_FRAMES]
        return np.asarray(coming + played @ self.optics.opd_per_command.T)


@dataclass(frozen=True, slots=True, kw_only=True)
class GainTuning:
    """The paper's gain ramp: tip and tilt, modes to 100, the rest, each by its residual slopes."""

    occasion: Occasion
    alpha: Misregistration
    """The truth."""

    reconstructor: Inverse
    frames_per_gain: int
    """Half of them settle."""

    @property
    def needs(self) -> tuple[Task, ...]:
        """The reconstructor."""
        return (self.reconstructor,)

    @property
    def n_frames(self) -> int:
        """Frames it takes at most."""
        return self.frames_per_gain * len(RAMP_GAINS) * (len(GROUP_ENDS) + 1)

    def compute(self, store: Store) -> Record:
        """Return ``gains`` one per mode, and what was tried: ``group``, ``gain``, ``residual_nm``.

        ``by_group`` has the gain of each group.
        """
        matrix = store.read(self.reconstructor)["matrix"]
        ramp = GainRamp(
            (RAMP_START,) * len(matrix), self.request(len(matrix)), frame_rate_hz=1000.0
        )
        closed = ClosedLoop(self.occasion, self.alpha, matrix, self.n_frames)
        for row in range(0, self.n_frames, BATCH_FRAMES):
            if ramp.done:
                break
            modes = ramp.modes
            result = closed.batch(row, np.array(ramp.gains))
            ramp.take(result.slopes @ matrix[modes].T)
        return {
            "gains": np.array(ramp.gains),
            "by_group": np.array(ramp.gains_by_group),
            "group": np.array([step.group for step in ramp.steps]),
            "gain": np.array([step.gain for step in ramp.steps]),
            "residual_nm": np.array([step.residual_m * 1e9 for step in ramp.steps]),
        }

    def request(self, n_modes: int) -> RampRequest:
        """Return what would be asked of an RTC."""
        starts = (0, *(end for end in GROUP_ENDS if end < n_modes))
        return RampRequest(
            id="paper",
            groups=tuple((first, after - 1) for first, after in pairwise((*starts, n_modes))),
            gains=RAMP_GAINS,
            frames_per_gain=self.frames_per_gain,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class PoleSweep:
    """Eigenvalues of R D(α) along a sweep."""

    alphas: tuple[Misregistration, ...]
    values: tuple[float, ...]
    """Of the swept parameter, in the sweep's unit."""

    n_modes: int

    @property
    def needs(self) -> tuple[Task, ...]:
        """Nothing but the model."""
        return ()

    def compute(self, store: Store) -> Record:
        """Return ``eigenvalues`` ``(n_values, n_modes)``, complex."""
        basis = telescope.basis().subset(np.arange(self.n_modes))
        model = InteractionModel(telescope.instrument(), basis)
        nominal = model.interaction_matrix(Misregistration())
        inverse = invert(np.asarray(nominal, dtype=np.float64), self.n_modes).matrix
        found = [
            np.linalg.eigvals(inverse @ np.asarray(model.interaction_matrix(alpha)))
            for alpha in self.alphas
        ]
        return {"eigenvalues": np.array(found).astype(np.complex128)}


def limit_of_stability(record: Record, values: tuple[float, ...], gain: float) -> float | None:
    """Return the first value at which a pole leaves the unit circle; None if none does."""
    radius = np.array([largest_pole(row, gain) for row in record["eigenvalues"]])
    unstable = np.flatnonzero(radius > 1.0)
    if not len(unstable) or unstable[0] == 0:
        return None
    k = int(unstable[0])
    share = (1.0 - radius[k - 1]) / (radius[k] - radius[k - 1])
    return float(values[k - 1] + share * (values[k] - values[k - 1]))


def largest_pole(eigenvalues: NDArray[np.complex128], gain: float) -> float:
    """Return the radius of the largest pole of the loop with these eigenvalues of R D."""
    radius = pole_radius(gain * eigenvalues, leak=LEAK, delay_frames=float(DELAY_FRAMES))
    return float(np.max(radius))
