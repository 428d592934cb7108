"""What tests of several modules share of unit.sim_rtc.computer.test_real_time_computer."""

from __future__ import annotations

import numpy as np

from pyrcal.rtc.identity import Identity, Reconstructor
from service.model.misregistration import Misregistration
from service.wire import DitherKind, DitherRequest, Manifest, layout_of
from sim_rtc.telescope.linear import LinearOptics

N_MODES, N_SLOPES = 4, 8


# Orthogonal modes: what is not controlled does not alias into what is.
RESPONSE = np.linalg.qr(np.random.default_rng(1).standard_normal((N_SLOPES, N_MODES)))[0].astype(
    np.float32
)


OPTICS = LinearOptics(
    alpha=Misregistration(),
    stuck_opd_m=np.zeros(5, dtype=np.float32),
    slopes_per_command=RESPONSE,
    opd_per_command=np.zeros((5, N_MODES), dtype=np.float32),
    images=np.ones((2, 1, 2, 1)) / 4,
)


IDENTITY = Identity(system="small", basis_id="basis", config_id="sensor")


def reconstructor(name, n_controlled):
    matrix = np.linalg.pinv(RESPONSE[:, :n_controlled]).astype(np.float32)
    manifest = Manifest(
        id=name,
        layout=layout_of(matrix, 1000),
        alpha=None,
        sigma=None,
        im_id=None,
        parent=None,
        basis_id="basis",
        config_id="sensor",
        system="small",
        created_ns=1,
    )
    return Reconstructor(manifest=manifest, matrix=matrix)


def dither_request(name):
    return DitherRequest(
        id=name,
        kind=DitherKind.SINE,
        modes=(3,),
        amplitude_m=(1e-9,),
        frequency_hz=(100.0,),
        duration_s=1.0,
    )
