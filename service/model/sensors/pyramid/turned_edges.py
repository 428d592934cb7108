"""Pyramid faces that are tilted apart: the edges at which they meet are turned.

Two faces that displace their pupil images by ``d`` against each other meet where both phases are
equal: at a line that is turned by ``d`` over the distance of the images. The light between this
line and the axis goes to the other image. The separable formulas leave that out, so that it is
computed here in the focal plane, once with turned edges and once without.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.sensors.pyramid.optics import PyramidOptics
from service.model.sensors.pyramid.signals import PyramidSensor, differentiate_signals

Array = NDArray[Any]
Places = NDArray[np.float64]
"""``(2, 2, 2)`` [side y, side x, (x, y)]."""

_SIDES = np.array([[[-1, -1], [1, -1]], [[-1, 1], [1, 1]]])
"""Side of each image, as ``Places``."""


def turn_edges(
    sensor: PyramidSensor, shapes: Array, windows: Places, off: Places, *, exchanged: bool
) -> Array:
    """Return what turned edges add to the signals ``(n_signals, n_shapes)`` per metre.

    Parameters
    ----------
    sensor
        The pyramid, with the images where the model has them.
    shapes
        ``(n_points, n_shapes)`` wavefronts at the lit points of the pupil, metres.
    windows, off
        Displacement of the windows that cut the images from a square, and of the images from their
        windows, subapertures, as they are on the detector.
    exchanged
        True if opposite images have exchanged roles in the model, as with wavefronts of the other
        sign. The edges do not turn with them.
    """
    optics, f = sensor.optics, sensor.optics.focal_frequencies
    centres, plane = _SIDES * optics.wfs.image_separation_subap / 2, np.stack(np.meshgrid(f, f))

    def find_phase(places: Places) -> Array:
        """Return the phase of the faces that are highest in the middle, waves."""
        return np.asarray(np.tensordot(places, plane, axes=1).min(axis=(0, 1)))

    turned = np.broadcast_to(find_phase(centres + windows + off), (2, 2, len(f), len(f)))
    modelled = off[::-1, ::-1] if exchanged else off
    apart = find_phase(centres) + np.tensordot(modelled, plane, axes=1)
    signals = []
    for phase, seen, back in ((turned, centres + windows, exchanged), (apart, centres, False)):
        masks = np.exp(-2j * np.pi * phase).astype(np.complex64, order="C")
        images, changes = _respond(optics, shapes, seen, masks)
        if back:
            images, changes = images[::-1, :, ::-1], -changes[::-1, ::-1]
        light = optics.gather_light(images, changes, sensor.valid)
        signals.append(differentiate_signals(light, sensor.valid))
    return np.asarray((signals[0] - signals[1]) * (2 * np.pi / optics.wfs.wavelength_m))


def _respond(
    optics: PyramidOptics, shapes: Array, centres: Places, masks: Array
) -> tuple[Array, Array]:
    """Return the images ``(2, n, 2, n)``, and their changes ``(2, 2, n, n, n_shapes)``.

    Each image is seen at its centre ``(2, 2, 2)``, behind its mask ``(2, 2, n, n)`` in the focus.
    """
    n, (along_y, along_x), nodes = optics.wfs.n_subapertures, optics.source_phasors(), optics.nodes
    u, n_nodes = optics.pupil.coordinates, len(nodes.weights)
    to_focus = np.exp(-2j * np.pi * np.outer(optics.focal_frequencies, u)).astype(np.complex64)
    points = (np.arange(n)[:, None] - (n - 1) / 2 + nodes.offsets).ravel()
    weights = np.tile(nodes.weights, n)
    back = np.exp(
        2j * np.pi * (centres[..., None, None] + points[:, None]) * optics.focal_frequencies
    ).astype(np.complex64)  # (2, 2, (x, y), n n_nodes, n_frequencies)
    maps = np.zeros((1 + shapes.shape[1], len(u), len(u)), np.complex64)
    lit, maps[0] = optics.pupil.lit, optics.pupil_field
    maps[1:, lit] = optics.pupil_field[lit] * shapes.T
    images, changes = np.zeros((2, n, 2, n)), np.zeros((2, 2, n, n, shapes.shape[1]), np.float32)
    for y, pair in zip(along_y, along_x, strict=True):
        for x in pair:
            focus = to_focus @ (maps * (y[:, None] * x)) @ to_focus.T
            for place in np.ndindex(2, 2):
                back_x, back_y = back[place]
                field = back_y @ (focus * masks[place]) @ back_x.T
                parts = np.conj(field[0]) * field * np.outer(weights, weights)
                light = parts.reshape(-1, n, n_nodes, n, n_nodes).sum(axis=(2, 4))
                images[place[0], :, place[1]] += light[0].real
                changes[place] -= 2.0 * np.moveaxis(light[1:].imag, 0, -1)
    return images, changes
