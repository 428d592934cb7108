"""What tests of several modules share of unit.test_config."""

from __future__ import annotations

ABOUT = '[instrument]\nname = "bench"\ndiameter_m = 8.0\nstop = "telescope"\n'


MIRROR = '[mirror]\nlayout = "grid"\nn_across = 11\npitch_m = 0.8\ndiameter_m = 8.8\n'


MODES = "[modes]\nn_modes = 50\n"
