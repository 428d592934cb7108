"""Faults of RTC, sensor and network, on a schedule.

``KIND@T[:ARGUMENTS]`` begins a fault at T seconds of loop time. The plan only knows what is to
happen when; those of the computer and of telemetry on its way are carried out here, those of
reconstructors in :mod:`sim_rtc.link.matrices`.
"""

from __future__ import annotations

import textwrap
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np
import structlog
from numpy.typing import NDArray
from typing_extensions import override

from pyrcal.rtc.identity import new_session
from service.wire import FrameHeader, Loop, LoopRequest, encode_frames
from sim_rtc.arguments import refusal
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.computer.telemetry import FrameClock, Pace

_log = structlog.get_logger("sim_rtc")
Array32 = NDArray[np.float32]


class FaultKind(StrEnum):
    """Kinds of faults."""

    LOST = "lost"
    LATE = "late"
    DUPLICATED = "duplicated"
    REORDERED = "reordered"
    NAN = "nan"
    FROZEN = "frozen"
    GARBAGE = "garbage"
    SHAPE = "shape"
    BASIS = "basis"
    SECOND = "second"
    CLOCK = "clock"
    STALL = "stall"
    PAUSE = "pause"
    RESTART = "restart"
    OPEN = "open"
    SATURATION = "saturation"
    REFUSE = "refuse"
    MUTE = "mute"
    DEAF = "deaf"
    LATE_SWAP = "late-swap"
    EARLY_ACK = "early-ack"
    TURNED_SIGN = "turned-sign"
    DITHER_LOST = "dither-lost"
    DITHER_LATE = "dither-late"
    MIRROR_SILENT = "mirror-silent"
    REFERENCES_SCALED = "references-scaled"
    REFERENCES_KEPT = "references-kept"


@dataclass(frozen=True, slots=True)
class Argument:
    """One number behind the colon."""

    name: str
    default: float
    low: float
    high: float


_FOREVER = 1e9
_SHARE: Final = Argument("SHARE", 1.0, 0.0, 1.0)
_SECONDS: Final = Argument("SECONDS", 1.0, 0.001, _FOREVER)
_HIDDEN: Final = Argument("HIDDEN", 0.0, 0.0, 1.0)
_DELAY: Final = Argument("DELAY", 0.3, 0.001, 60.0)

FORMS: Final[dict[FaultKind, tuple[tuple[Argument, ...], str]]] = {
    FaultKind.LOST: ((_SHARE, _SECONDS), "a share of the batches is never sent; 1 is a gap"),
    FaultKind.LATE: ((_DELAY, _SECONDS), "batches are sent DELAY seconds of loop time late"),
    FaultKind.DUPLICATED: ((_SHARE, _SECONDS), "a share of the batches is sent twice"),
    FaultKind.REORDERED: ((_SHARE, _SECONDS), "a share of the batches changes place with the next"),
    FaultKind.NAN: ((_SHARE, _SECONDS), "a share of the frames has a slope that is not a number"),
    FaultKind.FROZEN: ((_SECONDS,), "the slopes sent repeat; the loop itself goes on"),
    FaultKind.GARBAGE: (
        (_SHARE, _SECONDS),
        "a share of the batches is cut short or, every other one, has a nonsense header",
    ),
    FaultKind.SHAPE: ((_SECONDS,), "the last slope of every frame is missing, header included"),
    FaultKind.BASIS: ((_SECONDS,), "frames and status name another modal basis"),
    FaultKind.SECOND: ((_SECONDS,), "a second RTC sends a session of its own in between"),
    FaultKind.CLOCK: (
        (Argument("STEP", 0.5, -3600.0, 3600.0),),
        "timestamps step by STEP seconds, for good",
    ),
    FaultKind.STALL: ((_SECONDS,), "nothing for SECONDS of wall-clock time, then all in a burst"),
    FaultKind.PAUSE: ((_SECONDS,), "nothing for SECONDS; the sequence goes on, timestamps step"),
    FaultKind.RESTART: (
        (_SECONDS,),
        "gone for SECONDS; then a new session from frame 0 with the first matrix",
    ),
    FaultKind.OPEN: ((_SECONDS,), "the loop opens (a new session) and closes again"),
    FaultKind.SATURATION: (
        (Argument("STROKE_NM", 50.0, 1.0, 1e5), _SECONDS),
        "no mode gets more than STROKE_NM nanometres RMS",
    ),
    FaultKind.REFUSE: (
        (Argument("COUNT", 1.0, 1.0, 1e6),),
        "so many reconstructors are rejected, with a reason",
    ),
    FaultKind.MUTE: ((_SECONDS,), "reconstructors are applied and never acknowledged"),
    FaultKind.DEAF: ((_SECONDS,), "reconstructors are neither applied nor acknowledged"),
    FaultKind.LATE_SWAP: (
        (Argument("DELAY", 4.0, 0.001, 600.0), _SECONDS),
        "reconstructors are staged, and applied DELAY seconds later",
    ),
    FaultKind.EARLY_ACK: (
        (Argument("DELAY", 4.0, 0.001, 1e6), _SECONDS),
        "reconstructors are acknowledged as applied at once, and applied DELAY seconds later",
    ),
    FaultKind.TURNED_SIGN: ((_SECONDS,), "reconstructors are applied with the sign turned"),
    FaultKind.DITHER_LOST: ((_SECONDS,), "dithers are accepted and never reach the mirror"),
    FaultKind.DITHER_LATE: ((_DELAY, _SECONDS), "dithers begin DELAY after the announced frame"),
    FaultKind.MIRROR_SILENT: (
        (_SECONDS,),
        "dithers are in the telemetry and never reach the mirror",
    ),
    FaultKind.REFERENCES_SCALED: (
        (Argument("FACTOR", -1.0, -10.0, 10.0), _HIDDEN, _SECONDS),
        "reference offsets are applied times FACTOR; HIDDEN 1 reads back what was requested",
    ),
    FaultKind.REFERENCES_KEPT: (
        (_HIDDEN, _SECONDS),
        "reference offsets are accepted and named, and the old one stays",
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault of the schedule."""

    kind: FaultKind
    time_s: float
    """Start of the fault, seconds of loop time."""

    values: tuple[float, ...]
    """One for each argument of its form, defaults filled in."""

    def value(self, name: str) -> float:
        """Return an argument by name."""
        names = [argument.name for argument in FORMS[self.kind][0]]
        return self.values[names.index(name)]

    @property
    def end_s(self) -> float:
        """End, seconds; a fault without a duration lasts until the next of its kind."""
        names = [argument.name for argument in FORMS[self.kind][0]]
        return self.time_s + (self.value("SECONDS") if "SECONDS" in names else _FOREVER)

    @override
    def __str__(self) -> str:
        """Return the text it was read from, defaults filled in."""
        return f"{self.kind}@{self.time_s:g}:{','.join(f'{value:g}' for value in self.values)}"


class FaultPlan:
    """The faults of a run and the loop time; read by any thread, ``now_s`` set by the loop's."""

    def __init__(self, faults: tuple[Fault, ...] = ()) -> None:
        self.faults = tuple(sorted(faults, key=lambda fault: fault.time_s))
        self.now_s = 0.0
        """Loop time of the batch under way, seconds."""

    def active(self, kind: FaultKind, time_s: float | None = None) -> Fault | None:
        """Return the latest fault of a kind that lasts at ``time_s`` (None: now), or None."""
        at_s = self.now_s if time_s is None else time_s
        found = [f for f in self.faults if f.kind is kind and f.time_s <= at_s < f.end_s]
        return found[-1] if found else None


def read_fault(text: str) -> Fault:
    """Read a fault, ``KIND@T[:ARGUMENTS]``.

    Raises
    ------
    argparse.ArgumentTypeError
        If the kind is unknown or a number is missing its range; the text says what was expected.
    """
    name, _, rest = text.partition("@")
    if name not in FORMS:
        raise refusal(text, f"KIND@T[:ARGUMENTS] with KIND one of {', '.join(FORMS)}")
    kind = FaultKind(name)
    form = FORMS[kind][0]
    expected = f"{kind}@T[:{','.join(a.name for a in form)}], T >= 0 seconds"
    time_text, _, arguments = rest.partition(":")
    try:
        time_s = float(time_text)
        given = [float(part) for part in arguments.split(",")] if arguments else []
    except ValueError:
        raise refusal(text, expected) from None
    if not 0.0 <= time_s < _FOREVER or len(given) > len(form):
        raise refusal(text, expected)
    values = (*given, *(argument.default for argument in form[len(given) :]))
    for value, argument in zip(values, form, strict=True):
        if not argument.low <= value <= argument.high:
            raise refusal(text, f"{argument.name} from {argument.low:g} to {argument.high:g}")
    return Fault(kind=kind, time_s=time_s, values=values)


def manual() -> str:
    """Return the chapter of ``--help`` on faults."""
    lines = [
        "faults",
        "  --fault KIND@T[:ARGUMENTS], repeatable, begins at T seconds of loop time. Arguments, in",
        "  this order and with these defaults when left out:",
    ]
    for kind, (form, text) in FORMS.items():
        arguments = ",".join(f"{a.name}={a.default:g}" for a in form)
        head = f"    {kind + ' ' + arguments:<35}"
        lines += textwrap.wrap(text, 96, initial_indent=head, subsequent_indent=" " * 39)
    return "\n".join(lines) + "\n"


_NEVER_FRAMES = 2**40


class ComputerFaults:
    """Carries out the plan between two batches, in the loop's thread."""

    def __init__(
        self,
        plan: FaultPlan,
        target: RealTimeComputer,
        *,
        clock: FrameClock,
        pace: Pace,
        absence: Callable[[], AbstractContextManager[None]],
    ) -> None:
        """Take the parts.

        Parameters
        ----------
        plan
            What is to happen when.
        target
            The computer.
        clock, pace
            Of its frames.
        absence
            Context in which the RTC is not to be seen on the network.
        """
        self._plan = plan
        self._target = target
        self._clock = clock
        self._pace = pace
        self._absence = absence
        self._waiting = list(plan.faults)
        self._lasting: list[Fault] = []

    def before_batch(self, time_s: float, stopped: threading.Event) -> None:
        """Begin and end what is due at this loop time; a stall waits here."""
        self._plan.now_s = time_s
        # Ends come before beginnings, so that a fault that follows another of its kind is not ended
        # by it.
        while self._lasting and min(f.end_s for f in self._lasting) <= time_s:
            over = min(self._lasting, key=lambda fault: fault.end_s)
            self._lasting.remove(over)
            self._change(over, begins=False)
        while self._waiting and self._waiting[0].time_s <= time_s:
            fault = self._waiting.pop(0)
            _log.warning("fault", fault=str(fault), text="as asked for")
            self._lasting.append(fault)
            self._begin(fault, stopped)

    def _begin(self, fault: Fault, stopped: threading.Event) -> None:
        match fault.kind:
            case FaultKind.STALL:
                stopped.wait(fault.value("SECONDS"))
            case FaultKind.PAUSE:
                self._rest(fault.value("SECONDS"), stopped)
            case FaultKind.RESTART:
                self._restart(fault.value("SECONDS"), stopped)
            case FaultKind.CLOCK:
                self._clock.step(round(1e9 * fault.value("STEP")))
            case _:
                self._change(fault, begins=True)

    def _change(self, fault: Fault, *, begins: bool) -> None:
        """Begin or end what lasts."""
        match fault.kind:
            case FaultKind.OPEN:
                loop = Loop.OPEN if begins else Loop.CLOSED
                self._target.execute(LoopRequest(id=f"fault-{fault.kind}", loop=loop))
            case FaultKind.SATURATION:
                self._target.limit_stroke(1e-9 * fault.value("STROKE_NM") if begins else None)
            case FaultKind.DITHER_LOST:
                self._target.delay_dithers(_NEVER_FRAMES if begins else 0)
            case FaultKind.DITHER_LATE:
                n_frames = round(1e9 * fault.value("DELAY") / self._clock.dt_ns)
                self._target.delay_dithers(n_frames if begins else 0)
            case FaultKind.MIRROR_SILENT:
                self._target.hide_dithers(hidden=begins)
            case FaultKind.REFERENCES_SCALED | FaultKind.REFERENCES_KEPT:
                hidden = bool(fault.value("HIDDEN"))
                spoil = _spoil_references(fault) if begins else None
                self._target.spoil_references(spoil, hidden=hidden)
            case _:
                pass

    def _restart(self, seconds: float, stopped: threading.Event) -> None:
        with self._absence():
            self._rest(seconds, stopped)
            self._target.restart()
            self._clock.restart(time.time_ns())

    def _rest(self, seconds: float, stopped: threading.Event) -> None:
        """Do nothing, as a computer that hangs; no frame is made up for later."""
        stopped.wait(seconds)
        self._clock.step(round(1e9 * seconds))
        self._pace.forgive(seconds)


def _spoil_references(fault: Fault) -> Callable[[Array32, Array32], Array32]:
    """Return the offset that is applied, as a function of the present and the requested one."""
    if fault.kind is FaultKind.REFERENCES_KEPT:
        return lambda present, _: present
    factor = np.float32(fault.value("FACTOR"))
    return lambda _, requested: factor * requested


Sendable = tuple[bytes, bytes]
"""Payload and attachment of one batch."""

_OTHER_BASIS = "another-basis"
# 0xc1 is the one byte that msgpack never uses.
_NONSENSE = b"\xc1 no header of frames"


class WireFaults:
    """Turns each batch into the messages really sent, in order; for one thread."""

    def __init__(self, plan: FaultPlan, rng: np.random.Generator) -> None:
        self._plan = plan
        self._rng = rng
        self._held: list[tuple[float, Sendable]] = []
        """Batches that wait, and until when."""
        self._frozen: Array32 | None = None
        self._overtaken: list[Sendable] = []
        self._second_session = new_session()
        self._n_garbled = 0

    def messages(self, header: FrameHeader, rows: Array32, time_s: float) -> list[Sendable]:
        """Return the messages to send now: this batch or its damaged form, and held ones."""
        due = [message for due_s, message in self._held if due_s <= time_s]
        self._held = [held for held in self._held if held[0] > time_s]
        header, rows = self._damage_batch(header, rows, time_s)
        sent = due + self._on_the_way(
            self._garble_batch(encode_frames(header, rows), time_s), time_s
        )
        if self._plan.active(FaultKind.SECOND, time_s):
            other = replace(header, session=self._second_session)
            sent.append(encode_frames(other, rows))
        return sent

    def basis_id(self, basis_id: str, time_s: float) -> str:
        """Return the basis that frames and status name."""
        return _OTHER_BASIS if self._plan.active(FaultKind.BASIS, time_s) else basis_id

    def _damage_batch(
        self, header: FrameHeader, rows: Array32, time_s: float
    ) -> tuple[FrameHeader, Array32]:
        n_slopes = header.n_slopes
        if self._plan.active(FaultKind.FROZEN, time_s):
            if self._frozen is None:
                self._frozen = rows[-1, :n_slopes].copy()
            rows = np.hstack([np.tile(self._frozen, (header.n, 1)), rows[:, n_slopes:]])
        else:
            self._frozen = None
        fault = self._plan.active(FaultKind.NAN, time_s)
        if fault is not None:
            struck = self._rng.random(header.n) < fault.value("SHARE")
            # The rows are recorded and judged elsewhere: only what is sent is damaged.
            rows = rows.copy()
            rows[struck, self._rng.integers(n_slopes)] = np.nan
        if self._plan.active(FaultKind.SHAPE, time_s):
            rows = np.delete(rows, n_slopes - 1, axis=1)
            header = replace(header, n_slopes=n_slopes - 1)
        return replace(header, basis_id=self.basis_id(header.basis_id, time_s)), rows

    def _garble_batch(self, message: Sendable, time_s: float) -> Sendable:
        if not self._struck(FaultKind.GARBAGE, time_s):
            return message
        self._n_garbled += 1
        payload, attachment = message
        return (payload, _NONSENSE) if self._n_garbled % 2 else (payload[:-3], attachment)

    def _on_the_way(self, message: Sendable, time_s: float) -> list[Sendable]:
        """Return the messages in place of a batch, after one that it has overtaken."""
        late = self._plan.active(FaultKind.LATE, time_s)
        sent: list[Sendable] = []
        if self._struck(FaultKind.LOST, time_s):
            pass
        elif late is not None:
            self._held.append((time_s + late.value("DELAY"), message))
        else:
            sent = [message] * (2 if self._struck(FaultKind.DUPLICATED, time_s) else 1)
        if not self._overtaken and self._struck(FaultKind.REORDERED, time_s):
            self._overtaken = sent
            return []
        sent += self._overtaken
        self._overtaken = []
        return sent

    def _struck(self, kind: FaultKind, time_s: float) -> bool:
        fault = self._plan.active(kind, time_s)
        return fault is not None and bool(self._rng.random() < fault.value("SHARE"))
