"""RTCs that do not keep to the contract: axes, signs and units."""

from dataclasses import replace

import numpy as np
import pytest

from pyrcal_studies.campaign.golden_nights import (
    DIALECTS,
    GoldenNight,
    Mischief,
    Plan,
    dialect_of,
)
from pyrcal_studies.campaign.observatory import SMALL
from service.estimation.frames import FrameBlock
from service.instrument import load_instrument
from service.model.slopes import Orientation
from service.runtime.worker import Compute, OpticsWorker

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
    np.testing.assert_allclose(dialect.meant(dialect.shown(matrix)), matrix, rtol=1e-6)
    assert not np.allclose(dialect.shown(matrix), matrix)


@pytest.mark.parametrize("mischief", sorted(DIALECTS))
def test_in_any_dialect_the_matrix_told_times_the_slopes_told_is_the_command_told(mischief):
    rng = np.random.default_rng(2)
    matrix = rng.standard_normal((3, N_SLOPES)).astype(np.float32)
    slopes = rng.standard_normal((5, N_SLOPES)).astype(np.float32)
    dialect = dialect_of(mischief, MASK)
    told = dialect.spoken(block(slopes, slopes @ matrix.T))
    np.testing.assert_allclose(
        told.slopes @ dialect.shown(matrix).T, told.commands_m, rtol=1e-4, atol=1e-4 * dialect.unit
    )


def test_a_flip_mirrors_the_grid_and_negates_the_slopes_along_it():
    number = np.full(MASK.shape, -1)
    number[MASK] = np.arange(N_SLOPES // 2)
    dialect = dialect_of(Mischief.FLIP_X, MASK)
    slopes = np.arange(N_SLOPES, dtype=np.float32)[None]
    told = dialect.spoken(block(slopes, np.zeros((1, 3), dtype=np.float32))).slopes[0]
    assert told[0] == -number[0, 2]
    assert told[N_SLOPES // 2] == N_SLOPES // 2 + number[0, 2]


def test_an_rtc_with_the_other_signs_is_named_within_2_s_and_gets_no_matrix():
    instrument = load_instrument(SMALL)
    stated = replace(instrument.slopes, orientation=Orientation())
    bench = OpticsWorker(replace(instrument, slopes=stated), Compute(threads=1))
    night = GoldenNight(Plan(name="sign", seconds=3.0), bench)
    night.dome.speak(Mischief.SIGN)
    night.restart_rtc()
    night.advance(2.0)
    (alarm,) = [a for a in night.state.alarms.active if a.name == "matrix-mismatch"]
    assert "sign = -1" in alarm.text
    night.advance(4.0)
    assert night.swaps == []
