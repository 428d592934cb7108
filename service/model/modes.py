"""The mirror's modes and its surface between actuators."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.errors import ModelError
from service.model.far_field import PlateSum
from service.model.instrument import Instrument, TabulatedModes
from service.model.karhunen_loeve import compute_modes, surface_statistics
from service.model.kinds import BasisKind
from service.model.local_table import LocalTable, local_table
from service.model.surface import Gaussian, Surface, mirror_surface
from service.model.tabulated import TabulatedBasis, build_table_basis, smooth_shapes
from service.model.turbulence import predict_variance

Array = NDArray[np.float64]

Indices = Sequence[int] | NDArray[np.integer]


@dataclass(frozen=True, kw_only=True, eq=False)
class ModalBasis:
    """Modes of an analytic mirror.

    A unit command is 1 m RMS of OPD over the pupil for Karhunen-Loeve modes, and what its owner
    says for others.
    """

    surface: Surface
    """The mirror between its actuators, coordinates in subapertures."""

    mode_to_actuator: Array
    """``(n_actuators, n_modes)`` actuator strokes of each mode, metres OPD per unit command."""

    coefficients: Array
    """``(n_basis, n_modes)`` weights of the surface's basis functions for each mode."""

    variance_m2: Array
    """``(n_modes,)`` expected variance of each mode under the turbulence, metres² OPD."""

    y_sign: float = 1.0
    """-1: the mirror is seen from behind."""

    @property
    def n_modes(self) -> int:
        """Modes of the basis."""
        return int(self.coefficients.shape[1])

    def render(self, points: Array) -> Array:
        """Return the modes ``(n_points, n_modes)`` at mirror ``points`` ``(n_points, 2)``."""
        # A mirror seen from behind is drawn in its own coordinates.
        at = points * [1.0, self.y_sign]
        if self.plates is not None:
            return self.plates.heights(at)
        return self.surface.basis(at) @ self.coefficients

    def render_slope(self, points: Array, direction: Array) -> Array:
        """Return the derivative of the modes along ``direction``, ``(n_points, n_modes)``."""
        side = np.array([1.0, self.y_sign])
        if self.plates is not None:
            return self.plates.slopes(points * side, direction * side)
        return self.surface.slope(points * side, direction * side) @ self.coefficients

    def render_wider(self, points: Array) -> Array:
        """Return how the modes change with the logarithm of the influence functions' width.

        ``(n_points, n_modes)``; the strokes of the actuators stay.
        """
        if isinstance(self.surface, Gaussian):
            return self.surface.wider(points * [1.0, self.y_sign]) @ self.coefficients
        return smooth_shapes(self.render, points)

    @cached_property
    def plates(self) -> PlateSum | None:
        """The sum of its plates; None: it has none."""
        if isinstance(self.surface, Gaussian):
            return None
        return PlateSum(surface=self.surface, coefficients=self.coefficients)

    @override
    def __getstate__(self) -> dict[str, object]:
        """Leave out the sums, 26 MB: the process that receives the basis computes them itself."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def in_single(self) -> ModalBasis:
        """The same modes as products take them, in float32."""
        # Gaussian functions only, whose coefficients are the strokes: thin plates need float64.
        strokes: NDArray[Any] = self.coefficients.astype(np.float32)
        return replace(self, mode_to_actuator=strokes, coefficients=strokes)

    @property
    def is_local(self) -> bool:
        """True if its functions end near their actuators, so that ``patch`` finds them."""
        return isinstance(self.surface, Gaussian)

    def patch(
        self, points: Array, direction: Array | None = None
    ) -> tuple[NDArray[np.intp], Array]:
        """Return which functions reach some points close together, and their heights there.

        ``(n_near,)`` and ``(n_points, n_near)``; with a ``direction`` ``(n_points, 2)`` their rates
        along it. What they weigh in each mode are the ``coefficients``.

        Raises
        ------
        ModelError
            If they do not end.
        """
        if not isinstance(self.surface, Gaussian):
            raise ModelError("modes: found functions that reach everywhere; expected local ones")
        side = np.array([1.0, self.y_sign])
        return self.surface.patch(points * side, None if direction is None else direction * side)

    def of_surface(self, surface: Surface) -> ModalBasis:
        """Return the same strokes of other influence functions."""
        coefficients = surface.coefficients(self.mode_to_actuator)
        return replace(self, surface=surface, coefficients=coefficients)

    @property
    def of_actuators(self) -> ModalBasis:
        """Basis of single actuators, a unit stroke each, without statistics of the turbulence."""
        strokes = np.eye(len(self.mode_to_actuator))
        return replace(
            self,
            mode_to_actuator=strokes,
            coefficients=self.surface.coefficients(strokes),
            variance_m2=np.ones(len(strokes)),
        )

    def known(self, points: Array) -> NDArray[np.bool_]:
        """Return that an analytic surface is known at every point, ``(n_points,)``."""
        return np.ones(len(points), dtype=np.bool_)

    def subset(self, indices: Indices) -> ModalBasis:
        """Return a basis of these modes only, in this order."""
        return self._of_columns(
            lambda columns: np.ascontiguousarray(columns[:, indices]), self.variance_m2[indices]
        )

    def combine_modes(self, weights: Array) -> ModalBasis:
        """Return a basis of combinations of the modes, ``weights`` ``(n_modes, n_combined)``.

        Modes are taken to vary apart from one another.
        """
        return self._of_columns(lambda columns: columns @ weights, self.variance_m2 @ weights**2)

    def _of_columns(self, combine: Callable[[Array], Array], variance_m2: Array) -> ModalBasis:
        """Return a basis of the columns that ``combine`` makes of those of these modes."""
        other = replace(
            self,
            mode_to_actuator=combine(self.mode_to_actuator),
            coefficients=combine(self.coefficients),
            variance_m2=variance_m2,
        )
        # The series of a tile are linear in the modes: combining them spares the plates.
        if self.plates is not None and other.plates is not None:
            other.plates.take_tiles(self.plates, combine)
        return other


Basis = ModalBasis | TabulatedBasis
"""Shapes of the mirror that can be evaluated wherever a registration puts them."""

LocalBasis = ModalBasis | LocalTable
"""Made of functions that may end near their actuators."""


def local_of(basis: Basis) -> LocalBasis | None:
    """Return a basis whose functions end near their actuators; None: they do not."""
    return basis if isinstance(basis, LocalBasis) and basis.is_local else None


def modal_basis(instrument: Instrument) -> Basis:
    """Return the modes of this instrument, of any kind.

    Raises
    ------
    ModelError
        If the mirror has fewer modes than requested, or its table is too coarse.
    """
    # Computed with the finest subapertures, so that all sensor modes have the same basis.
    finest = instrument.finest
    mirror = finest.mirror
    if isinstance(mirror, TabulatedModes):
        made = build_table_basis if mirror.local is None else local_table
        return in_subapertures(made(finest, mirror), instrument)
    return in_subapertures(analytic_basis(finest), instrument)


def in_subapertures(basis: Basis, instrument: Instrument) -> Basis:
    """Return the mirror's modes in coordinates of the instrument's present subapertures.

    The modes are always computed with the finest subapertures: with coarser ones they would be
    degenerate.
    """
    wider = instrument.subaperture_m / instrument.finest.subaperture_m
    if wider == 1.0:
        return basis
    if isinstance(basis, ModalBasis):
        surface = mirror_surface(instrument.analytic_mirror, instrument.subaperture_m)
        return basis.of_surface(surface)
    return replace(basis, instrument=instrument, step_subap=basis.step_subap / wider)


def analytic_basis(instrument: Instrument) -> ModalBasis:
    """Return the modes of an analytic mirror: the user's own, its actuators, or KL modes.

    Raises
    ------
    ModelError
        If the mirror has fewer modes than requested, or is a table of shapes.
    """
    mirror = instrument.analytic_mirror
    strokes = mirror.mode_to_actuator
    if strokes is None:
        if mirror.basis is BasisKind.KARHUNEN_LOEVE:
            return karhunen_loeve_basis(instrument)
        strokes = np.eye(len(mirror.positions_m))
    # The statistics serve the expected variance alone: the modes are the user's own.
    surface = mirror_surface(mirror, instrument.subaperture_m)
    gram, covariance = surface_statistics(instrument, surface)
    return ModalBasis(
        surface=surface,
        mode_to_actuator=strokes,
        coefficients=surface.coefficients(strokes),
        variance_m2=predict_variance(strokes.T @ gram @ strokes, strokes.T @ covariance @ strokes),
        y_sign=mirror.y_sign,
    )


def karhunen_loeve_basis(instrument: Instrument) -> ModalBasis:
    """Return the first ``n_modes`` KL modes of the instrument's mirror.

    Raises
    ------
    ModelError
        If the mirror has fewer modes than requested.
    """
    mirror = instrument.analytic_mirror
    surface = mirror_surface(mirror, instrument.subaperture_m)
    strokes, variance = compute_modes(instrument, surface)
    return ModalBasis(
        surface=surface,
        mode_to_actuator=strokes,
        coefficients=surface.coefficients(strokes),
        variance_m2=variance,
        y_sign=mirror.y_sign,
    )
