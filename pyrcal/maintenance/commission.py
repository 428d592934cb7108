"""``pyrcal commission``: judge a commissioning and write its report.

The inputs are the archive of a night, the checker's result and a fit of a measured matrix;
docs/operate/commissioning.md says how to obtain them.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from pyrcal.maintenance.acceptance import Commissioning, Judgement, judge
from pyrcal.maintenance.archive import open_archive, read_settings
from pyrcal.maintenance.commission_page import write_page
from service.archive import Archive
from service.archive.index import Range
from service.archive.nights import FOREVER_NS, MAX_DOWNSAMPLED
from service.errors import ConfigurationError, UnknownIdError, say
from service.files.documents import json_text
from service.files.whole import open_hdf5
from service.instrument import load_instrument
from service.model.misregistration import PARAMETERS
from service.records.products import MatrixState

ACCEPTED, NOT_ACCEPTED = 0, 1
"""Exit status."""

MAX_SAMPLES: Final = 2000
"""Largest number of trend samples in the report."""


def main(options: argparse.Namespace) -> int:
    """Write the report; return 0 if every criterion is passed, else 1.

    Raises
    ------
    ArchiveError, ConfigurationError, UnknownIdError
        If it cannot be made.
    """
    commissioning = read_commissioning(options)
    criteria = judge(commissioning)
    write_page(commissioning, criteria, options.output)
    if options.json:
        print(json_text([asdict(one) for one in criteria], indent=2))
    else:
        for one in criteria:
            print(f"{one.outcome:8}{one.group:10} {one.name}: {one.found} (limit: {one.limit})")
    open_ones = [one for one in criteria if one.outcome is not Judgement.PASS]
    verdict = f"not accepted: {len(open_ones)} not passed" if open_ones else "accepted"
    say(f"{options.output}: {len(criteria)} criteria, {verdict}")
    return NOT_ACCEPTED if open_ones else ACCEPTED


def read_commissioning(options: argparse.Namespace) -> Commissioning:
    """Read the archive and the results that the options name."""
    settings = read_settings(options)
    instrument = load_instrument(options.instrument or settings.service.instrument)
    with open_archive(settings) as archive:
        _check_instrument(archive, instrument.name)
        first_ns, last_ns = _choose_time(archive, options)
        estimates = archive.nights.estimates(first_ns, last_ns, MAX_DOWNSAMPLED)
        samples = archive.nights.samples(first_ns, last_ns, MAX_SAMPLES)
        marks = archive.nights.marks(first_ns, last_ns, MAX_DOWNSAMPLED)
        # What was recorded, and not the night, is the judged time: a share of it must not count
        # hours in which no service ran.
        times_ns = [one.t_ns_utc for each in (estimates, samples, marks) for one in each]
        if not estimates:
            raise UnknownIdError("nothing was measured between --since and --until")
        trail = archive.audit_trail(
            Range(since_ns=first_ns, until_ns=last_ns, limit=MAX_DOWNSAMPLED)
        )
        return Commissioning(
            settings=settings,
            instrument=instrument,
            first_ns=min(times_ns),
            last_ns=max(times_ns),
            estimates=estimates,
            samples=samples,
            marks=marks,
            matrices=tuple(
                one
                for one in archive.reconstructors.records()
                # The matrix in use may be of an earlier night.
                if first_ns <= one.created_ns_utc <= last_ns or one.state is MatrixState.APPLIED
            ),
            probations=tuple(
                (one.t_ns_utc, one.name.removeprefix("probation."), one.text)
                for one in trail
                if one.name.startswith("probation.")
            ),
            checks=None if options.check_rtc is None else _read_checks(options.check_rtc),
            fit=None if options.fit is None else _read_fit(options.fit),
            origins={
                "archive": str(archive.directory),
                "check-rtc": str(options.check_rtc or "not given"),
                "fit": str(options.fit or "not given"),
            },
        )


def _check_instrument(archive: Archive, name: str) -> None:
    """Raise if the matrices of the archive were made for another instrument.

    The limits follow from the instrument, so a report with another one would mislead.
    """
    for product_id in archive.reconstructors.stored():
        with open_hdf5(archive.reconstructors.path_of(product_id)) as file:
            made_for = str(file["provenance"].attrs.get("instrument", name))
        if made_for != name:
            raise ConfigurationError(
                f"--instrument: found {name}, but {product_id} in {archive.directory} is for "
                f"{made_for}; expected the instrument of the archive"
            )


def _choose_time(archive: Archive, options: argparse.Namespace) -> tuple[int, int]:
    """Return the judged time: the newest night, or the one given, cut by the other options."""
    nights = archive.nights.between(0, FOREVER_NS)
    if options.night is not None:
        nights = tuple(night for night in nights if night.date == options.night)
    # A night with events alone, as of a service that only waited, cannot be judged.
    nights = tuple(night for night in nights if night.n_estimates)
    if not nights:
        which = options.night or "no night"
        raise UnknownIdError(f"{which}: nothing was measured then, by {archive.directory}")
    first_ns, last_ns = nights[-1].since_ns_utc, nights[-1].until_ns_utc
    if options.since is not None:
        first_ns = _parse_time(options.since, "--since")
    if options.until is not None:
        last_ns = _parse_time(options.until, "--until")
    return first_ns, last_ns


def _parse_time(text: str, option: str) -> int:
    try:
        time = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigurationError(
            f"{option}: found {text}, expected RFC 3339 like 2026-03-01T20:00:00Z"
        ) from error
    if time.tzinfo is None:
        raise ConfigurationError(f"{option}: found {text} without a time zone, expected a final Z")
    return round(time.timestamp() * 1e9)


def _read_checks(path: Path) -> tuple[dict[str, Any], ...]:
    """Return the lines of ``pyrcal check-rtc --json``."""
    document = _read_json(path, "pyrcal check-rtc --json")
    checks = document.get("checks")
    if not isinstance(checks, list) or not all(
        isinstance(one, dict) and {"check", "outcome", "found"} <= set(one) for one in checks
    ):
        raise ConfigurationError(
            f"{path}: found no list of checks, expected the output of pyrcal check-rtc --json"
        )
    return tuple(checks)


def _read_fit(path: Path) -> dict[str, Any]:
    """Return the document of ``pyrcal fit --json``."""
    document = _read_json(path, "pyrcal fit --json")
    if not {*PARAMETERS, "sigma", "verdict", "registration", "reconstructor"} <= set(document):
        raise ConfigurationError(f"{path}: found no fit, expected the output of pyrcal fit --json")
    return document


def _read_json(path: Path, origin: str) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{path}: {error}; expected the output of {origin}") from error
    if not isinstance(document, dict):
        raise ConfigurationError(f"{path}: expected one JSON object, the output of {origin}")
    return document
