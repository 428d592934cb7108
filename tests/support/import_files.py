"""What tests of several modules share of unit.fitting.test_import_files."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

N = 6


_ROWS, _COLUMNS = np.mgrid[:N, :N] - (N - 1) / 2


VALID = np.hypot(_COLUMNS, _ROWS) <= N / 2


MATRIX = np.random.default_rng(1).normal(size=(2 * VALID.sum(), 5))


CUBE = np.random.default_rng(2).normal(size=(5, 12, 12)).astype(np.float32)


def aot_file(path, listed=None, moved=None, sensor_moved=None, **loop):
    aotpy = pytest.importorskip("aotpy")
    places = np.full(VALID.shape, -1, dtype=np.int32)
    places[VALID] = np.arange(VALID.sum()) if listed is None else listed
    moved, sensor_moved = (
        None if one is None else aotpy.Image(name, one)
        for name, one in (("moved", moved), ("sensor moved", sensor_moved))
    )
    sensor = aotpy.Pyramid(
        uid="sensor",
        n_sides=4,
        source=aotpy.NaturalGuideStar(uid="star"),
        n_valid_subapertures=int(VALID.sum()),
        subaperture_mask=aotpy.Image("mask", places),
        wavelength=750e-9,
        transformation_matrix=sensor_moved,
    )
    telescope = aotpy.MainTelescope(uid="t", enclosing_diameter=2.0, obstruction_diameter=0.4)
    mirror = aotpy.DeformableMirror(
        uid="dm",
        telescope=telescope,
        n_valid_actuators=5,
        influence_function=aotpy.Image("functions", CUBE),
        transformation_matrix=moved,
    )
    matrices = {name: aotpy.Image(name, values) for name, values in loop.items()}
    control = aotpy.ControlLoop(
        uid="loop", input_sensor=sensor, commanded_corrector=mirror, **matrices
    )
    system = aotpy.AOSystem(
        ao_mode="SCAO",
        name="it",
        main_telescope=telescope,
        sources=[sensor.source],
        wavefront_sensors=[sensor],
        wavefront_correctors=[mirror],
        loops=[control],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        system.write_to_file(path, "fits")
