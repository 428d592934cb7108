"""An RTC whose truth differs from the instrument file in single modes, in simulated time.

Its mirror, sensor, loop and first matrix agree with one another: alone it runs well. They are the
simulator's, with its imperfections, and the modes are others than the file says. Nothing here
knows how the service finds out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from pyrcal.rtc.identity import Reconstructor
from pyrcal_studies.campaign.observatory_checks import true_response
from pyrcal_studies.campaign.observatory_dome import Dome, Moment
from pyrcal_studies.campaign.observatory_link import ShortLink
from service.errors import LinkError
from service.estimation.frames import FrameBlock
from service.model.misregistration import Misregistration
from service.wire import Manifest, checksum, layout_of
from sim_rtc.assembly import Telescope
from sim_rtc.computer.feed import Block
from sim_rtc.computer.loop import LoopBlock, LoopTerms, ModalLoop
from sim_rtc.computer.reconstructors import compute_truncated_inverse
from sim_rtc.computer.telemetry import Batch
from sim_rtc.options import Options
from sim_rtc.telescope.linear import LinearOptics
from sim_rtc.telescope.mirror import modal_content
from sim_rtc.telescope.plant import Optics

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
