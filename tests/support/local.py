"""What tests of several modules share of unit.model.test_local."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from service.model.kinds import BasisKind, Influence, Normalisation, SlopeOrder, Stop
from service.model.modes import ModalBasis, analytic_basis
from tests.support.numerics import small_instrument

RECIPES = [
    (order, normalisation)
    for order in (SlopeOrder.XY, SlopeOrder.IMAGES)
    for normalisation in Normalisation
]


def grid_m(n_across, pitch_m):
    line = (np.arange(n_across) - (n_across - 1) / 2) * pitch_m
    y, x = np.meshgrid(line, line, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel()])


@cache
def many_actuators(stop=Stop.MIRROR, n_subapertures=24):
    """24 subapertures, 625 actuators, zonal: more than reach any tile."""
    plain = small_instrument(grid_m(25, 8.0 / 24), stop=stop, influence=Influence.GAUSSIAN)
    return replace(
        plain,
        wfs=replace(plain.wfs, n_subapertures=n_subapertures, pupil_separation_subap=30.0),
        mirror=replace(plain.mirror, pitch_m=8.0 / 24, basis=BasisKind.ZONAL),
    )


@cache
def basis():
    found = analytic_basis(many_actuators())
    assert isinstance(found, ModalBasis)
    return found
