"""Counters of the link, and the age of its telemetry."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from service.wire import FrameHeader, Status

STATISTICS_PERIOD_S: Final = 2.0
"""Messages of this last period describe the present telemetry."""

BIN_S: Final = 0.25
"""Interval over which messages are summed."""

USED: Final = "used"
"""Outcome of a message or frame that was accepted."""

MALFORMED: Final = "malformed"
"""Outcome of one that broke the contract."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Disposition:
    """Outcome of messages of one kind, or of frames, in the last seconds."""

    kind: str
    """frames, status, ack, im, reply."""

    outcome: str
    """``used``, or in a word why not."""

    n: int
    """Frames, or messages, in the last ``STATISTICS_PERIOD_S``."""

    age_s: float
    """Time since the last one, seconds."""

    text: str
    """Description of the last one: what was found and what was expected; empty if nothing was
    wrong."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Refusal:
    """Something that somebody wanted on the link and may not."""

    who: str
    """The name in a certificate, or of a user; or what was missing."""

    what: str
    where: str
    """The key; of a connection, why it was refused."""

    n: int
    age_s: float
    """Time since the last occurrence, seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EndingCertificate:
    """A certificate that ends soon, or has ended."""

    name: str
    path: str
    remaining_s: float
    """Below 0: it has ended."""


class Counters:
    """Counts what has become of everything that came; not thread-safe."""

    __slots__ = ("_bins", "_last", "totals")

    def __init__(self) -> None:
        self.totals: Counter[tuple[str, str]] = Counter()
        # Counted in bins, because a list of single messages would grow with the rate of the sender.
        self._bins: deque[tuple[float, Counter[tuple[str, str]]]] = deque(
            maxlen=round(STATISTICS_PERIOD_S / BIN_S) + 1
        )
        self._last: dict[tuple[str, str], tuple[float, str]] = {}

    def add(self, kind: str, outcome: str, n: int, now_s: float, text: str = "") -> None:
        """Count ``n`` of a kind that met the same fate."""
        if not n:
            return
        self.totals[kind, outcome] += n
        if not self._bins or now_s - self._bins[-1][0] >= BIN_S:
            self._bins.append((now_s, Counter()))
        self._bins[-1][1][kind, outcome] += n
        self._last[kind, outcome] = (now_s, text)

    def begin(self) -> None:
        """Forget what came of late, and no total: what sends now is another."""
        self._bins.clear()
        self._last.clear()

    def of(self, kind: str, *, but: tuple[str, ...] = ()) -> dict[str, int]:
        """Return the totals of one kind since the start, by outcome."""
        return {o: n for (k, o), n in self.totals.items() if k == kind and o not in but}

    def dispositions(self, now_s: float) -> tuple[Disposition, ...]:
        """Return what has become of everything, the most frequent first."""
        recent: Counter[tuple[str, str]] = Counter()
        for start_s, counts in self._bins:
            if now_s - start_s <= STATISTICS_PERIOD_S:
                recent.update(counts)
        # An outcome stays listed with n = 0 after its last message: alarms decide by its age.
        fates = (
            Disposition(
                kind=kind, outcome=outcome, n=recent[kind, outcome], age_s=now_s - s, text=text
            )
            for (kind, outcome), (s, text) in self._last.items()
        )
        return tuple(sorted(fates, key=lambda disposition: -disposition.n))


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStatistics:
    """Counts since the service started, of all sessions together."""

    rtc_alive: bool
    """True if the RTC's liveliness token exists."""

    session: str | None
    """Session that counts; None if there is none."""

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
    """Frames that came too late; they stay among the lost."""

    frames_nonfinite: int
    """Frames dropped because a slope or a command was not finite."""

    frames_overwritten: int
    """Frames not drained in time, or void by a new session."""

    frames_refused: Mapping[str, int]
    """Frames of batches not used, by reason: session, basis, config, shape, leap, sequence."""

    messages_malformed: Mapping[str, int]
    """Messages that broke the contract, by kind: frames, status, ack, im, reply."""

    statuses_received: int
    acknowledgements_received: int
    acknowledgements_unknown: int
    """Acknowledgements of an id that this process has never offered."""

    events_dropped: int
    """Events dropped because nothing read them."""

    callback_errors: int
    """Faults of the service itself while it took a message in; they are logged."""

    frame_age_s: float | None
    """Seconds since the last frame arrived, by arrival; None: none has."""

    telemetry_age_s: float = 0.0
    """Age of the newest frame at its arrival, seconds: its delay beyond that of the fastest one."""

    dispositions: tuple[Disposition, ...] = ()
    """Outcomes of frames and messages by kind, the most frequent first."""

    missing: str = ""
    """Reason why the link is not open; empty if it is."""

    waiting_connections: Mapping[int, int] = field(default_factory=dict)
    """Connections closed before a TLS handshake that zenoh has not dealt with yet, by port."""

    status_age_s: float | None = None
    """Seconds since the last status of this session was taken in; None: none has been."""

    session_age_s: float = 0.0
    """Seconds since the first message of the session that counts."""

    session_waiting: str | None = None
    """The session that will count if the present one stays silent; None: there is none."""

    latency_p50_s: float | None
    """Median of put-to-callback over the last batches; None unless the RTC's session stamps its
    messages. It compares two clocks when the RTC runs on another machine."""

    refusals: tuple[Refusal, ...] = ()
    """Refusals on a secured link in the last minute, latest first."""

    ending_certificates: tuple[EndingCertificate, ...] = ()
    """Certificates that end soon or have ended, the first to end first."""


MAX_AGE_S: Final = 2.5
"""Telemetry that is older when it arrives is not used: α may have jumped meanwhile, or the matrix
have been swapped."""

MAX_DRIFT: Final = 0.009
"""Largest difference between two clocks that is no delay, as a fraction; nine times what the
contract allows the frame rate."""

MAX_DRIFT_S: Final = 1.0
"""Excess above which a delay is no drift, and is not forgotten however long it stays."""


class TelemetryAge:
    """Follows how much longer the newest frames take to arrive than the fastest; not thread-safe.

    Three clocks show the delay of a message: the time stamp of the RTC's zenoh session, the time of
    the frame and the number of the frame, each compared with the arrival. The least delay counts,
    because a clock that is set, a pause of the loop and an RTC slower than its frame period each
    disturb one or two of them, and a slow link all three. The stamps do not show a queue within the
    RTC. Its statuses do: their frame number is ahead of the telemetry.
    """

    def __init__(self) -> None:
        self._session: str | None = None
        self._end = 0
        self._stamps, self._times, self._numbers, self._lead = (_Excess() for _ in range(4))
        self._delay_s = self._lead_s = 0.0

    @property
    def age_s(self) -> float:
        """Age of the newest frame at its arrival, seconds."""
        return max(self._delay_s, self._lead_s)

    def add_frames(self, header: FrameHeader, at_s: float, latency_s: float | None) -> float:
        """Return the age of the newest frame, seconds.

        Parameters
        ----------
        header
            Header of a batch in its place in the sequence.
        at_s
            Arrival by a monotonic clock.
        latency_s
            Arrival less the stamp of the message; None without a stamp.
        """
        is_new, end = header.session != self._session, header.seq0 + header.n
        if is_new:
            # Its numbers have no relation to those before, and its frames perhaps another clock.
            self._session, self._lead_s = header.session, 0.0
            self._times, self._numbers, self._lead = (_Excess() for _ in range(3))
        elif end <= self._end:  # a recovered frame says nothing about the newest one
            return self.age_s
        self._end, t_ns = end, header.t0_ns + header.n * header.dt_ns
        excess_s = {
            self._times: self._times.add(at_s - t_ns * 1e-9, at_s),
            self._numbers: self._numbers.add(at_s - end * header.dt_ns * 1e-9, at_s),
        }
        if latency_s is not None:
            excess_s[self._stamps] = self._stamps.add(latency_s, at_s)
        if is_new:
            self._delay_s = min(self._delay_s, excess_s.get(self._stamps, 0.0))
        else:
            self._delay_s = min(excess_s.values())
        for clock in excess_s:
            clock.agree(self._delay_s)
        return self.age_s

    def add_status(self, status: Status, at_s: float) -> None:
        """Note by how many frames a status is ahead of the telemetry."""
        if status.session == self._session and status.seq is not None:
            ahead_s = (status.seq - self._end) / status.frame_rate_hz
            self._lead_s = self._lead.add(ahead_s, at_s)


class _Excess:
    """Excess of a delay over its least value, which may drift."""

    def __init__(self) -> None:
        self._least_s, self._last_s, self._at_s = math.inf, 0.0, 0.0

    def add(self, delay_s: float, at_s: float) -> float:
        """Return the excess of a delay at this time, seconds."""
        if self._last_s - self._least_s < MAX_DRIFT_S:
            self._least_s += MAX_DRIFT * (at_s - self._at_s)
        self._least_s = min(self._least_s, delay_s)
        self._last_s, self._at_s = delay_s, at_s
        return delay_s - self._least_s

    def agree(self, excess_s: float) -> None:
        """Change the least delay if the excess differs from what another clock shows."""
        if not 0.0 <= self._last_s - self._least_s - excess_s <= MAX_DRIFT_S:
            self._least_s = self._last_s - excess_s
