"""RTCs whose single modes differ from the instrument file, and whether their loop is made worse.

Run: ``python -m pyrcal_studies.campaign.other_modes --plant linear --output var/other_modes.jsonl
--table table.md`` for the differences of ``TRUTHS``, or with ``differ``, ``killed`` (the same with
the service killed), ``healthy``, ``healthy_diffractive`` or ``jumps`` for nights drawn by seed.
Nights that are in the file already are not run again; every night is played twice, once without a
service.

An outside RTC controls 120 of 150 modes with its own integrator and its own matrix, the service is
in ``auto`` and raises the modes to all. Mirror, sensor, loop and first matrix agree with one
another, so alone the RTC runs well; its modes are not those of the instrument file.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal.rtc.identity import Reconstructor
from pyrcal_studies.campaign.observatory import (
    SMALL,
    Dome,
    KeptNight,
    Latencies,
    Moment,
    ShortLink,
    Swap,
    true_response,
)
from pyrcal_studies.campaign.rows import Row, RowFile, heading, line, range_of, tell
from service.config import load_settings
from service.errors import LinkError
from service.estimation.frames import FrameBlock
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, OpticsWorker, Sampling
from service.tracking.state import Mode
from service.wire import Loop, LoopRequest, Manifest, checksum, layout_of
from sim_rtc.assembly import Telescope
from sim_rtc.computer.feed import Block
from sim_rtc.computer.loop import LoopBlock, LoopTerms, ModalLoop
from sim_rtc.computer.reconstructors import compute_truncated_inverse
from sim_rtc.computer.telemetry import Batch
from sim_rtc.options import Options
from sim_rtc.telescope.linear import LinearOptics
from sim_rtc.telescope.mirror import modal_content
from sim_rtc.telescope.plant import Optics

PROGRAM = "python -m pyrcal_studies.campaign.other_modes"

Array32 = NDArray[np.float32]


class Kind(StrEnum):
    """How the truth differs from the file."""

    AS_TOLD = "as told"
    SCALE = "scale"
    """A mode times a factor; -1 turns its sign."""

    EXCHANGE = "exchange"
    """Two modes in each other's place."""

    ROLL = "roll"
    """All modes one place on."""

    PERMUTE = "permute"
    """All modes in any order."""

    SLOPES = "slopes"
    """All slopes in any order."""

    STRENGTH = "strength"
    """The sensor answers so many times as strongly; the RTC's own matrix knows it."""

    PLAYS_EXCHANGED = "plays exchanged"
    """Two rows of every matrix that is sent are exchanged; it is acknowledged as it was sent."""

    PLAYS_TIMES = "plays times"
    PLAYS_ROLLED = "plays rolled"
    ZEROS = "zeros"
    """The slopes are 0 for ten seconds, in the loop as on the wire."""

    FROZEN = "frozen"


LIES = frozenset({Kind.PLAYS_EXCHANGED, Kind.PLAYS_TIMES, Kind.PLAYS_ROLLED})
STANDING = frozenset({Kind.ZEROS, Kind.FROZEN})
STANDS_S = 10.0
"""For so long a camera stands."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What an RTC truly is."""

    kind: Kind = Kind.AS_TOLD
    modes: tuple[int, ...] = ()
    factor: float = 1.0
    offered: bool = True
    """Whether the RTC lets its own matrix be read back."""

    since_s: float = 15.0
    """When the camera stands still, seconds of the night."""

    seed: int = 0
    """Of a permutation."""

    @property
    def name(self) -> str:
        """What tells it from the others."""
        modes = "/".join(map(str, self.modes))
        factor = "" if self.factor == 1.0 else f"x {self.factor:g}"
        words = (self.kind.value, modes, factor, "" if self.offered else "not offered")
        return " ".join(word for word in words if word)

    def played(self, n_modes: int) -> tuple[NDArray[np.intp], Array32]:
        """Return which mode of the file each mode of the RTC is, and times what."""
        index, scale = np.arange(n_modes), np.ones(n_modes, dtype=np.float32)
        match self.kind:
            case Kind.SCALE:
                scale[list(self.modes)] = self.factor
            case Kind.EXCHANGE:
                index[list(self.modes)] = self.modes[::-1]
            case Kind.ROLL:
                index = np.roll(index, 1)
            case Kind.PERMUTE:
                index = np.random.default_rng(self.seed).permutation(n_modes)
            case _:
                pass
        return index, scale

    def loaded(self, matrix: Array32) -> Array32:
        """Return what the loop does with a matrix that it is sent."""
        match self.kind:
            case Kind.PLAYS_EXCHANGED:
                matrix = matrix.copy()
                matrix[list(self.modes)] = matrix[list(self.modes[::-1])]
            case Kind.PLAYS_TIMES:
                matrix = matrix * np.float32(self.factor)
            case Kind.PLAYS_ROLLED:
                matrix = np.roll(matrix, 1, axis=0)
            case _:
                pass
        return matrix


class Camera:
    """What the loop reads of the sensor: nothing new while it stands."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self._last: Array32 | None = None

    def standing(self, time_s: float) -> Array32 | None:
        """Return the slopes ``(n_slopes,)`` that are read again and again; None: new ones are."""
        truth = self._truth
        if truth.kind not in STANDING or not 0.0 <= time_s - truth.since_s < STANDS_S:
            return None
        if self._last is not None and truth.kind is Kind.ZEROS:
            return np.zeros_like(self._last)
        return self._last

    def read(self, slopes: Array32) -> None:
        """Remember the last frame."""
        self._last = slopes[-1].copy()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OtherBlock(Block):
    """A block of frames seen by a camera that may stand."""

    inner: Block
    camera: Camera
    rate_hz: float

    @property
    @override
    def n_frames(self) -> int:
        return self.inner.n_frames

    @override
    def phase_at(self, row: int) -> Array32:
        return self.inner.phase_at(row)

    @override
    def run(
        self, row: int, loop: ModalLoop, terms: LoopTerms, dither_m: Array32 | None
    ) -> LoopBlock:
        standing = self.camera.standing((self.first_frame + row) / self.rate_hz)
        if standing is None:
            result = self.inner.run(row, loop, terms, dither_m)
            self.camera.read(result.slopes)
            return result
        return loop.run_frames(
            self.batch_frames, lambda *_: standing, terms, dither_m, self._read_played_rows(row)
        )


class OtherDome(Dome):
    """A telescope whose RTC is as ``truth`` says; it begins with a matrix of its own.

    That matrix inverts what was measured by day, at ``calibrated``, on this very telescope.
    """

    def __init__(self, words: Sequence[str], truth: Truth, calibrated: Misregistration) -> None:
        self.truth = truth
        self._calibrated = calibrated
        self._camera = Camera(truth)
        self._seen: tuple[Optics, Optics] | None = None
        self._content: tuple[Optics, Array32] | None = None
        super().__init__(words)
        n_slopes = self._optics.n_slopes
        self._place = np.arange(n_slopes)
        if truth.kind is Kind.SLOPES:
            self._place = np.random.default_rng(truth.seed).permutation(n_slopes)
        self._strength = np.float32(truth.factor if truth.kind is Kind.STRENGTH else 1.0)
        self._told: dict[str, Array32] = {}

    def telemetry(self) -> list[FrameBlock]:
        """Let one block of frames pass and return what is sent of it."""
        return [
            replace(block, slopes=block.slopes[:, self._place] * self._strength)
            for block in super().play()
        ]

    @override
    def play(self) -> list[FrameBlock]:
        return self.telemetry()

    @override
    def stage(self, reconstructor: Reconstructor) -> None:
        """Hand the loop a matrix that was sent, as this RTC loads it."""
        matrix = reconstructor.matrix
        self._told[reconstructor.manifest.id] = matrix
        inner = np.empty_like(matrix)
        inner[:, self._place] = matrix * self._strength
        super().stage(replace(reconstructor, matrix=self.truth.loaded(inner)))

    def applied(self) -> tuple[Manifest, Array32]:
        """Return the matrix in use as the RTC shows it.

        Raises
        ------
        LinkError
            If the RTC shows none.
        """
        if not self.truth.offered:
            raise LinkError("no answer from the RTC on rtc/cm/applied within 2 s")
        active = self.computer.reconstructor
        own = np.ascontiguousarray(active.matrix[:, self._place] / self._strength)
        matrix = self._told.get(active.manifest.id, own)
        layout = layout_of(matrix, active.manifest.layout.chunk_bytes)
        return replace(active.manifest, layout=layout), matrix

    @override
    def _moment(self, batches: list[Batch]) -> Moment:
        """Return the truth of a block; its wavefront error is that of the mirror's modes alone.

        What no mode can correct is the same whatever the service does, and would hide it.
        """
        squares = []
        for batch in batches:
            optics = batch.optics
            if self._content is None or self._content[0] is not optics:
                content = modal_content(optics.opd_per_command, self.telescope.weights)
                self._content = (optics, content.astype(np.float32))
            residual_m = self._content[1] @ batch.phase_m + batch.commands_m[0]
            in_modes = optics.opd_per_command @ residual_m
            in_modes -= self.telescope.weights @ in_modes
            squares.append(float(self.telescope.weights @ in_modes**2))
        return replace(
            super()._moment(batches), wavefront_nm=1e9 * float(np.sqrt(np.mean(squares)))
        )

    @override
    def _built(self, options: Options) -> Telescope:
        telescope = super()._built(options)
        optics = self._other(telescope.plant.optics(self._calibrated))
        n_controlled = options.n_controlled(self.instrument.modes.n_modes)
        matrix = compute_truncated_inverse(true_response(optics, n_controlled))
        own = Reconstructor.own(
            f"own-{n_controlled}-{checksum(matrix)[:8]}",
            matrix,
            telescope.identity,
            created_ns=telescope.reconstructor.manifest.created_ns,
        )
        return replace(telescope, reconstructor=own)

    @override
    def _blocks(self) -> Iterator[Block]:
        for block in super()._blocks():
            if self._seen is None or self._seen[0] is not block.optics:
                self._seen = (block.optics, self._other(block.optics))
            optics: Any = self._seen[1]
            yield OtherBlock(
                first_frame=block.first_frame,
                optics=optics,
                phases_m=block.phases_m,
                played_m=block.played_m,
                batch_frames=block.batch_frames,
                inner=replace(block, optics=optics),
                camera=self._camera,
                rate_hz=self.rate_hz,
            )

    def _other(self, optics: Optics) -> Optics:
        """Return the optics with the modes that this RTC truly has."""
        index, scale = self.truth.played(optics.opd_per_command.shape[1])
        opd = np.asfortranarray(optics.opd_per_command[:, index] * scale)
        if isinstance(optics, LinearOptics):
            response = np.asfortranarray(optics.slopes_per_command[:, index] * scale)
            return replace(optics, opd_per_command=opd, slopes_per_command=response)
        return replace(optics, opd_per_command=opd)


class OtherLink(ShortLink):
    """The way to it and back."""

    def __init__(self, dome: OtherDome) -> None:
        super().__init__(dome)
        self._other = dome

    @override
    async def fetch_applied(self) -> tuple[Manifest, Array32]:
        """Return the matrix the RTC uses, as it shows it."""
        return self._other.applied()


INSTRUMENT = "tests/system/middle.toml"
GAINS = {"linear": 0.4, "diffractive": 0.5}
ALPHA = (0.12, -0.08, 0.2, 1.003)
"""Where the mirror truly lies, at the boundary."""

CALIBRATED = (0.05, -0.03, 0.05, 1.001)
"""Where it lay by day, when the RTC's own matrix was measured."""

N_CONTROLLED, N_TARGET = 120, 150

LATENCIES = Latencies(make_s=0.6, judge_s=0.5)
"""Three times what the worker takes for 150 modes on a core of its own: 0.21 and 0.18 s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One night."""

    truth: Truth = field(default_factory=Truth)
    instrument: str = INSTRUMENT
    plant: str = "linear"
    seconds: float = 40.0
    n_controlled: int = N_CONTROLLED
    n_target: int = N_TARGET
    jump_s: float | None = None
    """When the mirror jumps by .3 subapertures and 1 degree; None: never."""

    killed_s: float | None = None
    """When the service is killed and begun again; None: never."""

    magnitude: float = 8.0
    seed: int = 1

    @property
    def name(self) -> str:
        """What tells it from other nights."""
        jump = f"jump with {self.n_target}" if self.jump_s is not None else ""
        kill = "" if self.killed_s is None else f"killed at {self.killed_s:.1f} s"
        return ", ".join(word for word in (jump or self.truth.name, kill) if word)

    @property
    def words(self) -> list[str]:
        """The simulator's command line."""
        angle = np.random.default_rng(self.seed).uniform(0.0, 2.0 * np.pi)
        x, y = 0.3 * np.cos(angle), 0.3 * np.sin(angle)
        jump = [] if self.jump_s is None else [f"--jump={self.jump_s}:{x:.4f},{y:.4f},1,0"]
        return [
            f"--instrument={self.instrument}",
            f"--plant={self.plant}",
            f"--n-controlled={self.n_controlled}",
            f"--gain={GAINS[self.plant]}",
            "--leak=0.99",
            "--seeing=0.7",
            "--wind=8,20",
            f"--mag={self.magnitude}",
            f"--alpha={','.join(map(str, ALPHA))}",
            f"--seed={self.seed}",
            *jump,
        ]

    def dome(self) -> OtherDome:
        """Return the telescope and its RTC."""
        calibrated = Misregistration.from_vector(np.array(CALIBRATED) / BOUNDARY_SCALE)
        return OtherDome(self.words, self.truth, calibrated)


class OtherNight(KeptNight):
    """The service at such a telescope; with a ``folder`` it can be killed and begun again."""

    dome: OtherDome

    def __init__(self, plan: Plan, folder: Path | None = None) -> None:
        settings = load_settings(None, {}, {"control.n_modes_target": plan.n_target})
        self.said: dict[tuple[str, str], float] = {}
        """Every text of an alarm, and when it was said first."""

        super().__init__(
            policy_of(settings),
            Mode.AUTO,
            _bench(plan, settings.compute.working_point_modes),
            folder,
            latencies=LATENCIES,
            dome=plan.dome(),
            link=OtherLink,
        )

    def pass_(self, until_s: float) -> None:
        """Let time pass, and read what is said."""
        while self.time_s < until_s - 1e-9:
            self.advance(0.25)
            self.save()
            for alarm in self.state.alarms.active:
                self.said.setdefault((alarm.name, alarm.text), round(self.time_s, 2))


def _bench(plan: Plan, working_point_modes: int | None) -> OpticsWorker:
    """Return a worker that has learnt nothing yet; at its working point if that matters."""
    modes = None if plan.plant == "linear" else working_point_modes
    sampling = Sampling(working_point_modes=modes)
    return OpticsWorker(load_instrument(plan.instrument), Compute(threads=1, sampling=sampling))


WORSE, WORSE_S = 1.1, 1.0
"""A loop is made worse when its wavefront error is above the first times that of the same night
without a service for longer than the second."""

SMOOTHED_S = 0.25
"""Over which the wavefront error is the RMS."""

CLOSED_S = 2.0
"""Until then the loop is being closed, with a service or without."""

LATE_S = 3.0
"""At the end of a night, to tell what it came to."""


def play(plan: Plan) -> Row:
    """Run one night with a service and without, and return what came of it."""
    begun = time.process_time()
    with threadpool_limits(1), tempfile.TemporaryDirectory() as folder:
        night = OtherNight(plan, None if plan.killed_s is None else Path(folder))
        if plan.killed_s is not None:
            night.pass_(plan.killed_s)
            night.kill()
        night.pass_(plan.seconds)
        night.close()
        alone = untouched(
            replace(plan, truth=replace(plan.truth, offered=True), killed_s=None, n_target=0)
        )
    return {**asdict(plan), "name": plan.name, **came_of(plan, night, alone)} | {
        "cpu_s": round(time.process_time() - begun, 1)
    }


@lru_cache(maxsize=1)
def untouched(plan: Plan) -> tuple[Moment, ...]:
    """Return the same night without a service."""
    dome = plan.dome()
    while dome.time_s < plan.seconds:
        dome.play()
    return tuple(dome.moments)


def came_of(plan: Plan, night: OtherNight, alone: Sequence[Moment]) -> Row:
    """Return what the service did to the loop, and what it said."""
    begun = round(CLOSED_S / SMOOTHED_S)
    with_nm, without_nm = (smoothed(m)[begun:] for m in (night.dome.moments, alone))
    worse = with_nm > WORSE * without_nm
    late = round(LATE_S / SMOOTHED_S)
    said = [(at, name, text) for (name, text), at in night.said.items()]
    named = [(at, name) for at, name, text in said if names(plan, text)]
    orders = [(order.frame / night.dome.rate_hz, order.what) for order in night.dome.orders]
    opened = [at for at, what in orders if isinstance(what, LoopRequest) and what.loop is Loop.OPEN]
    return {
        "worse_s": longest(worse) * SMOOTHED_S,
        "worse_in_all_s": float(worse.sum()) * SMOOTHED_S,
        "first_worse_s": CLOSED_S + float(np.argmax(worse)) * SMOOTHED_S if worse.any() else None,
        "peak_nm": float(with_nm.max()),
        "peak_alone_nm": float(without_nm.max()),
        "late_nm": _rms(with_nm[-late:]),
        "late_alone_nm": _rms(without_nm[-late:]),
        "named_s": min(named)[0] if named else None,
        "by": min(named)[1] if named else None,
        "sent": [round(swap.time_s, 2) for swap in night.swaps],
        "n_modes": night.dome.moments[-1].n_controlled,
        "opened": opened,
        "closed_at_last": night.dome.moments[-1].closed,
        "undithered_s": undithered_s(night.dome.moments),
        "corrected_s": corrected_s(plan, night.swaps),
        "said": said,
        "log": [
            (round((entry.t_ns_utc - night.state.log[0].t_ns_utc) / 1e9, 2), entry.name, entry.text)
            for entry in night.state.log[-60:]
        ],
    }


def undithered_s(moments: Sequence[Moment]) -> float:
    """Return the longest time without a dither after the first one."""
    times = [moment.time_s for moment in moments if moment.dither_nm > 0.0]
    if not times:
        return moments[-1].time_s
    return float(np.diff([*times, moments[-1].time_s]).max())


CORRECTED = np.array([0.1, 0.1, np.deg2rad(0.3), 0.01])
"""A matrix is made for where the mirror is when its α is as near as this (numeric units)."""


def corrected_s(plan: Plan, swaps: Sequence[Swap]) -> float | None:
    """Return how long after the jump a matrix for the mirror's new place came into use."""
    for swap in swaps:
        if plan.jump_s is None or swap.made_for is None or swap.time_s <= plan.jump_s:
            continue
        if np.all(np.abs(swap.made_for.vector - swap.alpha.vector) < CORRECTED):
            return swap.time_s - plan.jump_s
    return None


def smoothed(moments: Sequence[Moment]) -> NDArray[np.float64]:
    """Return the wavefront error in nm, the RMS over each stretch of the night."""
    stretch = np.array([int((m.time_s - 1e-6) / SMOOTHED_S) for m in moments])
    power = np.bincount(stretch, [m.wavefront_nm**2 for m in moments])
    return np.asarray(np.sqrt(power / np.bincount(stretch)))


def longest(flags: NDArray[np.bool_]) -> int:
    """Return how many follow one another at most."""
    most = run = 0
    for flag in flags:
        run = run + 1 if flag else 0
        most = max(most, run)
    return most


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


WORDS = {
    Kind.SCALE: r"sign|scale|strong|weak|times (?!as)|factor|respon|unit",
    Kind.EXCHANGE: r"exchang|swap|order|place",
    Kind.ROLL: r"order|roll|shift|moved on|place",
    Kind.PERMUTE: r"order|permut|place|other modes|basis",
    Kind.SLOPES: r"order|slopes",
    Kind.PLAYS_EXCHANGED: r"plays|exchang|not the matrix|other matrix|another matrix",
    Kind.PLAYS_TIMES: r"plays|times|not the matrix|other matrix|another matrix",
    Kind.PLAYS_ROLLED: r"plays|roll|order|not the matrix|other matrix|another matrix",
    Kind.ZEROS: r"slopes.*(zero|\b0\b|same|stand)|camera|frozen|stands",
    Kind.FROZEN: r"slopes.*(frozen|same|stand|change|repeat)|camera|stands",
}
"""What an alarm must speak of, besides the modes."""


def names(plan: Plan, text: str) -> bool:
    """Return whether an alarm says what the RTC truly is."""
    truth = plan.truth
    pattern = WORDS.get(truth.kind)
    if pattern is None or re.search(pattern, text, re.IGNORECASE) is None:
        return False
    single = truth.kind in {Kind.SCALE, Kind.EXCHANGE}
    return not single or all(re.search(rf"\b{mode}\b", text) for mode in truth.modes)


def _scale(factor: float, *modes: int) -> Truth:
    return Truth(kind=Kind.SCALE, modes=modes, factor=factor)


TRUTHS = (
    Truth(),
    _scale(-1.0, 10),
    _scale(-1.0, 110),
    _scale(-1.0, 130),
    _scale(-1.0, 145),
    Truth(kind=Kind.EXCHANGE, modes=(10, 11)),
    Truth(kind=Kind.EXCHANGE, modes=(3, 40)),
    Truth(kind=Kind.EXCHANGE, modes=(118, 125)),
    _scale(1.7, 0),
    _scale(-0.5, 15),
    _scale(3.0, 10),
    _scale(0.1, 10),
    Truth(kind=Kind.ROLL),
    Truth(kind=Kind.PERMUTE),
    Truth(kind=Kind.SLOPES),
    Truth(kind=Kind.STRENGTH, factor=0.5),
    Truth(kind=Kind.PLAYS_EXCHANGED, modes=(10, 40)),
    Truth(kind=Kind.PLAYS_TIMES, factor=3.0),
    Truth(kind=Kind.PLAYS_ROLLED),
    Truth(kind=Kind.ZEROS),
    Truth(kind=Kind.FROZEN),
)
"""Those of the issue's table, and of it what an RTC may also keep to itself: its matrix."""


def plans(given: argparse.Namespace) -> list[Plan]:
    """Return the nights that are asked for."""
    base = {"plant": given.plant, "seconds": given.seconds, "seed": given.seed}
    nights = [Plan(truth=truth, **base) for truth in TRUTHS]
    hidden = [t for t in TRUTHS if t.kind not in LIES | STANDING]
    nights += [Plan(truth=Truth(**{**asdict(truth), "offered": False}), **base) for truth in hidden]
    for n_target in (N_CONTROLLED, N_TARGET):
        nights.append(Plan(n_target=n_target, jump_s=25.0, **base))
    return [night for night in nights if given.only in night.name]


def table(rows: Iterable[Row]) -> str:
    """Return the rows in Markdown."""
    text = heading(
        *("plant", "the RTC's truth", "worse than alone by > 10 %", "peak (alone)"),
        *("at the end (alone)", "sent after", "modes", "opened after", "named after", "by"),
    )
    for row in rows:
        named = "-" if row["named_s"] is None else f"{row['named_s']:.1f} s"
        sent = ", ".join(f"{at:.1f}" for at in row["sent"][:5])
        more = " ..." if len(row["sent"]) > 5 else ""
        text += line(
            *(row["plant"], row["name"], f"{row['worse_s']:.1f} s"),
            f"{row['peak_nm']:.0f} ({row['peak_alone_nm']:.0f}) nm",
            f"{row['late_nm']:.0f} ({row['late_alone_nm']:.0f}) nm",
            *(f"{sent}{more} s" if sent else "-", row["n_modes"]),
            f"{row['opened'][0]:.1f} s" if row["opened"] else "-",
            *(named, row["by"] or "-"),
        )
    return text


def run(nights: Iterable[Plan], output: Path) -> list[Row]:
    """Play the nights that are not in the file yet, and return all rows of it."""
    file = RowFile(output)
    done = {(row["plant"], row["name"], row["seed"]) for row in file.rows}
    for plan in nights:
        if (plan.plant, plan.name, plan.seed) not in done:
            file.add(play(plan))
            sys.stderr.write(table(file.rows[-1:]).splitlines()[-1] + "\n")
    return file.rows


_SEED = 20261123
FACTORS = (-1.0, -1.0, -1.0, -0.5, 0.1, 0.5, 2.0, 3.0)
KINDS = (Kind.SCALE,) * 5 + (Kind.EXCHANGE,) * 3 + (Kind.ROLL, Kind.PERMUTE)
DIFFRACTIVE_EVERY = 4
"""One RTC in so many is at a diffractive telescope."""

NAMED_S = 15.0
CORRECTED_S = 8.0


def differing(seed: int) -> Plan:
    """Return the night of an RTC whose modes differ: the same for the same seed."""
    rng = np.random.default_rng([_SEED, seed])
    kind = KINDS[seed % len(KINDS)]
    diffractive = seed % DIFFRACTIVE_EVERY == DIFFRACTIVE_EVERY - 1
    n_first, n_all = (45, 60) if diffractive else (N_CONTROLLED, N_TARGET)
    modes: tuple[int, ...] = ()
    factor = 1.0
    if kind is Kind.SCALE:
        factor = float(rng.choice(FACTORS))
        n_modes = int(rng.choice([1, 1, 3]))
        # one in three among those that are not controlled at first
        low, high = (n_first, n_all) if rng.random() < 1 / 3 else (0, n_first)
        modes = tuple(sorted(rng.choice(np.arange(low, high), n_modes, replace=False).tolist()))
    elif kind is Kind.EXCHANGE:
        modes = tuple(sorted(rng.choice(n_all, 2, replace=False).tolist()))
    offered = (seed + seed // DIFFRACTIVE_EVERY) % 2 == 0
    truth = Truth(kind=kind, modes=modes, factor=factor, offered=offered, seed=seed)
    plan = Plan(truth=truth, seed=seed, seconds=40.0, n_controlled=n_first, n_target=n_all)
    if not diffractive:
        return plan
    # the small one: of the other a second takes two
    return replace(plan, instrument=SMALL, plant="diffractive", seconds=25.0)


def killed(seed: int) -> Plan:
    """Return the same night with the service killed at some moment."""
    rng = np.random.default_rng([_SEED, 1, seed])
    return replace(differing(seed), killed_s=round(float(rng.uniform(2.0, 20.0)), 1))


def healthy(seed: int) -> Plan:
    """Return five minutes of an RTC that is as told."""
    rng = np.random.default_rng([_SEED, 2, seed])
    return Plan(seed=seed, seconds=300.0, magnitude=round(float(rng.uniform(7.0, 11.0)), 1))


def healthy_diffractive(seed: int) -> Plan:
    """Return the same of a diffractive telescope; every other RTC keeps its matrix to itself."""
    rng = np.random.default_rng([_SEED, 4, seed])
    plan = replace(healthy(seed), magnitude=round(float(rng.uniform(7.0, 11.0)), 1), seconds=60.0)
    plan = replace(plan, truth=Truth(offered=seed % 2 == 0), n_controlled=45, n_target=60)
    return replace(plan, instrument=SMALL, plant="diffractive")


def jumping(seed: int) -> Plan:
    """Return a night whose mirror jumps once all modes are controlled."""
    rng = np.random.default_rng([_SEED, 3, seed])
    jump_s = round(float(rng.uniform(25.0, 40.0)), 1)
    return Plan(seed=seed, jump_s=jump_s, seconds=jump_s + 20.0)


CAMPAIGNS: Mapping[str, Callable[[int], Plan]] = {
    "differ": differing,
    "killed": killed,
    "healthy": healthy,
    "healthy_diffractive": healthy_diffractive,
    "jumps": jumping,
}


def summary(rows: Sequence[Row]) -> str:
    """Return what counts of all nights, in one line."""
    differ = [row for row in rows if row["truth"]["kind"] != Kind.AS_TOLD]
    jumped = [row for row in rows if row["jump_s"] is not None]
    soon = [row for row in differ if row["named_s"] is not None and row["named_s"] <= NAMED_S]
    in_time = [row for row in jumped if (row["corrected_s"] or np.inf) <= CORRECTED_S]
    text = heading(
        *("nights", "loops made worse by > 10 % for > 1 s", "RTCs that differ", "named in 15 s"),
        *("with alarms", "dither gone for 10 s", "jumps", "corrected in 8 s", "peak above alone"),
    )
    return text + line(
        *(len(rows), sum(row["worse_s"] > WORSE_S for row in rows), len(differ), len(soon)),
        sum(bool(row["said"]) for row in rows),
        sum(row["undithered_s"] > 10.0 for row in rows),
        *(len(jumped), len(in_time)),
        sum(row["peak_nm"] > row["peak_alone_nm"] for row in jumped),
    )


def main() -> int:
    """Run what is missing, then print the tables; 1 if a loop was made worse."""
    parser = argparse.ArgumentParser(prog=PROGRAM)
    parser.add_argument(
        "campaign", nargs="?", choices=tuple(CAMPAIGNS), help="nights drawn by seed; none: TRUTHS"
    )
    parser.add_argument("--seeds", type=range_of, default=range(40), metavar="FIRST:END")
    parser.add_argument("--plant", choices=tuple(GAINS), default="linear", help="of TRUTHS")
    parser.add_argument("--seconds", type=float, default=40.0, help="of each night of TRUTHS")
    parser.add_argument("--seed", type=int, default=1, help="of TRUTHS")
    parser.add_argument("--only", default="", metavar="TEXT", help="nights with it in their name")
    parser.add_argument("--output", type=Path, default=Path("other_modes.jsonl"))
    parser.add_argument("--table", type=Path, metavar="FILE.md")
    given = parser.parse_args()
    nights = map(CAMPAIGNS[given.campaign], given.seeds) if given.campaign else plans(given)
    rows = run(nights, given.output)
    tell(f"{summary(rows)}\n{table(rows)}", given.table, PROGRAM)
    return int(any(row["worse_s"] > WORSE_S for row in rows))


if __name__ == "__main__":
    sys.exit(main())
