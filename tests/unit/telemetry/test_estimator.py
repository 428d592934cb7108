"""The three estimators answer to one interface, and each says what it cannot tell."""

from __future__ import annotations

import numpy as np
import pytest

from service.model.misregistration import PARAMETERS, Misregistration
from service.telemetry.estimator import (
    LOCK_IN,
    PASSIVE,
    RANDOM,
    DitheredEstimate,
    Estimate,
    Window,
)
from service.telemetry.instrumental import WindowEstimate
from service.telemetry.lockin import Spectra
from service.telemetry.noisymatrix import RandomEstimate
from service.telemetry.passive import PassiveEstimate
from service.telemetry.randomdither import Correlated


def asked_of(protocol) -> set[str]:
    classes = (cls for cls in protocol.__mro__ if cls.__module__ == protocol.__module__)
    return {name for cls in classes for name in vars(cls) if not name.startswith("_")}


@pytest.mark.parametrize(
    ("kind", "protocol"),
    [
        (WindowEstimate, DitheredEstimate),
        (RandomEstimate, DitheredEstimate),
        (PassiveEstimate, Estimate),
        (Spectra, Window),
        (Correlated, Window),
    ],
)
def test_every_kind_has_all_that_the_interface_asks_for(kind, protocol):
    asked = asked_of(protocol)
    assert len(asked) >= 5
    assert all(hasattr(kind, name) for name in asked)


COMMON = {
    "alpha": Misregistration(),
    "covariance": np.eye(4),
    "optical_gain": np.ones(1),
    "misfit": 1.0,
    "step": np.zeros(4),
}
DITHERED = COMMON | {
    "lag_frames": np.zeros(1),
    "gain_sigma": np.ones(1),
    "modes": (3,),
    "t_ns_utc": 0,
    "cm_id": None,
    "session": "s",
}


@pytest.mark.parametrize(
    ("estimate", "expected"),
    [
        (WindowEstimate(**DITHERED), LOCK_IN),
        (RandomEstimate(**DITHERED), RANDOM),
        (PassiveEstimate(**COMMON), PASSIVE),
    ],
)
def test_every_estimate_knows_what_its_kind_can_tell(estimate, expected):
    assert estimate.determines is expected


def test_only_a_dither_tells_the_shifts():
    assert LOCK_IN.missing == RANDOM.missing == ()
    assert PASSIVE.missing == ("shift_x_subap", "shift_y_subap")
    assert set(PASSIVE.parameters) | set(PASSIVE.missing) == set(PARAMETERS)
