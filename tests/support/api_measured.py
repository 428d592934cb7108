"""What tests of several modules share of unit.test_api_measured."""

from __future__ import annotations

import hashlib

import numpy as np

from service.errors import UnknownIdError
from service.model.misregistration import Misregistration
from service.records.operations import MeasurementRecord, MeasureState, NoisyFinding
from service.wire import Pattern

MATRIX = np.arange(12, dtype=np.float32).reshape(4, 3)


FILE = b"\x89HDF the product"


STORED = MeasurementRecord(
    id="im-1",
    state=MeasureState.STORED,
    pattern=Pattern.PUSH_PULL_MODAL,
    modes=(0, 7, 3),
    amplitude_m=(1e-8, 2e-8, 2e-8),
    n_average=5,
    asked_ns_utc=900,
    start_seq=70,
    created_ns_utc=1_000,
    n_slopes=4,
    double_pass=False,
    session="s-1",
    basis_id="kl",
    config_id="b1",
    sha256=hashlib.sha256(MATRIX.tobytes()).hexdigest(),
)


NOISY = MeasurementRecord(
    id="noisy-1",
    state=MeasureState.STORED,
    pattern=None,
    modes=(0, 7, 3),
    amplitude_m=(5e-9 / 3**0.5,) * 3,
    duration_s=30.0,
    window_s=5.0,
    seed=77,
    asked_ns_utc=900,
    basis_id="kl",
    config_id="b1",
    finding=NoisyFinding(
        n_slopes=4,
        n_frames=29_994,
        n_missing=6,
        snr=1.4,
        alpha=Misregistration(shift_x_subap=0.1, rotation_rad=np.deg2rad(0.2)),
        covariance=np.diag([0.01, 0.01, np.deg2rad(0.02), 0.001]) ** 2,
        optical_gain=0.6,
        misfit=1.01,
        cm_id="cm-1",
        session="s-1",
        created_ns_utc=1_000,
        sha256="0" * 64,
    ),
)


class FakeMatrices:
    """The archive's matrices of one kind; numbers of a noisy one leave with their noise alone."""

    def __init__(self, folder, name):
        self.name, self.path = name, folder / f"{name}.h5"
        self.path.write_bytes(FILE)

    def matrix(self, name):
        assert not self.name.startswith("noisy"), name
        self.file(name)
        return MATRIX

    def file(self, name):
        if name != self.name:
            raise UnknownIdError(f"measurement {name}: no such matrix in the archive")
        return self.path
