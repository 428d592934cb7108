"""Documents as JSON: NumPy's numbers are numbers, what is not finite is null."""

import json

import numpy as np
import pytest

from service.files.bundle import RECONSTRUCTOR, Bundle, read_bundle, write_bundle
from service.files.documents import json_text, plain


def test_numpy_numbers_become_those_of_python():
    given = {
        "bool": np.bool_(True),
        "int": np.int64(7),
        "float": np.float32(0.5),
        "array": np.array([[1, 2], [3, 4]]),
        "scalar": np.array(2.0),
        "nested": [{"deep": (np.intp(3), np.True_)}],
    }
    assert json.loads(json_text(given)) == {
        "bool": True,
        "int": 7,
        "float": 0.5,
        "array": [[1, 2], [3, 4]],
        "scalar": 2.0,
        "nested": [{"deep": [3, True]}],
    }


@pytest.mark.parametrize("value", [np.nan, np.float32("inf"), -np.inf, float("nan")])
def test_a_number_that_is_not_finite_is_null(value):
    assert json.loads(json_text({"a": value, "b": [value], "c": np.array([1.0, value])})) == {
        "a": None,
        "b": [None],
        "c": [1.0, None],
    }
    assert plain(value, finite=False) is not None


def test_what_has_no_place_in_a_document_is_refused():
    with pytest.raises(TypeError):
        json_text({"a": object()})


def test_facts_of_a_bundle_may_be_numbers_of_numpy(tmp_path):
    arrays = {RECONSTRUCTOR: np.ones((2, 3), np.float32)}
    facts = {"n": np.int64(4), "sure": np.True_, "gain": np.float32(0.25)}
    write_bundle(tmp_path / "b.h5", Bundle(id="b", facts=facts, arrays=arrays))
    assert read_bundle(tmp_path / "b.h5").facts == {"n": 4, "sure": True, "gain": 0.25}
