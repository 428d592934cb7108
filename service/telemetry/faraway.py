"""Registration from nothing known: a few smooth modes dithered with the loop open.

With the loop open a dithered line is a measured column of the interaction matrix, so that no loop
has to be known, let alone be stable, and the fit is that of a small matrix: Gauss-Newton steps,
halved where they make it worse, every column with a gain of its own. An open loop leaves the
pyramid a seventh of its response in 1" seeing and another mean shape of it: the result is good to
some per cent of a subaperture, which is what closing a loop takes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration
from service.telemetry.instrumental import MAX_LAG_FRAMES, Loop, WindowEstimate, fit_window
from service.telemetry.lockin import Spectra
from service.telemetry.span import WindowRefused

Array = NDArray[Any]

LONGEST_STEP = np.array([0.8, 0.8, np.deg2rad(4.0), 0.04])
"""A step further than this trusts the derivatives too far (numeric units)."""

APPROACHED = np.array([0.02, 0.02, np.deg2rad(0.1), 2e-3])
"""A step shorter than this leaves the rest to the finer model."""

LIMIT = np.array([3.0, 3.0, np.deg2rad(20.0), 0.15])
"""Nobody looks further than this from the nominal registration (numeric units)."""

MOST_STEPS = 12
_HALVINGS = 3

UNEXPLAINED = 0.2
"""Largest share of the columns' power, noise taken off, that the right registration may leave."""

FAINTEST = 5.0
"""σ of a line's gain from which on it is seen."""

LARGEST_GAIN = 3.0

NOT_FOUND = "registration not found"
"""How the reason begins of a window that was good and led nowhere."""


class Model(Protocol):
    """An optical model of the dithered modes alone, columns in the order of the lines."""

    def interaction_matrix(self, alpha: Misregistration) -> Array:
        """Return D(α), ``(n_slopes, n_lines)``."""

    def derivatives(self, alpha: Misregistration) -> Array:
        """Return dD/dα ``(4, n_slopes, n_lines)``."""

    def linearise(self, alpha: Misregistration) -> Linearisation:
        """Return both together."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FarEstimate:
    """Where the mirror is, from one window with the loop open."""

    estimate: WindowEstimate
    """Its covariance is the noise's alone."""

    unexplained: float
    """Share of the columns' power, noise taken off, that the model leaves."""

    n_starts: int
    """Starts that were tried."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Columns:
    """What the lines show of the interaction matrix."""

    measured: Array
    """``(n_slopes, n_lines)`` slope per metre."""

    noise: Array
    """``(n_lines,)`` power of the noise in each column, from the bins beside the line."""

    @classmethod
    def of(cls, spectra: Spectra) -> _Columns:
        """Divide the slopes at the lines by the known dither."""
        lines = np.arange(len(spectra.plan.modes))
        known = spectra.dither[lines, list(spectra.plan.modes)].astype(complex)
        beside = np.sum(np.abs(spectra.slopes[:, 1:]) ** 2, axis=2).mean(axis=1)
        return cls(
            measured=(spectra.slopes[:, 0] / known[:, None]).real.T,
            # half of a complex bin's noise is in its real part
            noise=0.5 * beside / np.abs(known) ** 2,
        )

    def left(self, matrix: Array) -> tuple[float, Array]:
        """Return the mean share of the columns a matrix leaves at its best gains, and those.

        A line whose best gain is negative has nothing in common with the model.
        """
        power = np.sum(matrix**2, axis=0)
        gains = np.maximum(np.sum(matrix * self.measured, axis=0), 0.0) / power
        total = np.sum(self.measured**2, axis=0)
        return float(1.0 - np.mean(gains**2 * power / total)), gains

    def unexplained(self, matrix: Array) -> float:
        """Return the same with the noise taken off both."""
        power, total = np.sum(matrix**2, axis=0), np.sum(self.measured**2, axis=0)
        gains = self.left(matrix)[1]
        left = total - gains**2 * power - self.noise
        return float(np.mean(left / np.maximum(total - self.noise, 0.1 * total)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Search:
    """Where to look, and with what."""

    far: Model
    """Coarse: leads."""

    near: Model
    """Fine: decides."""

    nominal: Misregistration
    """Centre of the range."""

    starts: tuple[Misregistration, ...]
    """Tried in this order."""


def find(spectra: Spectra, search: Search) -> FarEstimate | WindowRefused:
    """Return where the first start leads from which the model explains the columns."""
    columns = _Columns.of(spectra)
    loop = Loop(
        reconstructor=np.zeros((0, len(columns.measured)), np.float32),
        gains=np.zeros(len(spectra.plan.modes)),
        leak=1.0,
        delay_frames=1.0,
        frame_rate_hz=spectra.plan.frame_rate_hz,
    )
    reason = "no start was given"
    for tried, start in enumerate(search.starts, start=1):
        landed = _landed(columns, search, start)
        if landed is None:
            reason = f"steps from {_said(start)} do not converge"
            continue
        estimate = fit_window(_alone(spectra), search.near.linearise(landed), loop)
        left = columns.unexplained(search.near.interaction_matrix(estimate.alpha))
        found = FarEstimate(estimate=estimate, unexplained=left, n_starts=tried)
        why_not = _why_not(found, search.nominal)
        if why_not is None:
            return found
        reason = why_not
    return WindowRefused(reason=f"{NOT_FOUND}: {reason}", t_ns_utc=spectra.t_end_ns_utc)


def _landed(columns: _Columns, search: Search, start: Misregistration) -> Misregistration | None:
    """Return where Gauss-Newton steps lead from a start; None: nowhere."""
    model = search.far
    here, matrix = start, np.asarray(model.interaction_matrix(start), dtype=float)
    for _ in range(MOST_STEPS):
        if not columns.left(matrix)[1].any():
            return None
        step = _step(columns, matrix, np.asarray(model.derivatives(here), dtype=float))
        moved = _best_of_halved(columns, search, here, matrix, step)
        if moved is None:
            return here if np.all(np.abs(step) < APPROACHED) else None
        before, (here, matrix) = here, moved
        if np.all(np.abs(here.vector - before.vector) < APPROACHED):
            return here
    return None


def _step(columns: _Columns, matrix: Array, derivatives: Array) -> Array:
    """Return the step ``(4,)`` that explains most, each line's own gain left free."""
    _, gains = columns.left(matrix)
    weight = 1.0 / np.linalg.norm(columns.measured, axis=0)
    along = np.sum(derivatives * matrix, axis=1, keepdims=True) / np.sum(matrix**2, axis=0)
    slopes = (derivatives - along * matrix) * gains * weight
    residual = (columns.measured - gains * matrix) * weight
    normal = np.einsum("asm,bsm->ab", slopes, slopes)
    normal += 1e-6 * np.diag(np.diag(normal))
    step = np.linalg.solve(normal, np.einsum("asm,sm->a", slopes, residual))
    return np.asarray(step / max(1.0, float(np.max(np.abs(step) / LONGEST_STEP))))


def _best_of_halved(
    columns: _Columns, search: Search, here: Misregistration, matrix: Array, step: Array
) -> tuple[Misregistration, Array] | None:
    """Return where the step, or a half or a quarter of it, explains more; None: nowhere."""
    before, _ = columns.left(matrix)
    for _ in range(_HALVINGS):
        vector = here.vector + step
        if np.all(np.abs(vector - search.nominal.vector) < LIMIT):
            there = Misregistration.from_vector(vector)
            found = np.asarray(search.far.interaction_matrix(there), dtype=float)
            if columns.left(found)[0] <= before * (1.0 + 1e-9):
                return there, found
        step = step / 2.0
    return None


def _alone(spectra: Spectra) -> Spectra:
    """Return a window of which only the dithered modes are left, in the order of the lines."""
    modes = list(spectra.plan.modes)
    return Spectra(
        plan=spectra.plan,
        session=spectra.session,
        cm_id=spectra.cm_id,
        first_seq=spectra.first_seq,
        t_end_ns_utc=spectra.t_end_ns_utc,
        n_missing=spectra.n_missing,
        slopes=spectra.slopes,
        commands=spectra.commands[:, :, modes],
        dither=spectra.dither[:, modes],
    )


def _why_not(found: FarEstimate, nominal: Misregistration) -> str | None:
    """Return why an estimate is not believed, or None."""
    estimate = found.estimate
    gains = np.abs(estimate.optical_gain)
    if estimate.gain_sigma is not None and np.any(gains < FAINTEST * estimate.gain_sigma):
        return "the dither is not seen in the slopes: raise its amplitude or the window's length"
    if gains.max() > LARGEST_GAIN:
        return f"optical gains up to {gains.max():.1f}: the instrument file is another's"
    lag = float(np.median(estimate.lag_frames))
    if abs(lag) > MAX_LAG_FRAMES:
        return f"columns misaligned: slopes lag commands by {lag:+.2f} frame, 0 is expected"
    if not np.all(np.abs(estimate.alpha.vector - nominal.vector) < LIMIT):
        return f"{_said(estimate.alpha)} is out of range"
    if np.any(np.abs(estimate.step) > LONGEST_STEP):
        return f"the finer model leads away from {_said(estimate.alpha)}"
    if found.unexplained > UNEXPLAINED:
        return (
            f"{_said(estimate.alpha)} leaves {found.unexplained:.0%} of the response unexplained, "
            f"expected at most {UNEXPLAINED:.0%}"
        )
    return None


def _said(alpha: Misregistration) -> str:
    x, y, rotation, magnification = alpha.to_boundary().values()
    return f"({x:+.2f}, {y:+.2f} subap, {rotation:+.2f} deg, {magnification:.4f})"
