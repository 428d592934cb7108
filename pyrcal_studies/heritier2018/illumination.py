"""Reconstructors of a synthetic matrix with less signal, noise or displaced pupil images.

The paper sees parts of the pupil that gather less signal (figure 10): the bottom left part, the
central obscuration and what is behind the spiders of the retro-reflector. Here the slopes of those
subapertures are made smaller in the synthetic matrix before it is inverted, so that their cost in
the simulated loop of section 4.4 is known feature by feature.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import telescope
from pyrcal_studies.heritier2018.reconstructors import synthetic_matrix
from pyrcal_studies.heritier2018.registration import FitRun, fitted_alpha
from pyrcal_studies.heritier2018.store import Record, Store, Task
from service.control.reconstructor import invert
from service.model.pupil import valid_subapertures
from service.model.sensors.registry import kind_of

Array = NDArray[np.float64]

_BLOB_RADIUS = 6.0
_BLOB_CENTRE = (-7.0, -7.0)
_RIM_SUBAP = 2.5
"""Width of the ring about the central obscuration, in subapertures."""

_SPIDER_SUBAP = 1.0
"""Half-width of the strip behind a spider, in subapertures."""

_NOISE_SEED = 4


class Feature(StrEnum):
    """Parts of the pupil that gather less signal, as in figure 10."""

    NONE = "none"
    BOTTOM_LEFT = "bottom left"
    OBSCURATION = "about the central obscuration"
    SPIDERS = "behind the spiders"
    ALL = "all three"


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What is done to a synthetic matrix."""

    feature: Feature = Feature.NONE
    depth: float = 0.0
    """Share of the signal that is missing there, 0..1."""

    noise: float = 0.0
    """RMS of the noise over that of each column."""

    displaced_images: float = 0.0
    """RMS displacement of the four pupil images from their common place, subapertures."""


def missing(feature: Feature) -> Array:
    """Return ``(n_valid,)``, 1 where all of the signal may be missing and 0 where none is."""
    valid = valid_subapertures(telescope.instrument())
    n = len(valid)
    y, x = np.mgrid[:n, :n][:, valid] - (n - 1) / 2
    blob = np.exp(-((x - _BLOB_CENTRE[0]) ** 2 + (y - _BLOB_CENTRE[1]) ** 2) / _BLOB_RADIUS**2)
    hole = telescope.instrument().wfs.pupil_diameter / 2 * telescope.instrument().obscuration_ratio
    rim = np.exp(-np.maximum(np.hypot(x, y) - hole, 0.0) / _RIM_SUBAP)
    arms = np.exp(-((np.minimum(np.abs(x - y), np.abs(x + y)) / np.sqrt(2.0) / _SPIDER_SUBAP) ** 2))
    maps = {Feature.BOTTOM_LEFT: blob, Feature.OBSCURATION: rim, Feature.SPIDERS: arms}
    if feature is Feature.ALL:
        return np.asarray(np.max(list(maps.values()), axis=0))
    return np.asarray(maps.get(feature, np.zeros_like(blob)))


def image_offsets(rms_subap: float, rng: np.random.Generator) -> Array:
    """Return random displacements ``(8,)`` of four pupil images, along x then along y.

    Their mean is zero in both directions: a common displacement is a shift of the registration.
    """
    offsets = rng.standard_normal((2, 4))
    offsets -= offsets.mean(axis=1, keepdims=True)
    return np.asarray((offsets * rms_subap / np.sqrt(np.mean(offsets**2))).ravel())


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangedReconstructor:
    """Inverse of the changed synthetic matrix."""

    fit: FitRun
    n_modes: int
    change: Change

    @property
    def passes(self) -> int:
        """How often the light meets the mirror."""
        return 1

    @property
    def needs(self) -> tuple[Task, ...]:
        """The fit."""
        return (self.fit,)

    def compute(self, store: Store) -> Record:
        """Return ``matrix`` ``(n_modes, n_slopes)``."""
        rng = np.random.default_rng(_NOISE_SEED)
        alpha, instrument = fitted_alpha(store.read(self.fit)), telescope.instrument()
        if self.change.displaced_images:
            offsets = image_offsets(self.change.displaced_images, rng)
            displaced = kind_of(instrument).displace_images(instrument, offsets)
            instrument = replace(instrument, wfs=displaced)
        matrix = synthetic_matrix(alpha, instrument)[:, : self.n_modes]
        kept = 1.0 - self.change.depth * missing(self.change.feature)
        matrix = matrix * np.tile(kept, 2)[:, None]
        scatter = self.change.noise * np.sqrt(np.mean(matrix**2, axis=0))
        matrix = matrix + scatter * rng.standard_normal(matrix.shape)
        return {"matrix": invert(matrix, self.n_modes).matrix}
