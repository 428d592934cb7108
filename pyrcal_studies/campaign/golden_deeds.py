"""What can happen in a golden night: to the RTC, to the service, and what operators ask."""

from __future__ import annotations

from collections.abc import Callable

from pyrcal_studies.campaign.golden_night import GoldenNight
from pyrcal_studies.campaign.strange_rtc import Mischief
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.commands import Command
from service.tracking.events import Event
from service.tracking.state import Mode
from service.wire import Acknowledgement, AckState, DitherKind, DitherRequest, Pattern
from service.wire import Command as Order

Do = Callable[[GoldenNight], None]
Deeds = tuple[tuple[float, Do], ...]


def ask(command: Command) -> Do:
    """Return an operator's command."""
    return lambda night: night.ask(command)


def hear(event: Event) -> Do:
    """Return something that is heard of."""
    return lambda night: night.post(event)


def order(command: Order) -> Do:
    """Return what somebody else orders of the RTC."""
    return lambda night: _ordered(night, command)


def trouble(name: str, text: str = "as it is said", *, over: bool = False) -> Do:
    """Return an alarm of the link, or its end."""
    return hear(ev.ConditionChanged(name=name, text=text, over=over))


def begin(mischief: Mischief) -> Do:
    """Return the beginning of a mischief."""
    return lambda night: night.dome.begin(mischief)


def end(mischief: Mischief) -> Do:
    """Return the end of one."""
    return lambda night: night.dome.end(mischief)


def speak(mischief: Mischief | None) -> Do:
    """Return an RTC's start in another dialect."""

    def start(night: GoldenNight) -> None:
        night.dome.speak(mischief)
        night.restart_rtc()

    return start


def refuse(*kinds: type[Order]) -> Do:
    """Return an RTC that refuses these; none: that refuses nothing any more."""
    return lambda night: setattr(night.dome, "refused", kinds)


def cut(*, off: bool = True) -> Do:
    """Return a link on which no answer comes."""
    return lambda night: setattr(night.dome, "unreachable", off)


def deaf(*, ears: bool = False) -> Do:
    """Return an RTC that accepts dithers and plays none."""
    return lambda night: setattr(night.dome, "deaf", not ears)


def break_worker(why: str = "the worker has ended") -> Do:
    """Return a worker that does no job; an empty reason: that does them again."""
    return lambda night: setattr(night.worker, "broken", why)


def restart(mode: Mode = Mode.AUTO) -> Do:
    """Return a restart of the service."""
    return lambda night: night.restart_service(mode)


def restart_rtc(night: GoldenNight) -> None:
    """Let the RTC start anew."""
    night.restart_rtc()


def vanish(night: GoldenNight) -> None:
    """Let the RTC be gone."""
    night.silent = True
    night.post(ev.RtcVanished())


def appear(night: GoldenNight) -> None:
    """Let it be there again."""
    night.silent = False
    night.post(ev.LogEvent(name="rtc.appeared", text="the RTC is there"))


def approve(night: GoldenNight) -> None:
    """Approve the last proposal."""
    night.ask(cmd.Approve(id=night.proposed()))


def reject(night: GoldenNight) -> None:
    """Reject it."""
    night.ask(cmd.Reject(id=night.proposed(), reason="not this one"))


def publish_first(night: GoldenNight) -> None:
    """Send the oldest reconstructor again."""
    night.ask(cmd.Publish(id=night.state.matrices.reconstructors[0].id))


def measured(night: GoldenNight) -> None:
    """Let the RTC's matrix come."""
    night.measured()


LAST = "last"


def acknowledged(state: AckState, reason: str, name: str | None = LAST) -> Do:
    """Return an answer of the RTC's to the last reconstructor, or another one."""

    def answer(night: GoldenNight) -> None:
        rtc, last = night.state.loop.rtc, night.state.matrices.reconstructors[-1].id
        acknowledgement = Acknowledgement(
            session="" if rtc is None else rtc.session,
            id=last if name == LAST else name,
            sha256=None,
            state=state,
            reason=reason,
            frame_seq=3 if state is AckState.APPLIED else None,
        )
        night.post(acknowledgement)

    return answer


def _ordered(night: GoldenNight, command: Order) -> None:
    night.dome.order(command)


def slew(first_deg: float, rate_deg_s: float, begin_s: float, seconds: float) -> Deeds:
    """Return a telescope that moves in elevation, told once a second."""
    return tuple(
        (
            begin_s + k,
            ask(cmd.SetPointing(elevation_deg=first_deg + k * rate_deg_s, azimuth_deg=30.0)),
        )
        for k in range(round(seconds))
    )


NOISY = 4.0
"""Seconds of a noisy matrix."""

CLOSE, OPEN = cmd.SetLoop(loop="closed"), cmd.SetLoop(loop="open")
STOP, START = cmd.StopDither(), cmd.StartDither()
ACQUIRE, ABORT, REFIT = cmd.Acquire(), cmd.AbortAcquisition(), cmd.Refit()
GROUPS = (cmd.ModeGroup(first=0, last=1), cmd.ModeGroup(first=2, last=44))
RAMP = cmd.Ramp(groups=GROUPS, gains=(0.3, 0.4), step_s=0.5)
MEASURE = cmd.Measure(id="im-1", pattern=Pattern.PUSH_PULL_MODAL, n_average=1)
SINE = cmd.Measure(id="im-2", pattern=Pattern.SINE, modes=(50, 52), duration_s=2.0)
EVERYTHING: tuple[Command, ...] = (
    REFIT,
    cmd.Rollback(),
    START,
    RAMP,
    MEASURE,
    SINE,
    ACQUIRE,
    CLOSE,
    cmd.SetLoop(leak=0.99),
    cmd.MeasureNoisy(id="noisy-late", duration_s=NOISY),
    cmd.GiveUp(id="im-1"),
    cmd.GiveUp(id="noisy-1"),
    ABORT,
    cmd.Approve(id="nobody"),
    cmd.Reject(id="nobody"),
    cmd.Publish(id="nobody"),
    cmd.SetPointing(elevation_deg=70.0, azimuth_deg=0.0),
)
"""One command of each kind; what ends things comes last."""


def everything(begin_s: float, step_s: float = 0.1, *, ending: bool = False) -> Deeds:
    """Return all commands one after the other; those that end things only where that is meant."""
    given = [c for c in EVERYTHING if ending or not isinstance(c, _ENDING)]
    return tuple((begin_s + k * step_s, ask(command)) for k, command in enumerate(given))


_ENDING = (cmd.GiveUp, cmd.AbortAcquisition)


def dither(name: str) -> DitherRequest:
    """Return a dither that somebody else asks for."""
    return DitherRequest(
        id=name,
        kind=DitherKind.SINE,
        modes=(60, 65),
        amplitude_m=(5e-9, 5e-9),
        frequency_hz=(210.0, 260.0),
        duration_s=20.0,
    )
