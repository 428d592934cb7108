"""What tests of several modules share of unit.runtime.test_shared_rows."""

from __future__ import annotations

from service.runtime.worker.rows import SharedRows


def helped_by(cluster, n_threads=2):
    shared = SharedRows(n_threads)
    shared._cluster = cluster
    return shared
