"""Dialects of RTCs that do not keep to the contract: axes, signs, order and units."""

import numpy as np
import pytest

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
