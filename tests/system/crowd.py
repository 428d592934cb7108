"""A thousand connections that keep others out, and how soon the service answers all the same.

``nice -n -12 python -m tests.system.crowd`` measures crowds at REST and at the port of the link,
with a simulated RTC at 1 kHz. Each connection that ends is made again after a second.
"""

import asyncio
import resource
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx

from tests.support.night import a_night, wait_for
from tests.support.pace import patience

N_CONNECTIONS = 1000
LASTS_S = 8.0
AGAIN_S = 1.0

HEAD = b"POST /v1/stop HTTP/1.1\r\nHost: 127.0.0.1\r\n"
BODY = b"Content-Type: application/json\r\nContent-Length: 1000\r\n\r\n"
KINDS = {
    "silent": (b"", b""),
    "half-sent": (HEAD + b"X-", b""),
    "slow": (HEAD + b"X-", b"x"),
    "slow-body": (HEAD + BODY, b" "),
}
"""What a connection sends at first, and each second."""


async def hold(port, kind, n_connections):
    """Keep so many connections open, for ever."""
    first, more = KINDS[kind]

    async def one():
        while True:
            with suppress(OSError):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.write(first)
                while not reader.at_eof():
                    with suppress(TimeoutError):
                        await asyncio.wait_for(reader.read(1000), 1.0)
                    writer.write(more)
                writer.transport.abort()
            await asyncio.sleep(AGAIN_S)

    await asyncio.gather(*(one() for _ in range(n_connections)))


@contextmanager
def crowded(night, kind, n_connections, port=None):
    """Have that crowd while the block lasts, as a process of its own."""
    words = ["tests.system.crowd", "hold", port or night.port, kind, n_connections]
    crowd = night.start("crowd", [str(word) for word in words])
    try:
        yield crowd
    finally:
        crowd.kill()


def time_of(night, method, path):
    """Return how long a new client waits for an answer, seconds; infinite if there is none."""
    began_s = time.monotonic()
    try:
        answer = httpx.request(method, f"{night.client.base_url}{path}", timeout=patience(5.0))
    except httpx.HTTPError:
        return float("inf")
    return time.monotonic() - began_s if answer.is_success else float("inf")


def has_alarm(night):
    """Return whether a new client is told of a crowd; False if it is not answered."""
    with suppress(httpx.HTTPError):
        answer = httpx.get(f"{night.client.base_url}/v1/state", timeout=patience(5.0))
        return any(alarm["name"] == "rest-crowded" for alarm in answer.json()["alarms"])
    return False


def measure(night, kind):
    """Return the longest times for /healthz and stop during a crowd, its alarm, its frames."""
    before = night.state["link"]
    with crowded(night, kind, N_CONNECTIONS):
        time.sleep(3.0)
        health_s, stop_s, alarmed = [], [], False
        until_s = time.monotonic() + LASTS_S
        while time.monotonic() < until_s:
            health_s.append(time_of(night, "GET", "/healthz"))
            stop_s.append(time_of(night, "POST", "/v1/stop"))
            time_of(night, "POST", "/v1/resume")
            alarmed |= has_alarm(night)
            time.sleep(0.5)
    time.sleep(2.0)
    after = wait_for(lambda: night.state, 10.0)["link"]
    n_frames = after["frames_received"] - before["frames_received"]
    n_lost = after["frames_lost"] - before["frames_lost"]
    return (
        f"{kind}: /healthz {max(health_s):.2f} s, stop {max(stop_s):.2f} s at most of "
        f"{len(stop_s)}; alarm {alarmed}; {n_lost} of {n_frames} frames lost"
    )


def time_of_return(night, rtc):
    """Return how long an RTC that restarts is kept out by silent connections to the link."""
    with crowded(night, "silent", N_CONNECTIONS, int(night.zenoh.rpartition(":")[2])):
        time.sleep(5.0)
        rtc.kill()
        wait_for(lambda: night.state["rtc"] is None, 10.0)
        began_s = time.monotonic()
        night.rtc(seed=4)
        wait_for(lambda: night.state["rtc"] is not None, 60.0)
        took_s = time.monotonic() - began_s
        return f"silent at the link: the RTC is back {took_s:.1f} s after its start"


def main():
    """Hold a crowd, or measure all kinds three times."""
    if sys.argv[1:2] == ["hold"]:
        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
        asyncio.run(hold(int(sys.argv[2]), sys.argv[3], int(sys.argv[4])))
    with tempfile.TemporaryDirectory() as folder, a_night(Path(folder)) as night:
        night.service("auto")
        rtc = night.rtc()
        night.wait_for_modes(60, 60.0)
        for kind in (*KINDS, *KINDS, *KINDS):
            _report(measure(night, kind))
        _report(time_of_return(night, rtc))


def _report(line):
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
