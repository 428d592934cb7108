"""Random sequences of what strangers found, and whether the service ever makes a loop worse.

Run: ``python -m pyrcal_studies.campaign.strange_nights --seeds 0:1000 --output var/strange.jsonl``;
nights that are there already are not run again. In each night an RTC gets up to one mischief after
the other, the mirror jumps, the worker is slow, operators ask for anything at any time. A loop that
is beyond a micrometre for more than a second is played again with a service that only listens: what
it does not do there, the service has done.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal_studies.campaign.observatory import Latencies, Observatory
from pyrcal_studies.campaign.observatory_dome import Moment
from pyrcal_studies.campaign.rows import Row, RowFile, heading, line, range_of, tell
from pyrcal_studies.campaign.small import SETTINGS, SMALL, bench_of, latencies_of
from pyrcal_studies.campaign.strange_rtc import DIALECTS, Mischief, StrangeDome, StrangeLink
from service.config import load_settings
from service.errors import PyrcalError
from service.runtime.policy import policy_of
from service.tracking import commands as cmd
from service.tracking.events import Event
from service.tracking.products import MatrixState
from service.tracking.state import Mode
from service.wire import Acknowledgement, Loop, LoopRequest, Pattern

LIMIT_NM, LIMIT_S = 1000.0, 1.0
"""A loop beyond the first for longer than the second is not held any more."""

HEALTHY_NM = 300.0
"""A loop below it had no need to be opened."""

N_CONTROLLED = 45
_SEED = 20261122


@dataclass(frozen=True, slots=True, kw_only=True)
class Deed:
    """Something that happens in a night."""

    time_s: float
    name: str
    do: Callable[[StrangeNight], None]


class StrangeNight(Observatory):
    """A night whose RTC is up to something; ``telemetry_checks`` only: nothing is asked of it."""

    dome: StrangeDome

    def __init__(self, words: Sequence[str], latencies: Latencies, *, listening: bool) -> None:
        mode = Mode.HOLD if listening else Mode.AUTO
        dither = {"dither.enabled": not listening, "dither.longest_pause_s": 0.0}
        settings = {**SETTINGS, **dither}
        super().__init__(
            words,
            policy_of(load_settings(None, {}, settings)),
            mode,
            bench_of(words[0].removeprefix("--instrument=")),
            latencies=latencies,
            with_poles=False,
            dome=StrangeDome(words),
            link=StrangeLink,
        )
        self.listening = listening
        self.opened: list[float] = []
        """When the service opened a healthy loop that nobody had asked to be opened."""
        self.may_open = False
        self.sent_in_dialect = 0
        self._n_orders = 0

    def ask(self, command: cmd.Command) -> None:
        """Let an operator ask for something; a refusal is an answer, too."""
        if self.listening:
            return
        self.may_open |= isinstance(command, cmd.Acquire | cmd.SetLoop | cmd.Measure)
        try:
            self.command(command)
        except PyrcalError:
            return

    def play(self, deeds: Sequence[Deed], seconds: float) -> None:
        """Let the night pass and everything happen in it."""
        for deed in deeds:
            self._pass(deed.time_s)
            deed.do(self)
        self._pass(seconds)

    def _pass(self, until_s: float) -> None:
        while self.time_s < until_s - 1e-9:
            n_swaps = len(self.swaps)
            self.advance(0.1)
            if self.dome.mischief & DIALECTS:
                self.sent_in_dialect += len(self.swaps) - n_swaps
            for order in self.dome.orders[self._n_orders :]:
                opening = isinstance(order.what, LoopRequest) and order.what.loop is Loop.OPEN
                if opening and not self.may_open and self._residual_nm() < HEALTHY_NM:
                    self.opened.append(self.time_s)
            self._n_orders = len(self.dome.orders)

    def _residual_nm(self) -> float:
        closed = [m.wavefront_nm for m in self.dome.moments[-20:] if m.closed]
        return float(np.median(closed)) if closed else np.inf

    @override
    def _hear_status(self) -> None:
        if Mischief.NO_STATUS not in self.dome.mischief:
            super()._hear_status()

    @override
    def _hear(self, event: Event) -> None:
        told = isinstance(event, Acknowledgement)
        if not (told and Mischief.NO_ACK in self.dome.mischief):
            super()._hear(event)


def deeds_of(rng: np.random.Generator, seconds: float) -> list[Deed]:
    """Return what happens in a night, in its order."""
    deeds: list[Deed] = []
    for time_s in np.sort(rng.uniform(2.0, seconds - 5.0, rng.integers(4, 9))):
        kind = rng.choice(["dialect", "mischief", "order", "order", "restart"])
        match kind:
            case "dialect":
                spoken = rng.choice([*sorted(DIALECTS), "none"])
                deeds.append(_dialect(float(time_s), None if spoken == "none" else spoken))
            case "mischief":
                mischief = Mischief(rng.choice(sorted(set(Mischief) - DIALECTS)))
                lasts_s = float(rng.uniform(3.0, 15.0))
                deeds += _mischief(float(time_s), mischief, min(time_s + lasts_s, seconds - 0.5))
            case "restart":
                deeds.append(Deed(time_s=time_s, name="restart", do=StrangeNight.restart_rtc))
            case _:
                deeds.append(_order(float(time_s), rng))
    return sorted(deeds, key=lambda deed: deed.time_s)


def _dialect(time_s: float, spoken: str | None) -> Deed:
    def do(night: StrangeNight) -> None:
        night.dome.speak(None if spoken is None else Mischief(spoken))
        night.restart_rtc()

    return Deed(time_s=time_s, name=f"speaks {spoken or 'as agreed'}", do=do)


def _mischief(time_s: float, mischief: Mischief, end_s: float) -> list[Deed]:
    return [
        Deed(time_s=time_s, name=mischief, do=lambda night: night.dome.begin(mischief)),
        Deed(time_s=end_s, name=f"no {mischief}", do=lambda night: night.dome.end(mischief)),
    ]


def _order(time_s: float, rng: np.random.Generator) -> Deed:
    """Return an operator's order, any of them, to be given at any time."""
    number = int(time_s * 1000)
    plain: list[cmd.Command] = [
        cmd.Acquire(),
        cmd.AbortAcquisition(),
        cmd.Refit(),
        cmd.Rollback(),
        cmd.StartDither(),
        cmd.StopDither(),
        cmd.Ramp(),
        cmd.MeasureNoisy(id=f"noisy-{number}", duration_s=5.0),
        cmd.Measure(id=f"im-{number}", pattern=Pattern.PUSH_PULL_MODAL),
        cmd.SetLoop(loop="open"),
        cmd.SetLoop(loop="closed"),
        *(cmd.SetMode(mode=mode) for mode in Mode),
    ]
    k = int(rng.integers(len(plain) + 2))
    if k < len(plain):
        return Deed(time_s=time_s, name=str(plain[k]), do=lambda night: night.ask(plain[k]))
    return Deed(time_s=time_s, name="approve or publish", do=_approve)


def _approve(night: StrangeNight) -> None:
    """Approve the last proposal; without one send again whatever there is."""
    shelf = night.state.matrices.reconstructors
    proposed = [record.id for record in shelf if record.state is MatrixState.PROPOSED]
    if proposed:
        night.ask(cmd.Approve(id=proposed[-1]))
    elif shelf:
        night.ask(cmd.Publish(id=shelf[0].id))


def play(seed: int, instrument: str, seconds: float) -> Row:
    """Run one night, and again with a service that only listens if its loop was lost."""
    begun = time.process_time()
    night = _night(seed, instrument, seconds, listening=False)
    lost = beyond(night.dome.moments)
    blamed: list[tuple[float, float]] = []
    if lost:
        alone = beyond(_night(seed, instrument, seconds, listening=True).dome.moments)
        blamed = [span for span in lost if not any(_overlap(span, other) for other in alone)]
    return {
        "seed": seed,
        "seconds": seconds,
        "deeds": [(round(d.time_s, 2), d.name) for d in _plan(seed, instrument, seconds)[2]],
        "lost": lost,
        "blamed": blamed,
        "opened": night.opened,
        "sent_in_dialect": night.sent_in_dialect,
        "n_swaps": len(night.swaps),
        "worst_nm": max(m.wavefront_nm for m in night.dome.moments if m.closed),
        "alarms": sorted({name for glance in night.glances for name in glance.alarms}),
        "cpu_s": time.process_time() - begun,
    }


def beyond(moments: Sequence[Moment]) -> list[tuple[float, float]]:
    """Return when a closed loop was beyond the limit for too long: first and last second."""
    spans: list[tuple[float, float]] = []
    start_s: float | None = None
    for moment in moments:
        if moment.closed and moment.wavefront_nm > LIMIT_NM:
            start_s = moment.time_s if start_s is None else start_s
            continue
        if start_s is not None and moment.time_s - start_s > LIMIT_S:
            spans.append((start_s, moment.time_s))
        start_s = None
    if start_s is not None and moments[-1].time_s - start_s > LIMIT_S:
        spans.append((start_s, moments[-1].time_s))
    return spans


def _overlap(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one[0] < other[1] + LIMIT_S and other[0] < one[1] + LIMIT_S


def _plan(seed: int, instrument: str, seconds: float) -> tuple[list[str], Latencies, list[Deed]]:
    """Return the simulator's command line, how slow the worker is, and what happens."""
    rng = np.random.default_rng([_SEED, seed])
    words = [
        f"--instrument={instrument}",
        "--plant=linear",
        f"--n-controlled={N_CONTROLLED}",
        f"--seed={seed}",
        f"--mag={rng.choice([7.0, 9.0])}",
        f"--gain={rng.choice([0.3, 0.4, 0.5])}",
    ]
    x, y = rng.uniform(-0.15, 0.15, 2)
    turn, larger = rng.uniform(-0.4, 0.4), rng.uniform(-0.005, 0.005)
    words.append(f"--alpha={x:.3f},{y:.3f},{turn:.3f},{1 + larger:.4f}")
    for time_s in np.sort(rng.uniform(4.0, seconds, rng.integers(0, 3))):
        x, y = rng.uniform(-0.3, 0.3, 2)
        words.append(f"--jump={time_s:.2f}:{x:.3f},{y:.3f},{rng.uniform(-0.6, 0.6):.3f},0")
    slow = float(rng.choice([1.0, 1.0, 4.0]))
    return words, latencies_of(slow), deeds_of(rng, seconds)


def _night(seed: int, instrument: str, seconds: float, *, listening: bool) -> StrangeNight:
    words, latencies, deeds = _plan(seed, instrument, seconds)
    with threadpool_limits(1):
        night = StrangeNight(words, latencies, listening=listening)
        night.play(deeds, seconds)
    return night


def table(rows: Sequence[Row]) -> str:
    """Return the campaign as a Markdown table, and every night that went wrong."""
    wrong = [row for row in rows if row["blamed"] or row["opened"] or row["sent_in_dialect"]]
    text = heading(
        *("nights", "matrices sent", "loops beyond 1 um for 1 s", "of them the service's doing"),
        *("healthy loops opened", "matrices sent in a wrong dialect"),
    )
    text += line(
        *(len(rows), sum(row["n_swaps"] for row in rows)),
        *(sum(len(row[name]) for row in rows) for name in ("lost", "blamed", "opened")),
        sum(row["sent_in_dialect"] for row in rows),
    )
    return text + "\n" + "".join(f"- {json.dumps(row)}\n" for row in wrong)


def main() -> int:
    """Run what is missing, then print the table; 1 if the service has done harm."""
    given = _parser().parse_args()
    file = RowFile(given.output)
    done = {row["seed"] for row in file.rows}
    for seed in given.seeds:
        if seed not in done:
            file.add(play(seed, given.instrument, given.seconds))
    text = table(file.rows)
    tell(text, given.table, "python -m pyrcal_studies.campaign.strange_nights")
    return int(any(row["blamed"] for row in file.rows))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m pyrcal_studies.campaign.strange_nights",
        description="Plays RTCs that do not keep to the contract, and counts the loops lost.",
    )
    parser.add_argument("--output", type=Path, default=Path("strange.jsonl"), help="rows, resumed")
    parser.add_argument("--table", type=Path, metavar="FILE.md")
    parser.add_argument("--instrument", default=SMALL, metavar="NAME|FILE")
    parser.add_argument("--seeds", type=range_of, default=range(4), metavar="FIRST:END")
    parser.add_argument("--seconds", type=float, default=40.0, help="of each night")
    return parser


if __name__ == "__main__":
    sys.exit(main())
