"""From rows to the tables of a campaign: bias, scatter, coverage, refusals, wavefront error."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal_studies.campaign.rows import UNITS, Row, four, heading, line
from service.estimation.estimate import model_error

Array = NDArray[np.float64]

GROUPED_BY = (
    "plant", "truth", "magnitude", "profile", "wind_m_s", "gain",
    "n_controlled", "amplitude_nm", "window_s", "working_point_modes", "modes", "camera",
    "instrument", "rate_hz",
)  # fmt: skip
"""Nights that differ in nothing but the seed make one line of the table."""

HEADER = heading(
    *("night", "windows (refused)", "bias x, y % / mdeg / %", "scatter", "scatter/σ", "chi2/4"),
    *("inside 95 %", "error RMS", "wavefront nm"),
)


def table(rows: list[Row], floor: Array, *, pooled: bool = False) -> str:
    """Return the campaign as a Markdown table; ``floor`` ``(4,)`` in boundary units.

    ``pooled``: one line for all winds.
    """
    groups: dict[tuple[Any, ...], list[Row]] = defaultdict(list)
    for row in rows:
        common = row | {"wind_m_s": None} if pooled else row
        values = (common[name] for name in GROUPED_BY)
        groups[tuple(tuple(v) if isinstance(v, list) else v for v in values)].append(row)
    return HEADER + "".join(_line(key, group, floor) for key, group in groups.items())


def _line(key: tuple[Any, ...], rows: list[Row], floor: Array) -> str:
    good = [row for row in rows if row["refused"] is None]
    wavefront = np.array([row["wavefront_nm"] for row in rows if row["wavefront_nm"] is not None])
    name = _name(dict(zip(GROUPED_BY, key, strict=True)))
    counted = f"{len(rows)} ({len(rows) - len(good)})"
    error_nm = f"{np.sqrt(np.mean(wavefront**2)):.1f}" if wavefront.size else "-"
    if not good:
        return line(name, counted, *"------", error_nm)
    errors = np.array([row["error"] for row in good])
    covariances = np.array([row["covariance"] for row in good])
    seeds = np.array([row["seed"] for row in good])
    sigma = np.sqrt(np.mean(np.diagonal(covariances, axis1=1, axis2=2), axis=0))
    scatter = _within(errors, seeds)
    squares = distances(errors, covariances + model_errors(good), floor)
    inside = np.mean(squares < scipy.stats.chi2.ppf(0.95, 4))
    return line(
        *(name, counted),
        four(errors.mean(axis=0) * UNITS),
        four(scatter * UNITS),
        four(scatter / sigma),
        f"{squares.mean() / 4:.2f}",
        f"{inside:.0%}",
        four(np.sqrt(np.mean(errors**2, axis=0)) * UNITS),
        error_nm,
    )


def model_errors(rows: list[Row]) -> Array:
    """Return ``(n, 4, 4)`` what the misfit of each window adds, which the service adds as well."""
    return np.array([np.diag(model_error(row["covariance"], row["misfit"]) ** 2) for row in rows])


def distances(errors: Array, covariances: Array, floor: Array) -> Array:
    """Return ``(n,)`` normalised squared errors, floor included: four degrees of freedom."""
    total = covariances + np.diag(floor**2)
    return np.array([e @ np.linalg.solve(c, e) for e, c in zip(errors, total, strict=True)])


def _within(errors: Array, seeds: NDArray[np.int_]) -> Array:
    """Return the RMS scatter about each telescope's own mean, ``(4,)``."""
    squares, freedom = np.zeros(4), 0
    for seed in np.unique(seeds):
        own = errors[seeds == seed]
        squares += np.sum((own - own.mean(axis=0)) ** 2, axis=0)
        freedom += len(own) - 1
    return np.asarray(np.sqrt(squares / freedom)) if freedom else np.full(4, np.nan)


def _name(key: dict[str, Any]) -> str:
    wind = "many winds" if key["wind_m_s"] is None else f"{key['wind_m_s']:g} m/s"
    sky = key["profile"] or wind
    words = [
        f"{key['plant']} {key['truth']}, mag {key['magnitude']:g}, {sky}",
        f"{key['n_controlled']} modes g {key['gain']:g}",
        f"4 x {key['amplitude_nm']:g} nm, {key['window_s']:g} s",
    ]
    if key["working_point_modes"]:
        words.append("working point")
    if key["modes"]:
        words.append("modes " + " ".join(str(mode) for mode in key["modes"]))
    if key["instrument"] != "flao-lbt":
        words.insert(0, Path(key["instrument"]).stem)
    if key["rate_hz"]:
        words.append(f"{key['rate_hz']:g} Hz")
    if key["camera"] != "ccd":
        words.append(key["camera"])
    return ", ".join(words)
