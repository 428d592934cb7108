"""Blocks of telemetry."""

from __future__ import annotations

import numpy as np

from tests.support.numerics import block_of


def test_a_block_has_as_many_frames_as_rows_of_slopes():
    assert block_of(np.zeros((7, 4)), np.zeros((7, 3)), None).n_frames == 7
