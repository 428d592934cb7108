"""A sample of the service's state every few seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.archive.nights import Values
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration

TREND_S = 15.0
"""From one sample to the next, seconds: 1 MB a day."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrendSample:
    """The service's state at one moment; without a sample no service ran."""

    t_ns_utc: int
    """When, the service's clock."""

    telemetry_ns_utc: int | None = None
    """End of the telemetry that had come since the sample before, the RTC's clock; None: none."""

    alpha: Misregistration | None = None
    """The registration as it was known; None: it was not."""

    sigma: NDArray[np.float64] | None = None
    """``(4,)`` 1 σ of it then, grown since the last measurement, numeric units."""

    wavefront_m: float | None = None
    """Wavefront error with the reconstructor in use, by the linear model, metres RMS."""

    residual_m: float | None = None
    """What the reconstructor in use reads in the residual slopes, all its modes together, metres
    RMS: turbulence left over and noise, optical gain not undone."""

    margin: float | None = None
    """Largest closed-loop pole radius within α ± 3 σ over its bound: beyond 1 nothing is sent."""

    optical_gain: float | None = None
    """Mean over the modes of which it was measured."""

    n_controlled: int | None = None
    """Modes that the RTC controls."""

    magnitude: float | None = None
    """Of the guide star, as the RTC tells."""

    flux: float | None = None
    """Mean of the flux map, in the RTC's unit."""

    elevation_deg: float | None = None
    azimuth_deg: float | None = None


_FOURS = ("alpha", "sigma")
_PLAIN = tuple(field.name for field in fields(TrendSample) if field.name not in _FOURS)
_COLUMNS = (*_PLAIN, *(f"{four}_{name}" for four in _FOURS for name in PARAMETERS))
_INTEGERS = ("t_ns_utc", "telemetry_ns_utc", "n_controlled")
_NAMES = ", ".join(_COLUMNS)

SCHEMA = f"""
CREATE TABLE IF NOT EXISTS trend (
    {", ".join(f"{name} {'INTEGER' if name in _INTEGERS else 'REAL'}" for name in _COLUMNS)}
);
CREATE INDEX IF NOT EXISTS trend_by_time ON trend (t_ns_utc);
"""
"""Columns are the fields of a sample, in the units of their names."""

INSERT = f"INSERT INTO trend ({_NAMES}) VALUES ({', '.join('?' * len(_COLUMNS))})"


class Trends:
    """Reads the samples; never waits for a writer, nor has one wait.

    A question that the disk does not answer raises StorageError.

    Parameters
    ----------
    asked
        Returns the rows that a question to the index finds.
    """

    def __init__(self, asked: Callable[[str, Values], list[Any]]) -> None:
        self._asked = asked

    def between(self, first_ns: int, last_ns: int, n_most: int) -> tuple[TrendSample, ...]:
        """Return at most so many samples of a time, oldest first.

        Of more, the last one and the one of the largest residual in equal parts of the time.
        """
        within = "WHERE t_ns_utc BETWEEN :first AND :last"
        times = {"first": first_ns, "last": last_ns}
        ((begin_ns, end_ns, n_there),) = self._asked(
            f"SELECT min(t_ns_utc), max(t_ns_utc), count(*) FROM trend {within}", times
        )
        if n_there > n_most:
            part = f"FROM trend {within} GROUP BY (t_ns_utc - :begin) / :width"
            within = (
                f"WHERE rowid IN (SELECT id FROM (SELECT rowid AS id, max(t_ns_utc) {part})"
                f" UNION SELECT id FROM (SELECT rowid AS id, max(residual_m) {part}))"
            )
            width = (end_ns - begin_ns) // (n_most // 2) + 1
            times |= {"begin": begin_ns, "width": width}
        rows = self._asked(f"SELECT {_NAMES} FROM trend {within} ORDER BY t_ns_utc", times)
        return tuple(map(_sample, rows))


def rows_of(samples: Iterable[TrendSample]) -> list[tuple[object, ...]]:
    """Return the rows that :data:`INSERT` takes."""
    return [
        (
            *(getattr(sample, name) for name in _PLAIN),
            *_with_names(None if sample.alpha is None else sample.alpha.vector),
            *_with_names(sample.sigma),
        )
        for sample in samples
    ]


def _with_names(four: NDArray[np.float64] | None) -> list[float | None]:
    found: list[float | None] = [None] * len(PARAMETERS)
    return found if four is None else (four * BOUNDARY_SCALE).tolist()


def _sample(row: tuple[Any, ...]) -> TrendSample:
    plain = dict(zip(_PLAIN, row[: len(_PLAIN)], strict=True))
    if row[-1] is None:
        return TrendSample(**plain)
    alpha, sigma = np.array(row[len(_PLAIN) :], dtype=np.float64).reshape(2, 4) / BOUNDARY_SCALE
    return TrendSample(**plain, alpha=Misregistration.from_vector(alpha), sigma=sigma)
