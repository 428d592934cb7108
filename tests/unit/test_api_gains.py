"""The table of loop gains over real HTTP messages, with a hand-written service behind it."""

from dataclasses import replace

import pytest

from service.archive import Archive
from service.archive.nights import TrendSample
from service.records.registration import MeasuredGains, ModeGain
from tests.support.api import FakeService, a_snapshot
from tests.support.handmade import REGISTRATION
from tests.support.situations import START_NS, record, rtc
from tests.support.states import tracker_state

MEASURED = (
    ModeGain(mode=20, gain=0.5, sigma=0.01, scatter=0.02, t_ns_utc=START_NS),
    ModeGain(mode=509, gain=0.7, sigma=0.02, scatter=0.02, t_ns_utc=START_NS),
)


@pytest.fixture
def service():
    state = tracker_state(
        rtc=rtc(),
        registration=replace(REGISTRATION, optical_gains=MEASURED),
        reconstructors=(record("cm-1", optical_gains=MEASURED[:1]), record("cm-2")),
    )
    return FakeService(a_snapshot(state, now_ns=0))


async def test_the_present_table_is_of_every_mode_of_the_basis(client):
    table = (await client.get("/v1/gains")).json()
    assert table["reconstructor"] is None
    assert [one["mode"] for one in table["measured"]] == [20, 509]
    assert len(table["optical_gain"]) == len(table["factor"]) == 594
    assert table["optical_gain"][20] == pytest.approx(0.5, rel=0.05)
    assert table["factor"][20] > table["factor"][509]


async def test_the_present_table_has_its_sigma_time_and_conditions(client, service):
    table = (await client.get("/v1/gains")).json()
    for gain, relative, sigma in zip(
        table["optical_gain"], table["relative_sigma"], table["sigma"], strict=True
    ):
        assert sigma == pytest.approx(gain * relative)
    # A measured mode is known to 2 %, because the response of the sensor is not diagonal.
    assert 0.008 < table["sigma"][20] < 0.02 < table["sigma"][300]
    assert table["t_ns_utc"] == str(START_NS) or table["t_ns_utc"] == START_NS
    assert (table["magnitude"], table["frame_rate_hz"]) == (8.0, 1000.0)
    service.change(reference_id="ncpa-2")
    assert (await client.get("/v1/gains")).json()["reference_id"] == "ncpa-2"
    alone = (await client.get("/v1/reconstructors/cm-2/gains")).json()
    assert (alone["t_ns_utc"], alone["magnitude"], alone["reference_id"]) == (None, None, None)


async def test_a_reconstructors_table_is_of_its_own_modes_and_time(client):
    table = (await client.get("/v1/reconstructors/cm-1/gains")).json()
    assert table["reconstructor"] == "cm-1"
    assert [one["mode"] for one in table["measured"]] == [20]
    assert len(table["factor"]) == 400


async def test_where_nothing_was_measured_the_table_says_so(client):
    table = (await client.get("/v1/reconstructors/cm-2/gains")).json()
    assert table["measured"] == []
    assert min(table["relative_sigma"]) > 0.1


async def test_the_gains_of_a_night_are_kept_with_their_conditions(client, service, tmp_path):
    night = [
        MeasuredGains(
            measured=tuple(replace(one, t_ns_utc=START_NS + k) for one in MEASURED),
            n_modes=594,
            reference_id="ncpa-2",
            magnitude=8.0 + k,
            frame_rate_hz=500.0,
        )
        for k in range(5)
    ]
    with Archive(tmp_path) as service.archive:
        service.archive.open()
        samples = [TrendSample(t_ns_utc=k, gains=gains) for k, gains in enumerate([*night, None])]
        service.archive.record((), (), (), samples)
        newest = (await client.get("/v1/gains/history?limit=2")).json()["entries"]
        oldest = (await client.get("/v1/gains/history?limit=2&after=0")).json()["entries"]
        later = f"/v1/gains/history?after={oldest[-1]['t_ns_utc']}"
        rest = (await client.get(later)).json()["entries"]
    assert [one["magnitude"] for one in newest] == [11.0, 12.0]
    assert [one["magnitude"] for one in (*oldest, *rest)] == [8.0, 9.0, 10.0, 11.0, 12.0]
    assert (newest[0]["reference_id"], newest[0]["frame_rate_hz"]) == ("ncpa-2", 500.0)
    now = (await client.get("/v1/gains")).json()
    assert [len(one["sigma"]) for one in newest] == [594, 594]
    assert newest[0]["optical_gain"] == now["optical_gain"]
    assert [one["mode"] for one in newest[0]["measured"]] == [20, 509]


async def test_a_table_of_nothing_is_a_problem(client, service):
    assert (await client.get("/v1/reconstructors/cm-9/gains")).status_code == 404
    service.change(rtc=None)
    answer = await client.get("/v1/gains")
    assert (answer.status_code, "no RTC is there" in answer.text) == (409, True)
