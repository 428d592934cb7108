"""σ of a registration: a statistical and a systematic part.

The statistical part comes from noise and from the disagreement of disjoint sets. Each mode is a
cluster of a sandwich estimate, and sets of modes, of actuators and of subapertures give a block
jackknife (:mod:`pyrcal.fitting.disjoint_sets`), which replaces the estimate where it is larger.

The systematic part comes from errors of the model, which are common to all modes: what regions of
the pupil disagree by, a floor that no model is free of, and how far other explanations of the
matrix that the data do not exclude would move the registration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.disjoint_sets import (
    DisjointSets,
    Distortion,
    Normals,
    SetComparison,
    jackknife_sigma,
    mode_partitions,
    pupil_partitions,
)
from pyrcal.fitting.methods import Settled
from pyrcal.fitting.solver import STRETCHES, regional_scores
from service.estimation.reference import is_by_actuator
from service.model.instrument import Mirror

Array = NDArray[np.float64]

FLOOR_SUBAP = 3e-4
"""Smallest 1 σ of a shift. Noise-free matrices of other codes, of the same mirror at 0.3 to 1.1
subapertures, were fitted with errors of 0.017 to 0.038 % (RMS of a shift); with modes of a sensor
of 20 subapertures, modulated by 20 points, 0.05 %."""

EDGE_FLOOR_SUBAP = 1.5e-4
"""Smallest 1 σ of a point at the pupil's edge by a rotation. With 12 subapertures matrices of an
FFT pyramid and of OOPAO had errors of 0.5 and 1.4e-4 (RMS), with 20 subapertures 3e-4, of which
the scatter between modes and regions shows the rest."""

MAGNIFICATION_FLOOR = 1e-4
"""Smallest 1 σ of the magnification: the error on those matrices was 3e-5 with modes, 1.2e-4 with
actuators."""

LOCAL_MAGNIFICATION_FLOOR = 1e-3
"""The same if each subaperture is normalised by its own flux, because border subapertures then
weigh as much as full ones. Matrices of HCIPy with 20 subapertures were fitted 2e-4 to 6e-4 too
small, others 0.1 to 0.3 %."""

WEAK_MODULATION_FLOOR = 1e-3
"""The same for a pyramid with a modulation of little more than the width of a star. OOPAO samples a
circle of 1 λ/D by 8 points: its matrices were fitted with errors of 0.1 to 0.3 %, and with an FFT
pyramid of 12 subapertures those 8 points alone change the magnification by 2.7e-4."""

NONLINEAR_SHIFT_SUBAP = 0.08
"""Error of a shift over the share of the signal that pokes beyond the linear range leave, for a
pyramid modulated by 1 λ/D: 0.03 to 0.09 subapertures for strokes of 0.15 to 0.4 µm, push-only and
push-pull, on two mirrors with an FFT pyramid, and 0.05 on one of OOPAO. All actuators err alike, so
that no sets of them show it."""

LINEAR_RESIDUAL = 0.035
"""RMS share of the signal that such a pyramid leaves with small pokes, at most."""

FAR_SHARE = np.array([1.5e-3, 1.5e-3, np.deg2rad(2.5e-3), 2.5e-4])
"""1 σ of each parameter over the length of the shift in subapertures: with a large shift, a mirror
of another kind differs from the model at the border. Of 24 telescopes at 0.66 to 1.0 subapertures,
23 are inside the 95 % ellipse; without the terms for rotation and magnification it was 20."""

STRANGE_RESIDUAL = 0.095
"""Residual share of the signal left by a mirror of another kind. The effect of a large shift is
reduced in proportion for smaller residuals, as with other codes, which leave one percent."""

POSITION_ERROR_PITCH = 0.02
"""RMS error of an actuator's position along each axis, in pitches, where the instrument file states
none: an assumption. It is bounded by the residual beyond ``EXACT_RESIDUAL``, for such errors leave
about the same share: 2 % of a pitch leave 2.2 % of the signal of 40 modes of 144 actuators."""

EXACT_RESIDUAL = 0.015
"""RMS share of the signal that may be left over although all actuators are in place: matrices of
other codes leave 0.2 to 2 %, most of them about 1 %."""

REGIONAL_SHARE = np.array([0.53, 0.53, 0.165, 1.43])
"""Error of each parameter over the scatter between regions of the pupil: effects of opposite
regions partly cancel."""

FEW_MODES = 45.0
"""Number of modes above which errors of the model average out."""

FEW_MODES_EXCESS = 5.0
"""Relative increase of the model errors with hardly any modes."""

FEW_MODES_POWER = np.array([1.0, 1.0, 1.0, 0.5])
"""Power of that increase for each parameter: the magnification is less affected."""

UNINFORMATIVE_RATIO = 5.0
"""1 σ of a parameter in a set of modes, over the median of all sets, above which it is ignored."""

MAX_SETS = 8
MIN_PER_SET = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Uncertainty:
    """Covariance of the registration, and agreement of the sets of modes."""

    covariance: Array
    """``(4, 4)`` total covariance of the registration."""

    nuisance_sigma: Array
    """``(n_nuisances,)`` 1 σ of the nuisances."""

    subset_steps: Array
    """``(n_sets, 4)`` step of each disjoint set of modes from the common solution."""

    subset_covariance: Array
    """``(n_sets, 4, 4)`` covariance of these steps from the scatter of modes within each set."""

    statistical: Array
    """``(4, 4)`` part of the covariance from noise and the scatter of sets."""

    sets: tuple[DisjointSets, ...] = ()
    """Disjoint sets of modes, actuators and subapertures, each fitted separately."""

    distortion: Distortion | None = None
    """Smooth distortion of the mirror that explains the most."""

    @property
    def sigma_statistical(self) -> Array:
        """``(4,)`` 1 σ from noise and the scatter of disjoint sets."""
        return np.asarray(np.sqrt(np.diag(self.statistical)))

    @property
    def sigma_systematic(self) -> Array:
        """``(4,)`` 1 σ from model errors and alternatives that are not excluded."""
        rest = np.diag(self.covariance) - np.diag(self.statistical)
        return np.asarray(np.sqrt(np.maximum(rest, 0.0)))

    def with_moves(self, moves: Array, shares: Array) -> Uncertainty:
        """Return the uncertainty with alternatives added to its systematic part.

        Parameters
        ----------
        moves
            ``(n, 4)`` change of the registration under each alternative, numeric units.
        shares
            ``(n,)`` weight of its square: 1 for an alternative that the matrix prefers.
        """
        if not len(moves):
            return self
        # Only variances are added: correlations between the parameters' changes are left out.
        added = np.diag(shares @ moves**2)
        return replace(
            self,
            covariance=self.covariance + added,
            subset_covariance=self.subset_covariance + added,
        )

    @property
    def subset_scatter(self) -> Array:
        """``(4,)`` 1 σ scatter of the sets; NaN with fewer than two."""
        if len(self.subset_steps) < 2:
            return np.full(4, np.nan)
        return np.asarray(self.subset_steps.std(axis=0, ddof=1))

    @property
    def subset_tension(self) -> float:
        """Largest distance of a set from the common solution, in its own σ.

        A parameter whose σ in a set is far above the median is ignored, because its step exceeds
        the linear range of the model.
        """
        if len(self.subset_steps) < 2:
            return 0.0
        sigma = np.sqrt([np.diag(matrix) for matrix in self.subset_covariance])
        sigma[sigma > UNINFORMATIVE_RATIO * np.median(sigma, axis=0)] = np.inf
        return float(np.max(np.abs(self.subset_steps) / sigma))


def estimate_uncertainty(
    settled: Settled, structure: float, magnification_floor: float
) -> Uncertainty:
    """Return the uncertainty of a fit's registration, without that of alternatives.

    Parameters
    ----------
    settled
        The fit.
    structure
        RMS share of the signal that is left over and is no noise.
    magnification_floor
        Smallest 1 σ of the magnification.
    """
    solution, target, nuisances = settled.solution, settled.target, settled.nuisances
    projection, prior, instrument = solution.projection, settled.prior, settled.models.instrument
    regions, n_planes = nuisances.regions[target.rows], instrument.slopes.kind.n_planes
    radius_subap = instrument.wfs.pupil_diameter / 2.0
    # The registration has no prior, so its distance from one is 0.
    values = np.concatenate([np.zeros(4), nuisances.from_prior(solution.nuisances)])
    mode_sets = mode_partitions(target, n_planes, by_actuator=is_by_actuator(instrument))
    pupil_sets = pupil_partitions(target.valid, n_planes, target.rows)
    n_modes = len(projection.gains)
    n_sets = min(MAX_SETS, n_modes // MIN_PER_SET)
    by_mode = Normals.of_modes(projection)
    normals, scores = by_mode.normals, by_mode.scores
    noise = projection.chi / max(projection.residual.size - len(prior) - n_modes, 1)
    held = np.diag(prior * noise)
    spread = np.linalg.inv(normals.sum(axis=0) + held)
    # Few modes scatter less about a solution that was fitted to them, which n / (n - 1) makes up
    # for.
    every = _sandwich(spread, scores) * n_modes / max(n_modes - 1, 1)
    # A few modes may agree by chance: σ is never below that of white noise.
    from_modes = _at_least(every[:4, :4], (spread * noise)[:4, :4])
    by_region = _sandwich(spread, regional_scores(projection, regions))
    # noise also scatters between regions, but the statistical part already includes it
    noise_power = max(settled.share**2 - structure**2, 0.0)
    white = np.diag(spread) * noise * (noise_power / settled.share**2 if noise_power else 0.0)
    regional = np.sqrt(np.maximum(np.diag(by_region) - white, 0.0))
    few = (1.0 + FEW_MODES_EXCESS * np.exp(-n_modes / FEW_MODES)) ** FEW_MODES_POWER
    share = few * REGIONAL_SHARE * regional[:4]
    # ``REGIONAL_SHARE`` is known for the registration only, so nuisances have the whole scatter.
    model_error = np.sqrt(np.diag(by_region))[4:]
    if nuisances.anamorphosis:
        # an anamorphosis is a magnification along one axis and its inverse along the other
        model_error[STRETCHES] = few[3] * REGIONAL_SHARE[3] * regional[4:][STRETCHES]
    # The residual limits how much mirror and model differ.
    kind_share = min(1.0, settled.share / STRANGE_RESIDUAL)
    far = kind_share * FAR_SHARE * float(np.hypot(*solution.vector[:2]))
    # A rotation moves the pupil's edge by the radius times as much.
    floor = np.array(
        [FLOOR_SUBAP, FLOOR_SUBAP, EDGE_FLOOR_SUBAP / radius_subap, magnification_floor]
    )
    # a quantity fixed by its prior may have any value within that prior
    held_back = (spread * np.diag(held) @ spread)[:4, :4] * noise * solution.dispersion
    from_model = np.diag(share**2 + floor**2 + far**2) + held_back
    pull = prior * noise * values
    by_row = Normals.of_rows(projection, regions)
    places = _pupil_places(target.valid, n_planes, radius_subap)[target.rows]
    distortion = by_row.fit_distortion(places, held, pull, projection.chi, noise)
    comparison = SetComparison(
        seen=projection,
        regions=regions,
        held=held,
        pull=pull,
        noise=noise,
        distortion=distortion,
    )
    sets = (
        *comparison.of_modes(mode_sets, by_mode),
        *comparison.of_rows(pupil_sets, by_row),
    )
    steps, covariances = _subsets(max(n_sets, 1), normals, held, scores, pull, noise)
    statistical = from_modes
    for kind in (mode_sets, pupil_sets):
        found = jackknife_sigma([one for one in sets if one.words in kind])
        # Partitions have few sets, which may agree by chance, so they only increase σ.
        statistical = _at_least(statistical, np.diag(found**2))
    return Uncertainty(
        covariance=statistical + from_model,
        statistical=statistical,
        sets=sets,
        distortion=distortion,
        nuisance_sigma=np.sqrt(np.diag(every + spread * noise)[4:] + model_error**2),
        subset_steps=steps,
        subset_covariance=covariances + from_model,
    )


def misplacement_sigma(
    mirror: Mirror, radius_m: float, subaperture_m: float, residual: float
) -> Array:
    """Return 1 σ of the registration from independent errors of the actuators' positions, ``(4,)``.

    A least-squares registration of ``n`` points whose positions are wrong by ``p`` (RMS along each
    axis) is wrong by ``p / sqrt(n)`` in a shift, and by ``p / (sqrt(n) r)`` in rotation,
    magnification and both parts of an anamorphosis, ``r`` the RMS radius of the points. Disjoint
    sets of modes share the actuators, so that their agreement does not show this error.

    Parameters
    ----------
    mirror
        Actuators that are drawn. Those up to a pitch outside the pupil count.
    radius_m, subaperture_m
        Radius of the pupil and width of a subaperture, metres in the pupil plane.
    residual
        RMS share of the signal that is left over and is no noise.
    """
    radii = np.hypot(*mirror.positions_m.T)
    # Actuators up to a pitch outside the pupil still move the surface at its edge.
    seen = radii[radii <= radius_m + mirror.pitch_m]
    if len(seen) < 2:
        return np.zeros(4)
    stated = mirror.position_error_pitch
    room = float(np.sqrt(max(residual**2 - EXACT_RESIDUAL**2, 0.0)))
    error = min(POSITION_ERROR_PITCH if stated is None else stated, room)
    each_m = error * mirror.pitch_m / np.sqrt(len(seen))
    # The same value for rotation and magnification, which both move a point by its radius.
    turn = each_m / float(np.sqrt(np.mean(seen**2)))
    shift = each_m / subaperture_m
    return np.array([shift, shift, turn, turn])


def nonlinearity_sigma(residual: float, noise_share: float) -> Array:
    """Return 1 σ of the registration from pokes beyond a pyramid's linear range, ``(4,)``.

    Parameters
    ----------
    residual
        RMS share of the signal that is left over.
    noise_share
        Largest share of its power that is noise, 0 to 1.
    """
    left = float(np.sqrt(max(residual**2 * (1.0 - noise_share) - LINEAR_RESIDUAL**2, 0.0)))
    shift = NONLINEAR_SHIFT_SUBAP * left
    # Only errors of a shift were measured in proportion to the residual.
    return np.array([shift, shift, 0.0, 0.0])


def _pupil_places(valid: NDArray[np.bool_], n_planes: int, radius_subap: float) -> Array:
    """Return the position of every signal ``(n_slopes, 2)`` along x and y, pupil radii."""
    y, x = np.stack(np.nonzero(valid)) - (len(valid) - 1) / 2
    return np.tile(np.column_stack([x, y]) / radius_subap, (n_planes, 1))


def _sandwich(spread: Array, scores: Array) -> Array:
    """Return the covariance of all unknowns if columns of ``scores`` are independent."""
    pulled = spread @ scores
    return np.asarray(pulled @ pulled.T)


def _at_least(covariance: Array, other: Array) -> Array:
    """Return the first covariance, scaled to the larger σ of both with its correlations."""
    own, least = np.sqrt(np.diag(covariance)), np.sqrt(np.diag(other))
    # Without a σ there is nothing to scale: a fit without residual has none.
    if not np.all(own > 0.0):
        return other
    grown = np.maximum(own, least) / own
    return np.asarray(covariance * np.outer(grown, grown))


def _subsets(
    n_sets: int, normals: Array, held: Array, scores: Array, pull: Array, noise: float
) -> tuple[Array, Array]:
    """Return the step of every set of modes ``(n_sets, 4)`` and its covariance.

    The covariance of a set is from the scatter of its modes around its own solution. The scatter
    around the common solution would hide sets that agree within themselves but not with each other.
    """
    steps, covariances = [], []
    for k in range(n_sets):
        # Every n-th mode, so that each set has low and high orders.
        own, scored = normals[k::n_sets], scores[:, k::n_sets]
        spread = np.linalg.inv(own.sum(axis=0) + held)
        step = spread @ (scored.sum(axis=1) - pull)
        about = scored - (own @ step).T
        n_modes = len(own)
        covariance = _sandwich(spread, about)[:4, :4] * n_modes / max(n_modes - 1, 1)
        steps.append(step[:4])
        covariances.append(_at_least(covariance, (spread * noise)[:4, :4]))
    return np.array(steps), np.array(covariances)
