"""A shape is loaded and held, with a service and an RTC as processes of their own."""

import io
import json
import subprocess
import sys
import time

import numpy as np
import pytest
import zenoh.ext

from service.wire import ReferencesRequest, decode
from tests.support.checker import write_plant
from tests.support.fake_rtc import client_session
from tests.support.night import N_TARGET, a_night, wait_for

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(240)]

NCPA = ("--ncpa", "40", "--ncpa-zernike", "5")
SHAPE = {"kind": "zernike", "frame": "instrument", "values": [0.0, 0.0, 0.0, 0.0, 40.0]}


@pytest.fixture
def night(tmp_path):
    with a_night(tmp_path) as night:
        yield night


def references(night):
    return night.state["references"]


def load(night, shape=SHAPE):
    """Load a shape once the registration is known and the matrices are those of the service."""
    wait_for(lambda: (night.state["registration"] or {}).get("validity") == "fresh", 60.0)
    wait_for(lambda: night.state["rtc"]["n_controlled"] == N_TARGET, 60.0)
    night.client.post("/v1/references", json=shape | {"unit": "nm"}).raise_for_status()


def static_nm(path, reference_id):
    """Return the static error of the last line under a name."""
    lines = [json.loads(line) for line in path.read_text().splitlines()[:-1]]
    named = (one for one in lines if one.get("reference_id", 0) == reference_id)
    return [one["static_error_nm"] for one in named][-1]


def test_a_shape_is_held_read_back_and_given_up(night, tmp_path):
    """18 nm: the linear telescope has gains by mode that its four dithered modes do not show."""
    truth = tmp_path / "truth.jsonl"
    night.service()
    night.rtc(*NCPA, "--truth", str(truth))
    load(night)
    wait_for(lambda: references(night)["verified"], 20.0, lambda: references(night))
    used = references(night)["used"]["id"]
    assert night.state["reference_id"] == used
    time.sleep(10.0)
    assert static_nm(truth, None) == pytest.approx(40.0, abs=5.0)
    assert static_nm(truth, used) < 18.0
    night.client.delete("/v1/references").raise_for_status()
    wait_for(lambda: references(night)["used"]["id"] != used, 20.0)
    own = references(night)["used"]
    assert own["offset_rms"] == 0.0
    wait_for(lambda: references(night)["verified"], 20.0)
    time.sleep(5.0)
    assert static_nm(truth, own["id"]) == pytest.approx(40.0, abs=5.0)
    night.check_alarms()


def load_file(night, path, *words):
    """Load a shape by the command line; return its exit status and what it says."""
    command = [sys.executable, "-m", "pyrcal", "references", "load", str(path), *words]
    url = f"http://127.0.0.1:{night.port}"
    done = subprocess.run([*command, "--url", url], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def json_file(folder, **changes):
    path = folder / f"{'-'.join(changes)}.json"
    document = {"kind": "modes", "frame": "mirror", "unit": "nm", "values": [0, 0, 0, 0, 30]}
    path.write_text(json.dumps(document | changes))
    return path


def test_bad_input_is_refused_the_references_in_use_stay_and_every_kind_of_file_is_held(
    night, tmp_path
):
    fits = pytest.importorskip("astropy.io.fits")
    night.service()
    night.rtc()
    load(night)
    wait_for(lambda: references(night)["verified"], 20.0, lambda: references(night))
    used = references(night)["used"]["id"]
    slopes, instrument = tmp_path / "slopes.npy", ("--frame", "instrument")
    np.save(slopes, np.full(7, 0.01))
    for path, words, says in (
        (json_file(tmp_path, basis_id="kl-7"), (), "basis_id: found kl-7, expected"),
        (json_file(tmp_path, values=[0, float("nan")]), (), "found 1 values that are not finite"),
        (json_file(tmp_path, unit="m"), (), "found 30 m, is the unit m?"),
        (slopes, ("--kind", "slopes", *instrument), "slopes: found 7, expected"),
    ):
        status, said = load_file(night, path, *words)
        assert status != 0, said
        assert says in said
    status, said = load_file(night, json_file(tmp_path, values=[0, 0, 0, 0, 400]))
    assert status == 0, said
    wait_for(lambda: references(night)["newest"]["state"] == "refused", 20.0)
    assert "at most" in references(night)["newest"]["reason"]
    assert references(night)["used"]["id"] == used

    offset = night.client.get(f"/v1/references/{used}/slopes", params={"format": "npy"})
    np.save(slopes, 0.8 * np.load(io.BytesIO(offset.raise_for_status().content)))
    y, x = (np.indices((40, 40)) + 0.5) / 20.0 - 1.0
    lit = (np.hypot(x, y) < 1.0) & (np.hypot(x, y) > 0.3)
    np.save(tmp_path / "map.npy", np.where(lit, 60.0 * x * y, np.nan))
    columns = [
        fits.Column(name="noll", format="J", array=[5, 4]),
        fits.Column(name="amplitude", format="D", array=[30.0, 5.0], unit="nm"),
    ]
    fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "table.fits")
    for path, words in (
        (slopes, ("--kind", "slopes")),
        (tmp_path / "map.npy", ("--unit", "nm")),
        (tmp_path / "table.fits", ()),
    ):
        status, said = load_file(night, path, *instrument, *words)
        assert status == 0, said
        wait_for(
            lambda path=path: (
                references(night)["shape"]["source"] == path.name
                and references(night)["used"]["shape"] == references(night)["shape"]["id"]
            ),
            30.0,
            lambda: references(night),
        )


def test_an_rtc_that_turns_their_sign_is_named_within_seconds(night):
    night.service()
    night.rtc(*NCPA, "--fault", "references-scaled@0:-1,0,1000")
    load(night)
    wait_for(lambda: "references-misapplied" in night.alarms, 20.0)
    assert "other numbers" in night.alarms["references-misapplied"]
    # In mode auto it returns to its own references, which are right with any sign.
    wait_for(lambda: (references(night)["used"] or {}).get("offset_rms") == 0.0, 20.0)


def test_for_an_rtc_without_the_command_they_are_on_the_topic(night, tmp_path):
    plant = write_plant(tmp_path / "plant.npz")
    night.service()
    night.start("rtc", ["examples.rtc", night.zenoh, "small", str(plant)])
    load(night, {"kind": "modes", "frame": "mirror", "values": [0.0, 0.0, 0.0, 0.0, 30.0]})
    wait_for(lambda: references(night)["unsupported"], 60.0, lambda: references(night))
    assert references(night)["used"] is None
    history = zenoh.ext.HistoryConfig(max_samples=1)
    with client_session(night.zenoh) as session:
        topic = "ao/v1/small/references"
        heard = zenoh.ext.declare_advanced_subscriber(session, topic, history=history)
        sample = wait_for(heard.try_recv)
    request = decode(ReferencesRequest, sample.payload.to_bytes())
    assert request.reference_id == references(night)["newest"]["id"]
    assert request.offset.any()
