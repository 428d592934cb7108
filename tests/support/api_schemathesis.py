"""What tests of several modules share of unit.test_api_schemathesis."""

from __future__ import annotations

import contextlib
from types import SimpleNamespace

from service.api import create_app
from service.archive import Archive
from service.errors import WorkerError
from service.files.fit_folder import FitRequest
from service.runtime.actions import Actions, Publishing
from service.runtime.supervisor import Supervisor
from service.runtime.uploads import FitLimits, FitQueue
from service.web.authentication import Hosts
from tests.support.api import LINK
from tests.support.handmade import STATE, Clock, HandmadeBridge
from tests.support.situations import POLICY
from tests.support.small import small_instrument


class Bridge(HandmadeBridge):
    def statistics(self):
        return LINK


class NoWorkers(SimpleNamespace):
    problem, busy_s, cpu_s = "", 0.0, {}

    async def call(self, *_):
        raise WorkerError("nobody is there")


@contextlib.contextmanager
def application(folder, keys):
    """Give the application, its archive in a folder."""
    bridge, workers, archive = Bridge(), NoWorkers(), Archive(folder)
    archive.open()
    with archive:
        actions = Actions(
            bridge=bridge,
            workers=workers,
            archive=archive,
            instrument=small_instrument(),
            publishing=Publishing(system="small", chunk_bytes=4096, pole_radius_bound=0.95),
            clock_ns=Clock(),
        )
        supervisor = Supervisor(
            state=STATE,
            policy=POLICY,
            bridge=bridge,
            workers=workers,
            archive=archive,
            actions=actions,
        )
        limits = FitLimits(max_bytes=10_000, waiting=10_000, seconds=1)
        request = FitRequest(
            asked={},
            own_instrument="small",
            own_sha256="",
            max_bytes=10_000,
            threads=1,
            nice=0,
            memory_mb=500,
        )
        desk = FitQueue(
            folder=folder, program=("false",), request=request, limits=limits, clock_ns=Clock()
        )
        hosts = Hosts(allowed=("testserver",))
        yield create_app(supervisor, desk, hosts=hosts, keys=keys)
