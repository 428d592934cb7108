"""Golden nights in which the telescope, the RTC or the service is up to something."""

from __future__ import annotations

from pyrcal_studies.campaign.golden_deeds import (
    ABORT,
    ACQUIRE,
    CLOSE,
    REFIT,
    START,
    STOP,
    acknowledged,
    appear,
    approve,
    ask,
    begin,
    break_worker,
    cut,
    deaf,
    end,
    everything,
    hear,
    order,
    refuse,
    reject,
    restart,
    restart_rtc,
    slew,
    speak,
    trouble,
    vanish,
)
from pyrcal_studies.campaign.golden_night import Plan
from pyrcal_studies.campaign.strange_rtc import Mischief
from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.state import Level, Mode
from service.wire import AckState, DitherRequest, Loop, LoopRequest

FAR = ("--alpha=0.9,-0.6,3.0,1.02",)
"""Registrations that no window finds."""

SPARSE = {"dither.longest_pause_s": 6.0}
BEND = {"tracking.flexure_subap_per_degree": 0.01, "tracking.flexure_deg_per_degree": 0.01}
TRACKING = (
    Plan(name="steady", seconds=15.0),
    Plan(name="jump", seconds=18.0, words=("--jump=8.3:0.1,0,0,0",)),
    Plan(name="jump-rotation", seconds=18.0, words=("--jump=8.8:0,0,0.12,0",)),
    Plan(
        name="jump-and-back",
        seconds=20.0,
        words=("--jump=8.0:0.3,0.1,0,0", "--jump=9.1:-0.3,-0.1,0,0", "--jump=13.5:0.2,0.2,0.3,0"),
    ),
    Plan(name="drift", seconds=25.0, words=("--drift=0.4,-0.3,0.3,0.002",)),
    Plan(
        name="slew",
        seconds=24.0,
        settings=BEND,
        deeds=(*slew(60.0, 0.0, 1.0, 2), *slew(60.0, 2.0, 9.0, 6), *slew(72.0, 0.0, 16.0, 2)),
    ),
    Plan(
        name="faint", seconds=25.0, words=("--mag=12.5",), settings={"dither.longest_window_s": 5.0}
    ),
    Plan(name="pauses", seconds=60.0, settings=SPARSE, words=("--jump=41.0:0.1,0,0,0",)),
    Plan(
        name="vibrations",
        seconds=20.0,
        words=("--vibration=tilt:239:40", "--vibration=focus:47:15"),
        settings={"dither.avoid_hz": (283.0,)},
    ),
    Plan(name="slow-worker", seconds=30.0, slow=4.0, words=("--jump=14.0:0.2,0,0.2,0",)),
    Plan(
        name="seeing-gains",
        seconds=15.0,
        deeds=((3.0, begin(Mischief.SEEING_GAINS)),),
    ),
    Plan(
        name="more-modes",
        seconds=30.0,
        words=("--n-controlled=20",),
        settings={"control.n_modes_target": 80},
    ),
    Plan(
        name="modes-declined",
        seconds=30.0,
        words=("--n-controlled=30",),
        mode=Mode.PROPOSE,
        settings={"control.n_modes_target": 60},
        deeds=(
            (8.0, reject),
            (14.0, approve),
            (16.0, refuse(LoopRequest)),
            (20.0, approve),
            (23.0, refuse()),
            (26.0, ask(cmd.Refit(n_modes=80))),
        ),
    ),
)

ACQUIRING = (
    Plan(
        name="acquire-ordered",
        seconds=35.0,
        words=FAR,
        mode=Mode.PROPOSE,
        deeds=((2.0, ask(ACQUIRE)), *everything(3.0)),
    ),
    Plan(name="acquire-alone", seconds=45.0, words=FAR, settings={"acquisition.auto": True}),
    Plan(
        name="acquire-aborted",
        seconds=25.0,
        words=FAR,
        deeds=(
            (2.0, ask(ACQUIRE)),
            (5.0, ask(ABORT)),
            (7.0, ask(CLOSE)),
            (9.0, ask(ABORT)),
            (11.0, ask(ACQUIRE)),
            (13.0, ask(STOP)),
            (16.0, ask(ACQUIRE)),
            (17.0, ask(cmd.SetMode(mode=Mode.HOLD))),
            (18.0, ask(ABORT)),
            (20.0, ask(cmd.SetMode(mode=Mode.AUTO))),
        ),
    ),
    Plan(
        name="acquire-refused",
        seconds=25.0,
        words=FAR,
        deeds=(
            (2.0, refuse(LoopRequest)),
            (2.5, ask(ACQUIRE)),
            (5.0, refuse(DitherRequest)),
            (6.0, ask(ACQUIRE)),
            (18.0, refuse()),
            (19.0, ask(ACQUIRE)),
        ),
    ),
    Plan(
        name="acquire-cut-off",
        seconds=30.0,
        words=FAR,
        deeds=((2.0, ask(ACQUIRE)), (4.0, cut()), (8.0, cut(off=False)), (12.0, restart_rtc)),
    ),
    Plan(
        name="acquire-gap",
        seconds=40.0,
        words=FAR,
        settings={"acquisition.auto": True},
        deeds=((2.0, ask(ACQUIRE)), (5.0, vanish), (9.0, appear)),
    ),
    Plan(
        name="acquire-restart",
        seconds=40.0,
        words=FAR,
        settings={"acquisition.auto": True},
        deeds=((2.0, ask(ACQUIRE)), (6.0, restart())),
    ),
    Plan(
        name="acquire-restart-propose",
        seconds=25.0,
        words=FAR,
        mode=Mode.PROPOSE,
        deeds=(
            (2.0, ask(ACQUIRE)),
            (6.0, restart(Mode.PROPOSE)),
            (10.0, ask(CLOSE)),
            (16.0, restart(Mode.PROPOSE)),
        ),
    ),
    Plan(
        name="acquire-somebody-closes",
        seconds=30.0,
        words=FAR,
        deeds=(
            (2.0, ask(ACQUIRE)),
            (5.0, order(LoopRequest(id="other-1", loop=Loop.CLOSED))),
            (9.0, break_worker()),
            (16.0, break_worker("")),
        ),
    ),
    Plan(
        name="diverging",
        seconds=30.0,
        settings={"acquisition.auto": True},
        deeds=((7.0, order(LoopRequest(id="other-1", gains=(1.6,) * 45 + (0.0,) * 45))),),
    ),
)

FAULTS = (
    Plan(
        name="worker-broken",
        seconds=28.0,
        deeds=(
            (4.0, break_worker()),
            (10.0, break_worker("")),
            (14.0, break_worker()),
            (15.0, ask(REFIT)),
            (17.0, ask(cmd.Rollback())),
            (19.0, break_worker("")),
        ),
    ),
    Plan(
        name="no-acknowledgement",
        seconds=24.0,
        deeds=((3.0, begin(Mischief.NO_ACK)), (16.0, end(Mischief.NO_ACK)), (18.0, ask(REFIT))),
    ),
    Plan(
        name="not-applied",
        seconds=26.0,
        words=("--jump=13.0:0.1,0,0,0",),
        deeds=(
            (6.0, acknowledged(AckState.REJECTED, "range: it says")),
            (9.0, restart_rtc),
            (15.0, acknowledged(AckState.REJECTED, "it says")),
            (
                17.0,
                acknowledged(AckState.REJECTED, "what?", None),
            ),
            (
                18.0,
                acknowledged(AckState.APPLIED, "", "unknown"),
            ),
        ),
    ),
    Plan(
        name="other-sha",
        seconds=20.0,
        deeds=((3.0, begin(Mischief.OTHER_SHA)), (13.0, end(Mischief.OTHER_SHA))),
    ),
    Plan(
        name="no-cm-id",
        seconds=16.0,
        deeds=((0.1, begin(Mischief.NO_CM_ID)), (9.0, end(Mischief.NO_CM_ID))),
    ),
    Plan(
        name="strong-dither",
        seconds=24.0,
        deeds=((4.0, begin(Mischief.STRONG_DITHER)), (14.0, end(Mischief.STRONG_DITHER))),
    ),
    Plan(
        name="loop-law",
        seconds=34.0,
        deeds=(
            (3.0, begin(Mischief.LEAK)),
            (12.0, end(Mischief.LEAK)),
            (14.0, begin(Mischief.DELAY)),
            (22.0, end(Mischief.DELAY)),
            (24.0, begin(Mischief.GAIN)),
            (31.0, end(Mischief.GAIN)),
        ),
    ),
    Plan(name="sign", seconds=20.0, deeds=((0.5, speak(Mischief.SIGN)), (12.0, speak(None)))),
    Plan(name="flip", seconds=20.0, deeds=((5.0, speak(Mischief.FLIP_X)), (14.0, speak(None)))),
    Plan(
        name="nanometres",
        seconds=18.0,
        deeds=((5.0, speak(Mischief.NANOMETRES)), (12.0, speak(None))),
    ),
    Plan(
        name="rtc-restarts",
        seconds=26.0,
        words=("--jump=16.0:0.1,0,0,0",),
        deeds=(
            (7.0, restart_rtc),
            (14.0, restart_rtc),
            (14.2, vanish),
            (17.0, appear),
            (20.0, begin(Mischief.NO_STATUS)),
            (24.0, end(Mischief.NO_STATUS)),
        ),
    ),
    Plan(
        name="service-restarts",
        seconds=36.0,
        deeds=(
            (8.0, restart()),
            (14.0, ask(cmd.SetMode(mode=Mode.HOLD))),
            (15.0, ask(STOP)),
            (17.0, restart()),
            (22.0, ask(START)),
            (23.0, ask(cmd.SetMode(mode=Mode.AUTO))),
            (28.0, ask(cmd.SetMode(mode=Mode.HOLD))),
            (29.0, restart(Mode.PROPOSE)),
        ),
    ),
    Plan(
        name="second-service",
        seconds=24.0,
        deeds=(
            (6.0, hear(ev.ServicesMet(drives=False, others=("one on host a, process 1",)))),
            *everything(8.0, 0.05),
            (12.0, hear(ev.ServicesMet(drives=True, others=("one on b",)))),
            (16.0, hear(ev.ServicesMet(drives=True, others=()))),
        ),
    ),
    Plan(
        name="alarms",
        seconds=44.0,
        deeds=(
            (5.0, trouble("second-rtc")),
            (7.0, trouble("basis-mismatch")),
            (26.0, trouble("archive-failed")),
            (29.0, trouble("archive-failed", over=True)),
            (31.0, trouble("worker-behind")),
            (33.0, trouble("worker-behind", over=True)),
            (34.0, trouble("columns-misaligned")),
            (
                36.0,
                hear(ev.LogEvent(name="message.malformed", text="status: 3", level=Level.WARNING)),
            ),
            (
                36.5,
                hear(ev.LogEvent(name="message.malformed", text="status: 4", level=Level.WARNING)),
            ),
            (38.0, trouble("commands-off-loop")),
            (40.0, trouble("commands-off-loop", over=True)),
        ),
    ),
    Plan(name="deaf", seconds=30.0, deeds=((4.0, deaf()), (16.0, deaf(ears=True)))),
    Plan(
        name="dither-refused",
        seconds=34.0,
        deeds=(
            (0.1, refuse(DitherRequest)),
            (12.0, refuse()),
            (20.0, cut()),
            (26.0, cut(off=False)),
        ),
    ),
)
