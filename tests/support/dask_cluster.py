"""A Dask scheduler and its workers as processes of their own, on loopback."""

import contextlib
import json
import os
import signal
import subprocess
import sys

from tests.support.night import ROOT, wait_for


class DaskCluster:
    """What an observatory starts with ``dask scheduler`` and ``dask worker``."""

    def __init__(self, folder, port=0):
        self.folder = folder
        told = folder / "told.json"
        told.unlink(missing_ok=True)
        words = ("--port", str(port), "--scheduler-file", told.name)
        self.scheduler = self._started("scheduler", *words)
        wait_for(lambda: told.exists() and told.read_text(), what="no scheduler")
        self.address = json.loads(told.read_text())["address"]
        self.workers = []

    def add_worker(self, root=ROOT):
        """Start a worker whose pyrcal is that of a folder; the scheduler knows it then."""
        self.workers.append(
            self._started("worker", self.address, "--nthreads", "1", "--no-nanny", root=root)
        )
        log = self.folder / "worker.log"  # of all of them, of those before as well
        wait_for(
            lambda: log.read_text().count("Registered to:") >= len(self.workers),
            60,
            lambda: log.read_text()[-2000:],
        )

    def close(self):
        for process in (*self.workers, self.scheduler):
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()

    def _started(self, what, *words, root=ROOT):
        command = (sys.executable, "-m", "dask", what, *words)
        with (self.folder / f"{what}.log").open("a") as log:
            return subprocess.Popen(
                [*command, "--host", "127.0.0.1", "--no-dashboard"],
                cwd=self.folder,
                stdout=log,
                stderr=log,
                env=os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"},
            )


@contextlib.contextmanager
def dask_cluster(folder, n_workers=2, port=0):
    """Give a cluster for as long as the block lasts."""
    cluster = DaskCluster(folder, port)
    try:
        for _ in range(n_workers):
            cluster.add_worker()
        yield cluster
    finally:
        cluster.close()
