"""Detect wrong columns of a matrix: signs, places, noise, and remainders of earlier pokes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.solver import Solution
from service.errors import list_first
from service.estimation.orientation import find_orientation
from service.estimation.reference import Reference, Target
from service.model.instrument import Instrument
from service.model.modes import Basis
from service.model.sensors.sensor import Mapper

Array = NDArray[np.float64]

OPPOSITE_CORRELATION = -0.5
"""Correlation of a column with its model below which it has the wrong sign."""

OTHER_MODE_CORRELATION = 0.7
"""Correlation with another mode's model above which a column belongs to that mode."""

OWN_MODE_CORRELATION = 0.35
"""Correlation with its own model above which a column is not attributed to another mode."""

ORDER_CORRELATION = 0.7
"""Correlation of the lowest orders above which another arrangement of columns is accepted."""

ORDER_CORRELATION_RATIO = 1.3
"""Factor by which that correlation must exceed the one of the listed arrangement."""

NOISE_GAIN = 0.2
"""Gain of a column over the median, either way, within which the column may hold noise only."""

WEAK_COLUMN = 0.7
"""Largest size of such a column, over the expected one."""

MAX_NOISE_SHARE = 0.25
"""Largest share of columns with such a gain; more of them are the columns of another basis."""

CHANCE_SIGMA = 4.0
"""Correlation with the model, in 1 σ of that of noise, below which a column may be noise only."""

WHITE_NOISE_LIMIT = 11.8
"""Sum of squares of two neighbour correlations, in their σ, that noise exceeds in 0.3 % of cases.
"""

SMALLEST_SMEAR = 0.01
"""Share of the previous column below which the pokes count as settled."""

SMEAR_SIGMA = 5.0
"""Smallest significant share of the previous column, in its own σ."""

MAX_SMEAR = 0.45
"""Share above which a column belongs to the previous poke rather than to its own."""

_MIN_MODES = 9
"""Number of modes below which some other arrangement always correlates by chance."""

_MAX_LISTED = 12


def find_noise_columns(solution: Solution, target: Target, n_planes: int) -> NDArray[np.bool_]:
    """Return the columns that contain noise only ``(n_modes,)``.

    Such a column has nothing in common with its model, and its neighbouring subapertures are
    uncorrelated. A column of another mode, or of another basis, is smooth. So is the noise of
    vibration and turbulence: a smooth column counts as noise if it is weak and its gain near 0,
    unless it is that of another mode or many columns are like it.
    """
    # unit columns: squares of a value such as 1e200, read from a damaged file, would overflow
    measured = _unit(np.where(target.rows[:, None], target.matrix, 0.0))
    every = np.abs(measured.T @ _unit(np.asarray(solution.matrix, np.float64)))
    alike = np.diag(every)
    # The correlation of noise with any pattern scatters by one over the root of the number of
    # slopes.
    unlike = alike < CHANCE_SIGMA / np.sqrt(target.rows.sum())
    gains, middle = solution.projection.gains, float(np.abs(np.median(solution.projection.gains)))
    size = np.linalg.norm(target.matrix[target.rows], axis=0)
    expected = np.linalg.norm(solution.matrix[target.rows], axis=0) * middle
    found = np.asarray(
        (np.abs(gains) < NOISE_GAIN * middle)
        # The columns of actuators that are listed one place off are as strong as others.
        & (size < WEAK_COLUMN * expected)
        & (alike < OWN_MODE_CORRELATION)
        & (every.max(axis=1) < OTHER_MODE_CORRELATION)
    )
    if found.mean() > MAX_NOISE_SHARE:
        found = np.zeros(len(unlike), dtype=np.bool_)
    for column in np.flatnonzero(unlike & ~found):
        maps = np.zeros((n_planes, *target.valid.shape))
        maps[:, target.valid] = measured[:, column].reshape(n_planes, -1)
        counted = np.zeros_like(maps)
        counted[:, target.valid] = target.rows.reshape(n_planes, -1)
        squares = float(np.sum(maps**2)) / max(float(counted.sum()), 1.0)
        strength = 0.0
        for axis in (1, 2):
            # Pairs with a slope that was left out contain no product and must not count as
            # uncorrelated.
            pairs = np.sum(counted * np.roll(counted, 1, axis=axis))
            product = np.sum(maps * np.roll(maps, 1, axis=axis))
            strength += float(product**2 / (max(float(pairs), 1.0) * squares**2))
        found[column] = strength < WHITE_NOISE_LIMIT
    return found


def find_strange_columns(solution: Solution, target: Target) -> Iterator[str]:
    """Yield sentences on columns with the wrong sign and on columns of other modes."""
    measured = _unit(target.matrix[target.rows])
    alike = measured.T @ _unit(np.asarray(solution.matrix, dtype=np.float64)[target.rows])
    own = np.diag(alike)
    turned = target.modes[own < OPPOSITE_CORRELATION]
    if len(turned):
        yield f"columns of the wrong sign: {list_first(turned, _MAX_LISTED)}"
    likest = np.argmax(np.abs(alike), axis=1)
    columns = np.arange(len(own))
    foreign = (np.abs(alike[columns, likest]) > OTHER_MODE_CORRELATION) & (
        np.abs(own) < OWN_MODE_CORRELATION
    )
    exchanged, moved = [], []
    for column in np.flatnonzero(foreign):
        other = likest[column]
        pair = target.modes[column], target.modes[other]
        sign = alike[column, other] < 0.0
        if not (foreign[other] and likest[other] == column):
            moved.append(f"{pair[0]} is mode {pair[1]}'s{' with the other sign' if sign else ''}")
        # Each exchanged pair is named once.
        elif column < other:
            signs = sign or alike[other, column] < 0.0
            exchanged.append(f"{pair[0]} and {pair[1]}{' with other signs' if signs else ''}")
    if exchanged:
        yield f"columns that have changed places: {list_first(exchanged, _MAX_LISTED, '; ')}"
    if moved:
        yield f"columns that are another mode's: {list_first(moved, _MAX_LISTED, '; ')}"


def find_displaced_columns(
    instrument: Instrument, usable: Reference, basis: Basis, *, mapper: Mapper = map
) -> Iterator[str]:
    """Yield a sentence if all columns are displaced by one or reversed.

    The lowest modes decide.

    Parameters
    ----------
    instrument
        Instrument as described in its file; its orientation may be unknown.
    usable, basis
        Measured matrix, and the modes of its columns in order.
    """
    n = len(usable.columns)
    if n < _MIN_MODES:
        return
    every = np.arange(n)

    def correlation(columns: NDArray[np.intp], modes: NDArray[np.intp]) -> float:
        # Without mode numbers, because the arrangement tried here contradicts them.
        listed = replace(usable, matrix=usable.matrix[:, columns], modes=None, noise=None)
        search = find_orientation(instrument, listed, basis.subset(modes), mapper=mapper)
        return search.best.correlation

    tried = {
        "the first column is additional (piston?): column 1 is mode 0's, and so on": (
            every[1:],
            every[:-1],
        ),
        "the first column is missing: column 0 is mode 1's, and so on": (every[:-1], every[1:]),
        "the columns are in reverse order": (every, every[::-1]),
    }
    found = {words: correlation(*places) for words, places in tried.items()}
    best = max(found, key=lambda words: found[words])
    # Searched in the same way, so that the correlations are comparable.
    here = correlation(every, every)
    if found[best] > max(ORDER_CORRELATION, ORDER_CORRELATION_RATIO * here):
        yield (
            f"{best}; the lowest modes then correlate with the model by {found[best]:.2f}, "
            f"as listed by {here:.2f}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Smear:
    """Share of the previous column contained in each column."""

    share: float
    sigma: float
    """1 σ of the share, from its scatter between columns."""

    @property
    def is_found(self) -> bool:
        """True if the share is significant and large enough to matter."""
        return self.share > max(SMALLEST_SMEAR, SMEAR_SIGMA * self.sigma)

    @property
    def words(self) -> str:
        """Sentence on the share, its treatment in the fit, and the remedy."""
        return (
            f"each column holds {self.share:.0%} of the column before it (+- {self.sigma:.1%}): "
            "pokes that had not settled; the fit takes it out. Wait longer after each poke, or "
            "subtract it"
        )


def measure_smear(solution: Solution, target: Target) -> Smear:
    """Return the share of the previous column in each column, less that of the next one.

    Errors of the model make a column look like its neighbours on either side; a mirror that has not
    settled adds only the previous one.
    """
    measured = target.matrix[target.rows]
    model = np.asarray(solution.matrix, np.float64)[target.rows] * solution.projection.gains
    steps = np.diff(target.modes) == 1
    # Both neighbours must be consecutive modes: the next one is the control for model errors.
    middles = np.flatnonzero(steps[:-1] & steps[1:]) + 1
    if len(middles) < _MIN_MODES:
        # An infinite σ, so that nothing is found.
        return Smear(share=0.0, sigma=np.inf)
    found = []
    for k in middles:
        own, before, after = np.linalg.lstsq(model[:, [k, k - 1, k + 1]], measured[:, k])[0]
        found.append((before - after) / (abs(own) + abs(before) + abs(after)))
    # medians, so that a few outlying columns do not decide
    middle = float(np.median(found))
    # 1.4826 makes the median deviation a σ; 1.25 is the σ of a median over that of a mean.
    scatter = 1.4826 * float(np.median(np.abs(np.array(found) - middle)))
    return Smear(share=middle, sigma=1.25 * scatter / float(np.sqrt(len(found))))


def remove_smear(usable: Reference, share: float) -> Reference:
    """Return the columns with this share of the previous column removed, in sequence."""
    matrix = np.array(usable.matrix, dtype=np.float64)
    # in sequence, because each column contains a share of the already corrected previous one
    ratio = share / (1.0 - share)
    for k in np.flatnonzero(np.diff(usable.columns) == 1) + 1:
        matrix[:, k] -= ratio * matrix[:, k - 1]
    return replace(usable, matrix=matrix)


def _unit(columns: Array) -> Array:
    return np.asarray(columns / np.linalg.norm(columns, axis=0))
