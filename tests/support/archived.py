"""What tests of several modules share of unit.test_archive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.model.misregistration import Misregistration
from service.records.products import GateVerdict, MatrixState, ReconstructorRecord

MATRIX = np.arange(12, dtype=np.float32).reshape(3, 4)


VERDICT = GateVerdict(
    accepted=False,
    worst_pole_radius=float("inf"),
    aligned_pole_radius=0.7,
    bound=0.95,
    n_points=9,
    reason="unstable at +3 sigma: measure longer",
)


def record_of(matrix_id="cm-1", **changes) -> ReconstructorRecord:
    record = ReconstructorRecord(
        id=matrix_id,
        state=MatrixState.PROPOSED,
        n_modes=3,
        created_ns_utc=1_000,
        alpha=Misregistration(shift_x_subap=0.2, rotation_rad=np.deg2rad(0.3), magnification=1.01),
        sigma=np.array([0.01, 0.02, np.deg2rad(0.03), 0.004]),
        parent="cm-0",
        condition_number=8.4,
        gate=VERDICT,
        reason="waits for an operator",
    )
    return replace(record, **changes)


def product(archive, matrix_id="cm-1"):
    return archive.reconstructors.path_of(matrix_id)
