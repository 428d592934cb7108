"""The modulated pyramid as textbooks draw it: the slow reference the fast model is held against.

Pupil field, zero padding, Fourier transform, four-face phase mask, and back to the detector, for
every point of the modulation. The mask is the product of a roof in y and one in x, so all this is a
matrix on either axis of the field. It shares nothing with ``service.model`` but the conventions:
arrays are ``[y, x]``, lengths in subapertures, frequencies in cycles per subaperture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from typing_extensions import override

Paths = list[tuple[NDArray[np.complex128], NDArray[np.complex128]]]
"""Of y and of x, ``(n_detector, n)``."""


def slopes_of(images: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return ``[all Sx; all Sy]`` of four pupil images ``(2, n, 2, n)``, over their mean flux."""
    flux = images.sum(axis=(0, 2))[valid].mean()
    across_x = (images[:, :, 0] - images[:, :, 1]).sum(axis=0)
    across_y = (images[0] - images[1]).sum(axis=1)
    return np.asarray(np.concatenate([across_x[valid], across_y[valid]]) / flux)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FftPyramid:
    """A pyramid sensor behind a pupil of given illumination."""

    amplitude: NDArray[np.float64]
    """``(n, n)`` amplitude of the pupil field, grey at the edge; both axes are ``coordinates``."""

    sampling: int
    """Pupil points per subaperture."""

    wavelength_m: float
    """Sensing wavelength, metres."""

    n_subapertures: int = 30
    """Subapertures across the pupil."""

    image_separation_subap: float = 36.0
    """Distance between the centres of neighbouring pupil images."""

    modulation_lambda_over_d: float = 3.0
    """Radius of the modulation circle."""

    n_modulation: int = 28
    """Points on the circle."""

    n_nodes: int = 2
    """Gauss-Legendre nodes per axis in a subaperture."""

    padded_subap: int = 160
    """Width of the zero-padded pupil plane: what leaves it on one side comes back on the other."""

    def images(
        self, opd_m: NDArray[np.float64], shift: tuple[float, float] = (0.0, 0.0)
    ) -> NDArray[np.float64]:
        """Return the four pupil images, ``(2, n, 2, n)``: side and row in y, side and column in x.

        Side 0 is the one at negative detector coordinates. ``shift`` (x, y) moves the images.
        """
        return self._images(opd_m, self._paths(shift))

    def _images(self, opd_m: NDArray[np.float64], paths: Paths) -> NDArray[np.float64]:
        field = self.amplitude * np.exp(2j * np.pi * opd_m / self.wavelength_m)
        intensity = sum(np.abs(on_y @ field @ on_x.T) ** 2 for on_y, on_x in paths)
        _, weights = np.polynomial.legendre.leggauss(self.n_nodes)
        weights = weights / 2
        n, nd = self.n_subapertures, self.n_nodes
        nodes = intensity.reshape(2, n, nd, 2, n, nd) / self.n_modulation
        return np.asarray(np.einsum("iyaJxb,a,b->iyJx", nodes, weights, weights))

    def slopes(
        self,
        opd_m: NDArray[np.float64],
        valid: NDArray[np.bool_],
        shift: tuple[float, float] = (0.0, 0.0),
    ) -> NDArray[np.float64]:
        """Return ``[all Sx; all Sy]`` of the valid subapertures, over their mean flux."""
        return self._slopes(opd_m, valid, self._paths(shift))

    def _slopes(
        self, opd_m: NDArray[np.float64], valid: NDArray[np.bool_], paths: Paths
    ) -> NDArray[np.float64]:
        return slopes_of(self._images(opd_m, paths), valid)

    def jacobian(
        self,
        opds: NDArray[np.float64],
        valid: NDArray[np.bool_],
        shift: tuple[float, float] = (0.0, 0.0),
        stroke_m: float = 1e-9,
    ) -> NDArray[np.float64]:
        """Return slopes per metre ``(n_slopes, n_maps)`` of OPD maps ``(n_maps, n, n)``, push-pull.

        The stroke must be small: 1e-8 m is already 0.2-0.6 % non-linear.
        """
        paths = self._paths(shift)
        columns = [
            (
                self._slopes(stroke_m * opd, valid, paths)
                - self._slopes(-stroke_m * opd, valid, paths)
            )
            / (2 * stroke_m)
            for opd in opds
        ]
        return np.stack(columns, axis=1)

    @property
    def coordinates(self) -> NDArray[np.float64]:
        """``(n,)`` pupil coordinates along either axis."""
        n = len(self.amplitude)
        return (np.arange(n) - (n - 1) / 2) / self.sampling

    @property
    def _frequencies(self) -> NDArray[np.float64]:
        n = self.sampling * self.padded_subap
        return np.fft.fftfreq(n, d=1 / self.sampling).astype(np.float64)

    def roof(self) -> NDArray[np.complex128]:
        """Each side tilts its half of the light by half the image separation."""
        tilted = np.exp(1j * np.pi * self.image_separation_subap * np.abs(self._frequencies))
        return tilted.astype(np.complex128)

    def _paths(self, shift: tuple[float, float]) -> Paths:
        """Return, for every point of the modulation, what leads a pupil axis to the detector's."""
        n_padded = self.sampling * self.padded_subap
        focus = scipy.fft.fft(np.eye(len(self.amplitude)), n=n_padded, axis=0)
        to_focus = self.roof()[:, None] * focus
        seen_y = self._detector_transform(shift[1]) @ to_focus
        seen_x = self._detector_transform(shift[0]) @ to_focus
        u = 2j * np.pi * self.coordinates / self.n_subapertures
        return [(seen_y * np.exp(u * y), seen_x * np.exp(u * x)) for x, y in self.modulation()]

    def modulation(self) -> NDArray[np.float64]:
        """Return the points of the modulation ``(n_modulation, 2)``, x and y in λ/D."""
        angle = 2 * np.pi * (np.arange(self.n_modulation) + 0.5) / self.n_modulation
        return self.modulation_lambda_over_d * np.column_stack([np.cos(angle), np.sin(angle)])

    def _detector_transform(self, shift: float) -> NDArray[np.complex128]:
        """Inverse Fourier sum at the detector points of one axis."""
        nodes, _ = np.polynomial.legendre.leggauss(self.n_nodes)
        side = np.array([-0.5, 0.5]) * self.image_separation_subap
        centre = np.arange(self.n_subapertures) - (self.n_subapertures - 1) / 2
        x = (side[:, None, None] + centre[:, None] + nodes / 2 - shift).ravel()
        nu = self._frequencies
        start = self.coordinates[0]  # the transform takes the first pupil point for the origin
        transform = np.exp(2j * np.pi * np.outer(x - start, nu)) / len(nu)
        return transform.astype(np.complex128)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DisplacedPyramid(FftPyramid):
    """The same, each of its four images seen at a place of its own beside the pixel grid."""

    offsets: NDArray[np.float64]
    """``(2, 2, 2)`` displacement of the images, subapertures: side along y, along x, (x, y)."""

    @override
    def _paths(self, shift: tuple[float, float]) -> Any:
        moved = self.offsets + shift
        return [[super(DisplacedPyramid, self)._paths(tuple(at)) for at in row] for row in moved]

    @override
    def _images(self, opd_m: NDArray[np.float64], paths: Any) -> NDArray[np.float64]:
        n = self.n_subapertures
        images = np.empty((2, n, 2, n))
        for y, x in np.ndindex(2, 2):
            images[y, :, x] = super(DisplacedPyramid, self)._images(opd_m, paths[y][x])[y, :, x]
        return images


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EllipticPyramid(FftPyramid):
    """The same, modulated on an ellipse."""

    axes_lambda_over_d: tuple[float, float]
    """Semi-axes."""

    angle_deg: float
    """Direction of the first one, from +x towards +y."""

    @override
    def modulation(self) -> NDArray[np.float64]:
        t = 2 * np.pi * np.arange(self.n_modulation) / self.n_modulation
        first, second = self.axes_lambda_over_d
        turned = np.exp(1j * np.deg2rad(self.angle_deg))
        path = turned * (first * np.cos(t) + 1j * second * np.sin(t))
        return np.column_stack([path.real, path.imag])
