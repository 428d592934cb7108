"""Limits on the number of controlled modes, and descriptions of modes for people."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.estimation.own_matrix import (
    N_NEIGHBOURS,
    UNEVEN_RATIO,
    compare_strength,
    find_neighbours,
)

HEALTHY_RATIO = 1.3
"""A mode whose response differs from that of its neighbours by ``UNEVEN_RATIO`` or its inverse is
reported if it certainly exceeds this factor, which healthy modes do not exceed. It may still be
controlled."""

DOUBTFUL_RATIO = 1.45
"""From here on another window is asked."""

CERTAINTY_SIGMA = 3.0
"""A ratio is certainly beyond a limit if it exceeds it by this many σ."""

MAX_NEIGHBOUR_DISTANCE = 2 * N_NEIGHBOURS
"""Modes away that one of them may be: others have another optical gain."""

MIN_EXPLAINED_SHARE = 0.3
"""Least share of a response that counts as explained when strengths are compared: noise makes it
uncertain, and it may come out as zero."""

MAX_COMPARED_WINDOWS = 3
"""Number of windows that compare a mode before it is accepted without a certain result."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeLimit:
    """More modes than these gate, RTC or operator would not have; they are tried again later."""

    n_modes: int
    """Number of modes that may be controlled at present."""

    since_ns_utc: int
    until_ns_utc: int
    """More are not tried before."""

    wait_s: float
    """From one to the other; doubled each time the limit is found again."""

    reason: str
    """Reason why more modes are not permitted, as the gate, the RTC or the operator gave it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeAnswer:
    """The last answer of a mode that contradicts the instrument file."""

    mode: int
    gain: float
    """Times the model."""

    like: int
    """Mode of the model that it answers as; its own: none certainly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeRatio:
    """Response of a mode relative to its neighbours, if it differs from that of healthy modes."""

    mode: int
    ratio: float
    """Response divided by the median response of its neighbours, averaged over all windows."""

    sigma: float
    """1 σ of that."""

    n_windows: int = 1

    def plus(self, other: ModeRatio) -> ModeRatio:
        """Return what two sets of windows say together."""
        # Weights by inverse variance; the variance of such a mean is σ² times the weight.
        weight = other.sigma**2 / (self.sigma**2 + other.sigma**2)
        return ModeRatio(
            mode=self.mode,
            ratio=weight * self.ratio + (1.0 - weight) * other.ratio,
            sigma=self.sigma * float(np.sqrt(weight)),
            n_windows=self.n_windows + other.n_windows,
        )

    @property
    def stands_out(self) -> bool:
        """Return True if the mode may be uneven and certainly differs from the others."""
        return self._beyond(DOUBTFUL_RATIO) and self._certainly_beyond(1.0)

    @property
    def certain(self) -> bool:
        """Return True if more than one window shows that the mode is uneven."""
        beyond = self._beyond(UNEVEN_RATIO) and self._certainly_beyond(HEALTHY_RATIO)
        return self.n_windows > 1 and beyond

    def _beyond(self, limit: float) -> bool:
        # Too weak by a factor counts as much as too strong by it.
        return self.ratio > limit or self.ratio < 1.0 / limit

    def _certainly_beyond(self, limit: float) -> bool:
        spare = CERTAINTY_SIGMA * self.sigma
        return self.ratio - spare > limit or self.ratio + spare < 1.0 / limit

    @property
    def undecided(self) -> bool:
        """Return True if another window must decide."""
        return self.stands_out and not self.certain and self.n_windows < MAX_COMPARED_WINDOWS


def compare(
    modes: NDArray[np.intp],
    gains: NDArray[np.float64],
    sigma: NDArray[np.float64],
    unexplained: NDArray[np.float64] | None = None,
) -> dict[int, ModeRatio]:
    """Compare the response of each mode in one window with those of its neighbours in the basis.

    Optical gains change slowly with the mode number. A window with fewer than ``N_NEIGHBOURS``
    other modes is not compared. ``unexplained`` is the share of the power of each mode's response
    that the model does not explain; None: nothing.
    """
    left = np.zeros(len(modes)) if unexplained is None else unexplained
    explained = np.maximum(1.0 - left, MIN_EXPLAINED_SHARE)
    found: dict[int, ModeRatio] = {}
    if len(modes) <= N_NEIGHBOURS:
        return found
    for k, mode in enumerate(modes.tolist()):
        beside = find_neighbours(modes, k)
        usual = float(np.median(gains[beside]))
        # A ratio to neighbours that do not respond, or that are far away in the basis, means
        # nothing.
        if usual > 0.0 and abs(modes[beside[-1]] - mode) <= MAX_NEIGHBOUR_DISTANCE:
            ratio = compare_strength(gains, explained, k, beside)
            found[mode] = ModeRatio(mode=mode, ratio=ratio, sigma=float(sigma[k]) / usual)
    return found


def add_ratios(
    before: Mapping[int, ModeRatio], now: Mapping[int, ModeRatio]
) -> dict[int, ModeRatio]:
    """Return what this window and those before say of each mode that this one compares."""
    return {mode: before[mode].plus(one) if mode in before else one for mode, one in now.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeProof:
    """Modes whose response was verified against the model, independently of any matrix."""

    proven: frozenset[int] = frozenset()
    """Seen in a dithered window: the sign, and the size within a factor of its neighbours'."""

    contrary: frozenset[int] = frozenset()
    """Seen in two windows to answer with another sign or size, or not at all."""

    suspected: frozenset[int] = frozenset()
    """Seen so in one window: the next one decides."""

    strange: frozenset[int] = frozenset()
    """Modes of the RTC's own matrix that could not be recognised in it."""

    answers: tuple[ModeAnswer, ...] = ()
    """Modes with a wrong or suspect response, in order."""

    uneven: frozenset[int] = frozenset()
    """Modes with a response certainly far above or below that of their neighbours, in at least two
    windows."""

    doubtful: tuple[ModeRatio, ...] = ()
    """Modes that may be uneven, in order. They are not verified before further windows decide."""

    compared: frozenset[int] = frozenset()
    """Modes that were dithered next to enough others for a comparison."""

    own_uneven: str = ""
    """Modes that are uneven in the RTC's own matrix, in words; empty if there are none."""

    shown: frozenset[int] = frozenset()
    """Modes that the present dither verifies; empty if its result is known."""

    shown_ns_utc: int = 0
    """Time of that request."""

    n_tries: int = 0
    """Number of consecutive requests without a result for any of their modes."""

    session: str = ""
    """Session of the RTC in which the service before this one has seen it; empty: this one has."""

    own_weights: tuple[float, ...] = ()
    """Weight of each mode of the basis for the measurement of α, by how well the model explains
    the RTC's own matrix; empty if all count alike."""

    own_model_error: tuple[float, float, float, float] | None = None
    """1 σ by which the model leads a window of α astray, numeric units, by the scatter between the
    modes of the RTC's own matrix; None if it explains them well, or none was read."""

    own_misfit_ratio: float | None = None
    """Median share of its modes' response that the model does not explain, in norm; None if no
    matrix was read."""

    own_response_ratio: float | None = None
    """Median over its modes of the response in the RTC's own matrix divided by the model's; None if
    no matrix was read."""

    @property
    def n_proven(self) -> int:
        """Modes that a dither has shown to answer as they should."""
        return len(self.proven)

    @property
    def contrary_modes(self) -> tuple[int, ...]:
        """Return the modes that a dither has found wrong; none of them is newly controlled."""
        return tuple(sorted(self.contrary))


MAX_LISTED_MODES = 8
"""Modes, or runs of them, that a sentence lists; of more it says how many."""


def format_subject(modes: Collection[int]) -> str:
    """Return modes as the subject of a sentence, with its verb."""
    return (
        f"mode {format_modes(modes)} has"
        if len(modes) == 1
        else f"modes {format_modes(modes)} have"
    )


def format_modes(modes: Iterable[int]) -> str:
    """Return modes in words, lowest first, a run of them by its ends."""
    runs: list[list[int]] = []
    for mode in sorted(modes):
        if runs and mode == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], mode]
        else:
            runs.append([mode])
    parts = [" to ".join(map(str, run)) for run in runs]
    more = f" and {len(parts) - MAX_LISTED_MODES} more" if len(parts) > MAX_LISTED_MODES else ""
    return ", ".join(parts[:MAX_LISTED_MODES]) + more
