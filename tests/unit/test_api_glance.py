"""Singular values and slopes over real HTTP messages, with a hand-written service behind them."""

import io
from types import SimpleNamespace

import numpy as np
import pytest

from service.control.reconstructor import invert
from service.errors import UnknownIdError
from service.estimation.frames import FrameBlock
from service.instrument import packaged_instrument
from service.model.pupil import rtc_valid_subapertures
from service.web import matrices, page
from tests.support.api import assert_problem


class FakeService:
    """One reconstructor, and the last frames."""

    def __init__(self):
        self.instrument = packaged_instrument("flao-lbt")
        self.newest_frames = None
        self.description = None
        self.interaction = np.random.default_rng(3).normal(size=(12, 4)) * [1e7, 5e6, 2e6, 4e5]

    def matrix(self, matrix_id):
        if matrix_id != "cm-1":
            raise UnknownIdError(f"unknown reconstructor {matrix_id}")
        return invert(self.interaction, 4).matrix


@pytest.fixture
def service():
    return FakeService()


async def test_singular_values_are_those_of_the_matrix_it_inverts(client, service):
    response = await client.get("/v1/reconstructors/cm-1/singular-values")
    expected = np.linalg.svd(service.interaction, compute_uv=False)
    assert response.json()["values"] == pytest.approx(expected, rel=1e-3)
    assert response.json()["nominal"] is None
    nominal = np.random.default_rng(4).normal(size=(12, 6)).astype(np.float32)
    service.description = SimpleNamespace(products=nominal.T @ nominal)
    response = await client.get("/v1/reconstructors/cm-1/singular-values")
    expected = np.linalg.svd(nominal[:, :4], compute_uv=False)
    assert response.json()["nominal"] == pytest.approx(expected, rel=1e-3)
    assert "max-age" in response.headers["cache-control"], "it never changes"
    unknown = await client.get("/v1/reconstructors/cm-2/singular-values")
    assert_problem(unknown, 404, "unknown-id", "cm-2")


async def test_products_are_summed_over_slopes_some_at_a_time(monkeypatch):
    matrix = np.random.default_rng(5).normal(size=(7, 23)).astype(np.float32)
    monkeypatch.setattr(matrices, "_SLOPES_PER_PRODUCT", 5)
    expected = matrix.astype(float) @ matrix.astype(float).T
    np.testing.assert_allclose(matrices._products(matrix), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("form", ["raw", "npy"])
async def test_a_large_matrix_leaves_in_parts_and_is_whole(client, service, monkeypatch, form):
    monkeypatch.setattr(matrices, "RESPONSE_PART_BYTES", 100)
    answer = await client.get(f"/v1/reconstructors/cm-1/matrix?format={form}")
    matrix, file = service.matrix("cm-1"), io.BytesIO()
    np.save(file, matrix)
    expected = {"raw": matrix.tobytes(), "npy": file.getvalue()}[form]
    assert answer.content == expected
    assert int(answer.headers["content-length"]) == len(expected)
    assert answer.headers["x-shape"] == "4,12"


def frames(slopes, t0_ns_utc=5):
    return FrameBlock(
        session="s", first_seq=1, t0_ns_utc=t0_ns_utc, dt_ns=1_000_000, slopes=slopes,
        commands_m=np.zeros((2, 1), np.float32), dither_m=None, cm_id="cm-1",
    )  # fmt: skip


@pytest.mark.parametrize(("shown_s", "t_ns"), [(0.0, 6), (1e9, 5)])
async def test_one_picture_of_the_slopes_serves_all_who_ask_soon(
    client, service, monkeypatch, shown_s, t_ns
):
    monkeypatch.setattr(page, "SHOWN_S", shown_s)
    slopes = np.zeros((2, 2 * int(rtc_valid_subapertures(service.instrument).sum())), np.float32)
    for t0_ns in (5, 6):
        service.newest_frames = frames(slopes, t0_ns)
        told = (await client.get("/v1/slopes")).json()
    assert told["t_ns_utc"] == t_ns


async def test_slopes_lie_where_their_subapertures_are(client, service):
    assert_problem(await client.get("/v1/slopes"), 404, "unknown-id", "no telemetry has come yet")
    valid = rtc_valid_subapertures(service.instrument)
    half = int(valid.sum())
    slopes = np.zeros((2, 2 * half), np.float32)
    slopes[:, 0] = 0.3, -0.4  # the first x slope; its RMS about zero is sqrt((0.09 + 0.16) / 2)
    service.newest_frames = frames(slopes)
    body = (await client.get("/v1/slopes")).json()
    maps = np.array(body["rms"], dtype=float)
    assert (body["n_frames"], body["cm_id"], maps.shape) == (2, "cm-1", (30, 60))
    assert np.isnan(maps).sum() == 2 * (valid.size - half)
    row, column = np.argwhere(valid)[0]
    assert maps[row, column] == pytest.approx(0.3536)
    assert np.nansum(maps) == pytest.approx(0.3536)
