"""A telescope whose pupil images are off the pixel grid, of which the service knows nothing."""

import numpy as np

from pyrcal_studies.campaign.image_nights import ImageNight, play, table


def test_sigma_that_is_shown_covers_what_displaced_images_do_to_a_shift():
    """Seed 1 is an unlucky draw: a shift is 0.033 subaperture off."""
    row = play(ImageNight(seed=1, rms_px=0.1, seconds=15.0))
    assert abs(row["error"][0]) > 0.02
    assert row["largest"][0] > 2.0
    assert max(row["shown_largest"]) < 1.5
    assert row["levels"] == ["fresh"]
    assert not row["alarms"]
    assert row["modes"] == 60
    assert np.all(np.array(row["shown_sigma"]) > row["sigma"])
    assert table([row]).count("\n") == 3
