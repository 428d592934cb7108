"""Observe REST and the truth file while the demo runs, and decide when it ends."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pyrcal.client.rest import RefusedError, Service, UnreachableError
from pyrcal.demo.children import Child
from pyrcal.demo.report import (
    MAX_SILENCE_S,
    MODEL,
    REAL_TIME,
    TOLERANCE_ACROSS_SUBAP,
    Circumstances,
    Report,
    View,
    make_report,
    waits,
)
from pyrcal.demo.truth import Line, TruthFile
from service.model.misregistration import PARAMETERS
from service.records.alarms import WORKER_BEHIND

POLL_S = 0.5
"""Time between two requests to the service, seconds."""

PRINT_PERIOD_S = 2.0
"""Time between two printed lines, seconds."""

HEADING_EVERY = 20
"""Printed lines between two headings."""

MAX_ANSWER_AGE_S = 1.5
"""Age beyond which an answer is not printed as current, seconds."""

REQUEST_TIMEOUT_S = 1.0
"""Timeout of a request, seconds."""

PREPARE_WITHIN_S = 180.0
"""Time limit of the preparation, seconds; a slow machine without a cache needs a third of it."""

LARGE_WITHIN_S = 1800.0
"""The same for a telescope of thousands of modes."""

USUAL_RATE_HZ = 1000.0
"""Frame rate of the simulated RTC, if the machine is fast enough."""

HOLD_S = 5.0
"""Time for which all criteria must be met before the demo ends by itself, seconds."""

MAX_STRETCH = 6.0
"""Longest duration over the requested one on a machine that does not keep real time."""

LARGE_STRETCH = 60.0
"""The same for a telescope of thousands of modes in slow motion."""

SLOW_STRETCH = 2.0
"""Longest telemetry over the requested one on a slow machine: a slow simulator indicates a slow
service."""

_TRUTH_PERIOD_S = 0.5
"""Loop time between two lines of the truth file, seconds. It may be one line ahead of the clock."""


class Stopwatch:
    """Seconds of telemetry since the end of preparation, including time without telemetry."""

    def __init__(self, now_s: float, telemetry_ns: int) -> None:
        self._start_s = self._now_s = self._grown_s = self._alive_s = now_s
        self._telemetry_ns = telemetry_ns
        self._idle_s = 0.0
        self.telemetry_s = 0.0
        """Simulated loop time, seconds."""

    def look(self, now_s: float, telemetry_ns: int, frames_grown_s: float | None = None) -> None:
        """Update wall clock and simulator clock; steps of the simulator clock are ignored.

        ``frames_grown_s`` is the wall-clock time of the last frame that the service received: in
        slow motion lines of the truth are far apart.
        """
        # Limited by the wall clock: a step of the simulator's clock is no telemetry.
        step_s = (telemetry_ns - self._telemetry_ns) / 1e9
        if step_s != 0.0:
            self.telemetry_s += min(max(step_s, 0.0), now_s - self._grown_s + _TRUTH_PERIOD_S)
            self._grown_s = now_s
        self._alive_s = max(self._grown_s, frames_grown_s or 0.0)
        if now_s - self._alive_s > MAX_SILENCE_S:
            self._idle_s += now_s - self._now_s
        self._now_s, self._telemetry_ns = now_s, telemetry_ns

    @property
    def wall_s(self) -> float:
        """Wall-clock time since the start, seconds."""
        return self._now_s - self._start_s

    @property
    def spent_s(self) -> float:
        """Seconds that count; the clock continues if the simulator stops."""
        # Telemetry, because a slow machine shall get as much of it as a fast one. Idle time: a
        # simulator that stopped must not keep the demo alive.
        return min(self.wall_s, self.telemetry_s + self._idle_s)

    @property
    def silent_s(self) -> float:
        """Time for which the simulator has written no truth, seconds."""
        return self._now_s - self._alive_s

    @property
    def pace(self) -> float | None:
        """Seconds of telemetry per second; None if it is too early."""
        return self.telemetry_s / self.wall_s if self.wall_s > MAX_SILENCE_S else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Promise:
    """Duration of the demo, and conditions to end it earlier."""

    seconds: float | None
    """Duration from the end of preparation, seconds; None to run until Ctrl-C."""

    whole: bool
    """True if the demo must last all the seconds, because of events at given times."""

    large: bool = False
    """True for thousands of modes: preparation takes minutes."""

    requested_rate_hz: float = USUAL_RATE_HZ
    """Requested frame rate of the simulator, Hz."""

    wanted_ratio: float = 1.0
    """Required ratio of the wavefront errors before and after."""

    across_subap: float = TOLERANCE_ACROSS_SUBAP
    """Subapertures across the pupil."""

    measured_plant: bool = False
    """True if the plant is a measured matrix, whose true registration is unknown."""


class TelemetryObserver:
    """Observer that polls REST and the truth file, and prints the progress."""

    def __init__(
        self,
        service: Service,
        truth: TruthFile,
        started: Sequence[Child],
        promise: Promise,
        say: Callable[[str], None],
    ) -> None:
        self._service = service
        self._truth = truth
        self._children = started
        self._promise = promise
        self._say = say
        self._state: View | None = None
        self._reconstructors: list[View] = []
        self._begun_s = self._answered_s = self._frames_grown_s = time.monotonic()
        self._frames = 0
        self._ready_s: float | None = None
        self._stopwatch: Stopwatch | None = None
        self._first_applied_s: float | None = None
        self._right_since_s: float | None = None
        self._behind = False
        self._shown_lines: set[str] = set()

    def run(self) -> None:
        """Wait for the preparation, then watch until all criteria are met or time is up."""
        if not self._wait_until_ready():
            return
        n_lines, next_line_s = 0, 0.0
        while not self._is_over():
            self._look()
            if time.monotonic() >= next_line_s:
                self._say_lines(n_lines)
                n_lines, next_line_s = n_lines + 1, time.monotonic() + PRINT_PERIOD_S
            time.sleep(POLL_S)

    def report(self, refusal: str | None = None) -> Report:
        """Return the current figures; ``refusal`` is that of the last window."""
        clock, now_s = self._stopwatch, time.monotonic()
        circumstances = Circumstances(
            seconds_to_ready=self._ready_s,
            seconds_to_first_applied=self._first_applied_s,
            pace=None if clock is None else clock.pace,
            unanswered_s=now_s - self._answered_s,
            frameless_s=0.0 if clock is None else now_s - self._frames_grown_s,
            silent_s=0.0 if clock is None else clock.silent_s,
            endings=self._endings(),
            wanted_ratio=self._promise.wanted_ratio,
            across_subap=self._promise.across_subap,
            measured_plant=self._promise.measured_plant,
            refusal=refusal,
        )
        return make_report(self._state, self._reconstructors, self._truth, circumstances)

    def make_final_report(self) -> Report:
        """Return the final figures, with the reason from the service's log if they failed."""
        self._truth.read()
        report = self.report()
        # The service is asked for its log only where a reason is needed.
        return report if report.good else self.report(self._last_refusal())

    def _last_refusal(self) -> str | None:
        try:
            log = self._service.get("/v1/events").document["log"]
        except (RefusedError, UnreachableError):
            return None
        return next((e["text"] for e in reversed(log) if e["name"] == "window.refused"), None)

    def _wait_until_ready(self) -> bool:
        """Wait for the model and the simulated telescope; return True if both are ready."""
        next_line_s = 0.0
        within_s = LARGE_WITHIN_S if self._promise.large else PREPARE_WITHIN_S
        while (waited_s := time.monotonic() - self._begun_s) < within_s:
            self._look()
            last = self._truth.last
            # A process that has ended will never be ready.
            if self._endings():
                return False
            # Both are needed: a large simulator is ready minutes after the service, or before it.
            if last is not None and self._state is not None and MODEL not in waits(self._state):
                self._ready_s = waited_s
                self._frames_grown_s = time.monotonic()
                self._stopwatch = Stopwatch(self._frames_grown_s, last["t_ns_utc"])
                self._say(f"{waited_s:7.1f}  ready: the clock starts\n")
                return True
            if waited_s >= next_line_s:
                self._say(f"{waited_s:7.1f}  preparing: {explain_waiting(self._state)}")
                next_line_s = waited_s + PRINT_PERIOD_S
            time.sleep(POLL_S)
        return False

    def _is_over(self) -> bool:
        clock, promise = self._stopwatch, self._promise
        if clock is None or promise.seconds is None:
            # Only the service's end ends it then: the truth file is followed across a restart of
            # the simulator.
            return any(child.name == "service" for child in self._children if child.ended)
        # The outcome must last, because an update just before may still turn out bad.
        right_s = 0.0 if self._right_since_s is None else clock.spent_s - self._right_since_s
        if self._endings() or (right_s >= HOLD_S and not promise.whole):
            return True
        # Once all is well no slowness has to be allowed for.
        patience = 1.0 if self._right_since_s is not None else self._time_factor(clock)
        over = clock.spent_s >= patience * promise.seconds
        stretch = LARGE_STRETCH if promise.large else MAX_STRETCH
        return over or clock.wall_s >= stretch * promise.seconds

    def _time_factor(self, clock: Stopwatch) -> float:
        """Return the factor on the requested seconds of telemetry for a slow machine."""
        if self._behind or self._promise.large:
            return MAX_STRETCH
        return SLOW_STRETCH if clock.pace is not None and clock.pace < REAL_TIME else 1.0

    def _look(self) -> None:
        self._truth.read()
        last = self._truth.last
        if self._stopwatch is not None and last is not None:
            self._stopwatch.look(time.monotonic(), last["t_ns_utc"], self._frames_grown_s)
        for ending in self._endings():
            self._say_once(f"         {ending}")
        try:
            state = self._service.get("/v1/state").document
            reconstructors = self._service.get("/v1/reconstructors").document["reconstructors"]
        except (RefusedError, UnreachableError):
            # The old answer stays for the report, but no success is counted on it.
            self._right_since_s = None
            return
        # Both or none: a state and reconstructors of different moments would contradict each other.
        self._state, self._reconstructors = state, reconstructors
        self._answered_s = time.monotonic()
        if self._stopwatch is not None:
            self._take_note(state, self._stopwatch)

    def _take_note(self, state: View, clock: Stopwatch) -> None:
        """Update frames, first applied matrix, and whether all criteria are met."""
        if state["link"]["frames_received"] != self._frames:
            self._frames = state["link"]["frames_received"]
            self._frames_grown_s = self._answered_s
        applied = any(r["applied_frame_seq"] is not None for r in self._reconstructors)
        if applied and self._first_applied_s is None:
            self._first_applied_s = clock.wall_s
        self._behind = any(alarm["name"] == WORKER_BEHIND for alarm in state["alarms"])
        if not self.report().good:
            self._right_since_s = None
        elif self._right_since_s is None:
            self._right_since_s = clock.spent_s

    def _say_lines(self, n_lines: int) -> None:
        if n_lines % HEADING_EVERY == 0:
            self._say(HEADING)
        clock, promise = self._stopwatch, self._promise
        pace = None if clock is None else clock.pace
        for line in (
            slow_line(pace, behind=self._behind),
            rate_line(self._state, promise.requested_rate_hz),
        ):
            if line is not None:
                self._say_once(line)
        seconds = 0.0 if clock is None else clock.wall_s
        silent_s = time.monotonic() - self._answered_s
        if silent_s > MAX_ANSWER_AGE_S:
            self._say(f"{seconds:7.1f}  no answer from the service for {silent_s:.0f} s")
        else:
            self._say(live_line(seconds, self._state, self._truth.last))

    def _endings(self) -> tuple[str, ...]:
        return tuple(ending for child in self._children if (ending := child.ended) is not None)

    def _say_once(self, line: str) -> None:
        if line not in self._shown_lines:
            self._shown_lines.add(line)
            self._say(line)


HEADING = (
    "   time   frames  lost |  shift x        shift y        rotation         magnification    |"
    "  age |   WFE  poles | matrix in use\n"
    "      s                |  subap          subap          deg                               |"
    "    s |    nm        |"
)

_FORMATS = {
    "shift_x_subap": "{:+.4f}±{:.4f}",
    "shift_y_subap": "{:+.4f}±{:.4f}",
    "rotation_deg": "{:+.4f}±{:.4f}",
    "magnification": "{:.5f}±{:.5f}",
}


def live_line(seconds: float, state: View | None, truth: Line | None) -> str:
    """Return one line of the running table."""
    if state is None:
        return f"{seconds:7.1f}  the service is starting"
    link, known = state["link"], state["registration"]
    # As wide as the four numbers, so that all columns stay below their headings.
    registration = " not known yet".ljust(66)
    age = "    -"
    if known is not None:
        cells = [
            _FORMATS[name].format(known["alpha"][name], known["sigma"][name]) for name in PARAMETERS
        ]
        registration = " {:14} {:14} {:16} {:18}".format(*cells)
        age = f"{known['age_s']:5.1f}"
    error = "    -" if truth is None else f"{truth['wavefront_error_nm']:5.0f}"
    margin = state["margin"]
    poles = "    -" if margin is None else f"{margin['worst_pole_radius']:.3f}"
    lost = link["frames_lost"]
    return (
        f"{seconds:7.1f} {link['frames_received']:8d} {lost:5d} |{registration}|{age} |"
        f" {error}  {poles} | {_matrix(state)}"
    )


def explain_waiting(state: View | None) -> str:
    """Return the reason why the clock has not started."""
    if state is None:
        return "the service is starting"
    if MODEL in (waited_for := waits(state)):
        return waited_for[MODEL]
    return "the simulated telescope is being prepared"


def rate_line(state: View | None, asked_hz: float = USUAL_RATE_HZ) -> str | None:
    """Return a line on a frame rate below the requested one, else None."""
    rtc = None if state is None else state["rtc"]
    if rtc is None or (held_hz := rtc["frame_rate_hz"]) >= asked_hz:
        return None
    return f"         simulated at {held_hz:g} Hz of {asked_hz:g}: what this machine holds"


def slow_line(pace: float | None, *, behind: bool) -> str | None:
    """Return a line if the demo takes longer than requested, else None."""
    if pace is not None and pace < REAL_TIME:
        return f"         the simulator runs at {pace:.1f} of real time; this takes longer"
    if behind:
        return "         the service's worker is behind; this takes longer"
    return None


def _matrix(state: View) -> str:
    alarms = " ".join([*(f"[{alarm['name']}]" for alarm in state["alarms"]), *_waits(state)])
    if not state["ready"]:
        return f"- {state['ready_reason']} {alarms}"
    if state["rtc"] is None:
        return f"- no RTC {alarms}"
    return f"{state['in_use'] or '-'} ({state['rtc']['n_controlled']} modes) {alarms}"


def _waits(state: View) -> list[str]:
    """Return the pending conditions that are not alarms."""
    known = {alarm["name"] for alarm in state["alarms"]}
    names = [wait["name"] for wait in state.get("waiting_for", ()) if wait["name"] not in known]
    return [f"waits for {', '.join(names)}"] if names else []
