"""Recognise the modes in the RTC's own matrix: order, sign, strength.

An RTC whose mode 10 has the other sign, or whose modes 3 and 40 are exchanged, closes its own loop
as well as any other, because its matrix was measured with them. With a matrix made by the model
these modes would diverge. The pseudo-inverse of the RTC's matrix is the interaction matrix that it
was made from. Each of its columns is compared with every mode of the model, at the registration
that explains most of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.control.reconstructor import MAX_CONDITION
from service.errors import list_first
from service.estimation.solver import SETTLED_STEP, Columns, Projection, shorten
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration
from service.records.products import UNEVEN_RATIO

Array = NDArray[Any]

MIN_MODE_CORRELATION = 0.5
"""Least correlation of a column with a mode for which it may be taken."""

OTHER_MODE_ADVANTAGE = 1.3
"""A column is another mode's where it correlates better with that one by this factor."""

N_FIRST_COLUMNS = 20
"""Lowest columns that a far registration is found by: their waves are long."""

COLUMNS_GROWTH = 3
"""Each next fit has so many times the columns of the last."""

MAX_FIT_STEPS = 6
"""Largest number of iterations of each fit."""

LINEAR_RANGE = np.array([0.1, 0.1, np.deg2rad(0.5), 0.005])
"""Distance from its registration beyond which a linearisation is recomputed, numeric units."""

MAX_STRANGE_SHARE = 0.3
"""Share of columns that may be no mode of the model before all are taken for another basis."""


N_NEIGHBOURS = 10
"""Number of neighbours that a mode's response is compared with."""

MIN_ROLLED_SHARE = 0.8
"""Share of misplaced modes that are so by as many places, when all are reported as rolled."""

MAX_UNWEIGHTED_MISFIT = 0.08
"""Median misfit of the RTC's own modes, in norm, below which all modes count alike for α. Matrices
of simulators that differ from the model in influence functions and light leave 0.01 to 0.05,
measured ones 0.15 to 0.4."""

MAX_TESTED_MISFIT = 0.4
"""Median misfit up to which the service was tested on measured responses (results/tracking.md)."""

N_FITTED = 8
"""Modes of the RTC's own matrix from which the misfit of others may be extrapolated."""

N_DITHERED = 4
"""Modes of a dither that measures α."""

N_PARAMETERS = 4
"""Number of parameters of a registration: so few modes have no scatter about the fit."""

_MAX_LISTED_MODES = 8
"""Modes that a sentence names at most."""

LineariseAt = Callable[[Misregistration], Linearisation]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeftOver:
    """The part of the measured response of some modes that the model does not explain."""

    columns: NDArray[np.intp]
    """``(n,)`` modes."""

    slopes: NDArray[np.float32]
    """``(n_slopes, n)`` slope per metre."""

    def is_large(self, model: NDArray[np.floating]) -> bool:
        """Return True if the model ``(n_slopes, n_modes)`` explains most of these modes poorly."""
        size = np.linalg.norm(model[:, self.columns], axis=0)
        share = np.linalg.norm(self.slopes, axis=0) / np.maximum(size, np.finfo(np.float32).tiny)
        return bool(len(share)) and float(np.median(share)) >= MAX_UNWEIGHTED_MISFIT

    def add_to(self, linearisation: Linearisation) -> Linearisation:
        """Return a linearisation whose matrix has it: the response as it was measured."""
        matrix = linearisation.matrix.copy()
        matrix[:, self.columns] += self.slopes
        return replace(linearisation, matrix=matrix)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OwnMatrix:
    """The modes that the RTC's own matrix controls, as the model recognises them."""

    alpha: Misregistration
    """Registration at which the model explains most of its columns."""

    columns: NDArray[np.intp]
    """``(n,)`` modes that it controls, in the RTC's numbering."""

    modes: NDArray[np.intp]
    """``(n,)`` mode of the model that each of them is; -1: none was recognised."""

    response: NDArray[np.float64]
    """``(n,)`` slopes per unit of command over the model's, signed; NaN: not recognised."""

    misfit: NDArray[np.float64]
    """``(n,)`` norm of the residual over that of the model's column; NaN: not recognised."""

    covariance: NDArray[np.float64]
    """``(4, 4)`` covariance of ``alpha``, numeric units, from the scatter between modes."""

    weights: tuple[float, ...] = ()
    """Weight of each mode of the basis for the measurement of α; empty if all count alike."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """``(n,)`` True for columns that are the mode of their number, with the model's sign."""
        return np.asarray((self.modes == self.columns) & (np.nan_to_num(self.response) > 0.0))

    @property
    def typical_misfit(self) -> float | None:
        """Median misfit of the modes that are known; None: none is."""
        return float(np.median(self.misfit[self.known])) if self.known.any() else None

    @property
    def model_error(self) -> tuple[float, float, float, float] | None:
        """1 σ by which the model leads a window of ``N_DITHERED`` modes astray, numeric units.

        From the scatter between modes; None if the model explains them well, or too few are known.
        """
        if not self.weights or not self.tells_registration:
            return None
        # The error of a mean of all known modes is scaled to one of the few that a window has.
        share = self.known.sum() / N_DITHERED
        x, y, rotation, magnification = np.sqrt(np.diag(self.covariance) * share).tolist()
        return x, y, rotation, magnification

    @property
    def tells_registration(self) -> bool:
        """True if enough modes were recognised for ``alpha`` to be a start of fits."""
        return int(self.known.sum()) > N_PARAMETERS and bool(np.isfinite(self.covariance).all())

    @property
    def wrong(self) -> str:
        """Text on modes with a sign or place unlike the instrument file's; empty without any."""
        strange = self.modes < 0
        if strange.mean() > MAX_STRANGE_SHARE:
            return (
                f"{int(strange.sum())} of the {len(self.modes)} modes that the RTC's own matrix "
                "controls are none of the instrument file's: its slopes are listed in another "
                "order, or its modes are another basis"
            )
        found = [self._order(), self._signs()]
        return "; ".join(part for part in found if part)

    @property
    def uneven(self) -> str:
        """Text on modes whose response differs from their neighbours'; empty without any."""
        recognised = np.flatnonzero(self.modes >= 0)
        gain, misfit = np.abs(self.response[recognised]), self.misfit[recognised]
        explained = 1.0 / (1.0 + misfit**2)
        ratio = {
            int(self.columns[mode]): compare_strength(
                gain, explained, k, find_neighbours(recognised, k)
            )
            for k, mode in enumerate(recognised)
            if len(recognised) > 1
        }
        odd = [
            f"mode {mode} {times:.2g} times"
            for mode, times in ratio.items()
            if not 1.0 / UNEVEN_RATIO < times < UNEVEN_RATIO
        ]
        if not odd:
            return ""
        listed = list_first(odd, _MAX_LISTED_MODES)
        return f"by the RTC's own matrix {listed} as strongly as its neighbours"

    @property
    def typical_response(self) -> float | None:
        """Median ratio of the recognised modes' response to the nominal; None without any."""
        return float(np.median(self.response[self.known])) if self.known.any() else None

    @property
    def text(self) -> str:
        """A sentence for the operator."""
        if self.wrong:
            return self.wrong
        size = self.typical_response
        found = f"{int(self.known.sum())} of {len(self.columns)} modes are the instrument file's"
        if size is not None and abs(size - 1.0) > 0.1:
            found += f" and respond {size:.2f} times as strongly as the model"
        misfit = self.typical_misfit
        if misfit is not None and misfit >= MAX_UNWEIGHTED_MISFIT:
            found += f"; the model leaves {misfit:.0%} of their response unexplained"
            check = ": check the instrument file" if misfit > MAX_TESTED_MISFIT else ""
            found += f" (tested up to {MAX_TESTED_MISFIT:.0%}{check})"
        return f"{found}; {self.uneven}" if self.uneven else found

    def _signs(self) -> str:
        turned = self.columns[np.nan_to_num(self.response) < 0.0]
        if not len(turned):
            return ""
        if len(turned) == 1:
            return f"mode {turned[0]} has the other sign by the RTC's own matrix"
        listed = list_first(turned, _MAX_LISTED_MODES)
        return f"modes {listed} have the other sign by the RTC's own matrix"

    def _order(self) -> str:
        elsewhere = (self.modes >= 0) & (self.modes != self.columns)
        if not elsewhere.any():
            return ""
        columns, modes = self.columns[elsewhere], self.modes[elsewhere]
        by, times = np.unique(modes - columns, return_counts=True)
        if times.max() > max(MIN_ROLLED_SHARE * len(columns), 2):
            whole = np.flatnonzero(modes - columns == by[times.argmax()])
            return (
                f"modes are rolled by {by[times.argmax()]:+d} by the RTC's own matrix: its mode "
                f"{columns[whole[0]]} is the instrument file's {modes[whole[0]]}, and so on for "
                f"{len(whole)} modes"
            )
        place = dict(zip(columns.tolist(), modes.tolist(), strict=True))
        # one < to lists each pair once.
        pairs = [(one, to) for one, to in place.items() if place.get(to) == one and one < to]
        if 2 * len(pairs) == len(columns):
            exchanged = list_first([f"{one} and {to}" for one, to in pairs], _MAX_LISTED_MODES)
            return f"modes {exchanged} are exchanged by the RTC's own matrix"
        text = list_first(
            [f"{one} is the instrument file's {to}" for one, to in place.items()], _MAX_LISTED_MODES
        )
        return f"modes have other places by the RTC's own matrix: {text}"


def find_neighbours(modes: NDArray[np.intp], k: int) -> NDArray[np.intp]:
    """Return the indices of the ``N_NEIGHBOURS`` modes nearest in number to ``modes[k]``."""
    return np.argsort(np.abs(modes - modes[k]), kind="stable")[1 : N_NEIGHBOURS + 1]


def compare_strength(
    gain: NDArray[np.floating], explained: NDArray[np.floating], k: int, others: NDArray[np.intp]
) -> float:
    """Return the strength of the response of mode ``k`` over the median of the ``others``.

    Where the model explains a mode's response only in part, the gain is the projection on the
    model, and too small: the norm of the response is ``gain / sqrt(explained)``. But noise raises
    the norm, so that of both ratios the one nearer to 1 is returned.

    Parameters
    ----------
    gain
        ``(n,)`` response over the model's.
    explained
        ``(n,)`` share of the power of each response that the model explains.
    k, others
        Indices of the mode and of its neighbours.
    """
    ratios = [
        float(size[k] / np.median(size[others])) for size in (gain, gain / np.sqrt(explained))
    ]
    return min(ratios, key=lambda ratio: abs(np.log(max(ratio, np.finfo(float).tiny))))


def recognise_modes(
    reconstructor: NDArray[np.float32], linearise: LineariseAt, start: Misregistration
) -> OwnMatrix | None:
    """Return the modes of a reconstructor ``(n_controlled, n_slopes)``, metres per slope.

    The registration is found from the lowest columns first, then from more and more of them, with
    a free gain for each; columns that are recognised as no mode or as another one do not spoil it.
    None: the matrix commands nothing, or holds numbers that are not finite.

    Parameters
    ----------
    reconstructor
        As the RTC multiplies with it; rows of zeros control nothing.
    linearise
        Makes the model's response at a registration, ``(n_slopes, n_modes)``.
    start
        Where the mirror is thought to be.
    """
    if not np.isfinite(reconstructor).all():
        return None
    columns = np.flatnonzero(np.any(reconstructor != 0.0, axis=1))
    if not len(columns):
        return None
    inverse = _inverse_of(reconstructor[columns])
    # Columns of unit length: gains differ by mode and contain nothing about the registration.
    seen = inverse / np.maximum(np.linalg.norm(inverse, axis=0), np.finfo(float).tiny)
    alpha, near = start, linearise(start)
    n = min(N_FIRST_COLUMNS, len(columns))
    while True:
        alpha, near = _fit_registration(seen[:, :n], columns[:n], alpha, near, linearise)
        if n == len(columns):
            break
        n = min(COLUMNS_GROWTH * n, len(columns))
    response = near.matrix_at(alpha)
    modes = _recognise_columns(seen, columns, response)
    gains, misfit = np.full((2, len(columns)), np.nan)
    for k in np.flatnonzero(modes >= 0):
        mode = response[:, modes[k]].astype(float)
        gains[k] = mode @ inverse[:, k] / (mode @ mode)
        residual = inverse[:, k] / gains[k] - mode
        misfit[k] = np.linalg.norm(residual) / np.linalg.norm(mode)
    return OwnMatrix(
        alpha=alpha,
        columns=columns,
        modes=modes,
        response=gains,
        misfit=misfit,
        covariance=_scatter(seen, modes, response, near),
    )


def weights_of_modes(found: OwnMatrix, power: NDArray[np.floating]) -> tuple[float, ...]:
    """Return the weight of each mode for the measurement of α; empty: all count alike.

    A mode of which the model leaves a share s unexplained pulls α by about s over its own
    sensitivity, whatever the noise. Of modes that the matrix does not control the misfit is
    extrapolated: it grows with the order of the mode on every bench measured so far.

    Parameters
    ----------
    found
        The modes of the RTC's own matrix.
    power
        ``(n_modes,)`` sum of the squares of each column of the model.
    """
    columns, misfit = found.columns[found.known], found.misfit[found.known]
    if len(columns) < N_FITTED or np.median(misfit) < MAX_UNWEIGHTED_MISFIT:
        return ()
    typical, every = float(np.median(misfit)), np.arange(len(power))
    slope, _ = np.polyfit(columns, misfit, 1)
    # Never below the typical misfit: modes that were not measured are not assumed to be better.
    expected = typical + np.maximum(slope * (every - np.median(columns)), 0.0)
    expected[columns] = misfit
    # The constant is for the error that the model has in any mode: no mode gets an unlimited
    # weight.
    weights = 1.0 / (power * (MAX_UNWEIGHTED_MISFIT**2 + expected**2))
    return tuple((weights / weights.max()).tolist())


def left_over(
    reconstructor: NDArray[np.float32], found: OwnMatrix, response: NDArray[np.floating]
) -> LeftOver:
    """Return what the model's ``response`` ``(n_slopes, n_modes)`` leaves of a reconstructor.

    ``response`` is of the registration that was found. One gain common to all modes is left out:
    it is the sensor's.
    """
    columns = found.columns[found.known]
    inverse = _inverse_of(reconstructor[found.columns])[:, found.known]
    model = response[:, columns].astype(float)
    gain = np.median(np.sum(model * inverse, axis=0) / np.sum(model**2, axis=0))
    return LeftOver(columns=columns, slopes=(inverse / gain - model).astype(np.float32))


def _inverse_of(reconstructor: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the interaction matrix ``(n_slopes, n)`` that a reconstructor inverts."""
    return np.linalg.pinv(reconstructor.astype(float), rcond=1.0 / MAX_CONDITION)


def _scatter(
    seen: Array, modes: NDArray[np.intp], response: Array, near: Linearisation
) -> NDArray[np.float64]:
    """Return the covariance ``(4, 4)`` of the registration from the scatter between modes.

    The sandwich estimator with a mode as the unit: a model that is wrong pulls each mode another
    way, and by more than the noise of its slopes would.
    """
    n_usable = np.count_nonzero(modes >= 0)
    if n_usable <= N_PARAMETERS:
        return np.full((4, 4), np.inf)
    found = _project(seen, modes, response, near)
    inverse = np.linalg.inv(found.normal)
    # Corrects for the parameters that were fitted to the same modes.
    spread = found.scores @ found.scores.T * (n_usable / (n_usable - N_PARAMETERS))
    return np.asarray(inverse @ spread @ inverse.T)


def _fit_registration(
    seen: Array,
    columns: NDArray[np.intp],
    alpha: Misregistration,
    near: Linearisation,
    linearise: LineariseAt,
) -> tuple[Misregistration, Linearisation]:
    """Return the registration that explains these columns of unit length, and a model near it."""
    for _ in range(MAX_FIT_STEPS):
        if np.any(np.abs(alpha.vector - near.alpha.vector) > LINEAR_RANGE):
            near = linearise(alpha)
        response = near.matrix_at(alpha)
        modes = _recognise_columns(seen, columns, response)
        if np.count_nonzero(modes >= 0) < 3:
            return alpha, near
        step = shorten(_project(seen, modes, response, near).best_step)
        alpha = alpha.add_step(step)
        if np.all(np.abs(step) < SETTLED_STEP):
            break
    return alpha, near


def _recognise_columns(
    seen: Array, columns: NDArray[np.intp], response: NDArray[np.float32]
) -> NDArray[np.intp]:
    """Return the mode that each column is, ``(n,)``; -1: none.

    A column is the mode of its own number unless another one fits it clearly better.
    """
    size = np.maximum(np.linalg.norm(response, axis=0), np.finfo(np.float32).tiny)
    # The absolute value: a mode with the other sign is recognised, and reported as such.
    likeness = np.abs((response / size).T @ seen)
    own = likeness[columns, np.arange(len(columns))]
    best = np.argmax(likeness, axis=0)
    highest = likeness[best, np.arange(len(columns))]
    modes = np.where(OTHER_MODE_ADVANTAGE * own >= highest, columns, best)
    taken = likeness[modes, np.arange(len(columns))]
    return np.where(taken >= MIN_MODE_CORRELATION, modes, -1)


def _project(
    seen: Array, modes: NDArray[np.intp], response: Array, near: Linearisation
) -> Projection:
    """Return the recognised columns, of unit length, against the model's ``response``."""
    usable = np.flatnonzero(modes >= 0)
    columns, model = seen[:, usable], response[:, modes[usable]]
    # A weak response determines the registration as well as a strong one: each is weighted as if
    # its gain were that of all.
    along = np.einsum("sm,sm->m", model, columns) / np.linalg.norm(model, axis=0)
    every = np.ones(len(columns), dtype=np.bool_)
    measured = Columns(matrix=columns, weights=along**-2.0, rows=every)
    return measured.project(model, near.derivatives[:, :, modes[usable]], np.float32)
