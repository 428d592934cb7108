"""The optics: pupil, mirror, modes, pyramid, registration, D(α). Pure numerics."""
