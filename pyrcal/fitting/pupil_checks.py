"""Try another obscuration, pupil size, pupil map or spider than the instrument file states.

None is fitted together with the registration: a wrong pupil has an effect at its edges only, and
uneven light has a similar one. A value that would explain the matrix far better is reported
instead.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal.fitting.methods import Settled, spread
from pyrcal.fitting.models import PREFERRED_SHARE, FitModels
from pyrcal.fitting.solver import nuisances_of, refine
from pyrcal.fitting.uncertainty import pupil_regions
from service.estimation.solver import Projection
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.pupil import light_per_subaperture
from service.model.sensors.registry import kind_of

Array = NDArray[np.float64]

MIN_PUPIL_EXPLAINED = 0.03
"""RMS share of the signal that a pupil must explain; less may be the model's own error."""

OFFSET_STEP_SUBAP = 0.05
"""Step of the pupil offset for the finite difference that approximates its derivative."""

EXCLUDED_SHARE = 0.98
"""Share of χ² left by a pupil to first order, above which its own model is not computed: it would
have to leave 0.95 to be reported."""

ARMS, TURN = "spiders_m", "spiders_deg"
"""Keys of the arms. A number of the second one is the turn of the arms, or of a pupil map, in
degrees."""

WITHOUT_ARMS, MAP_WORDS = "no spider", "the pupil map "
"""Name of the explanation without arms, and first words of one with a turned or mirrored map."""

MIN_OUTLINE_EXPLAINED = 0.01
"""RMS share of the signal that turned or wider arms must explain. Arms of one subaperture
that are turned by one degree leave 0.027 of it."""

TURNS_DEG = (-8.0, -4.0, 4.0, 8.0)
"""Angles at which the fit of a turned pupil may start besides 0, degrees."""

MAX_LIGHT_SHARE = 0.95
"""Share of χ² left with the light of a mirrored pupil map, above which it has no matrix computed:
light that no map describes leaves 0.97."""

MIN_LIGHT = 0.1
"""Smallest light of a subaperture that others are compared with, over that of a full one."""

_N_STEPS = 2
"""Number of steps towards the value that explains the most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PupilNumber:
    """A number of the instrument file that describes the pupil."""

    key: str
    """Key in the instrument file."""

    reported: float
    """Value in the instrument file."""

    power: int
    """Power of the value to which the illuminated area is proportional; steps are linear in it."""

    step: float
    """Step of that power for the finite difference."""

    range: tuple[float, float]
    """Range within which a file's value is assumed to be wrong at most."""

    notable: float
    """Smallest reported difference: simulators round their pupils to whole points."""

    explained: float = MIN_PUPIL_EXPLAINED
    """RMS share of the signal that another value must explain to be reported."""

    starts: tuple[float, ...] = ()
    """Values far from the file's from which the best one is searched as well."""

    def words(self, about: Instrument, value: float) -> str:
        """Return a value in the notation of the file."""
        if self.key == ARMS and value < 0.1 * self.reported:
            return WITHOUT_ARMS
        if self.key != TURN:
            return f"{self.key} = {value:.3g}"
        if about.pupil is not None:
            return f"{MAP_WORDS}turned by {value:.2g} deg"
        angles = np.round(_turn(about, value).spiders_deg, 1)
        return f"{self.key} = [{', '.join(f'{angle:g}' for angle in angles)}]"

    def with_value(self, about: Instrument, light: float) -> Instrument:
        """Return the instrument with another value, given as its power."""
        value = light ** (1.0 / self.power)
        if self.key == TURN:
            return _turn(about, value)
        if self.key == ARMS:
            return replace(about, spiders_m=value)
        if self.key == "obscuration_ratio":
            return replace(about, obscuration_ratio=value)
        return replace(about, wfs=replace(about.wfs, pupil_diameter_subap=value))

    def rate(self, few: FitSubset, light: float, matrix: Array) -> Array:
        """Return the derivative of D ``(n_slopes, n_few)`` by the power of the value there."""
        there = few.matrix(few.of(self.with_value(few.models.instrument, light + self.step)))
        return np.asarray((there - matrix) / self.step)

    def limit(self, light: float) -> float:
        """Return a power of the value, limited to the plausible range."""
        low, high = (limit**self.power for limit in self.range)
        return float(np.clip(light, low, high))

    def near(self, few: FitSubset, rate: Array) -> tuple[float, Lead, Array]:
        """Return the best value, its improvement and the change of α, to first order."""
        if few.tells(few.own, rate):
            step, light = few.step(few.own, rate), self.reported**self.power
            value = self.limit(light + step[-1])
            if value != light:
                # Less the step of the fit's own instrument, which is not 0 on the coarse grid.
                moved = step[:4] - few.step(few.own)[:4]
                return value ** (1.0 / self.power), few.lead(few.own, rate), moved
        return self.reported, Lead(share=1.0, sigma=0.0), np.zeros(4)

    def far(self, few: FitSubset, rate: Array) -> tuple[float, Lead, Array]:
        """Return the best value, its improvement and the change of α, with D of that value."""
        value, matrix = self.found(few, rate)
        return value, few.lead(matrix), few.step(matrix)[:4] - few.step(few.own)[:4]

    def found(self, few: FitSubset, rate: Array) -> tuple[float, Array]:
        """Return the value that explains the most, and its D ``(n_slopes, n_few)``.

        A second step takes its derivative from the first, unless that was too short.
        """
        light, matrix = self.reported**self.power, few.own
        for start in self.starts:
            other = few.matrix(few.of(self.with_value(few.models.instrument, start)))
            if few.left(other) < few.left(matrix):
                light, matrix = start, other
        if matrix is not few.own:
            rate = self.rate(few, light, matrix)
        for _ in range(_N_STEPS):
            # At a new value the border may cut no subaperture, and then nothing determines a
            # further step.
            if not few.tells(matrix, rate):
                break
            before, left = light, matrix
            light = self.limit(light + float(few.step(matrix, rate)[-1]))
            if light == before:
                break
            matrix = few.matrix(few.of(self.with_value(few.models.instrument, light)))
            if abs(light - before) > self.step:
                rate = (matrix - left) / (light - before)
        return light ** (1.0 / self.power), matrix


def _numbers(about: Instrument) -> tuple[PupilNumber, ...]:
    size, hole = about.wfs.pupil_diameter, about.obscuration_ratio
    width = PupilNumber(
        key="pupil_diameter_subap",
        reported=size,
        power=1,
        step=0.01 * size,
        range=(0.94 * size, 1.06 * size),
        notable=0.015 * size,
    )
    turn = PupilNumber(
        key=TURN,
        reported=0.0,
        power=1,
        step=1.0,
        range=(-12.0, 12.0),
        notable=0.3,
        explained=MIN_OUTLINE_EXPLAINED,
        starts=TURNS_DEG,
    )
    if about.pupil is not None:
        return width, turn  # the pupil map contains the obscuration
    inner = PupilNumber(
        key="obscuration_ratio",
        reported=hole,
        power=2,
        step=0.01,
        range=(0.0, max(0.6, hole)),
        notable=0.03,
    )
    if not about.spiders_deg or about.spiders_m is None:
        return inner, width
    arms = PupilNumber(
        key=ARMS,
        reported=about.spiders_m,
        power=1,
        step=0.1 * about.spiders_m,
        range=(0.0, 4.0 * about.spiders_m),
        notable=0.2 * about.spiders_m,
        explained=MIN_OUTLINE_EXPLAINED,
    )
    return inner, width, arms, turn


@dataclass(frozen=True, slots=True, kw_only=True)
class Lead:
    """Improvement or degradation of the misfit by another explanation."""

    share: float
    """χ² that it leaves over that of the fit."""

    sigma: float
    """1 σ of that share, from its scatter between modes and between regions of the pupil."""

    @property
    def significance(self) -> float:
        """Number of σ by which the other explanation is better; negative if it is worse."""
        gained = 1.0 - self.share
        if self.sigma > 0.0:
            return gained / self.sigma
        return float(np.copysign(np.inf, gained)) if gained else 0.0


class FitSubset:
    """A subset of a fit's modes at its solution, on the coarse grid."""

    def __init__(self, settled: Settled) -> None:
        self._settled, solution, self.models = settled, settled.solution, settled.models
        self.residual_fraction = settled.share
        self.modes = spread(settled.target.n_modes)
        self.target = settled.target.column_subset(self.modes)
        self.here = solution.alpha
        self._images = settled.nuisances.images
        known = np.concatenate([solution.derivatives, solution.nuisance_derivatives])
        self.derivatives = known[:, :, self.modes]
        """Derivatives of the unchanged instrument; they hardly depend on the alternative."""

        self._last: tuple[tuple[Array, ...], Projection] | None = None

    @cached_property
    def model(self) -> InteractionModel:
        """Model of the unchanged instrument with these modes only."""
        return self.models.cheap.of_modes(self.models.basis.subset(self.modes))

    @cached_property
    def own(self) -> Array:
        """D of the unchanged instrument, ``(n_slopes, n_few)``."""
        return self._at_solution(self.model)

    @property
    def has_free_pupil(self) -> bool:
        """True if a displacement of the pupil is among the unknowns, by its images together."""
        return bool(np.any(self._images.reshape(-1, 2, 4).sum(axis=2)))

    @cached_property
    def pupil_rates(self) -> Array:
        """``(2, n_slopes, n_few)`` derivatives of D by the pupil's position, the mirror unmoved."""
        about = self.models.instrument
        if about.stop is Stop.MIRROR:  # the pupil is displaced together with the mirror
            return np.asarray(self.derivatives[:2] - self.model.mirror_shift_derivatives(self.here))
        known = about.pupil_shift_subap or kind_of(about).pupil_offset(about)
        place, rates = np.array(known or (0.0, 0.0)), []
        for step in np.eye(2) * OFFSET_STEP_SUBAP:
            displaced = replace(about, pupil_shift_subap=tuple(place + step))
            rates.append((self.matrix(self.of(displaced)) - self.own) / OFFSET_STEP_SUBAP)
        return np.array(rates)

    def of(self, about: Instrument) -> FitModels:
        """Return the models of another instrument with the same modes."""
        return replace(self.models, instrument=about)

    def fit_again(self, about: Instrument, rate: Array) -> tuple[float, float, Array]:
        """Return the fit with another instrument and one further number of it.

        All modes are fitted on the fine grid: on the coarse one, with two points per subaperture,
        arms turned by one degree moved a rotation by half of what they do, and were found 0.4 to
        0.8 deg beyond their places.

        Parameters
        ----------
        about
            The instrument, at a value near the best one.
        rate
            ``(n_slopes, n_few)`` derivative of D by that value.

        Returns
        -------
        The step to the best value, χ² over that of the fit, and the change of α ``(4,)``.
        """
        settled = self._settled
        models, own = replace(settled.models, instrument=about), settled.solution
        there = refine(models, settled.target, own.alpha, settled.nuisances)
        known = np.concatenate([there.derivatives, there.nuisance_derivatives])[:, :, self.modes]
        seen = self.target.project(there.matrix[:, self.modes], np.concatenate([known, rate[None]]))
        share = there.projection.chi / own.projection.chi * seen.chi_at_best / seen.chi
        step = seen.best_step
        return float(step[-1]), float(share), there.vector + step[:4] - own.vector

    def matrix(self, tried: FitModels) -> Array:
        """Return D of an instrument, ``(n_slopes, n_few)``."""
        own = tried.basis is self.models.basis
        basis = self.model.basis if own else tried.basis.subset(self.modes)
        model = tried.model(self.models.cheap_sampling, basis, once=True)
        model.share_modes(self.model)
        return self._at_solution(model)

    def left(self, matrix: Array, *more: Array) -> float:
        """Return χ² at the best unknowns, including those of further derivatives."""
        return float(self.seen(matrix, *more).chi_at_best)

    def lead(self, matrix: Array, *more: Array) -> Lead:
        """Return the improvement of another matrix over the unchanged instrument.

        Squares of both residuals are compared mode by mode and region by region: common noise and
        errors cancel, and the rest scatters between modes and between regions.
        """
        own, other = self._own_left, self._left_at_best(self.seen(matrix, *more))
        gained = own - other
        by_mode = gained.sum(axis=0)
        by_region = np.bincount(self._regions, gained.sum(axis=1))
        return Lead(
            share=float(other.sum() / own.sum()) if own.any() else 1.0,
            sigma=float(
                max(
                    np.std(parts, ddof=1) * np.sqrt(len(parts)) if len(parts) > 1 else 0.0
                    for parts in (by_mode, by_region)
                )
                / own.sum()
            )
            if own.any()
            else 0.0,
        )

    @cached_property
    def _own_left(self) -> Array:
        return self._left_at_best(self.seen(self.own))

    @cached_property
    def _regions(self) -> NDArray[np.intp]:
        n_planes = self.models.instrument.slopes.kind.n_planes
        return pupil_regions(self.target.valid, n_planes)[self.target.rows]

    @staticmethod
    def _left_at_best(seen: Projection) -> Array:
        """Return the weighted squares of the residual after the best step ``(n_rows, n_few)``."""
        step = seen.best_step.astype(seen.jacobian.dtype)
        left = seen.residual - np.tensordot(step, seen.jacobian, axes=1)
        return np.asarray(left**2 * seen.weights)

    def tells(self, matrix: Array, rate: Array) -> bool:
        """Return True if the measurement depends on a quantity; it may cut no subaperture."""
        return bool(self.target.project(matrix, rate[None]).normal[0, 0] > 0.0)

    def step(self, matrix: Array, *more: Array) -> Array:
        """Return the best step of all unknowns."""
        return self.seen(matrix, *more).best_step

    def seen(self, matrix: Array, *more: Array) -> Projection:
        """Return the projection of the measurement on a matrix and further derivatives.

        That of the unchanged instrument and the last one are cached, because both the step and the
        misfit of an alternative are taken from it.
        """
        if matrix is self.own and not more:
            return self._own_seen
        asked = (matrix, *more)
        if self._last is not None:
            known, seen = self._last
            if len(known) == len(asked) and all(map(operator.is_, known, asked)):
                return seen
        self._last = None  # its memory is needed for the next one
        seen = self.target.project(matrix, self._with(more), np.float32)
        self._last = asked, seen
        return seen

    @cached_property
    def _own_seen(self) -> Projection:
        return self.target.project(self.own, self.derivatives, np.float32)

    def _at_solution(self, model: InteractionModel) -> Array:
        self.models.counter.n += 1
        return np.asarray(model.interaction_matrix(self.here), dtype=np.float64)

    def _with(self, more: tuple[Array, ...]) -> Array:
        if not more:
            return self.derivatives
        return np.concatenate([self.derivatives, np.array(more, self.derivatives.dtype)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TriedPupil:
    """Another obscuration or diameter, at the value that explains the most."""

    words: str
    """Entry for the instrument file."""

    lead: Lead
    """Improvement over the file's pupil."""

    moved: Array
    """``(4,)`` change of α, numeric units."""

    explains: bool
    """True if it explains enough of the signal to be reported."""


def try_pupils(few: FitSubset) -> tuple[TriedPupil, ...]:
    """Return other pupils, each at the value that explains the most.

    They are computed to first order only, if the residual is smaller than a pupil would have to
    explain, or if the pupil explains next to nothing.
    """
    found = []
    about = few.models.instrument
    # Light that fades outwards looks like a narrower pupil as well, and explains more then.
    most = min(PREFERRED_SHARE, fit_smooth_gain(few))
    for number in _numbers(about):
        little = few.residual_fraction < number.explained
        rate = number.rate(few, number.reported**number.power, few.own)
        # To first order first, because each further value takes the matrix of another sensor model.
        value, lead, moved = number.near(few, rate)
        if not little and lead.share < EXCLUDED_SHARE:
            value, lead, moved = number.far(few, rate)
            if number.key in {ARMS, TURN}:
                for _ in range(_N_STEPS):
                    other = number.with_value(about, value)
                    rate = number.rate(few, value, few.matrix(few.of(other)))
                    step, share, moved = few.fit_again(other, rate)
                    value, lead = number.limit(value + step), replace(lead, share=share)
                    if abs(step) < number.notable:
                        break
        explained = few.residual_fraction * np.sqrt(max(1.0 - lead.share, 0.0))
        notable = abs(value - number.reported) >= number.notable and explained >= number.explained
        found.append(
            TriedPupil(
                words=number.words(about, value),
                lead=lead,
                moved=moved,
                explains=notable and lead.share < most,
            )
        )
    return (*found, *_try_other_ways_round(few))


def _turn(about: Instrument, turn_deg: float) -> Instrument:
    """Return the instrument with its arms or its pupil map turned, from +x towards +y."""
    own = about.pupil
    if own is None:
        angles = tuple((angle + turn_deg) % 360.0 for angle in about.spiders_deg)
        return replace(about, spiders_deg=angles)
    turned = scipy.ndimage.rotate(own.lit, -turn_deg, reshape=False, order=1)
    return replace(about, pupil=replace(own, lit=np.clip(turned, 0.0, 1.0)))


def _try_other_ways_round(few: FitSubset) -> Iterator[TriedPupil]:
    """Yield the pupil map mirrored or turned by quarters, if that explains the matrix better.

    The eight ways are compared by the gain that their light gives each subaperture, which takes no
    model. Only the best has its matrix computed.
    """
    about = few.models.instrument
    if about.pupil is None or few.residual_fraction < MIN_PUPIL_EXPLAINED:
        return
    lit = about.pupil.lit
    ways = {f"turned by {90 * k} deg": np.rot90(lit, -k) for k in (1, 2, 3)}
    ways |= {"mirrored along x": lit[:, ::-1], "mirrored along y": lit[::-1]}
    ways |= {"mirrored at a diagonal": lit.T, "mirrored at the other diagonal": lit[::-1, ::-1].T}
    own, best = np.maximum(_light(few, about), MIN_LIGHT), ("", about, MAX_LIGHT_SHARE)
    for words, way in ways.items():
        other = replace(about, pupil=replace(about.pupil, lit=way))
        rate = (_light(few, other) / own - 1.0)[:, None] * few.own
        if few.tells(few.own, rate) and few.step(few.own, rate)[-1] > 0.0:
            share = few.lead(few.own, rate).share
            best = min(best, (words, other, share), key=lambda one: one[2])
    words, other, _ = best
    if other is not about:
        matrix = few.matrix(few.of(other))
        lead = few.lead(matrix)
        yield TriedPupil(
            words=f"{MAP_WORDS}{words}",
            lead=lead,
            moved=few.step(matrix)[:4] - few.step(few.own)[:4],
            explains=lead.share < PREFERRED_SHARE,
        )


def _light(few: FitSubset, about: Instrument) -> Array:
    """Return the light of a pupil at each slope ``(n_slopes,)``, of a full subaperture."""
    # the pupil moves with the mirror if that is the stop
    x, y = few.here.vector[:2] if about.stop is Stop.MIRROR else (0.0, 0.0)
    seen = scipy.ndimage.shift(light_per_subaperture(about), (y, x), order=1)
    return np.tile(seen[few.target.valid], about.slopes.kind.n_planes)


def fit_smooth_gain(few: FitSubset) -> float:
    """Return χ² with a smooth gain over the pupil, common to all modes, over that without."""
    own = few.own
    return few.left(own, *(pattern[:, None] * own for pattern in gain_maps(few))) / few.left(own)


def gain_maps(few: FitSubset) -> Array:
    """Return the shapes of a smooth gain over the pupil, ``(n_maps, n_slopes)``."""
    kind = few.models.instrument.slopes.kind
    return nuisances_of(few.target.valid, kind, gain_map=True).maps
