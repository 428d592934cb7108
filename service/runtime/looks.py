"""Looks at ordinary telemetry: when the sums of it are taken, and begun anew."""

from __future__ import annotations

from dataclasses import replace

from service.estimation import passive
from service.estimation.passive import Passive
from service.runtime.streams import Streams
from service.tracking.loop import why_open

WATCH_INTERVAL_S = 4.0
"""Between two looks of the passive watchdog, and of telemetry in each: a jump is to be seen within
5 s."""

LEAST_LOOK_S = 3.0
"""Of telemetry, beside a dither."""

RESTS, LONG_RESTS = 1, 3
"""Intervals left out after a look beside a dither, and while its windows are accepted: they show a
jump sooner than a look does."""


def taken(streams: Streams, *, told: bool = False) -> tuple[Streams, Passive | str | None]:
    """Return streams that begin new passive sums, and the old ones, or why there is no look yet.

    No two looks then share telemetry: their errors are independent, and one that lies wholly after
    a jump says so. Beside a dither some telemetry is left out, more where windows have ``told`` of
    α just now; None: that is why. A rest ends early when they no longer do.
    """
    rests = told and streams.cutter is not None and not _oversleeps(streams)
    streams = streams if rests else _awake(streams)
    rtc, sums = streams.rtc, streams.passive
    since_ns = 0 if streams.cutter is None or sums is None else sums.since_ns_utc
    if streams.heard_ns_utc - since_ns < LEAST_LOOK_S * 1e9 and since_ns:
        return streams, None
    if rtc is None or sums is None:
        return streams, "no passive estimate: there is no telemetry that could be used"
    if not rtc.in_loop:
        return streams, f"no passive estimate: {why_open(rtc)}"
    if sums.why_unusable is not None:
        return streams, sums.why_unusable
    least = passive.MIN_FRAMES_PER_MODE * sums.n_modes
    if sums.n_effective < least:
        return streams, (
            f"no passive estimate yet: {sums.n_effective:.0f} frames in runs without gaps, "
            f"{least} are needed for {sums.n_modes} modes"
        )
    waiting_ns = round(sums.n_waiting * 1e9 / rtc.frame_rate_hz)
    begun = replace(
        sums,
        sums=(),
        n_effective=0.0,
        since_ns_utc=streams.heard_ns_utc - waiting_ns,
    )
    if streams.cutter is not None and sums.tail is not None:
        rest_s = WATCH_INTERVAL_S * (LONG_RESTS if told else RESTS)
        begun = replace(
            begun,
            waiting=(),
            begun=False,
            from_seq=sums.tail.next_seq + round(rest_s * rtc.frame_rate_hz),
            since_ns_utc=streams.heard_ns_utc + round(rest_s * 1e9),
        )
    # a window that is under way is of the gains with which it began
    loop = rtc if streams.cutter is None else streams.loop
    return replace(streams, passive=begun, loop=loop), sums


def _awake(streams: Streams) -> Streams:
    """Return streams whose passive sums, where they rest, begin with what comes."""
    sums, heard_ns = streams.passive, streams.heard_ns_utc
    if sums is None or sums.since_ns_utc <= heard_ns:
        return streams
    return replace(streams, passive=replace(sums, from_seq=0, since_ns_utc=heard_ns))


def _oversleeps(streams: Streams) -> bool:
    """Return whether the rest after a look would be longer than any: the RTC's clock went back."""
    sums = streams.passive
    left_ns = 0 if sums is None else sums.since_ns_utc - streams.heard_ns_utc
    return left_ns > 2 * LONG_RESTS * WATCH_INTERVAL_S * 1e9
