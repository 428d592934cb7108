"""From rows of passive nights to tables: errors, what was said of them, how often it was true."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from pyrcal_studies.campaign.rows import UNITS, Row, four, heading, line

WITHIN = 1.96
"""σ that a normal error stays within in 95 of 100 cases."""

HEADER = heading(
    *("nights", "reading", "looks", "error RMS x, y % / mdeg / %", "largest", "stated σ"),
    *("within 1.96 σ, each", "misfit"),
)


def table(rows: list[Row]) -> str:
    """Return a line per reading and kind of night; nights that differ in seed and wind share it."""
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        for reading in row["error"]:
            groups[_name(row["night"]), reading].append(row)
    return HEADER + "".join(_line(*key, group) for key, group in groups.items())


def _name(night: Row) -> str:
    words = [
        f"{night['plant']} {night['truth']}, mag {night['magnitude']:g}",
        night["profile"] or "single winds",
        f"g {night['gain']:g}",
    ]
    if night["registered"]:
        words.append("registered")
    if night["dither_every_s"]:
        words.append(f"5 s of dither every {night['dither_every_s']:g} s")
    return ", ".join(words)


def _line(name: str, reading: str, rows: list[Row]) -> str:
    errors = np.array([row["error"][reading] for row in rows])
    sigma = np.array([row["sigma"][reading] for row in rows])
    within = np.mean(np.abs(errors) <= WITHIN * sigma, axis=0)
    return line(
        *(name, reading, len(rows)),
        four(np.sqrt(np.mean(errors**2, axis=0)) * UNITS),
        four(np.abs(errors).max(axis=0) * UNITS),
        four(np.sqrt(np.mean(sigma**2, axis=0)) * UNITS),
        " ".join(f"{share:.0%}" for share in within),
        f"{np.median([row['misfit'] for row in rows]):.2f}",
    )
