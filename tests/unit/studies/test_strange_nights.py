"""RTCs that do not keep to the contract, in simulated time."""

import numpy as np
import pytest

from pyrcal_studies.campaign.observatory_dome import Moment
from pyrcal_studies.campaign.strange_nights import _plan, beyond, deeds_of
from pyrcal_studies.campaign.strange_rtc import DIALECTS, Mischief, dialect_of
from service.estimation.frames import FrameBlock

MASK = np.array([[0, 1, 1, 0], [1, 1, 1, 1], [1, 1, 1, 1], [0, 1, 1, 0]], dtype=bool)
N_SLOPES = 2 * int(MASK.sum())


def block(slopes, commands_m):
    return FrameBlock(
        session="s",
        first_seq=0,
        t0_ns_utc=0,
        dt_ns=1,
        slopes=slopes,
        commands_m=commands_m,
        dither_m=None,
        cm_id="cm",
    )


@pytest.mark.parametrize("mischief", sorted(DIALECTS))
def test_a_matrix_is_meant_as_it_was_told(mischief):
    matrix = np.random.default_rng(1).standard_normal((3, N_SLOPES)).astype(np.float32)
    dialect = dialect_of(mischief, MASK)
    np.testing.assert_allclose(dialect.meant(dialect.told(matrix)), matrix, rtol=1e-6)
    assert not np.allclose(dialect.told(matrix), matrix)


@pytest.mark.parametrize("mischief", sorted(DIALECTS))
def test_in_any_dialect_the_matrix_told_times_the_slopes_told_is_the_command_told(mischief):
    rng = np.random.default_rng(2)
    matrix = rng.standard_normal((3, N_SLOPES)).astype(np.float32)
    slopes = rng.standard_normal((5, N_SLOPES)).astype(np.float32)
    dialect = dialect_of(mischief, MASK)
    told = dialect.spoken(block(slopes, slopes @ matrix.T))
    np.testing.assert_allclose(
        told.slopes @ dialect.told(matrix).T, told.commands_m, rtol=1e-4, atol=1e-4 * dialect.unit
    )


def test_a_flip_mirrors_the_grid_and_negates_the_slopes_along_it():
    number = np.full(MASK.shape, -1)
    number[MASK] = np.arange(N_SLOPES // 2)
    dialect = dialect_of(Mischief.FLIP_X, MASK)
    slopes = np.arange(N_SLOPES, dtype=np.float32)[None]
    told = dialect.spoken(block(slopes, np.zeros((1, 3), dtype=np.float32))).slopes[0]
    assert told[0] == -number[0, 2]
    assert told[N_SLOPES // 2] == N_SLOPES // 2 + number[0, 2]


def moment(time_s, wavefront_nm, closed=True):
    return Moment(
        time_s=time_s,
        alpha=None,
        wavefront_nm=wavefront_nm,
        n_clipped=0,
        cm_id="cm",
        n_controlled=1,
        closed=closed,
        dither_nm=0.0,
    )


def test_only_a_closed_loop_that_stays_beyond_the_limit_is_lost():
    short = [moment(k / 10, 2000.0 if 5 < k < 10 else 100.0) for k in range(30)]
    assert beyond(short) == []
    still = [moment(k / 10, 2000.0 if k > 5 else 100.0) for k in range(30)]
    assert beyond(still) == [(0.6, 2.9)]
    assert beyond([moment(k / 10, 2000.0, closed=False) for k in range(30)]) == []


def test_a_night_is_the_same_every_time_and_everything_happens_in_it():
    words, latencies, deeds = _plan(7, "small.toml", 40.0)
    again = _plan(7, "small.toml", 40.0)
    assert (words, latencies) == again[:2]
    assert [(d.time_s, d.name) for d in deeds] == [(d.time_s, d.name) for d in again[2]]
    names = {d.name for k in range(200) for d in deeds_of(np.random.default_rng(k), 40.0)}
    assert set(Mischief) - DIALECTS <= names
    assert {f"speaks {dialect}" for dialect in DIALECTS} <= names
