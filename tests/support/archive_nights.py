"""What tests of several modules share of unit.test_archive_nights."""

from __future__ import annotations

import numpy as np

from service.archive.nights import DAY_NS, HOUR_NS
from service.model.misregistration import Misregistration
from service.records.registration import HistoryEntry

SECOND = 1_000_000_000


NOON = 20_000 * DAY_NS + 12 * HOUR_NS
"""2024-10-04."""


def entry(t_ns, shift_x=0.1, **changes):
    return HistoryEntry(
        **{
            "t_ns_utc": t_ns,
            "measured": Misregistration(shift_x_subap=shift_x, rotation_rad=0.01),
            "measured_sigma": np.array([0.01, 0.02, 0.003, 0.0004]),
            "filtered": Misregistration(shift_x_subap=shift_x, magnification=1.002),
            "filtered_sigma": np.array([0.001, 0.002, 0.0003, 0.00004]),
            "innovation": 3.5,
            "misfit": 1.2,
            "in_use": "cm-1",
        }
        | changes
    )
