"""``pyrcal status``: what a running service does, on one screen, for somebody just woken up."""

from __future__ import annotations

import argparse
import json
from typing import Any

import httpx

from service.errors import LinkError, shown

WELL, NOT_WELL = 0, 1

ANSWER_WITHIN_S = 5.0

State = dict[str, Any]
"""What ``GET /v1/state`` answers."""

_ALPHA = {
    "shift_x_subap": ("shift x", "+.4f", "subap"),
    "shift_y_subap": ("shift y", "+.4f", "subap"),
    "rotation_deg": ("rotation", "+.4f", "deg"),
    "magnification": ("magnification", ".5f", ""),
}


def main(options: argparse.Namespace) -> int:
    """Ask, print, and return the exit status: 0 all is well, 1 not ready or an alarm.

    Raises
    ------
    LinkError
        If nothing answers there, or something else than pyrcal.
    """
    state = asked(options.url)
    try:
        lines = [json.dumps(state, indent=2)] if options.json else status_lines(state)
    except (KeyError, TypeError, ValueError) as error:
        raise LinkError(
            f"{options.url}: found an answer of another version of pyrcal ({error!r}); "
            "expected one like this program's: pyrcal status --json shows it"
        ) from error
    print("\n".join(lines if options.json else [shown(line) for line in lines]))
    return WELL if state["ready"] and not state["alarms"] else NOT_WELL


def asked(url: str) -> State:
    """Return the state that the service at this address tells.

    Raises
    ------
    LinkError
        If nothing answers there, or something else than pyrcal.
    """
    try:
        with httpx.Client(
            timeout=ANSWER_WITHIN_S, trust_env=False, verify=url.startswith("https:")
        ) as client:
            answer = client.get(f"{url.rstrip('/')}/v1/state")
            state = answer.raise_for_status().json()
    except httpx.TimeoutException as error:
        raise LinkError(
            f"{url}: no answer within {ANSWER_WITHIN_S:.0f} s; is it stopped?"
        ) from error
    except (httpx.TransportError, httpx.InvalidURL, httpx.UnsupportedProtocol) as error:
        raise LinkError(
            f"{url}: nothing answers ({error}); start the service with pyrcal run, or name its "
            "address with --url"
        ) from error
    except (httpx.HTTPStatusError, ValueError) as error:
        raise LinkError(f"{url}: something answers, but it is not pyrcal: {error}") from error
    if not isinstance(state, dict) or not {"ready", "alarms"} <= state.keys():
        raise LinkError(f"{url}: something answers, but it is not pyrcal")
    return state


def status_lines(state: State) -> list[str]:
    """Return the screen: first whether all is well and what is not, then what there is."""
    now_ns = state["now_ns"]
    ready = "ready" if state["ready"] else f"NOT READY: {state['ready_reason']}"
    lines = [f"{state['system']}, mode {state['mode']}, up {_span(state['uptime_s'])}: {ready}"]
    for alarm in state["alarms"]:
        lasting_s = max(0.0, (now_ns - alarm["since_ns_utc"]) / 1e9)
        lines.append(f"ALARM {alarm['name']} for {_span(lasting_s)}: {alarm['text']}")
    alarms = {alarm["name"] for alarm in state["alarms"]}
    lines += [
        f"waits for the {wait['party']}: {wait['text']}"
        for wait in state["waiting_for"]
        if wait["name"] not in alarms
    ]
    return [*lines, "", *_rtc(state), *_alpha(state), *_matrix(state), *_doing(state)]


def _rtc(state: State) -> list[str]:
    rtc, link = state["rtc"], state["link"]
    loop = "none has been heard, or it has vanished"
    if rtc is not None:
        loop = (
            f"loop {rtc['loop']} at {rtc['frame_rate_hz']:g} Hz, {rtc['n_controlled']} of "
            f"{rtc['n_modes']} modes"
        )
    age_s = link["frame_age_s"]
    last = "" if age_s is None else f", the last {_span(age_s)} ago"
    frames = f"{link['frames_received']} received, {link['frames_lost']} lost{last}"
    return [f"RTC      {loop}", f"frames   {frames}"]


def _alpha(state: State) -> list[str]:
    known = state["registration"]
    windows = f"{state['windows_accepted']} windows accepted, {state['windows_refused']} refused"
    if known is None:
        return [f"alpha    not known yet; {windows}"]
    worth = f"{known['validity']}, {_span(known['age_s'])} old; {windows}"
    why = f" ({known['validity_reason']})" if known["validity_reason"] else ""
    numbers = [
        f"         {label:13} {_number(known['alpha'][name], form)} ± "
        f"{_number(known['sigma'][name], form.lstrip('+'))} {unit}".rstrip()
        for name, (label, form, unit) in _ALPHA.items()
    ]
    return [f"alpha    {worth}{why}", *numbers]


def _matrix(state: State) -> list[str]:
    margin = state["margin"]
    if margin is None:
        return [f"matrix   {state['in_use'] or 'unknown'} in use, not judged"]
    verdict = "accepted" if margin["accepted"] else f"REFUSED: {margin['reason']}"
    radius = _number(margin["worst_pole_radius"], ".3f")
    return [
        f"matrix   {state['in_use'] or 'unknown'} in use, worst pole radius {radius} of at most "
        f"{margin['bound']:g}: {verdict}"
    ]


def _doing(state: State) -> list[str]:
    dithering, acquisition = state["dithering"], state["acquisition"]
    lines = [f"dither   {dithering['phase']}: {dithering['reason']}"]
    if acquisition["under_way"]:
        lines.append(f"doing    acquisition, {acquisition['stage']}: {acquisition['text']}")
    if state["measuring"] is not None:
        lines.append(f"doing    {state['measuring']['id']} is being measured")
    if state["gathering"] is not None:
        lines.append(f"doing    {state['gathering']['id']}, a noisy matrix, is under way")
    return lines


def _number(value: float | None, form: str) -> str:
    return "?" if value is None else format(value, form)


def _span(seconds: float) -> str:
    """Return a time as people say it."""
    for unit_s, unit, smaller_s, smaller in (
        (86_400.0, "d", 3600.0, "h"),
        (3600.0, "h", 60.0, "min"),
        (60.0, "min", 1.0, "s"),
    ):
        if seconds >= unit_s:
            return f"{seconds // unit_s:.0f} {unit} {seconds % unit_s // smaller_s:.0f} {smaller}"
    return f"{seconds:.2g} s" if seconds < 10.0 else f"{seconds:.0f} s"
