"""A worker, an archive and an RTC written by hand, for what the service does between them."""

import pytest

from service.runtime.actions import Actions, Publishing
from service.runtime.worker import start_worker
from service.runtime.workers import WorkerPool
from tests.support.handmade import Clock, HandmadeBridge
from tests.support.small import COMPUTE, small_instrument


@pytest.fixture(scope="session")
def workers():
    workers = WorkerPool(lambda: start_worker(small_instrument(), COMPUTE))
    yield workers
    workers.close()


@pytest.fixture
def bridge():
    return HandmadeBridge()


@pytest.fixture
def actions(bridge, workers, archive):
    return Actions(
        bridge=bridge,
        workers=workers,
        archive=archive,
        instrument=small_instrument(),
        publishing=Publishing(system="small", chunk_bytes=4096, pole_radius_bound=0.95),
        clock_ns=Clock(),
    )


@pytest.fixture(scope="module")
def scheduler():
    distributed = pytest.importorskip("distributed")  # of the extra that setup installs
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=2,
        processes=False,
        protocol="tcp://",
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    ) as found:
        yield found
