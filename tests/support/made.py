"""A fit made by hand, of three modes on a sensor of three by three: every number is known."""

from dataclasses import replace

import numpy as np

from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.methods import ScanStep
from pyrcal.fitting.report import FitReport
from service.model.kinds import Method, SlopeOrder
from service.model.misregistration import Misregistration
from service.model.slopes import Orientation

ALPHA = Misregistration(
    shift_x_subap=-0.92, shift_y_subap=0.35, rotation_rad=np.deg2rad(65.08), magnification=0.98
)
VALID = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=bool)
SYNTHETIC = np.random.default_rng(1).normal(size=(10, 3))
GAINS = np.array([1.0, 1.1, 0.9])
SCAN = ScanStep(
    parameter="rotation_deg",
    step=0.5,
    samples=np.array([64.5, 65.0, 65.5]),
    chi=np.array([3.0, 1.0, 3.0]),
    minimum=65.0,
    coefficients=np.array([2.0, 0.0, 1.0]),
)


def a_fit(**changes):
    maps = np.full((2, 3, 3), np.nan)
    maps[:, VALID] = 0.02
    fit = Fit(
        alpha=ALPHA,
        covariance=np.diag([1e-4, 4e-4, np.deg2rad(0.01) ** 2, 1e-6]),
        gains=GAINS,
        residual_fraction=0.02,
        residual_map=maps,
        residual_by_mode=np.array([0.01, 0.02, 0.03]),
        condition_number=8.4,
        modes=np.array([0, 1, 4]),
        orientation=Orientation(flip_x=True, sign_y=-1),
        order=SlopeOrder.YX,
        subset_scatter=np.array([1e-3, 2e-3, np.deg2rad(0.004), 1e-4]),
        accepted=True,
        converged=True,
        verdict="accepted: sets of modes agree",
        remarks=(),
        left_out=(),
        n_evaluations=9,
        synthetic=SYNTHETIC,
        measured=SYNTHETIC * GAINS,
        valid=VALID,
    )
    return replace(fit, **changes)


def a_report(fit=None, **changes):
    report = FitReport(
        fit=fit or a_fit(),
        method=Method.JOINT,
        instrument="bench",
        instrument_sha256="1" * 64,
        reference="im.h5:/interaction_matrix",
        reference_sha256="2" * 64,
        double_pass=True,
        seconds=1.2345,
    )
    return replace(report, **changes)
