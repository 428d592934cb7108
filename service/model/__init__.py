"""The optics: pupil, mirror, modes, pyramid, registration, interaction matrix. Pure numerics."""
