"""Limits on the number of controlled modes, and descriptions of modes for people."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from service.errors import list_first
from service.estimation.own_matrix import N_NEIGHBOURS, compare_strength, find_neighbours
from service.records.products import ModeRatio

MAX_NEIGHBOUR_DISTANCE = 2 * N_NEIGHBOURS
"""Modes away that one of them may be: others have another optical gain."""

MIN_EXPLAINED_SHARE = 0.3
"""Least share of a response that counts as explained when strengths are compared: noise makes it
uncertain, and it may come out as zero."""


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
        neighbours = find_neighbours(modes, k)
        usual = float(np.median(gains[neighbours]))
        # A ratio to neighbours that do not respond, or that are far away in the basis, means
        # nothing.
        if usual > 0.0 and abs(modes[neighbours[-1]] - mode) <= MAX_NEIGHBOUR_DISTANCE:
            ratio = compare_strength(gains, explained, k, neighbours)
            found[mode] = ModeRatio(mode=mode, ratio=ratio, sigma=float(sigma[k]) / usual)
    return found


def add_ratios(
    before: Mapping[int, ModeRatio], now: Mapping[int, ModeRatio]
) -> dict[int, ModeRatio]:
    """Return what this window and those before say of each mode that this one compares."""
    return {mode: before[mode].plus(one) if mode in before else one for mode, one in now.items()}


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
    return list_first((" to ".join(map(str, run)) for run in runs), MAX_LISTED_MODES)
