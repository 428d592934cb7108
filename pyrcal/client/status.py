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
    """Return the screen: first whether all is well, then the details."""
    ready = "ready" if state["ready"] else f"NOT READY: {state['ready_reason']}"
    does, up = state["operating"], span(state["uptime_s"])
    doing = f"{does['service_state']}, {does['current_operation']}"
    lines = [f"{state['system']}: {doing}; mode {state['mode']}, up {up}: {ready}"]
    lines += [f"ALARM {alarm_line(alarm, state)}" for alarm in worst_first(state)]
    gone = ", ".join(alarm["name"] for alarm in state["stale_alarms"])
    lines += [f"over and not acknowledged: {gone}; see pyrcal alarms"] if gone else []
    alarms = {alarm["name"] for alarm in state["alarms"]}
    lines += [
        f"waits for the {wait['responsible']}: {wait['text']}"
        for wait in state["waiting_for"]
        if wait["name"] not in alarms
    ]
    return [*lines, "", *_rtc(state), *_alpha(state), *_matrix(state), *_activity_lines(state)]


def worst_first(state: Document) -> list[Document]:
    """Return the alarms that are not muted: the most severe first, unacknowledged before others."""
    shown = [alarm for alarm in state["alarms"] if alarm["muted"] is None]
    return sorted(
        shown, key=lambda one: (-_SEVERITIES.index(one["severity"]), one["alarm_state"] != "active")
    )


_SEVERITIES = ("warning", "serious", "critical")


def alarm_line(alarm: Document, state: Document) -> str:
    """Return an alarm on one line: text, severity, duration, whether it was seen."""
    lasts = span(max(0.0, (state["now_ns"] - alarm["since_ns_utc"]) / 1e9))
    seen = "" if alarm["acknowledged"] is None else ", acknowledged"
    return f"{alarm['name']} ({alarm['severity']}{seen}) for {lasts}: {alarm['text']}"


def _rtc(state: Document) -> list[str]:
    rtc, link = state["rtc"], state["link"]
    loop = "none seen yet, or it has vanished"
    if rtc is not None:
        loop = (
            f"loop {rtc['loop']} at {rtc['frame_rate_hz']:g} Hz, {rtc['n_controlled']} of "
            f"{rtc['n_modes']} modes"
        )
    age_s = link["frame_age_s"]
    last = "" if age_s is None else f", the last {span(age_s)} ago"
    frames = f"{link['frames_received']} received, {link['frames_lost']} lost{last}"
    return [f"RTC      {loop}", f"frames   {frames}"]


def _alpha(state: Document) -> list[str]:
    known = state["registration"]
    windows = f"{state['windows_accepted']} accepted, {state['windows_refused']} refused"
    lines = [f"windows  {windows}", *_refusal(state)]
    if known is None:
        return ["alpha    not known yet", *lines]
    worth = f"{known['validity']}, {span(known['age_s'])} old"
    why = f" ({known['validity_reason']})" if known["validity_reason"] else ""
    four = (f"         {line}" for line in registration_lines(known))
    return [f"alpha    {worth}{why}", *four, *lines]


def _refusal(state: Document) -> list[str]:
    """Return time and reason of the last refused window."""
    last = state["window_refusal"]
    if last is None:
        return []
    gone_s = max(0.0, (state["now_ns"] - last["t_ns_utc"]) / 1e9)
    often = f" ({last['n_times']} times within a minute)" if last["n_times"] > 1 else ""
    return [f"         refused {span(gone_s)} ago{often}: {last['text']}"]


def registration_lines(known: Document) -> list[str]:
    """Return the four parameters of a registration, each with its 1 sigma and unit."""
    lines = [
        f"{label:13} {_number(known['alpha'][name], form)} ± "
        f"{_number(known['sigma'][name], form.lstrip('+'))} {unit}".rstrip()
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
    ]


def _matrix(state: Document) -> list[str]:
    return [f"matrix   {state['in_use'] or 'unknown'} in use, {verdict(state['margin'])}"]


def verdict(margin: Document | None) -> str:
    """Return the stability gate's verdict on a reconstructor as text."""
    if margin is None:
        return "not judged"
    outcome = "accepted" if margin["accepted"] else f"REFUSED: {margin['reason']}"
    radius = _number(margin["worst_pole_radius"], ".3f")
    return f"worst pole radius {radius} of at most {margin['bound']:g}: {outcome}"


def _activity_lines(state: Document) -> list[str]:
    dither_policy, acquisition = state["dither_policy"], state["acquisition"]
    lines = [f"dither   {dither_policy['phase']}: {dither_policy['reason']}"]
    if acquisition["under_way"]:
        lines.append(f"doing    acquisition, {acquisition['stage']}: {acquisition['text']}")
    if state["measuring"] is not None:
        lines.append(f"doing    {state['measuring']['id']} is being measured")
    if state["noisy_measurement"] is not None:
        lines.append(f"doing    {state['noisy_measurement']['id']}, a noisy matrix, is under way")
    return [*lines, *_refusal_lines(state)]


def _refusal_lines(state: Document) -> list[str]:
    """Return the reasons that refuse several orders now, and the first remedy."""
    orders: dict[str, list[str]] = {}
    for name, permission in state["permitted"].items():
        if not permission["allowed"]:
            orders.setdefault(permission["reason"], []).append(name.replace("_", " "))
    several = (item for item in orders.items() if len(item[1]) > FEW)
    return [f"refused  {', '.join(names)}: {reason}" for reason, names in several]


def _number(value: float | None, form: str) -> str:
    return "?" if value is None else format(value, form)
