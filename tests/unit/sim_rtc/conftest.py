"""A small telescope: 10 subapertures, 77 actuators, 40 modes; its optics take milliseconds."""

from dataclasses import replace

import numpy as np
import pytest

from service.instrument import load_instrument
from service.model.instrument import Mirror
from service.model.kinds import KarhunenLoeve
from service.model.modes import karhunen_loeve_basis


@pytest.fixture(scope="session")
def small_instrument():
    full = load_instrument("flao-lbt")
    axis = np.arange(-4.5, 5.0) * 0.9
    x, y = np.meshgrid(axis, axis)
    inside = np.hypot(x, y) < 4.5
    return replace(
        full,
        name="small",
        wfs=replace(full.wfs, n_subapertures=10, pupil_separation_subap=14.0),
        mirror=Mirror(positions_m=np.column_stack([x[inside], y[inside]]), pitch_m=0.9),
        modes=KarhunenLoeve(n_modes=40),
    )


@pytest.fixture(scope="session")
def small_basis(small_instrument):
    return karhunen_loeve_basis(small_instrument)
