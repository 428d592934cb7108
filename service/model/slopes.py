"""The slopes as the RTC lists them, and the way to conventions.md's order, axes and signs and back.

An RTC has its own order of components, its own corner of the detector where rows and columns begin,
and its own idea of which half of the light counts as positive. All of it is one permutation of the
slope vector with one sign per element, so nothing is interpolated and the inverse is exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.kinds import Normalisation, SlopeOrder

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, slots=True, kw_only=True)
class Orientation:
    """How the RTC's axes and signs lie in the axes of conventions.md.

    Applied from the RTC's slopes to ours in the order of the fields, bottom to top of the optics:
    signs of the components on the RTC's own grid, then the flips of the grid, then the swap. A
    flip or a swap moves the grid and the components together, as looking into a mirror does; a
    sign changes a component only.
    """

    swap_xy: bool = False
    """The RTC's rows run along our x: transpose the grid and exchange Sx and Sy. Comes last."""

    flip_x: bool = False
    """The RTC counts columns against our x: mirror the grid along x and negate Sx."""

    flip_y: bool = False
    """The RTC counts rows against our y: mirror the grid along y and negate Sy."""

    sign_x: int = 1
    """-1: the RTC's Sx falls for a wavefront rising along its own columns. Comes first."""

    sign_y: int = 1
    """-1: the RTC's Sy falls for a wavefront rising along its own rows. Comes first."""

    def __post_init__(self) -> None:
        """Refuse a sign that is none.

        Raises
        ------
        ModelError
            If a sign is neither 1 nor -1.
        """
        if not {self.sign_x, self.sign_y} <= {-1, 1}:
            raise ModelError(
                f"orientation: found signs {self.sign_x}, {self.sign_y}; expected 1 or -1"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class SlopeRecipe:
    """How the RTC makes and lists its slopes."""

    order: SlopeOrder = SlopeOrder.XY
    """Order of the components."""

    orientation: Orientation | None = None
    """Axes and signs; None: not known ("auto"), to be found from a measured matrix."""

    normalisation: Normalisation = Normalisation.GLOBAL
    """What the differences are divided by."""

    @property
    def assumed_orientation(self) -> Orientation:
        """What holds until a measurement says otherwise: the axes of conventions.md."""
        return self.orientation or Orientation()


def to_conventions(
    values: NDArray[Scalar],
    order: SlopeOrder,
    orientation: Orientation,
    mask: NDArray[np.bool_],
) -> NDArray[Scalar]:
    """Return RTC slopes in the order, axes and signs of conventions.md.

    Parameters
    ----------
    values
        ``(n_slopes, ...)`` slopes, or a matrix of them, as the RTC lists them.
    order, orientation
        The RTC's.
    mask
        ``(n, n)`` [y, x] valid subapertures in the RTC's own axes. The result is listed by
        ``turned_mask(mask, orientation)``.

    Raises
    ------
    ModelError
        If there are not two slopes for every valid subaperture.
    """
    index, sign = _listing(values, order, orientation, mask)
    return np.asarray(values[index] * _as_column(sign, values))


def to_rtc(
    values: NDArray[Scalar],
    order: SlopeOrder,
    orientation: Orientation,
    mask: NDArray[np.bool_],
) -> NDArray[Scalar]:
    """Return slopes of conventions.md as the RTC lists them: the inverse of ``to_conventions``.

    ``mask`` is in the RTC's own axes here too.

    Raises
    ------
    ModelError
        If there are not two slopes for every valid subaperture.
    """
    index, sign = _listing(values, order, orientation, mask)
    listed = np.empty_like(values)
    listed[index] = values * _as_column(sign, values)
    return listed


def turned_mask(mask: NDArray[Scalar], orientation: Orientation) -> NDArray[Scalar]:
    """Return a map ``(n, n)`` [y, x] in the RTC's axes, in those of conventions.md."""
    flipped = _flipped(mask, orientation)
    return flipped.T if orientation.swap_xy else flipped


def rtc_mask(mask: NDArray[Scalar], orientation: Orientation) -> NDArray[Scalar]:
    """Return a map ``(n, n)`` [y, x] in the axes of conventions.md, in the RTC's."""
    return _flipped(mask.T if orientation.swap_xy else mask, orientation)


def _flipped(plane: NDArray[Scalar], orientation: Orientation) -> NDArray[Scalar]:
    return plane[:: -1 if orientation.flip_y else 1, :: -1 if orientation.flip_x else 1]


def _listing(
    values: NDArray[Any], order: SlopeOrder, orientation: Orientation, mask: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.int8]]:
    """Return for every slope of conventions.md its place in the RTC's list, and its sign."""
    n_valid = int(mask.sum())
    if len(values) != 2 * n_valid:
        raise ModelError(
            f"slopes: found {len(values)} of them; expected {2 * n_valid}, two for each of the "
            f"{n_valid} valid subapertures"
        )
    planes = np.full((2, *mask.shape), -1, dtype=np.intp)
    planes[:, mask] = _places(order, n_valid)
    signs = [
        -orientation.sign_x if orientation.flip_x else orientation.sign_x,
        -orientation.sign_y if orientation.flip_y else orientation.sign_y,
    ]
    turned = [turned_mask(plane, orientation) for plane in planes]
    if orientation.swap_xy:
        turned.reverse()
        signs.reverse()
    valid = turned_mask(mask, orientation)
    index = np.concatenate([plane[valid] for plane in turned])
    return index, np.repeat(np.array(signs, dtype=np.int8), n_valid)


def _places(order: SlopeOrder, n_valid: int) -> NDArray[np.intp]:
    """Return where Sx and Sy of every valid subaperture stand in the list, ``(2, n_valid)``."""
    match order:
        case SlopeOrder.XY:
            return np.arange(2 * n_valid).reshape(2, n_valid)
        case SlopeOrder.YX:
            return np.arange(2 * n_valid).reshape(2, n_valid)[::-1]
        case SlopeOrder.INTERLEAVED:
            return np.arange(2 * n_valid).reshape(n_valid, 2).T


def _as_column(sign: NDArray[np.int8], values: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(sign.astype(values.dtype).reshape(-1, *[1] * (values.ndim - 1)))
