"""The programs of pyrcal on a secured link: service, simulator, checker, examples."""

import json
import re
import subprocess
import sys
import time

import msgpack
import pytest
import zenoh

from service.config.link_tables import read_link_tables
from tests.support.cable import free_port
from tests.support.fake_rtc import FakeRtc
from tests.support.night import INSTRUMENT, ROOT, a_night, wait_for
from tests.support.pace import patience

TLS = "transport/link/tls"

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]


def pyrcal(*words, **how):
    command = [sys.executable, "-m", "pyrcal", *map(str, words)]
    return subprocess.Popen(command, cwd=ROOT, text=True, stderr=subprocess.STDOUT, **how)


@pytest.fixture
def folder(tmp_path):
    made = pyrcal("certificates", "new", tmp_path / "tls", "--zenoh-port", free_port())
    assert made.wait(patience(20.0)) == 0
    return tmp_path / "tls"


def sign(folder, *names):
    """Have programs sign what they send."""
    for name in names:
        path = folder / f"{name}.toml"
        path.write_text(path.read_text().replace("# ", ""))


@pytest.mark.parametrize("signed", [False, True])
def test_the_checker_finds_the_simulator_through_certificates(folder, signed):
    if signed:
        sign(folder, "rtc", "service")
    where = ("--instrument", INSTRUMENT)
    rtc = pyrcal("sim", *where, "--config", folder / "rtc.toml", "--quiet", "--seconds", "60")
    try:
        checked = pyrcal(
            *("check-rtc", *where, "--config", folder / "service.toml", "--seconds", "4"),
            *("--only", "frames,status,dither,matrix,commit,rejection,replies,signatures", "--yes"),
            stdout=subprocess.PIPE,
        )
        found, _ = checked.communicate(timeout=patience(90.0))
    finally:
        rtc.kill()
        rtc.wait(patience(10.0))
    assert checked.returncode == 0, found
    assert "0 wrong" in found
    assert ("refused: unsigned, modified and replayed commands" in found) is signed
    assert ("no secret is shared" in found) is not signed


def test_the_checker_names_an_rtc_that_believes_what_nobody_has_signed(folder):
    """Its own messages are signed, and it takes anybody's."""
    sign(folder, "service")
    where = read_link_tables(folder / "rtc.toml").connect[0]
    secret = (folder / "signing.key").read_bytes().split()[0]
    tls = json.loads(zenoh.Config.from_file(str(folder / "rtc.json5")).get_json(TLS))
    words = ("--config", folder / "service.toml", "--system", "bench", "--instrument", INSTRUMENT)
    only = ("--only", "signatures", "--yes", "--seconds", "1")
    checker = pyrcal("check-rtc", *words, *only, stdout=subprocess.PIPE)
    patient = {"connect/timeout_ms": -1, TLS: tls}
    with FakeRtc(where, secret=secret, **patient) as rtc:
        rtc.signatures.check = lambda *_: None
        while checker.poll() is None:
            rtc.send_status()
            time.sleep(0.2)
    found, _ = checker.communicate()
    assert checker.returncode == 1, found
    assert "an unsigned command was accepted; a modified command was accepted" in found


@pytest.fixture
def night(folder, tmp_path):
    """A service and a simulated RTC that meet with certificates."""
    with a_night(tmp_path) as night:
        table = (folder / "service.toml").read_text()
        night.zenoh = json.loads(table.splitlines()[1].partition("= ")[2])[0]
        table = table.replace("[zenoh.tls]", "[zenoh.tls]\nwarn_days = 400")
        night.settings.write_text(night.settings.read_text() + table)
        yield night


def stranger(folder, **tls):
    """Connect as anybody would who has zenoh and the viewer's certificate, or something else."""
    config = zenoh.Config.from_file(str(folder / "viewer.json5"))
    if tls:
        config.insert_json5("transport/link/tls", json.dumps(tls))
    config.insert_json5("connect/exit_on_failure", "true")
    config.insert_json5("connect/timeout_ms", "1500")
    return zenoh.open(config)


def log_lines(process, event):
    lines = [json.loads(line) for line in process.log.splitlines() if line.startswith("{")]
    return [line for line in lines if line.get("event") == event]


ROOT_KEY = "ao/v1/small"
COMMAND = f"{ROOT_KEY}/cmd/rtc/loop"


def test_what_strangers_tried_is_logged_with_who_and_seen_on_the_page(night, folder):
    service = night.service("hold", wait=False)
    night.rtc("--config", folder / "rtc.toml")
    wait_for(lambda: night.ready(service) and night.state["link"]["frames_received"] > 100, 60.0)
    connected = {line["who"]: line["role"] for line in log_lines(service, "link.connected")}
    assert connected == {"rtc": "rtc"}

    gain = wait_for(lambda: night.rtc_says("gains"), 10.0)
    with stranger(folder) as session:
        held = [session.declare_subscriber("ao/**", print)]
        list(session.get(COMMAND, payload=msgpack.packb({"v": 1}), timeout=0.5))
        for key in ("cm/mine/commit", "cm/ack", "tel/frames", "tel/status"):
            session.put(f"{ROOT_KEY}/{key}", b"forged")
        held += [session.declare_queryable(f"{ROOT_KEY}/cm/*", print)]
        held += [session.liveliness().declare_token(f"{ROOT_KEY}/alive/service")]
        time.sleep(1.0)
        assert len(held) == 3
    ending = wait_for(lambda: night.alarms.get("certificate-ending"), 10.0)
    for name in ("service", "rtc", "viewer"):
        assert re.search(rf"the certificate of {name} \(.*?\) ends in 36[45] days", ending)
    assert night.rtc_says("gains") == gain
    night.no_frame_is_lost()

    with pytest.raises(zenoh.ZError):
        stranger(folder, root_ca_certificate=str(folder / "ca.pem")).close()
    assert "RTC" not in night.state["ready_reason"]
