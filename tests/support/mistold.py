"""What tests of several modules share of unit.fitting.test_mistold."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from pyrcal_studies.fft_pyramid import FftPyramid
from service.instrument.mirrors import grid
from service.model.instrument import Instrument, Mirror
from service.model.kinds import BasisKind, Influence, InfluenceShape, Stop
from service.model.misregistration import Misregistration
from service.model.pupil import lit_subapertures
from service.model.sensors.pyramid.description import Pyramid
from service.model.slopes import Orientation, SlopeRecipe

TRUTH = Misregistration(
    shift_x_subap=0.31, shift_y_subap=-0.22, rotation_rad=np.deg2rad(1.1), magnification=1.006
)


COUPLING = 0.35


N, SAMPLING, DIAMETER_M, OBSCURATION, PITCH_M = 12, 4, 3.0, 0.1, 0.25


ARM_M, ARMS_DEG = 0.2, (40.0, 150.0, 270.0)
"""Width and directions of the arms of a spider."""


ACTUATORS_M = grid(13, PITCH_M, 3.3)


MODES = np.linalg.qr(np.random.default_rng(5).normal(size=(len(ACTUATORS_M), 60)))[0]
"""A user's own combinations of actuators."""


def bench(**mirror) -> Instrument:
    shape = InfluenceShape(influence=Influence.GAUSSIAN, coupling=mirror.pop("coupling", COUPLING))
    return Instrument(
        name="bench",
        diameter_m=DIAMETER_M,
        obscuration_ratio=OBSCURATION,
        stop=Stop.TELESCOPE,
        wfs=Pyramid(
            n_subapertures=N,
            wavelength_m=750e-9,
            modulation_lambda_over_d=3.0,
            pupil_separation_subap=16.0,
        ),
        mirror=Mirror(
            **{"positions_m": ACTUATORS_M, "pitch_m": PITCH_M, "basis": BasisKind.ZONAL} | mirror,
            shape=shape,
        ),
        slopes=SlopeRecipe(orientation=Orientation()),
    )


@cache
def zonal(
    truth: Misregistration = TRUTH,
    pupil_subap: tuple[float, float] = (0.0, 0.0),
    arms_deg: tuple[float, ...] = (),
    modulation: float = 3.0,
) -> np.ndarray:
    """Every actuator pushed where the truth puts it, ``(n_slopes, n_actuators)``."""
    n = N * SAMPLING
    fine = (np.arange(8 * n) - (8 * n - 1) / 2) / (4 * n)
    off_x, off_y = np.array(pupil_subap) * 2.0 / N
    radius = np.hypot(fine - off_x, (fine - off_y)[:, None])
    lit = (radius <= 1.0) & (radius >= OBSCURATION)
    for angle in np.deg2rad(arms_deg):
        along = np.cos(angle) * fine + np.sin(angle) * fine[:, None]
        across = np.cos(angle) * fine[:, None] - np.sin(angle) * fine
        lit &= (along < 0.0) | (np.abs(across) > ARM_M / DIAMETER_M)
    pyramid = FftPyramid(
        amplitude=lit.reshape(n, 8, n, 8).mean(axis=(1, 3)),
        sampling=SAMPLING,
        wavelength_m=750e-9,
        n_subapertures=N,
        image_separation_subap=16.0,
        padded_subap=80,
        modulation_lambda_over_d=modulation,
    )
    x, y = np.meshgrid(pyramid.coordinates, pyramid.coordinates)
    x, y = x - truth.shift_x_subap, y - truth.shift_y_subap
    c, s = np.cos(truth.rotation_rad), np.sin(truth.rotation_rad)
    on_mirror = np.stack([c * x + s * y, -s * x + c * y]) / truth.magnification * DIAMETER_M / N
    apart = np.hypot(*(on_mirror[:, None] - ACTUATORS_M.T[:, :, None, None]))
    return pyramid.jacobian(COUPLING ** ((apart / PITCH_M) ** 2), lit_subapertures(bench()))


def sigmas_off(found) -> np.ndarray:
    return np.abs(found.alpha.vector - TRUTH.vector) / found.sigma


def masked(about: Instrument) -> Instrument:
    """The same with the RTC's own mask, as users give it."""
    mask = lit_subapertures(bench())
    return replace(about, wfs=replace(about.wfs, valid_subapertures=mask))
