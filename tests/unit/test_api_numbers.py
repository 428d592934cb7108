"""A reconstructor by what it is, and its numbers in every form."""

import hashlib
import io
import sys
from dataclasses import replace
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from service.archive import Archive
from service.records.products import MatrixState, ReconstructorRecord, ReferencesRecord
from service.records.state import ReferenceStates, TrackerState
from service.wire import checksum
from tests.support.api import FakeService, a_snapshot
from tests.support.states import tracker_state

MATRIX = np.arange(12, dtype=np.float32).reshape(3, 4) / 7


def record(name, state):
    return ReconstructorRecord(
        id=name, state=state, n_modes=3, created_ns_utc=1, sha256=checksum(MATRIX)
    )


RECORDS = (
    record("cm-1", MatrixState.SUPERSEDED),
    record("cm-2", MatrixState.SUPERSEDED),
    record("cm-3", MatrixState.APPLIED),
    record("cm-4", MatrixState.PROPOSED),
)


class Archived(FakeService):
    """Has the matrices of a real archive."""

    def matrix(self, matrix_id):
        return self.archive.reconstructors.matrix(matrix_id)


@pytest.fixture
def service(tmp_path):
    archive = Archive(tmp_path)
    archive.open()
    with archive:
        for one in RECORDS:
            archive.reconstructors.store(one, MATRIX, None, {})
        state = tracker_state(system="flao-lbt", reconstructors=RECORDS, in_use="cm-3")
        yield Archived(a_snapshot(state), archive=archive)


@pytest.mark.parametrize(
    ("alias", "name"), [("in-use", "cm-3"), ("previous", "cm-2"), ("candidate", "cm-4")]
)
async def test_a_reconstructor_is_found_by_what_it_is(client, service, alias, name):
    assert (await client.get(f"/v1/reconstructors/{alias}")).json()["id"] == name
    assert (await client.get(f"/v1/reconstructors/{alias}/gains")).json()["reconstructor"] == name
    matrix = await client.get(f"/v1/reconstructors/{alias}/matrix")
    assert f'filename="{name}.npy"' in matrix.headers["content-disposition"]
    answer = await client.post(f"/v1/reconstructors/{alias}/approve")
    assert answer.json()["links"]["reconstructor"] == f"/v1/reconstructors/{name}"
    assert service.commands[-1].id == name


@pytest.mark.parametrize(
    ("alias", "words"),
    [
        ("in-use", "no reconstructor is known to be in use"),
        ("previous", "no earlier reconstructor has been in use"),
        ("candidate", "no reconstructor is proposed"),
    ],
)
async def test_one_that_there_is_not_is_said_to_be_none(client, service, alias, words):
    service.now = a_snapshot(TrackerState(system="flao-lbt"))
    for answer in (
        await client.get(f"/v1/reconstructors/{alias}"),
        await client.post(f"/v1/reconstructors/{alias}/approve"),
    ):
        assert answer.status_code == 404
        assert answer.json()["detail"] == f"{alias}: {words}"
    assert service.commands == []


async def numbers(client, form):
    answer = await client.get(f"/v1/reconstructors/cm-3/matrix?format={form}")
    assert answer.status_code == 200, answer.text
    return answer


async def test_every_form_has_the_same_numbers(client):
    npy = await numbers(client, "npy")
    np.testing.assert_array_equal(np.load(io.BytesIO(npy.content)), MATRIX)
    raw = await numbers(client, "raw")
    assert hashlib.sha256(raw.content).hexdigest() == RECORDS[2].sha256
    assert npy.headers["x-shape"] == raw.headers["x-shape"] == "3,4"
    product = await numbers(client, "hdf5")
    assert product.headers["content-type"] == "application/x-hdf5"
    with h5py.File(io.BytesIO(product.content)) as file:
        np.testing.assert_array_equal(file["reconstructor"][()], MATRIX)


async def test_a_fits_image_has_them_too(client):
    fits = pytest.importorskip("astropy.io.fits")
    answer = await numbers(client, "fits")
    assert 'filename="cm-3.fits"' in answer.headers["content-disposition"]
    with fits.open(io.BytesIO(answer.content)) as file:
        assert file[0].header["OBJECT"] == "cm-3"
        np.testing.assert_array_equal(file[0].data, MATRIX)


async def test_without_its_package_a_fits_image_is_refused_by_name(client, monkeypatch):
    monkeypatch.setitem(sys.modules, "astropy.io", SimpleNamespace())
    answer = await client.get("/v1/reconstructors/cm-3/matrix?format=fits")
    assert answer.status_code == 409
    assert "pip install astropy" in answer.json()["detail"]


async def test_an_offset_of_references_leaves_for_a_program_that_applies_it(client, service):
    offset = np.linspace(-0.1, 0.1, 24).astype(np.float32)
    made = ReferencesRecord(
        id="ref-1", state=MatrixState.PROPOSED, created_ns_utc=1, sha256=checksum(offset)
    )
    service.archive.references.store(made, offset)
    known = replace(service.now.tracker, references=ReferenceStates(records=(made,)))
    service.now = a_snapshot(known)
    for alias in ("ref-1", "candidate", "newest"):
        answer = await client.get(f"/v1/references/{alias}/slopes?format=raw")
        assert answer.headers["X-Shape"] == "24"
        np.testing.assert_array_equal(np.frombuffer(answer.content, "<f4"), offset)
    assert (await client.get("/v1/references/in-use/slopes")).status_code == 404
    listed = (await client.get("/v1/references")).json()
    assert [one["id"] for one in listed["records"]] == ["ref-1"]
