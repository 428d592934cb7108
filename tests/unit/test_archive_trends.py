"""Samples of every moment: taken of what is known, kept, thinned, and answered over REST."""

import asyncio
import contextlib
from dataclasses import fields, replace

import numpy as np
import pytest

from service.archive.nights import TREND_S, TrendSample
from service.control.expected_gain import ExpectedGain
from service.control.gains import ModeGain
from service.errors import ArchiveError
from service.estimation.frames import FrameBlock
from service.model.misregistration import Misregistration
from service.runtime import telemetry_recorder as of_moments
from service.runtime.telemetry_recorder import TrendSampler, residual_of, sample_of
from service.tracking.products import Assessment
from service.wire import Pointing
from tests.states import changed
from tests.unit.test_api import ALPHA, SECOND, SIGMA, STATE, service

__all__ = ["service"]  # a fixture

FULL = TrendSample(
    t_ns_utc=SECOND,
    telemetry_ns_utc=7,
    alpha=ALPHA,
    sigma=SIGMA,
    wavefront_m=6e-8,
    residual_m=5e-8,
    margin=0.9,
    optical_gain=0.5,
    n_controlled=400,
    magnitude=11.5,
    flux=3.25,
    elevation_deg=61.0,
    azimuth_deg=-12.0,
)


def at(t_s, **changes):
    return replace(FULL, t_ns_utc=round(t_s * SECOND), **changes)


def test_a_sample_comes_back_as_it_was(archive):
    nothing = TrendSample(t_ns_utc=2 * SECOND)
    archive.record((), (), (), (FULL, nothing))
    full, bare = archive.nights.samples(0, 2 * SECOND, 10)
    assert isinstance(full.n_controlled, int)
    assert bare == nothing or bare.alpha is bare.sigma is bare.residual_m is None
    for field in fields(TrendSample):
        ours, theirs = getattr(full, field.name), getattr(FULL, field.name)
        if isinstance(theirs, Misregistration):
            ours, theirs = ours.vector, theirs.vector
        np.testing.assert_allclose(ours, theirs, rtol=1e-14, err_msg=field.name)


def test_of_many_the_worst_and_the_ends_remain(archive):
    night = [at(15 * k, residual_m=9e-7 if k == 777 else 5e-8) for k in range(3000)]
    archive.record((), (), (), night)
    found = archive.nights.samples(0, 10**18, 200)
    assert 100 <= len(found) <= 200
    assert found[-1].t_ns_utc == night[-1].t_ns_utc
    assert max(one.residual_m for one in found) == 9e-7
    gaps = np.diff([one.t_ns_utc for one in found]) / SECOND
    assert gaps.max() <= 2 * 15 * 3000 / 200 * 1.5


def block(slopes, cm_id="cm-1", t0_ns=5 * SECOND):
    n = len(slopes)
    return FrameBlock(
        session="s-1",
        first_seq=0,
        t0_ns_utc=t0_ns,
        dt_ns=1_000_000,
        slopes=slopes.astype(np.float32),
        commands_m=np.zeros((n, 2), np.float32),
        dither_m=None,
        cm_id=cm_id,
    )


def test_the_residual_is_what_the_matrix_reads_in_the_slopes():
    matrix = np.array([[1e-7, 0.0, 0.0], [0.0, 2e-7, 0.0]], np.float32)
    slopes = np.array([[0.3, 0.2, 9.0], [-0.3, -0.2, 9.0]])
    assert residual_of(block(slopes), matrix) == pytest.approx(5e-8), "3 and 4 at right angles"
    assert residual_of(block(slopes[:, :2]), matrix) is None


def test_what_is_known_is_in_the_sample():
    expected = ExpectedGain(loss_m=1e-8, wavefront_m=5e-8, pole_radius=0.8, fresh_pole_radius=0.8)
    gains = tuple(ModeGain(mode=k, gain=g, sigma=0.1, scatter=0.1, t_ns_utc=1) for k, g in
                  enumerate((0.4, 0.6)))  # fmt: skip
    state = changed(
        STATE,
        registration=replace(STATE.alpha.registration, optical_gains=gains),
        assessment=Assessment(id="rtc-0", alpha=ALPHA, expected=expected, t_ns_utc=1),
        pointing=Pointing(elevation_deg=61.0, azimuth_deg=120.0),
        rtc=replace(STATE.loop.rtc, magnitude=11.0, flux=np.full(4, 2.5, "<f4").tobytes()),
    )
    found = sample_of(state, 9, 8, 7e-8)
    assert (found.t_ns_utc, found.telemetry_ns_utc, found.residual_m) == (9, 8, 7e-8)
    assert found.wavefront_m == pytest.approx(6e-8)
    assert found.margin == pytest.approx(0.8 / 0.95)
    assert found.optical_gain == pytest.approx(0.5)
    assert (found.n_controlled, found.magnitude, found.flux) == (400, 11.0, 2.5)
    assert (found.elevation_deg, found.azimuth_deg) == (61.0, 120.0)
    np.testing.assert_array_equal(found.sigma, state.alpha.registration.sigma)
    another = changed(state, in_use="cm-9")
    assert sample_of(another, 9, 8, None).wavefront_m is None, "it is of another matrix"


async def test_telemetry_that_stands_is_none(monkeypatch):
    monkeypatch.setattr(of_moments, "TREND_S", 0.001)
    taken, frames = [], block(np.ones((4, 3)), cm_id="cm-1")

    def unknown(_):
        raise ArchiveError("nobody has its numbers")

    sampler = TrendSampler(
        state=lambda: STATE, frames=lambda: frames, matrix=unknown, keep=taken.append
    )
    running = asyncio.create_task(sampler.run())
    async with asyncio.timeout(5.0):
        while len(taken) < 3:  # noqa: ASYNC110 - as it goes on
            await asyncio.sleep(0.001)
    running.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await running
    ends = [one.telemetry_ns_utc for one in taken[:3]]
    assert ends == [5 * SECOND + 4_000_000, None, None]
    assert taken[0].residual_m is None


async def test_the_trends_are_answered_with_how_far_apart_they_are(client, service):
    service.archive.record((), (), (), [at(15 * k) for k in range(100)])
    told = (await client.get("/v1/trends", params={"since_ns": 15 * SECOND})).json()
    assert (len(told["samples"]), told["interval_s"]) == (99, TREND_S)
    first = told["samples"][0]
    assert first["t_utc"] == "1970-01-01T00:00:15.000000Z"
    assert first["alpha"]["rotation_deg"] == pytest.approx(0.3)
    thin = (await client.get("/v1/trends", params={"points": 8})).json()
    assert len(thin["samples"]) <= 8
    assert thin["interval_s"] > 15 * 100 / 8


PATHS = ("trends", "nights", "marks", "annotations", "audit", "alpha/history")


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("query", ["since=0020-01-01T00:00:00Z", "until=9999-01-01T00:00:00Z"])
async def test_a_time_that_no_clock_here_can_have_is_refused_with_those_that_can(
    client, path, query
):
    told = await client.get(f"/v1/{path}?{query}")
    assert told.status_code == 422, told.text
    expected = "expected a time from 1970-01-01T00:00:00Z to 2262-04-11T23:47:16Z"
    assert expected in told.json()["detail"]


@pytest.mark.parametrize("path", ["trends", "nights", "marks", "annotations"])
async def test_the_first_and_the_last_time_there_can_be_are_answered(client, path):
    query = "since=1970-01-01T00:00:00Z&until=2262-04-11T23:47:16Z"
    assert (await client.get(f"/v1/{path}?{query}")).status_code == 200
