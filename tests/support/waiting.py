"""What tests of several modules share of unit.runtime.test_waiting."""

from __future__ import annotations

from service.link.statistics import Disposition, LinkStatistics

SECOND = 1_000_000_000


def link(*dispositions, **changes):
    """A link on which all is well but for what is given."""
    counts = dict.fromkeys(
        (
            "batches_received",
            "frames_received",
            "frames_lost",
            "frames_recovered",
            "frames_duplicate",
            "frames_late",
            "frames_nonfinite",
            "frames_overwritten",
            "statuses_received",
            "acknowledgements_received",
            "acknowledgements_unknown",
            "events_dropped",
            "callback_errors",
        ),
        0,
    )
    values = {
        "rtc_alive": True,
        "session": "s1",
        "basis_id": "b",
        "config_id": "c",
        "frames_refused": {},
        "messages_malformed": {},
        "frame_age_s": 0.01,
        "status_age_s": 0.2,
        "session_age_s": 60.0,
        "latency_p50_s": None,
        "dispositions": dispositions,
    }
    return LinkStatistics(**(counts | values | changes))


def disposition(outcome, n, kind="frames", text="", age_s=0.1):
    return Disposition(kind=kind, outcome=outcome, n=n, age_s=age_s, text=text)


WELL = (disposition("used", 2000), disposition("used", 10, "status"))
