"""Checks that need nothing but the RTC's telemetry, one function each.

Each function takes the observer of the telemetry and its context, and returns one result.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from check_rtc.requirements import CheckResult, fine, seen, skipped, wrong
from check_rtc.watch import Arrival, TelemetryObserver, select_session, sort_by_frame
from service.estimation.orientation import format_setting
from service.estimation.slope_convention import SlopeConvention
from service.runtime.readiness import MAX_STATUSES_HZ
from service.tracking.alarm_rules import explain_clock
from service.wire import Keys, Manifest, Status

MIN_RATE_RATIO, MAX_RATE_RATIO = 0.8, 1.1
"""Range of the measured over the nominal frame rate; a simulated RTC may run slower."""

MESSAGE_RATE_RANGE_HZ: Final = (8.0, 120.0)
"""Usual range of batches per second; the contract says 10 to 100."""

STATUS_RATE_RANGE_HZ: Final = (0.8, 12.0)
"""Usual range of statuses per second; the contract says 1 to 10."""

NOTABLE_DELAY_S: Final = 0.25
"""Delay of a batch against the one before from which it is reported."""

MAX_DELAY_S: Final = 0.5
"""Largest delay of a batch; the service does not wait longer for missing frames."""

NOTABLE_CLOCK_LAG_S: Final = 10.0
"""Delay of the RTC's clock from which it is reported; telemetry may be late by as much."""

NOTABLE_PX: Final = 0.03
"""RMS offset of pupil images from which the instrument file should give it, in pixels.

An offset of 0.05 pixel that the model does not have moves a fitted shift by 0.016 subaperture.
"""

DETECTION_SIGMA: Final = 3.0
"""Number of σ from which an offset counts as detected."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageOffsets:
    """Offsets of the pupil images on the detector from their places on the pixel grid."""

    measured_px: NDArray[np.float64]
    """``(4, 2)`` offsets x, y of the images at -x -y, +x -y, -x +y, +x +y, detector pixels in the
    RTC's axes; their mean is 0."""

    sigma_px: NDArray[np.float64]
    """``(4, 2)`` 1 σ of ``measured_px``, detector pixels."""

    nominal_px: NDArray[np.float64] | None
    """``(4, 2)`` offsets in the instrument file, less their mean; None if it has none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TelemetryContext:
    """Context in which telemetry is judged: instrument, matrix in use, duration."""

    keys: Keys
    began_s: float
    """Start of listening on a monotonic clock, seconds."""

    ended_s: float
    """End of listening on the same clock, seconds."""

    applied: Manifest | None = None
    """Manifest of the matrix in use; None if the RTC does not give it."""

    applied_error: str = ""
    """Reason for which there is no matrix in use; empty if there is one."""

    is_served: bool = True
    """False if nothing answers on the key of the matrix in use, which is optional."""

    basis_id: str | None = None
    """Id of the modal basis in the instrument file; None if any is accepted."""

    config_id: str | None = None
    """Id of the sensor configuration in the instrument file; None if any is accepted."""

    slope_convention: SlopeConvention | str = ""
    """Signs and axes by the matrix in use, or the reason why they are unknown."""

    images: ImageOffsets | str = ""
    """Offsets of the pupil images in the flux of the status, or the reason why they are unknown."""

    @property
    def span_s(self) -> float:
        """Duration of the telemetry, seconds."""
        return self.ended_s - self.began_s


def run_telemetry_checks(
    observer: TelemetryObserver, context: TelemetryContext
) -> Iterator[CheckResult]:
    """Yield the result of every check of the telemetry."""
    for check in _CHECKS:
        yield check(observer, context)


def _connection(observer: TelemetryObserver, _: TelemetryContext) -> CheckResult:
    came = [at_s for at_s, alive in observer.tokens if alive]
    gone = [at_s for at_s, alive in observer.tokens if not alive]
    if not came:
        return wrong("connection", "telemetry comes, but the token alive/rtc is not declared")
    if not gone:
        return fine("connection", "the token is declared")
    if observer.tokens[-1][1]:
        away_s = came[-1] - gone[-1]
        return seen("connection", f"the token was away for {away_s:.1f} s and came back")
    return wrong("connection", "the token has disappeared")


def _messages(observer: TelemetryObserver, _: TelemetryContext) -> CheckResult:
    counts = Counter(refused.topic for refused in observer.refused)
    if not counts:
        n = len(observer.arrivals) + len(observer.statuses) + len(observer.acknowledgements)
        return fine("messages", f"{n} messages agree with their tables")
    which = ", ".join(f"{n} {topic}" for topic, n in counts.items())
    texts = dict.fromkeys(refused.text for refused in observer.refused)
    return wrong("messages", f"unreadable: {which}: {'; '.join(list(texts)[:3])}")


def _frames(observer: TelemetryObserver, _: TelemetryContext) -> CheckResult:
    arrivals = select_session(observer.arrivals, _main_session(observer))
    if len(arrivals) < 3:
        return wrong("frames", f"{len(arrivals)} messages of frames have come")
    first, last = arrivals[0], arrivals[-1]
    span_s = max(last.at_s - first.at_s, 1e-3)
    rate_hz = _rate_hz(arrivals)
    messages_hz = (len(arrivals) - 1) / span_s
    nominal_hz = 1e9 / last.header.dt_ns
    found = (
        f"{rate_hz:.0f} frames a second in {messages_hz:.0f} messages of up to "
        f"{max(a.header.n for a in arrivals)}; {nominal_hz:.4g} Hz by dt_ns"
    )
    status = observer.status
    if status is not None and abs(status.frame_rate_hz / nominal_hz - 1.0) > 1e-3:
        return wrong("frames", f"{found}, {status.frame_rate_hz:.6g} Hz by the status")
    if rate_hz > MAX_RATE_RATIO * nominal_hz:
        return wrong("frames", found)
    if rate_hz < MIN_RATE_RATIO * nominal_hz:
        return seen("frames", f"{found}: slower than nominal")
    if not MESSAGE_RATE_RANGE_HZ[0] <= messages_hz <= MESSAGE_RATE_RANGE_HZ[1]:
        return seen("frames", found)
    if not last.recoverable:
        return seen("frames", f"{found}; a plain publisher: lost frames cannot be recovered")
    return fine("frames", found)


def _rate_hz(arrivals: list[Arrival]) -> float:
    """Return the frame rate by the times of arrival: the median of several spans.

    The median ignores a span in which the loop paused. The first quarter is left out, because
    frames from the publisher's cache come in a burst.
    """
    later = arrivals[len(arrivals) // 4 :]
    n = max(len(later) // 3, 2)
    spans = [later[k : k + n] for k in range(0, len(later) - n + 1, n)]
    rates_hz = [
        (span[-1].stop_seq - span[0].stop_seq) / max(span[-1].at_s - span[0].at_s, 1e-3)
        for span in spans
    ]
    return float(np.median(rates_hz))


def _sizes(observer: TelemetryObserver, _: TelemetryContext) -> CheckResult:
    sizes = Counter((a.header.n_slopes, a.header.n_modes) for a in observer.arrivals)
    status = observer.status
    words = " and ".join(f"{slopes} slopes, {modes} modes" for slopes, modes in sizes)
    if status is not None and set(sizes) - {(status.n_slopes, status.n_modes)}:
        return wrong(
            "sizes", f"{words}; the status says {status.n_slopes} slopes, {status.n_modes} modes"
        )
    if len(sizes) > 1:
        return wrong("sizes", f"the sizes alternate: {words}")
    return fine("sizes", words) if sizes else skipped("sizes", "no frame has come")


def _numbers(observer: TelemetryObserver, _: TelemetryContext) -> CheckResult:
    problems = []
    if observer.n_nonfinite:
        problems.append(f"{observer.n_nonfinite} frames with numbers that are not finite")
    if observer.n_frozen:
        problems.append(f"{observer.n_frozen} frames with exactly the slopes of the frame before")
    if problems:
        return wrong("numbers", "; ".join(problems))
    return fine("numbers", f"all of {sum(a.header.n for a in observer.arrivals)} frames")


def _sequence(observer: TelemetryObserver, _: TelemetryContext) -> CheckResult:
    counts, restart = Counter[str](), ""
    for session in observer.sessions():
        arrivals = select_session(observer.arrivals, session)
        restart = restart or _find_restart(arrivals)
        head, known = arrivals[0].header.seq0, set[int]()
        for arrival in arrivals:
            seq0 = arrival.header.seq0
            if seq0 in known:
                counts["frames came twice"] += arrival.header.n
            elif seq0 < head:
                counts["overtaken"] += 1
            known.add(seq0)
            head = max(head, arrival.stop_seq)
        for before, after in pairwise(sort_by_frame(arrivals)):
            counts["frames are missing"] += max(after.header.seq0 - before.stop_seq, 0)
    overtaken = counts.pop("overtaken", 0)
    problems = [f"{n} {what}" for what, n in counts.items() if n] + ([restart] if restart else [])
    if problems:
        return wrong("sequence", "; ".join(problems))
    if overtaken:
        text = f"none is missing; {overtaken} messages came out of order"
        return seen("sequence", text)
    return fine("sequence", "each frame once, none missing")


def _find_restart(arrivals: list[Arrival]) -> str:
    """Return a text on where the sequence numbers start over; empty if they do not.

    A batch that was overtaken on the network also has a lower number, but an older timestamp.
    """
    head, newest_ns, known = 0, 0, set[int]()
    for arrival in arrivals:
        header = arrival.header
        again = header.seq0 < head and header.t0_ns > newest_ns
        if again and header.seq0 not in known:
            return f"seq0 goes back from {head} to {header.seq0} in session {header.session}"
        known.add(header.seq0)
        head, newest_ns = max(head, arrival.stop_seq), max(newest_ns, header.t0_ns)
    return ""


def _clock_steps(observer: TelemetryObserver) -> Iterator[tuple[Arrival, Arrival, float, float]]:
    """Yield neighbouring batches, the step of the RTC's clock between them, and their delay.

    The step is against a constant frame period, the delay against the same by arrival, both in
    seconds.
    """
    for session in observer.sessions():
        for before, after in pairwise(sort_by_frame(select_session(observer.arrivals, session))):
            dt_ns = before.header.dt_ns
            n_frames = after.header.seq0 - before.header.seq0
            step_ns = after.header.t0_ns - before.header.t0_ns - n_frames * dt_ns
            since_s = after.at_s - before.at_s - (after.stop_seq - before.stop_seq) * dt_ns * 1e-9
            yield before, after, step_ns * 1e-9, since_s


def _clock(observer: TelemetryObserver, _: TelemetryContext) -> CheckResult:
    pauses: list[tuple[float, int]] = []
    steps: list[tuple[float, int]] = []
    for before, after, step_s, since_s in _clock_steps(observer):
        if abs(step_s) <= before.header.dt_ns * 0.5e-9:
            continue
        # In a pause of the loop both clocks advance by the same time; a step of the RTC's clock
        # does not delay the arrival.
        is_pause = step_s > 0.0 and abs(since_s - step_s) < max(0.3 * step_s, 0.1)
        (pauses if is_pause else steps).append((step_s, after.header.seq0))
    if steps:
        step_s, seq = steps[0]
        return wrong(
            "clock", f"{len(steps)} steps without a pause, the first {step_s:+.4g} s at frame {seq}"
        )
    if pauses:
        step_s, seq = pauses[0]
        return seen("clock", f"the loop paused for {step_s:.2f} s before frame {seq}")
    if not observer.arrivals:
        return skipped("clock", "no frame has come")
    lead_s = (observer.arrivals[-1].header.t0_ns - time.time_ns()) * 1e-9
    problem = explain_clock(lead_s)
    if problem:
        return wrong("clock", f"{problem}, by the clock of this machine")
    found = f"{lead_s:+.2g} s from the clock of this machine"
    if lead_s < -NOTABLE_CLOCK_LAG_S:
        return seen("clock", f"even, and {found}")
    return fine("clock", f"even, and {found}")


def _delivery(observer: TelemetryObserver, _: TelemetryContext) -> CheckResult:
    """Check the largest delay of a batch against the one that came before it."""
    late, where = 0.0, 0
    for session in observer.sessions():
        for before, after in pairwise(select_session(observer.arrivals, session)):
            dt_s = before.header.dt_ns * 1e-9
            by_seq = (after.stop_seq - before.stop_seq) * dt_s
            by_clock = (after.header.t0_ns - before.header.t0_ns) * 1e-9
            excess = after.at_s - before.at_s - max(by_seq, by_clock, 0.0)
            if excess > late:
                late, where = excess, after.header.seq0
    found = f"at most {1e3 * late:.0f} ms late against the batch before, at frame {where}"
    if late > MAX_DELAY_S:
        return wrong("delivery", found)
    return (seen if late > NOTABLE_DELAY_S else fine)("delivery", found)


def _session(observer: TelemetryObserver, _: TelemetryContext) -> CheckResult:
    runs = [observer.arrivals[0].header.session] if observer.arrivals else []
    for before, after in pairwise(observer.arrivals):
        if after.header.session != before.header.session:
            runs.append(after.header.session)
    if not runs:
        return skipped("session", "no frame has come")
    names = list(dict.fromkeys(runs))
    # A change of session has one more run of the same session if a late message follows.
    if len(runs) > len(names) + 1:
        return wrong(
            "session", f"{len(names)} sessions alternate ({', '.join(names[:3])}): two RTCs"
        )
    if len(names) > 1:
        return seen("session", f"{names[1]} follows {names[0]}: the loop or the RTC was restarted")
    return fine("session", f"{names[0]} throughout")


def _status(observer: TelemetryObserver, context: TelemetryContext) -> CheckResult:
    status = observer.status
    if status is None:
        return wrong("status", f"none came in {context.span_s:.0f} s")
    times_s = [at_s for at_s, _ in observer.statuses]
    rate_hz = (len(times_s) - 1) / max(times_s[-1] - times_s[0], 1.0)
    found = (
        f"{rate_hz:.1f} a second; loop {status.loop}, {status.n_controlled} of {status.n_modes} "
        f"modes, "
        f"matrix {status.cm_id}"
    )
    disagreement = _find_disagreement(observer, status)
    if disagreement:
        return wrong("status", f"{found}; {disagreement}")
    if rate_hz > MAX_STATUSES_HZ or rate_hz < STATUS_RATE_RANGE_HZ[0]:
        return wrong("status", found)
    if rate_hz > STATUS_RATE_RANGE_HZ[1] or not status.in_loop or status.cm_id is None:
        return seen("status", found)
    return fine("status", found)


def _find_disagreement(observer: TelemetryObserver, status: Status) -> str:
    """Return a contradiction of the last status with itself or the frames; empty if none."""
    if status.loop == "closed" and not all(status.gains[: status.n_controlled]):
        return "loop is closed, but some controlled modes have a gain of 0: it should be partial"
    if status.loop != "open" and any(status.gains[status.n_controlled :]):
        return "some uncontrolled modes have a gain"
    at_s = observer.statuses[-1][0]
    earlier = [a for a in select_session(observer.arrivals, status.session) if a.at_s <= at_s]
    if not earlier:
        return f"no frame has its session {status.session}" if observer.arrivals else ""
    latest = max(arrival.stop_seq for arrival in earlier) - 1
    tolerance = 2.0 * status.frame_rate_hz  # two seconds of frames, as a status comes each second
    if status.seq is None or abs(status.seq - latest) > tolerance:
        return f"it has seq {status.seq}, the frames are at {latest}"
    # A swap may have come between the status and the frames next to it.
    if status.cm_id is not None and status.cm_id not in {a.header.cm_id for a in earlier[-20:]}:
        return f"the frames name matrix {earlier[-1].header.cm_id}"
    return ""


def _images(_: TelemetryObserver, context: TelemetryContext) -> CheckResult:
    images = context.images
    if isinstance(images, str):
        return skipped("images", images)
    nominal = np.zeros((4, 2)) if images.nominal_px is None else images.nominal_px
    error_px = images.measured_px - nominal
    rms_px, sigma_px = (float(np.sqrt(np.mean(part**2))) for part in (error_px, images.sigma_px))
    reference = "the pixel grid" if images.nominal_px is None else "wfs.image_offsets_px"
    found = f"{rms_px:.3f} pixel RMS from {reference}, 1 sigma {sigma_px:.3f}"
    if rms_px < max(NOTABLE_PX, DETECTION_SIGMA * sigma_px):
        return fine("images", found)
    offsets = ", ".join(f"[{x:.3f}, {y:.3f}]" for x, y in images.measured_px)
    return seen("images", f"{found}: set image_offsets_px = [{offsets}] in the instrument file")


def _ids(observer: TelemetryObserver, context: TelemetryContext) -> CheckResult:
    found = dict.fromkeys((a.header.basis_id, a.header.config_id) for a in observer.arrivals)
    found |= dict.fromkeys((s.basis_id, s.config_id) for _, s in observer.statuses)
    if context.applied is not None:
        found |= {(context.applied.basis_id, context.applied.config_id): None}
    words = "; then ".join(f"basis {basis}, configuration {config}" for basis, config in found)
    if len(found) > 1:
        return wrong("ids", words)
    pinned = context.basis_id, context.config_id
    for pair in found:
        for name, expected in zip(pair, pinned, strict=True):
            if expected not in {None, name}:
                return wrong("ids", f"{words}; the instrument file expects {expected}")
    return _references(observer, words) if found else skipped("ids", "nothing has come")


def _references(observer: TelemetryObserver, words: str) -> CheckResult:
    """Return the result for the ids with the names of the references, which may change."""
    frames = dict.fromkeys(a.header.reference_id for a in observer.arrivals)
    statuses = dict.fromkeys(s.reference_id for _, s in observer.statuses)
    shown = [", then ".join(name or "nil" for name in names) for names in (frames, statuses)]
    if frames and statuses and not frames.keys() & statuses.keys():
        found = f"{shown[0]} in frames and {shown[1]} in the status"
        return wrong("ids", f"{words}; references {found}, expected the same in both")
    named = any(frames)
    return fine("ids", f"{words}; references {shown[0]}" if named else words)


def _matrix(observer: TelemetryObserver, context: TelemetryContext) -> CheckResult:
    manifest, status = context.applied, observer.status
    if manifest is None and not context.is_served:
        reason = "no answer on rtc/cm/applied, which is optional; ids are not verified without it"
        return skipped("matrix", reason)
    if manifest is None or status is None:
        return wrong("matrix", context.applied_error or "there is no status to compare it with")
    shape = manifest.layout.shape
    found = f"{manifest.id}, {list(shape)} in {manifest.layout.n_chunks} chunks, checksum correct"
    if shape[1] != status.n_slopes or (status.in_loop and shape[0] != status.n_controlled):
        expected = [status.n_controlled, status.n_slopes]
        return wrong("matrix", f"{found}; by the status it should be {expected}")
    named = {status.cm_id for _, status in observer.statuses}
    if manifest.id not in named and named != {None}:
        return wrong("matrix", f"{found}; the status names {status.cm_id}")
    if manifest.system != context.keys.system:
        return wrong("matrix", f"{found}; its system is {manifest.system}")
    return fine("matrix", found)


def _law(observer: TelemetryObserver, context: TelemetryContext) -> CheckResult:
    laws, status = observer.loop.laws, observer.status
    reason = _explain_no_loop(observer, context)
    if reason or status is None:
        return skipped("law", reason)
    if not laws:
        reason = (
            "commands do not follow exactly from slopes (the mirror saturates, or something else "
            "moves it), or too few consecutive frames came"
        )
        return skipped("law", reason)
    last = laws[-1]
    found = (
        f"leak {last.leak:.4f}, gain {last.gain:.3g} times that of the status, delay "
        f"{last.delay_frames:.2f} frames"
    )
    # One wrong result alone may be a change of the loop that the status has not reported yet.
    if last.wrong and all(law.wrong for law in laws[-2:]):
        return wrong("law", last.wrong)
    expected = f"leak {status.leak:.4f}, delay {status.delay_frames:g} frames"
    return fine("law", f"{found}; by the status {expected}")


def _obedience(observer: TelemetryObserver, context: TelemetryContext) -> CheckResult:
    reason = _explain_no_loop(observer, context)
    results = observer.loop.obediences
    if reason or not results:
        return skipped("obedience", reason or "too few frames of one loop came")
    if any(not one.holds and not other.holds for one, other in pairwise(results)):
        worst = max(results, key=lambda result: int(result.disobeys.sum()))
        return wrong("obedience", worst.text)
    share = results[-1].share[np.isfinite(results[-1].share)]
    if not len(share):
        return skipped("obedience", "no mode was commanded to move")
    return fine(
        "obedience",
        f"{len(share)} modes make {share.min():.2f} to {share.max():.2f} of each commanded step",
    )


def _explain_no_loop(observer: TelemetryObserver, context: TelemetryContext) -> str:
    """Return the reason for which the loop cannot be judged; empty if it can."""
    status = observer.status
    if status is None:
        return "no status has come"
    if not status.in_loop:
        return "the loop is open"
    return "" if context.applied is not None else "the matrix in use is not known"


def _orientation(_: TelemetryObserver, context: TelemetryContext) -> CheckResult:
    convention = context.slope_convention
    if isinstance(convention, str):
        return skipped("orientation", convention)
    if convention.wrong:
        return wrong("orientation", convention.wrong)
    if convention.found is None:
        return skipped("orientation", "the matrix in use does not determine it")
    origin = "not set in the instrument file" if convention.adopted else "as in the instrument file"
    return fine("orientation", f"{format_setting(convention.found)} by the matrix in use: {origin}")


def _late_join(observer: TelemetryObserver, context: TelemetryContext) -> CheckResult:
    queries = [at_s for at_s, key in observer.queries if key == context.keys.current]
    if queries:
        return fine("late-join", f"cm/current was queried {len(queries)} time(s)")
    reason = "not queried, but once a session is enough: start the RTC after this program"
    return skipped("late-join", reason)


def _main_session(observer: TelemetryObserver) -> str | None:
    """Return the session of most batches; None if no batch came."""
    return next((session for session, _ in observer.sessions().most_common(1)), None)


_CHECKS: Final[tuple[Callable[[TelemetryObserver, TelemetryContext], CheckResult], ...]] = (
    _connection,
    _messages,
    _frames,
    _sizes,
    _numbers,
    _sequence,
    _clock,
    _delivery,
    _session,
    _status,
    _images,
    _ids,
    _matrix,
    _law,
    _obedience,
    _orientation,
    _late_join,
)
