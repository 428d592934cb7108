"""A service that starts before its network: how soon it tracks once the network is there.

``unshare --map-root-user --net --mount python -m tests.system.late_network`` gives it a network of
its own, to which a name and an address can be added; the test suite does without.
"""

import itertools
import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import httpx
import zenoh

from tests.support.cable import free_port
from tests.support.night import INSTRUMENT, Night, a_night, wait_for

ABSENT_S = 7.0
"""Time for which the network is not there."""

ADDRESS, NAME = "10.9.8.7", "ao-router.test"
HOSTS = "/etc/hosts"


def start_service(night, **options):
    """Start a service, of which nothing can be expected yet."""
    given = {"listen": night.zenoh, "port": night.port, "config": night.settings, "mode": "auto"}
    if "connect" in options:
        del given["listen"]
    given |= {"instrument": INSTRUMENT, "data-dir": night.directory / "data"} | options
    words = [str(word) for name, value in given.items() for word in (f"--{name}", value)]
    return night.start("service", ["service", "run", *words])


def start_router(night, endpoint):
    """Start a router of an observatory as a process of its own; return once it listens."""
    night.start("router", ["tests.system.late_network", "router", endpoint])
    port = int(endpoint.rpartition(":")[2])

    def listens():
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return True
        return False

    wait_for(listens, 30.0, f"a router at {endpoint}")


def waited_for(night, process):
    """Return what the service waits for, by name; None while REST does not answer."""
    assert process.popen.poll() is None, process.log
    with suppress(httpx.TransportError):
        return {wait["name"]: wait for wait in night.state["waiting_for"]}
    return None


def tracks(night):
    """Return whether telemetry has become a registration."""
    with suppress(httpx.TransportError):
        known = night.state["registration"]
        return known is not None and known["n_windows"] > 0
    return False


# ---------------------------------------------------------------- what is not there yet


@contextmanager
def late_router(night):
    """Yield the options of a service, and what starts its router."""
    yield {"connect": night.zenoh}, lambda: start_router(night, night.zenoh)


@contextmanager
def late_name(night):
    start_router(night, night.zenoh)
    port = night.zenoh.rpartition(":")[2]
    hosts = night.directory / "hosts"
    hosts.write_text(f"127.0.0.1 localhost {NAME}\n", encoding="utf-8")
    yield {"connect": f"tcp/{NAME}:{port}"}, lambda: _call("mount", "--bind", hosts, HOSTS)
    _call("umount", HOSTS)


@contextmanager
def late_address(night):
    night.zenoh = f"tcp/{ADDRESS}:{free_port()}"
    with night.settings.open("a", encoding="utf-8") as settings:
        settings.write("[zenoh]\nanyone_may_command_the_mirror = true\n")
    yield {}, lambda: _call("ip", "address", "add", f"{ADDRESS}/32", "dev", "lo")
    _call("ip", "address", "delete", f"{ADDRESS}/32", "dev", "lo")


@contextmanager
def late_port(night):
    port = int(night.zenoh.rpartition(":")[2])
    with taken(port) as free:
        yield {}, free


@contextmanager
def late_rest_port(night):
    with taken(night.port) as free:
        yield {}, free


@contextmanager
def taken(port):
    """Hold a port; yield what frees it."""
    holder = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import socket, time\n"
            f"held = socket.create_server(('127.0.0.1', {port}))\n"
            "print('held', flush=True)\n"
            "time.sleep(600)",
        ],
        stdout=subprocess.PIPE,
    )
    holder.stdout.readline()

    def free():
        holder.kill()
        holder.wait()

    try:
        yield free
    finally:
        free()
        holder.stdout.close()


def _call(*words):
    subprocess.run([str(word) for word in words], check=True)


# ---------------------------------------------------------------- times


def time_after(kind, directory):
    """Return the seconds from the moment at which the network is there to the first α."""
    with ExitStack() as stack:
        night = stack.enter_context(a_night(directory))
        options, appear = stack.enter_context(kind(night))
        night.rtc()
        service = start_service(night, **options)
        if kind is late_rest_port:
            wait_for(lambda: "api.waiting" in service.log, 30.0, lambda: service.log)
        else:
            waits = wait_for(lambda: waited_for(night, service), 30.0, lambda: service.log)
            assert waits["link"]["responsible"] == "network", waits
        time.sleep(ABSENT_S)
        appear()
        return _time_to_track(night)


def time_of_order(order, directory):
    """Return the seconds from the start of the last of three programs to the first α."""
    with a_night(directory) as night:
        starts = {
            "rtc": night.rtc,
            "router": lambda: start_router(night, night.zenoh),
            "service": lambda: start_service(night, connect=night.zenoh),
        }
        for place, name in enumerate(order):
            time.sleep(3.0 if place else 0.0)
            starts[name]()
        return _time_to_track(night)


def _time_to_track(night: Night):
    began_s = time.monotonic()
    wait_for(lambda: tracks(night), 60.0, lambda: night.state, every_s=0.05)
    return round(time.monotonic() - began_s, 2)


def _report(*what):
    sys.stdout.write(f"{' '.join(map(str, what))} s\n")
    sys.stdout.flush()


def main():
    """Print the time of each kind, twice, and of each order of three programs."""
    if sys.argv[1:2] == ["router"]:
        config = zenoh.Config()
        config.insert_json5("mode", json.dumps("router"))
        config.insert_json5("listen/endpoints", json.dumps(sys.argv[2:]))
        config.insert_json5("scouting/multicast/enabled", "false")
        with zenoh.open(config):
            threading.Event().wait()
    _call("ip", "link", "set", "lo", "up")
    kinds = (late_router, late_name, late_address, late_port, late_rest_port)
    for kind in (*kinds, *kinds):
        with tempfile.TemporaryDirectory() as folder:
            _report(kind.__name__, time_after(kind, Path(folder)))
    for order in itertools.permutations(("rtc", "router", "service")):
        with tempfile.TemporaryDirectory() as folder:
            _report(*order, time_of_order(order, Path(folder)))


if __name__ == "__main__":
    main()
