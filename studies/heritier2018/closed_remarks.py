"""How the closed loop compares with the paper's, in words that the run's numbers choose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_rtc.telescope.sky import DAYTIME_LINES
from studies.heritier2018 import page, paper

Array = NDArray[np.float64]


def still_remark(still: Array, by_night_nm: float, beyond_nm: float) -> str:
    """Return how the error without vibrations compares with the paper's simulation.

    ``by_night_nm`` is the same loop with all of the turbulence, ``beyond_nm`` the part of that
    which no mode of the mirror can make.
    """
    ours, spread = float(still.mean()), spread_nm(still)
    quoted = paper.STILL_ERROR
    away = quoted.distance(ours)
    text = f"Without vibrations: {ours:.0f} ± {spread:.0f} nm here, {quoted.text} in the paper. "
    if away <= spread:
        return page.remark(text + "Within our own spread.", agrees=True)
    left = quoted.distance(by_night_nm)
    text += (
        f"Ours differs by {away:.0f} nm. Played on the mirror, a turbulence holds only what the "
        f"mirror can make; by night, with the {beyond_nm:.0f} nm that it cannot make, the "
        f"registered loop with as many modes leaves {by_night_nm:.0f} nm"
    )
    if left <= spread:
        text += ", as in the paper: that accounts for the difference."
    elif left < 0.5 * away:
        text += (
            f", {left:.0f} nm from the paper's: that is most of the difference. The rest is in "
            "what the paper does not give us: wind, outer scale, frame rate and gains."
        )
    else:
        text += (
            f", {left:.0f} nm from the paper's: that is not the reason. What the paper does not "
            "give us differs: wind, outer scale, frame rate and gains."
        )
    return page.remark(text, agrees=False)


def shaken_remark(still: Array, shaken: Array) -> str:
    """Return how the error with vibrations compares with the paper's Table 2."""
    ours, spread = float(shaken.mean()), spread_nm(shaken)
    quoted = paper.SHAKEN_ERROR
    away = quoted.distance(ours)
    more_nm2 = float(np.mean(shaken**2 - still**2))
    added = float(np.sqrt(max(more_nm2, 0.0)))
    text = f"With vibrations: {ours:.0f} ± {spread:.0f} nm here, {quoted.text} in the paper. "
    if away <= spread:
        return page.remark(text + "Within our own spread.", agrees=True)
    low = min(quoted.values)
    needed = float(np.sqrt(max(low**2 - float(np.mean(still**2)), 0.0)))
    text += (
        f"The simulated dome ({_shaking()}) adds {added:.0f} nm to the residual; {needed:.0f} nm "
        "would be needed for the paper's lowest value. How strongly the telescope shook that day "
        "is not in the paper's tables, so the comparison between reconstructors below is what can "
        "be checked, not this level."
    )
    return page.remark(text, agrees=False)


def noise_remark(well: Array, in_haste: Array) -> str:
    """Return whether noise is what makes the synthetic matrix better, as it was at the telescope.

    Both are what the synthetic matrix gains, nm, without and with vibrations.
    """
    low, high = min(paper.SHAKEN_ERROR.values), max(paper.SHAKEN_ERROR.values)
    text = (
        f"The paper's values of Table 2 lie {high - low:.0f} nm apart at most, and its synthetic "
        f"matrix was slightly better; here it gains {well.max():.1f} nm at most when the matrix is "
        f"measured well, {in_haste.max():.1f} nm when every mode is pushed and pulled once. "
    )
    grows = bool(in_haste.max() > well.max() + 1.0)
    text += (
        "The gain is the noise that the measured matrix carries into the loop, and grows with it; "
        "how noisy the paper's was is not known."
        if grows
        else "Noise of the measured matrix is not what separates them here."
    )
    return page.remark(text, agrees=grows)


def spread_nm(values: Array) -> float:
    """Return the scatter over telescopes; of a single one, 5 % of its value."""
    return float(values.std(ddof=1)) if len(values) > 1 else 0.05 * float(values[0])


def _shaking() -> str:
    return ", ".join(
        f"{line.shape} {line.rms_m * 1e9:.0f} nm at {line.frequency_hz:g} Hz"
        for line in DAYTIME_LINES
    )
