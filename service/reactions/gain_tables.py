"""The table of loop gains from the optical gains that were measured."""

from __future__ import annotations

import numpy as np

from service.control.gain_table import GainTable, gain_table
from service.state import ModeGain


def table_of(measured: tuple[ModeGain, ...], n_modes: int) -> GainTable:
    """Return the table of the first ``n_modes`` modes; nothing measured: what is expected."""
    return gain_table(
        np.array([gain.mode for gain in measured], dtype=np.intp),
        np.array([gain.gain for gain in measured]),
        np.array([gain.sigma for gain in measured]),
        n_modes,
    )
