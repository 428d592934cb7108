"""Measured response of dithered modes: what the model does not explain of it.

The RTC's own matrix shows the model's error in the modes that it controls. Of all other modes only
a dither shows it, and a loop that begins to control them may be unstable because of it. The slopes
at a mode's line, over its command, are its measured response. The model's part is in phase with
the command and is subtracted; noise has any phase. So the component out of phase is noise alone,
as strong and as correlated over slopes and modes as the noise of the component in phase, and shows
how much of the latter is significant.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.estimation.lockin import Spectra
from service.estimation.own_matrix import LeftOver
from service.records.estimates import LockInEstimate

Array = NDArray[Any]

MIN_GAIN_SIGMA = 4.0
"""A mode whose gain is not above this many σ has no response whose shape could be compared."""

MEMORY_RATIO = 0.95
"""Weight of earlier windows after each window of the same mode: twenty windows are averaged, so
that the residual follows a response that changes over the night."""

_TINY = float(np.finfo(np.float32).tiny)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModeResidual:
    """Residual of the model in the response of one dithered mode."""

    mean: NDArray[np.complex64]
    """``(n_slopes,)`` slope per metre, the weighted mean of its windows; noise is imaginary."""

    weight: float
    """Sum of the windows' weights."""

    significant: NDArray[np.float32] | None = None
    """``(n_slopes,)`` its part above the noise; None if there is none: of a good model hardly any
    mode has one, and those of all modes of an ELT would take as much memory as D."""


class DitheredResponse:
    """Residual of the model in the response of dithered modes, averaged over their windows.

    ``residuals`` has what ``session`` of the RTC has shown so far, by mode.
    """

    def __init__(
        self, session: str | None = None, residuals: Mapping[int, ModeResidual] | None = None
    ) -> None:
        self.session = session
        self.residuals = dict(residuals or {})

    @property
    def _significant(self) -> dict[int, Array]:
        return {m: r.significant for m, r in self.residuals.items() if r.significant is not None}

    def add(self, spectra: Spectra, estimate: LockInEstimate, response: Array) -> None:
        """Add a window, without the optical gain of each mode: the gate gets it from the tracker.

        ``response`` is ``(n_slopes, n_modes)`` without this residual, at unit gain.
        """
        if estimate.session != self.session:
            # An RTC that was restarted may have other modes.
            self.residuals, self.session = {}, estimate.session
        gains, sigma = estimate.optical_gain, estimate.gain_sigma
        if sigma is None:
            return
        lines = np.flatnonzero(gains.real > MIN_GAIN_SIGMA * sigma)
        if not len(lines):
            return
        modes = np.array(spectra.plan.modes)[lines]
        commands = spectra.commands[lines, 0]
        own = commands[np.arange(len(lines)), modes]
        # The commands of all modes: the loop answers a dither with every mode that it controls,
        # and those have a residual as well.
        seen = commands.real @ response.T + 1j * (commands.imag @ response.T)
        significant = self._significant
        if known := sorted(significant):
            others = np.where(np.equal.outer(modes, known), 0.0, commands[:, known])
            seen += others @ np.array([significant[mode] for mode in known])
        left = (spectra.slopes[lines, 0] / gains[lines, None] - seen) / own[:, None]
        for mode, one in zip(modes.tolist(), left, strict=True):
            self._add_to_mean(mode, one.astype(np.complex64))
        self._find_significant(modes.tolist())

    def _add_to_mean(self, mode: int, left: Array) -> None:
        weight = 1.0 / max(float(np.mean(left.imag**2)), _TINY)
        before = self.residuals.get(mode, ModeResidual(mean=np.zeros_like(left), weight=0.0))
        total = MEMORY_RATIO * before.weight + weight
        mean = before.mean + (left - before.mean) * np.float32(weight / total)
        self.residuals[mode] = replace(before, mean=mean, weight=total)

    def _find_significant(self, modes: list[int]) -> None:
        """Keep the patterns of these modes' residuals that exceed the noise.

        The model's error is smooth over modes and slopes, so that few patterns have most of it,
        while noise is spread over all: a single mode may be measured poorly, and the error of the
        combination of modes that makes a loop unstable is still known.
        """
        mean = np.array([self.residuals[mode].mean for mode in modes])
        sigma = np.sqrt(np.mean(mean.imag**2, axis=1, keepdims=True))
        sigma = np.maximum(sigma, _TINY)
        noise = float(np.linalg.norm(mean.imag / sigma, ord=2))
        by_mode, size, by_slope = np.linalg.svd(mean.real / sigma, full_matrices=False)
        # No margin: a pattern of noise that passes raises a pole radius by 0.02 at most, and an
        # error that is missed may hide an unstable loop.
        size[size < noise] = 0.0
        left = (sigma * ((by_mode * size) @ by_slope)).astype(np.float32)
        for mode, one in zip(modes, left, strict=True):
            # A copy, because a row of the window's array would keep all of it in memory.
            found = one.copy() if size.any() else None
            self.residuals[mode] = replace(self.residuals[mode], significant=found)

    def left_over(self, known: Collection[int] = ()) -> LeftOver | None:
        """Return the significant residual of modes other than ``known`` ones; None: of no mode."""
        return _of_modes(self._significant, known)

    def with_noise(self, known: Collection[int] = ()) -> tuple[LeftOver, ...]:
        """Return the residual of modes other than ``known`` ones as it may be within its noise.

        It is the mean of the windows, and the mean with one realisation of its noise added and
        subtracted; empty if no mode was dithered.
        """
        every = [
            _of_modes(
                {m: r.mean.real + sign * r.mean.imag for m, r in self.residuals.items()}, known
            )
            for sign in (0.0, 1.0, -1.0)
        ]
        return tuple(one for one in every if one is not None)


def _of_modes(residuals: Mapping[int, Array], known: Collection[int]) -> LeftOver | None:
    modes = sorted(residuals.keys() - set(known))
    if not modes:
        return None
    slopes = np.array([residuals[mode] for mode in modes], np.float32)
    return LeftOver(columns=np.array(modes), slopes=slopes.T)
