"""A telescope measured by day, and the model put in its place: what studies of matrices begin with.

The matrix is measured with noise, push and pull, mode by mode, on the diffractive telescope with
its light through the mirror twice; the registration is what a small joint fit of all its modes
says, with a free gain for each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.rtc.identity import Identity
from service.estimation.solver import Columns, Projection
from service.instrument import load_instrument
from service.model.interaction import InteractionModel, Linearisation
from service.model.misregistration import Misregistration
from service.wire import MeasureRequest, Pattern
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.options import parse_options
from sim_rtc.telescope.diffractive import DiffractiveOptics

Array = NDArray[Any]

N_MEASURED = 400
PASSES = 2
STROKE_M = 20e-9
_N_STEPS = 4
_CALM = "--seeing 0.05 --vibration none"
"""Nothing is played on the mirror while its matrix is measured; 0.05 is the least seeing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registered:
    """The model where the measured matrix puts it."""

    alpha: Misregistration
    gains: NDArray[np.float64]
    """``(n_measured,)`` measured over model, both of one pass."""

    residual: float
    """RMS of measured less fitted model over the RMS of the measured."""


def telescope_of(words: str) -> Telescope:
    """Return a fresh telescope of these options of ``pyrcal sim``: the same sky every time."""
    options = parse_options(words.split())
    return build_telescope(options, load_instrument(options.instrument))


def measured_by_day(words: str, n_average: int) -> tuple[Array, Telescope]:
    """Return a matrix of one pass ``(n_slopes, 400)`` and the telescope it is of.

    ``n_average`` is the number of pushes and pulls of each mode; 0: as if there were no noise.

    Raises
    ------
    ValueError
        If the telescope refuses the measurement.
    """
    telescope = telescope_of(f"{words} {_CALM}")
    if n_average == 0:
        return noise_free(telescope), telescope
    computer = telescope.computer(iter(telescope.feed.blocks()))
    computer.prepare()
    reply = computer.execute(
        MeasureRequest(
            id="study",
            pattern=Pattern.PUSH_PULL_MODAL,
            modes=tuple(range(N_MEASURED)),
            amplitude_m=(STROKE_M,) * N_MEASURED,
            n_average=n_average,
        )
    )
    if not reply.accepted:
        raise ValueError(f"measurement: refused: {reply.reason}")
    while not (ended := computer.take_measured()):
        computer.next_batch()
    here = Identity(system="study", basis_id="basis", config_id="sensor", double_pass=True)
    manifest, matrix = ended[0].product(here, created_ns=0)
    if matrix is None:
        raise ValueError(f"measurement: {manifest.reason}")
    return matrix.astype(np.float64) / PASSES, telescope


def noise_free(
    telescope: Telescope,
    n_modes: int = N_MEASURED,
    stroke_m: float = STROKE_M,
    passes: int = PASSES,
) -> Array:
    """Return the matrix by push-pull without noise, ``(n_slopes, n_modes)``, of one pass."""
    optics = telescope.optics.at(0.0)
    if not isinstance(optics, DiffractiveOptics):
        raise TypeError(f"study: found {type(optics).__name__}; expected --plant diffractive")
    rng = np.random.default_rng(0)
    columns = []
    for mode in range(n_modes):
        stroke = stroke_m * optics.opd_per_command[:, mode]
        push, pull = (optics.slopes(sign * stroke, None, rng) for sign in (1.0, -1.0))
        columns.append((push - pull).astype(np.float64) / (2 * stroke_m * passes))
    return np.column_stack(columns)


def against(
    linear: Linearisation,
    measured: Array,
    modes: slice | Sequence[int] = slice(None),
    read: NDArray[np.bool_] | None = None,
) -> Projection:
    """Return measured columns ``(n_slopes, n_modes)`` beside the model's of these modes.

    Each has a gain of its own, and all weigh alike. ``read`` ``(n_slopes,)`` are the slopes that
    count, None: all.
    """
    rows = np.ones(len(measured), dtype=np.bool_) if read is None else read
    matrix = measured.astype(np.float64)
    columns = Columns(matrix=matrix, weights=1.0 / np.sum(matrix[rows] ** 2, axis=0), rows=rows)
    return columns.project(linear.matrix[:, modes], linear.derivatives[:, :, modes])


def step_of(seen: Projection) -> NDArray[np.float64]:
    """Return by how much α ``(4,)`` is off, to first order, numeric units."""
    return np.linalg.solve(seen.normal, seen.scores.sum(axis=1))


def registered(
    model: InteractionModel,
    measured: Array,
    start: Misregistration | None = None,
    read: NDArray[np.bool_] | None = None,
) -> Registered:
    """Return the joint fit of α and a gain per mode; ``read`` as of :func:`against`."""
    vector = (start or Misregistration()).vector
    for _ in range(_N_STEPS):
        linear = model.linearise(Misregistration.from_vector(vector))
        seen = against(linear, measured, slice(measured.shape[1]), read)
        vector = vector + step_of(seen)
    left = np.linalg.norm(seen.residual)
    used = measured if read is None else measured[read]
    return Registered(
        alpha=Misregistration.from_vector(vector),
        gains=seen.gains,
        residual=float(left / np.linalg.norm(used)),
    )
