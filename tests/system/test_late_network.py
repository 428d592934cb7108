"""A service that starts before its network, as after a power cut."""

import signal
import time

import pytest

from tests.support.night import a_night, wait_for
from tests.system.late_network import (
    late_rest_port,
    late_router,
    start_service,
    taken,
    tracks,
    waited_for,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(150)]


def test_it_waits_for_its_router_says_so_and_tracks_once_it_is_there(tmp_path):
    with a_night(tmp_path) as night, late_router(night) as (options, appear):
        night.rtc()
        service = start_service(night, **options)

        def wait():
            return (waited_for(night, service) or {}).get("link", {"text": ""})

        wait_for(lambda: night.zenoh in wait()["text"], 40.0, lambda: service.log)
        assert (wait()["responsible"], wait()["blocks"]) == ("network", True)
        assert night.client.get("/healthz").is_success
        appear()
        wait_for(lambda: tracks(night), 40.0, lambda: night.state)
        assert "link" not in waited_for(night, service)


def test_it_waits_for_the_ports_of_link_and_rest(tmp_path):
    """A second program on a taken port waits, too: it says which port, and what to do."""
    with a_night(tmp_path) as night, late_rest_port(night) as (options, free_rest):
        port = int(night.zenoh.rpartition(":")[2])
        with taken(port) as free_link:
            night.rtc()
            service = start_service(night, **options)
            wait_for(lambda: "already in use" in service.log, 40.0, lambda: service.log)
            wait_for(lambda: "api.waiting" in service.log, 40.0, lambda: service.log)
            assert f"cannot listen on 127.0.0.1:{night.port}" in service.log
            free_rest()
            waits = wait_for(lambda: waited_for(night, service), 20.0, lambda: service.log)
            assert "already in use" in waits["link"]["text"]
            free_link()
        wait_for(lambda: tracks(night), 40.0, lambda: night.state)


def test_it_can_be_ended_while_it_waits(tmp_path):
    with a_night(tmp_path) as night, late_rest_port(night):
        service = start_service(night, connect=night.zenoh)
        wait_for(lambda: "api.waiting" in service.log, 40.0, lambda: service.log)
        began_s = time.monotonic()
        service.send(signal.SIGTERM)
        assert service.ended(5.0) == 0, (time.monotonic() - began_s, service.log)
        assert "Traceback" not in service.log
        service.alone()
