"""Looks at ordinary telemetry: when the sums of it are taken, and begun anew."""

from __future__ import annotations

from dataclasses import replace

from service.estimation import passive
from service.estimation.loop import why_open
from service.estimation.passive import Passive
from service.runtime.estimator_bank import EstimatorBank

PASSIVE_INTERVAL_S = 4.0
"""Between two looks of the passive watchdog, and of telemetry in each: a jump is to be seen within
5 s."""

MIN_PASSIVE_S = 3.0
"""Of telemetry, beside a dither."""

RESTS, LONG_RESTS = 1, 3
"""Intervals left out after a look beside a dither, and while its windows are accepted: they show a
jump sooner than a look does."""


def take_passive_sums(
    bank: EstimatorBank, *, has_windows: bool = False
) -> tuple[EstimatorBank, Passive | str | None]:
    """Return streams that begin new passive sums, and the old ones, or why there is no look yet.

    No two looks then share telemetry: their errors are independent, and one that lies wholly after
    a jump says so. Beside a dither some telemetry is left out, more where windows have ``told`` of
    α just now; None: that is why. A rest ends early when they no longer do.
    """
    rests = has_windows and bank.cutter is not None and not _oversleeps(bank)
    bank = bank if rests else _awake(bank)
    rtc, sums = bank.rtc, bank.passive
    since_ns = 0 if bank.cutter is None or sums is None else sums.since_ns_utc
    if bank.received_ns_utc - since_ns < MIN_PASSIVE_S * 1e9 and since_ns:
        return bank, None
    if rtc is None or sums is None:
        return bank, "no passive estimate: there is no telemetry that could be used"
    if not rtc.in_loop:
        return bank, f"no passive estimate: {why_open(rtc)}"
    if sums.why_unusable is not None:
        return bank, sums.why_unusable
    least = passive.MIN_FRAMES_PER_MODE * sums.n_modes
    if sums.n_effective < least:
        return bank, (
            f"no passive estimate yet: {sums.n_effective:.0f} frames in runs without gaps, "
            f"{least} are needed for {sums.n_modes} modes"
        )
    waiting_ns = round(sums.n_waiting * 1e9 / rtc.frame_rate_hz)
    begun = replace(
        sums,
        sums=(),
        n_effective=0.0,
        since_ns_utc=bank.received_ns_utc - waiting_ns,
    )
    if bank.cutter is not None and sums.tail is not None:
        rest_s = PASSIVE_INTERVAL_S * (LONG_RESTS if has_windows else RESTS)
        begun = replace(
            begun,
            waiting=(),
            begun=False,
            from_seq=sums.tail.next_seq + round(rest_s * rtc.frame_rate_hz),
            since_ns_utc=bank.received_ns_utc + round(rest_s * 1e9),
        )
    # a window that is under way is of the gains with which it began
    loop = rtc if bank.cutter is None else bank.loop
    return replace(bank, passive=begun, loop=loop), sums


def _awake(bank: EstimatorBank) -> EstimatorBank:
    """Return streams whose passive sums, where they rest, begin with what comes."""
    sums, heard_ns = bank.passive, bank.received_ns_utc
    if sums is None or sums.since_ns_utc <= heard_ns:
        return bank
    return replace(bank, passive=replace(sums, from_seq=0, since_ns_utc=heard_ns))


def _oversleeps(bank: EstimatorBank) -> bool:
    """Return whether the rest after a look would be longer than any: the RTC's clock went back."""
    sums = bank.passive
    left_ns = 0 if sums is None else sums.since_ns_utc - bank.received_ns_utc
    return left_ns > 2 * LONG_RESTS * PASSIVE_INTERVAL_S * 1e9
