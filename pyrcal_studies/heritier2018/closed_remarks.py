"""How the closed loop compares with the paper's, in words that the run's numbers choose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import page, paper
from sim_rtc.telescope.sky import DAYTIME_LINES

Array = NDArray[np.float64]


def shaken_remark(still: Array, shaken: Array) -> str:
    """Return how the error with vibrations compares with the first column of Table 2."""
    ours, spread = float(shaken.mean()), spread_nm(shaken)
    quoted = paper.TABLE_2["synthetic"]
    theirs = quoted.errors_nm[0]
    text = f"With vibrations: {ours:.0f} ± {spread:.0f} nm here, {theirs:g} nm in the paper. "
    if abs(ours - theirs) <= spread:
        return page.remark(text + "Within our own spread.", agrees=True)
    added = float(np.sqrt(max(float(np.mean(shaken**2 - still**2)), 0.0)))
    needed = float(np.sqrt(max(theirs**2 - float(np.mean(still**2)), 0.0)))
    text += (
        f"The simulated dome ({_shaking()}) adds {added:.0f} nm to the residual; {needed:.0f} nm "
        "would be needed for the paper's. How strongly the telescope shook that day is not in the "
        "paper's tables, so this level cannot be checked; the columns without tip and tilt can."
    )
    return page.remark(text, agrees=False)


def noise_remark(well: Array, in_haste: Array) -> str:
    """Return whether noise is what makes the synthetic matrix better, as it was at the telescope.

    Both are what the synthetic matrix gains, nm, without and with vibrations.
    """
    measured, synthetic = (paper.TABLE_2[key].errors_nm[1] for key in ("measured", "synthetic"))
    text = (
        f"Without tip and tilt the paper's synthetic matrix was {measured - synthetic:.1f} nm "
        f"better than the measured one; here, all modes together, it gains {well.max():.1f} nm at "
        f"most when the matrix is measured well, {in_haste.max():.1f} nm when every mode "
        "is pushed and pulled once. "
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
