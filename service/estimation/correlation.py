"""Registration from correlations of a loop's commands with one another, without the slopes.

An integrator's increment ``δ_{k+d} = -g R s_k`` is what the sensor saw ``d`` frames before, so what
a command did to the mirror is in the increment ``d`` frames later, where the mirror lies on the
sensor: ``E[δ_{k+d} c_k^T]`` has the shape of ``-g R D(α)`` (Berdeu et al. 2024, who correlate
increments with increments, and read off where in space their correlation has its peak).

Turbulence moves with the wind, too, and increments have more of it than of noise. Correlations at
several lags, ``d - 1`` and longer, are therefore summed with weights that leave out what is smooth
in time: those of the filter of :mod:`service.estimation.passive`. The rest of it is the same
regression, of increments instead of slopes: R has left one number a mode of the slopes, and with
them what they tell that no mode of the loop could do.

References
----------
Berdeu et al. 2024, arXiv 2410.06569.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.estimation import passive
from service.estimation.estimate import PASSIVE_BIAS, BiasBlock, PassiveEstimate
from service.estimation.estimator import Change, FrameContext, LoopContext
from service.estimation.frames import FrameBlock, joined_frames
from service.estimation.passive import Passive
from service.estimation.passive_sums import PassiveSums
from service.estimation.windows import ClosedLoop
from service.model.interaction import Linearisation

WHOLE_FRAME = 0.05
"""A delay further than this from whole frames is spread over two increments."""

_RANK = 1e-5
"""Of the largest singular value: what is smaller is rounding."""

CORRELATION_BIAS = BiasBlock(
    name="commands",
    floor=PASSIVE_BIAS.floor,
    over_scatter=PASSIVE_BIAS.over_scatter,
    wander=PASSIVE_BIAS.wander,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommandCorrelation(PassiveSums):
    """Forgetting sums of products of increments and of the commands before them."""

    resets = PassiveSums.resets | Change.MATRIX

    sums: Passive
    """Of increments, over gain and noise, in place of slopes."""

    terms: ClosedLoop | None = None
    """The loop that makes the increments; None: no frame of a known one has come."""

    @classmethod
    @override
    def begin(cls, loop: LoopContext) -> CommandCorrelation:
        """Return sums of the loop that have begun with nothing."""
        sums = Passive.begin(loop)
        return cls(n_modes=sums.n_modes, sums=sums)

    @override
    def update(self, frames: FrameContext) -> CommandCorrelation:
        """Return them with one more block."""
        if frames.terms is None:
            return self
        return accumulate(replace(self, terms=frames.terms), frames.moving)

    @override
    def emptied(self, *, rests: bool) -> CommandCorrelation:
        """Return them with nothing multiplied, nor anything that waits where they rest."""
        sums = self.sums.emptied(rests=rests)
        return replace(self, sums=sums, n_effective=sums.n_effective)

    @override
    def fit(self, linearisation: Linearisation) -> PassiveEstimate | None:
        """Estimate α about a linearisation; None: too few frames have come."""
        return fit(self, linearisation)

    @property
    def lag(self) -> int:
        """Frames from a command to the increment that answers it."""
        return round(self.sums.delay_frames)

    @property
    @override
    def n_waiting(self) -> int:
        """Frames whose answer has come and that are not multiplied yet."""
        return self.sums.n_waiting

    @property
    @override
    def n_instruments(self) -> int:
        """Modes whose commands are the instruments of the regression."""
        return self.sums.n_instruments

    @property
    @override
    def why_unusable(self) -> str | None:
        """Return why this loop's telemetry says nothing, or None."""
        delay_frames = self.sums.delay_frames
        if abs(delay_frames - self.lag) > WHOLE_FRAME:
            return (
                f"no correlation of commands: the loop's delay is {delay_frames:g} frames, whole "
                "ones are needed to know which command answers which"
            )
        return self.sums.why_unusable


def accumulate(state: CommandCorrelation, block: FrameBlock) -> CommandCorrelation:
    """Add a block of frames; a frame counts once its answer has come, ``lag`` frames later."""
    terms = state.terms
    if terms is None or state.why_unusable is not None or block.first_seq < state.from_seq:
        return state
    block = replace(block, slopes=block.slopes[:, :0])
    frames = block
    if state.tail is not None and block.follows(state.tail):
        frames = joined_frames(_alike(state.tail, block))
    state = replace(state, tail=frames.last(state.lag))
    n_answered = frames.n_frames - state.lag
    if n_answered < 1:
        return state
    answered = replace(frames.rows(0, n_answered), slopes=seen(frames, terms, state.lag))
    sums = passive.accumulate(state.sums, answered)
    return replace(state, sums=sums, n_effective=sums.n_effective)


def _alike(*blocks: FrameBlock) -> tuple[FrameBlock, ...]:
    """Return blocks all of which say what of their commands is dither, or none."""
    if all(block.dither_m is None for block in blocks):
        return blocks
    none = (np.zeros_like(block.commands_m) for block in blocks)
    return tuple(
        replace(block, dither_m=still) if block.dither_m is None else block
        for block, still in zip(blocks, none, strict=True)
    )


def seen(frames: FrameBlock, terms: ClosedLoop, lag: int) -> NDArray[np.float32]:
    """Return what R saw in all frames but the last ``lag``, by the commands that it led to.

    ``R s_k = -(c_{k+d} - leak c_{k+d-1}) / g``, metres, ``(n_frames - lag, n_rows)``: a column for
    each mode of the loop that has a gain.
    """
    own, rows = frames.without_dither().commands_m, _rows(terms)
    new = own[lag:, rows] - np.float32(terms.leak) * own[lag - 1 : -1, rows]
    return np.asarray(new / -terms.gains[rows].astype(np.float32))


def _rows(terms: ClosedLoop) -> NDArray[np.intp]:
    return np.flatnonzero(terms.gains[: len(terms.reconstructor)] > 0.0)


def fit(state: CommandCorrelation, linearisation: Linearisation) -> PassiveEstimate | None:
    """Fit α and a free gain per mode to what R saw of commands; None when too few frames came.

    As slopes are fitted, after ``(R R^T)^-1/2``: what is left of white slopes is white then, and
    the model is D as that many patterns of slopes see it.
    """
    terms = state.terms
    if terms is None or not state.sums.sums:
        return None
    whitened, patterns = _white(terms)
    cross, *others = state.sums.sums
    sums = replace(
        state.sums,
        sums=(whitened @ cross, *others),
        samples=tuple((whitened @ slopes, commands) for slopes, commands in state.sums.samples),
    )
    model = replace(
        linearisation,
        matrix=patterns @ linearisation.matrix,
        derivatives=np.stack([patterns @ part for part in linearisation.derivatives]),
    )
    found = sums.fit(model)
    return None if found is None else replace(found, bias=CORRELATION_BIAS)


def _white(terms: ClosedLoop) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return what makes the noise of ``R s`` white, and the patterns of slopes that it is then of.

    ``(n_patterns, n_rows)``, per metre, and ``(n_patterns, n_slopes)``, orthonormal.
    """
    left, size, patterns = np.linalg.svd(terms.reconstructor[_rows(terms)], full_matrices=False)
    kept = size > _RANK * size[0]
    return left[:, kept].T / size[kept, None], patterns[kept]
