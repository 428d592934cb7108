"""From rows to the tables of nights of the whole service."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from pyrcal_studies.campaign.rows import UNITS, Row, four, heading, line

GROUPED_BY = (
    "case", "plant", "truth", "magnitude", "gain", "n_controlled", "seconds", "period_s",
    "instrument", "settings",
)  # fmt: skip
"""Nights that differ in nothing but the seed make one line."""

HEADER = heading(
    *("nights", "good α after s", "own matrix after s", "tracking RMS x, y % / mdeg / %"),
    *("flagged after s", "corrected after s", "wavefront nm", "dither nm", "cost nm"),
    *("windows (refused)", "published", "refused by the gate", "unstable"),
)


def table(rows: list[Row]) -> str:
    """Return the nights as a Markdown table, the worst of each group in brackets."""
    groups: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        groups[str([row[name] for name in GROUPED_BY])].append(row)
    return HEADER + "".join(line_of(_name(group[0]), group) for group in groups.values())


def line_of(name: str, rows: list[Row]) -> str:
    """Return the line of a group of nights."""
    jumps = [jump for row in rows for jump in row["jumps"]]
    return line(
        f"{len(rows)} x {name}",
        _worst([row["good_alpha_s"] for row in rows]),
        _worst([row["own_matrix_s"] for row in rows]),
        _tracking(rows),
        _worst([jump["flagged_s"] for jump in jumps]),
        _worst([jump["corrected_s"] for jump in jumps]),
        _mean([row["wavefront_nm"] for row in rows], ".1f"),
        _mean([row["dither_nm"] for row in rows], ".2f"),
        _cost(rows),
        f"{sum(sum(row['windows']) for row in rows)} ({sum(row['windows'][1] for row in rows)})",
        sum(len(row["published"]) for row in rows),
        sum(row["refused"] for row in rows),
        sum(row["unstable"] for row in rows),
    )


def _name(row: Row) -> str:
    words = [
        f"**{row['case']}**, {row['plant']} {row['truth']}, mag {row['magnitude']:g}",
        f"{row['n_controlled']} modes g {row['gain']:g}",
        f"{row['seconds']:g} s",
        *row["settings"],
    ]
    if row["instrument"] != "flao-lbt":
        words.append("another instrument")
    return ", ".join(words)


def _tracking(rows: list[Row]) -> str:
    """Return the RMS over all nights."""
    found = [row["tracking_rms"] for row in rows if row["tracking_rms"] is not None]
    if not found:
        return "-"
    return four(np.sqrt(np.mean(np.square(found), axis=0)) * UNITS)


def _worst(values: list[Any]) -> str:
    """Return mean and worst; what never came is counted."""
    came = [value for value in values if value is not None]
    if not values:
        return "-"
    never = f", {len(values) - len(came)} never" if len(came) < len(values) else ""
    if not came:
        return f"never ({len(values)})"
    return f"{np.mean(came):.1f} ({max(came):.1f}{never})"


def _mean(values: list[Any], form: str) -> str:
    found = [value for value in values if value is not None]
    return format(float(np.mean(found)), form) if found else "-"


def _cost(rows: list[Row]) -> str:
    """Return the plain difference of wavefront errors with and without dither, nm."""
    found = [
        row["wavefront_nm"] - row["twin_nm"]
        for row in rows
        if row.get("twin_nm") is not None and row["wavefront_nm"] is not None
    ]
    return f"{np.mean(found):.3f} ({max(found):.3f})" if found else "-"
