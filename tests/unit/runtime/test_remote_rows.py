"""Rows of D that a Dask worker computes of instrument and modes, which it gets once."""

import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from service.model.kinds import Stop
from service.runtime.cluster import Cluster
from service.runtime.worker import rows
from service.runtime.worker.rows import RemoteRows
from tests.support.remote_rows import FIRST, model_of
from tests.support.shared_rows import helped_by

SECOND = replace(FIRST, shift_y_subap=-0.1)


def collected(**settings):
    """Return the functions of rows that a linearisation asks for."""
    asked = []

    def noted(function, items):
        if hasattr(function, "elsewhere"):
            asked.append(function)
        return map(function, items)

    model_of(mapper=noted, **settings).linearise(FIRST)
    return asked


@pytest.mark.parametrize("stop", Stop)
def test_rows_made_again_of_few_kilobytes_are_the_same_to_the_bit(stop):
    for function in collected(stop=stop, anamorphosis=True):
        there = function.elsewhere
        sent, parts = RemoteRows.of(there), pickle.loads(pickle.dumps(there.parts))
        assert len(pickle.dumps(sent)) < 3000
        for row in (3, 12):
            np.testing.assert_array_equal(sent(row, *parts), function(row))


MADE = []


def prepare_there(*parts):
    MADE.append(parts)
    return parts


class Rows:
    def __init__(self, model, alpha):
        self.model, self.alpha = model, alpha


def test_what_comes_once_is_the_instrument_and_its_modes_in_single():
    again, modes = collected()[0].elsewhere.parts
    assert len(pickle.dumps(again)) < 20e3  # places of 625 actuators are part of it
    assert len(pickle.dumps(modes)) < 1.02 * 4 * 625**2


def test_of_the_next_matrix_only_its_alpha_is_sent(scheduler, monkeypatch):
    monkeypatch.setattr(rows, "MIN_REMOTE_ROW_S", 0.0)
    monkeypatch.setattr(rows, "MIN_REMOTE_JOB_S", 0.0)
    monkeypatch.setattr(rows, "_compute", lambda *work: None)  # all by the cluster
    with Cluster(scheduler.scheduler_address) as cluster:
        sent, scatter = [], cluster._client.scatter
        monkeypatch.setattr(
            cluster._client,
            "scatter",
            lambda what, **how: sent.append(what) or scatter(what, **how),
        )
        helped = model_of(mapper=helped_by(cluster, 1).map)
        for alpha in (FIRST, SECOND):
            np.testing.assert_array_equal(
                helped.linearise(alpha).rates, model_of().linearise(alpha).rates
            )
    assert len(sent) == 2


def test_a_worker_makes_the_model_once_and_keeps_the_last_rows():
    def described(alpha):
        return pickle.dumps((prepare_there, partial(Rows, alpha=alpha)))

    kept, parts = rows._Kept(), ("instrument", "modes")
    MADE.clear()
    first = kept.rows(described(1), parts)
    assert kept.rows(described(1), parts) is first
    assert (kept.rows(described(2), parts).alpha, len(MADE)) == (2, 1)
    others = ("instrument", "other modes")
    assert (kept.rows(described(2), others).model, len(MADE)) == (others, 2)
