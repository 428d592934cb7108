"""Rows of D by other libraries than NumPy."""

import importlib.util
import pickle
from dataclasses import replace

import numpy as np
import pytest

from service.errors import ModelError
from service.model import arrays
from service.model.arrays import NUMPY, Arrays, arrays_of
from service.model.interaction import InteractionModel
from service.model.kinds import Normalisation, SlopeOrder, Stop
from service.model.local import LocalShapes
from tests.support.local import RECIPES, basis, many_actuators
from tests.support.numerics import SOMEWHERE, small_basis, small_instrument

STRICT = Arrays("array_api_strict")
"""Only what the standard has, and nothing that NumPy alone can do."""


def model(library, order=SlopeOrder.XY, normalisation=Normalisation.GLOBAL, *, local=True):
    instrument = many_actuators(Stop.TELESCOPE, 26) if local else small_instrument()
    slopes = replace(instrument.slopes, order=order, normalisation=normalisation)
    return InteractionModel(
        replace(instrument, slopes=slopes),
        basis() if local else small_basis(),
        pupil_sampling=2 if local else 1,
        detector_nodes=1,
        dtype=np.float64,
        kept_bytes=0.0,
        arrays=library,
    )


def assert_alike(library, **settings):
    """To rounding: sums of some thousand products in float64, in another order."""
    ours, theirs = model(NUMPY, **settings), model(library, **settings)
    for name in ("interaction_matrix", "derivatives"):
        expected, found = getattr(ours, name)(SOMEWHERE), getattr(theirs, name)(SOMEWHERE)
        assert isinstance(found, np.ndarray)
        np.testing.assert_allclose(found, expected, atol=1e-13 * np.abs(expected).max())


def test_the_standard_alone_is_enough():
    pytest.importorskip("array_api_strict")
    assert isinstance(model(NUMPY)._render_modes(SOMEWHERE), LocalShapes)
    assert_alike(STRICT)


@pytest.mark.parametrize(("order", "normalisation"), RECIPES)
def test_the_standard_alone_is_enough_for_every_kind_of_signal(order, normalisation):
    pytest.importorskip("array_api_strict")
    assert_alike(STRICT, order=order, normalisation=normalisation, local=False)


def test_few_shapes_are_computed_by_the_chosen_library_too():
    """What is cheaper for few shapes is written for NumPy alone."""
    assert model(NUMPY, local=False).sensor.optics.are_few(1)
    assert model(pickle.loads(pickle.dumps(NUMPY)), local=False).sensor.optics.are_few(1)
    assert not model(STRICT, local=False).sensor.optics.are_few(1)


@pytest.mark.long
@pytest.mark.parametrize("local", [True, False])
def test_torch_finds_what_numpy_finds(local):
    pytest.importorskip("torch", reason="torch is 200 MB and more: whoever wants it brings it")
    assert_alike(arrays_of("torch"), local=local)


def test_a_library_goes_to_other_processes_by_its_name():
    assert pickle.loads(pickle.dumps(STRICT)) == STRICT
    assert arrays_of("numpy") is NUMPY


def test_a_library_that_is_not_installed_is_named(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        arrays.importlib.util, "find_spec", lambda name: None if name == "cupy" else found(name)
    )
    with pytest.raises(ModelError, match=r'"cupy": found no cupy .* pip install .* take "numpy"'):
        arrays_of("cupy")


def test_a_library_that_does_not_work_is_named(monkeypatch):
    monkeypatch.setattr(arrays.importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(Arrays, "there", lambda self, array: 1 / 0)
    with pytest.raises(ModelError, match=r"does not work here .*division by zero"):
        arrays_of("cupy")
