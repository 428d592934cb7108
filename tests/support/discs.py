"""A picture of the four pupil images of a pyramid, with edges of a pixel's share."""

import numpy as np

FINE = 10
"""Points along the side of a pixel."""


def four_discs(n_px, centres, diameter_px, hole_px=0.0):
    """Return the light ``(n_px, n_px)`` of four discs, 1 inside."""
    places = (np.arange(n_px * FINE) + 0.5) / FINE - 0.5
    light = np.zeros((n_px * FINE, n_px * FINE))
    for row, column in centres:
        away = np.hypot(places[:, None] - row, places - column)
        light += (away < diameter_px / 2) & (away >= hole_px / 2)
    return light.reshape(n_px, FINE, n_px, FINE).mean(axis=(1, 3))
