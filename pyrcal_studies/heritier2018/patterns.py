"""Calibration patterns compared at equal time (section 2.1, equations 2 to 5).

The same modes of the same telescope are calibrated with five kinds of patterns U: single
actuators, single modes, Hadamard combinations of modes, system modes, and sines on all modes at
once. The result is compared with the telescope's noise-free matrix: ΔD of equation 5, and what ΔD
does to the registration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.calibration import STROKE_M, Answer
from pyrcal_studies.heritier2018.reconstructors import synthetic_matrix
from pyrcal_studies.heritier2018.registration import DERIVATIVE_STEPS
from pyrcal_studies.heritier2018.store import Record, Store, Task
from pyrcal_studies.heritier2018.telescope import Occasion
from service.control.reconstructor import invert
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from sim_rtc.computer.feed import BATCH_FRAMES
from sim_rtc.computer.strokes import (
    Demodulation,
    PushPull,
    Regression,
    Tones,
    hadamard_shapes,
    modal,
    pokes,
    system_shapes,
)

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

POKE_PEAK_M = 100e-9
"""Largest displacement of a single actuator, metres OPD. A poke of 20 nm RMS over the pupil would
reach half a micrometre and leave the pyramid's linear range."""

TONES_FRAMES_PER_MODE = 6
"""As many as two pushes and two pulls take."""

FREQUENCIES = (0.05, 0.45)
"""Range of the sines, cycles per frame."""

N_SETS = 8
"""Disjoint sets of modes whose scatter gives the registration's σ."""


class Pattern(StrEnum):
    """Calibration patterns U."""

    ZONAL = "zonal"
    MODAL = "modal (KL)"
    HADAMARD = "Hadamard (of KL)"
    SYSTEM = "system modes"
    SINES = "multiplexed sines"


@dataclass(frozen=True, slots=True, kw_only=True)
class PatternRun:
    """A calibration with one kind of pattern."""

    occasion: Occasion
    alpha: Misregistration
    """Registration of the telescope."""

    pattern: Pattern
    n_modes: int
    truth: Answer
    """Noise-free matrix of the same telescope."""

    @property
    def needs(self) -> tuple[Task, ...]:
        """The noise-free matrix."""
        return (self.truth,)

    def compute(self, store: Store) -> Record:
        """Return the number of frames, ‖ΔD‖/‖D‖, and σ of the registration, boundary units."""
        matrix, n_frames, rms_m = self._measured()
        exact = store.read(self.truth)["matrix"][:, : self.n_modes].astype(np.float64)
        exact *= self.occasion.passes
        error = exact - matrix
        sets = registration_by_set(error, exact, self.alpha, N_SETS) * BOUNDARY_SCALE
        return {
            "n_frames": np.array(n_frames),
            "pattern_rms_m": np.array(rms_m),
            "relative_error": np.array(np.linalg.norm(error) / np.linalg.norm(exact)),
            "sigma": sets.std(axis=0, ddof=1) / np.sqrt(N_SETS),
        }

    def _measured(self) -> tuple[Array, int, float]:
        """Return the calibrated matrix, its frames and the RMS of the patterns' wavefront."""
        seen = telescope.optics(self.occasion, self.alpha)
        rng = telescope.measuring(self.occasion, list(Pattern).index(self.pattern))
        detector = telescope.pixels(self.occasion, seen)
        shaking = telescope.sky(self.occasion).vibrations
        commands_of, solver, n_frames = self._calibration(seen.n_slopes)
        power = []
        for start in range(0, n_frames, BATCH_FRAMES):
            frame = np.arange(start, min(start + BATCH_FRAMES, n_frames))
            commands = commands_of(frame)
            power.append(float(np.mean(np.sum(commands.astype(np.float64) ** 2, axis=1))))
            shaken = shaking.frames(len(frame)) @ shaking.phase_per_line.T
            slopes = [
                seen.slopes(seen.mirror_opd_m(command) + phase, detector, rng)
                for command, phase in zip(commands, shaken, strict=True)
            ]
            solver.take(frame, np.array(slopes), commands)
        return solver.matrix().astype(np.float64), n_frames, float(np.sqrt(np.mean(power)))

    def _calibration(
        self, n_slopes: int
    ) -> tuple[Callable[[NDArray[np.int64]], Array32], Regression | Demodulation, int]:
        n_basis = telescope.basis().n_modes
        modes = tuple(range(self.n_modes))
        if self.pattern is Pattern.SINES:
            n_frames = TONES_FRAMES_PER_MODE * self.n_modes
            tones = Tones(
                modes=np.arange(self.n_modes),
                amplitude_m=np.full(self.n_modes, STROKE_M / np.sqrt(self.n_modes)),
                cycles_per_frame=np.linspace(*FREQUENCIES, self.n_modes),
                n_modes=n_basis,
                n_frames=n_frames,
            )
            return tones.commands, Demodulation(tones, n_slopes=n_slopes), n_frames
        if self.pattern is Pattern.ZONAL:
            to_actuators = telescope.basis().mode_to_actuator
            shapes = pokes(np.asarray(to_actuators, dtype=np.float64), 1.0)
            peak = np.abs(shapes @ to_actuators.T).max()
            strokes = PushPull(
                shapes_m=(shapes * np.float32(POKE_PEAK_M / peak)).astype(np.float32), n_average=1
            )
            # single actuators move every mode of the mirror
            solver = Regression(modes, n_modes=n_basis, n_slopes=n_slopes)
            return strokes.commands, solver, strokes.n_frames
        strokes = PushPull(shapes_m=self._shapes(modes, n_basis), n_average=self._n_average)
        solver = Regression(modes, n_modes=n_basis, n_slopes=n_slopes)
        return strokes.commands, solver, strokes.n_frames

    @property
    def _n_average(self) -> int:
        return 1 if self.pattern is Pattern.HADAMARD else 2

    def _shapes(self, modes: tuple[int, ...], n_basis: int) -> Array32:
        match self.pattern:
            case Pattern.MODAL:
                return modal(modes, (STROKE_M,) * self.n_modes, n_basis)
            case Pattern.HADAMARD:
                amplitude = STROKE_M / float(np.sqrt(self.n_modes))
                return hadamard_shapes(modes, (amplitude,) * self.n_modes, n_basis)
            case _:
                nominal = synthetic_matrix(self.alpha) * self.occasion.passes
                inverse = invert(nominal, self.n_modes).matrix
                return system_shapes(inverse, modes, STROKE_M, n_basis)


def registration_by_set(error: Array, exact: Array, alpha: Misregistration, n_sets: int) -> Array:
    """Return what the error of a matrix does to α, ``(n_sets, 4)``, one for each set of modes.

    Every mode keeps a free gain, as in the fit: the part along its own column does not count.
    """
    derivatives = sensitivities(alpha, exact.shape[1])
    found = []
    for first in range(n_sets):
        chosen = slice(first, None, n_sets)
        columns = exact[:, chosen] / np.linalg.norm(exact[:, chosen], axis=0)

        def apart(values: Array, columns: Array = columns, chosen: slice = chosen) -> Array:
            part = values[:, chosen]
            return np.asarray((part - columns * np.sum(columns * part, axis=0)).ravel())

        rows = np.array([apart(one) for one in derivatives]).T
        found.append(np.linalg.lstsq(rows, -apart(error), rcond=None)[0])
    return np.array(found)


def sensitivities(alpha: Misregistration, n_modes: int) -> Array:
    """Return the derivatives of the synthetic matrix for two passes ``(4, n_slopes, n_modes)``."""
    found = []
    for index, step in enumerate(DERIVATIVE_STEPS):
        away = step * (np.arange(4) == index)
        plus, minus = (
            synthetic_matrix(Misregistration.from_vector(alpha.vector + sign * away))[:, :n_modes]
            for sign in (1, -1)
        )
        found.append((plus - minus) / step)
    return np.array(found)
