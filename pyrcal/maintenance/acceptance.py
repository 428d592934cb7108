"""Acceptance of a commissioning: what was measured, the criteria, and their limits.

Every criterion compares one number with a limit. ``pyrcal commission`` reads the numbers;
docs/operate/commissioning.md explains the limits.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.archive.nights import Mark, MarkKind, TrendSample
from service.config import Settings
from service.model.instrument import Instrument
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.records.alarms import ALARMS, Severity
from service.records.products import MatrixState, ReconstructorRecord
from service.records.registration import HistoryEntry, Source
from service.runtime.policy import policy_of
from service.tracking.policy import Policy

REQUIRED_CHECKS: Final = (
    *("connection", "messages", "frames", "sizes", "numbers", "sequence", "clock", "delivery"),
    *("session", "status", "ids", "matrix", "law", "obedience", "orientation", "replies"),
    *("dither", "columns", "commit", "chunks", "rejection", "finite", "reconnect", "loop"),
)
"""Checks of ``pyrcal check-rtc`` that every RTC must pass; the others belong to optional parts."""

MIN_WINDOWS: Final = 10
"""Smallest number of dithered windows in α for a judgement on precision and consistency."""

ELLIPSE_95: Final = 9.488
"""95th percentile of chi-squared with 4 degrees of freedom: innovation of a consistent window."""

MIN_COVERAGE: Final = 0.85
"""Smallest share of windows inside their 95 % ellipse; docs/results/tracking.md has 96 to 100 %."""

MIN_FRESH_SHARE: Final = 0.9
"""Smallest share of the time, after α was first known, during which α was not stale."""

MAX_RESIDUAL_RATIO: Final = 1.1
"""Largest residual per mode after the swaps over that before; the limit of the probation."""

MAX_SERIOUS_SHARE: Final = 0.05
"""Largest share of the time with a serious alarm."""

COMPARED_S: Final = 300.0
"""Longest time before the first and after the last swap whose residuals are compared, seconds."""

MIN_SAMPLES: Final = 2
"""Smallest number of trend samples (one in 15 s) on either side of the swaps."""


class Judgement(StrEnum):
    """Outcome of one criterion."""

    PASS = "pass"
    """The number is within its limit."""

    FAIL = "fail"
    """The number is beyond its limit."""

    MISSING = "missing"
    """There is nothing to judge; it counts as not passed."""


@dataclass(frozen=True, slots=True)
class Criterion:
    """One line of the acceptance: a number and its limit."""

    group: str
    """Part of the commissioning: RTC, Fit, Tracking, Matrices, Alarms or Wavefront."""

    name: str
    outcome: Judgement
    found: str
    """Measured number with its unit, or why there is none."""

    limit: str
    """Limit with its unit."""

    remedy: str
    """Advice if the criterion is not passed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Commissioning:
    """All that the report is made of."""

    settings: Settings
    instrument: Instrument
    first_ns: int
    """Begin of the judged time, nanoseconds since the Unix epoch, UTC."""

    last_ns: int
    estimates: tuple[HistoryEntry, ...]
    samples: tuple[TrendSample, ...]
    marks: tuple[Mark, ...]
    matrices: tuple[ReconstructorRecord, ...]
    """Reconstructors that were made or in use during that time."""

    probations: tuple[tuple[int, str, str], ...]
    """Time, state and text of each verdict of a probation."""

    checks: tuple[dict[str, Any], ...] | None = None
    """Result of ``pyrcal check-rtc --json``; None if it was not given."""

    fit: dict[str, Any] | None = None
    """Result of ``pyrcal fit --json``; None if it was not given."""

    origins: dict[str, str] = field(default_factory=dict)
    """Files and folders that were read, by what they are."""

    @property
    def policy(self) -> Policy:
        """Limits of the tracker with these settings and this instrument."""
        return policy_of(self.settings, self.instrument)

    @property
    def alarms(self) -> tuple[tuple[str, int, int], ...]:
        """Name, begin and end of each alarm, nanoseconds; one that lasts ends with the time."""
        return tuple(_alarm_intervals(self.marks, self.last_ns))

    @property
    def swaps_ns(self) -> tuple[int, ...]:
        """Times at which a matrix of the service came into use."""
        return tuple(one.t_ns_utc for one in self.marks if one.name == "reconstructor.applied")


def judge(data: Commissioning) -> tuple[Criterion, ...]:
    """Return all criteria in the order of the report."""
    parts = {
        "RTC": _judge_rtc,
        "Fit": _judge_fit,
        "Tracking": _judge_tracking,
        "Matrices": _judge_matrices,
        "Alarms": _judge_alarms,
        "Wavefront": _judge_wavefront,
    }
    outcomes = {True: Judgement.PASS, False: Judgement.FAIL, None: Judgement.MISSING}
    return tuple(
        Criterion(group, name, outcomes[passed], *texts)
        for group, part in parts.items()
        for name, passed, *texts in part(data)
    )


_Lines = Iterator[tuple[str, bool | None, str, str, str]]
"""Name of each criterion, whether it is passed (None if there is nothing to judge), what was found,
limit, and advice."""


def _count(names: Collection[str]) -> str:
    """Return how many there are, and which."""
    # Each name once: an alarm may have begun and ended many times.
    return f"{len(names)}: {', '.join(dict.fromkeys(names))}" if names else "0"


def _judge_rtc(data: Commissioning) -> _Lines:
    wrong_name, passed_name = "checks that found a violation", "required checks passed"
    n_required = f"{len(REQUIRED_CHECKS)}"
    remedy = "correct the RTC: pyrcal check-rtc names the requirements of each check"
    if data.checks is None:
        yield wrong_name, None, "no result was given", "0", remedy
        yield passed_name, None, "no result was given", n_required, remedy
        return
    outcomes = {one["check"]: one["outcome"] for one in data.checks}
    wrong = [name for name, outcome in outcomes.items() if outcome == "wrong"]
    yield wrong_name, not wrong, _count(wrong), "0", remedy
    # "seen" is unusual, but the contract allows it.
    open_ones = [name for name in REQUIRED_CHECKS if outcomes.get(name) not in {"ok", "seen"}]
    n_passed = f"{len(REQUIRED_CHECKS) - len(open_ones)} of {n_required}"
    yield (
        passed_name,
        not open_ones,
        f"{n_passed}; not: {', '.join(open_ones)}" if open_ones else n_passed,
        n_required,
        "run pyrcal check-rtc --yes --open-loop --json in closed loop",
    )


def _judge_fit(data: Commissioning) -> _Lines:
    names = ("registration determined", "σ of the registration", "stable modes")
    limits = ("yes", _sigma_text(_largest_fit_sigma(data)), f"{_n_wanted(data)} modes")
    if data.fit is None or data.fit["registration"] is None:
        reason = "no fit was given" if data.fit is None else "the fit has no registration"
        for name, limit in zip(names, limits, strict=True):
            yield name, None, reason, limit, "measure and fit a matrix"
        return
    registration, control = data.fit["registration"], data.fit["reconstructor"]
    yield (
        names[0],
        bool(registration["determined"]),
        str(data.fit["verdict"]),
        limits[0],
        "follow the fit's recommendation: instrument file, order of slopes, more averages",
    )
    sigma = np.array([data.fit["sigma"][name] for name in PARAMETERS]) / BOUNDARY_SCALE
    yield (
        names[1],
        bool((sigma <= _largest_fit_sigma(data)).all()),
        _sigma_text(sigma),
        limits[1],
        "more averages or more modes",
    )
    if control is None:
        yield names[2], None, "the fit has no closed loop", limits[2], "give --gain"
        return
    # A matrix may have been measured for fewer modes than the service is to control.
    wanted = min(_n_wanted(data), int(control["n_modes"]))
    yield (
        names[2],
        int(control["stable_modes"]) >= wanted,
        f"{control['stable_modes']} of {control['n_modes']} at gain {control['gain']:g}",
        f"{wanted} modes",
        "a lower gain, fewer modes, or a better instrument file",
    )


def _largest_fit_sigma(data: Commissioning) -> NDArray[np.float64]:
    """Return 1 σ ``(4,)`` from which on α is stale, with the model error that a fit includes."""
    return np.hypot(data.policy.stale_sigma, data.policy.floor)


def _n_wanted(data: Commissioning) -> int:
    """Return the number of modes that the settings require, at most those of the mirror."""
    return min(data.settings.control.n_modes_target, data.instrument.modes.n_modes)


def _sigma_text(sigma: NDArray[np.float64]) -> str:
    x, y, rotation, magnification = sigma * BOUNDARY_SCALE
    shifts = f"{x:.3g}" if f"{x:.3g}" == f"{y:.3g}" else f"{x:.3g}, {y:.3g}"
    return f"{shifts} subap, {rotation:.3g} deg, {100 * magnification:.2g} %"


def _judge_tracking(data: Commissioning) -> _Lines:
    # Estimates from ordinary telemetry have a bias that a dither does not have: not judged here.
    windows = [one for one in data.estimates if one.entered and one.source is not Source.PASSIVE]
    yield (
        "dithered windows in α",
        len(windows) >= MIN_WINDOWS,
        f"{len(windows)}",
        f"at least {MIN_WINDOWS}",
        "let it dither longer; the log says why windows are rejected (window.refused)",
    )
    # The precision that the service itself requires of α; its σ includes the model error.
    policy = data.policy
    floor = np.hypot(policy.floor, policy.image_floor)  # both are in every σ of the service
    target = np.hypot(policy.tolerance * policy.dither_sigma, floor)
    enough = len(windows) >= MIN_WINDOWS
    median = np.median([one.filtered_sigma for one in windows], axis=0) if windows else target
    yield (
        "median σ of α after a window",
        bool((median <= target).all()) if enough else None,
        _sigma_text(median) if enough else "too few windows",
        _sigma_text(target),
        "a brighter star, or a larger [dither] budget_m",
    )
    inside = float(np.mean([one.innovation <= ELLIPSE_95 for one in windows])) if windows else 0.0
    yield (
        "windows inside their 95 % ellipse",
        inside >= MIN_COVERAGE if enough else None,
        f"{100 * inside:.0f} % of {len(windows)}" if enough else "too few windows",
        f"at least {100 * MIN_COVERAGE:.0f} %",
        "σ is too small, or the mirror moves: set [tracking] drift_*, look for vibrations",
    )
    # Samples before α was first known say nothing on whether the dither keeps it fresh.
    known = [one.sigma for one in data.samples if one.sigma is not None]
    stale = np.hypot(policy.stale_sigma, floor)
    fresh = [bool((sigma <= stale).all()) for sigma in known]
    share = float(np.mean(fresh)) if fresh else 0.0
    yield (
        "time with a usable α, since it was known",
        share >= MIN_FRESH_SHARE if fresh else None,
        f"{100 * share:.0f} % of {len(fresh)} samples" if fresh else "no sample has α",
        f"at least {100 * MIN_FRESH_SHARE:.0f} %",
        "let it dither; see the alarms estimate-stale and windows-refused",
    )


def _judge_matrices(data: Commissioning) -> _Lines:
    n_applied = len(data.swaps_ns)
    yield (
        "applied by the RTC",
        n_applied >= 1,
        f"{n_applied}",
        "at least 1",
        "approve a proposal (pyrcal reconstructors approve), or set the mode to auto",
    )
    bad = [
        one.id for one in data.matrices if one.state in {MatrixState.REJECTED, MatrixState.FAILED}
    ]
    yield (
        "rejected or failed",
        not bad,
        _count(bad),
        "0",
        "see the reason of each (pyrcal archive show ID) and the RTC's log",
    )
    verdicts = [state for _, state, _ in data.probations]
    n_passed = verdicts.count("passed")
    n_back = sum(state in _WORSE for state in verdicts)
    yield (
        "probations passed; taken back or worse",
        n_passed >= 1 and not n_back if verdicts else None,
        f"{n_passed} passed, {n_back} worse" if verdicts else "no probation ended",
        "at least 1 passed, 0 worse",
        "find out why: α, the gains, the RTC's own matrix (alarm probation)",
    )
    # The last one: margins of matrices that were replaced do not matter any more.
    margins = [one.margin for one in data.samples if one.margin is not None]
    worst = margins[-1] if margins else None
    yield (
        "largest pole radius over its bound, at the end",
        None if worst is None else worst <= 1.0,
        "not judged" if worst is None else f"{worst:.3f}",
        "at most 1",
        "a lower gain or fewer modes (alarm margin)",
    )


_WORSE: Final = frozenset({"rolling-back", "watched", "rolled-back", "kept", "opening", "opened"})
"""States of a probation whose matrix made the loop worse."""


def _judge_alarms(data: Commissioning) -> _Lines:
    # At least a second, so that an archive of a moment is judged and not divided by zero.
    span_s = max((data.last_ns - data.first_ns) * 1e-9, 1.0)
    critical = [name for name, *_ in data.alarms if _severity(name) is Severity.CRITICAL]
    yield (
        "critical",
        not critical,
        _count(critical),
        "0",
        "the runbook; cut a deliberate test off with --since and --until",
    )
    serious = [
        (begin_ns, end_ns)
        for name, begin_ns, end_ns in data.alarms
        if _severity(name) is Severity.SERIOUS
    ]
    share = min(1.0, _union_ns(serious) * 1e-9 / span_s)
    yield (
        "time with a serious alarm",
        share <= MAX_SERIOUS_SHARE,
        f"{100 * share:.1f} %, {len(serious)} alarms",
        f"at most {100 * MAX_SERIOUS_SHARE:.0f} %",
        "the runbook",
    )


def _severity(name: str) -> Severity | None:
    """Return the severity of an alarm; None for a rule of the observatory's own."""
    return ALARMS[name].severity if name in ALARMS else None


def _alarm_intervals(marks: Iterable[Mark], last_ns: int) -> Iterator[tuple[str, int, int]]:
    begun: dict[str, int] = {}
    for mark in marks:
        if mark.kind is MarkKind.ALARM:
            # The first line counts: an alarm that lasts may be reported again.
            begun.setdefault(mark.name, mark.t_ns_utc)
        elif mark.kind is MarkKind.OVER and mark.name in begun:
            yield mark.name, begun.pop(mark.name), mark.t_ns_utc
        elif mark.kind is MarkKind.START:
            # Alarms of the run before ended with it, without a line of their own.
            yield from ((name, begin_ns, mark.t_ns_utc) for name, begin_ns in begun.items())
            begun.clear()
    yield from ((name, begin_ns, last_ns) for name, begin_ns in begun.items())


def _union_ns(intervals: Sequence[tuple[int, int]]) -> int:
    """Return the time that is covered by at least one of the intervals."""
    # Alarms overlap: two at the same time are not twice the time.
    total, until = 0, 0
    for begin_ns, end_ns in sorted(intervals):
        total += max(0, end_ns - max(begin_ns, until))
        until = max(until, end_ns)
    return total


def _judge_wavefront(data: Commissioning) -> _Lines:
    before, after = compare_residuals(data)
    enough = min(len(before), len(after)) >= MIN_SAMPLES
    # Medians, because a few bad seconds of seeing must not decide.
    ratio = float(np.median(after) / np.median(before)) if enough else 0.0
    yield (
        "residual per controlled mode, after the swaps over before",
        ratio <= MAX_RESIDUAL_RATIO if enough else None,
        f"{ratio:.2f} ({1e9 * np.median(before):.2f} to {1e9 * np.median(after):.2f} nm RMS)"
        if enough
        else f"{len(before)} samples before, {len(after)} after",
        f"at most {MAX_RESIDUAL_RATIO:g}",
        "roll back and compare; the seeing may have changed meanwhile",
    )


def compare_residuals(data: Commissioning) -> tuple[list[float], list[float]]:
    """Return residuals per mode before the first and after the last swap, metres RMS."""
    if not data.swaps_ns:
        return [], []
    # Close to the swaps only, because seeing and star change during a night.
    reach_ns = round(COMPARED_S * 1e9)
    first_ns, last_ns = data.swaps_ns[0], data.swaps_ns[-1]
    per_mode = residuals_per_mode(data)
    return (
        [value for t_ns, value in per_mode if first_ns - reach_ns <= t_ns < first_ns],
        [value for t_ns, value in per_mode if last_ns < t_ns <= last_ns + reach_ns],
    )


def residuals_per_mode(data: Commissioning) -> list[tuple[int, float]]:
    """Return time and residual of each sample, metres RMS per controlled mode.

    Matrices differ in their number of modes, so the residual is divided by its square root.
    """
    return [
        (one.t_ns_utc, float(one.residual_m / np.sqrt(one.n_controlled)))
        for one in data.samples
        if one.residual_m is not None and one.n_controlled
    ]
