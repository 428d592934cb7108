"""Tasks on a Dask cluster; tests/system/test_cluster.py kills real processes."""

import os
import subprocess
import sys

import pytest

from pyrcal_studies.campaign.rows import played
from service.errors import ClusterError, ModelError
from service.runtime import cluster as module
from service.runtime.cluster import Cluster, own_versions

pytest.importorskip("distributed")  # of the extra that setup installs


def halved(number):
    if number % 2:
        raise ModelError(f"found {number}, expected an even number")
    return number // 2


def test_each_item_comes_back_with_its_number(scheduler):
    with Cluster(scheduler.scheduler_address) as cluster:
        assert cluster.n_threads == 2
        assert dict(cluster.each(halved, [4, 8, 2])) == {0: 2, 1: 4, 2: 1}


def test_what_a_task_raises_is_raised_here(scheduler):
    with (
        Cluster(scheduler.scheduler_address) as cluster,
        pytest.raises(ModelError, match="found 3"),
    ):
        dict(cluster.each(halved, [4, 3]))


def test_a_campaign_s_plans_are_tasks_of_the_cluster(scheduler):
    address = scheduler.scheduler_address
    assert sorted(played(halved, [4, 8, 2], 1, address)) == [1, 2, 4]
    assert list(played(halved, [], 1, "tcp://127.0.0.1:1")) == []


def test_what_a_cluster_that_is_lost_leaves_is_played_here(scheduler, monkeypatch, capsys):
    def lost(_self, function, items):
        yield 1, function(items[1])
        raise ClusterError("tcp://there:8786: the Dask scheduler does not answer any more")

    monkeypatch.setattr(Cluster, "each", lost)
    assert list(played(halved, [4, 8, 2], 1, scheduler.scheduler_address)) == [4, 2, 1]
    told = capsys.readouterr().err
    assert "does not answer any more; the other 2 are played here, --workers 1" in told


def test_a_scheduler_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setattr(module, "CONNECT_TIMEOUT_S", 0.3)
    with pytest.raises(ClusterError, match=r"^tcp://127.0.0.1:1: found no Dask scheduler there"):
        Cluster("tcp://127.0.0.1:1")
    with pytest.raises(ClusterError, match=r"^here: found no Dask scheduler there"):
        Cluster("here")


def test_a_worker_that_comes_later_with_another_version_does_nothing():
    expected = {**own_versions(), "numpy": "1.0"}
    with pytest.raises(ClusterError, match=rf"found numpy {own_versions()['numpy']}, expected "):
        module._perform(4, halved, expected)


def test_without_the_extra_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ClusterError, match=r"install it: pip install 'pyrcal\[cluster\]'"):
        Cluster("tcp://127.0.0.1:1")


def test_nobody_imports_dask_who_has_not_asked_for_it():
    code = (
        "import sys, service.runtime.cluster, service.runtime.worker, service.cli.serve; "
        "import pyrcal_studies.campaign.rows; sys.exit('dask' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], env=os.environ).returncode == 0
