"""A sensor with its pupil, its response to small wavefronts and its light, for any kind.

Signals are ordered plane by plane, each plane over all valid subapertures in row-major order of the
mask: Sx, then Sy, or the planes of ``SignalKind``. ``service.model.slopes`` converts to the RTC's
order and axes. The sensor's Jacobian K is never held as a whole: ``apply`` may compute it row by
row of subapertures.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from service.model.arrays import NUMPY, Arrays
from service.model.local import MadeElsewhere, Shapes
from service.model.pupil import Illumination

Array = NDArray[Any]

Mapper = Callable[[Callable[[int], Any], Iterable[int]], Iterator[Any]]
"""Like the builtin ``map``; an executor's ``map`` spreads the work over rows."""


class RowTask(ABC):
    """A function of rows that may be sent to another process: no threads in it.

    A mapper may share its rows with other machines; those of any other function stay here.
    """

    @abstractmethod
    def __call__(self, row: int) -> Array:
        """Return what there is of a row."""

    @property
    def elsewhere(self) -> MadeElsewhere | None:
        """Recipe for another process to make the same; None if it is sent megabytes of arrays."""
        return None


class WorkingPoint(ABC):
    """Effect of a loop's residual on the source; its content is private to its kind."""

    __slots__ = ()

    @property
    @abstractmethod
    def coherence(self) -> float:
        """Share of the light that stays where a flat wavefront puts it, 0..1."""


KEPT_BYTES = 1e9
"""Enough for K of 40 subapertures at every sampling; of the ELT it takes 3.8 GB."""

_ROW_CHUNK = 512
"""Rows of a product per task: large enough for BLAS, small enough to share between cores."""


class Response(Protocol):
    """Response of the sensor to small wavefronts, for one position of its pupil image."""

    @property
    def light(self) -> NDArray[np.float64]:
        """Light on every pixel of a flat wavefront, in the sensor's own shape and unit."""

    def lit(self, light: NDArray[np.float64]) -> Response:
        """Return the response where the pixels have other light at rest: some may be dead."""

    def jacobian(self) -> Array:
        """Return K whole, ``(n_signals, n_points)`` per metre: for simulators only."""

    def apply(self, shapes: Shapes) -> Array:
        """Return the signals ``(n_signals, n_shapes)`` of wavefronts ``(n_points, n_shapes)``.

        Wavefronts are in metres of OPD at the illuminated points of the pupil. Local ones are
        multiplied like any others.
        """

    def with_shift_rates(self, shapes: Shapes) -> tuple[Array, Array, Array]:
        """Return what ``apply`` does, and its change per subaperture along x, and along y."""


@runtime_checkable
class SeveralImages(Protocol):
    """The response of a sensor with several images of the pupil, each at its own place."""

    def image_rates(self, shapes: Shapes) -> Array:
        """Return the change of the signals when one image alone moves on its pixels.

        ``(2 n_images, n_signals, n_shapes)`` per subaperture: each along x, then each along y.
        """


class Sensor(Protocol):
    """A sensor with its pupil, at a given sampling."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """``(n, n)`` [y, x] subapertures that give signals, in the axes of conventions.md."""

    @property
    def n_signals(self) -> int:
        """Signals of a frame."""

    @property
    def keeps_gradient(self) -> bool:
        """Return True if the response caches intermediate results for further shapes.

        If it does not, it is cheaper to request all shapes together.
        """

    def at(self, shift: tuple[float, float]) -> Response:
        """Return the response with the pupil's image moved by ``shift``, (x, y) subapertures."""

    def work(self, n_shapes: int) -> Work:
        """Return what a response and the signals of so many shapes take."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Work:
    """Cost of a computation, estimated before it begins."""

    memory_bytes: float
    """At its largest, shapes and signals not counted."""

    flop: float
    """Additions and multiplications."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fineness:
    """Sampling of the sensor, and where it is computed."""

    n_nodes: int = 3
    """Quadrature nodes along a side of a subaperture."""

    n_source_points: int = 0
    """Points of the source at least, where it has any; 0: as many as are enough."""

    dtype: type[np.float32] | type[np.float64] = np.float32
    """Precision of the products; float64 for derivative checks."""

    mapper: Mapper = map
    """Spreads rows over threads."""

    kept_bytes: float = KEPT_BYTES
    """Memory that a response may use to cache results for further shapes. A response that needs
    more caches nothing."""

    arrays: Arrays = NUMPY
    """Array library for the rows of a pyramid; sparse lenslets use SciPy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PupilPosition:
    """Position of the pupil image."""

    at: tuple[float, float]
    """x and y of their centre from that of the sensor's grid, subapertures."""

    sigma: tuple[float, float]
    """1 σ of both."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageOffsets:
    """Displacement of each of several pupil images from its place on the pixel grid."""

    subap: NDArray[np.float64]
    """``(4, 2)`` along x and y, subapertures, of the images at -x -y, +x -y, -x +y, +x +y; their
    mean is 0."""

    sigma_subap: NDArray[np.float64]
    """``(4, 2)`` 1 σ of each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CannotTell:
    """The map does not say; a value, because it may well happen."""

    reason: str
    """Description of what was found, and what would help."""


class Light(Protocol):
    """The light of one instrument's sensor; counts are in the axes of conventions.md."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the counts."""

    def counts_of(self, flux: bytes) -> NDArray[Any]:
        """Return the counts that a status carries.

        Raises
        ------
        ModelError
            If they are not this sensor's.
        """

    def counts(self, light: NDArray[Any]) -> NDArray[Any]:
        """Return a response's light as counts are laid out."""

    def orient_counts(self, counts: NDArray[Any]) -> NDArray[Any]:
        """Return counts in the RTC's axes, in those of conventions.md."""

    def find_pupil(self, counts: NDArray[Any]) -> PupilPosition | CannotTell:
        """Return the position of the pupil's image, for any shift that light can determine.

        Raises
        ------
        ModelError
            If the counts have another shape.
        """

    def find_image_offsets(self, counts: NDArray[Any]) -> ImageOffsets | CannotTell:
        """Return the displacement of each of several pupil images from its place on the pixel grid.

        Raises
        ------
        ModelError
            If the counts have another shape.
        """

    def illumination(self, counts: NDArray[Any], position: PupilPosition) -> Illumination:
        """Return how evenly the beam is lit.

        Raises
        ------
        ModelError
            If the counts have another shape, or are dark.
        """

    def relative(
        self, counts: NDArray[Any], position: PupilPosition
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the light over that of an even beam, ``(n, n)`` on the sensor, and where known."""


def by_rows(
    mapper: Mapper, function: Callable[[Array], Array], rows: Array, n_together: int = _ROW_CHUNK
) -> Array:
    """Return what a function makes of rows, chunk after chunk of so many together."""
    starts = range(0, len(rows), n_together)
    chunks = mapper(lambda start: function(rows[start : start + n_together]), starts)
    return np.concatenate(list(chunks))
