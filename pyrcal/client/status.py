"""``pyrcal status``: the whole service on one screen."""

from __future__ import annotations

from pyrcal.client.rest import Document
from pyrcal.terminal import span

FEW = 2
"""Largest number of orders that may be refused for one reason in normal operation."""

_ALPHA = {
    "shift_x_subap": ("shift x", "+.4f", "subap"),
    "shift_y_subap": ("shift y", "+.4f", "subap"),
    "rotation_deg": ("rotation", "+.4f", "deg"),
    "magnification": ("magnification", ".5f", ""),
}


def status_lines(state: Document) -> list[str]:
    """Return the screen: whether all is well, alarms with what to do, then the details."""
    return [line for line, _ in mark_urgent(state)]


def mark_urgent(state: Document) -> list[tuple[str, bool]]:
    """Return the lines of the screen, each with True if it must be seen first."""
    ready = "READY" if state["ready"] else f"NOT READY: {state['ready_reason']}"
    does, up = state["operating"], span(state["uptime_s"])
    doing = f"{does['service_state']}, {does['current_operation']}"
    urgent = [(f"{state['system']}: {ready}", not state["ready"])]
    urgent.append((f"{doing}; {_mode_text(state['mode'])}; up {up}", False))
    for alarm in worst_first(state):
        urgent.append((f"ALARM {alarm_line(alarm, state)}", True))
        urgent.append((f"      To do: {alarm['do']}", False))
    lines = []
    for alarm in state["stale_alarms"]:
        name = alarm["name"]
        lines.append(f"over, not acknowledged: {name} (pyrcal alarms ack {name})")
    alarms = {alarm["name"] for alarm in state["alarms"]}
    lines += [
        f"Waiting for the {wait['responsible']}: {wait['text']}"
        for wait in state["waiting_for"]
        # An alarm with this name is on the screen already.
        if wait["name"] not in alarms
    ]
    lines += ["", *_rtc(state), *_alpha(state), *_matrix(state), *_activity_lines(state)]
    return [*urgent, *((line, False) for line in lines)]


_MODES = {
    "auto": "the service sends new matrices by itself",
    "propose": "new matrices wait for an approval",
    "hold": "no matrices are made or sent",
}


def _mode_text(mode: str) -> str:
    """Return the mode and its meaning."""
    meaning = _MODES.get(mode)
    return f"mode {mode}" if meaning is None else f"mode {mode} ({meaning})"


def worst_first(state: Document) -> list[Document]:
    """Return the alarms that are not muted: the most severe first, unacknowledged before others."""
    # A muted alarm is listed elsewhere, with who muted it.
    shown = [alarm for alarm in state["alarms"] if alarm["muted"] is None]
    return sorted(
        shown, key=lambda one: (-_SEVERITIES.index(one["severity"]), one["alarm_state"] != "active")
    )


_SEVERITIES = ("warning", "serious", "critical")


def alarm_line(alarm: Document, state: Document) -> str:
    """Return an alarm on one line: severity, name, duration, whether it was seen, text."""
    lasts = span(max(0.0, (state["now_ns"] - alarm["since_ns_utc"]) / 1e9))
    seen = "" if alarm["acknowledged"] is None else ", acknowledged"
    return f"{alarm['severity']} {alarm['name']} (for {lasts}{seen}): {alarm['text']}"


def _rtc(state: Document) -> list[str]:
    rtc, link = state["rtc"], state["link"]
    loop = "not connected"
    if rtc is not None:
        loop = (
            f"loop {rtc['loop']} at {rtc['frame_rate_hz']:g} Hz, {rtc['n_controlled']} of "
            f"{rtc['n_modes']} modes controlled"
        )
    age_s = link["frame_age_s"]
    last = "" if age_s is None else f", the last {span(age_s)} ago"
    frames = f"{link['frames_received']} received, {link['frames_lost']} lost{last}"
    return [_line("RTC", loop), _line("Frames", frames), *_references(state)]


def _references(state: Document) -> list[str]:
    """Return name and age of changed reference slopes; older services do not report them."""
    since_ns = state.get("reference_since_ns_utc")
    if since_ns is None:
        return []
    age = span(max(0.0, (state["now_ns"] - since_ns) / 1e9))
    return [_line("References", f"{state['reference_id']}, for {age}")]


def _line(label: str, text: str) -> str:
    return f"{label:13} {text}"


def _alpha(state: Document) -> list[str]:
    known = state["registration"]
    windows = f"{state['windows_accepted']} accepted, {state['windows_refused']} rejected"
    lines = [_line("Windows", windows), *_refusal(state)]
    if known is None:
        return [_line("Registration", "not measured yet"), *lines]
    why = f" ({known['validity_reason']})" if known["validity_reason"] else ""
    age = f"{known['validity']}, {span(known['age_s'])} old{why}"
    return [
        _line("Registration", age),
        *(_line("", line) for line in registration_lines(known)),
        *lines,
    ]


def _refusal(state: Document) -> list[str]:
    """Return time and reason of the last rejected window."""
    last = state["window_refusal"]
    if last is None:
        return []
    gone_s = max(0.0, (state["now_ns"] - last["t_ns_utc"]) / 1e9)
    often = f" ({last['n_times']} times within a minute)" if last["n_times"] > 1 else ""
    return [_line("", f"last rejection {span(gone_s)} ago{often}: {last['text']}")]


def registration_lines(known: Document) -> list[str]:
    """Return the four parameters, each with its 1 sigma and unit, and what limits sigma."""
    tracked = known.get("tracking_sigma")
    lines = [
        f"{label:13} {_number(known['alpha'][name], form)} ± "
        f"{_number(known['sigma'][name], form.lstrip('+'))} {unit}".rstrip()
        + (f", changes ± {_number(tracked[name], form.lstrip('+'))}" if tracked else "")
        for name, (label, form, unit) in _ALPHA.items()
    ]
    stretched = zip(
        ("stretch x", "stretch 45"),
        known["alpha"].get("anamorphosis") or (),
        known.get("anamorphosis_sigma") or (),
        strict=False,
    )
    return [
        *lines,
        *(f"{label:13} {value:+.5f} ± {sigma:.5f}" for label, value, sigma in stretched),
        *filter(None, [known.get("sigma_limit")]),
    ]


def _matrix(state: Document) -> list[str]:
    return [_line("Matrix in use", f"{state['in_use'] or 'unknown'}; {verdict(state['margin'])}")]


def verdict(margin: Document | None) -> str:
    """Return the result of the stability check of a reconstructor as text."""
    if margin is None:
        return "stability not checked"
    outcome = "accepted" if margin["accepted"] else f"REFUSED: {margin['reason']}"
    radius = _number(margin["worst_pole_radius"], ".3f")
    return f"worst pole radius {radius}, limit {margin['bound']:g}: {outcome}"


def _activity_lines(state: Document) -> list[str]:
    dither_policy, acquisition = state["dither_policy"], state["acquisition"]
    lines = [_line("Dither", f"{dither_policy['phase']}: {dither_policy['reason']}")]
    if acquisition["under_way"]:
        lines.append(
            _line("Under way", f"acquisition, {acquisition['stage']}: {acquisition['text']}")
        )
    if state["measuring"] is not None:
        lines.append(_line("Under way", f"measurement of the matrix {state['measuring']['id']}"))
    if state["noisy_measurement"] is not None:
        noisy = state["noisy_measurement"]["id"]
        lines.append(_line("Under way", f"measurement of the noisy matrix {noisy}"))
    return [*lines, *_refusal_lines(state)]


def _refusal_lines(state: Document) -> list[str]:
    """Return the reasons that refuse several orders now, with the first remedy."""
    orders: dict[str, list[str]] = {}
    for name, permission in state["permitted"].items():
        if not permission["allowed"]:
            orders.setdefault(permission["reason"], []).append(name.replace("_", " "))
    # One or two orders are always refused, such as to close a loop that is closed.
    several = (item for item in orders.items() if len(item[1]) > FEW)
    return [_line("Not possible", f"{', '.join(names)}: {reason}") for reason, names in several]


def _number(value: float | None, form: str) -> str:
    return "?" if value is None else format(value, form)
