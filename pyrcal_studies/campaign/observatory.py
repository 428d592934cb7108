"""The whole service against a simulated telescope, in simulated time: no network, no processes.

What the service does is the service's own code: streams, worker, tracker, actions, translation of
the wire. Only what waits is replaced: an agenda says when each thing is over, by the frames' time,
so a night takes as long as it computes and is the same every time.

``Dome`` is the telescope with its RTC, ``ShortLink``, ``OwnHands`` and ``Shelf`` replace the link,
the worker process and the archive, and ``Observatory`` is the service at the dome. ``published``
judges the matrices of a night by the telescope alone: the wavefront after each swap, and the poles
of the loop with the telescope's own response, which the service has not seen.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cache, partial
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from pyrcal.rtc import staging
from pyrcal.rtc.identity import Reconstructor
from service.archive.products import NoisyNumbers
from service.archive.store import Provenance
from service.control.loop import pole_radius
from service.errors import PyrcalError, UnknownIdError, WorkerError
from service.estimation.dither_windows import EndedWindow
from service.estimation.frames import FrameBlock
from service.estimation.loop import select_gains
from service.estimation.passive import PASSIVE_INTERVAL_S
from service.estimation.random_dither import Correlated
from service.instrument import load_instrument
from service.model.misregistration import Misregistration
from service.records import commands
from service.records import events as ev
from service.records.events import Effect, Event
from service.records.operations import MeasurementRecord
from service.records.products import (
    GateVerdict,
    MatrixState,
    ReconstructorRecord,
    ReferencesRecord,
)
from service.records.state import LoopState, Mode, ModelState, OperatorState, TrackerState
from service.runtime.actions import Actions, Publishing, present_conditions
from service.runtime.engine import Engine
from service.runtime.estimates import PendingWindow, fit_passive, fitted, read_own_matrix
from service.runtime.ports import StorePort
from service.runtime.worker import Compute, OpticsWorker, Sampling
from service.runtime.worker.records import patience_s
from service.tracker import step
from service.tracking.policy import SECOND_NS, Policy
from service.wire import (
    CHUNK_LIMIT,
    Acknowledgement,
    Command,
    Manifest,
    ReferencesInUse,
    Reply,
    Status,
    checksum,
    decode,
    encode,
    split,
)
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.computer.feed import BATCH_FRAMES, Block
from sim_rtc.computer.telemetry import Batch, FrameClock, LoopSettings
from sim_rtc.options import Options, parse_options
from sim_rtc.telescope.diffractive import DiffractiveOptics
from sim_rtc.telescope.linear import LinearOptics
from sim_rtc.telescope.plant import Optics
from sim_rtc.truth import WavefrontError

START_NS = 1_800_000_000_000_000_000
"""When simulated nights begin: every timestamp counts from here."""

P = ParamSpec("P")
T = TypeVar("T")
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """The truth during one block of frames."""

    time_s: float
    """End of the block, since the night began."""

    alpha: Misregistration
    """Where the mirror truly lay at its end."""

    wavefront_nm: float
    """RMS of the residual wavefront over pupil and block."""

    n_clipped: int
    """Commands that met a limit of the mirror."""

    cm_id: str
    """Of the matrix that multiplied its last slopes."""

    n_controlled: int
    closed: bool
    dither_nm: float
    """RMS of the dither on the mirror, all modes together; 0: none."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Order:
    """Something the RTC was told."""

    frame: int
    """Frames since the night began when it was told."""

    what: Command | Reconstructor


class Inline(Executor):
    """Does what it is given at once, so that nothing depends on how fast the machine is."""

    @override
    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Return a future that is done."""
        future: Future[T] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


class Dome:
    """The telescope, frame by frame; time passes in ``play`` alone."""

    def __init__(self, words: Sequence[str], *, block_batches: int = 5) -> None:
        """Take the simulator's command line; ``block_batches`` messages make a block."""
        options = parse_options(list(words))
        self.instrument = load_instrument(options.instrument)
        self.telescope = self._built(options)
        self.computer = self.telescope.computer(self._blocks())
        self.magnitude = options.magnitude
        self.rate_hz = options.frame_rate_hz
        self.jump_times_s = tuple(sorted(jump.time_s for jump in options.jumps))
        self.frame = 0
        """Frames played since the night began."""

        self.moments: list[Moment] = []
        self.orders: list[Order] = []
        self._dt_ns = round(1e9 / options.frame_rate_hz)
        self._clock = FrameClock(start_ns_utc=START_NS, dt_ns=self._dt_ns)
        self._error = WavefrontError(self.telescope.weights)
        self._block_batches = block_batches
        self._optics: Optics = self.telescope.optics.at(0.0)

    @property
    def now_ns(self) -> int:
        """The time, nanoseconds UTC."""
        return START_NS + self.frame * self._dt_ns

    @property
    def time_s(self) -> float:
        """Seconds since the night began."""
        return self.frame / self.rate_hz

    @property
    def optics(self) -> Optics:
        """The true optics, as of the last frame."""
        return self._optics

    @property
    def alpha(self) -> Misregistration:
        """Where the mirror truly lies on the sensor, as of the last frame."""
        return self._optics.alpha

    def play(self) -> list[FrameBlock]:
        """Let one block of frames pass and return it as the link would, joined while it may be."""
        batches = [self.computer.next_batch() for _ in range(self._block_batches)]
        self.frame += self._block_batches * BATCH_FRAMES
        self._optics = batches[-1].optics
        self.moments.append(self._moment(batches))
        return [self._block(part) for part in _alike(batches, _on_the_wire)]

    def order(self, command: Command) -> Reply:
        """Tell the RTC something and return its answer."""
        self.orders.append(Order(frame=self.frame, what=command))
        return self.computer.execute(command)

    def stage(self, reconstructor: Reconstructor) -> None:
        """Hand the loop a checked matrix; it multiplies from the next frame on."""
        self.orders.append(Order(frame=self.frame, what=reconstructor))
        self.computer.stage(reconstructor)

    def restart(self) -> None:
        """Let the RTC begin again, at frame 0 and with the matrix of the start."""
        self.computer.restart()
        self._clock.restart(self.now_ns)

    def step_clock(self, by_ns: int) -> None:
        """Have the RTC's clock leap."""
        self._clock.step(by_ns)

    def status(self) -> Status:
        """Return what the RTC says of itself, as it comes out of the wire."""
        status = replace(
            self._clock.stamp_status(self.computer.status()),
            magnitude=self.magnitude,
            flux=self.telescope.detector.flux(self.computer.images),
        )
        return decode(Status, encode(status))

    def _built(self, options: Options) -> Telescope:
        """Return the telescope; another one may be built of the same options."""
        return build_telescope(options, self.instrument, Inline())

    def _blocks(self) -> Iterator[Block]:
        """Yield what comes to the sensor."""
        return self.telescope.feed.blocks()

    def _moment(self, batches: list[Batch]) -> Moment:
        last = batches[-1]
        errors_nm = [
            error
            for part in _alike(batches, _optics_of)
            for error in self._error.rms_nm(self._error.residual_m(part))
        ]
        return Moment(
            time_s=self.time_s,
            alpha=last.optics.alpha,
            wavefront_nm=float(np.sqrt(np.mean(np.square(errors_nm)))),
            n_clipped=sum(batch.n_clipped for batch in batches),
            cm_id=last.cm_id,
            n_controlled=last.n_controlled,
            closed=last.closed,
            dither_nm=_dither_nm(batches),
        )

    def _block(self, batches: list[Batch]) -> FrameBlock:
        first = batches[0]
        dithers = [batch.dither_m for batch in batches if batch.dither_m is not None]
        return FrameBlock(
            session=first.session,
            first_seq=first.seq0,
            t0_ns_utc=self._clock.end_of_exposure_ns(first.seq0),
            dt_ns=self._dt_ns,
            slopes=np.concatenate([batch.slopes for batch in batches]),
            commands_m=np.concatenate([batch.commands_m for batch in batches]),
            dither_m=np.concatenate(dithers) if dithers else None,
            cm_id=first.cm_id,
            reference_name=first.identity.reference_id or first.identity.config_id,
        )


def replayed(words: Sequence[str], orders: Sequence[Order], seconds: float) -> Dome:
    """Return the same telescope after a night of the same orders, nobody listening.

    With the dithers left out of ``orders``, its wavefront error tells what they cost.
    """
    dome, left = Dome(words), list(orders)
    while dome.time_s < seconds:
        while left and left[0].frame <= dome.frame:
            what = left.pop(0).what
            if isinstance(what, Reconstructor):
                dome.stage(what)
            else:
                dome.order(what)
        dome.play()
    return dome


def _dither_nm(batches: list[Batch]) -> float:
    """Return the RMS of a dither: a mode's command is its own RMS over the pupil."""
    squares = [
        0.0 if batch.dither_m is None else float(np.mean(np.sum(batch.dither_m**2, axis=1)))
        for batch in batches
    ]
    return float(np.sqrt(np.mean(squares))) * 1e9


def _on_the_wire(batch: Batch) -> object:
    return batch.session, batch.cm_id, batch.dither_m is None, batch.identity


def _optics_of(batch: Batch) -> object:
    return id(batch.optics)


def _alike(batches: list[Batch], by: Callable[[Batch], object]) -> list[list[Batch]]:
    """Return the batches in runs of which all are alike."""
    return [list(run) for _, run in itertools.groupby(batches, by)]


R = TypeVar("R")


class ShortLink:
    """A link without a network: commands are carried out at once, matrices wait to be delivered."""

    def __init__(self, dome: Dome) -> None:
        self._dome = dome
        self._staging = self._new_staging()
        self.sent: list[tuple[Manifest, NDArray[np.float32]]] = []
        """Matrices on their way to the RTC."""

    def _new_staging(self) -> staging.Staging:
        computer = self._dome.computer
        return staging.Staging(computer.terms, limit_bytes=computer.largest_matrix_bytes)

    async def command(self, command: Command) -> Reply:
        """Return the RTC's answer."""
        return self._dome.order(command)

    async def publish(self, manifest: Manifest, matrix: NDArray[np.float32]) -> None:
        """Put a matrix on its way; ``deliver`` brings it to the RTC."""
        self.sent.append((manifest, matrix))

    async def fetch_applied(self) -> tuple[Manifest, NDArray[np.float32]]:
        """Return the matrix the RTC uses."""
        active = self._dome.computer.reconstructor
        return active.manifest, active.matrix

    async def fetch_references(self) -> ReferencesInUse:
        """Return the offset of the RTC's reference slopes."""
        return self._dome.computer.references_in_use()

    def offer(self, manifest: Manifest, matrix: NDArray[np.float32]) -> None:
        """Do nothing: the RTC is never late."""

    def set_current(self, matrix_id: str | None) -> None:
        """Do nothing: the RTC is never late."""

    def deliver(self, manifest: Manifest, matrix: NDArray[np.float32]) -> list[Acknowledgement]:
        """Hand the RTC a matrix the way it comes over the wire, and return what it says."""
        parts = split(matrix, manifest.layout.chunk_bytes)
        for index, part in enumerate(parts):
            self._carry_out(self._staging.chunk(manifest.id, index, part))
        return self._carry_out(self._staging.commit(manifest, self._dome.time_s))

    def swapped(self) -> list[Acknowledgement]:
        """Return what the RTC says of the matrices it has begun to use."""
        said = [self._staging.applied(*swap) for swap in self._dome.computer.take_swaps()]
        return [self._told(one) for one in said if one is not None]

    def void(self) -> None:
        """Forget what was on its way: the RTC has restarted."""
        self.sent.clear()
        self._staging = self._new_staging()

    def _carry_out(self, outcome: staging.Replies) -> list[Acknowledgement]:
        for reconstructor in outcome.staged:
            self._dome.stage(reconstructor)
        return [self._told(one) for one in outcome.acknowledgements]

    def _told(self, acknowledgement: Acknowledgement) -> Acknowledgement:
        """Return what is heard of it."""
        return acknowledgement


class OwnHands:
    """A worker that is no process of its own: the workbench itself."""

    def __init__(self, workbench: OpticsWorker) -> None:
        self.model: Callable[[], ModelState] = lambda: self._known
        """Returns the model that jobs are done with."""

        self.changed: Callable[[ModelState], object] = self._learn
        """Called with the model after a job that has changed it."""

        self.broken = ""
        """Why no job can be done; empty: all can."""

        self._workbench = workbench
        self._known = ModelState()
        self._arrays: Mapping[str, Any] = {}

    def _learn(self, model: ModelState) -> None:
        self._known = model

    async def call(
        self, job: Callable[Concatenate[OpticsWorker, P], R], *args: P.args, **kwargs: P.kwargs
    ) -> R:
        """Run a method of the workbench now; what goes wrong is said as the worker would."""
        if self.broken:
            raise WorkerError(self.broken)
        bench, model = self._workbench, self.model()
        try:
            bench.restore(model, self._arrays)
            result = job(bench, *args, **kwargs)
        except PyrcalError:
            raise
        except Exception as error:
            raise WorkerError(f"{job.__name__} failed in the worker: {error!r}") from error
        self._arrays = bench.arrays
        if bench.state != model:
            self.changed(bench.state)
        return result


class Kept:
    """Keeps interaction matrices in memory."""

    def __init__(self) -> None:
        self.records: list[MeasurementRecord] = []

    def store(
        self,
        record: MeasurementRecord,
        numbers: NDArray[np.float32] | NoisyNumbers,
        name: str,
    ) -> None:
        """Keep what is known of one; nobody asks for its numbers."""
        self.records.append(record)


class KeptReconstructors:
    """Keeps reconstructors in memory."""

    def __init__(self) -> None:
        self._matrices: dict[str, NDArray[np.float32]] = {}

    def store(
        self,
        record: ReconstructorRecord,
        matrix: NDArray[np.float32],
        covariance: NDArray[np.float64] | None,
        provenance: Mapping[str, Provenance],
    ) -> None:
        """Keep the numbers."""
        self._matrices[record.id] = matrix

    def matrix(self, matrix_id: str) -> NDArray[np.float32]:
        """Return a reconstructor, ``(n_modes, n_slopes)``.

        Raises
        ------
        UnknownIdError
            If it was never stored here.
        """
        if matrix_id not in self._matrices:
            raise UnknownIdError(f"no reconstructor {matrix_id}")
        return self._matrices[matrix_id]


class KeptReferences:
    """Keeps reference slopes in memory."""

    def __init__(self) -> None:
        self._offsets: dict[str, NDArray[np.float32]] = {}

    def store(self, record: ReferencesRecord, offset: NDArray[np.float32]) -> None:
        """Keep the numbers."""
        self._offsets[record.id] = offset

    def matrix(self, reference_id: str) -> NDArray[np.float32]:
        """Return an offset ``(n_slopes,)``.

        Raises
        ------
        UnknownIdError
            If it was never stored here.
        """
        if reference_id not in self._offsets:
            raise UnknownIdError(f"no references {reference_id}")
        return self._offsets[reference_id]


class Shelf:
    """Keeps matrices in memory: a simulated night is over when its program ends."""

    def __init__(self) -> None:
        self.reconstructors = KeptReconstructors()
        self.references = KeptReferences()
        self.measured, self.noisy = Kept(), Kept()


WATCHED_S = 20.0
"""After a swap: an unstable loop needs a fraction of it, an edge may slip after seconds."""

LEAST_S = 0.5
"""Less than this of a matrix in use tells nothing."""

GROWTH = 2.0
"""A wavefront error that ends so much above the one before, and above the night's best, has grown:
seeing that gets worse by a half in this time makes 1.4."""

STROKE_M = 1e-8
"""Of the push and pull that find a telescope's response, metres RMS: a pyramid is linear there."""


class Outcome(StrEnum):
    """What a matrix did to the loop."""

    HELD = "held"
    DIVERGED = "diverged"
    UNTESTED = "untested"
    """It was not applied, or not for long enough to tell."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Swap:
    """A matrix as it came into use."""

    id: str
    n_modes: int
    time_s: float
    alpha: Misregistration
    """Where the mirror truly lay."""

    made_for: Misregistration | None
    """The registration it was computed for; None: not by the service."""

    gate: GateVerdict | None
    """The service's own verdict before it was sent; None: not judged."""

    radius: float | None
    """Largest pole radius around the telescope's true response to a flat wavefront: without the
    optical gain, which lowers the loop gain; 1 is the edge. None: it was not looked at."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Publication:
    """A swap, and what came of it."""

    swap: Swap
    before_nm: float
    """RMS wavefront error during the second before the swap."""

    after_nm: float
    """The same during the last second of the watch; NaN: there is none."""

    outcome: Outcome


def published(swap: Swap, moments: Sequence[Moment], until_s: float) -> Publication:
    """Judge one swap by the moments around it; the watch ends at ``until_s`` at the latest.

    That is the next swap, the next jump of the mirror or the end of the night: what comes after is
    not the matrix's doing.
    """
    end_s = min(swap.time_s + WATCHED_S, until_s)
    before = [m for m in moments if swap.time_s - 1.0 < m.time_s <= swap.time_s]
    after = [m for m in moments if swap.time_s < m.time_s <= end_s]
    late = [m for m in after if m.time_s > end_s - 1.0]
    before_nm, after_nm = _rms_nm(before), _rms_nm(late)
    clipped = any(m.n_clipped for m in after) and not any(m.n_clipped for m in before)
    quiet_nm = min((m.wavefront_nm for m in moments if m.time_s > 1.0), default=np.nan)
    grown = after_nm > GROWTH * max(before_nm, quiet_nm)
    outcome = Outcome.HELD
    if grown or clipped or (swap.radius or 0.0) >= 1.0:
        outcome = Outcome.DIVERGED
    elif end_s - swap.time_s < LEAST_S:
        outcome = Outcome.UNTESTED
    return Publication(swap=swap, before_nm=before_nm, after_nm=after_nm, outcome=outcome)


def true_radius(
    reconstructor: NDArray[np.float32], optics: Optics, settings: LoopSettings
) -> float:
    """Return the largest pole radius of the loop of these optics, its gains and this matrix."""
    n_modes = len(reconstructor)
    coupling = reconstructor @ true_response(optics, n_modes)
    gains = np.array(settings.gains[:n_modes], np.float32)
    eigenvalues = np.linalg.eigvals(gains[:, None] * coupling)
    radii = pole_radius(eigenvalues, leak=settings.leak, delay_frames=settings.delay_frames)
    return float(radii.max())


def true_response(optics: Optics, n_modes: int) -> NDArray[np.float32]:
    """Return the true interaction matrix ``(n_slopes, n_modes)``: known, or pushed and pulled."""
    if isinstance(optics, LinearOptics):
        return optics.slopes_per_command[:, :n_modes]
    if not isinstance(optics, DiffractiveOptics):
        raise TypeError(f"poles: found {type(optics).__name__}; expected a simulated telescope")
    rng = np.random.default_rng(0)
    columns = []
    for mode in range(n_modes):
        stroke = np.float32(STROKE_M) * optics.opd_per_command[:, mode]
        push, pull = (optics.slopes(sign * stroke, None, rng) for sign in (1.0, -1.0))
        columns.append((push - pull) / np.float32(2.0 * STROKE_M))
    return np.column_stack(columns)


def _rms_nm(moments: Sequence[Moment]) -> float:
    if not moments:
        return float("nan")
    return float(np.sqrt(np.mean([m.wavefront_nm**2 for m in moments])))


_Job = tuple[float, Callable[[], None]]
"""How long the worker is at something, seconds, and what it has done then."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Latencies:
    """How long things take at the telescope, seconds of simulated time.

    The worker does one thing after the other, the most urgent first, as the service's does.
    """

    fit_s: float = 0.5
    make_s: float = 2.0
    judge_s: float = 1.0
    watch_s: float = 0.5
    command_s: float = 0.1
    """Until the RTC's answer is here; it acts at once."""

    send_s: float = 0.1
    """Until a matrix is staged; the RTC swaps with its next frames."""

    fetch_s: float = 0.3
    listen_s: float = 0.5
    """Until a matrix of the RTC's own has been compared with the instrument file."""

    status_s: float = 0.2
    """Between two status messages of the RTC."""

    tick_s: float = 1.0
    """Between two looks of the service at what it waits for."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Glance:
    """What the service held to be true at the end of a block."""

    time_s: float
    alpha: NDArray[np.float64] | None
    """``(4,)`` the tracker's registration, numeric units; None: not known."""

    sigma: NDArray[np.float64] | None
    """``(4,)`` 1 σ, floor included."""

    alarms: tuple[str, ...]


@dataclass(order=True, slots=True)
class _Due:
    """Something that will have happened."""

    t_ns: int
    number: int
    """Of two at the same time the one first put down comes first."""

    happen: Callable[[], None] = field(compare=False)


class Observatory:
    """A night in simulated time; ``advance`` lets it pass."""

    hands: Callable[[OpticsWorker], OwnHands] = OwnHands
    """What computes for the service."""

    def __init__(
        self,
        options: Sequence[str],
        policy: Policy,
        mode: Mode,
        workbench: OpticsWorker,
        *,
        latencies: Latencies | None = None,
        with_poles: bool = True,
        dome: Dome | None = None,
        link: Callable[[Any], ShortLink] = ShortLink,
        archive: StorePort | None = None,
    ) -> None:
        """Take the simulator's command line, ``--plant linear --seed 1``, and the policy.

        ``with_poles`` finds the true poles of every swap, seconds on a diffractive telescope.
        ``dome`` and ``link`` are another telescope and the way to it; without an ``archive``
        matrices are kept in memory.
        """
        self.dome = dome or Dome(options)
        self.latencies = latencies or Latencies()
        system = self.dome.computer.identity.system
        about = self.dome.instrument
        workbench.restore(ModelState(), {})
        description = workbench.describe()
        state = TrackerState(
            system=system,
            model=workbench.state,
            operator=OperatorState(mode=mode),
            loop=LoopState(basis_id=about.basis_id, config_id=about.config_id),
        )
        self._engine = Engine(state, policy, self, step=self.step)
        self._engine.set_description(description)
        self.glances: list[Glance] = []
        self.swaps: list[Swap] = []
        self.events: list[tuple[float, Event]] = []
        """All that the tracker heard and when, status and ticks left out."""

        self._link = link(self.dome)
        self._workers = self.hands(workbench)
        # A job may change the model while a coroutine runs, within which no effect can begin.
        self._changes: list[ModelState] = []
        self._workers.model = lambda: self._changes[-1] if self._changes else self.state.model
        self._workers.changed = self._changes.append
        self._shelf: StorePort = archive or Shelf()
        self._publishing = Publishing(
            system=system, chunk_bytes=CHUNK_LIMIT, pole_radius_bound=0.95
        )
        self._actions = self._new_actions()
        self._n_restarts = 0
        self._agenda: list[_Due] = []
        self._numbers = itertools.count()
        self._with_poles = with_poles
        self._idle_worker()
        self._begin()

    @property
    def state(self) -> TrackerState:
        """What the service knows now."""
        return self._engine.state

    @property
    def time_s(self) -> float:
        """Seconds since the night began."""
        return self.dome.time_s

    def advance(self, seconds: float) -> None:
        """Let so much time pass.

        Raises
        ------
        TypeError
            If the service wants something done that no observatory here can do.
        """
        until_s = self.time_s + seconds
        while self.time_s < until_s - 1e-9:
            blocks = self.dome.play()
            self._happen()
            self._engine.feed(blocks)
            self._acknowledged()
            self._look()

    def command(self, command: commands.Command) -> None:
        """Do what an operator would: raises what the tracker refuses."""
        self._post(command)

    def matrix(self, matrix_id: str) -> NDArray[np.float32]:
        """Return one of the last reconstructors ``(n_modes, n_slopes)``."""
        return self._actions.matrix(matrix_id)

    def force(self, matrix: NDArray[np.float32]) -> None:
        """Have the service send a matrix that the gate has never seen as if it had accepted it."""
        state, n_modes = self.state, len(matrix)
        registration, rtc, margin = state.alpha.registration, state.loop.rtc, state.matrices.margin
        if registration is None or rtc is None or margin is None:
            raise ValueError("force: found no α, no RTC or no verdict; expected a night under way")
        record = ReconstructorRecord(
            id=f"forced-{self.dome.frame}",
            state=MatrixState.PROPOSED,
            n_modes=n_modes,
            created_ns_utc=self.dome.now_ns,
            alpha=registration.alpha,
            sigma=registration.sigma,
            parent=state.matrices.in_use,
            sha256=checksum(matrix),
            gate=margin,
            judged=present_conditions(state, select_gains(rtc, n_modes)),
        )
        self._shelf.reconstructors.store(record, matrix, registration.total_covariance, {})
        self._post(ev.MatrixMade(record=record, wanted=True))

    def publications(self) -> list[Publication]:
        """Return what has come of every matrix that was swapped in, so far."""
        jumps = (*self.dome.jump_times_s, *(swap.time_s for swap in self.swaps), self.time_s)
        return [
            published(
                swap, self.dome.moments, min((t for t in jumps if t > swap.time_s), default=0.0)
            )
            for swap in self.swaps
        ]

    def restart_rtc(self) -> None:
        """Let the RTC begin again with the matrix it started the night with."""
        self._n_restarts += 1
        self.dome.restart()
        self._link.void()
        self._hear(ev.SessionStarted(session=self.dome.computer.session))

    def _new_actions(self) -> Actions:
        """Return what carries out effects, nothing in its memory."""
        return Actions(
            bridge=self._link,
            workers=self._workers,
            archive=self._shelf,
            instrument=self.dome.instrument,
            publishing=self._publishing,
            clock_ns=lambda: self.now_ns(),
        )

    def _begin(self) -> None:
        self._post(ev.LogEvent(name="service.ready", text="a night in simulated time"))
        self._hear(ev.LogEvent(name="rtc.appeared", text="the RTC is there"))
        session = self.dome.computer.session
        self._hear(ev.SessionStarted(session=session))
        self._every(self.latencies.status_s, self._hear_status)
        self._every(self.latencies.tick_s, lambda: self._post(ev.Tick()))
        self._in(PASSIVE_INTERVAL_S, self._watch)

    def _idle_worker(self) -> None:
        self._jobs: list[tuple[float, int, Callable[[], _Job]]] = []
        self._busy = self._fitting = False
        self._backlog = PendingWindow()

    def _at(self, t_ns: int, happen: Callable[[], None]) -> None:
        heapq.heappush(self._agenda, _Due(t_ns, next(self._numbers), happen))

    def _in(self, seconds: float, happen: Callable[[], None]) -> None:
        self._at(self.dome.now_ns + round(seconds * SECOND_NS), happen)

    def _every(self, seconds: float, happen: Callable[[], None]) -> None:
        def again() -> None:
            happen()
            self._in(seconds, again)

        self._in(seconds, again)

    def _work(self, job: Callable[..., object], begin: Callable[[], _Job]) -> None:
        """Have the worker begin something once it has a hand free, and what is more urgent done."""
        due_s = self.time_s + patience_s(job)
        heapq.heappush(self._jobs, (due_s, next(self._numbers), begin))
        self._work_on()

    def _work_on(self) -> None:
        while self._jobs and not self._busy:
            *_, begin = heapq.heappop(self._jobs)
            lasts_s, done = begin()

            def over(done: Callable[[], None] = done) -> None:
                self._busy = False
                done()
                self._work_on()

            self._busy = True
            self._in(lasts_s, over)

    def _happen(self) -> None:
        """Let everything happen that is due."""
        while self._agenda and self._agenda[0].t_ns <= self.dome.now_ns:
            heapq.heappop(self._agenda).happen()

    def _hear(self, event: Event) -> None:
        self._engine.receive(event)

    def _hear_status(self) -> None:
        self._hear(self.dome.status())

    def _acknowledged(self) -> None:
        for answer in self._link.swapped():
            self._note_swap()
            self._hear(answer)

    def _note_swap(self) -> None:
        rtc = self.dome.computer
        matrix, optics = rtc.reconstructor.matrix, self.dome.optics
        record = self.state.reconstructor(rtc.reconstructor.manifest.id)
        swap = Swap(
            id=rtc.reconstructor.manifest.id,
            made_for=None if record is None else record.alpha,
            gate=None if record is None else record.gate,
            n_modes=len(matrix),
            time_s=self.time_s,
            alpha=self.dome.alpha,
            radius=true_radius(matrix, optics, rtc.settings) if self._with_poles else None,
        )
        self.swaps.append(swap)

    def _look(self) -> None:
        registration = self.state.alpha.registration
        self.glances.append(
            Glance(
                time_s=self.time_s,
                alpha=None if registration is None else registration.alpha.vector,
                sigma=None if registration is None else registration.sigma,
                alarms=tuple(alarm.name for alarm in self.state.alarms.active),
            )
        )

    def fit(self, window: EndedWindow) -> None:
        """Fit a window at once if the worker has a hand free, else after what it is at."""
        if isinstance(window, Correlated):
            self._actions.noisy.take(window, self.state)
        given_up = self._backlog.put(window)
        if given_up is not None:
            self._post(ev.WindowLost(refused=given_up))
        if not self._fitting:
            self._fitting = True
            self._work(OpticsWorker.fit, self._fit_next)

    def _fit_next(self) -> _Job:
        window = self._backlog.take()
        if window is None:
            self._fitting = False
            return 0.0, _nothing
        event = self._run(fitted(window, self.state, self._workers, self._actions.matrix))

        def done() -> None:
            self._post(event)
            self._work(OpticsWorker.fit, self._fit_next)

        return self.latencies.fit_s, done

    def _run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine to its end, then post how its jobs changed the model."""
        result = asyncio.run(coroutine)
        changes, self._changes[:] = tuple(self._changes), []
        for model in changes:
            self._post(ev.ModelChanged(model=model))
        return result

    def _watch(self) -> None:
        self._work(OpticsWorker.fit_passive, self._look_at_sums)

    def _look_at_sums(self) -> _Job:
        sums = self._engine.take_sums()
        events = self._run(fit_passive(sums, self.state, self._workers))

        def done() -> None:
            for event in events:
                self._post(event)
            self._in(PASSIVE_INTERVAL_S, self._watch)

        return self.latencies.watch_s if events else 0.0, done

    def _post(self, event: Event, cause: str = "") -> None:
        self._engine.post(event, cause)

    def now_ns(self) -> int:
        """Return the time, nanoseconds UTC."""
        return self.dome.now_ns

    def step(
        self, state: TrackerState, event: Event, policy: Policy, now_ns: int, cause: str
    ) -> tuple[TrackerState, tuple[Effect, ...]]:
        """Let the tracker decide."""
        return step(state, event, policy, now_ns, cause)

    def stepped(self, before: TrackerState, event: Event) -> None:
        """Keep what the tracker heard."""
        if not isinstance(event, ev.Tick | Status):
            self.events.append((self.time_s, event))

    def perform(self, effect: Effect) -> None:
        """Do what the tracker wants done."""
        self._do(effect, self.state)

    def swapped(self, in_use: str | None) -> None:
        """Watch what a matrix does that has come into use."""
        if in_use is not None:
            self._hear_out(in_use)

    def sensor_mode_changed(self, config_id: str) -> None:
        """Have the worker model another mode of the sensor, as soon as it has a hand free."""

        def begin() -> _Job:
            description = self._run(self._workers.call(OpticsWorker.describe))

            def done() -> None:
                if self.state.loop.config_id == config_id:
                    self._engine.set_description(description)
                    self._post(ev.LogEvent(name="service.ready", text=config_id))
                    self.swapped(self.state.matrices.in_use)

            return self.latencies.make_s, done

        self._work(OpticsWorker.describe, begin)

    def _hear_out(self, in_use: str) -> None:
        """Watch what the matrix in use does, and learn from it how the RTC speaks."""
        matrix, record = self._actions.matrix(in_use), self.state.reconstructor(in_use)
        self._engine.learn(in_use, matrix)
        if record is not None:
            read = read_own_matrix(record, matrix, self.state, self._workers, self._actions.matrix)
            for event in self._run(read):
                self._in(self.latencies.listen_s, partial(self._post, event))

    def _do(self, effect: Effect, state: TrackerState) -> None:
        """Carry an effect out; what comes of it is heard when it would be."""
        job, lasts_s = self._takes(effect)

        def begin() -> _Job:
            event = self._performed(effect, state)
            return lasts_s, lambda: self._done(event, effect.cause)

        if job is not None:
            self._work(job, begin)
        else:
            _, done = begin()
            self._in(lasts_s, done)

    def _performed(self, effect: Effect, state: TrackerState) -> Event | None:
        try:
            if isinstance(effect, ev.SendMatrix):
                self._engine.learn(effect.id, self._actions.matrix(effect.id))
            event = self._run(self._actions.perform(effect, state))
        except PyrcalError as error:
            event = ev.JobFailed(effect=effect, text=str(error))
        while self._link.sent:
            sent = partial(self._deliver, self._n_restarts, *self._link.sent.pop())
            self._in(self.latencies.send_s, sent)
        return event

    def _arrive(self) -> None:
        """Let every matrix that is on its way to the RTC come there."""
        for due in sorted(self._agenda):
            if isinstance(due.happen, partial) and due.happen.func == self._deliver:
                due.happen()

    def _deliver(self, n_restarts: int, manifest: Manifest, matrix: NDArray[np.float32]) -> None:
        if n_restarts != self._n_restarts:
            return  # on its way to a process that is gone, and its connection with it
        for answer in self._link.deliver(manifest, matrix):
            self._hear(answer)

    def _done(self, event: Event | None, cause: str) -> None:
        if event is not None:
            self._post(event, cause)

    def _takes(self, effect: Effect) -> tuple[Callable[..., object] | None, float]:
        """Return the worker's job that an effect asks for, if any, and how long it takes."""
        wait = self.latencies
        match effect:
            case ev.MakeMatrix():
                return OpticsWorker.make, wait.make_s
            case ev.JudgeMatrix():
                return OpticsWorker.margin, wait.judge_s
            case ev.RepublishMatrix(judged=True) | ev.JudgeProposal():
                return OpticsWorker.judge, wait.judge_s
            case ev.MakeReferences():
                return OpticsWorker.make_references, wait.make_s
            case ev.FetchMatrix() | ev.FetchReferences():
                return None, wait.fetch_s
            case ev.SendReferences():
                return None, wait.command_s
            case ev.RepublishMatrix() | ev.SendMatrix() | ev.Ask() | ev.FinishNoisy():
                return None, wait.command_s
            case _:
                raise TypeError(
                    f"observatory: found {type(effect).__name__}; expected an effect whose "
                    "duration is known here (pyrcal_studies.campaign.observatory)"
                )


def _nothing() -> None:
    pass


SMALL = "tests/system/small.toml"

N_TARGET = 60
"""Modes that its matrices are to control in the end."""

SETTINGS: Mapping[str, object] = {
    "dither.budget_m": 40e-9,
    "dither.amplitude_m": 20e-9,
    "dither.window_s": 1.0,
    "dither.longest_window_s": 1.0,
    "control.n_modes_target": N_TARGET,
    "tracking.floor_rotation_deg": 0.04,
    "tracking.floor_magnification": 0.0007,
}
"""Of the service: few modes must tell as much as many."""


def latencies_of(slower: float = 1.0) -> Latencies:
    """Return how long things take with a worker that takes so many times longer."""
    return Latencies(fit_s=0.5 * slower, make_s=2.0 * slower, judge_s=slower, watch_s=0.5 * slower)


@cache
def bench_of(instrument: str, sampling: int | None = None) -> OpticsWorker:
    """Return the worker of an instrument, one per process; ``sampling`` None: the usual one."""
    points = Sampling() if sampling is None else Sampling(sampling, sampling)
    return OpticsWorker(load_instrument(instrument), Compute(threads=1, sampling=points))
