"""Random sequences of faults in simulated time, and what must hold after every step of them.

Run: ``python -m pyrcal_studies.campaign.fault_nights --seeds 0:144 --output var/nights.jsonl``;
nights that are there already are not run again. A night of ten minutes: the service is killed, its
machine's clock stepped, its worker lost or slow; the RTC starts anew, its link is cut or half open,
its clock leaps, frames are lost; another service stands before it; the mirror jumps; operators give
orders. Then the same night again with a service that only listens: what the wavefront would have
been without it.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal_studies.campaign.observatory import (
    SETTINGS,
    SMALL,
    Moment,
    Observatory,
    OwnHands,
    ShortLink,
    bench_of,
    latencies_of,
)
from pyrcal_studies.campaign.rows import (
    Row,
    campaign_parser,
    complete,
    heading,
    line,
    range_of,
    tell,
)
from service.archive import Archive
from service.config import load_settings
from service.errors import LinkError, PyrcalError
from service.estimation.frames import FrameBlock
from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import DitherPhase
from service.records.products import MatrixState
from service.records.state import (
    MatrixStates,
    Mode,
    OperatorState,
    ReferenceStates,
    TrackerState,
)
from service.runtime.archiving import (
    SAVE_INTERVAL_S,
    is_unsaved,
    is_urgent,
    leave,
    restore_tracking,
)
from service.runtime.losses import silence
from service.runtime.policy import policy_of
from service.tracking.invariants import find_violations
from service.tracking.operations.running import OperationKind, running_operations
from service.tracking.policy import SECOND_NS
from service.tracking.resume import restored, restored_references
from service.wire import Acknowledgement, Command, Manifest, Reply

STEP_S = 0.25
"""From one look at what must hold to the next."""

LOOK_S = 1.0
"""From one look of the service at its link to the next."""

STALE_S = 3.0
"""Without telemetry for so long, nothing may be sent."""

AGREE_S = 3.0
"""In which service and RTC agree on the matrix in use, once they hear each other."""

SILENT_S = 30.0
"""Without a window for so long, something must say why."""

HARM, HARM_S = 1.10, 5.0
"""The wavefront may be so many times worse than without the service, for so long at most."""

LEAST_NM = 20.0
"""Below it a wavefront is as good as any."""

WIND_M = 0.012
"""What the air moves from a frame to the next: at a lower rate the wind is as much slower. Gains of
0.4 would leave a radian of wavefront else, and a matrix that reads too much would do better."""

MISSING = 0.045
"""Share of frames that are lost at random: a tenth less than a window may lack."""

_OWNERS = {
    OperationKind.MEASURING,
    OperationKind.GATHERING,
    OperationKind.RAMPING,
    OperationKind.ACQUIRING,
}
_SEED = 20261126


DOWN_S = 3.0
"""From the end of a service until the next one listens."""


def _opened(folder: Path) -> Archive:
    archive = Archive(folder)
    archive.open()
    return archive


class CutLink(ShortLink):
    """The way to the RTC and back, which may be cut; ``watch`` is told of all that is sent."""

    cut = False
    watch: Callable[[Manifest], None]

    @override
    async def command(self, command: Command) -> Reply:
        """Return the RTC's answer, or raise LinkError: none comes."""
        if self.cut:
            raise LinkError("the RTC did not answer within 2 s")
        return await super().command(command)

    @override
    async def publish(self, manifest: Manifest, matrix: NDArray[np.float32]) -> None:
        """Put a matrix on its way, where there is one."""
        self.watch(manifest)
        if not self.cut:
            await super().publish(manifest, matrix)

    @override
    async def fetch_applied(self) -> tuple[Manifest, NDArray[np.float32]]:
        """Return the matrix the RTC uses, or raise LinkError: no answer comes."""
        if self.cut:
            raise LinkError("the RTC did not answer within 2 s")
        return await super().fetch_applied()


class FaultNight(Observatory):
    """A night of faults; what does not hold is in ``broken``.

    The service keeps its state in ``folder``; after a kill another service continues from there.
    """

    _link: CutLink

    def __init__(self, words: Sequence[str], folder: Path, seed: int, *, listening: bool) -> None:
        settings = {**SETTINGS, "dither.enabled": not listening}
        self._policy = policy_of(load_settings(None, {}, settings))
        self._mode = Mode.HOLD if listening else Mode.AUTO
        self._folder, self._archive = folder, _opened(folder)
        self._saved: TrackerState | None = None
        self._saved_s = 0.0
        self.broken: list[str] = []
        self.listening = listening
        self.clock_ns = 0
        """The service's clock before the true time."""

        self.burst = self.gaps = False
        self.stands_by = False
        """Another service drives the RTC."""

        self.told: Mode | None = None
        """What an operator has ordered last."""

        self._rng = np.random.default_rng([_SEED, seed, 1])
        self._heard_s = self._agreed_s = self._window_s = 0.0
        self._n_accepted = 0
        self.n_windows = 0
        """Taken in, of all services."""

        super().__init__(
            words,
            self._policy,
            self._mode,
            bench_of(words[0].removeprefix("--instrument=")),
            latencies=latencies_of(),
            with_poles=False,
            link=CutLink,
            archive=self._archive,
        )
        self._link.watch = self._sent
        self._looked_s = 0.0

    def kill(self) -> None:
        """End the service as ``kill -9`` does; another takes up what is on the disk.

        What was on its way to the RTC arrives; telescope and RTC go on.
        """
        self._arrive()
        self._agenda.clear()
        self._idle_worker()
        self._archive.close()
        begun_s = self.time_s + DOWN_S
        while self.time_s < begun_s:
            self.dome.play()
            for _ in self._link.swapped():
                self._note_swap()
        self._archive = self._shelf = _opened(self._folder)
        self._actions = self._new_actions()
        state = TrackerState(
            system=self.state.system,
            operator=OperatorState(mode=self._mode),
            matrices=MatrixStates(reconstructors=restored(self._archive.reconstructors.records())),
            references=ReferenceStates(
                records=restored_references(self._archive.references.records())
            ),
        )
        self._engine.state = restore_tracking(self._archive, state, self._policy, self.now_ns())
        self._engine.begin_anew()
        self._begin()

    def close(self) -> None:
        """Close the archive."""
        self._archive.close()

    @override
    def stepped(self, before: TrackerState, event: ev.Event) -> None:
        """Keep what the tracker heard, and write what the service would."""
        super().stepped(before, event)
        records = self.state.matrices.reconstructors
        if records is not before.matrices.reconstructors:
            old = {record.id: record for record in before.matrices.reconstructors}
            news = tuple(record for record in records if old.get(record.id) is not record)
            self._archive.record(news, (), ())

    def save(self) -> None:
        """Write what the next service needs as seldom as the service does."""
        state = self.state
        before, due = self._saved, self.time_s >= self._saved_s + SAVE_INTERVAL_S
        if before is None or ((due or is_urgent(before, state)) and is_unsaved(before, state)):
            leave(self._archive, state, self.now_ns())
            self._saved, self._saved_s = state, self.time_s

    @override
    def now_ns(self) -> int:
        """Return the time by the service's clock, nanoseconds UTC."""
        return super().now_ns() + self.clock_ns

    @override
    def advance(self, seconds: float) -> None:
        """Let so much time pass; a cut link brings nothing."""
        until_s = self.time_s + seconds
        while self.time_s < until_s - 1e-9:
            blocks = self.dome.play()
            self._happen()
            if not self._link.cut:
                arrived = list(self._arriving(blocks))
                if arrived:
                    self._heard_s = self.time_s
                self._engine.feed(arrived)
            self._acknowledged()
            if self.time_s >= self._looked_s + LOOK_S:
                self._looked_s = self.time_s
                self._miss_frames()

    def _miss_frames(self) -> None:
        """Complain of frames that stay away, as the service does of its link."""
        (name, text) = next(iter(silence(self.state.loop.rtc, self.time_s - self._heard_s).items()))
        if text or self.state.alarm(name) is not None:
            self._hear(ev.ConditionChanged(name=name, text=text or "over", over=not text))

    def _arriving(self, blocks: list[FrameBlock]) -> Iterator[FrameBlock]:
        if self.burst:
            return
        for block in blocks:
            if self.gaps:
                yield from _runs(block, self._rng.random(block.n_frames) >= MISSING)
            else:
                yield block

    @override
    def _hear(self, event: ev.Event) -> None:
        if self._link.cut and isinstance(event, Acknowledgement):
            return
        super()._hear(event)

    @override
    def _hear_status(self) -> None:
        if not self._link.cut:
            super()._hear_status()

    def order(self, command: cmd.Command) -> None:
        """Let an operator ask for something; a refusal is an answer, too."""
        if self.listening:
            return
        with suppress(PyrcalError):
            self.command(command)
            if isinstance(command, cmd.SetMode):
                self.told = Mode(command.mode)

    def cut(self, *, seen: bool) -> None:
        """Cut the link; ``seen``: the RTC's liveliness goes with it, else it is half open."""
        self._link.cut = True
        if seen:
            self._hear(ev.RtcVanished())

    def join(self) -> None:
        """Mend the link."""
        self._link.cut = False
        self._heard_s = self._agreed_s = self.time_s
        self._hear(ev.LogEvent(name="rtc.appeared", text="the RTC is there"))

    def meet(self, *, stands_by: bool) -> None:
        """Let the service hear of another one, which drives the RTC, or that it has gone."""
        self.stands_by = stands_by
        others = ("another service",) if stands_by else ()
        self._hear(ev.ServicesMet(drives=not stands_by, others=others))

    @property
    def worker(self) -> OwnHands:
        """What computes for the service."""
        return self._workers

    def kill_with_clock(self, seconds: float) -> None:
        """Kill the service; its machine's clock is stepped before it is begun again."""
        self.clock_ns += round(seconds * SECOND_NS)
        self.kill_and_look()

    def kill_and_look(self) -> None:
        """Kill the service, and look whether what it had said is found again."""
        self.save()
        kept = {record.id: record for record in self.state.matrices.reconstructors}
        used = {MatrixState.APPLIED, MatrixState.SUPERSEDED}
        self.kill()
        self.meet(stands_by=self.stands_by)
        if self._link.cut:
            self._hear(ev.RtcVanished())
        self._heard_s = self._agreed_s = self._window_s = self.time_s
        found = {record.id: record for record in self.state.matrices.reconstructors}
        for name, record in kept.items():
            if record.state not in used or record.gate is None:
                continue
            if name not in found:
                self._wrong(f"{name} is gone after a kill")
            try:
                self._actions.matrix(name)
            except PyrcalError as error:
                self._wrong(f"{name} cannot be read after a kill: {error}")
        if self.told is not None and self.state.operator.mode is not self.told:
            self._wrong(f"mode {self.state.operator.mode} after a kill, ordered was {self.told}")
        if any(self._folder.rglob("*.part")):
            self._wrong("half a file is left after a kill")

    def play(self, deeds: Sequence[Deed], seconds: float) -> None:
        """Let the night pass and everything happen in it."""
        for deed in (*deeds, Deed(time_s=seconds, name="end", do=lambda _: None)):
            while self.time_s < deed.time_s - 1e-9:
                self.advance(STEP_S)
                self.save()
                self._look_around()
            deed.do(self)

    def _look_around(self) -> None:
        """See whether all holds that must."""
        state, now_s = self.state, self.time_s
        running = running_operations(state, self.now_ns())
        owners = [one.text for one in running if one.kind in _OWNERS]
        if len(owners) > 1:
            self._wrong(f"two have the loop: {owners}")
        for violation in find_violations(state):
            self._wrong(violation)
        rtc_has = self.dome.computer.reconstructor.manifest.id
        agreed = state.matrices.in_use == rtc_has or (
            state.matrices.in_use is None and self.stands_by  # it asks nothing: not known
        )
        if self._link.cut or state.loop.rtc is None or agreed:
            self._agreed_s = now_s
        elif now_s - self._agreed_s > AGREE_S:
            self._wrong(f"{state.matrices.in_use} is said to be in use, the RTC has {rtc_has}")
        news = max(state.windows.accepted - self._n_accepted, 0)
        self._n_accepted, self.n_windows = state.windows.accepted, self.n_windows + news
        if news or self._reason_for_silence():
            self._window_s = now_s
        elif now_s - self._window_s > SILENT_S:
            self._wrong(f"no window for {SILENT_S:g} s and nothing says why")

    def _reason_for_silence(self) -> bool:
        state, policy = self.state, self.state.dithers.policy
        rests = policy.phase in {DitherPhase.OFF, DitherPhase.SPARSE, DitherPhase.OPERATOR}
        busy = any(one.kind in _OWNERS for one in running_operations(state, self.now_ns()))
        return bool(state.alarms.active) or busy or (rests and bool(policy.reason))

    def _sent(self, manifest: Manifest) -> None:
        """Look at a matrix as it leaves."""
        record = self.state.reconstructor(manifest.id)
        if self.listening:
            self._wrong(f"{manifest.id} was sent in hold")
        if record is None or record.gate is None or not record.gate.accepted:
            self._wrong(f"{manifest.id} was sent and the gate has not accepted it")
        if self.time_s - self._heard_s > STALE_S:
            self._wrong(f"{manifest.id} was sent {self.time_s - self._heard_s:.1f} s after a frame")
        if self.stands_by:
            self._wrong(f"{manifest.id} was sent by one that stands by")

    def _wrong(self, text: str) -> None:
        if not self.broken or self.broken[-1].partition(": ")[2] != text:
            self.broken.append(f"{self.time_s:.1f} s: {text}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Deed:
    """Something that happens in a night."""

    time_s: float
    name: str
    do: Callable[[FaultNight], None]


Act = Callable[[FaultNight], None]


def _set(name: str, *, to: bool) -> Act:
    return lambda night: setattr(night, name, to)


def _worker(text: str) -> Act:
    def do(night: FaultNight) -> None:
        night.worker.broken = text

    return do


def _slow(slower: float) -> Act:
    def do(night: FaultNight) -> None:
        night.latencies = latencies_of(slower)

    return do


def _stepped(seconds: float) -> Act:
    return lambda night: night.dome.step_clock(round(seconds * SECOND_NS))


LASTING: dict[str, tuple[Act, Act]] = {
    "link cut": (lambda night: night.cut(seen=True), FaultNight.join),
    "link half open": (lambda night: night.cut(seen=False), FaultNight.join),
    "frames lost": (_set("gaps", to=True), _set("gaps", to=False)),
    "no frames": (_set("burst", to=True), _set("burst", to=False)),
    "worker lost": (_worker("the worker was killed"), _worker("")),
    "worker slow": (_slow(4.0), _slow(1.0)),
    "another service": (
        lambda night: night.meet(stands_by=True),
        lambda night: night.meet(stands_by=False),
    ),
}
"""What begins and ends."""

AT_ONCE: dict[str, Act] = {
    "service killed": FaultNight.kill_and_look,
    "RTC restarted": lambda night: night.restart_rtc(),
    "RTC's clock +1 h": _stepped(3600.0),
    "RTC's clock -10 s": _stepped(-10.0),
    "killed, clock +1 h": lambda night: night.kill_with_clock(3600.0),
    "killed, clock -30 s": lambda night: night.kill_with_clock(-30.0),
}

ORDERS: tuple[cmd.Command, ...] = (
    *(cmd.SetMode(mode=mode) for mode in Mode),
    cmd.Refit(),
    cmd.StopDither(),
    cmd.StartDither(),
)
"""Of operators; none that opens the loop or asks for another matrix than the service would."""


def deeds_of(rng: np.random.Generator, seconds: float) -> list[Deed]:
    """Return what happens in a night: one thing every ten seconds, nothing at its end."""
    deeds: list[Deed] = []
    kinds = [*LASTING, *AT_ONCE, "order", "order"]
    for time_s in np.sort(rng.uniform(5.0, seconds - 40.0, max(round(seconds / 10.0), 3))):
        name = kinds[int(rng.integers(len(kinds)))]
        if name in LASTING:
            begin, end = LASTING[name]
            end_s = float(time_s + rng.uniform(1.0, 30.0))
            deeds.append(Deed(time_s=float(time_s), name=name, do=begin))
            deeds.append(Deed(time_s=end_s, name=f"no {name}", do=end))
        elif name in AT_ONCE:
            deeds.append(Deed(time_s=float(time_s), name=name, do=AT_ONCE[name]))
        else:
            deeds.append(_order(float(time_s), ORDERS[int(rng.integers(len(ORDERS)))]))
    deeds.append(_order(seconds - 9.0, cmd.SetMode(mode=Mode.AUTO)))
    return sorted(deeds, key=lambda deed: deed.time_s)


def _order(time_s: float, order: cmd.Command) -> Deed:
    return Deed(time_s=time_s, name=str(order), do=lambda night: night.order(order))


def worse(moments: Sequence[Moment], without: Sequence[Moment]) -> list[tuple[float, float]]:
    """Return when the wavefront was worse than without the service for too long: first, last s.

    Of seconds; one in which either loop was open does not count.
    """
    ours, theirs = _by_second(moments), _by_second(without)
    spans: list[tuple[float, float]] = []
    begun: int | None = None
    for second in sorted(ours):
        there = theirs.get(second)
        bad = there is not None and ours[second] > HARM * max(there, LEAST_NM)
        if bad:
            begun = second if begun is None else begun
        if begun is not None and (not bad or second == max(ours)):
            end = second + bad
            if end - begun > HARM_S:
                spans.append((float(begun), float(end)))
            begun = None
    return spans


def _by_second(moments: Sequence[Moment]) -> dict[int, float]:
    squares: dict[int, list[float]] = {}
    for moment in moments:
        if moment.closed:
            squares.setdefault(int(moment.time_s), []).append(moment.wavefront_nm**2)
    return {second: float(np.sqrt(np.mean(values))) for second, values in squares.items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Night:
    """One night; two that are equal give the same row."""

    seed: int = 0
    instrument: str = SMALL
    plant: str = "linear"
    rate_hz: float = 1000.0
    seconds: float = 600.0


def _words(rng: np.random.Generator, what: Night) -> list[str]:
    x, y = rng.uniform(-0.1, 0.1, 2)
    words = [
        f"--instrument={what.instrument}",
        f"--plant={what.plant}",
        f"--rate={what.rate_hz:g}",
        f"--wind={WIND_M * what.rate_hz:g},35",
        "--n-controlled=45",
        f"--seed={what.seed}",
        "--mag=7",
        f"--alpha={x:.3f},{y:.3f},{rng.uniform(-0.3, 0.3):.3f},1.002",
    ]
    for time_s in np.sort(rng.uniform(20.0, what.seconds, round(what.seconds / 200.0))):
        x, y = rng.uniform(-0.2, 0.2, 2)
        words.append(f"--jump={time_s:.2f}:{x:.3f},{y:.3f},{rng.uniform(-0.5, 0.5):.3f},0")
    return words


def play(what: Night) -> Row:
    """Play one night, and the same with a service that only listens."""
    begun = time.process_time()
    rng = np.random.default_rng([_SEED, what.seed])
    words = _words(rng, what)
    deeds = deeds_of(rng, what.seconds)

    def night_of(*, listening: bool) -> FaultNight:
        """Play the night; its archive is gone afterwards."""
        with threadpool_limits(1), tempfile.TemporaryDirectory(prefix="fault-night-") as folder:
            night = FaultNight(words, Path(folder), what.seed, listening=listening)
            night.play(deeds, what.seconds)
            night.close()
        return night

    night, alone = night_of(listening=False), night_of(listening=True)
    moments = night.dome.moments
    return asdict(what) | {
        "deeds": [(round(deed.time_s, 2), deed.name) for deed in deeds],
        "broken": night.broken,
        "worse": worse(moments, alone.dome.moments),
        "n_swaps": len(night.swaps),
        "n_windows": night.n_windows,
        "median_nm": [_median(moments), _median(alone.dome.moments)],
        "cpu_s": time.process_time() - begun,
    }


def _runs(block: FrameBlock, arrives: np.ndarray) -> Iterator[FrameBlock]:
    """Yield each stretch of frames that arrive."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], arrives, [False]]).astype(int)))
    for start, stop in edges.reshape(-1, 2):
        rows = slice(int(start), int(stop))
        yield replace(
            block,
            first_seq=block.first_seq + rows.start,
            t0_ns_utc=block.t0_ns_utc + rows.start * block.dt_ns,
            slopes=block.slopes[rows],
            commands_m=block.commands_m[rows],
            dither_m=None if block.dither_m is None else block.dither_m[rows],
        )


def _median(moments: Sequence[Moment]) -> float:
    return round(float(np.median([one.wavefront_nm for one in moments if one.closed])), 1)


def table(rows: Sequence[Row]) -> str:
    """Return the campaign as a Markdown table, and every night that went wrong."""
    text = heading(
        *("plant", "frames a second", "nights", "simulated hours", "faults and orders"),
        *("windows", "matrices sent"),
        *("rules broken", f"worse by {HARM - 1:.0%} for {HARM_S:g} s"),
    )
    kinds = sorted({(row["plant"], row["rate_hz"]) for row in rows})
    for plant, rate_hz in kinds:
        of = [row for row in rows if (row["plant"], row["rate_hz"]) == (plant, rate_hz)]
        text += line(
            *(plant, f"{rate_hz:g}", len(of), f"{sum(row['seconds'] for row in of) / 3600.0:.2f}"),
            *(sum(len(row["deeds"]) for row in of), sum(row["n_windows"] for row in of)),
            sum(row["n_swaps"] for row in of),
            *(sum(len(row[name]) for row in of) for name in ("broken", "worse")),
        )
    wrong = [row for row in rows if row["broken"] or row["worse"]]
    said = [{name: row[name] for name in ("seed", "plant", "broken", "worse")} for row in wrong]
    return text + "\n" + "".join(f"- {json.dumps(one)}\n" for one in said)


def main() -> int:
    """Play what is missing, then print the table; 1 if anything was broken."""
    parser = campaign_parser("fault_nights", __doc__)
    parser.add_argument("--instrument", default=SMALL, metavar="NAME|FILE")
    parser.add_argument("--plant", choices=("linear", "diffractive"), default="linear")
    parser.add_argument("--rate", type=float, default=1000.0, metavar="HZ", help="of frames")
    parser.add_argument("--seeds", type=range_of, default=range(4), metavar="FIRST:END")
    parser.add_argument("--seconds", type=float, default=600.0, help="of each night")
    given = parser.parse_args()
    nights = [
        Night(
            seed=seed,
            instrument=given.instrument,
            plant=given.plant,
            rate_hz=given.rate,
            seconds=given.seconds,
        )
        for seed in given.seeds
    ]
    rows = complete(play, nights, given)
    tell(table(rows), given.table, parser.prog)
    return int(any(row["broken"] or row["worse"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
