"""Counters of the link, as one record for REST and metrics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStatistics:
    """What has passed since the service started; counts are of all sessions together."""

    rtc_alive: bool
    """Whether the RTC's liveliness token is there."""

    session: str | None
    """The session that counts; None: none has been heard."""

    basis_id: str | None
    """Expected of every message; None: the first one seen will be adopted."""

    config_id: str | None
    """Expected of every message; None: the first one seen will be adopted."""

    batches_received: int
    """Batches that were well-formed, of this session, basis and configuration."""

    frames_received: int
    """Frames that could be used, recovered ones included."""

    frames_lost: int
    """Frames missing in the sequence and not recovered (yet)."""

    frames_recovered: int
    """Frames that came after later ones and still found their place."""

    frames_duplicate: int
    frames_late: int
    """Frames that came when their place had been passed; they stay among the lost."""

    frames_nonfinite: int
    """Frames dropped because a slope or a command was not finite."""

    frames_overwritten: int
    """Frames nobody drained in time, or that a new session made void."""

    frames_refused: Mapping[str, int]
    """Frames of batches not used, by reason: session, basis, config, shape."""

    messages_malformed: Mapping[str, int]
    """Messages that broke the contract, by kind: frames, status, ack, im, reply."""

    statuses_received: int
    acknowledgements_received: int
    acknowledgements_unknown: int
    """Those for an id this process has never offered."""

    events_dropped: int
    """Events that gave way because nobody took them."""

    callback_errors: int
    """Faults of the service itself while it took a message in; they are logged."""

    frame_age_s: float | None
    """Seconds since the last frame arrived, by arrival; None: none has."""

    latency_p50_s: float | None
    """Median of put-to-callback over the last batches; None unless the RTC's session stamps its
    messages. It compares two clocks when the RTC runs on another machine."""
