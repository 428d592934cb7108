"""Measured influence functions that end, between the points of their table.

The spline through each function, and its smooth continuation where the table knows nothing, end
as it does: a tile of the pupil knows the functions near it, as it does Gaussian ones.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from typing_extensions import override

from service.errors import ModelError
from service.model.instrument import Instrument, LocalFunctions, TabulatedModes
from service.model.local import shapes_on
from service.model.pupil import instrument_pupil
from service.model.tabulated import TabulatedBasis, continuation, margin_of, pad_mask
from service.model.turbulence import SAMPLING, local_statistics, predict_variance

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_TAIL = 12
"""Samples around a function that its spline reaches: weights fall by 0.27 from one to the next."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalTable(TabulatedBasis):
    """Modes of measured functions that end; ``coefficients`` are strokes ``(n_functions, n)``."""

    functions: Any = field(repr=False)
    """``(ny * nx, n_functions)`` weights of the B-splines, sparse by rows."""

    is_local = True

    @cached_property
    @override
    def variance_m2(self) -> Array:
        strokes = np.asarray(self.coefficients, np.float64)
        pupil = instrument_pupil(self.instrument, SAMPLING)
        functions = shapes_on(pupil, self.functions.shape[1], self.patch)
        gram, covariance = local_statistics(self.instrument, functions)
        return predict_variance(strokes.T @ gram @ strokes, strokes.T @ covariance @ strokes)

    @cached_property
    def in_single(self) -> LocalTable:
        """The same modes as products take them, in float32."""
        return replace(self, coefficients=self.coefficients.astype(np.float32))

    def patch(
        self, points: Array, direction: Array | None = None
    ) -> tuple[NDArray[np.intp], Array]:
        """Return which functions reach some points close together, and their heights there.

        ``(n_near,)`` and ``(n_points, n_near)``; with a ``direction`` ``(n_points, 2)`` their rates
        along it. What they weigh in each mode are the ``coefficients``.
        """
        found = self._splines_at(points, direction) @ self.functions
        # A sparse product keeps only functions whose splines reach one of the points.
        near = np.unique(found.indices)
        return near.astype(np.intp), np.asarray(found[:, near].toarray())

    @override
    def _combine_splines(self, splines: Any) -> Array:
        return np.asarray((splines @ self.functions) @ self.coefficients)


def local_table(instrument: Instrument, table: TabulatedModes) -> LocalTable:
    """Return the splines through a mirror's own functions.

    Raises
    ------
    ModelError
        If the table is too coarse for the sensor, or has no functions that end.
    """
    local = table.local
    if local is None:
        raise ModelError("modes: found a table of modes; expected functions that end")
    step, margin = margin_of(instrument, table)
    known = pad_mask(table.known, margin)
    samples = _continue_samples(
        _place_samples(local, table.known.shape, margin, known.shape), known
    )
    # Without strokes each function is a mode.
    strokes = np.eye(local.n_functions) if local.strokes is None else local.strokes
    return LocalTable(
        instrument=instrument,
        coefficients=strokes,
        functions=_splines_through(samples, known.shape, local.floor),
        surface_known=known,
        step_subap=step,
        y_sign=table.y_sign,
    )


def _place_samples(
    local: LocalFunctions,
    shape: tuple[int, ...],
    margin: tuple[int, int],
    grown: tuple[int, ...],
) -> Any:  # noqa: ANN401 - scipy has no types
    """Return the functions' samples on the table with its margin, ``(ny * nx, n)``, by columns."""
    row, column = np.divmod(local.places, shape[1])
    row, column = row + margin[0], column + margin[1]
    # A negative margin cuts the table: samples beyond what any registration reaches are dropped.
    inside = (row >= 0) & (row < grown[0]) & (column >= 0) & (column < grown[1])
    function = np.repeat(np.arange(local.n_functions), np.diff(local.ends))
    places = (row * grown[1] + column)[inside]
    size = (grown[0] * grown[1], local.n_functions)
    return scipy.sparse.csc_array((local.heights[inside], (places, function[inside])), shape=size)


def _continue_samples(samples: Any, known: Mask) -> Any:  # noqa: ANN401 - scipy has no types
    """Return the samples, and where nothing is known what continues them oddly."""
    target, weights = continuation(known)
    found = (weights.astype(samples.dtype) @ samples).tocoo()
    beyond = (found.data, (target[found.coords[0]], found.coords[1]))
    return (samples + scipy.sparse.csc_array(beyond, shape=samples.shape)).tocsc()


def _splines_through(samples: Any, shape: tuple[int, ...], floor: float) -> Any:  # noqa: ANN401
    """Return the weights of the B-splines through each column, those below the floor left out."""
    values, places = [], []
    for j in range(samples.shape[1]):
        part = slice(samples.indptr[j], samples.indptr[j + 1])
        row, column = np.divmod(samples.indices[part], shape[1])
        if not len(row):
            values.append(np.zeros(0, samples.dtype))
            places.append(np.zeros(0, np.intp))
            continue
        low = np.maximum([row.min() - _TAIL, column.min() - _TAIL], 0)
        high = np.minimum([row.max() + _TAIL, column.max() + _TAIL], np.array(shape) - 1)
        box = np.zeros(high - low + 1, samples.dtype)
        box[row - low[0], column - low[1]] = samples.data[part]
        # In a box around the samples: beyond its tail a spline is nothing.
        box = scipy.ndimage.spline_filter(box, order=3, output=box.dtype)
        y, x = np.nonzero(np.abs(box) > floor * np.abs(box).max())
        values.append(box[y, x])
        places.append((y + low[0]) * shape[1] + x + low[1])
    ends = np.concatenate([[0], np.cumsum([len(one) for one in places])])
    found = (np.concatenate(values), np.concatenate(places), ends)
    return scipy.sparse.csc_array(found, shape=samples.shape).tocsr()
