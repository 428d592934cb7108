"""A simulated telescope and its RTC in simulated time: frames, status, orders, and the truth."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from pyrcal.rtc.identity import Reconstructor
from service.estimation.frames import FrameBlock
from service.instrument import load_instrument
from service.model.misregistration import Misregistration
from service.wire import Command, Reply, Status, decode, encode
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.computer.feed import BATCH_FRAMES, Block
from sim_rtc.computer.telemetry import Batch, FrameClock
from sim_rtc.options import Options, parse_options
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
            self._clock.stamped(self.computer.status()),
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
            error for part in _alike(batches, _optics_of) for error in self._error.rms_nm(part)
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
    return batch.session, batch.cm_id, batch.dither_m is None


def _optics_of(batch: Batch) -> object:
    return id(batch.optics)


def _alike(batches: list[Batch], by: Callable[[Batch], object]) -> list[list[Batch]]:
    """Return the batches in runs of which all are alike."""
    return [list(run) for _, run in itertools.groupby(batches, by)]
