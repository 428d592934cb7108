"""The optical gain of every dithered mode, followed from window to window."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.reactions.policy import SECOND_NS
from service.state import ModeGain

MODES_KEPT = 64
"""More than any dither plays at once: of those measured longest ago the rest is forgotten."""

GAIN_RATE = 0.05 / np.sqrt(60.0)
"""Random walk of a gain, relative, 1 σ after one second: seeing changes it by 5 % in a minute."""

FIRST_SCATTER = 0.1
"""Relative 1 σ of one window before any two were compared."""

LEARNING = 0.1
"""Weight of the newest window in the scatter: ten windows are remembered."""

_FARTHEST = 3.0
"""A window further out than this many σ counts as one at this distance."""

Array = NDArray[np.float64]


def followed_gains(
    known: tuple[ModeGain, ...],
    modes: tuple[int, ...],
    gains: Array,
    sigma: Array | None,
    t_ns: int,
) -> tuple[ModeGain, ...]:
    """Return the gains after a window that held these modes, in the order of the modes.

    ``gains`` and ``sigma`` ``(n_lines,)`` are modulus and 1 σ from the window's own data; None:
    nothing but the scatter from window to window tells how precise they are.
    """
    table = {gain.mode: gain for gain in known}
    own = np.zeros(len(gains)) if sigma is None else sigma
    for mode, gain, noise in zip(modes, gains, own, strict=True):
        table[mode] = _followed(table.get(mode), mode, float(gain), float(noise), t_ns)
    newest = sorted(table.values(), key=lambda gain: gain.t_ns_utc)[-MODES_KEPT:]
    return tuple(sorted(newest, key=lambda gain: gain.mode))


def _followed(
    known: ModeGain | None, mode: int, measured: float, noise: float, t_ns: int
) -> ModeGain:
    """Return one gain as a scalar random walk; its windows' scatter is learnt as it goes.

    A window's own σ knows the noise beside the lines, not that the gain itself swings.
    """
    if known is None:
        scatter = max(noise, FIRST_SCATTER * measured)
        return ModeGain(mode=mode, gain=measured, sigma=scatter, scatter=scatter, t_ns_utc=t_ns)
    elapsed_s = max((t_ns - known.t_ns_utc) / SECOND_NS, 0.0)
    prior = known.sigma**2 + (GAIN_RATE * known.gain) ** 2 * elapsed_s
    farthest = _FARTHEST * float(np.sqrt(prior + known.scatter**2))
    innovation = float(np.clip(measured - known.gain, -farthest, farthest))
    learnt = max(innovation**2 - prior, noise**2)
    scatter = float(np.sqrt((1 - LEARNING) * known.scatter**2 + LEARNING * learnt))
    weight = prior / (prior + scatter**2)
    return ModeGain(
        mode=mode,
        gain=known.gain + weight * innovation,
        sigma=float(np.sqrt((1 - weight) * prior)),
        scatter=scatter,
        t_ns_utc=t_ns,
    )
