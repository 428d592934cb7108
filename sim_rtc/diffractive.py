"""The pyramid as light makes it: the whole field, the whole phase, frame by frame.

No FFT: the four-face pyramid's transmission is separable, so the field on the detector is
``Wy X Wx^T`` with ``X = A exp(iφ) exp(i k u)`` the modulated pupil field and W the one-dimensional
roof operator. The pupil images move by the shift, to any part of a subaperture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.model.instrument import Instrument, Pyramid
from service.model.pupil import PupilGrid

Array = NDArray[Any]

_EDGE_SAMPLES = 16
"""Samples across a cell of the pupil: its light is good to about 1e-3 of a cell."""

_SIDES = np.array([-1.0, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Quadrature:
    """How finely the sensor is computed."""

    n_nodes: int = 2
    """Gauss-Legendre nodes per axis in a subaperture."""

    n_modulation: int = 24
    """Points on the modulation circle, even; 24 leave an error of 2e-3 on tip at 3 λ/D."""

    dtype: type[np.complex64] | type[np.complex128] = np.complex64
    """Precision of the fields."""

    def __post_init__(self) -> None:
        """Refuse a modulation whose points do not pair up.

        Raises
        ------
        ModelError
            If the number of modulation points is odd or not positive.
        """
        if self.n_modulation < 2 or self.n_modulation % 2:
            raise ModelError(
                f"pyramid: found {self.n_modulation} modulation points; expected an even number"
            )


class DiffractivePyramid:
    """The light on the four pupil images for any wavefront, at one shift of the images.

    Not for two threads at once: its fields are computed in place.
    """

    def __init__(
        self,
        wfs: Pyramid,
        pupil: PupilGrid,
        shift_subap: tuple[float, float] = (0.0, 0.0),
        quadrature: Quadrature | None = None,
    ) -> None:
        self._wfs, self._pupil = wfs, pupil
        self.shift_subap = shift_subap
        """(x, y) by which the images are moved."""

        self._quadrature = quadrature or Quadrature()
        dtype = self._quadrature.dtype
        n_u = len(pupil.coordinates)
        roof_y, roof_x = self._roof(shift_subap[1]), self._roof(shift_subap[0])
        tilt_y, tilt_x = self._tilts()
        # Points of the modulation that share their y component share the first product.
        left = (tilt_y[:, None] * roof_y).reshape(-1, n_u)
        right = (tilt_x[:, :, None] * roof_x).reshape(len(tilt_x), -1, n_u).transpose(0, 2, 1)
        self._left: Array = left.astype(dtype)
        self._right: Array = np.ascontiguousarray(right, dtype)
        self._field = np.zeros((n_u, n_u), dtype)
        self._by_row = np.empty((len(self._left), n_u), dtype)
        self._light = np.empty((len(tilt_y), len(roof_y), 2 * len(roof_x)), dtype)
        real = np.empty(0, dtype).real.dtype
        self._lit = np.flatnonzero(pupil.lit)
        self._amplitude = pupil.amplitude[pupil.lit].astype(real)
        self._wavenumber = real.type(2 * np.pi / wfs.wavelength_m)

    def at(self, shift_subap: tuple[float, float]) -> DiffractivePyramid:
        """Return the same sensor with its images elsewhere."""
        return DiffractivePyramid(self._wfs, self._pupil, shift_subap, self._quadrature)

    def images(self, opd_m: Array) -> Array:
        """Return the light ``(2, n, 2, n)``: side, row along y, side, column along x.

        ``opd_m`` is ``(n_points,)``, at the lit points of the pupil. The unit is the light of a
        fully lit subaperture of the pupil.
        """
        phase = self._wavenumber * opd_m.astype(self._wavenumber.dtype, copy=False)
        field = self._field.reshape(-1)
        field.real[self._lit] = self._amplitude * np.cos(phase)
        field.imag[self._lit] = self._amplitude * np.sin(phase)
        np.matmul(self._left, self._field, out=self._by_row)
        n_pairs, n_y, _ = self._light.shape
        np.matmul(self._by_row.reshape(n_pairs, n_y, -1), self._right, out=self._light)
        parts = self._light.view(self._amplitude.dtype)
        power = np.einsum("mij,mij->ij", parts, parts)
        n, nodes = self._wfs.n_subapertures, self._quadrature.n_nodes
        # Rows: side, subaperture, node; columns: point of the pair, side, subaperture, node, part.
        by_node = power.reshape(2, n, nodes, 2, 2, n, nodes * 2)
        return np.asarray(by_node.sum(axis=(2, 3, 6)))

    def _roof(self, shift_subap: float) -> Array:
        """Return the roof operator along one axis, ``(2 n n_nodes, N)``, its weights included.

        The kernel of one edge is that of a half-plane's transform, cut at the band limit of the
        pupil grid; the light of a subaperture is a Gauss-Legendre sum over its nodes.
        """
        n, half = self._wfs.n_subapertures, self._wfs.pupil_separation_subap / 2
        offsets, weights = np.polynomial.legendre.leggauss(self._quadrature.n_nodes)
        centres = np.arange(n) - (n - 1) / 2
        x = _SIDES[:, None, None] * half + centres[:, None] + offsets / 2 - shift_subap
        distance = x[..., None] - self._pupil.coordinates
        near, far = ((distance + sign * half) * self._pupil.sampling for sign in (1.0, -1.0))
        kernel = np.sinc(far) + np.sinc(near) + 1j * (_half_plane(near) - _half_plane(far))
        kernel *= 0.5 * np.sqrt(weights / 2)[:, None]
        # Each of M points has 1/M of the light.
        kernel /= np.sqrt(np.sqrt(self._quadrature.n_modulation))
        return np.asarray(kernel.reshape(-1, len(self._pupil.coordinates)))

    def _tilts(self) -> tuple[Array, Array]:
        """Return modulation phasors ``(M/2, N)`` along y and ``(M/2, 2, N)`` along x."""
        n_modulation = self._quadrature.n_modulation
        angle = 2 * np.pi * (np.arange(n_modulation // 2) + 0.5) / n_modulation
        radius = 2 * np.pi * self._wfs.modulation_lambda_over_d / self._wfs.pupil_diameter
        u = self._pupil.coordinates
        along_y = np.exp(1j * radius * np.cos(angle)[:, None] * u)
        along_x = np.exp(1j * radius * np.sin(angle)[:, None, None] * _SIDES[:, None] * u)
        return along_y, along_x


def centred_pupil(instrument: Instrument, sampling: int) -> PupilGrid:
    """Return the pupil on an odd grid, with a point at its centre.

    The service's grids are even: half a point away. A cell's amplitude is the fraction of its area
    inside the annulus, by counting.
    """
    radius = instrument.wfs.pupil_diameter / 2
    n = 2 * int(np.ceil(sampling * max(radius, instrument.wfs.n_subapertures / 2))) + 1
    coordinates = (np.arange(n) - (n - 1) / 2) / sampling
    inside = ((np.arange(_EDGE_SAMPLES) + 0.5) / _EDGE_SAMPLES - 0.5) / sampling
    fine = (coordinates[:, None] + inside).reshape(-1)
    squared = fine[:, None] ** 2 + fine**2
    lit = (squared <= radius**2) & (squared >= (radius * instrument.obscuration_ratio) ** 2)
    amplitude = lit.reshape(n, _EDGE_SAMPLES, n, _EDGE_SAMPLES).mean(axis=(1, 3))
    return PupilGrid(sampling=sampling, coordinates=coordinates, amplitude=amplitude)


def _half_plane(n: Array) -> Array:
    """Return ``(1 - cos πn) / (πn)``, 0 at 0: the transform of a sign, cut at the band limit."""
    return np.asarray(np.sinc(n / 2) * np.sin(np.pi * n / 2))
