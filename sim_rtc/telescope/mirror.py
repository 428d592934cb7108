"""The deformable mirror: shape, dead actuators, limits, lag.

A diffractive telescope's influence functions are of another kind than the service's: a plate under
tension on springs, where the service has a bare thin plate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ConfigurationError
from service.model.instrument import Mirror
from service.model.kinds import Influence
from service.model.surface import mirror_surface

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_EULER = 0.5772156649015329


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorFaults:
    """Actuators that do not obey."""

    dead: tuple[int, ...] = ()
    """Switched off: the shell takes them wherever their neighbours bend it."""

    stuck: tuple[tuple[int, float], ...] = ()
    """Actuator and the OPD it is held at, metres."""

    def check(self, n_actuators: int) -> None:
        """Refuse actuators the mirror does not have, or with two faults at once.

        Raises
        ------
        ConfigurationError
            Naming the actuator.
        """
        named = [*self.dead, *(index for index, _ in self.stuck)]
        for index in named:
            if not 0 <= index < n_actuators:
                raise ConfigurationError(
                    f"--dead-actuators, --stuck-actuators: found actuator {index}; "
                    f"the mirror has 0 to {n_actuators - 1}"
                )
        if len(set(named)) != len(named):
            raise ConfigurationError(
                f"--dead-actuators, --stuck-actuators: found {sorted(named)}; "
                "expected every actuator once"
            )


class PlantSurface(Protocol):
    """The mirror of a plant between its actuators, coordinates in subapertures."""

    def coefficients(self, strokes: Array, free: tuple[int, ...] = ()) -> Array:
        """Return ``(n_basis, n_shapes)`` weights of the shapes with these actuator strokes.

        ``strokes`` is ``(n_actuators, n_shapes)``; those of ``free`` actuators do not count.
        """

    def basis(self, points: Array) -> Array | scipy.sparse.csr_array:
        """Return ``(n_points, n_basis)`` at ``points`` ``(n_points, 2)``, x and y."""


@dataclass(frozen=True, slots=True, eq=False)
class TensionedPlate:
    """A plate with bending stiffness and tension, held by springs at its actuators.

    The kernel ``-(K0(κr) + log κr + γ - log 2)`` is the Green's function of ``∇⁴ - κ²∇²``: a thin
    plate over short distances, a membrane over long ones. The springs have a stiffness, so the
    surface need not pass exactly through what was commanded.

    References
    ----------
    Mitášová & Mitáš 1993, Math. Geol. 25, 641 (spline with tension).
    """

    positions: Array
    """``(n_actuators, 2)`` x and y."""

    tension: float
    """κ, reciprocal of the length beyond which tension rules over bending."""

    softness: float = 0.0
    """Compliance of the springs over the plate's own, 0: held firmly."""

    def coefficients(self, strokes: Array, free: tuple[int, ...] = ()) -> Array:
        """Return ``(n_actuators + 1, n_shapes)`` weights of the shapes with these strokes.

        Actuators that are ``free`` are left out of the plate's supports: their weights are zero.
        """
        n = len(self.positions)
        held = np.setdiff1d(np.arange(n), free)
        system = np.ones((len(held) + 1, len(held) + 1))
        system[:-1, :-1] = self._kernel(self.positions[held])[:, held]
        diagonal = np.arange(len(held))
        system[diagonal, diagonal] += self.softness
        system[-1, -1] = 0.0
        # The last equation makes the weights sum to zero: it determines the constant.
        padded = np.vstack([strokes[held], np.zeros((1, strokes.shape[1]))])
        weights = np.zeros((n + 1, strokes.shape[1]))
        weights[np.append(held, n)] = scipy.linalg.lu_solve(scipy.linalg.lu_factor(system), padded)
        return weights

    def basis(self, points: Array) -> Array:
        """Return ``(n_points, n_actuators + 1)``: the kernel about each actuator, then 1."""
        return np.column_stack([self._kernel(points), np.ones(len(points))])

    def _kernel(self, points: Array) -> Array:
        dx = points[:, :1] - self.positions[:, 0]
        dy = points[:, 1:] - self.positions[:, 1]
        scaled = self.tension * np.hypot(dx, dy)
        return _tension_kernel(scaled)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnSurface:
    """Nominal influence functions, on actuators that may be switched off.

    Without one of its actuators a thin plate bends as the others determine; a Gaussian is absent.
    """

    mirror: Mirror
    subaperture_m: float

    def coefficients(self, strokes: Array, free: tuple[int, ...] = ()) -> Array:
        """Return ``(n_basis, n_shapes)`` weights of the shapes with these strokes."""
        n = len(self.mirror.positions_m)
        held = np.setdiff1d(np.arange(n), free)
        supports = replace(self.mirror, positions_m=self.mirror.positions_m[held])
        found = mirror_surface(supports, self.subaperture_m).coefficients(strokes[held])
        n_others = len(found) - len(held)
        weights = np.zeros((n + n_others, strokes.shape[1]))
        weights[np.append(held, n + np.arange(n_others))] = found
        return weights

    def basis(self, points: Array) -> Array:
        """Return ``(n_points, n_basis)`` of all actuators, those that are off included."""
        return mirror_surface(self.mirror, self.subaperture_m).basis(points)


def _tension_kernel(scaled: Array) -> Array:
    """Return ``-(K0(x) + log x + γ - log 2)``, by its series where the terms would cancel."""
    # log 0 at an actuator itself; the kernel's limit there is 0.
    x = np.maximum(scaled, 1e-12)
    # K0(x) and log(x / 2) cancel to the second order: their difference has no digits left.
    near = x < 1e-3
    exact = -(scipy.special.k0(x) + np.log(x / 2) + _EULER)
    half = (x / 2) ** 2
    return np.asarray(np.where(near, half * (np.log(x / 2) + _EULER - 1.0), exact))


def misplace_actuators(mirror: Mirror, position_error: float, rng: np.random.Generator) -> Mirror:
    """Return the mirror with random position errors that contain no shift, rotation or scale.

    ``position_error`` is RMS per axis in pitches. A common movement of all actuators would be a
    registration: the true α would be another one.
    """
    nominal = mirror.positions_m @ np.array([1.0, 1.0j])
    error = rng.normal(0.0, position_error * mirror.pitch_m, (len(nominal), 2)) @ [1.0, 1.0j]
    similarity = np.column_stack([np.ones_like(nominal), nominal])
    coefficients, *_ = np.linalg.lstsq(similarity, error, rcond=None)
    error -= similarity @ coefficients
    moved = nominal + error
    return replace(mirror, positions_m=np.column_stack([moved.real, moved.imag]))


def disobedient(
    surface: PlantSurface, mode_to_actuator: Array, faults: MirrorFaults
) -> tuple[Array, Array]:
    """Return weights ``(n_basis, n_modes)`` of the modes and ``(n_basis,)`` of stuck actuators.

    A dead actuator goes where the surface takes it; a stuck one stays at its place whatever the
    modes ask for.
    """
    faults.check(len(mode_to_actuator))
    strokes = np.column_stack([mode_to_actuator, np.zeros(len(mode_to_actuator))])
    for index, opd_m in faults.stuck:
        strokes[index] = 0.0
        strokes[index, -1] = opd_m
    weights = surface.coefficients(strokes, faults.dead)
    return weights[:, :-1], weights[:, -1]


def modal_content(modes: Array32, weights: Array) -> Array:
    """Return ``(n_modes, n_points)``: how much of each mode is in a phase, least squares by area.

    ``modes`` ``(n_points, n_modes)`` are shapes, ``weights`` ``(n_points,)`` shares of the area.
    """
    weighted = modes * weights[:, None].astype(np.float32)
    gram = (modes.T @ weighted).astype(np.float64)
    factor = scipy.linalg.cho_factor(gram)
    return np.asarray(scipy.linalg.cho_solve(factor, weighted.T.astype(np.float64)))


def heights(mirror: Mirror, strokes: Array) -> Array:
    """Return where these strokes put the surface at the actuators, both ``(n_actuators, n)``.

    A thin plate passes through its strokes; Gaussians overlap, and add up to more.
    """
    if mirror.shape.influence is Influence.THIN_PLATE:
        return strokes
    drawn = mirror_surface(mirror, mirror.pitch_m)
    return np.asarray(
        drawn.basis(mirror.positions_m / mirror.pitch_m) @ drawn.coefficients(strokes)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorLimits:
    """Largest stroke and slope of the mirror, in OPD."""

    stroke_m: float = 30e-6
    """Largest stroke of an actuator either way."""

    bend_m: float = 4e-6
    """Largest distance of an actuator from the mean of its neighbours: a limit of its force."""


class MirrorDrive:
    """Converts the commanded modes into those on the mirror: limits first, then the lag.

    With a first-order response the mirror moves during part of every exposure. The slopes, and the
    telemetry, contain the mean over the exposure.
    """

    def __init__(
        self,
        mirror: Mirror,
        mode_to_actuator: Array,
        *,
        frame_rate_hz: float,
        rise_s: float = 0.0,
        limits: MirrorLimits | None = None,
    ) -> None:
        """Take the time from 10 to 90 % of a step as ``rise_s``; 0 moves at once."""
        self._limits = limits or MirrorLimits()
        self._to_actuators = mode_to_actuator.astype(np.float32)
        self._to_modes = np.linalg.pinv(mode_to_actuator).astype(np.float32)
        self._neighbour_mean = _neighbour_mean(mirror.positions_m, mirror.pitch_m)
        # A first-order response takes log 9 time constants from 10 to 90 %.
        steps = frame_rate_hz * rise_s / np.log(9.0)
        self._left_at_end = np.float32(np.exp(-1.0 / steps)) if steps > 0.0 else np.float32(0.0)
        # Mean of exp(-t / τ) over a frame: (τ / T)(1 - exp(-T / τ)).
        self._left_on_average = np.float32(steps * (1.0 - float(self._left_at_end)))
        n_modes = mode_to_actuator.shape[1]
        self._position = np.zeros(n_modes, dtype=np.float32)
        self._dither = np.zeros(n_modes, dtype=np.float32)

    def follow(self, command_m: Array32, dither_m: Array32 | None) -> int:
        """Replace a command and its dither part by the mirror's response.

        Both are ``(n_modes,)``. Returns the number of actuators that met a limit.
        """
        n_limited = self._limit(command_m)
        self._move(self._position, command_m)
        if dither_m is None:
            self._dither *= self._left_at_end
        else:
            self._move(self._dither, dither_m)
        return n_limited

    def _limit(self, command_m: Array32) -> int:
        strokes = self._to_actuators @ command_m
        n_limited = 0
        bend = strokes - self._neighbour_mean @ strokes
        excess = bend - np.clip(bend, -self._limits.bend_m, self._limits.bend_m)
        beyond = np.count_nonzero(excess)
        if beyond:
            strokes -= excess
            n_limited += int(beyond)
        clipped = np.clip(strokes, -self._limits.stroke_m, self._limits.stroke_m)
        n_limited += int(np.count_nonzero(clipped != strokes))
        if n_limited:
            # Fitted back to the modes: the integrator must know what the mirror does.
            command_m[:] = self._to_modes @ clipped
        return n_limited

    def _move(self, position: Array32, command: Array32) -> None:
        """Advance ``position`` to the end of the frame and put its mean over it in ``command``."""
        distance = position - command
        np.add(command, distance * self._left_at_end, out=position)
        command += distance * self._left_on_average


def _neighbour_mean(positions_m: Array, pitch_m: float) -> scipy.sparse.csr_array:
    """Return ``(n, n)`` averages over the neighbours of each actuator within two pitches."""
    n = len(positions_m)
    near = np.zeros((n, n), dtype=bool)
    for corners in scipy.spatial.Delaunay(positions_m).simplices:
        near[np.ix_(corners, corners)] = True
    distance = np.hypot(*(positions_m[:, None] - positions_m).transpose(2, 0, 1))
    # Delaunay joins actuators across the central obscuration and along the rim, which are no
    # neighbours.
    near &= (distance > 0.0) & (distance < 2 * pitch_m)
    share = near / np.maximum(near.sum(axis=1, keepdims=True), 1)
    return scipy.sparse.csr_array(share.astype(np.float32))
