"""Geometry of several sensors and mirrors: the registration of each sensor-mirror pair.

A sensor, its guide star and a mirror make a pair. A point of the nominal mirror geometry is mapped
to the mirror's conjugate altitude, along the star's line of sight to the pupil, and from there to
the sensor's grid: three similarity transforms in sequence. The matrix of a pair determines α, its
registration relative to the nominal one. This module relates those α to the positions of sensors,
mirrors and stars.

References
----------
Agapito, Plantet & Heritier 2024, Proc. SPIE 13097, 130975P (arXiv 2406.15336), section 2.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.guide_star import GuideStar, Similarity
from service.model.instrument import Instrument, Mirror, TabulatedModes
from service.model.kinds import BasisKind, Stop
from service.model.modes import Basis, ModalBasis, modal_basis
from service.model.surface import mirror_surface

Array = NDArray[np.float64]

ARCSEC_RAD = np.pi / 180.0 / 3600.0

SHIFTS, ROTATION, MAGNIFICATION, STAR, HEIGHT = slice(0, 2), 2, 3, slice(4, 6), 6
"""Places among the numbers of a sensor, and of a mirror, which has no star."""

N_OF_SENSOR, N_OF_MIRROR = 7, 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedSensor:
    """A sensor with its nominal position and its guide star."""

    name: str
    instrument: Instrument
    """Instrument file with the telescope and the sensor."""

    star: GuideStar
    place: Similarity
    """Transform from the pupil to the sensor's grid, lengths in its subapertures."""

    fixed: bool = False
    """True if the nominal position is exact and is not fitted."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedMirror:
    """A mirror with its nominal position."""

    name: str
    instrument: Instrument
    """Instrument file with the actuators and modes."""

    altitude_m: float
    """Conjugate altitude along the line of sight."""

    place: Similarity
    """Transform from the nominal mirror geometry to the plane at its altitude, lengths in metres.
    """

    fixed: bool = False
    """True if the nominal position is exact and is not fitted."""


class Pair(NamedTuple):
    """Indices of a sensor and of a mirror."""

    sensor: int
    mirror: int


class Parameter(NamedTuple):
    """One parameter of the position of a sensor, star or mirror."""

    owner: str
    """Name of the sensor or mirror."""

    name: str
    """Name of the parameter, with its unit at the boundary."""

    boundary: float
    """Factor from the numeric value to the boundary unit."""

    subap: float
    """Change of the parameter that moves the sensor's image of the mirror by about one subaperture,
    at the edge of the pupil or on the highest mirror."""

    free: bool
    """True if the parameter is fitted; otherwise it keeps its value from the file."""


@dataclass(frozen=True, kw_only=True, eq=False)
class System:
    """Sensors and mirrors of one telescope, and which of their positions are unknown."""

    name: str
    sensors: tuple[PlacedSensor, ...]
    mirrors: tuple[PlacedMirror, ...]
    stars_move: bool = False
    """True if the directions of stars are fitted as well."""

    heights_move: bool = False
    """True if the heights of laser stars are fitted as well."""

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """Every sensor with every mirror."""
        return tuple(Pair(i, j) for i in range(len(self.sensors)) for j in range(len(self.mirrors)))

    def names(self, pair: Pair) -> tuple[str, str]:
        """Return the names of a pair's sensor and mirror."""
        return self.sensors[pair.sensor].name, self.mirrors[pair.mirror].name

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of all positions, in the order of ``nominal``."""
        return tuple(self._parameters())

    def _parameters(self) -> Iterator[Parameter]:
        degrees = 180.0 / np.pi
        # With all mirrors in the pupil, directions of stars have no effect, and any unit serves.
        highest_m = max(abs(mirror.altitude_m) for mirror in self.mirrors) or 1.0
        for sensor in self.sensors:
            free, star, laser = not sensor.fixed, sensor.star, sensor.star.height_m < inf
            # A rotation or magnification of 1 over the radius moves the pupil's edge by one
            # subaperture.
            edge = 2.0 / sensor.instrument.wfs.pupil_diameter
            parallax = sensor.instrument.subaperture_m / highest_m
            # The cone effect images a mirror 1 - altitude / height times as wide, whose derivative
            # by the height is altitude / height².
            higher = star.height_m**2 / highest_m * edge if laser else 1.0
            yield Parameter(sensor.name, "shift_x_subap", 1.0, 1.0, free)
            yield Parameter(sensor.name, "shift_y_subap", 1.0, 1.0, free)
            yield Parameter(sensor.name, "rotation_deg", degrees, edge, free)
            yield Parameter(sensor.name, "magnification", 1.0, edge, free)
            yield Parameter(sensor.name, "star_x_arcsec", 1 / ARCSEC_RAD, parallax, self.stars_move)
            yield Parameter(sensor.name, "star_y_arcsec", 1 / ARCSEC_RAD, parallax, self.stars_move)
            # A natural star is at infinity, so there is no height to fit.
            found = self.heights_move and laser
            yield Parameter(sensor.name, "star_height_m", 1.0, higher, found)
        for mirror in self.mirrors:
            edge = 2.0 / mirror.instrument.wfs.pupil_diameter
            width_m, free = mirror.instrument.subaperture_m, not mirror.fixed
            yield Parameter(mirror.name, "shift_x_m", 1.0, width_m, free)
            yield Parameter(mirror.name, "shift_y_m", 1.0, width_m, free)
            yield Parameter(mirror.name, "rotation_deg", degrees, edge, free)
            yield Parameter(mirror.name, "magnification", 1.0, edge, free)

    def of_sensor(self, number: int) -> slice:
        """Return the indices of a sensor's parameters."""
        return slice(number * N_OF_SENSOR, (number + 1) * N_OF_SENSOR)

    def of_mirror(self, number: int) -> slice:
        """Return the indices of a mirror's parameters."""
        first = len(self.sensors) * N_OF_SENSOR
        return slice(first + number * N_OF_MIRROR, first + (number + 1) * N_OF_MIRROR)

    @cached_property
    def nominal(self) -> Array:
        """``(n_parameters,)`` values from the system file, numeric units."""
        of_sensors = [
            [
                *_numbers(s.place),
                s.star.direction_rad.real,
                s.star.direction_rad.imag,
                s.star.height_m,
            ]
            for s in self.sensors
        ]
        return np.concatenate([*of_sensors, *(_numbers(m.place) for m in self.mirrors)])

    def at(self, values: Array) -> System:
        """Return the system whose nominal positions are these values."""
        sensors = tuple(
            replace(
                one, star=_star(values[self.of_sensor(k)]), place=_place(values[self.of_sensor(k)])
            )
            for k, one in enumerate(self.sensors)
        )
        mirrors = tuple(
            replace(one, place=_place(values[self.of_mirror(k)]))
            for k, one in enumerate(self.mirrors)
        )
        return replace(self, sensors=sensors, mirrors=mirrors)

    def seen(self, pair: Pair, values: Array) -> Similarity:
        """Return the map from the nominal mirror geometry to a sensor's grid, in subapertures."""
        to_grid, along_light, to_altitude = self._steps(pair, values)
        return to_grid.after(along_light).after(to_altitude)

    def _steps(self, pair: Pair, values: Array) -> tuple[Similarity, Similarity, Similarity]:
        of_sensor, of_mirror = (
            values[self.of_sensor(pair.sensor)],
            values[self.of_mirror(pair.mirror)],
        )
        width_m = self.sensors[pair.sensor].instrument.subaperture_m
        along_light = _star(of_sensor).project_plane(self.mirrors[pair.mirror].altitude_m)
        return (
            _place(of_sensor),
            along_light.scale_unit(width_m),
            _place(of_mirror).scale_unit(width_m),
        )

    def drawn(self, pair: Pair) -> Similarity:
        """Return the part of the nominal map that the pair's instrument file already contains.

        α is relative to it. It is the whole map if actuators are known and the telescope is the
        stop; otherwise it is the identity.
        """
        mirror = self.mirrors[pair.mirror].instrument.mirror
        stop = self.sensors[pair.sensor].instrument.stop
        if isinstance(mirror, Mirror) and stop is Stop.TELESCOPE:
            return self.seen(pair, self.nominal)
        return Similarity()

    def instrument(self, pair: Pair) -> Instrument:
        """Return the instrument of a pair: the sensor's, with the mirror as it appears on its grid.

        Its D at ``Misregistration()`` is that of the nominal system; where ``drawn`` is the
        identity, D is nominal at ``alphas`` of the nominal values.
        """
        sensor, mirror = self.sensors[pair.sensor], self.mirrors[pair.mirror]
        about, own = sensor.instrument, mirror.instrument
        unknown = (
            *(key for key in about.unknown if key.startswith("wfs.")),
            *(key for key in own.unknown if key.startswith("mirror.")),
        )
        # With the pupil displaced on the grid, the model's pupil has to be displaced as well.
        shift = sensor.place.shift
        return replace(
            about,
            name=f"{sensor.name}-{mirror.name}",
            pupil_shift_subap=(shift.real, shift.imag) if shift else None,
            mirror=self._place_mirror(pair),
            modes=own.modes,
            unknown=unknown,
            law=None,
            remarks=(),
        )

    def basis(self, pair: Pair) -> Basis:
        """Return the mirror's modes as imaged on this sensor; strokes are the same for all."""
        about = self.instrument(pair)
        own = self.bases[pair.mirror]
        if not isinstance(own, ModalBasis):
            return modal_basis(about)
        seen = mirror_surface(about.analytic_mirror, about.subaperture_m)
        return replace(own.of_surface(seen), y_sign=about.mirror.y_sign)

    @cached_property
    def bases(self) -> tuple[Basis, ...]:
        """Modes of each mirror, as its own instrument file defines them."""
        return tuple(modal_basis(mirror.instrument) for mirror in self.mirrors)

    def lit(self, pair: Pair) -> NDArray[np.intp] | None:
        """Return the illuminated actuators of a mirror at an altitude.

        None if the mirror is conjugate to the pupil or its modes are not single actuators.
        """
        mirror, about = self.mirrors[pair.mirror], self.instrument(pair)
        own = about.mirror
        if mirror.altitude_m == 0.0 or not isinstance(own, Mirror):
            return None
        if own.mode_to_actuator is not None or own.basis is not BasisKind.ZONAL:
            return None
        radius_m = np.linalg.norm(own.positions_m, axis=1)
        inside = radius_m <= about.diameter_m / 2
        return np.flatnonzero(inside & (radius_m >= about.obscuration_ratio * about.diameter_m / 2))

    def _place_mirror(self, pair: Pair) -> Mirror | TabulatedModes:
        mirror, drawn = self.mirrors[pair.mirror].instrument.mirror, self.drawn(pair)
        if drawn == Similarity() or not isinstance(mirror, Mirror):
            return mirror
        width_m = self.sensors[pair.sensor].instrument.subaperture_m
        # Rotation and mirror image are in the positions from here on, so the new geometry has
        # neither.
        sided = mirror.positions_m * [1.0, mirror.y_sign]
        return replace(
            mirror,
            positions_m=drawn.scale_unit(1.0 / width_m).points(sided),
            pitch_m=mirror.pitch_m * abs(drawn.turn),
            nominal_rotation_rad=0.0,
            parity=1,
        )

    def alphas(self, values: Array) -> Array:
        """Return α of every pair ``(n_pairs, 4)`` for these parameters, numeric units."""
        found = [self.seen(p, values).after(self.drawn(p).inverse).alpha.vector for p in self.pairs]
        return np.array(found)

    def rates(self, values: Array) -> Array:
        """Return ``(n_pairs, 4, n_parameters)`` derivatives of the pairs' α by the parameters."""
        found = np.zeros((len(self.pairs), 4, len(values)))
        for rates, pair in zip(found, self.pairs, strict=True):
            turned, shifted = self._pair_rates(pair, values)
            drawn = self.drawn(pair)
            turn = self.seen(pair, values).turn / drawn.turn
            # α begins where the instrument file's own map ends, so that map's shift is taken out.
            shifted = shifted - turn * turned * drawn.shift
            rates[:] = [shifted.real, shifted.imag, turned.imag, abs(turn) * turned.real]
        return found

    def _pair_rates(self, pair: Pair, values: Array) -> tuple[NDArray[np.complex128], ...]:
        """Return the derivatives of the logarithm of the map's linear part, and of its shift."""
        turned, shifted = np.zeros((2, len(values)), dtype=np.complex128)
        of_sensor, of_mirror = self.of_sensor(pair.sensor), self.of_mirror(pair.mirror)
        to_grid, along_light, to_altitude = self._steps(pair, values)
        width_m = self.sensors[pair.sensor].instrument.subaperture_m
        altitude_m = self.mirrors[pair.mirror].altitude_m
        height_m = values[of_sensor][HEIGHT]
        # ``scale``: metres at the altitude to the grid; ``centre``: image of the mirror's centre
        scale = to_grid.turn * along_light.turn / width_m
        centre = to_grid.after(along_light).after(to_altitude).shift - to_grid.shift
        narrower = -abs(along_light.turn) * altitude_m / height_m**2
        size, own_size = values[of_sensor][MAGNIFICATION], values[of_mirror][MAGNIFICATION]
        turned[of_sensor] = [0, 0, 1j, 1 / size, 0, 0, narrower]
        shifted[of_sensor] = [
            1,
            1j,
            1j * centre,
            centre / size,
            -scale * altitude_m,
            -1j * scale * altitude_m,
            centre * narrower,
        ]
        turned[of_mirror] = [0, 0, 1j, 1 / own_size]
        shifted[of_mirror] = [scale, 1j * scale, 0, 0]
        return turned, shifted


def _numbers(place: Similarity) -> list[float]:
    """Return shift, rotation and magnification of a place."""
    return [place.shift.real, place.shift.imag, float(np.angle(place.turn)), abs(place.turn)]


def _star(numbers: Array) -> GuideStar:
    return GuideStar(direction_rad=complex(*numbers[STAR]), height_m=float(numbers[HEIGHT]))


def _place(numbers: Array) -> Similarity:
    return Similarity(
        turn=numbers[MAGNIFICATION] * complex(np.exp(1j * numbers[ROTATION])),
        shift=complex(*numbers[SHIFTS]),
    )
