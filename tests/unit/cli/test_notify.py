"""systemd hears that the service has started and goes on, and nothing once it stands still."""

import asyncio
import os
import socket

import pytest

from service.cli import notify


@pytest.fixture
def systemd(tmp_path, monkeypatch):
    """The socket that systemd listens on."""
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.bind(path)
        heard.settimeout(5.0)
        monkeypatch.setenv("NOTIFY_SOCKET", path)
        yield heard


def heard_by(systemd):
    return systemd.recv(4096).decode()


async def told(stalled, n, systemd):
    task = asyncio.create_task(notify.keep_informed(lambda: stalled, lambda: "rtc: no\ntelemetry"))
    try:
        return [await asyncio.to_thread(heard_by, systemd) for _ in range(n)]
    finally:
        task.cancel()


async def test_a_service_that_goes_on_feeds_the_watchdog_three_times_in_its_limit(
    systemd, monkeypatch
):
    monkeypatch.setenv("WATCHDOG_USEC", "60000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    assert notify.feeding_interval_s() == pytest.approx(0.02)
    first, *others = await told("", 3, systemd)
    assert first == "READY=1"
    assert others == ["WATCHDOG=1\nSTATUS=rtc: no\\ntelemetry"] * 2


async def test_one_that_stands_still_lets_it_starve_and_says_why(systemd, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "60000")
    _, *others = await told("the tick has stood still", 3, systemd)
    assert others == ["STATUS=the tick has stood still"] * 2


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "x"},
        {"WATCHDOG_USEC": "9", "WATCHDOG_PID": "1"},
    ],
)
def test_a_watchdog_that_is_not_this_process_s_is_not_fed(environment):
    assert notify.feeding_interval_s(environment) is None


def test_an_abstract_socket_is_reached_too_and_one_that_is_gone_costs_nothing():
    name = f"pyrcal-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as heard:
        heard.bind(f"\0{name}")
        heard.settimeout(5.0)
        notify.notify("STOPPING=1", {"NOTIFY_SOCKET": f"@{name}"})
        assert heard_by(heard) == "STOPPING=1"
    notify.notify("READY=1", {"NOTIFY_SOCKET": "/nowhere/at/all"})
    notify.notify("READY=1", {})
