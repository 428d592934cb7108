"""Who comes onto a secured link: what zenoh's log says, what is remembered, what is said of it."""

import os
import subprocess
import sys
import time

import pytest

from service.link import guard
from service.link.guard import Certificate, LinkGuard, LinkSecurity, ZenohLog
from service.link.guard import ending_in_words as ending
from service.link.guard import refused_in_words as refused

# as eclipse-zenoh 1.10.2 wrote them
ON = "TRACE rx-0 ThreadId(16) zenoh::net::routing::interceptor"
SUBJECT = "12 on Interface(lo)+CertCommonName(viewer)+Transport(Tls)+12"
DENIED = f"{ON}::access_control: {SUBJECT} is unauthorized to Put (ingress) on ao/v1/s/cm/a/commit"
DONE = f"{ON}: Msg intercepted!"
NO_CERTIFICATE = (
    "\x1b[2m2026-11-25T18:10:14Z\x1b[0m \x1b[33m WARN\x1b[0m acc-0 ThreadId(06) "
    "\x1b[2mzenoh_link_tls::unicast\x1b[0m\x1b[2m:\x1b[0m received fatal alert: UnknownCA. "
    "Hint: increase the system open file limit."
)
WRONG_USER = (
    "DEBUG acc-0 ThreadId(05) zenoh_transport::unicast::establishment::accept: UsrPwd extension - "
    "Recv OpenSyn. Invalid user. at /root/.cargo/usrpwd.rs:418."
)


def read(*lines):
    found = []
    log = ZenohLog(lambda *what: found.append(what))
    for line in lines:
        log.read(line)
    return found


def test_what_was_refused_has_name_message_and_key():
    assert read(DENIED, DONE) == [("viewer", "Put", "ao/v1/s/cm/a/commit")]


def test_what_zenoh_only_computes_ahead_was_not_refused():
    assert read(DENIED, DENIED, f"{ON}::access_control: caching") == []


def test_threads_that_speak_at_once_are_told_apart():
    other = DENIED.replace("ThreadId(16)", "ThreadId(17)").replace("viewer", "rtc")
    done = DONE.replace("ThreadId(16)", "ThreadId(17)")
    assert [who for who, _, _ in read(DENIED, other, DONE, done)] == ["viewer", "rtc"]


def test_what_the_router_does_not_send_is_no_attempt():
    assert read(DENIED.replace("ingress", "egress"), DONE) == []


def test_who_was_not_let_in_has_no_name():
    assert read(NO_CERTIFICATE) == [
        ("no certificate of ours", "Connect", "received fatal alert: UnknownCA")
    ]
    assert read(WRONG_USER) == [
        ("no known name and password", "Connect", "Recv OpenSyn. Invalid user.")
    ]


def test_a_refusal_is_spoken_of_for_a_minute_and_counted(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(guard.time, "monotonic", lambda: now[0])
    watched = LinkGuard(LinkSecurity())
    watched.refused("viewer", "Put", "a")
    now[0] += 1.0
    watched.refused("viewer", "Put", "a")
    (found,) = watched.refusals()
    assert (found.n, found.age_s) == (2, 0.0)
    assert refused([found]) == "refused on the link: viewer: Put (a), 2 times"
    now[0] += guard.RECENT_S
    assert watched.refusals() == ()


def test_a_flood_of_keys_takes_no_memory():
    watched = LinkGuard(LinkSecurity())
    for k in range(10_000):
        watched.refused("viewer", "Put", f"key-{k}")
    found = watched.refusals()
    assert len(found) == guard.REMEMBERED + 1
    assert sum(one.n for one in found) == 10_000
    assert refused(found).endswith(f"and {guard.REMEMBERED - 2} more")


def test_a_certificate_is_named_before_it_ends_and_when_it_has():
    now_s = time.time()
    days = {"rtc": 12.2, "viewer": 400.0, "service": -1.0}
    certificates = tuple(
        Certificate(path=f"{name}.pem", name=name, ends_s=now_s + n * guard.DAY_S)
        for name, n in days.items()
    )
    found = LinkGuard(LinkSecurity(certificates=certificates, warn_s=30 * guard.DAY_S)).ending()
    assert ending(found) == (
        "the certificate of service (service.pem) has ended; "
        "the certificate of rtc (rtc.pem) ends in 12 days"
    )
    assert ending(()) == ""


SCRIPT = """
import os, subprocess, sys
from service.link.guard import refusals_of_zenoh
found = []
with refusals_of_zenoh(lambda *what: found.append(what)):
    os.write(1, b"{line}\\n")
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    for _ in range(200):
        try:
            os.write(1, b"x" * 65_000 + b"\\n")
        except BlockingIOError:
            break
print(found[0][0], flush=True)
child.communicate(b"end\\n")
os.write(1, b"and on")
"""


def test_the_pipe_never_waits_not_even_for_a_child_and_standard_output_is_as_before(tmp_path):
    line = WRONG_USER
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.replace("{line}", line)],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ},
        check=True,
    )
    assert done.stdout == "no known name and password\nand on"


@pytest.mark.parametrize("name", ["link-refused", "certificate-ending"])
def test_each_has_its_alarm(name):
    from service.tracking.alarms import ALARMS

    assert ALARMS[name].severity == "warning"
