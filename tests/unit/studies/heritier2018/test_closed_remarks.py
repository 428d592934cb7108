from __future__ import annotations

import numpy as np

from pyrcal_studies.heritier2018.closed_remarks import noise_remark, shaken_remark, spread_nm


def test_within_our_own_spread_nothing_needs_a_reason() -> None:
    ours = np.array([120.0, 126.0, 132.0])
    assert spread_nm(ours) == 6.0
    assert "agrees" in shaken_remark(ours, np.array([190.0, 195.0, 200.0]))


def test_a_dome_that_shakes_less_says_how_much_more_the_paper_needs() -> None:
    still, shaken = np.full(3, 100.0), np.full(3, 125.0)
    text = shaken_remark(still, shaken)
    assert "adds 75 nm" in text
    assert f"{np.sqrt(195**2 - 100**2):.0f} nm would be needed" in text


def test_noise_is_named_as_the_reason_only_where_more_of_it_gains_more() -> None:
    well = np.array([0.2, 0.5])
    assert "grows with it" in noise_remark(well, np.array([4.0, 9.0]))
    assert "not what separates" in noise_remark(well, np.array([0.3, 0.6]))
