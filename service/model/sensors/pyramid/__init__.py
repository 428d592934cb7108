"""The modulated pyramid: all that only a sensor of four pupil images has."""
