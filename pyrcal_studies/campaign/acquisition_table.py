"""How acquisitions ended: counts, times, and whether anything was believed that is not so."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from pyrcal_studies.campaign.rows import UNITS, Row, heading, line

WRONG = np.array([0.1, 0.1, 0.1, 0.005])
"""An α further off than this is wrong (boundary units): what a loop needs, and ten times the
accuracy asked for; or further than 5 of its own σ."""

WRONG_SIGMA = 5.0

_HEADER = heading(
    *("telescope, plant, truth", "starts", "tracking (share)", "time s: median, longest"),
    *("opened again", "failed, clear state", "unclear", "wrong α", "unstable matrix applied"),
    "error RMS x, y % / mdeg / %",
)


def table(rows: list[Row]) -> str:
    """Return the table, one line for each kind of start."""
    groups: dict[tuple[Any, ...], list[Row]] = defaultdict(list)
    for row in rows:
        name = Path(row["instrument"]).stem
        key = (name, row["plant"], row["truth"], row["magnitude"], row["gain"], row["n_controlled"])
        groups[key].append(row)
    return _HEADER + "".join(_line(key, group) for key, group in sorted(groups.items()))


def wrong(row: Row) -> bool:
    """Return whether the service relied on a registration that is not the telescope's."""
    if row["error"] is None or row["stage"] != "tracking":
        return False
    error = np.abs(row["error"])
    return bool(np.any(error > WRONG) or np.any(error > WRONG_SIGMA * np.array(row["sigma"])))


def _line(key: tuple[Any, ...], rows: list[Row]) -> str:
    name, plant, truth, magnitude, gain, n_controlled = key
    tracking = [row for row in rows if row["stage"] == "tracking"]
    failed = [row for row in rows if row["stage"] == "failed"]
    times = [row["time_s"] for row in tracking]
    spent = f"{np.median(times):.0f}, {max(times):.0f}" if times else "-"
    again = sum(row["attempts"] > 1 for row in rows)
    unstable = sum(radius is not None and radius >= 1.0 for row in rows for radius in _sent(row))
    errors = np.array([row["error"] for row in tracking if row["error"] is not None])
    rms = "-"
    if len(errors):
        x, y, rotation, magnification = np.sqrt(np.mean(errors**2, axis=0)) * UNITS
        rms = f"{x:.2f} {y:.2f} {rotation:.1f} {magnification:.3f}"
    return line(
        f"{name}, {plant}, {truth}, mag {magnitude:g}, {n_controlled} modes g {gain:g}",
        len(rows),
        f"{len(tracking)} ({len(tracking) / len(rows):.0%})",
        *(spent, again, len(failed), len(rows) - len(tracking) - len(failed)),
        *(sum(map(wrong, rows)), unstable, rms),
    )


def _sent(row: Row) -> list[float | None]:
    """Return the true pole radii of the matrices the service has sent."""
    radii: list[float | None] = row["radii"]
    return radii
