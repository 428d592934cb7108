"""Conversion between the RTC's list of signals and the order, axes and signs of conventions.md.

An RTC has its own order of components, its own corner of the detector where rows and columns begin,
and its own choice of which half of the light counts as positive. The conversion is one permutation
of the signal vector with one sign per element, so nothing is interpolated and the inverse is exact.
For pixels it is a permutation only: their sign states on which side the images are.

The parts common to all sensors are planes over the valid subapertures, their order in the list, and
the orientation of the grid. Each kind of signal, and so each sensor that has it, defines its
planes, their change when the grid is turned or a sign is reversed, and the orders that only it can
have.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.kinds import Normalisation, SignalKind, SlopeOrder

Scalar = TypeVar("Scalar", bound=np.generic)

TO_SLOPES = {
    SignalKind.XY: np.eye(2),
    SignalKind.INTENSITY: np.array([[1.0, -1.0, 1.0, -1.0], [1.0, 1.0, -1.0, -1.0]]),
}
"""``(2, n_planes)``: Sx and Sy of the signals of a subaperture, in the axes of conventions.md."""

_PLANE_PLACES = {
    SlopeOrder.XY: [0, 1],
    SlopeOrder.YX: [1, 0],
    SlopeOrder.IMAGES: [0, 1, 2, 3],
    SlopeOrder.IMAGES_YX: [0, 2, 1, 3],
    SlopeOrder.AROUND: [0, 1, 3, 2],
}
"""Index of each plane of conventions.md in the orders that list one plane after the other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Orientation:
    """The RTC's axes and signs in the axes of conventions.md.

    Applied from the RTC's slopes to ours in the order of the fields, bottom to top of the optics:
    signs of the components on the RTC's own grid, then the flips of the grid, then the swap. A
    flip or a swap moves the grid and the components together, as looking into a mirror does; a
    sign changes a component only. With pixels, -1 exchanges the images at -x and +x, or at -y and
    +y, and leaves each image as it is.
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


FLIPS = ("swap_xy", "flip_x", "flip_y")
"""Keys of an instrument file that turn or mirror the grid."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SlopeRecipe:
    """Kind, order, orientation and normalisation of an RTC's signals."""

    order: SlopeOrder = SlopeOrder.XY
    """Order of the signals; it says of which kind they are, too."""

    orientation: Orientation | None = None
    """Axes and signs; None: not known ("auto"), to be found from a measured matrix."""

    normalisation: Normalisation = Normalisation.GLOBAL
    """Normalisation of the intensities."""

    @property
    def kind(self) -> SignalKind:
        """Kind of the signals."""
        return self.order.kind

    @property
    def assumed_orientation(self) -> Orientation:
        """The stated orientation, else the axes of conventions.md."""
        return self.orientation or Orientation()


PLAIN = SlopeRecipe()
"""All Sx, then all Sy, over the mean flux."""


def to_conventions(
    values: NDArray[Scalar], recipe: SlopeRecipe, mask: NDArray[np.bool_]
) -> NDArray[Scalar]:
    """Return RTC signals in the order, axes and signs of conventions.md.

    Parameters
    ----------
    values
        ``(n_slopes, ...)`` signals, or a matrix of them, as the RTC lists them.
    recipe
        How it lists them.
    mask
        ``(n, n)`` [y, x] valid subapertures in the RTC's own axes. The result is listed by
        ``orient_mask(mask, recipe.assumed_orientation)``.

    Raises
    ------
    ModelError
        If there are not two slopes for every valid subaperture.
    """
    # A gather with signs; its inverse below is the scatter.
    index, sign = _list_signals(values, recipe, mask)
    return np.asarray(values[index] * _as_column(sign, values))


def to_rtc(
    values: NDArray[Scalar], recipe: SlopeRecipe, mask: NDArray[np.bool_]
) -> NDArray[Scalar]:
    """Return signals of conventions.md as the RTC lists them: the inverse of ``to_conventions``.

    ``mask`` is in the RTC's own axes here too.

    Raises
    ------
    ModelError
        If there are not two slopes for every valid subaperture.
    """
    index, sign = _list_signals(values, recipe, mask)
    listed = np.empty_like(values)
    listed[index] = values * _as_column(sign, values)
    return listed


def orient_mask(mask: NDArray[Scalar], orientation: Orientation) -> NDArray[Scalar]:
    """Return a map ``(n, n)`` [y, x] in the RTC's axes, in those of conventions.md."""
    flipped = _flip(mask, orientation)
    return flipped.T if orientation.swap_xy else flipped


def rtc_mask(mask: NDArray[Scalar], orientation: Orientation) -> NDArray[Scalar]:
    """Return a map ``(n, n)`` [y, x] in the axes of conventions.md, in the RTC's."""
    return _flip(mask.T if orientation.swap_xy else mask, orientation)


def _flip(plane: NDArray[Scalar], orientation: Orientation) -> NDArray[Scalar]:
    return plane[:: -1 if orientation.flip_y else 1, :: -1 if orientation.flip_x else 1]


def _list_signals(
    values: NDArray[Any], recipe: SlopeRecipe, mask: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.int8]]:
    """Return for every signal of conventions.md its place in the RTC's list, and its sign."""
    order, orientation = recipe.order, recipe.assumed_orientation
    n_valid, n_planes = int(mask.sum()), order.kind.n_planes
    if len(values) != n_planes * n_valid:
        raise ModelError(
            f"slopes: found {len(values)} of them; expected {n_planes * n_valid}, "
            f"{n_planes} for each of the {n_valid} valid subapertures"
            f"{likely_kind(len(values), n_planes * n_valid)}"
        )
    # Indices are turned as maps: flips and swaps then need no formula of their own.
    planes = np.full((n_planes, *mask.shape), -1, dtype=np.intp)
    planes[:, mask] = _places(order, mask)
    valid = orient_mask(mask, orientation)
    turned = np.array([orient_mask(plane, orientation)[valid] for plane in planes])
    sign_x, sign_y = orientation.sign_x, orientation.sign_y
    signs = np.array([sign_x, sign_y], np.int8) * (-1) ** np.array(
        [orientation.flip_x, orientation.flip_y]
    )
    if order.kind is SignalKind.INTENSITY:
        # A sign of -1 exchanges images, because a pixel's light has no sign.
        images = turned.reshape(2, 2, n_valid)[:: signs[1], :: signs[0]]
        images = images.swapaxes(0, 1) if orientation.swap_xy else images
        return images.reshape(-1), np.ones(len(values), dtype=np.int8)
    if orientation.swap_xy:
        # Swapping the axes also exchanges Sx and Sy.
        turned, signs = turned[::-1], signs[::-1]
    return turned.reshape(-1), np.repeat(signs, n_valid)


def likely_kind(n_found: int, n_expected: int) -> str:
    """Return what a wrong number of signals looks like; empty: nothing known."""
    words = {
        2.0: '; they look like pixels: is it slopes.kind = "intensity"?',
        0.5: '; they look like x and y slopes: is it slopes.kind = "xy"?',
    }
    return words.get(n_found / max(n_expected, 1), "")


def slopes_of(signals: NDArray[Any], kind: SignalKind) -> NDArray[Any]:
    """Return Sx and Sy ``(2, n_valid, ...)`` of signals ``(n_slopes, ...)`` of conventions.md."""
    part = TO_SLOPES[kind].astype(signals.dtype)
    return np.tensordot(part, signals.reshape(kind.n_planes, -1, *signals.shape[1:]), axes=1)


def signals_of_slopes(slopes: NDArray[Any], kind: SignalKind) -> NDArray[Any]:
    """Return the smallest signals ``(n_slopes, ...)`` that have these slopes ``(2, n_valid, ...)``.

    Of ``slopes_of`` its pseudo-inverse.
    """
    rows = TO_SLOPES[kind]
    # The rows are orthogonal and of the same length, so that this is the pseudo-inverse.
    part = (rows.T / (rows[0] @ rows[0])).astype(slopes.dtype)
    return np.tensordot(part, slopes, axes=1).reshape(-1, *slopes.shape[2:])


def as_maps(slopes: NDArray[np.floating], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return signals ``(n_slopes,)`` as one map, NaN where none is valid: see ``side_by_side``."""
    planes = slopes.reshape(-1, int(valid.sum()))
    maps = np.full((len(planes), *valid.shape), np.nan)
    maps[:, valid] = planes
    return side_by_side(maps)


def side_by_side(maps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Sx next to Sy ``(n, 2 n)``, or four images in their positions ``(2 n, 2 n)``."""
    return np.vstack([np.hstack(list(maps[k : k + 2])) for k in range(0, len(maps), 2)])


def _places(order: SlopeOrder, mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the indices in the list of the signals of every valid subaperture.

    ``(n_planes, n_valid)``: of Sx and Sy, or of the images at -x -y, +x -y, -x +y, +x +y.
    """
    n_planes, n_valid = order.kind.n_planes, int(mask.sum())
    places = np.arange(n_planes * n_valid)
    if order in {SlopeOrder.INTERLEAVED, SlopeOrder.PIXELS}:
        return places.reshape(n_valid, n_planes).T
    if order is SlopeOrder.DETECTOR:
        side_y, side_x, place = np.indices((2, 2, n_valid)).reshape(3, -1)
        row, column = (axis[place] for axis in np.nonzero(mask))
        # lexsort gives the signal at each place of the list; argsort inverts it to the place of
        # each signal.
        return np.argsort(np.lexsort((column, side_x, row, side_y))).reshape(4, n_valid)
    return places.reshape(n_planes, n_valid)[_PLANE_PLACES[order]]


def _as_column(sign: NDArray[np.int8], values: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(sign.astype(values.dtype).reshape(-1, *[1] * (values.ndim - 1)))
