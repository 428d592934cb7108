"""Measuring the interaction matrix as by day: push, pull, with photon noise and a shaking dome."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.store import Record, Store, Task
from pyrcal_studies.heritier2018.telescope import Occasion
from service.estimation.reference import Reference
from service.model.misregistration import Misregistration
from sim_rtc.computer.feed import BATCH_FRAMES
from sim_rtc.computer.strokes import PushPull, Regression, frames_per_shape, modal

STROKE_M = 20e-9
"""RMS of one mode on the mirror, metres OPD; the sensor sees it twice."""

PART_MODES = 50
"""Modes measured in one step."""

SMALL_STROKE_M = 1e-9
"""Small enough for the pyramid to be linear."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredPart:
    """Consecutive columns of a measured interaction matrix."""

    occasion: Occasion
    alpha: Misregistration
    """The truth: known to the simulator alone."""

    first_mode: int
    n_modes: int
    n_average: int
    """Pushes, and as many pulls, of each mode."""

    @property
    def needs(self) -> tuple[Task, ...]:
        """Nothing: it is measured."""
        return ()

    @property
    def n_frames(self) -> int:
        """Frames it takes."""
        return self.n_modes * frames_per_shape(self.n_average)

    def compute(self, store: Store) -> Record:
        """Return ``matrix`` ``(n_slopes, n_modes)``, slope per metre of command on the mirror."""
        seen = telescope.optics(self.occasion, self.alpha)
        rng = telescope.measuring(self.occasion, self.first_mode // PART_MODES)
        detector = telescope.pixels(self.occasion, seen)
        shaking = telescope.sky(self.occasion).vibrations
        modes = tuple(range(self.first_mode, self.first_mode + self.n_modes))
        n_basis = seen.opd_per_command.shape[1]
        strokes = PushPull(
            shapes_m=modal(modes, (STROKE_M,) * self.n_modes, n_basis), n_average=self.n_average
        )
        solver = Regression(modes, n_modes=n_basis, n_slopes=seen.n_slopes)
        for start in range(0, strokes.n_frames, BATCH_FRAMES):
            frame = np.arange(start, min(start + BATCH_FRAMES, strokes.n_frames))
            commands = strokes.commands(frame)
            shaken = shaking.frames(len(frame)) @ shaking.phase_per_line.T
            slopes = [
                seen.slopes(seen.mirror_opd_m(command) + phase, detector, rng)
                for command, phase in zip(commands, shaken, strict=True)
            ]
            solver.take(frame, np.array(slopes), commands)
        return {"matrix": solver.matrix(), "n_frames": np.array(self.n_frames)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """A whole measured interaction matrix, as its parts are."""

    occasion: Occasion
    alpha: Misregistration
    n_modes: int
    n_average: int

    @property
    def parts(self) -> tuple[MeasuredPart, ...]:
        """The steps it is measured in."""
        return tuple(
            MeasuredPart(
                occasion=self.occasion,
                alpha=self.alpha,
                first_mode=first,
                n_modes=min(PART_MODES, self.n_modes - first),
                n_average=self.n_average,
            )
            for first in range(0, self.n_modes, PART_MODES)
        )

    @property
    def n_frames(self) -> int:
        """Frames it takes."""
        return sum(part.n_frames for part in self.parts)

    def matrix(self, store: Store) -> NDArray[np.float32]:
        """Return ``(n_slopes, n_modes)``, slope per metre of command on the mirror."""
        return np.hstack([store.read(part)["matrix"] for part in self.parts])

    def reference(self, store: Store) -> Reference:
        """Return it as a fit takes it."""
        return Reference(
            matrix=self.matrix(store).astype(np.float64), double_pass=self.occasion.passes == 2
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What a telescope truly answers to small strokes: no noise, nothing shakes."""

    occasion: Occasion
    alpha: Misregistration
    n_modes: int

    @property
    def needs(self) -> tuple[Task, ...]:
        """Nothing but the telescope."""
        return ()

    @property
    def parts(self) -> tuple[Answer, ...]:
        """Itself: it is one step."""
        return (self,)

    def matrix(self, store: Store) -> NDArray[np.float32]:
        """Return ``(n_slopes, n_modes)``, slope per metre of command on the mirror."""
        seen_once = store.read(self)["matrix"]
        return np.asarray(seen_once * np.float32(self.occasion.passes), dtype=np.float32)

    def reference(self, store: Store) -> Reference:
        """Return it as a fit takes it."""
        return Reference(
            matrix=self.matrix(store).astype(np.float64), double_pass=self.occasion.passes == 2
        )

    def compute(self, store: Store) -> Record:
        """Return ``matrix`` ``(n_slopes, n_modes)``, slope per metre of wavefront, seen once.

        ``singular`` are its singular values, largest first.
        """
        seen = telescope.optics(self.occasion, self.alpha)
        rng = telescope.photons(self.occasion)
        stroke = np.float32(SMALL_STROKE_M)
        columns = []
        for mode in range(self.n_modes):
            opd_m = stroke * seen.opd_per_command[:, mode]
            push, pull = (seen.slopes(sign * opd_m, None, rng) for sign in (1, -1))
            columns.append((push - pull).astype(np.float64) / (2 * SMALL_STROKE_M))
        matrix = np.array(columns).T / self.occasion.passes
        return {
            "singular": np.linalg.svd(matrix, compute_uv=False),
            "matrix": matrix.astype(np.float32),
        }
