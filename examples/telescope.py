"""A camera and a mirror for examples/rtc.py: turbulence, and a sensor that is linear."""

import numpy as np


class Telescope:
    """Of a PLANT.npz with ``response`` (n_slopes, n_modes), slope per metre, and ``sigma_m``."""

    def __init__(self, plant):
        self.response, self.sigma_m = plant["response"], plant["sigma_m"]
        self.turbulence, self.rng = np.zeros(len(self.sigma_m)), np.random.default_rng()

    def expose(self, command_m):
        """Return the slopes of one frame, the mirror at ``command_m`` (n_modes,) metres of OPD."""
        kick = self.rng.standard_normal(len(self.sigma_m))
        self.turbulence = 0.998 * self.turbulence + 0.063 * self.sigma_m * kick
        noise = 2e-3 * self.rng.standard_normal(len(self.response))
        return self.response @ (command_m + self.turbulence) + noise
