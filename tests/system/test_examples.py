"""The programs of examples/ do what they say: an RTC from the contract alone is calibrated."""

import time

import msgpack
import pytest
import zenoh

from tests.support.cable import free_port
from tests.support.checker import checked_beside, late_with_the_machine, write_plant
from tests.support.night import ALPHA, INSTRUMENT, N_START, N_TARGET, ROOT, a_night, wait_for

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]

SYSTEM = "small"


@pytest.fixture
def plant(tmp_path):
    return write_plant(tmp_path / "plant.npz")


def test_they_are_as_short_as_the_page_says():
    for name, most in (("subscribe", 42), ("rtc", 214), ("secured", 65)):
        text = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")
        assert text.count("\n") <= most
        assert "service" not in {
            word.split(".")[0]
            for line in text.splitlines()
            for word in line.split()[1:2]
            if line.startswith(("import ", "from "))
        }


@pytest.mark.long
def test_the_rtc_is_registered_and_swaps_a_matrix_that_a_subscriber_gets_too(tmp_path, plant):
    with a_night(tmp_path) as night:
        night.service("auto")
        subscriber = night.start("subscribe", ["examples.subscribe", night.zenoh, SYSTEM])
        rtc = night.start("rtc", ["examples.rtc", night.zenoh, SYSTEM, str(plant)])
        wait_for(lambda: night.state["link"]["frames_received"], 20.0, lambda: rtc.log)
        known = wait_for(lambda: night.state["registration"], 30.0, lambda: night.state)
        for name, truth in ALPHA.items():
            assert abs(known["alpha"][name] - truth) < 4 * known["sigma"][name], (name, known)
        night.wait_for_modes(N_TARGET)
        in_use = night.state["in_use"]
        wait_for(lambda: night.rtc_says("cm_id") == in_use, 10.0, "its status names it")
        told = next(line for line in subscriber.log.splitlines() if line.startswith(in_use))
        assert told.endswith("right")
        assert f"({N_TARGET}, " in told
        night.no_frame_is_lost()

        where = ["--connect", night.zenoh, "--instrument", str(INSTRUMENT), "--seconds", "2"]
        check = night.start("check", ["pyrcal", "check-rtc", *where, "--yes"])
        assert check.ended(40.0) == 0, check.log
        assert "a service drives this RTC: end it first" in check.log
        words = ["pyrcal", "check-rtc", "--connect", night.zenoh, "--passive", "--seconds", "2"]
        passive = night.start("passive", words)
        assert passive.ended(40.0) == 0, passive.log
        assert f"system {SYSTEM}" in passive.log
        assert night.state["in_use"] == in_use


def test_the_rtc_joins_a_secured_link_and_takes_what_is_signed_alone(tmp_path, plant):
    """Its swap, its gains and its replies: the service's own, and none of a stranger's."""
    folder, port = tmp_path / "tls", free_port()
    make = ["pyrcal", "certificates", "new", str(folder), "--zenoh-port", str(port)]
    with a_night(tmp_path) as night:
        assert night.start("certificates", make).ended(20.0) == 0
        table = (folder / "service.toml").read_text().replace("# ", "")
        night.settings.write_text(night.settings.read_text() + table)
        night.zenoh = f"tls/127.0.0.1:{port}"
        service = night.service("auto", wait=False)
        secured = [str(folder / "rtc.json5"), str(folder / "signing.key")]
        night.start("rtc", ["examples.rtc", night.zenoh, SYSTEM, str(plant), *secured])
        wait_for(lambda: night.ready(service), 60.0, lambda: service.log)
        night.wait_for_modes(N_START, 60.0)
        gains, before = night.rtc_says("gains"), night.state["in_use"]
        # the RTC's own certificate, stolen, and the service's: all but the secret
        thief = zenoh.Config.from_file(secured[0])
        tls = thief.get_json("transport/link/tls").replace("tls/rtc", "tls/service")
        thief.insert_json5("transport/link/tls", tls)
        order = {"v": 1, "id": "mine", "gains": [1.9] * len(gains), "leak": 1.0, "loop": None}
        with zenoh.open(thief) as session:
            asked = msgpack.packb(order | {"n_controlled": None})
            key = f"ao/v1/{SYSTEM}/cmd/rtc/loop"
            (reply,) = session.get(key, payload=asked, timeout=5.0)
            said = msgpack.unpackb(reply.ok.payload.to_bytes())
            assert (said["accepted"], said["reason"]) == (False, "signature: none")
            session.put(f"ao/v1/{SYSTEM}/cm/mine/commit", msgpack.packb({"v": 1, "id": "mine"}))
            session.put(f"ao/v1/{SYSTEM}/tel/status", msgpack.packb({"v": 1}))
            time.sleep(1.0)
        assert night.rtc_says("gains") == gains
        assert night.rtc_says("cm_id") == before


@pytest.mark.long
@pytest.mark.parametrize(
    ("module", "expected"),
    [
        ("examples.rtc", {"late-join", "images", "references"}),
        ("examples.rtc_with_library", {"images"}),
    ],
)
def test_the_rtc_keeps_the_contract(tmp_path, plant, module, expected):
    status, checks, text = checked_beside(
        tmp_path, lambda endpoint: [module, endpoint, SYSTEM, str(plant)], "--yes"
    )
    flagged = {name for name, one in checks.items() if one["outcome"] != "ok"}
    if "delivery" in flagged and late_with_the_machine(checks["delivery"]):
        flagged.remove("delivery")
    assert flagged == expected, text  # neither sends light
    assert status == int(any(one["outcome"] == "wrong" for one in checks.values()))
