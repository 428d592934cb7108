"""An RTC that says one thing and does another, in simulated time: what strangers' RTCs have done.

The telescope is the simulator's. Between it and the service stands a dialect (axes, signs and order
of the slopes, unit of the commands) and a status, acknowledgements and dithers that need not be
true. Nothing here knows how the service finds out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from pyrcal.rtc.identity import Reconstructor
from pyrcal_studies.campaign.observatory import Dome, ShortLink
from service.estimation.frames import FrameBlock
from service.model.pupil import valid_subapertures
from service.wire import (
    Acknowledgement,
    Command,
    DitherRequest,
    LoopRequest,
    Manifest,
    Reply,
    Status,
    layout_of,
)
from sim_rtc.computer.activities import MAX_DITHER_AMPLITUDE_M

STRONG = 20.0
"""A dither is so much stronger than was asked for, as far as the mirror goes."""

TRUE_LEAK, TOLD_LEAK = 0.90, 0.99


class Mischief(StrEnum):
    """One way of not keeping to the contract, or to the truth."""

    SIGN = "sign"
    """Slopes, and so the matrices, of the other sign."""

    FLIP_X = "flip-x"
    FLIP_Y = "flip-y"
    SWAP_XY = "swap-xy"
    ORDER_YX = "order-yx"
    INTERLEAVED = "interleaved"
    NANOMETRES = "nanometres"
    """Commands, and so the matrices, in nanometres."""

    MICROMETRES = "micrometres"
    LEAK = "leak"
    """0.99 is told, 0.90 is true."""

    DELAY = "delay"
    """A frame less is told than there is."""

    GAIN = "gain"
    """Half the gain is told."""

    SEEING_GAINS = "seeing-gains"
    """Gains that move by 1 % with every status: nothing wrong with that."""

    STRONG_DITHER = "strong-dither"
    OTHER_SHA = "other-sha"
    """What is acknowledged is not what was sent."""

    NO_ACK = "no-ack"
    NO_STATUS = "no-status"
    NO_CM_ID = "no-cm-id"


DIALECTS = frozenset(list(Mischief)[:8])
"""Those of telemetry and matrices: an RTC changes them only when it starts anew."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dialect:
    """How slopes and commands are listed on the wire."""

    index: NDArray[np.intp]
    """``(n_slopes,)``: the place on the wire ``k`` shows slope ``index[k]``."""

    sign: NDArray[np.float32]
    """``(n_slopes,)`` of each place on the wire."""

    unit: float
    """Commands on the wire over commands in metres."""

    def told(self, matrix: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a reconstructor as the RTC would show it."""
        shown = matrix[:, self.index] * self.sign * np.float32(self.unit)
        return np.ascontiguousarray(shown, dtype=np.float32)

    def meant(self, matrix: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what the loop does with a reconstructor it is sent: the inverse of ``told``."""
        inner = np.empty_like(matrix)
        inner[:, self.index] = matrix * self.sign / np.float32(self.unit)
        return inner

    def spoken(self, block: FrameBlock) -> FrameBlock:
        """Return telemetry as it is sent."""
        unit, dither = np.float32(self.unit), block.dither_m
        return replace(
            block,
            slopes=block.slopes[:, self.index] * self.sign,
            commands_m=block.commands_m * unit,
            dither_m=None if dither is None else dither * unit,
        )


def dialect_of(mischief: Mischief | None, mask: NDArray[np.bool_]) -> Dialect:
    """Return the dialect of an RTC; ``mask`` ``(n, n)`` [y, x] are its valid subapertures."""
    n_valid = int(mask.sum())
    number = np.full(mask.shape, -1)
    number[mask] = np.arange(n_valid)
    places, signs = (number, number), (1.0, 1.0)
    match mischief:
        case Mischief.SIGN:
            signs = (-1.0, -1.0)
        case Mischief.FLIP_X:
            places, signs = (number[:, ::-1],) * 2, (-1.0, 1.0)
        case Mischief.FLIP_Y:
            places, signs = (number[::-1],) * 2, (1.0, -1.0)
        case Mischief.SWAP_XY:
            places = (number.T, number.T)
        case _:
            pass
    first, second = (place[place >= 0] for place in places)
    if mischief is Mischief.SWAP_XY:
        index = np.concatenate([first + n_valid, second])
    else:
        index = np.concatenate([first, second + n_valid])
    sign = np.repeat(np.array(signs, dtype=np.float32), n_valid)
    order = np.arange(2 * n_valid)
    if mischief is Mischief.ORDER_YX:
        order = np.roll(order, n_valid)
    elif mischief is Mischief.INTERLEAVED:
        order = order.reshape(2, -1).T.ravel()
    unit = {Mischief.NANOMETRES: 1e9, Mischief.MICROMETRES: 1e6}.get(mischief or Mischief.GAIN, 1.0)
    return Dialect(index=index[order], sign=sign[order], unit=unit)


class StrangeDome(Dome):
    """A telescope whose RTC gets up to mischief: ``mischief`` may change at any time."""

    def __init__(self, words: Sequence[str]) -> None:
        super().__init__(words)
        self.mischief: set[Mischief] = set()
        self._asked: dict[str, DitherRequest] = {}
        self._n_told = 0
        self.speak(None)

    def speak(self, mischief: Mischief | None) -> None:
        """Take up a dialect, None the right one, as an RTC does that is set up anew."""
        self.dialect = dialect_of(mischief, valid_subapertures(self.instrument))
        self.mischief -= DIALECTS
        self.mischief |= {mischief} if mischief else set()

    def begin(self, mischief: Mischief) -> None:
        """Get up to something that needs no new session."""
        self.mischief.add(mischief)
        if mischief is Mischief.LEAK:
            self._leak(TRUE_LEAK)

    def end(self, mischief: Mischief) -> None:
        """Behave again."""
        self.mischief.discard(mischief)
        if mischief is Mischief.LEAK:
            self._leak(TOLD_LEAK)

    def _leak(self, leak: float) -> None:
        self.computer.execute(LoopRequest(id=f"strange-{self.frame}", leak=leak))

    @override
    def play(self) -> list[FrameBlock]:
        """Let one block of frames pass and return what is sent of it."""
        return [self.dialect.spoken(block) for block in super().play()]

    @override
    def order(self, command: Command) -> Reply:
        """Tell the RTC something and return its answer."""
        if Mischief.STRONG_DITHER in self.mischief and isinstance(command, DitherRequest):
            self._asked[command.id] = command
            most_m = MAX_DITHER_AMPLITUDE_M
            strong = tuple(min(STRONG * a, most_m) for a in command.amplitude_m)
            command = replace(command, amplitude_m=strong)
        return super().order(command)

    @override
    def stage(self, reconstructor: Reconstructor) -> None:
        """Hand the loop a matrix, as it understands it."""
        super().stage(replace(reconstructor, matrix=self.dialect.meant(reconstructor.matrix)))

    def applied(self) -> tuple[Manifest, NDArray[np.float32]]:
        """Return the matrix in use as the RTC shows it."""
        active = self.computer.reconstructor
        matrix = self.dialect.told(active.matrix)
        layout = layout_of(matrix, active.manifest.layout.chunk_bytes)
        return replace(active.manifest, layout=layout), matrix

    @override
    def status(self) -> Status:
        """Return what the RTC says of itself, true or not."""
        status = super().status()
        self._n_told += 1
        dither = status.dither
        if dither is not None and dither.request.id in self._asked:
            asked = self._asked[dither.request.id]
            status = replace(status, dither=replace(dither, request=asked))
        if Mischief.LEAK in self.mischief:
            status = replace(status, leak=TOLD_LEAK)
        if Mischief.DELAY in self.mischief:
            status = replace(status, delay_frames=status.delay_frames - 1.0)
        if Mischief.NO_CM_ID in self.mischief:
            status = replace(status, cm_id=None)
        factor = 0.5 if Mischief.GAIN in self.mischief else 1.0
        if Mischief.SEEING_GAINS in self.mischief:
            factor *= 1.0 + 0.01 * (self._n_told % 2)
        return replace(status, gains=tuple(factor * gain for gain in status.gains))


class StrangeLink(ShortLink):
    """The way to it and back: what is acknowledged need not be what was sent."""

    def __init__(self, dome: StrangeDome) -> None:
        super().__init__(dome)
        self._strange = dome

    @override
    async def fetch_applied(self) -> tuple[Manifest, NDArray[np.float32]]:
        """Return the matrix the RTC uses, as it shows it."""
        return self._strange.applied()

    @override
    def _told(self, acknowledgement: Acknowledgement) -> Acknowledgement:
        other = Mischief.OTHER_SHA in self._strange.mischief
        return replace(acknowledgement, sha256="0" * 64) if other else acknowledgement
