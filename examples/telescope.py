"""Simulated telescope for the RTC examples: turbulence, mirror, and a linear wavefront sensor."""

import numpy as np


class Telescope:
    """Linear telescope from the arrays of a PLANT.npz file.

    ``response`` (n_slopes, n_modes) is the interaction matrix, slope per metre OPD; ``sigma_m``
    (n_modes,) is the RMS of the turbulence in each mode.
    """

    def __init__(self, plant):
        self.response, self.sigma_m = plant["response"], plant["sigma_m"]
        self.turbulence, self.rng = np.zeros(len(self.sigma_m)), np.random.default_rng()

    def expose(self, command_m):
        """Return the slopes of one frame, the mirror at ``command_m`` (n_modes,) metres of OPD."""
        # a first-order process of constant variance: 0.998**2 + 0.063**2 = 1
        kick = self.rng.standard_normal(len(self.sigma_m))
        self.turbulence = 0.998 * self.turbulence + 0.063 * self.sigma_m * kick
        noise = 2e-3 * self.rng.standard_normal(len(self.response))
        return self.response @ (command_m + self.turbulence) + noise
