"""What an observatory has before the night: the names of its basis and sensor, a first matrix."""

from __future__ import annotations

import hashlib
import time

import numpy as np
from numpy.typing import NDArray

from service.model.instrument import BasisKind, Instrument
from service.model.interaction import InteractionModel
from service.model.modes import ModalBasis
from service.wire import CHUNK_LIMIT, Manifest, layout_of
from sim_rtc.reconstructors import Reconstructor, truncated_inverse
from sim_rtc.telemetry import Identity


def initial_reconstructor(
    instrument: Instrument, basis: ModalBasis, identity: Identity, n_controlled: int
) -> Reconstructor:
    """Return what an observatory has before any flexure: the nominal model's inverse."""
    aligned = instrument.start
    interaction = InteractionModel(instrument, basis).interaction_matrix(aligned)
    matrix = truncated_inverse(interaction[:, :n_controlled])
    layout = layout_of(matrix, CHUNK_LIMIT)
    manifest = Manifest(
        id=f"initial-{n_controlled}-{layout.sha256[:8]}",
        layout=layout,
        alpha=aligned.to_boundary(),
        sigma=None,
        im_id=None,
        parent=None,
        basis_id=identity.basis_id,
        config_id=identity.config_id,
        system=identity.system,
        created_ns=time.time_ns(),
    )
    return Reconstructor(manifest=manifest, matrix=matrix)


def identity_of(instrument: Instrument, valid: NDArray[np.bool_]) -> Identity:
    """Return the names of basis and sensor configuration: they change when either does."""
    mirror, wfs = instrument.analytic_mirror, instrument.wfs
    basis = hashlib.sha256(np.round(mirror.positions_m, 6).tobytes())
    basis.update(repr((mirror.influence, mirror.coupling, instrument.modes)).encode())
    kind = "kl"
    if mirror.mode_to_actuator is not None or mirror.basis is not BasisKind.KARHUNEN_LOEVE:
        kind = "own"
        strokes = mirror.mode_to_actuator
        basis.update(b"zonal" if strokes is None else np.round(strokes, 9).tobytes())
    sensor = hashlib.sha256(np.packbits(valid).tobytes())
    sensor.update(
        repr((wfs.wavelength_m, wfs.modulation_lambda_over_d, wfs.pupil_separation_subap)).encode()
    )
    return Identity(
        system=instrument.name,
        basis_id=f"{kind}-{instrument.modes.n_modes}-{basis.hexdigest()[:8]}",
        config_id=f"pyramid-{wfs.n_subapertures}-{sensor.hexdigest()[:8]}",
    )
