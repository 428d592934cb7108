"""Checks that need telemetry alone, one function each."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from check_rtc.requirements import Checked, fine, seen, skipped, wrong
from check_rtc.watch import Arrival, TelemetryObserver, in_order, of_session
from service.estimation.orientation import setting_written
from service.estimation.slope_convention import SlopeConvention
from service.runtime.readiness import MAX_STATUSES_HZ
from service.wire import Keys, Manifest, Status

SLOWEST, FASTEST = 0.8, 1.1
"""Frames a second by the clock here, over those stated: a simulated RTC may be slower."""

MESSAGES_HZ: Final = (8.0, 120.0)
STATUSES_HZ: Final = (0.8, 12.0)

LATE_S: Final = 0.25
"""A batch that comes so much later than the one before lets expect is worth a look."""

TOO_LATE_S: Final = 0.5
"""The service holds frames back for no longer."""

FAR_NS: Final = 86_400 * 10**9
"""Between the RTC's clock and the one here."""


NOTABLE_PX: Final = 0.03
"""RMS displacement of pupil images that an instrument file should state: 0.05 pixel left out of the
model moves a fitted shift by 0.016 subaperture."""

SURE_SIGMA: Final = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImagePlaces:
    """Where the pupil images lie on the detector, beside their places on the pixel grid."""

    found_px: NDArray[np.float64]
    """``(4, 2)`` displacement x, y of the images at -x -y, +x -y, -x +y, +x +y, detector pixels in
    the RTC's axes; their mean is 0."""

    sigma_px: NDArray[np.float64]
    """``(4, 2)`` 1 σ of each."""

    stated_px: NDArray[np.float64] | None
    """``(4, 2)`` those of the instrument file, less their mean; None if it states none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class About:
    """Context of the telemetry: instrument, matrix, duration."""

    keys: Keys
    began_s: float
    """When listening began, on the clock of what was heard."""

    ended_s: float
    applied: Manifest | None = None
    """Of the matrix in use; None: it is not to be had."""

    not_applied: str = ""
    """Why not; empty: it is."""

    offered: bool = True
    """Whether anybody answers for it at all."""

    basis_id: str | None = None
    config_id: str | None = None
    """As the instrument file pins them; None: any."""

    dialect: SlopeConvention | str = ""
    """What the matrix says of signs and axes, or why nobody looked."""

    images: ImagePlaces | str = ""
    """Where the pupil images lie by the flux of the status, or why that is not known."""

    @property
    def span_s(self) -> float:
        """Duration of the telemetry, seconds."""
        return self.ended_s - self.began_s


def find_all(observer: TelemetryObserver, about: About) -> Iterator[Checked]:
    """Yield the finding of every check in the telemetry."""
    for look in _LOOKS:
        yield look(observer, about)


def _connection(observer: TelemetryObserver, _: About) -> Checked:
    came = [at_s for at_s, alive in observer.tokens if alive]
    gone = [at_s for at_s, alive in observer.tokens if not alive]
    if not came:
        return wrong("connection", "there is no token alive/rtc, though telemetry comes")
    if not gone:
        return fine("connection", "the token is there")
    if observer.tokens[-1][1]:
        away_s = came[-1] - gone[-1]
        return seen("connection", f"the token was gone for {away_s:.1f} s, and came back")
    return wrong("connection", "the token has gone")


def _messages(observer: TelemetryObserver, _: About) -> Checked:
    counts = Counter(refused.topic for refused in observer.refused)
    if not counts:
        n = len(observer.arrivals) + len(observer.statuses) + len(observer.acknowledgements)
        return fine("messages", f"{n} messages, each as its table says")
    which = ", ".join(f"{n} {topic}" for topic, n in counts.items())
    texts = dict.fromkeys(refused.text for refused in observer.refused)
    return wrong("messages", f"{which} cannot be read: {'; '.join(list(texts)[:3])}")


def _frames(observer: TelemetryObserver, _: About) -> Checked:
    arrivals = of_session(observer.arrivals, _chief_session(observer))
    if len(arrivals) < 3:
        return wrong("frames", f"{len(arrivals)} messages of frames have come")
    first, last = arrivals[0], arrivals[-1]
    span_s = max(last.at_s - first.at_s, 1e-3)
    rate_hz = _rate_hz(arrivals)
    messages_hz = (len(arrivals) - 1) / span_s
    nominal_hz = 1e9 / last.header.dt_ns
    found = (
        f"{rate_hz:.0f} frames a second in {messages_hz:.0f} messages of up to "
        f"{max(a.header.n for a in arrivals)}; dt_ns says {nominal_hz:.4g} Hz"
    )
    status = observer.status
    if status is not None and abs(status.frame_rate_hz / nominal_hz - 1.0) > 1e-3:
        return wrong("frames", f"{found}, the status {status.frame_rate_hz:.6g} Hz")
    if rate_hz > FASTEST * nominal_hz:
        return wrong("frames", found)
    if rate_hz < SLOWEST * nominal_hz:
        return seen("frames", f"{found}: it runs slower than it says")
    if not MESSAGES_HZ[0] <= messages_hz <= MESSAGES_HZ[1]:
        return seen("frames", found)
    if not last.recoverable:
        return seen("frames", f"{found}; a plain publisher: what is lost stays lost")
    return fine("frames", found)


def _rate_hz(arrivals: list[Arrival]) -> float:
    """Return frames a second: the median of some spans, for a loop may stand still in one.

    What had waited for somebody to listen comes in a burst at first.
    """
    later = arrivals[len(arrivals) // 4 :]
    n = max(len(later) // 3, 2)
    spans = [later[k : k + n] for k in range(0, len(later) - n + 1, n)]
    rates_hz = [
        (span[-1].stop_seq - span[0].stop_seq) / max(span[-1].at_s - span[0].at_s, 1e-3)
        for span in spans
    ]
    return float(np.median(rates_hz))


def _sizes(observer: TelemetryObserver, _: About) -> Checked:
    sizes = Counter((a.header.n_slopes, a.header.n_modes) for a in observer.arrivals)
    status = observer.status
    words = " and ".join(f"{slopes} slopes, {modes} modes" for slopes, modes in sizes)
    if status is not None and set(sizes) - {(status.n_slopes, status.n_modes)}:
        return wrong(
            "sizes", f"{words}; the status says {status.n_slopes} slopes, {status.n_modes} modes"
        )
    if len(sizes) > 1:
        return wrong("sizes", f"{words} in turn")
    return fine("sizes", words) if sizes else skipped("sizes", "no frame has come")


def _numbers(observer: TelemetryObserver, _: About) -> Checked:
    problems = []
    if observer.n_nonfinite:
        problems.append(f"{observer.n_nonfinite} frames with numbers that are not finite")
    if observer.n_frozen:
        problems.append(
            f"{observer.n_frozen} frames whose slopes repeat those before to the last bit"
        )
    if problems:
        return wrong("numbers", "; ".join(problems))
    return fine("numbers", f"all of {sum(a.header.n for a in observer.arrivals)} frames")


def _sequence(observer: TelemetryObserver, _: About) -> Checked:
    counts, over = Counter[str](), ""
    for session in observer.sessions():
        arrivals = of_session(observer.arrivals, session)
        over = over or _started_over(arrivals)
        head, known = arrivals[0].header.seq0, set[int]()
        for arrival in arrivals:
            seq0 = arrival.header.seq0
            if seq0 in known:
                counts["frames came twice"] += arrival.header.n
            elif seq0 < head:
                counts["overtaken"] += 1
            known.add(seq0)
            head = max(head, arrival.stop_seq)
        for before, after in pairwise(in_order(arrivals)):
            counts["frames are missing"] += max(after.header.seq0 - before.stop_seq, 0)
    overtaken = counts.pop("overtaken", 0)
    problems = [f"{n} {what}" for what, n in counts.items() if n] + ([over] if over else [])
    if problems:
        return wrong("sequence", "; ".join(problems))
    if overtaken:
        text = f"none is missing; {overtaken} messages were overtaken on their way"
        return seen("sequence", text)
    return fine("sequence", "each frame once, none missing")


def _started_over(arrivals: list[Arrival]) -> str:
    """Return where the sequence went back; empty: nowhere."""
    head, newest_ns, known = 0, 0, set[int]()
    for arrival in arrivals:
        header = arrival.header
        again = header.seq0 < head and header.t0_ns > newest_ns
        if again and header.seq0 not in known:
            return f"seq0 goes back from {head} to {header.seq0} in session {header.session}"
        known.add(header.seq0)
        head, newest_ns = max(head, arrival.stop_seq), max(newest_ns, header.t0_ns)
    return ""


def _steps(observer: TelemetryObserver) -> Iterator[tuple[Arrival, Arrival, float, float]]:
    """Yield neighbours, by how much the clock steps in between, and the time they waited, s."""
    for session in observer.sessions():
        for before, after in pairwise(in_order(of_session(observer.arrivals, session))):
            dt_ns = before.header.dt_ns
            n_frames = after.header.seq0 - before.header.seq0
            step_ns = after.header.t0_ns - before.header.t0_ns - n_frames * dt_ns
            since_s = after.at_s - before.at_s - (after.stop_seq - before.stop_seq) * dt_ns * 1e-9
            yield before, after, step_ns * 1e-9, since_s


def _clock(observer: TelemetryObserver, _: About) -> Checked:
    pauses: list[tuple[float, int]] = []
    steps: list[tuple[float, int]] = []
    for before, after, step_s, since_s in _steps(observer):
        if abs(step_s) <= before.header.dt_ns * 0.5e-9:
            continue
        waited = step_s > 0.0 and abs(since_s - step_s) < max(0.3 * step_s, 0.1)
        (pauses if waited else steps).append((step_s, after.header.seq0))
    if steps:
        step_s, seq = steps[0]
        return wrong(
            "clock", f"{len(steps)} steps, the first by {step_s:+.4g} s at frame {seq}, no pause"
        )
    if pauses:
        step_s, seq = pauses[0]
        return seen("clock", f"the loop stood still for {step_s:.2f} s before frame {seq}")
    if not observer.arrivals:
        return skipped("clock", "no frame has come")
    away_ns = observer.arrivals[-1].header.t0_ns - time.time_ns()
    if abs(away_ns) > FAR_NS:
        return seen("clock", f"it is {away_ns * 1e-9:+.3g} s from the clock here")
    return fine("clock", f"it goes on evenly, {away_ns * 1e-9:+.2g} s from the clock here")


def _delivery(observer: TelemetryObserver, _: About) -> Checked:
    """Judge by neighbours in the order of arrival: how late one is against the one before."""
    late, where = 0.0, 0
    for session in observer.sessions():
        for before, after in pairwise(of_session(observer.arrivals, session)):
            dt_s = before.header.dt_ns * 1e-9
            by_seq = (after.stop_seq - before.stop_seq) * dt_s
            by_clock = (after.header.t0_ns - before.header.t0_ns) * 1e-9
            excess = after.at_s - before.at_s - max(by_seq, by_clock, 0.0)
            if excess > late:
                late, where = excess, after.header.seq0
    found = f"at most {1e3 * late:.0f} ms later than the one before lets expect, frame {where}"
    if late > TOO_LATE_S:
        return wrong("delivery", found)
    return (seen if late > LATE_S else fine)("delivery", found)


def _session(observer: TelemetryObserver, _: About) -> Checked:
    runs = [observer.arrivals[0].header.session] if observer.arrivals else []
    for before, after in pairwise(observer.arrivals):
        if after.header.session != before.header.session:
            runs.append(after.header.session)
    if not runs:
        return skipped("session", "no frame has come")
    names = list(dict.fromkeys(runs))
    # stragglers of the session before may still come
    if len(runs) > len(names) + 1:
        return wrong(
            "session", f"{len(names)} sessions speak in turn ({', '.join(names[:3])}): two RTCs"
        )
    if len(names) > 1:
        return seen("session", f"{names[1]} began where {names[0]} ended: loop or RTC began anew")
    return fine("session", f"{names[0]} throughout")


def _status(observer: TelemetryObserver, about: About) -> Checked:
    status = observer.status
    if status is None:
        return wrong("status", f"none has come in {about.span_s:.0f} s")
    times_s = [at_s for at_s, _ in observer.statuses]
    rate_hz = (len(times_s) - 1) / max(times_s[-1] - times_s[0], 1.0)
    found = (
        f"{rate_hz:.1f} a second; loop {status.loop}, {status.n_controlled} of {status.n_modes} "
        f"modes, "
        f"matrix {status.cm_id}"
    )
    disagrees = _disagreement(observer, status)
    if disagrees:
        return wrong("status", f"{found}; {disagrees}")
    if rate_hz > MAX_STATUSES_HZ or rate_hz < STATUSES_HZ[0]:
        return wrong("status", found)
    if rate_hz > STATUSES_HZ[1] or not status.in_loop or status.cm_id is None:
        return seen("status", found)
    return fine("status", found)


def _disagreement(observer: TelemetryObserver, status: Status) -> str:
    """Return how the last status contradicts the frames, or itself; empty: it does not."""
    if status.loop == "closed" and not all(status.gains[: status.n_controlled]):
        return "it says a closed loop, and gains of 0 for modes that are controlled: partial"
    if status.loop != "open" and any(status.gains[status.n_controlled :]):
        return "it has gains for modes that are not controlled"
    at_s = observer.statuses[-1][0]
    of_it = [a for a in of_session(observer.arrivals, status.session) if a.at_s <= at_s]
    if not of_it:
        return f"no frame is of its session {status.session}" if observer.arrivals else ""
    latest = max(arrival.stop_seq for arrival in of_it) - 1
    reach = 2.0 * status.frame_rate_hz
    if status.seq is None or abs(status.seq - latest) > reach:
        return f"it has seq {status.seq}, the frames are at {latest}"
    if status.cm_id is not None and status.cm_id not in {a.header.cm_id for a in of_it[-20:]}:
        return f"the frames name matrix {of_it[-1].header.cm_id}"
    return ""


def _images(_: TelemetryObserver, about: About) -> Checked:
    places = about.images
    if isinstance(places, str):
        return skipped("images", places)
    stated = np.zeros((4, 2)) if places.stated_px is None else places.stated_px
    beside = places.found_px - stated
    rms_px, sigma_px = (float(np.sqrt(np.mean(part**2))) for part in (beside, places.sigma_px))
    where = "the pixel grid" if places.stated_px is None else "wfs.image_offsets_px"
    found = f"they lie {rms_px:.3f} pixel RMS beside {where}, 1 sigma {sigma_px:.3f}"
    if rms_px < max(NOTABLE_PX, SURE_SIGMA * sigma_px):
        return fine("images", found)
    offsets = ", ".join(f"[{x:.3f}, {y:.3f}]" for x, y in places.found_px)
    return seen("images", f"{found}: the instrument file may say image_offsets_px = [{offsets}]")


def _ids(observer: TelemetryObserver, about: About) -> Checked:
    found = dict.fromkeys((a.header.basis_id, a.header.config_id) for a in observer.arrivals)
    found |= dict.fromkeys((s.basis_id, s.config_id) for _, s in observer.statuses)
    if about.applied is not None:
        found |= {(about.applied.basis_id, about.applied.config_id): None}
    words = "; then ".join(f"basis {basis}, configuration {config}" for basis, config in found)
    if len(found) > 1:
        return wrong("ids", words)
    pinned = about.basis_id, about.config_id
    for pair in found:
        for name, expected in zip(pair, pinned, strict=True):
            if expected not in {None, name}:
                return wrong("ids", f"{words}; the instrument file expects {expected}")
    return fine("ids", words) if found else skipped("ids", "nothing has come")


def _matrix(observer: TelemetryObserver, about: About) -> Checked:
    manifest, status = about.applied, observer.status
    if manifest is None and not about.offered:
        why = "no answer on rtc/cm/applied: optional; without it ids are believed"
        return skipped("matrix", why)
    if manifest is None or status is None:
        return wrong("matrix", about.not_applied or "there is no status to compare it with")
    shape = manifest.layout.shape
    found = f"{manifest.id}, {list(shape)} in {manifest.layout.n_chunks} parts, its sum is right"
    if shape[1] != status.n_slopes or (status.in_loop and shape[0] != status.n_controlled):
        return wrong("matrix", f"{found}; the status says {[status.n_controlled, status.n_slopes]}")
    named = {status.cm_id for _, status in observer.statuses}
    if manifest.id not in named and named != {None}:
        return wrong("matrix", f"{found}; the status names {status.cm_id}")
    if manifest.system != about.keys.system:
        return wrong("matrix", f"{found}; its system is {manifest.system}")
    return fine("matrix", found)


def _law(observer: TelemetryObserver, about: About) -> Checked:
    laws, status = observer.loop.laws, observer.status
    why = _why_unjudged(observer, about)
    if why or status is None:
        return skipped("law", why)
    if not laws:
        why = (
            "the commands do not follow from the slopes to the last digit (a mirror that clips, "
            "something else played on it), or too few frames in a row have come"
        )
        return skipped("law", why)
    last = laws[-1]
    found = (
        f"leak {last.leak:.4f}, gain {last.gain:.3g} of the stated one, delay "
        f"{last.delay_frames:.2f} frames"
    )
    if last.wrong and all(law.wrong for law in laws[-2:]):
        return wrong("law", last.wrong)
    return fine("law", f"{found}; stated {status.leak:.4f} and {status.delay_frames:g} frames")


def _obedience(observer: TelemetryObserver, about: About) -> Checked:
    why = _why_unjudged(observer, about)
    verdicts = observer.loop.obediences
    if why or not verdicts:
        return skipped("obedience", why or "too few frames of one loop have come")
    if any(not one.holds and not other.holds for one, other in pairwise(verdicts)):
        worst = max(verdicts, key=lambda verdict: int(verdict.disobeys.sum()))
        return wrong("obedience", worst.text)
    share = verdicts[-1].share[np.isfinite(verdicts[-1].share)]
    if not len(share):
        return skipped("obedience", "no mode was asked to move")
    return fine(
        "obedience", f"{len(share)} modes take {share.min():.2f} to {share.max():.2f} of each step"
    )


def _why_unjudged(observer: TelemetryObserver, about: About) -> str:
    status = observer.status
    if status is None:
        return "no status has come"
    if not status.in_loop:
        return "the loop is open"
    return "" if about.applied is not None else "the matrix in use is not known"


def _orientation(_: TelemetryObserver, about: About) -> Checked:
    dialect = about.dialect
    if isinstance(dialect, str):
        return skipped("orientation", dialect)
    if dialect.wrong:
        return wrong("orientation", dialect.wrong)
    if dialect.found is None:
        return skipped("orientation", "the matrix in use does not show it")
    why = "the instrument file leaves it open" if dialect.adopted else "as in the file"
    found = f"by the matrix in use {setting_written(dialect.found)}: {why}"
    return fine("orientation", found)


def _late_join(observer: TelemetryObserver, about: About) -> Checked:
    asked = [at_s for at_s, key in observer.asked if key == about.keys.current]
    if asked:
        return fine("late-join", f"cm/current was asked {len(asked)} time(s)")
    why = "not asked meanwhile: once a session is enough; start the RTC after this to see it"
    return skipped("late-join", why)


def _chief_session(observer: TelemetryObserver) -> str | None:
    """Return the session of most batches."""
    return next((session for session, _ in observer.sessions().most_common(1)), None)


_LOOKS: Final[tuple[Callable[[TelemetryObserver, About], Checked], ...]] = (
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
