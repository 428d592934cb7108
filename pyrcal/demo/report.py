"""Result of the demo: the estimate against the truth, the loop before and after, as a table."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

from pyrcal.demo.truth import TruthFile
from service.model.misregistration import PARAMETERS
from service.records.alarms import WORKER_BEHIND

TOLERANCE = {
    "shift_x_subap": 0.02,
    "shift_y_subap": 0.02,
    "rotation_deg": 0.05,
    "magnification": 0.002,
}
"""Largest error of a good estimate, with 30 subapertures across the pupil or more."""

TOLERANCE_ACROSS_SUBAP = 30.0
"""Number of subapertures below which larger angles are allowed: the edge moves by as much."""

MAX_ERROR_IN_SIGMA = 4.0

MAX_SILENCE_S = 5.0
"""Time without data after which its source counts as stopped, seconds."""

MODEL = "model"
"""Name of the wait for the model's preparation."""

REAL_TIME = 0.9
"""Share of real time below which a simulator is called slow."""

View = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Circumstances:
    """Observations of the demo that explain a failed result."""

    seconds_to_ready: float | None = None
    """Time from the start until model and simulator were prepared, seconds; None if they never
    were."""

    seconds_to_first_applied: float | None = None
    """Time from then to the service's first applied matrix, seconds; None if there was none."""

    pace: float | None = None
    """Seconds of telemetry per second; None if not known."""

    unanswered_s: float = 0.0
    """Time for which the service has not answered, seconds."""

    frameless_s: float = 0.0
    """Time for which the service has received no frame, seconds."""

    silent_s: float = 0.0
    """Time for which the simulator has written no truth, seconds."""

    endings: tuple[str, ...] = ()
    """Exit status and last output of processes that have ended."""

    wanted_ratio: float = 1.0
    """Smallest accepted ratio of the wavefront errors at the start and at the end."""

    across_subap: float = TOLERANCE_ACROSS_SUBAP
    """Subapertures across the pupil."""

    measured_plant: bool = False
    """True if the plant is a measured matrix, whose true registration is unknown."""

    refusal: str | None = None
    """Reason of the last refused window; None if not known."""


@dataclass(slots=True, kw_only=True)
class Stage:
    """Loop with one reconstructor."""

    id: str | None = None
    n_modes: int | None = None
    wavefront_error_nm: float | None = None
    """True wavefront error from the simulator, nm RMS."""

    worst_pole_radius: float | None = None
    """Largest closed-loop pole radius within 3 sigma, as predicted by the service's gate."""


@dataclass(slots=True, kw_only=True)
class Report:
    """Results of one run."""

    true_alpha: dict[str, float] | None = None
    estimated_alpha: dict[str, float] | None = None
    sigma: dict[str, float] | None = None
    """1 σ, the model-error floor included."""

    floor: dict[str, float] | None = None
    """The model error that no integration removes, 1 σ: part of ``sigma``."""

    error: dict[str, float] | None = None
    error_in_sigma: dict[str, float] | None = None
    start: Stage = field(default_factory=Stage)
    first_update: Stage = field(default_factory=Stage)
    target_modes: Stage = field(default_factory=Stage)
    wavefront_ratio: float | None = None
    """Wavefront error at the start over that with more modes."""

    reconstructors_published: int = 0
    reconstructors_applied: int = 0
    reconstructors_refused_by_gate: int = 0
    reconstructors_rejected_by_rtc: int = 0
    swaps: list[View] = field(default_factory=list)
    frames_received: int = 0
    frames_lost: int = 0
    seconds_to_ready: float | None = None
    seconds_to_first_applied: float | None = None
    """Time from the end of preparation, seconds; None if no matrix was applied."""

    pace: float | None = None
    """Seconds of telemetry per second."""

    alarms: list[str] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    """Reasons of a failure, if they are known."""

    @property
    def good(self) -> bool:
        """True if the demo succeeded."""
        return not self.failures

    def to_json(self) -> str:
        """Return the report as one JSON object."""
        return json.dumps({**asdict(self), "good": self.good}, indent=2)


def make_report(
    state: View | None,
    reconstructors: list[View],
    truth: TruthFile,
    circumstances: Circumstances,
) -> Report:
    """Compare the service's results with the truth."""
    report = Report(
        seconds_to_ready=circumstances.seconds_to_ready,
        seconds_to_first_applied=circumstances.seconds_to_first_applied,
        pace=circumstances.pace,
    )
    if state is None:
        report.failures.append("the service never answered")
    else:
        report.frames_received = state["link"]["frames_received"]
        report.frames_lost = state["link"]["frames_lost"]
        alarms = {alarm["name"]: f"{alarm['name']}: {alarm['text']}" for alarm in state["alarms"]}
        report.alarms = list(alarms.values())
        # A slow machine is given more time instead.
        report.failures += [f"alarm {alarms[name]}" for name in alarms if name != WORKER_BEHIND]
        report.swaps = truth.swaps
        _count(report, reconstructors)
        _stages(report, reconstructors, truth, measured_plant=circumstances.measured_plant)
        _compare(report, state, truth)
        if circumstances.unanswered_s > MAX_SILENCE_S:
            report.failures.append(
                f"the service has not answered for {circumstances.unanswered_s:.0f} s"
            )
        _judge(report, circumstances)
    if report.failures:
        report.reasons = [*circumstances.endings, *_reasons(state, circumstances)]
    return report


def _reasons(state: View | None, circumstances: Circumstances) -> Iterator[str]:
    """Yield possible causes of a failure."""
    if state is None:
        return
    waited_for = waits(state)
    # Without a model nothing else can have worked: the other reasons would only follow from it.
    if MODEL in waited_for:
        yield f"the service was not ready: {waited_for[MODEL]}"
        return
    if circumstances.silent_s > MAX_SILENCE_S:
        yield f"the simulator has made nothing for {circumstances.silent_s:.0f} s"
    # A service that does not answer says nothing of frames.
    if circumstances.unanswered_s <= MAX_SILENCE_S:
        yield from _explain_missing_frames(state, circumstances.frameless_s)
    for alarm in state["alarms"]:
        if alarm["name"] == WORKER_BEHIND:
            yield f"too slow: {alarm['text']}"
    if circumstances.pace is not None and circumstances.pace < REAL_TIME:
        yield f"too slow: the simulator made {circumstances.pace:.2f} s of telemetry a second"
    yield from _explain_refused_windows(state, circumstances.refusal)
    # What has an alarm is a failure already.
    alarm_names = {alarm["name"] for alarm in state["alarms"]}
    yield from (f"waiting: {text}" for name, text in waited_for.items() if name not in alarm_names)


def waits(state: View) -> dict[str, str]:
    """Return the conditions that the service waits for, by name."""
    return {
        wait["name"]: f"for the {wait['responsible']}: {wait['text']}"
        for wait in state["waiting_for"]
    }


def _explain_missing_frames(state: View, frameless_s: float) -> Iterator[str]:
    if state["link"]["frames_received"] == 0:
        yield "no frames: none has reached the service"
    elif frameless_s > MAX_SILENCE_S:
        yield f"no frames: the last reached the service {frameless_s:.0f} s ago"


def _explain_refused_windows(state: View, refusal: str | None) -> Iterator[str]:
    accepted, refused = state["windows_accepted"], state["windows_refused"]
    if refused > accepted:
        last = "" if refusal is None else f"; the last: {refusal}"
        yield f"refused windows: {refused} of {accepted + refused}{last}"
    elif accepted == 0 and state["registration"] is None:
        yield "no window of telemetry was finished"


def _count(report: Report, reconstructors: list[View]) -> None:
    # The RTC's first matrix has no parent: it is not the service's.
    own = [r for r in reconstructors if r["parent"] is not None]
    report.reconstructors_published = sum(r["published_ns_utc"] is not None for r in own)
    report.reconstructors_applied = sum(r["applied_frame_seq"] is not None for r in own)
    report.reconstructors_refused_by_gate = sum(r["state"] == "refused" for r in own)
    report.reconstructors_rejected_by_rtc = sum(r["state"] == "rejected" for r in own)


def _stages(
    report: Report, reconstructors: list[View], truth: TruthFile, *, measured_plant: bool
) -> None:
    """Fill in the stages of the loop, and how the wavefront error compares with the start.

    A measured plant begins with its own reconstructor: the service's first one is compared with it,
    too, where no modes were added.
    """
    foreign = [r for r in reconstructors if r["parent"] is None]
    applied = [r for r in reconstructors if r["applied_frame_seq"] is not None]
    if foreign:
        report.start = _stage(foreign[0], truth)
    if applied:
        report.first_update = _stage(applied[0], truth)
    larger = [
        _stage(r, truth)
        for r in applied
        if report.start.n_modes and r["n_modes"] > report.start.n_modes
    ]
    if larger:
        # A matrix applied just before the end has no measured wavefront error yet.
        seen = [stage for stage in larger if stage.wavefront_error_nm is not None]
        report.target_modes = (seen or larger)[-1]
    last = report.target_modes if larger or not measured_plant else report.first_update
    before_nm, after_nm = (stage.wavefront_error_nm for stage in (report.start, last))
    if before_nm and after_nm:
        report.wavefront_ratio = before_nm / after_nm


def _stage(record: View, truth: TruthFile) -> Stage:
    gate = record["gate"]
    return Stage(
        id=record["id"],
        n_modes=record["n_modes"],
        wavefront_error_nm=truth.wavefront_error_nm(record["id"]),
        worst_pole_radius=None if gate is None else gate["worst_pole_radius"],
    )


def _compare(report: Report, state: View, truth: TruthFile) -> None:
    known, last = state["registration"], truth.last
    # A measured plant has no true registration.
    if last is not None and last[PARAMETERS[0]] is not None:
        report.true_alpha = {name: last[name] for name in PARAMETERS}
    if known is None:
        return
    report.estimated_alpha, report.sigma = known["alpha"], known["sigma"]
    report.floor, true = known["floor"], report.true_alpha
    if true is None:
        return
    report.error = {name: known["alpha"][name] - true[name] for name in PARAMETERS}
    report.error_in_sigma = {name: report.error[name] / known["sigma"][name] for name in PARAMETERS}


def _judge(report: Report, circumstances: Circumstances) -> None:
    """Describe everything that is not as required."""
    judge = _failures_on_measured_plant if circumstances.measured_plant else _failures
    report.failures += judge(report, circumstances)
    for swap in report.swaps:
        # The RTC swaps between two frames: a skipped one is a fault.
        if swap["frames_skipped"]:
            report.failures.append(
                f"{swap['frames_skipped']} frames skipped at the swap to {swap['cm_id']}"
            )


def _failures(report: Report, circumstances: Circumstances) -> list[str]:
    """Return failures of the estimate and the loop, if the truth is known."""
    failures = _estimate_failures(report, circumstances.across_subap)
    start, first, target = report.start, report.first_update, report.target_modes
    if not _has_recovered(start.worst_pole_radius, first.worst_pole_radius):
        failures.append("the stability margin has not recovered")
    if not _is_less(target.wavefront_error_nm, start.wavefront_error_nm):
        failures.append("the wavefront error with more modes is not below that of the start")
        return failures
    ratio, wanted = report.wavefront_ratio, circumstances.wanted_ratio
    if ratio is not None and ratio < wanted:
        failures.append(
            f"the wavefront error of the start is {ratio:.2f} times that with more modes, expected "
            f"{wanted:g} times"
        )
    return failures


def _failures_on_measured_plant(report: Report, circumstances: Circumstances) -> list[str]:
    """Return failures in a demo that begins with the measured reconstructor."""
    failures, ratio = [], report.wavefront_ratio
    if report.estimated_alpha is None:
        failures.append("no estimate of the registration")
    if ratio is None:
        failures.append("no reconstructor of the service was in use for long enough")
    elif ratio < circumstances.wanted_ratio:
        failures.append(
            f"the wavefront error is {1.0 / ratio:.2f} times that of the measured matrix' own "
            f"reconstructor, expected at most {1.0 / circumstances.wanted_ratio:.2f} times"
        )
    return failures


def _tolerances(across_subap: float) -> dict[str, float]:
    # An angle moves the edge of a smaller pupil by less.
    wider = max(TOLERANCE_ACROSS_SUBAP / across_subap, 1.0)
    return {
        name: round(allowed if name.endswith("_subap") else wider * allowed, 4)
        for name, allowed in TOLERANCE.items()
    }


def _estimate_failures(report: Report, across_subap: float) -> list[str]:
    if report.error is None or report.error_in_sigma is None:
        return ["no estimate of the registration"]
    failures, tolerances = [], _tolerances(across_subap)
    for name in PARAMETERS:
        if abs(report.error[name]) > tolerances[name]:
            failures.append(
                f"{name} is off by {report.error[name]:+.5f}, allowed {tolerances[name]}"
            )
        if abs(report.error_in_sigma[name]) > MAX_ERROR_IN_SIGMA:
            failures.append(f"{name} is off by {report.error_in_sigma[name]:+.1f} sigma")
    return failures


def _has_recovered(start: float | None, first: float | None) -> bool:
    """Return True if an update improves the margin.

    A worker without time never checks the matrix that is replaced; the gate has checked the update.
    """
    return first is not None and (start is None or _is_less(first, start))


def _is_less(value: float | None, limit: float | None) -> bool:
    return value is not None and limit is not None and math.isfinite(value) and value < limit


def table(report: Report) -> str:
    """Return the closing table."""
    lines = ["", "registration       true        estimated    sigma       error      in sigma"]
    lines += [f"  {name:15}" + _row(report, name) for name in PARAMETERS]
    lines += ["", "loop                           modes   wavefront error   worst pole radius"]
    for label, stage in (
        ("at the start", report.start),
        ("after the first update", report.first_update),
        ("with more modes", report.target_modes),
    ):
        lines.append(_stage_row(label, stage))
    lines += _before_and_after(report)
    seconds = report.seconds_to_first_applied
    first = "never" if seconds is None else f"{seconds:.1f} s after it was ready"
    ready = report.seconds_to_ready
    lines += [
        "",
        "never ready" if ready is None else f"ready {ready:.1f} s after the start",
        f"reconstructors: {report.reconstructors_published} published, "
        f"{report.reconstructors_applied} applied, {report.reconstructors_refused_by_gate} refused "
        f"by the gate, {report.reconstructors_rejected_by_rtc} rejected by the RTC; "
        f"first applied {first}",
        f"frames: {report.frames_received} received, {report.frames_lost} lost",
    ]
    lines += [
        f"swap to {swap['cm_id']}: {swap['frames_skipped']} frames skipped, wavefront peak "
        f"{swap['peak_before_nm']:.0f} nm before, {swap['peak_after_nm']:.0f} nm after"
        for swap in report.swaps
    ]
    lines.append("")
    lines += [f"FAILED: {text}" for text in report.failures] or ["GOOD: the main job was done"]
    lines += [f"because: {text}" for text in report.reasons]
    return "\n".join(lines)


def _before_and_after(report: Report) -> list[str]:
    before_nm, after_nm = report.start.wavefront_error_nm, report.target_modes.wavefront_error_nm
    if not before_nm or not after_nm:
        return []
    return [
        "",
        f"wavefront error {before_nm:.0f} nm before, {after_nm:.0f} nm after: "
        f"{before_nm / after_nm:.2f} times less; Strehl ratio at 1.65 um "
        f"{strehl_ratio(before_nm):.2f} before, {strehl_ratio(after_nm):.2f} after",
    ]


def strehl_ratio(error_nm: float) -> float:
    """Return the Strehl ratio at 1.65 um by Marechal's approximation."""
    return math.exp(-((2.0 * math.pi * error_nm / 1650.0) ** 2))


def _row(report: Report, name: str) -> str:
    true = report.true_alpha
    # A measured plant has no truth, and an estimate is shown all the same.
    if true is None and report.estimated_alpha is not None and report.sigma is not None:
        return f"  not known {report.estimated_alpha[name]:+14.5f} {report.sigma[name]:9.5f}"
    if true is None:
        return "  not known"
    if report.estimated_alpha is None or report.sigma is None or report.error is None:
        return f"{true[name]:+11.5f}    no estimate"
    in_sigma = (report.error_in_sigma or {})[name]
    return (
        f"{true[name]:+11.5f} {report.estimated_alpha[name]:+14.5f} {report.sigma[name]:9.5f} "
        f"{report.error[name]:+11.5f} {in_sigma:+9.2f}"
    )


def _stage_row(label: str, stage: Stage) -> str:
    if stage.id is None:
        return f"  {label:28} never reached"
    error, radius = stage.wavefront_error_nm, stage.worst_pole_radius
    return (
        f"  {label:28} {stage.n_modes:5d}   "
        f"{'-' if error is None else f'{error:8.1f} nm':>15}   "
        f"{'not judged' if radius is None else f'{radius:.3f}':>17}"
    )
