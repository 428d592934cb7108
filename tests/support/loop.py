"""What tests of several modules share of unit.control.test_loop."""

from __future__ import annotations

import numpy as np


def integrator_limit(eigenvalue_argument_rad):
    """Return the largest stable ``gain |λ|`` for two frames of delay and no leak.

    ``2 sin((π/2 - |arg λ|) / 3)``; negative where no gain is stable.
    """
    return 2.0 * np.sin((np.pi / 2 - np.abs(eigenvalue_argument_rad)) / 3.0)
