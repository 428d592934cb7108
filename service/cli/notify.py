"""Report start, progress and end of the service to systemd.

The protocol is that of sd_notify(3): datagrams to the socket that systemd names in the environment.
Without systemd there is no socket, and nothing is sent.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import Callable, Mapping

import structlog

from service.errors import shown

IDLE_S = 10.0
"""Interval between two status lines if there is no watchdog."""

FEEDS = 3.0
"""Messages per watchdog interval: one may be late, and one lost."""


def notify(text: str, environment: Mapping[str, str] = os.environ) -> None:
    """Send a message to systemd, if it has started the service and listens."""
    address = environment.get("NOTIFY_SOCKET", "")
    if not address:
        return
    if address.startswith("@"):  # of the abstract namespace
        address = "\0" + address[1:]
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
        out.setblocking(False)
        out.sendto(text.encode(), address)


def feeding_interval_s(environment: Mapping[str, str] = os.environ) -> float | None:
    """Return the interval of messages to the watchdog; None if this process has no watchdog."""
    limit_us, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if not limit_us.isdecimal() or int(limit_us) == 0 or pid not in {"", str(os.getpid())}:
        return None
    return 1e-6 * int(limit_us) / FEEDS


async def keep_informed(stalled: Callable[[], str], status: Callable[[], str]) -> None:
    """Report that the service has started; feed the watchdog while no part has stopped.

    Parameters
    ----------
    stalled
        Returns the part of the service that has stopped; empty if all run.
    status
        A line for ``systemctl status``.
    """
    every_s, complaint = feeding_interval_s(), ""
    notify("READY=1")
    while True:
        found = stalled()
        if found and not complaint:
            structlog.get_logger().error("service.stalled", text=found)
        complaint = found
        fed = "" if found or every_s is None else "WATCHDOG=1\n"
        notify(f"{fed}STATUS={shown(found or status())}")
        await asyncio.sleep(every_s or IDLE_S)
