"""Reference slopes with which a loop holds a shape that is not flat, and how large it may be.

A loop with a pyramid holds the shape c, modes in metres of OPD, if ``r = D(α) G c`` is subtracted
from its slopes: c is what it leaves on the sensor. G is the gain with which the sensor responds to
a shape that stays, a few per cent below the gain that a fast dither measures. If the seeing gets
worse while r stays, the loop holds more than c, because a smaller response has to make the same
slopes; beyond some size it runs away within a second. A shape is therefore limited by the worst
seeing that is expected, and not by today's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import Basis
from service.model.sensors.registry import kind_of
from service.model.turbulence import REFERENCE_WAVELENGTH_M
from service.model.zernikes import compute_zernikes
from service.records.products import Frame

Array = NDArray[np.float64]

SEEING_COEFFICIENT = 0.98
"""Seeing times r0 over the wavelength, for an infinite outer scale."""

_SAMPLING = 3
"""Pupil points along a subaperture, with which the limit was measured."""

HOLDING_LOSS = 0.80
HOLDING_EXPONENT = 3.45
"""A loop with ``r = D G c`` and the gain G of fast dithers holds ``1 + 0.80 (1 - G)^3.45`` times c.

Measured on the simulated diffractive telescope (docs/results/references.md): 1.01, 1.06 and 1.17
times at gains of 0.72, 0.525 and 0.36.
"""


def holding_gain(optical_gain: NDArray[Any]) -> Array:
    """Return the gain that holds a shape ``(n_modes,)`` of optical gains ``(n_modes,)``.

    The optical gain is that of pokes or of fast dithers, metres per metre. In residual turbulence
    the response of a pyramid fluctuates, and its mean response to a shape that stays is smaller. A
    gain of 1 and more, of a sensor without turbulence or in double pass, is returned as it is.

    Raises
    ------
    ModelError
        If a gain is not a positive number.
    """
    gain = np.asarray(optical_gain, dtype=np.float64)
    if not np.all(np.isfinite(gain) & (gain > 0.0)):
        raise ModelError(
            "references: found an optical gain that is not a positive number; expected one for "
            "each mode, metres per metre"
        )
    lost = np.maximum(1.0 - gain, 0.0)
    return np.asarray(gain / (1.0 + HOLDING_LOSS * lost**HOLDING_EXPONENT))


def compute_references(
    interaction_matrix: NDArray[Any], optical_gain: NDArray[Any], coefficients_m: NDArray[Any]
) -> Array:
    """Return the offset of the reference slopes ``(n_slopes,)`` with which a loop holds a shape.

    It is ``r = D(α) G c``, to be subtracted from the slopes beyond the RTC's own references.

    Parameters
    ----------
    interaction_matrix
        D(α) ``(n_slopes, n_modes)`` in the RTC's order of slopes, slope per metre.
    optical_gain
        Gain of each mode ``(n_modes,)`` as dithers measure it, at α; ``holding_gain`` is applied
        here.
    coefficients_m
        The shape c ``(n_modes,)`` that the loop is to leave on the sensor, metres OPD.

    Raises
    ------
    ModelError
        If the numbers of modes differ, or a coefficient is not a finite number.
    """
    gain, shape = holding_gain(optical_gain), _check_shape(coefficients_m)
    if not len(gain) == len(shape) == interaction_matrix.shape[1]:
        raise ModelError(
            f"references: found {len(gain)} gains and {len(shape)} coefficients for a matrix of "
            f"{interaction_matrix.shape[1]} modes; expected as many"
        )
    return np.asarray(interaction_matrix.astype(np.float64, copy=False) @ (gain * shape))


def _check_shape(coefficients_m: NDArray[Any]) -> Array:
    shape = np.asarray(coefficients_m, dtype=np.float64)
    if not np.all(np.isfinite(shape)):
        raise ModelError("shape: found a coefficient that is not a finite number; expected metres")
    return shape


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalShape:
    """A shape on the sensor, as modes of the mirror."""

    coefficients_m: Array
    """``(n_modes,)`` metres OPD, 0 beyond the modes that may be used."""

    unexplained: float
    """RMS over the pupil of what no mode explains, over that of the shape, 0..1."""


def shape_in_modes(
    model: InteractionModel,
    alpha: Misregistration,
    given: NDArray[Any],
    frame: Frame,
    *,
    n_modes: int,
) -> ModalShape:
    """Return a shape as the first ``n_modes`` modes of the mirror at registration α.

    In the frame of the mirror ``given`` ``(n,)`` are coefficients of its modes. In that of the
    instrument they are Zernike coefficients by Noll's number from 1 on (``compute_zernikes``), or a
    map ``(n, n)`` [y, x] whose sides touch the pupil; metres OPD on the sensor's axes. They are
    fitted by least squares over the lit pupil, without piston.

    Raises
    ------
    ModelError
        If a number is not finite, or there are more coefficients than modes.
    """
    given = np.asarray(given, dtype=np.float64)
    coefficients_m = np.zeros(model.basis.n_modes)
    if frame is Frame.MIRROR:
        if given.ndim != 1 or np.any(given[n_modes:]):
            raise ModelError(
                f"shape: found {given.shape} coefficients in the frame of the mirror; expected "
                f"those of the {n_modes} modes that the loop controls"
            )
        coefficients_m[:n_modes][: len(given)] = _check_shape(given[:n_modes])
        return ModalShape(coefficients_m=coefficients_m, unexplained=0.0)
    places = model.pupil.points / (model.instrument.wfs.pupil_diameter / 2.0)
    read = compute_zernikes if given.ndim == 1 else _read_map
    opd_m = _check_shape(read(given, places))
    weights = model.pupil.weights
    # No sensor sees piston: it is taken out of the shape and of the modes.
    modes = model.render_modes(alpha)[:, :n_modes].astype(np.float64)
    modes = np.sqrt(weights)[:, None] * (modes - weights @ modes)
    shape = np.sqrt(weights) * (opd_m - weights @ opd_m)
    coefficients_m[:n_modes] = np.linalg.lstsq(modes, shape, rcond=None)[0]
    left_m = float(np.linalg.norm(shape - modes @ coefficients_m[:n_modes]))
    return ModalShape(
        coefficients_m=coefficients_m,
        unexplained=left_m / max(float(np.linalg.norm(shape)), np.finfo(float).tiny),
    )


def _read_map(values: Array, places: Array) -> Array:
    """Return a map ``(n, n)`` over the square around the unit disc, at places ``(n_points, 2)``."""
    if values.ndim != 2 or values.shape[0] != values.shape[1]:
        raise ModelError(f"shape: found a map of {values.shape}; expected a square one")
    pixels = (np.arange(len(values)) + 0.5) / len(values) * 2.0 - 1.0
    inside = np.clip(places[:, ::-1], pixels[0], pixels[-1])
    return np.asarray(scipy.interpolate.RegularGridInterpolator((pixels, pixels), values)(inside))


MAX_SLOPE = 0.7
"""Largest reference slope in any seeing. A slope of a pyramid cannot exceed 1."""

SAFE_SLOPE = 0.12
"""Largest reference slope where the sensor's coherence is lower than ``LEAST_COHERENCE``."""

LEAST_COHERENCE = 0.2
SLOPE_PER_COHERENCE = 2.5
"""Largest reference slope above ``SAFE_SLOPE``: ``2.5 (coherence - 0.2)`` in the worst seeing.

A loop without a shape needs most of the sensor's range in strong turbulence: it is lost by an
excursion after which the references hold so much that the response falls further. Measured on the
simulated diffractive telescope (docs/results/references.md): loops of 3 m that were lost by a shape
had reference slopes from 0.39 on at a coherence of 0.25, in an earlier sweep from 0.22 on, and from
0.70 on at 0.42. With less, one of 40 is lost, as without a shape. Neither the optical gain nor the
mean response to the shape explains this.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeLimit:
    """Verdict on the size of a shape."""

    accepted: bool
    """True if the loop keeps this shape when the seeing becomes the worst one within a second."""

    largest_m: float
    """RMS over the pupil of the largest multiple of this shape that is accepted, metres OPD."""

    reason: str
    """Sentence with the numbers."""


def limit_shape(
    instrument: Instrument,
    basis: Basis,
    coefficients_m: NDArray[Any],
    *,
    optical_gain: NDArray[Any],
    n_controlled: int,
    worst_seeing_arcsec: float,
) -> ShapeLimit:
    """Return whether a loop that holds a shape survives the worst seeing with fixed references.

    Parameters
    ----------
    instrument, basis
        The sensor, and the modes of the mirror.
    coefficients_m
        The shape ``(n_modes,)``, metres OPD.
    optical_gain
        Present gains of its modes ``(n_modes,)``, with which the references are computed.
    n_controlled
        Number of modes that the loop controls.
    worst_seeing_arcsec
        Seeing to survive, full width at half maximum at 500 nm.

    Raises
    ------
    ModelError
        If a number is not finite or not positive where it has to be.
    """
    held = holding_gain(optical_gain) * _check_shape(coefficients_m)
    rms_m = float(np.linalg.norm(coefficients_m))
    if not worst_seeing_arcsec > 0.0:
        raise ModelError(
            f"shape: found a worst seeing of {worst_seeing_arcsec} arcsec; expected more than 0"
        )
    at_work = kind_of(instrument).working_point(
        instrument,
        n_controlled=n_controlled,
        r0_m=SEEING_COEFFICIENT * REFERENCE_WAVELENGTH_M / np.deg2rad(worst_seeing_arcsec / 3600.0),
        sampling=_SAMPLING * instrument.binning,
    )
    if at_work is None or rms_m == 0.0:
        return ShapeLimit(
            accepted=True,
            largest_m=np.inf,
            reason="no limit: the sensor responds to every size alike, or the shape is flat",
        )
    # The references as the only mode of a basis: one column of the matrix is enough.
    one = basis.combine_modes(held[:, None])
    model = InteractionModel(instrument, one, pupil_sampling=_SAMPLING)
    peak = float(np.abs(model.interaction_matrix(instrument.start)).max())
    allowed = SLOPE_PER_COHERENCE * (at_work.coherence - LEAST_COHERENCE)
    largest_m = rms_m * float(np.clip(allowed, SAFE_SLOPE, MAX_SLOPE)) / peak
    return ShapeLimit(
        accepted=rms_m <= largest_m,
        largest_m=largest_m,
        reason=(
            f"found a shape of {rms_m * 1e9:.0f} nm RMS; the loop survives a seeing of "
            f"{worst_seeing_arcsec:.1f} arcsec with at most {largest_m * 1e9:.0f} nm of it"
        ),
    )
