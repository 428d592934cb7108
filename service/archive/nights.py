"""Estimates of α over the nights, events, samples and notes."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.archive.serialisation import from_json, to_json
from service.errors import TooLargeError
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration
from service.records.alarms import ALARMS
from service.records.registration import HistoryEntry, MeasuredGains, Source

Values = Sequence[object] | Mapping[str, object]
"""Values of a query's placeholders."""

_FOURS = ("measured", "measured_sigma", "filtered", "filtered_sigma")
_FILTERED = tuple(f"filtered_{parameter}" for parameter in PARAMETERS)
_NUMBERS = ("innovation", "misfit", *(f"{four}_{name}" for four in _FOURS for name in PARAMETERS))
_COLUMNS = ", ".join(("t_ns_utc", "source", "entered", "in_use", *_NUMBERS))

TREND_S = 15.0
"""From one sample to the next, seconds: 1 MB a day."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrendSample:
    """The service's state at one moment; without a sample no service ran."""

    t_ns_utc: int
    """Time by the service's clock."""

    telemetry_ns_utc: int | None = None
    """End of the telemetry that had come since the sample before, the RTC's clock; None: none."""

    alpha: Misregistration | None = None
    """The registration as it was known; None: it was not."""

    sigma: NDArray[np.float64] | None = None
    """``(4,)`` 1 σ of it then, grown since the last measurement, numeric units."""

    wavefront_m: float | None = None
    """Wavefront error with the reconstructor in use, by the linear model, metres RMS."""

    residual_m: float | None = None
    """Residual slopes as the reconstructor in use measures them, all its modes together, metres
    RMS: remaining turbulence and noise, not corrected for optical gain."""

    margin: float | None = None
    """Largest closed-loop pole radius within α ± 3 σ over its bound: beyond 1 nothing is sent."""

    optical_gain: float | None = None
    """Mean over the modes of which it was measured."""

    n_controlled: int | None = None
    """Modes that the RTC controls."""

    magnitude: float | None = None
    """Magnitude of the guide star, as the RTC reports it."""

    flux: float | None = None
    """Mean of the flux map, in the RTC's unit."""

    elevation_deg: float | None = None
    azimuth_deg: float | None = None
    gains: MeasuredGains | None = None
    """Optical gains by mode; None if none was measured since the sample before."""


CHARTED = tuple(field.name for field in fields(TrendSample) if field.name != "gains")
"""Fields of a sample that go into a chart of the trends."""

_PLAIN = tuple(name for name in CHARTED if name not in {"alpha", "sigma"})
_OF_SAMPLE = (*_PLAIN, *(f"{four}_{name}" for four in ("alpha", "sigma") for name in PARAMETERS))
_INTEGERS = ("t_ns_utc", "telemetry_ns_utc", "n_controlled")

SCHEMA = f"""
CREATE TABLE IF NOT EXISTS estimate (
    t_ns_utc INTEGER NOT NULL, source TEXT NOT NULL, entered INTEGER NOT NULL, in_use TEXT,
    {", ".join(f"{name} REAL" for name in _NUMBERS)}
);
CREATE INDEX IF NOT EXISTS estimate_by_time ON estimate (t_ns_utc);
CREATE INDEX IF NOT EXISTS audit_by_name ON audit (name, t_ns_utc);
CREATE TABLE IF NOT EXISTS trend (
    {", ".join(f"{name} {'INTEGER' if name in _INTEGERS else 'REAL'}" for name in _OF_SAMPLE)}
);
CREATE INDEX IF NOT EXISTS trend_by_time ON trend (t_ns_utc);
CREATE TABLE IF NOT EXISTS gains (t_ns_utc INTEGER NOT NULL, record TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS gains_by_time ON gains (t_ns_utc);
CREATE TABLE IF NOT EXISTS annotation (
    t_ns_utc INTEGER NOT NULL, written_ns_utc INTEGER NOT NULL,
    who TEXT NOT NULL, note TEXT NOT NULL
);
CREATE INDEX IF NOT EXISTS annotation_by_time ON annotation (t_ns_utc);
"""
"""Columns are the fields of a line of history, a sample, a note, in the units of their names."""

INSERT_ESTIMATE = (
    f"INSERT INTO estimate ({_COLUMNS}) VALUES ({', '.join('?' * (4 + len(_NUMBERS)))})"
)
INSERT_SAMPLE = (
    f"INSERT INTO trend ({', '.join(_OF_SAMPLE)}) VALUES ({', '.join('?' * len(_OF_SAMPLE))})"
)
INSERT_GAINS = "INSERT INTO gains VALUES (?, ?)"

HOUR_NS = 3_600_000_000_000
DAY_NS = 24 * HOUR_NS

FOREVER_NS = (1 << 63) - 1
"""Time after everything that can be recorded: SQLite's largest integer."""

MAX_DOWNSAMPLED = 300_000
"""Estimates that are looked through at once: a week of telemetry."""


class MarkKind(StrEnum):
    """Kinds of marks in a chart of α."""

    SWAP = "swap"
    """The RTC uses another reconstructor."""

    JUMP = "jump"
    """The mirror has jumped."""

    ALARM = "alarm"
    """An alarm was raised."""

    OVER = "over"
    """An alarm was over."""

    NOTE = "note"
    """An operator has noted something."""

    START = "start"
    """The service started: alarms of the run before ended with it, without a report."""


_KINDS = {
    "reconstructor.applied": MarkKind.SWAP,
    "reconstructor.adopted": MarkKind.SWAP,
    "registration.jump": MarkKind.JUMP,
    "registration.passive-jump": MarkKind.JUMP,
    "service.ready": MarkKind.START,
    **dict.fromkeys(ALARMS, MarkKind.ALARM),
}
_NOTE = "note by "
_OF_NOTE = "t_ns_utc, written_ns_utc, who, note"
_OF_KINDS = f"who = 'service' AND name IN ({', '.join(map(repr, _KINDS))})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """Something that belongs into a chart of α."""

    t_ns_utc: int
    kind: MarkKind
    name: str
    """Name as in the audit trail; for an alarm its name."""

    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Night:
    """Summary of one night."""

    date: str
    """Date of the noon at which it begins, UTC, such as 2026-03-01."""

    since_ns_utc: int
    """Noon at which the night begins."""

    until_ns_utc: int
    """Last nanosecond before the next noon."""

    duration_s: float = 0.0
    """Time from the first estimate to the last, seconds."""

    n_estimates: int = 0
    n_swaps: int = 0
    n_jumps: int = 0
    n_alarms: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Annotation:
    """An operator's note."""

    t_ns_utc: int
    """Of what time it is."""

    written_ns_utc: int
    """Time of writing."""

    who: str
    note: str
    id: int = 0
    """From 1 on, growing; 0: not kept yet."""


class Nights:
    """Reads what the nights have left, and takes notes; a reader never waits for a writer.

    A question that the disk does not answer raises StorageError.

    Parameters
    ----------
    asked
        Returns the rows that a question to the index finds.
    add
        Carries out an insertion; returns the id of the row.
    noon_utc_h
        UTC hour of local noon, where one night ends and the next begins.
    """

    def __init__(
        self,
        asked: Callable[[str, Values], list[Any]],
        add: Callable[[str, tuple[str | int, ...]], int],
        noon_utc_h: int = 12,
    ) -> None:
        self._asked = asked
        self._add = add
        self._noon_ns = noon_utc_h * HOUR_NS

    def estimates(
        self, first_ns: int, last_ns: int, n_most: int, *, newest: bool = True
    ) -> tuple[HistoryEntry, ...]:
        """Return the newest or the oldest estimates, both ends of the time included; in order."""
        rows = self._asked(
            f"SELECT {_COLUMNS} FROM estimate WHERE t_ns_utc BETWEEN ? AND ?"
            f" ORDER BY t_ns_utc {'DESC' if newest else 'ASC'} LIMIT ?",
            (first_ns, last_ns, n_most),
        )
        return tuple(map(_entry, reversed(rows) if newest else rows))

    def n_estimates(self, first_ns: int, last_ns: int) -> int:
        """Return how many estimates there are of a time, both ends included."""
        ((n_there,),) = self._asked(
            "SELECT count(*) FROM estimate WHERE t_ns_utc BETWEEN ? AND ?", (first_ns, last_ns)
        )
        return int(n_there)

    def downsampled(self, first_ns: int, last_ns: int, n_points: int) -> tuple[HistoryEntry, ...]:
        """Return at most so many estimates of a time, oldest first.

        They are the lowest and the highest of each parameter in equal parts of the time.

        Raises
        ------
        TooLargeError
            If there are more than ``MAX_DOWNSAMPLED``.
        """
        within = "WHERE t_ns_utc BETWEEN :first AND :last"
        times = {"first": first_ns, "last": last_ns}
        ((begin_ns, end_ns, n_there),) = self._asked(
            f"SELECT min(t_ns_utc), max(t_ns_utc), count(*) FROM estimate {within}", times
        )
        if n_there > MAX_DOWNSAMPLED:
            raise TooLargeError(
                f"found {n_there} estimates in this time, expected at most {MAX_DOWNSAMPLED}: "
                "ask for less of it"
            )
        if n_there <= n_points:
            return self.estimates(first_ns, last_ns, n_points)
        # Each part gives a lowest and a highest entry of every parameter.
        n_parts = n_points // (2 * len(PARAMETERS))
        # of the row that has it, where there is one min or max: https://sqlite.org/lang_select.html
        extremes = " UNION ".join(
            f"SELECT id FROM (SELECT rowid AS id, {end}({name}) FROM estimate {within}"
            " GROUP BY (t_ns_utc - :begin) / :width)"
            for name in _FILTERED
            for end in ("min", "max")
        )
        rows = self._asked(
            f"SELECT {_COLUMNS} FROM estimate WHERE rowid IN ({extremes}) ORDER BY t_ns_utc",
            # Plus 1: the last entry would otherwise begin a part of its own.
            times | {"begin": begin_ns, "width": (end_ns - begin_ns) // n_parts + 1},
        )
        return tuple(map(_entry, rows))

    def marks(self, first_ns: int, last_ns: int, n_most: int) -> tuple[Mark, ...]:
        """Return the newest marks of a time, which has both ends; oldest first.

        A note's name is who has written it.
        """
        rows = self._asked(
            f"SELECT t_ns_utc, name, text FROM audit WHERE {_OF_KINDS}"
            f" AND t_ns_utc BETWEEN :first AND :last UNION ALL SELECT t_ns_utc, '{_NOTE}' || who,"
            " note FROM annotation WHERE t_ns_utc BETWEEN :first AND :last"
            " ORDER BY t_ns_utc DESC LIMIT :most",
            {"first": first_ns, "last": last_ns, "most": n_most},
        )
        return tuple(
            Mark(t_ns_utc=t_ns, kind=_kind(name, text), name=name.removeprefix(_NOTE), text=text)
            for t_ns, name, text in reversed(rows)
        )

    def between(self, first_ns: int, last_ns: int) -> tuple[Night, ...]:
        """Return the nights with any content that overlap an interval."""
        night = f"(t_ns_utc - {self._noon_ns}) / {DAY_NS}"
        time = (first_ns, last_ns)
        measured = self._asked(
            f"SELECT {night}, count(*), max(t_ns_utc) - min(t_ns_utc) FROM estimate"
            " WHERE t_ns_utc BETWEEN ? AND ? GROUP BY 1",
            time,
        )
        marks = self._asked(
            f"SELECT {night}, name, text LIKE '%: over', count(*) FROM audit"
            f" WHERE {_OF_KINDS} AND t_ns_utc BETWEEN ? AND ? GROUP BY 1, 2, 3",
            time,
        )
        counts: Counter[tuple[int, MarkKind]] = Counter()
        for day, name, over, n_times in marks:
            counts[day, MarkKind.OVER if over else _KINDS[name]] += n_times
        spans = {day: (n_there, span_ns / 1e9) for day, n_there, span_ns in measured}
        return tuple(
            self._night(day, *spans.get(day, (0, 0.0)), counts)
            for day in sorted({*spans, *(day for day, _ in counts)})
        )

    def samples(self, first_ns: int, last_ns: int, n_most: int) -> tuple[TrendSample, ...]:
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
        rows = self._asked(
            f"SELECT {', '.join(_OF_SAMPLE)} FROM trend {within} ORDER BY t_ns_utc", times
        )
        return tuple(map(_sample, rows))

    def gains(
        self, first_ns: int, last_ns: int, n_most: int, *, newest: bool = True
    ) -> tuple[MeasuredGains, ...]:
        """Return the newest or the oldest measured gains of a time, both ends included."""
        rows = self._asked(
            "SELECT record FROM gains WHERE t_ns_utc BETWEEN ? AND ?"
            f" ORDER BY t_ns_utc {'DESC' if newest else 'ASC'} LIMIT ?",
            (first_ns, last_ns, n_most),
        )
        found = tuple(from_json(text, MeasuredGains) for (text,) in rows)
        return found[::-1] if newest else found

    def add_note(self, made: Annotation) -> int:
        """Keep a note, on the disk when it returns; return its id.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        question = f"INSERT INTO annotation ({_OF_NOTE}) VALUES (?, ?, ?, ?)"
        return self._add(question, (made.t_ns_utc, made.written_ns_utc, made.who, made.note))

    def notes(self, first_ns: int, last_ns: int, n_most: int) -> tuple[Annotation, ...]:
        """Return the newest notes about a time, which has both ends; oldest first."""
        rows = self._asked(
            f"SELECT {_OF_NOTE}, rowid FROM annotation WHERE t_ns_utc BETWEEN ? AND ?"
            " ORDER BY t_ns_utc DESC, rowid DESC LIMIT ?",
            (first_ns, last_ns, n_most),
        )
        return tuple(
            Annotation(t_ns_utc=t_ns, written_ns_utc=written_ns, who=who, note=note, id=number)
            for t_ns, written_ns, who, note, number in reversed(rows)
        )

    def _night(
        self, day: int, n_estimates: int, duration_s: float, counts: Counter[tuple[int, MarkKind]]
    ) -> Night:
        since_ns = day * DAY_NS + self._noon_ns
        return Night(
            date=f"{datetime.fromtimestamp(since_ns // 1_000_000_000, UTC):%Y-%m-%d}",
            since_ns_utc=since_ns,
            until_ns_utc=since_ns + DAY_NS - 1,
            duration_s=duration_s,
            n_estimates=n_estimates,
            n_swaps=counts[day, MarkKind.SWAP],
            n_jumps=counts[day, MarkKind.JUMP],
            n_alarms=counts[day, MarkKind.ALARM],
        )


def rows_of_estimates(entries: Iterable[HistoryEntry]) -> list[tuple[object, ...]]:
    """Return the rows that :data:`INSERT_ESTIMATE` takes."""
    return [
        (
            entry.t_ns_utc,
            str(entry.source),
            entry.entered,
            entry.in_use,
            entry.innovation,
            entry.misfit,
            *_with_names(entry.measured.vector),
            *_with_names(entry.measured_sigma),
            *_with_names(entry.filtered.vector),
            *_with_names(entry.filtered_sigma),
        )
        for entry in entries
    ]


def rows_of_samples(samples: Iterable[TrendSample]) -> list[tuple[object, ...]]:
    """Return the rows that :data:`INSERT_SAMPLE` takes."""
    return [
        (
            *(getattr(sample, name) for name in _PLAIN),
            *_with_names(None if sample.alpha is None else sample.alpha.vector),
            *_with_names(sample.sigma),
        )
        for sample in samples
    ]


def rows_of_gains(samples: Iterable[TrendSample]) -> list[tuple[object, ...]]:
    """Return the rows that :data:`INSERT_GAINS` takes."""
    found = (one.gains for one in samples if one.gains is not None)
    return [(gains.t_ns_utc, to_json(gains)) for gains in found if gains.measured]


def _with_names(four: NDArray[np.float64] | None) -> list[float | None]:
    found: list[float | None] = [None] * len(PARAMETERS)
    return found if four is None else (four * BOUNDARY_SCALE).tolist()


def _entry(row: tuple[Any, ...]) -> HistoryEntry:
    t_ns, source, entered, in_use, innovation, misfit, *numbers = row
    # SQLite has no NaN, it keeps NULL instead
    fours = np.array(numbers, dtype=np.float64).reshape(4, 4) / BOUNDARY_SCALE
    return HistoryEntry(
        t_ns_utc=t_ns,
        source=Source(source),
        entered=bool(entered),
        in_use=in_use,
        innovation=math.nan if innovation is None else innovation,
        misfit=math.nan if misfit is None else misfit,
        measured=Misregistration.from_vector(fours[0]),
        measured_sigma=fours[1],
        filtered=Misregistration.from_vector(fours[2]),
        filtered_sigma=fours[3],
    )


def _kind(name: str, text: str) -> MarkKind:
    if name.startswith(_NOTE):
        return MarkKind.NOTE
    return MarkKind.OVER if text == f"{name}: over" else _KINDS[name]


def _sample(row: tuple[Any, ...]) -> TrendSample:
    plain = dict(zip(_PLAIN, row[: len(_PLAIN)], strict=True))
    if row[-1] is None:
        return TrendSample(**plain)
    alpha, sigma = np.array(row[len(_PLAIN) :], dtype=np.float64).reshape(2, 4) / BOUNDARY_SCALE
    return TrendSample(**plain, alpha=Misregistration.from_vector(alpha), sigma=sigma)
