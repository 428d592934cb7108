import json

import numpy as np
import pytest

from service.files.report import document
from service.model.misregistration import PARAMETERS
from service.model.slopes import Orientation
from tests.unit.files.made import GAINS, a_fit, a_report

KEYS = {
    *PARAMETERS,
    "sigma",
    "covariance",
    "gains",
    "residual_fraction",
    "condition_number",
    "n_modes_used",
    "orientation",
    "subset_scatter",
    "converged",
    "verdict",
    "notes",
    "seconds",
}


def test_the_document_has_exactly_the_keys_it_promises():
    found = document(a_report())
    assert set(found) == KEYS
    assert set(found["sigma"]) == set(found["subset_scatter"]) == set(PARAMETERS)


def test_every_number_is_in_the_unit_of_its_name():
    found = document(a_report())
    assert found["rotation_deg"] == pytest.approx(65.08)
    assert found["sigma"]["rotation_deg"] == pytest.approx(0.01)
    assert found["covariance"][2][2] == pytest.approx(0.01**2)
    assert found["subset_scatter"]["rotation_deg"] == pytest.approx(0.004)
    assert found["shift_x_subap"] == -0.92
    assert found["sigma"]["shift_y_subap"] == pytest.approx(0.02)
    assert found["gains"] == GAINS.tolist()
    assert found["n_modes_used"] == 3


def test_the_orientation_is_said_as_the_instrument_file_would():
    found = document(a_report())["orientation"]
    assert found == {
        "order": "yx",
        "swap_xy": False,
        "flip_x": True,
        "flip_y": False,
        "sign": [1, -1],
    }
    both = a_fit(orientation=Orientation(sign_x=-1, sign_y=-1))
    assert document(a_report(both))["orientation"]["sign"] == -1


def test_what_should_be_known_beside_the_verdict_is_in_the_document():
    assert document(a_report(notes=("columns of the wrong sign: 3",)))["notes"] == [
        "columns of the wrong sign: 3"
    ]


def test_what_was_left_out_is_named_in_the_verdict():
    fit = a_fit(left_out=("not finite: mode 2", "dead (no response): mode 3"))
    verdict = document(a_report(fit))["verdict"]
    assert verdict.startswith("accepted")
    assert "mode 2" in verdict
    assert "mode 3" in verdict
    assert "\n" not in verdict


def test_a_number_that_is_none_is_null():
    fit = a_fit(
        accepted=False,
        covariance=np.full((4, 4), np.inf),
        gains=np.array([1.0, np.nan, 0.9]),
        residual_fraction=np.nan,
        subset_scatter=np.full(4, np.nan),
    )
    found = json.loads(json.dumps(document(a_report(fit)), allow_nan=False))
    assert found["gains"] == [1.0, None, 0.9]
    assert found["residual_fraction"] is None
    assert found["sigma"] == dict.fromkeys(PARAMETERS)
