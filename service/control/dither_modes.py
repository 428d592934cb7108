"""Which modes a dither tells most with.

All modes are seen equally well by a shift, but a mode of high azimuthal order tells a rotation
twice as well as its neighbours, and one of high radial order the magnification.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.model.interaction import Linearisation

Array = NDArray[np.float64]

SPAN = 100
"""Modes above the controlled ones that are looked at: further up, models of mirrors differ more."""

_BLIND = 1e-12
_GAINFUL = 1e-6


def information(linearisation: Linearisation) -> Array:
    """Return what each mode tells of α, ``(n_modes, 4, 4)``, per metre² of dither and unit noise.

    The Fisher information of white slope noise, a free gain of the mode taken out:
    ``J^T J`` with ``J_k = (I - P) dD/dα_k``, P the projection on the mode's own response.
    """
    response, derivatives = linearisation.matrix, linearisation.derivatives
    n_modes = response.shape[1]
    norm = _sums(response, response)
    along = np.array([_sums(response, derivative) for derivative in derivatives])
    full = np.empty((n_modes, len(derivatives), len(derivatives)))
    for k, one in enumerate(derivatives):
        for j, other in enumerate(derivatives[: k + 1]):
            full[:, k, j] = full[:, j, k] = _sums(one, other)
    return np.asarray(full - np.einsum("km,lm->mkl", along, along) / norm[:, None, None])


def _sums(one: NDArray[np.float32], other: NDArray[np.float32]) -> Array:
    """Return the products of every two columns, ``(n_modes,)``."""
    return np.asarray(np.einsum("sm,sm->m", one, other), dtype=np.float64)


def most_telling(information: Array, candidates: range, n: int, wanted: Array) -> tuple[int, ...]:
    """Return the ``n`` modes that together come closest to every wanted σ ``(4,)``.

    Of all sets the one whose worst ratio of σ to ``wanted`` is smallest, found by exchange: from
    evenly spread modes, each in turn gives way to the best other candidate until none does.
    """
    pool = [mode for mode in candidates if mode < len(information)]
    if len(pool) <= n:
        return tuple(pool)
    scaled = information * np.outer(wanted, wanted)
    chosen = [pool[k] for k in np.linspace(0, len(pool) - 1, n).round().astype(int)]
    cost, improving = float(_worst(scaled[chosen].sum(axis=0))), True
    while improving:
        improving = False
        for place in range(n):
            kept = chosen[:place] + chosen[place + 1 :]
            others = [mode for mode in pool if mode not in kept]
            costs = _worst(scaled[kept].sum(axis=0) + scaled[others])
            best = int(np.argmin(costs))
            if costs[best] < cost * (1.0 - _GAINFUL):
                chosen, cost, improving = [*kept, others[best]], float(costs[best]), True
    return tuple(sorted(chosen))


def _worst(scaled: Array) -> Array:
    """Return the largest variance of α over what is wanted, of sets ``(..., 4, 4)``.

    A set that is blind to a combination of parameters has an enormous one.
    """
    power = np.diagonal(scaled, axis1=-2, axis2=-1)
    unit = np.sqrt(power[..., :, None] * power[..., None, :])
    correlation = scaled / unit + _BLIND * np.eye(scaled.shape[-1])
    variances = np.diagonal(np.linalg.inv(correlation), axis1=-2, axis2=-1) / power
    return np.asarray(variances.max(axis=-1))
