"""What the demo prints: a line every few seconds, a table at the end."""

from __future__ import annotations

from typing import Any

from service.model.misregistration import PARAMETERS
from studies.demo.report import MODEL, REAL_TIME, Report, Stage, waits
from studies.demo.truth import Line

HEADING = (
    "   time   frames  lost |  shift x        shift y        rotation         magnification    |"
    "  age |   WFE  poles | matrix in use\n"
    "      s                |  subap          subap          deg                               |"
    "    s |    nm        |"
)

_FORMATS = {
    "shift_x_subap": "{:+.4f}±{:.4f}",
    "shift_y_subap": "{:+.4f}±{:.4f}",
    "rotation_deg": "{:+.4f}±{:.4f}",
    "magnification": "{:.5f}±{:.5f}",
}


def live_line(seconds: float, state: dict[str, Any] | None, truth: Line | None) -> str:
    """Return one line of the running table."""
    if state is None:
        return f"{seconds:7.1f}  the service is starting"
    link, known = state["link"], state["registration"]
    registration = " not known yet".ljust(66)
    age = "    -"
    if known is not None:
        cells = [
            _FORMATS[name].format(known["alpha"][name], known["sigma"][name]) for name in PARAMETERS
        ]
        registration = " {:14} {:14} {:16} {:18}".format(*cells)
        age = f"{known['age_s']:5.1f}"
    error = "    -" if truth is None else f"{truth['wavefront_error_nm']:5.0f}"
    margin = state["margin"]
    poles = "    -" if margin is None else f"{margin['worst_pole_radius']:.3f}"
    lost = link["frames_lost"]
    return (
        f"{seconds:7.1f} {link['frames_received']:8d} {lost:5d} |{registration}|{age} |"
        f" {error}  {poles} | {_matrix(state)}"
    )


def awaited(state: dict[str, Any] | None) -> str:
    """Return what keeps the clock from starting."""
    if state is None:
        return "the service is starting"
    if MODEL in (waited_for := waits(state)):
        return waited_for[MODEL]
    return "the simulated telescope is being prepared"


def slow_line(pace: float | None, *, real_time: bool, behind: bool) -> str | None:
    """Return what to say where it takes longer than asked for; None: it does not."""
    if pace is not None and pace < REAL_TIME:
        who = "this machine is slow: the simulator" if real_time else "the diffractive telescope"
        return f"         {who} runs at {pace:.1f} of real time; this takes longer"
    if behind:
        return "         this machine is slow: the service's worker is behind; this takes longer"
    return None


def _matrix(state: dict[str, Any]) -> str:
    alarms = " ".join([*(f"[{alarm['name']}]" for alarm in state["alarms"]), *_waits(state)])
    if not state["ready"]:
        return f"- {state['ready_reason']} {alarms}"
    if state["rtc"] is None:
        return f"- no RTC {alarms}"
    return f"{state['in_use'] or '-'} ({state['rtc']['n_controlled']} modes) {alarms}"


def _waits(state: dict[str, Any]) -> list[str]:
    """Return what is waited for besides the end of alarms."""
    known = {alarm["name"] for alarm in state["alarms"]}
    names = [wait["name"] for wait in state.get("waiting_for", ()) if wait["name"] not in known]
    return [f"waits for {', '.join(names)}"] if names else []


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


def _row(report: Report, name: str) -> str:
    true = report.true_alpha
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
