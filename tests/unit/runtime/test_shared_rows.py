"""Rows that the worker's threads and a Dask cluster compute together."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from service.errors import ClusterError
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.sensors.sensor import RowTask
from service.runtime.cluster import Cluster
from service.runtime.worker import rows as module
from service.runtime.worker.rows import SharedRows
from tests.support.shared_rows import helped_by

SMALL = Path(__file__).parents[2] / "system" / "small.toml"
ALPHA = Misregistration(shift_x_subap=0.2, rotation_rad=0.01, magnification=1.003)


class Pretended:
    """A cluster that answers rows as it is told to."""

    address = "tcp://there:8786"

    def __init__(self, answers=None, error=None):
        self.answers, self.error = answers, error
        self.asked, self.closed = [], False

    def each(self, function, items, *, is_large, enough):
        self.asked += items
        for number, item in enumerate(items):
            if self.answers is None or number < self.answers:
                yield number, function(item)
        if self.error:
            raise self.error
        enough.wait(5.0)

    def check(self):
        pass

    def close(self):
        self.closed = True


class Slow(RowTask):
    """Rows that take their time, and note who computed them."""

    def __init__(self, seconds=0.02):
        self.seconds, self.done, self.lock = seconds, [], threading.Lock()

    def __call__(self, row):
        time.sleep(self.seconds)
        with self.lock:
            self.done.append(row)
        return 10 * row


@pytest.fixture(autouse=True)
def everything_pays(monkeypatch):
    monkeypatch.setattr(module, "MIN_REMOTE_ROW_S", 0.0)
    monkeypatch.setattr(module, "MIN_REMOTE_JOB_S", 0.0)


def test_rows_come_in_their_order_whoever_has_computed_them():
    cluster = Pretended()
    assert list(helped_by(cluster).map(Slow(), range(20))) == [10 * row for row in range(20)]
    assert cluster.asked == list(range(19, 0, -1))


@pytest.mark.parametrize("answers", [0, 3])
def test_a_cluster_that_answers_no_more_is_not_waited_for(answers):
    began_s = time.monotonic()
    rows = list(helped_by(Pretended(answers)).map(Slow(), range(20)))
    assert rows == [10 * row for row in range(20)]
    assert time.monotonic() - began_s < 4.0


def test_a_cluster_that_is_lost_is_named_and_left():
    cluster = Pretended(2, ClusterError("tcp://there:8786: it is gone"))
    shared = helped_by(cluster)
    assert list(shared.map(Slow(), range(20))) == [10 * row for row in range(20)]
    assert shared.problem == "tcp://there:8786: it is gone"
    assert cluster.closed
    assert list(shared.map(Slow(), range(3))) == [0, 10, 20]


def test_what_a_row_raises_is_raised_here():
    class Refusing(RowTask):
        def __call__(self, row):
            if row == 3:
                raise ValueError("row 3")
            return row

    with pytest.raises(ValueError, match="row 3"):
        list(helped_by(Pretended(0)).map(Refusing(), range(5)))


def test_small_work_stays_here(monkeypatch):
    cluster = Pretended()
    monkeypatch.setattr(module, "MIN_REMOTE_JOB_S", 10.0)
    assert list(helped_by(cluster).map(Slow(), range(4))) == [0, 10, 20, 30]
    assert list(helped_by(cluster).map(Slow(), range(1))) == [0]
    monkeypatch.setattr(module, "MIN_REMOTE_JOB_S", 0.0)
    assert list(helped_by(cluster).map(lambda row: row, range(4))) == [0, 1, 2, 3]
    assert cluster.asked == []


def test_d_and_its_derivatives_are_the_same_to_the_bit_with_a_cluster(scheduler, monkeypatch):
    compute = module._compute  # here, but not before the cluster has answered
    instrument = load_instrument(SMALL)
    basis = modal_basis(instrument)
    alone = InteractionModel(instrument, basis, kept_bytes=0).linearise(ALPHA)
    with Cluster(scheduler.scheduler_address) as cluster:
        shared, answered = helped_by(cluster, 1), _answered(cluster)
        monkeypatch.setattr(
            module, "_compute", lambda *work: answered.wait(30.0) and compute(*work)
        )
        together = InteractionModel(instrument, basis, kept_bytes=0, mapper=shared.map).linearise(
            ALPHA
        )
        for thread in threading.enumerate():
            if thread.name == module.RECEIVER_THREAD:
                thread.join()
    np.testing.assert_array_equal(together.matrix, alone.matrix)
    np.testing.assert_array_equal(together.derivatives, alone.derivatives)
    assert answered.is_set()


def _answered(cluster):
    """Return an event of the first row that the cluster answers."""
    each, answered = cluster.each, threading.Event()

    def noted(*args, **kwargs):
        for found in each(*args, **kwargs):
            answered.set()
            yield found

    cluster.each = noted
    return answered


def test_a_cluster_that_is_not_there_is_named_and_taken_up_when_it_comes(monkeypatch):
    monkeypatch.setattr(module, "CLUSTER_SEARCH_INTERVAL_S", 0.05)
    found = []

    def connected(address):
        found.append(address)
        if len(found) < 3:
            raise ClusterError(f"{address}: found no Dask scheduler there")
        return Ending()

    class Ending(Pretended):
        def check(self):
            threading.Event().wait()  # the thread that looks has done its part

    monkeypatch.setattr(module, "Cluster", connected)
    shared = SharedRows(1, "tcp://there:8786")
    told = set()
    deadline_s = time.monotonic() + 10.0
    while shared._cluster is None and time.monotonic() < deadline_s:
        told.add(shared.problem)
        time.sleep(0.01)
    assert "tcp://there:8786: found no Dask scheduler there" in told
    assert shared.problem == ""
