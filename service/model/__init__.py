"""The optics: pupil, mirror, modes, sensors, registration, D(α). Pure numerics."""
