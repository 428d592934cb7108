"""The service as systemd starts it, and nobody else: the unit's own line, its socket."""

import re
import signal
import socket

import pytest

from tests.support.cable import free_port
from tests.support.deploy import SERVICE
from tests.support.night import INSTRUMENT, Process, session_members
from tests.support.pace import patience
from tests.support.repository import ROOT

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]


def test_the_line_of_the_unit_starts_a_service_that_reports_feeds_and_ends(tmp_path, monkeypatch):
    (line,) = SERVICE["ExecStart"]
    _, *words = line.replace("/etc/pyrcal/pyrcal.toml", str(ROOT / "deploy/pyrcal.toml")).split()
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", "1500000")
    for key, value in {
        "SERVICE__DATA_DIR": tmp_path / "data",
        "SERVICE__CACHE_DIR": tmp_path / "cache",
        "SERVICE__INSTRUMENT": INSTRUMENT,
        "API__PORT": free_port(),
        "ZENOH__LISTEN": f'["tcp/127.0.0.1:{free_port()}"]',
    }.items():
        monkeypatch.setenv(f"PYRCAL_{key}", str(value))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(patience(60.0))
        process = Process("service", ["pyrcal", *words], tmp_path)
        try:
            heard = [systemd.recv(4096).decode() for _ in range(4)]
            assert heard[0] == "READY=1", process.log
            assert all(text.startswith("WATCHDOG=1\nSTATUS=") for text in heard[1:])
            assert re.search("rtc: .*", heard[-1]), heard
            process.send(signal.SIGTERM)
            while (text := systemd.recv(4096).decode()) != "STOPPING=1":
                assert text.startswith("WATCHDOG=1")
            assert process.ended(10.0) == 0, process.log
        finally:
            if session_members(process.popen.pid):
                process.kill()
