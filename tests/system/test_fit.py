"""A measured matrix fitted as a user would: from a shell, and by a running service."""

import io
import json
import signal
import socket
import zipfile

import h5py
import httpx
import numpy as np
import pytest

from tests.data.tiny.make import ALPHA, HERE, N_MODES
from tests.support.fitting import pyrcal
from tests.support.night import a_night, wait_for
from tests.support.pace import patience

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]

TOML, MATRIX = HERE / "tiny.toml", HERE / "tiny.h5"
CLOSE = {"shift_x_subap": 0.02, "shift_y_subap": 0.02, "rotation_deg": 0.1, "magnification": 0.003}
"""The simulator's mirror and light are not the model's, and 40 modes of a small bench average
little of that: a few per cent of the matrix, about as much of these."""


def check_close(found):
    for name, tolerance in CLOSE.items():
        assert abs(found[name] - ALPHA[name]) < tolerance, (name, found[name])
        assert 0.0 < found["sigma"][name] < tolerance


def test_a_matrix_on_disk_becomes_a_reconstructor(tmp_path):
    fitted = pyrcal("fit", TOML, MATRIX, "--json", "--output", "fit.h5", folder=tmp_path)
    assert fitted.returncode == 0, fitted.stderr
    found = json.loads(fitted.stdout)
    check_close(found)
    assert found["verdict"].startswith("accepted")
    assert found["orientation"] == {
        "order": "yx",
        "swap_xy": False,
        "flip_x": False,
        "flip_y": True,
        "sign": 1,
    }
    assert found["n_modes_used"] == N_MODES
    made = pyrcal(
        "reconstruct", TOML, "fit.h5", "--modes", 50, "--output", "cm.h5", folder=tmp_path
    )
    assert made.returncode == 0, made.stderr
    with h5py.File(tmp_path / "cm.h5", "r") as product, h5py.File(MATRIX, "r") as measured:
        seen = product["reconstructor"][()] @ measured["interaction_matrix"][()]
    # by day the light meets the mirror twice: a mode is seen twice, and nothing else
    assert np.abs(np.diag(seen[:N_MODES]) - 2.0).max() < 0.2
    assert {path.name for path in tmp_path.iterdir()} == {"fit.h5", "cm.h5"}


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        night.service("hold")
        yield night


def finished(night, posted):
    assert posted.status_code == httpx.codes.ACCEPTED, posted.text
    link = posted.json()["links"]["fit"]

    def answer():
        found = night.client.get(link)
        return found if found.status_code != httpx.codes.ACCEPTED else None

    return wait_for(answer, 90.0, "the end of the fit")


def an_archive():
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.write(TOML, "tiny.toml")
        archive.write(MATRIX, "tiny.h5")
    return buffer.getvalue()


@pytest.mark.long
def test_the_service_fits_what_is_uploaded_and_keeps_nothing(night):
    found = finished(night, night.client.post("/v1/fits", content=an_archive()))
    assert found.status_code == httpx.codes.OK, found.text
    check_close(found.json())
    uploads = night.directory / "data" / "uploads"
    wait_for(lambda: not list(uploads.iterdir()), 10.0, "an empty folder")
    assert [fit["state"] for fit in night.client.get("/v1/fits").json()["fits"]] == ["done"]

    # the service's own instrument is another one: its name is told, and its numbers
    other = finished(night, night.client.post("/v1/fits", content=MATRIX.read_bytes()))
    assert other.status_code in {httpx.codes.OK, httpx.codes.UNPROCESSABLE_ENTITY}
    if other.status_code == httpx.codes.OK:
        assert other.json()["verdict"].startswith("refused")
    assert night.state["ready"]


def check_two_gigabytes_are_refused_unread(night):
    with socket.create_connection(("127.0.0.1", night.port), timeout=patience(10.0)) as raw:
        raw.sendall(
            b"POST /v1/fits HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2000000000\r\n\r\n"
            + b"\x89HDF\r\n\x1a\n"
        )
        answer = b""
        while not answer.endswith(b"}"):
            answer += (part := raw.recv(65536))
            assert part, answer
    assert answer.startswith(b"HTTP/1.1 413 ")
    assert b"application/problem+json" in answer
    assert b"expected at most 512 MB" in answer
    uploads = night.directory / "data" / "uploads"
    wait_for(lambda: not list(uploads.iterdir()), 5.0, "an empty folder")


@pytest.mark.long
def test_two_gigabytes_are_refused_and_a_running_fit_does_not_delay_the_end(night):
    check_two_gigabytes_are_refused_unread(night)
    (process,) = night.processes
    posted = night.client.post("/v1/fits?method=paper", content=an_archive())
    assert posted.status_code == httpx.codes.ACCEPTED
    process.send(signal.SIGTERM)
    assert process.ended(30.0) == 0, process.log
    assert not (night.directory / "data" / "uploads").exists()
