"""How the service inverts: as the settings say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.config.settings import load_settings
from service.control.reconstructor import InversionMethod, Prior, invert, invert_with_prior
from service.model.misregistration import Misregistration
from service.runtime.worker import OpticsWorker
from tests.support.small import (
    COMPUTE,
    N_CONTROLLED,
    SIGMA,
    conditions,
    loop_settings,
    small_instrument,
)

NOISE = 0.2


def made_with(**settings):
    bench = OpticsWorker(small_instrument(), replace(COMPUTE, **settings))
    made = bench.make(conditions(Misregistration(), np.diag(SIGMA**2), loop_settings(), 0.95))
    return bench._model, made


def test_the_default_is_the_truncated_svd():
    assert load_settings(None, {}).control.method == InversionMethod.SVD
    model, made = made_with()
    expected = invert(model.interaction_matrix(Misregistration()), N_CONTROLLED).matrix
    np.testing.assert_array_equal(made.matrix, expected)


def test_map_knows_the_instruments_turbulence_and_the_noise_of_the_settings():
    model, made = made_with(method=InversionMethod.MAP, slope_noise=NOISE)
    known = Prior(variance_m2=model.basis.variance_m2, slope_noise=np.full(model.n_slopes, NOISE))
    matrix = model.interaction_matrix(Misregistration())
    expected = invert_with_prior(matrix, N_CONTROLLED, known).matrix
    np.testing.assert_array_equal(made.matrix, expected)
    assert made.gate.accepted


def test_the_method_may_come_from_the_environment():
    settings = load_settings(
        None, {"PYRCAL_CONTROL__METHOD": "map", "PYRCAL_CONTROL__SLOPE_NOISE": "0.2"}
    )
    assert settings.control.method == InversionMethod.MAP
    assert settings.control.slope_noise == 0.2
