"""The simulator's own reconstructors and reference slopes, and the names of basis and sensor."""

from __future__ import annotations

import hashlib
import time
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal.rtc.identity import Identity, Reconstructor
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import BasisKind, SignalKind
from service.model.misregistration import Misregistration
from service.model.modes import Basis
from service.model.sensors.registry import kind_of
from service.wire import checksum

Array32 = NDArray[np.float32]

_SMALLEST_SINGULAR_RATIO = 1e-3


def compute_truncated_inverse(interaction: Array32) -> Array32:
    """Return the pseudo-inverse of D ``(n_slopes, n_modes)`` without its weakest directions."""
    u, values, vh = scipy.linalg.svd(interaction.astype(np.float64), full_matrices=False)
    kept = values > _SMALLEST_SINGULAR_RATIO * values[0]
    inverse = (vh[kept].T / values[kept]) @ u[:, kept].T
    return np.ascontiguousarray(inverse, dtype=np.float32)


def initial_reconstructor(
    instrument: Instrument,
    basis: Basis,
    identity: Identity,
    n_controlled: int,
    aligned: Misregistration,
) -> Reconstructor:
    """Return the matrix before any flexure: the inverse of the model where all is aligned."""
    interaction = InteractionModel(instrument, basis).interaction_matrix(aligned)
    return own_reconstructor(interaction[:, :n_controlled], identity, aligned)


def own_reconstructor(
    interaction: NDArray[Any], identity: Identity, alpha: Misregistration | None = None
) -> Reconstructor:
    """Return the pseudo-inverse of D ``(n_slopes, n_controlled)`` as the RTC's own matrix.

    ``alpha`` is the registration that D belongs to; None if it is not known.
    """
    matrix = compute_truncated_inverse(interaction.astype(np.float32))
    name = f"initial-{len(matrix)}-{checksum(matrix)[:8]}"
    told = None if alpha is None else alpha.to_boundary()
    return Reconstructor.own(name, matrix, identity, created_ns=time.time_ns(), alpha=told)


FIRST_SHAPE_MODE, N_SHAPE_MODES = 2, 20
"""Modes of the shapes that references put on the mirror: as static aberrations of optics, low ones.
"""


class ReferenceSchedule:
    """New reference slopes at regular times, each for a shape at random.

    The slopes are those of a matrix that the reconstructor inverts, as an RTC has it from its own
    calibration. Strength of the modes falls as their index, and so as the square of their order.
    """

    def __init__(
        self, matrix: Array32, *, rms_m: float, period_s: float, named_by: str, seed: int | None
    ) -> None:
        n_modes = min(N_SHAPE_MODES, len(matrix) - FIRST_SHAPE_MODE)
        modes = np.arange(FIRST_SHAPE_MODE, FIRST_SHAPE_MODE + n_modes)
        shapes = np.eye(len(matrix))[:, modes] / modes
        self._slopes = np.linalg.lstsq(matrix.astype(np.float64), shapes)[0]
        self._scale_m = rms_m / np.linalg.norm(1.0 / modes)
        self._period_s, self._named_by = period_s, named_by
        self._rng, self._n = np.random.default_rng(seed), 0

    def next(self, time_s: float) -> tuple[Array32, dict[str, str]] | None:
        """Return reference slopes and their name if new ones are due at this time; else None."""
        if time_s < (self._n + 1) * self._period_s:
            return None
        self._n += 1
        amplitudes_m = self._scale_m * self._rng.normal(size=self._slopes.shape[1])
        references = (self._slopes @ amplitudes_m).astype(np.float32)
        return references, {self._named_by: f"references-{self._n}"}


def identity_of(instrument: Instrument, valid: NDArray[np.bool_]) -> Identity:
    """Return the names of basis and sensor configuration: they change when either does."""
    mirror, wfs = instrument.analytic_mirror, instrument.wfs
    # Rounded to a micrometre, so that rounding errors of a platform do not make another basis.
    basis = hashlib.sha256(np.round(mirror.positions_m, 6).tobytes())
    basis.update(repr((mirror.shape.influence, mirror.shape.coupling, instrument.modes)).encode())
    kind = "kl"
    if mirror.mode_to_actuator is not None or mirror.basis is not BasisKind.KARHUNEN_LOEVE:
        kind = "own"
        strokes = mirror.mode_to_actuator
        basis.update(b"zonal" if strokes is None else np.round(strokes, 9).tobytes())
    sensor = hashlib.sha256(np.packbits(valid).tobytes())
    sensor.update(repr(kind_of(instrument).identity(wfs)).encode())
    if instrument.slopes.kind is not SignalKind.XY:
        sensor.update(instrument.slopes.kind.encode())
    config_id = instrument.config_id
    if not instrument.sensor_modes or config_id is None:
        config_id = f"{wfs.kind}-{wfs.n_subapertures}-{sensor.hexdigest()[:8]}"
    return Identity(
        system=instrument.name,
        basis_id=f"{kind}-{instrument.modes.n_modes}-{basis.hexdigest()[:8]}",
        config_id=config_id,
    )
