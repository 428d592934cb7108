"""The last steps of a fit: a regularised least-squares solution on the fine grid.

Besides the registration, nuisance parameters are fitted linearly: each adds one derivative to the
projection and has a prior of its own. A rotation of the slope axes is always among them. Without
it, a pyramid whose edges are rotated by one degree would rotate the registration by 0.007 deg with
400 modes, and by 0.06 deg with the lowest 40.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.models import FitModels, Optic
from service.estimation.solver import (
    MAX_STEP,
    SETTLED_STEP,
    Columns,
    Projection,
    within_limits,
)
from service.model.interaction import InteractionModel
from service.model.kinds import SignalKind, Stop
from service.model.misregistration import Misregistration
from service.model.slopes import signals_of_slopes, slopes_of

Array = NDArray[np.float64]

MAX_NEAR_STEPS = 6

SLOPE_TURN_SIGMA_RAD = np.deg2rad(1.5)
"""Prior 1 σ of the rotation of the slope axes, rad: a pyramid is aligned to the pixels within a
degree or two."""

GAIN_MAP_ORDER = 4
"""Order of the polynomial in x and y that describes the gain over the pupil."""

GAIN_MAP_SIGMA = 0.3
"""Prior 1 σ of each coefficient of the gain map."""

ANAMORPHOSIS_SIGMA = 0.02
"""Prior 1 σ of each stretch: half the relative difference of the image scales along two axes."""

STRETCHES = slice(1, 3)
"""Indices of the two stretches among the nuisances, if they are unknown: after the axes' rotation.
"""

LONGEST_STRETCH = 0.03
"""Longest step of a stretch: 0.45 subapertures at the edge of 30. The derivatives hold no further.
"""

SETTLED_STRETCH = 1e-5
"""Step of a stretch below which the fit has converged: 1.5e-4 subapertures at the edge of 30."""

LINEAR_STEP = np.array([0.02, 0.02, np.deg2rad(0.1), 4e-3])
"""Step below which the coarse model is extrapolated with its derivatives (numeric units). The
error, some percent of the step, is that of a start for the fine grid."""

FINE_LINEAR_STEP = np.array([5e-4, 5e-4, np.deg2rad(2e-3), 2e-4])
"""The same limit for the fine model, whose last step is then extrapolated. Derivatives of the
coarse model are wrong by 1 %: the error is less than a twentieth of the smallest sigma of a fit."""

LINEAR_STRETCH, FINE_LINEAR_STRETCH = 4e-3, 2e-4
"""The same limits for a stretch."""

STRETCH_FLOOR = 1e-4
"""Smallest 1 σ of an anamorphosis; the same floor as the magnification's: both are image scales."""

NOMINAL = Misregistration()

OPTIC_SIGMA = {Optic.WIDTH: 0.25, Optic.SENSOR: 0.5}
"""Prior 1 σ of the logarithm of a value that the instrument file states: a coupling of 0.35 might
be 0.18 or 0.53."""

UNKNOWN_SIGMA = 1.0
"""Prior 1 σ of the logarithm of a value that the instrument file marks as unknown."""

N_SECTORS, N_RINGS = 12, 3
"""Numbers of sectors and of rings of equal area that the regions of the pupil are made of."""

LONGEST_OPTIC_STEP = 0.4
"""Longest step of such a logarithm; the derivatives hold no further."""


def image_patterns(stop: Stop) -> Array:
    """Return orthonormal displacements of the four images ``(n_patterns, 8)``.

    The eight components are displacements along x of the images at -x -y, +x -y, -x +y, +x +y, then
    along y. With the mirror as stop there are six patterns of zero mean, because a common
    displacement is the shift of α. With the telescope as stop, two more patterns displace all
    images together: α is then the mirror's position on the grid, and the pupil may be displaced
    independently.
    """
    # Signs follow x, y and x y of the images, and the last row moves all alike, so the patterns are
    # orthogonal.
    along = np.array([[-1, 1, -1, 1], [-1, -1, 1, 1], [1, -1, -1, 1], [1, 1, 1, 1]]) / 2.0
    both: Array = np.kron(np.eye(2), along).astype(np.float64)  # patterns along x, then along y
    return both if stop is Stop.TELESCOPE else both[[0, 1, 2, 4, 5, 6]]


def is_blurring(pattern: Array) -> bool:
    """Return True if a pattern of ``image_patterns`` has no first-order effect on slopes.

    Images that are stretched apart or sheared only blur the slopes. A quadrupole along one axis
    looks like a shift along the other axis to one of the slope components, so it can be measured.
    """
    along_x, along_y = pattern.reshape(2, 2, 2)
    # A blur moves opposite images in opposite directions, so their sum is 0.
    even = np.abs(along_x + along_x[::-1, ::-1]) + np.abs(along_y + along_y[::-1, ::-1])
    return bool(np.all(even < 1e-9))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Nuisances:
    """Unknowns fitted together with the registration, in a fixed order."""

    regions: NDArray[np.intp]
    """``(n_slopes,)`` region of the pupil of each slope."""

    maps: Array
    """``(n_maps, n_slopes)`` gain over the pupil of each coefficient of the gain map."""

    anamorphosis: bool
    """True if the two stretches are unknown."""

    nominal: Array = field(default_factory=lambda: np.zeros(2))
    """``(2,)`` expected stretches."""

    optics: tuple[tuple[Optic, float], ...] = ()
    """Unknown optical quantities, each with the offset of the current models from the instrument
    file, as a logarithm; the prior refers to the file."""

    unknown: frozenset[Optic] = frozenset()
    """Optical quantities that the instrument file marks as unknown."""

    images: Array = field(default_factory=lambda: np.zeros((0, 8)))
    """``(n_patterns, 8)`` unknown displacements of the pupil images, see ``image_patterns``."""

    image_sigma: float = 0.0
    """Prior 1 σ of each displacement pattern, subapertures."""

    displaced: Array = field(default_factory=lambda: np.zeros(8))
    """``(8,)`` displacements of the images already included in the models, subapertures."""

    expected: Array = field(default_factory=lambda: np.zeros(8))
    """``(8,)`` the same that the prior expects."""

    @property
    def sigma(self) -> Array:
        """``(n_nuisances,)`` prior 1 σ of each nuisance."""
        stretches = [ANAMORPHOSIS_SIGMA] * (2 if self.anamorphosis else 0)
        optics = [
            UNKNOWN_SIGMA if optic in self.unknown else OPTIC_SIGMA[optic]
            for optic, _ in self.optics
        ]
        maps = [GAIN_MAP_SIGMA] * len(self.maps)
        images = [self.image_sigma] * len(self.images)
        return np.array([SLOPE_TURN_SIGMA_RAD, *stretches, *optics, *images, *maps])

    @property
    def first_optic(self) -> int:
        """Index of the first optical quantity among the nuisances."""
        return 3 if self.anamorphosis else 1

    @property
    def image_places(self) -> slice:
        """Indices of the image displacements among the nuisances."""
        first = self.first_optic + len(self.optics)
        return slice(first, first + len(self.images))

    def with_sensor_moved(self, change: float) -> Nuisances:
        """Return the same for models whose sensor number is changed, see ``sensor_coordinate``."""
        moved = [(optic, at + change * (optic is Optic.SENSOR)) for optic, at in self.optics]
        return replace(self, optics=tuple(moved))

    def from_prior(self, values: Array) -> Array:
        """Return values ``(n_nuisances,)`` as offsets from their expected values."""
        distance = values.astype(float)
        if self.anamorphosis:
            distance[STRETCHES] -= self.nominal
        for k, (_, offset) in enumerate(self.optics, self.first_optic):
            # The models are updated during a fit, whereas the prior stays at the file's value.
            distance[k] += offset
        # The same for images: the models already contain ``displaced``.
        distance[self.image_places] += self.images @ (self.displaced - self.expected)
        return distance

    def image_offsets(self, values: Array) -> Array:
        """Return the displacements of the pupil images from their nominal positions ``(8,)``.

        In subapertures, in the order of ``image_patterns``.
        """
        return self.displaced + values[self.image_places] @ self.images

    def changes(self, values: Array) -> dict[Optic, float]:
        """Return the logarithm of each optical quantity over its value in the instrument file."""
        distance = self.from_prior(values)
        return {
            optic: float(distance[k]) for k, (optic, _) in enumerate(self.optics, self.first_optic)
        }

    @property
    def prior(self) -> Array:
        """``(4 + n_nuisances,)`` reciprocal variances; the registration itself has no prior."""
        return np.concatenate([np.zeros(4), 1.0 / self.sigma**2])

    def derivatives(
        self,
        models: FitModels,
        alpha: Misregistration,
        matrix: NDArray[Any],
        cheap_matrix: NDArray[Any] | None = None,
        of_stretches: Sequence[Array] | Array = (),
        of_images: Sequence[Array] | Array = (),
    ) -> Array:
        """Return the derivatives of D by each nuisance except the gain map.

        Shape ``(n_nuisances - n_maps, n_slopes, n_modes)``. ``matrix`` is D, ``cheap_matrix``
        that of the coarse grid or None if it is not known. ``of_stretches`` are the derivatives by
        the stretches, if they are unknown, ``of_images`` those by the image displacements, one for
        each pattern.
        """
        kind = models.instrument.slopes.kind
        along_x, along_y = slopes_of(matrix, kind)
        # A small rotation of the axes adds (-Sy, Sx) times the angle to (Sx, Sy).
        turned = signals_of_slopes(np.stack([-along_y, along_x]), kind)
        which = [optic for optic, _ in self.optics]
        optics = models.optics_derivatives(alpha, which, cheap_matrix)
        return np.array([turned, *of_stretches, *optics, *of_images])

    def combine_images(self, apart: Array, of_alpha: Array) -> Array:
        """Return the change with each pattern, of the changes ``(8, ...)`` with each image."""
        rates = np.tensordot(self.images.astype(apart.dtype), apart, axes=1)
        common = self.images.reshape(-1, 2, 4).mean(axis=2)
        # a common displacement moves the pupil; α, the mirror's position on the grid, is unchanged
        rates -= np.tensordot(common.astype(apart.dtype), of_alpha[:2], axes=1)
        return np.asarray(rates)

    def slope_gain(self, values: Array) -> Array:
        """Return the gain ``(n_slopes,)`` that the gain map gives every slope, mean 1."""
        return np.asarray(1.0 + values[len(values) - len(self.maps) :] @ self.maps)

    def gain_map(self, values: Array, valid: NDArray[np.bool_]) -> Array | None:
        """Return the gain over the pupil ``(n, n)``, mean 1; None without a gain map."""
        if not len(self.maps):
            return None
        gain = np.full(valid.shape, np.nan)
        gain[valid] = self.slope_gain(values)[: int(valid.sum())]
        return gain

    def begin(self, start: Misregistration) -> Array:
        """Return their values ``(n_nuisances,)`` before the first step."""
        values = np.zeros(len(self.sigma))
        if self.anamorphosis:
            values[STRETCHES] = start.stretches
        return values

    def at(self, start: Misregistration, vector: Array, values: Array) -> Misregistration:
        """Return the registration of a 4-vector and the stretches among the values."""
        moved = start.with_vector(vector)
        return moved.with_anamorphosis(values[STRETCHES]) if self.anamorphosis else moved

    def stretch_sigma(self, sigma: Array) -> Array | None:
        """Return the ``(2,)`` among 1 σ of all; None when they are not unknown."""
        return np.hypot(sigma[STRETCHES], STRETCH_FLOOR) if self.anamorphosis else None

    def linear(self, values: Array) -> Array:
        """Return ``(n_nuisances - n_maps,)`` values, 0 for those that the model itself applies."""
        rest = values[: len(values) - len(self.maps)].copy()
        if self.anamorphosis:
            # The matrix is computed with the stretches: their derivatives would count them twice.
            rest[STRETCHES] = 0.0
        return rest


def nuisances_of(
    valid: NDArray[np.bool_],
    kind: SignalKind,
    *,
    gain_map: bool = False,
    anamorphosis: bool = False,
    nominal: Misregistration = NOMINAL,
    optics: Sequence[Optic] = (),
    unknown: frozenset[Optic] = frozenset(),
    images: Array | None = None,
    image_sigma: float = 0.0,
    displaced: Array | None = None,
) -> Nuisances:
    """Return the nuisances: the axes' rotation, and the optional ones that were requested."""
    place = np.zeros(8) if displaced is None else displaced
    unknowns = Nuisances(
        maps=np.empty((0, kind.n_planes * int(valid.sum()))),
        anamorphosis=anamorphosis,
        nominal=nominal.stretches,
        optics=tuple((optic, 0.0) for optic in optics),
        unknown=unknown,
        images=np.zeros((0, 8)) if images is None else images,
        image_sigma=image_sigma,
        displaced=place,
        expected=place,
        regions=pupil_regions(valid, kind.n_planes),
    )
    if not gain_map:
        return unknowns
    n = len(valid)
    # About -1 to 1 across the pupil, so that high powers stay comparable with low ones.
    y, x = (np.stack(np.nonzero(valid)) - (n - 1) / 2) / (n / 2)
    order = GAIN_MAP_ORDER
    powers = [x**i * y**j for i in range(order + 1) for j in range(order + 1 - i) if i + j > 0]
    # without their mean, because the free gain of each mode describes a common factor
    centred = np.array(powers) - np.mean(powers, axis=1, keepdims=True)
    # Orthonormal over the subapertures, so that one prior suits all coefficients.
    orthonormal, _ = np.linalg.qr(centred.T)
    maps = np.tile(orthonormal.T * np.sqrt(valid.sum()), kind.n_planes)
    return replace(unknowns, maps=maps)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """Minimum of the fit on one of the grids."""

    alpha: Misregistration
    """Registration. Its anamorphosis keeps its start value if it is not fitted."""

    nuisances: Array
    """``(n_nuisances,)`` values of the nuisances."""

    matrix: NDArray[np.float32]
    """``(n_slopes, n_modes)`` model matrix at the solution."""

    near: Array
    """``(n_unknowns - n_maps, n_slopes, n_modes)`` derivatives of the model at ``near_alpha``,
    before the gain map is applied and without the map's own derivatives."""

    near_alpha: Misregistration
    """Registration at which the derivatives were computed."""

    derivatives: Array
    """``(n_unknowns, n_slopes, n_modes)`` derivatives of the model by the registration, then by the
    nuisances, with the gain map applied, taken nearby."""

    projection: Projection
    dispersion: float
    """Number of dependent slopes that count as one independent slope."""

    converged: bool

    on_fine_grid: bool = True
    """True if the fine model determined the solution."""

    @property
    def vector(self) -> Array:
        """``(4,)`` of α, numeric units."""
        return self.alpha.vector


def refine(
    models: FitModels,
    columns: Columns,
    start: Misregistration,
    nuisances: Nuisances,
    max_steps: int = MAX_NEAR_STEPS,
    *,
    near: Solution | None = None,
    of_images: Array | None = None,
    decides: InteractionModel | None = None,
    fine_below: float = 0.0,
) -> Solution:
    """Return the minimum on the fine grid, with derivatives frozen on a coarser one.

    Near the minimum an error of the derivatives only slows convergence: the minimum depends on the
    residual, which is computed on the fine grid.

    Parameters
    ----------
    models, columns, start, nuisances
        Models of the instrument, measured columns, start of the registration, other unknowns.
    max_steps
        Largest number of steps.
    near
        Nearby solution whose derivatives are used; None if they are to be computed.
    of_images
        Derivatives by the image displacements only, of a nearby solution; None to compute them.
    decides
        Model of the residual that is minimised; None for the fine one.
    fine_below
        RMS residual share of the signal below which the fine model decides instead of the coarse
        one, after a step within which the model is linear.
    """
    vector, values = start.vector, nuisances.begin(start)
    decides = models.fine if decides is None else decides
    matrix = models.matrix(decides, start)
    near_alpha = start if near is None else near.near_alpha
    rates = (
        _compute_derivatives(
            models,
            start,
            matrix,
            nuisances,
            of_images,
            on_coarse_grid=decides is models.cheap,
        )
        if near is None
        else near.near
    )
    seen, every = _project_columns(columns, matrix, rates, values, nuisances)
    regions = nuisances.regions[columns.rows]
    counts = dispersion(seen, regions)
    # The matrix is computed again for these unknowns only; all others act by their derivatives.
    moving, settled, converged = np.arange(4), SETTLED_STEP, False
    coarse_linear, fine_linear = LINEAR_STEP, FINE_LINEAR_STEP
    if nuisances.anamorphosis:
        moving = np.append(moving, 4 + np.arange(STRETCHES.start, STRETCHES.stop))
        settled = np.append(settled, [SETTLED_STRETCH] * 2)
        coarse_linear = np.append(coarse_linear, [LINEAR_STRETCH] * 2)
        fine_linear = np.append(fine_linear, [FINE_LINEAR_STRETCH] * 2)
    step = _limit_step(seen, values, nuisances, counts)
    for _ in range(max_steps):
        # The last point inside the limits is kept, and the fit counts as not converged.
        if not within_limits(vector + step[:4]):
            break
        vector, values = vector + step[:4], values + step[4:]
        on_coarse_grid = decides is models.cheap
        linear = bool(
            np.all(np.abs(step[moving]) < (coarse_linear if on_coarse_grid else fine_linear))
        )
        if on_coarse_grid and linear and _expected_share(seen, columns) < fine_below:
            # A change of grid needs a matrix of its own, however short the step was.
            decides, linear = models.fine, False
        if linear:
            matrix = matrix + sum(step[k].astype(rates.dtype) * rates[k] for k in moving)
        else:
            matrix = models.matrix(decides, nuisances.at(start, vector, values))
        seen, every = _project_columns(columns, matrix, rates, values, nuisances)
        counts = dispersion(seen, regions)
        step = _limit_step(seen, values, nuisances, counts)
        if np.all(np.abs(step[moving]) < settled):
            converged = True
            break
    return Solution(
        alpha=nuisances.at(start, vector, values),
        nuisances=values,
        matrix=matrix,
        near=rates,
        near_alpha=near_alpha,
        derivatives=every,
        projection=seen,
        dispersion=counts,
        converged=converged,
        on_fine_grid=decides is not models.cheap,
    )


def _expected_share(seen: Projection, columns: Columns) -> float:
    """Return the RMS share of the signal that the next step leaves over, to first order."""
    power = np.sum(columns.matrix[columns.rows] ** 2, axis=0)
    return float(np.sqrt(max(seen.chi_at_best, 0.0) / (power @ columns.weights)))


def _compute_derivatives(
    models: FitModels,
    alpha: Misregistration,
    matrix: NDArray[Any],
    nuisances: Nuisances,
    of_images: Array | None,
    *,
    on_coarse_grid: bool,
) -> Array:
    """Return the derivatives by α and each nuisance except the gain map, ``Solution.near``.

    ``on_coarse_grid``: ``matrix`` is D of the coarse model.
    """
    model, stretched = models.cheap, nuisances.anamorphosis
    models.counter.n += 6 if stretched else 4
    if of_images is not None or not len(nuisances.images):
        moved = model.derivatives(alpha, with_stretches=stretched)
    else:
        models.counter.n += 2
        apart = model.image_derivatives(alpha)
        moved = model.derivatives(alpha, apart, with_stretches=stretched)
        of_images = nuisances.combine_images(apart, moved)
    of_nuisances = nuisances.derivatives(
        models,
        alpha,
        matrix,
        matrix if on_coarse_grid else None,
        moved[4:],
        () if of_images is None else of_images,
    )
    return np.concatenate([moved[:4], of_nuisances])


def _project_columns(
    columns: Columns,
    matrix: NDArray[np.float32],
    near: Array,
    values: Array,
    nuisances: Nuisances,
) -> tuple[Projection, Array]:
    """Return the projection of the measurement on D and nuisances, and the derivatives used.

    The gain map multiplies the current D and its derivatives. When it multiplied D of the start
    instead, a gain of 30 % left an error of 30 % of the distance from start to solution.

    Parameters
    ----------
    columns
        The measurement.
    matrix
        ``(n_slopes, n_modes)`` D at the registration.
    near
        ``(n_unknowns - n_maps, n_slopes, n_modes)`` derivatives, the gain map's left out.
    values
        ``(n_nuisances,)`` of the nuisances.
    nuisances
        What they are.
    """
    model = matrix + np.tensordot(nuisances.linear(values).astype(near.dtype), near[4:], axes=1)
    if not len(nuisances.maps):
        return columns.project(model, near, np.float32), near
    gain = nuisances.slope_gain(values)[:, None].astype(near.dtype)
    every = np.empty((len(near) + len(nuisances.maps), *model.shape), near.dtype)
    np.multiply(near, gain, out=every[: len(near)])
    np.multiply(nuisances.maps[:, :, None], model, out=every[len(near) :], casting="same_kind")
    return columns.project(model * gain, every, np.float32), every


def _limit_step(seen: Projection, values: Array, nuisances: Nuisances, counts: float) -> Array:
    """Return the step of the registration and the nuisances, limited in length.

    ``counts`` correlated slopes weigh as much as one independent slope, because residuals with a
    common cause carry less information. Without this, benches with a third of the signal
    unexplained would have pupil images displaced by a pixel to fit some of it.
    """
    # the residual itself sets the noise level: the normal equations are in units of its variance
    noise = seen.chi / max(seen.residual.size - len(seen.gains), 1)
    prior = nuisances.prior * noise * counts
    pull = prior * np.concatenate([np.zeros(4), nuisances.from_prior(values)])
    step = np.linalg.solve(seen.normal + np.diag(prior), seen.scores.sum(axis=1) - pull)
    # the whole step is shortened, not its components: its direction is the solution's
    excess = np.abs(step[:4]) / MAX_STEP
    stretches = step[4:][STRETCHES] if nuisances.anamorphosis else np.zeros(1)
    first = 4 + nuisances.first_optic
    optics = np.abs(step[first : first + len(nuisances.optics)]) / LONGEST_OPTIC_STEP
    longest = [*excess, *optics, *(np.abs(stretches) / LONGEST_STRETCH)]
    return np.asarray(step / max(1.0, *longest))


def dispersion(projection: Projection, regions: NDArray[np.intp]) -> float:
    """Return how many correlated slopes count as one independent slope, at least 1.

    Modes, or regions of the pupil ``(n_rows,)``, each contribute a gradient by the unknowns. If
    slopes were independent, the squares of these gradients would add up to the variance of the
    residual times the normal matrix; errors common to a mode or region increase the sum.
    """
    n_unknowns = len(projection.jacobian)
    noise = projection.chi / max(projection.residual.size - len(projection.gains), 1)
    # A fit without residual has no correlations to measure.
    if not noise > 0.0:
        return 1.0
    # pinv, because unknowns without effect make the matrix singular; here they count nothing.
    spread = np.linalg.pinv(projection.normal, hermitian=True) / (noise * n_unknowns)
    found = 1.0
    for scores in (projection.scores, regional_scores(projection, regions)):
        found = max(found, float(np.einsum("kc,kl,lc->", scores, spread, scores)))
    return found


def pupil_regions(valid: NDArray[np.bool_], n_planes: int) -> NDArray[np.intp]:
    """Return the region of every signal ``(n_slopes,)``: sector, and ring of equal area."""
    n = len(valid)
    y, x = np.stack(np.nonzero(valid)) - (n - 1) / 2
    sector = np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * N_SECTORS).astype(np.intp)
    radius = np.hypot(x, y)
    # The square of the radius makes rings of equal area; 1e-9 keeps the outermost inside.
    ring = np.floor((radius / (radius.max() + 1e-9)) ** 2 * N_RINGS).astype(np.intp)
    return np.tile(np.minimum(sector, N_SECTORS - 1) * N_RINGS + ring, n_planes)


def regional_scores(projection: Projection, regions: NDArray[np.intp]) -> Array:
    """Return the gradient by the unknowns from each region ``(n_unknowns, n_regions)``."""
    weighted = projection.residual * projection.weights
    # In the Jacobian's precision: with two precisions einsum would convert the Jacobian, the
    # largest array of a fit.
    single = weighted.astype(projection.jacobian.dtype, copy=False)
    by_slope = np.einsum("ksm,sm->ks", projection.jacobian, single)
    return np.array([np.bincount(regions, row) for row in by_slope])
