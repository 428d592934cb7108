"""The simulator's own reconstructors, and the names of its basis and sensor configuration."""

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
