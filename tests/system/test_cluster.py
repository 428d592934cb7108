"""Campaigns and a service on a real Dask scheduler; its workers die, and so does it."""

import json
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

from service.errors import ClusterError
from service.runtime.cluster import Cluster
from service.runtime.worker import rows
from tests.support.cable import free_port
from tests.support.dask_cluster import dask_cluster
from tests.support.night import INSTRUMENT, N_TARGET, ROOT, a_night, wait_for
from tests.support.pace import patience
from tests.support.remote_rows import FIRST, model_of
from tests.support.shared_rows import helped_by

pytestmark = [pytest.mark.system, pytest.mark.long]

N_NIGHTS = 3
NIGHTS = (
    f"--instrument={INSTRUMENT}",
    "--n-controlled=45",
    "--seconds=3",
    f"--seeds=0:{N_NIGHTS}",
)


def campaign(rows, *words):
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "pyrcal_studies.campaign.system_nights",
            *NIGHTS,
            f"--output={rows}",
            *words,
        ],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process):
    _, told = process.communicate(timeout=patience(90))
    return process.returncode, told


def rows_of(path):
    """Return rows in order, without what each run has of its own: its session's id."""
    rows = sorted(map(json.loads, path.read_text().splitlines()), key=lambda row: row["seed"])
    for row in rows:
        row["log"] = [line for line in row["log"] if line[2] != "rtc.session"]
    return rows


def n_rows(path):
    return len(path.read_text().splitlines()) if path.exists() else 0


@pytest.fixture(scope="module")
def played_here(tmp_path_factory):
    path = tmp_path_factory.mktemp("here") / "rows.jsonl"
    assert ended(campaign(path))[0] == 0
    return rows_of(path)


def test_a_worker_that_is_killed_changes_nothing_but_time(tmp_path, played_here):
    with dask_cluster(tmp_path) as dask:
        path = tmp_path / "rows.jsonl"
        running = campaign(path, "--cluster", dask.address)
        wait_for(lambda: n_rows(path), 60, "no row of the cluster's")
        dask.workers[0].kill()
        status, told = ended(running)
    assert (status, "played here" in told) == (0, False)
    assert rows_of(path) == played_here


def test_nights_that_a_lost_scheduler_leaves_are_played_here(tmp_path, played_here):
    """It stands still: one that is killed is seen sooner, by its closed connection."""
    with dask_cluster(tmp_path) as dask:
        path = tmp_path / "rows.jsonl"
        running = campaign(path, "--cluster", dask.address)
        wait_for(lambda: n_rows(path), 60, "no row of the cluster's")
        dask.scheduler.send_signal(signal.SIGSTOP)
        status, told = ended(running)
    (line,) = [line for line in told.splitlines() if "played here" in line]
    assert status == 0
    assert line.startswith(f"{dask.address}: the Dask scheduler does not answer any more")
    assert rows_of(path) == played_here


def test_nights_without_any_worker_left_are_played_here_and_rows_are_resumed(tmp_path, played_here):
    path = tmp_path / "rows.jsonl"
    with dask_cluster(tmp_path, n_workers=1) as dask:
        running = campaign(path, "--cluster", dask.address)
        wait_for(lambda: n_rows(path), 60, "no row of the cluster's")
        dask.workers[0].kill()
        status, _ = ended(running)
        assert status == 0
        assert rows_of(path) == played_here
        path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
        refused = ended(campaign(path, "--cluster", dask.address))
    assert refused[0] == 2
    assert "found a scheduler without workers; start some with" in refused[1]
    assert n_rows(path) == N_NIGHTS - 1


def test_a_worker_of_another_pyrcal_is_named(tmp_path):
    other = tmp_path / "other"
    for package in ("service", "sim_rtc", "pyrcal_studies", "pyrcal"):
        shutil.copytree(ROOT / package, other / package, ignore=shutil.ignore_patterns("manual"))
    with (other / "service" / "errors.py").open("a") as file:
        file.write("# of another day\n")
    with dask_cluster(tmp_path, n_workers=1) as dask:
        dask.add_worker(other)
        with pytest.raises(ClusterError, match=r"found pyrcal .*\(code \w+\), expected pyrcal"):
            Cluster(dask.address)


def without_pyrcal(folder):
    """Make a folder in which a worker finds no pyrcal; return it."""
    (folder / "without" / "service").mkdir(parents=True)
    nothing = "raise ModuleNotFoundError(\"No module named 'service'\", name='service')\n"
    (folder / "without" / "service" / "__init__.py").write_text(nothing)
    return folder / "without"


NO_PYRCAL = r"found no pyrcal that reports its version \(ModuleNotFoundError"


def test_a_worker_without_pyrcal_is_named_whenever_it_comes(tmp_path):
    without = without_pyrcal(tmp_path)
    with dask_cluster(tmp_path, n_workers=1) as dask:
        with Cluster(dask.address) as cluster:
            dask.add_worker(without)
            with pytest.raises(ClusterError, match=NO_PYRCAL) as late:
                list(cluster.each(abs, [-1, -2]))
        with pytest.raises(ClusterError, match=NO_PYRCAL) as first:
            Cluster(dask.address)
    assert not any("\n" in str(one.value) for one in (late, first))


def test_rows_of_a_worker_that_is_killed_are_computed_by_the_other(tmp_path, monkeypatch):
    monkeypatch.setattr(rows, "MIN_REMOTE_ROW_S", 0.0)
    monkeypatch.setattr(rows, "MIN_REMOTE_JOB_S", 0.0)
    monkeypatch.setattr(rows, "_compute", lambda *work: None)  # all but the first by the cluster
    here = model_of().linearise(FIRST)
    with dask_cluster(tmp_path) as dask, Cluster(dask.address) as cluster:
        each = cluster.each

        def struck(*args, **how):
            for number, answer in enumerate(each(*args, **how)):
                if number == 2:
                    dask.workers[0].kill()
                yield answer

        monkeypatch.setattr(cluster, "each", struck)
        there = model_of(mapper=helped_by(cluster, 1).map).linearise(FIRST)
    np.testing.assert_array_equal(there.matrix, here.matrix)
    np.testing.assert_array_equal(there.rates, here.rates)


def test_a_service_names_a_cluster_that_is_gone_and_works_on(tmp_path):
    def alarm():
        return night.alarms.get("cluster-lost")

    port = free_port()
    with a_night(tmp_path) as night:
        address = f"tcp://127.0.0.1:{port}"
        with night.settings.open("a") as file:
            file.write(f'[compute]\ncluster = "{address}"\n')
        night.service()
        night.rtc()
        wait_for(alarm, 40.0, "an alarm of the cluster that is not there")
        assert alarm().startswith(f"{address}: found no Dask scheduler there")
        night.wait_for_modes(N_TARGET)
        with dask_cluster(tmp_path, n_workers=1, port=port) as dask:
            assert dask.address == address
            wait_for(lambda: alarm() is None, 60.0, alarm)
        wait_for(alarm, 60.0, "an alarm of the cluster that is gone")
        assert "start it and its workers again" in alarm()
        assert "worker-lost" not in night.alarms
