"""Predict the interaction matrix and the achievable precision of an instrument."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.files.disk_cache import cached_basis
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.interaction import Linearisation, RtcInteractionModel
from service.model.misregistration import Misregistration


def interaction_matrix(
    instrument: Instrument | str | Path, alpha: Misregistration | None = None
) -> NDArray[np.float32]:
    """Return the noise-free D(α) of an instrument, ``(n_slopes, n_modes)`` slope per metre of OPD.

    ``instrument`` is what ``load_instrument`` returns or takes.
    Rows are in the order of the RTC's slopes. Without ``alpha`` the registration is perfect. The
    modes are cached on disk (in ``$PYRCAL_SERVICE__CACHE_DIR``, or ``~/.cache/pyrcal``); many
    matrices of one instrument are quickest with one ``RtcInteractionModel``.

    Raises
    ------
    ModelError
        If the optical model cannot work with the instrument.

    References
    ----------
    Heritier et al. 2018, equation 1: D = M_WFS M_DM.
    """
    if not isinstance(instrument, Instrument):
        instrument = load_instrument(instrument)
    model = RtcInteractionModel(instrument, cached_basis(instrument))
    return np.asarray(model.interaction_matrix(alpha or Misregistration()), np.float32)


def dither_sigma(
    near: Linearisation,
    modes: Sequence[int],
    amplitude_m: float,
    n_frames: int,
    slope_noise: float,
) -> NDArray[np.float64]:
    """Return ``(4,)`` 1 σ of α from sines on several modes at once, measurement noise only.

    Units: subapertures, subapertures, radians, magnification. Each mode is dithered by a sine of
    ``amplitude_m`` (RMS, metres of OPD) over ``n_frames`` frames, all at different frequencies;
    slopes have white noise of ``slope_noise`` RMS per frame. The gain of each mode is fitted as
    well, so changes that look like a gain do not contribute to α. Turbulence at the dither
    frequencies and errors of the model are not included.

    A column of D from such a sine has an error of σ_slope / (a √N) in every slope. With J the
    derivatives of the columns, less their projection on the columns themselves, the covariance of α
    is that error squared times (Σ JᵀJ)⁻¹.

    Raises
    ------
    ModelError
        If a mode is not one of the linearisation's, or a number is not above 0.
    """
    n_modes = near.matrix.shape[1]
    wrong = [mode for mode in modes if not 0 <= mode < n_modes]
    if wrong or not len(modes):
        raise ModelError(f"modes: found {wrong or 'none'}, expected some of 0 to {n_modes - 1}")
    if min(amplitude_m, n_frames, slope_noise) <= 0.0:
        raise ModelError(
            f"found an amplitude of {amplitude_m:g} m, {n_frames} frames, a noise of "
            f"{slope_noise:g}; expected numbers above 0"
        )
    information = np.zeros((4, 4))
    for mode in modes:
        column = near.matrix[:, mode].astype(np.float64)
        column /= np.linalg.norm(column)
        rates = near.derivatives[:, :, mode].astype(np.float64)
        # The gain of each mode is free, so a change along the column says nothing about α.
        rates -= np.outer(rates @ column, column)
        information += rates @ rates.T
    error = slope_noise / (amplitude_m * np.sqrt(n_frames))
    return np.asarray(error * np.sqrt(np.diag(np.linalg.inv(information))))
