"""An interaction matrix asked for over HTTP, measured by an RTC process, fetched over HTTP."""

import hashlib
import io

import h5py
import httpx
import numpy as np
import pytest

from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from tests.support.measure import measured, no_dither
from tests.support.night import ALPHA, INSTRUMENT, N_START, a_night, wait_for

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(180)]


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def quiet_night(night):
    """A closed loop whose dither an operator has stopped."""
    night.service("hold")
    night.rtc()
    wait_for(lambda: night.state["in_use"], what="the RTC's matrix")
    no_dither(night)


def numbers_of(night, record):
    path = f"/v1/measurements/{record['id']}/matrix"
    return np.load(io.BytesIO(night.client.get(path).content), allow_pickle=False)


def check_against_model(matrix, modes):
    """The direction of every column is that of the service's own model at the true α.

    Lengths differ by the optical gain, and the simulator's sensor and mirror are not the model's:
    a few per cent.
    """
    instrument = load_instrument(str(INSTRUMENT))
    model = InteractionModel(instrument, karhunen_loeve_basis(instrument))
    expected = model.interaction_matrix(Misregistration.from_boundary(ALPHA))[:, list(modes)]
    cosine = np.sum(matrix * expected, axis=0)
    cosine /= np.linalg.norm(matrix, axis=0) * np.linalg.norm(expected, axis=0)
    assert np.median(cosine) > 0.98
    assert cosine.min() > 0.9
    gain = np.linalg.norm(matrix, axis=0) / np.linalg.norm(expected, axis=0)
    assert 0.4 < np.median(gain) < 1.05


def test_a_matrix_is_measured_kept_and_handed_out(night):
    quiet_night(night)
    session = night.state["rtc"]["session"]
    record = measured(night, {"pattern": "hadamard", "n_average": 6})
    assert record["state"] == "stored", record
    assert record["modes"] == list(range(N_START))
    assert record["double_pass"] is False
    assert record["session"] != session, "opening the loop begins a new session"

    matrix = numbers_of(night, record)
    assert matrix.shape == (record["n_slopes"], N_START)
    check_against_model(matrix, record["modes"])

    path = f"/v1/measurements/{record['id']}/matrix"
    raw = night.client.get(path, params={"format": "raw"}).content
    assert hashlib.sha256(raw).hexdigest() == record["sha256"]
    product = night.client.get(path, params={"format": "hdf5"}).content
    with h5py.File(io.BytesIO(product)) as file:
        np.testing.assert_array_equal(file["interaction_matrix"], matrix)
        assert file.attrs["pattern"] == "hadamard"
        assert file.attrs["instrument"] == "small"
    assert (night.directory / "data" / "interaction_matrices" / f"{record['id']}.h5").exists()

    wait_for(lambda: night.rtc_says("loop") == "closed", what="the loop closed again")
    night.check_alarms("loop-open")

    # one shape after the other: ten times the pushes, for turbulence in the open loop
    other = measured(night, {"pattern": "system-modes", "n_average": 60})
    assert other["state"] == "stored", other
    check_against_model(numbers_of(night, other), other["modes"])


def test_a_matrix_is_measured_by_sines_with_the_loop_closed(night):
    quiet_night(night)
    session = night.state["rtc"]["session"]
    body = {"pattern": "sine", "modes": [5, 20, 40], "amplitude_m": 2e-8, "duration_s": 8.0}
    record = measured(night, body)
    assert record["state"] == "stored", record
    assert record["session"] == session
    check_against_model(numbers_of(night, record), record["modes"])


def test_measured_matrices_outlive_the_service_and_a_lost_rtc_is_named(night):
    quiet_night(night)
    record = measured(night, {"n_average": 1, "modes": [0, 1]})
    answer = night.client.post("/v1/measurements", json={"n_average": 200})
    assert answer.status_code == httpx.codes.ACCEPTED, answer.text
    service, rtc = night.processes
    rtc.kill()
    path = f"/v1/measurements/{answer.json()['id']}"
    failed = wait_for(
        lambda: (lambda m: m if m["state"] == "failed" else None)(night.client.get(path).json()),
        what="the failed measurement",
    )
    assert failed["reason"] == "the RTC vanished"
    service.kill()
    night.service("hold")
    kept = night.client.get("/v1/measurements").json()["measurements"]
    assert [(m["id"], m["state"]) for m in kept] == [(record["id"], "stored")]
    assert numbers_of(night, record).shape == (record["n_slopes"], 2)
