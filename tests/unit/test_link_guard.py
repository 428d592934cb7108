"""Who comes onto a secured link: what is remembered, what is said of it."""

import time
from types import SimpleNamespace

import pytest
import zenoh

from service.link import guard
from service.link.guard import LinkGuard
from service.link.guard import describe_expiry as ending
from service.link.guard import describe_refusals as refused
from service.wire.access import Certificate, LinkSecurity


def test_a_refusal_is_spoken_of_for_a_minute_and_counted(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(guard.time, "monotonic", lambda: now[0])
    watched = LinkGuard(LinkSecurity())
    watched.refused("viewer", "Put", "a")
    now[0] += 1.0
    watched.refused("viewer", "Put", "a")
    (found,) = watched.refusals()
    assert (found.n, found.age_s) == (2, 0.0)
    assert refused([found]).values["text"] == "viewer: Put (a), 2 times"
    now[0] += guard.REFUSAL_REPORT_DURATION_S
    assert watched.refusals() == ()


def test_a_flood_of_keys_takes_no_memory():
    watched = LinkGuard(LinkSecurity())
    for k in range(10_000):
        watched.refused("viewer", "Put", f"key-{k}")
    found = watched.refusals()
    assert len(found) == guard.MAX_LISTED_REFUSALS + 1
    assert sum(one.n for one in found) == 10_000
    assert str(refused(found)).endswith(f"and {guard.MAX_LISTED_REFUSALS - 2} more")


def test_a_certificate_is_named_before_it_ends_and_when_it_has():
    now_s = time.time()
    days = {"rtc": 12.2, "viewer": 400.0, "service": -1.0}
    certificates = tuple(
        Certificate(path=f"{name}.pem", name=name, ends_s=now_s + n * guard.DAY_S)
        for name, n in days.items()
    )
    found = LinkGuard(LinkSecurity(certificates=certificates, warn_s=30 * guard.DAY_S)).ending()
    assert str(ending(found)) == (
        "the certificate of service (service.pem) has ended; "
        "the certificate of rtc (rtc.pem) ends in 12 days"
    )
    assert ending(()) is None


def test_a_name_without_a_role_that_comes_again_and_again_is_one_refusal():
    """Each of its connections has another port."""
    watched = LinkGuard(LinkSecurity(roles={"rtc": "rtc"}))
    for port in range(50_000, 50_020):
        link = SimpleNamespace(auth_identifier="x", dst=f"tls/10.0.0.9:{port}", zid="1")
        watched.on_link(SimpleNamespace(link=link, kind=zenoh.SampleKind.PUT))
    (found,) = watched.refusals()
    assert (found.who, found.n) == ("x", 20)
    assert found.where.endswith("tls/10.0.0.9")


def test_connections_that_were_closed_before_a_handshake_are_counted_by_port(tmp_path):
    """The kernel's table: local address and state are the second and fourth column."""
    table = tmp_path / "tcp"
    rows = [("1D17", "0A"), *[("1D17", "08")] * 30, ("1D17", "01"), ("1D18", "08"), ("1F90", "08")]
    lines = [
        f"  {k}: 0100007F:{port} 0900007F:C350 {s} 0:0 00:0" for k, (port, s) in enumerate(rows)
    ]
    table.write_text("\n".join(["  sl  local_address rem_address st", *lines]))
    listen = ("tls/0.0.0.0:7447", "tls/[::]:7448#iface=eth0", "tcp/127.0.0.1:8080")
    waiting = guard.count_waiting(listen, (table, tmp_path / "absent"))
    assert waiting == {7447: 30, 7448: 1}
    assert guard.describe_flood({7448: guard.MIN_ALARM_CONNECTIONS - 1}) is None
    flooded = guard.describe_flood(waiting)
    assert flooded.key == "link.flooded: 7447"
    assert "3 s" in str(flooded)


@pytest.mark.parametrize("name", ["link-refused", "certificate-ending"])
def test_each_has_its_alarm(name):
    from service.records.alarms import ALARMS

    assert ALARMS[name].severity == "warning"
