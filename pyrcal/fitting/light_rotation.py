"""Coarse rotation from the illumination of the pupil.

Only features without rotational symmetry carry information: shadows of spider arms, or an uneven
beam. Whether they rotate with the mirror depends on the instrument; with an adaptive secondary
mounted on those arms, they do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError
from service.estimation.solver import vertex
from service.model.pupil import Illumination
from service.model.sensors.sensor import CannotTell, PupilPosition

Array = NDArray[np.float64]

_STEP_DEG = 0.5
_MIN_CORRELATION = 0.3
"""Correlation below which the two maps have no common structure. Diffraction leaves narrow arms
0.4; a pupil without arms reaches 0.2."""

_MAX_PEAK_RATIO = 0.85
"""Correlation of another rotation over the best one above which the result is ambiguous."""

_APART_DEG = 10.0
"""Smallest distance of two separate correlation peaks, degrees."""

_LARGEST_SIGMA_DEG = 2.0
_SHADOW_SAMPLES = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class LightRotation:
    """Measured rotation of the illumination relative to its reference."""

    rotation_rad: float
    """Rotation from sensor +x towards +y, rad."""

    sigma_rad: float
    """1 σ of the rotation from the noise of the map and the sharpness of its structure, rad."""

    correlation: float
    """Correlation of the map with the rotated reference, 0..1."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Arms:
    """Spider arms at rotation 0."""

    angles_rad: tuple[float, ...]
    """Direction of each arm from +x towards +y, from the centre outwards, rad."""

    width_subap: float
    """Width of each shadow, subapertures."""

    def light(self, n: int) -> Array:
        """Return the illumination behind the arms ``(n, n)``, on centred subapertures, 0..1."""
        inside = (np.arange(_SHADOW_SAMPLES) + 0.5) / _SHADOW_SAMPLES - 0.5
        # Samples within each subaperture, because an arm may be narrower than one.
        fine = (np.arange(n)[:, None] - (n - 1) / 2 + inside).reshape(-1)
        x, y = fine[None, :], fine[:, None]
        hidden = np.zeros((len(fine), len(fine)))
        for angle in self.angles_rad:
            along = x * np.cos(angle) + y * np.sin(angle)
            across = y * np.cos(angle) - x * np.sin(angle)
            edge = np.clip((self.width_subap / 2 - np.abs(across)) * _SHADOW_SAMPLES + 0.5, 0, 1)
            # The largest and not the sum: where arms overlap the light is blocked once. Half lines,
            # because arms end at the centre.
            hidden = np.maximum(hidden, np.where(along >= 0.0, edge, 0.0))
        cells = hidden.reshape(n, _SHADOW_SAMPLES, n, _SHADOW_SAMPLES)
        return np.asarray(1.0 - cells.mean(axis=(1, 3)))


def find_rotation(
    light: Array,
    known: NDArray[np.bool_],
    position: PupilPosition,
    reference: Illumination | Arms,
    *,
    within_rad: float = 2 * np.pi,
) -> LightRotation | CannotTell:
    """Return the rotation of the illumination relative to a reference centred on its own pupil.

    Parameters
    ----------
    light, known
        Output of ``relative_light``, on the sensor.
    position
        Position of the pupil on the sensor.
    reference
        Illumination measured at rotation 0, or the spider arms. With arms, smooth unevenness is
        removed first, because arms do not predict it.
    within_rad
        Largest rotation searched. Evenly spaced arms repeat after a fraction of a turn.

    Raises
    ------
    ModelError
        If a map is not square.
    """
    if light.shape != known.shape or light.ndim != 2 or light.shape[0] != light.shape[1]:
        raise ModelError(
            f"rotation: found light {light.shape} and its mask {known.shape}; expected the same "
            "square map"
        )
    # slightly beyond half a turn, so that a peak at 180 deg has neighbours on both sides
    limit = min(np.rad2deg(within_rad), 180.0 + _APART_DEG / 2)
    angles = np.arange(-limit, limit + _STEP_DEG / 2, _STEP_DEG)
    if isinstance(reference, Arms):
        template, smooth = reference.light(len(light) + 2), _smooth_shapes(known, 3)
    else:
        # A measured reference contains the smooth unevenness as well, so only the mean is removed.
        template, smooth = reference.intensity, _smooth_shapes(known, 0)
    seen = _remove_shapes(light[known], smooth)
    turned = np.array(
        [
            _remove_shapes(_rotate_reference(template, known, position, angle), smooth)
            for angle in np.deg2rad(angles)
        ]
    )
    sizes = np.linalg.norm(turned, axis=1) * np.linalg.norm(seen)
    if sizes.min() <= 1e-9 * max(float(sizes.max()), 1.0):
        return CannotTell(reason="the light, or its reference, is even: no rotation shows")
    correlation = turned @ seen / sizes
    best = int(np.argmax(correlation))
    refusal = _refusal(angles, correlation, best)
    if refusal:
        return CannotTell(reason=refusal)
    # The best angle has neighbours, because ``_refusal`` rejects the first and the last one.
    rotation_deg = angles[best] + _STEP_DEG * vertex(*correlation[best - 1 : best + 2])
    # σ of a least-squares rotation: noise of the map over the norm of its derivative
    slope = (turned[best + 1] - turned[best - 1]) / (2 * np.deg2rad(_STEP_DEG))
    scale = float(turned[best] @ seen / (turned[best] @ turned[best]))
    left = seen - scale * turned[best]
    sigma = float(left.std() / (scale * np.linalg.norm(slope)))
    if np.rad2deg(sigma) > _LARGEST_SIGMA_DEG:
        return CannotTell(
            reason=f"the light's structure is too weak: {np.rad2deg(sigma):.1f} deg of "
            f"uncertainty, expected at most {_LARGEST_SIGMA_DEG:g}; average more frames"
        )
    return LightRotation(
        rotation_rad=float(np.deg2rad(rotation_deg)),
        sigma_rad=sigma,
        correlation=float(correlation[best]),
    )


def _refusal(angles: Array, correlation: Array, best: int) -> str:
    """Return why the best rotation is rejected; empty if it is accepted."""
    highest = float(correlation[best])
    if highest < _MIN_CORRELATION:
        return (
            f"the light does not resemble its reference at any rotation: correlation "
            f"{highest:.2f}, expected at least {_MIN_CORRELATION:g}"
        )
    apart = np.abs((angles - angles[best] + 180.0) % 360.0 - 180.0)
    peak = np.r_[False, np.diff(np.sign(np.diff(correlation))) < 0, False]
    rivals = np.where(peak & (apart >= _APART_DEG), correlation, -1.0)
    if rivals.max() > _MAX_PEAK_RATIO * highest:
        other = angles[int(np.argmax(rivals))]
        return (
            f"ambiguous: rotations of {angles[best]:.0f} and {other:.0f} deg explain the light "
            "equally well; give a narrower range"
        )
    if best in {0, len(angles) - 1}:
        return f"the best rotation is the last one tried, {angles[best]:.0f} deg; try a wider range"
    return ""


def _rotate_reference(
    reference: Array, known: NDArray[np.bool_], position: PupilPosition, angle_rad: float
) -> Array:
    """Return the reference rotated and moved to ``position``, on the known subapertures."""
    n, middle = len(known), (len(reference) - 1) / 2
    rows, columns = np.nonzero(known)
    # Each subaperture is looked up in the reference, which takes the inverse rotation.
    x = columns - (n - 1) / 2 - position.at[0]
    y = rows - (n - 1) / 2 - position.at[1]
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    places = [middle + cosine * y - sine * x, middle + cosine * x + sine * y]
    return np.asarray(scipy.ndimage.map_coordinates(reference, places, order=1, mode="nearest"))


def _smooth_shapes(known: NDArray[np.bool_], order: int) -> Array:
    """Return orthonormal polynomials over the known subapertures ``(n_known, n_shapes)``."""
    y, x = (2.0 * axis / len(known) - 1.0 for axis in np.nonzero(known))
    terms = [x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)]
    return np.asarray(np.linalg.qr(np.column_stack(terms))[0])


def _remove_shapes(values: Array, shapes: Array) -> Array:
    return np.asarray(values - shapes @ (shapes.T @ values))
