"""Try another obscuration, pupil size, pupil map or spider than the instrument file states.

None is fitted together with the registration: a wrong pupil has an effect at its edges only, and
uneven light has a similar one. A value that would explain the matrix far better is reported
instead.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal.fitting.comparison import MIN_EXPLAINED, Alternative, FitSubset
from pyrcal.fitting.models import FAR_PREFERRED_SHARE, PREFERRED_SHARE
from service.model.instrument import Instrument
from service.model.kinds import Stop
from service.model.pupil import light_per_subaperture

Array = NDArray[np.float64]

MIN_PUPIL_EXPLAINED = 0.03
"""RMS share of the signal that a pupil must explain; less may be the model's own error."""

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
        there = few.matrix_of(self.with_value(few.models.instrument, light + self.step))
        return np.asarray((there - matrix) / self.step)

    def limit(self, light: float) -> float:
        """Return a power of the value, limited to the plausible range."""
        low, high = (limit**self.power for limit in self.range)
        return float(np.clip(light, low, high))

    def near(self, few: FitSubset, rate: Array) -> tuple[float, Alternative]:
        """Return the best value and how it compares, to first order."""
        if few.depends_on(few.own, rate):
            light = self.reported**self.power
            value = self.limit(light + few.step(few.own, rate)[-1])
            if value != light:
                return value ** (1.0 / self.power), few.compare(few.own, rate)
        return self.reported, few.compare(few.own)

    def found(self, few: FitSubset, rate: Array) -> tuple[float, Array]:
        """Return the value that explains the most, and its D ``(n_slopes, n_few)``.

        A second step takes its derivative from the first, unless that was too short.
        """
        light, matrix = self.reported**self.power, few.own
        for start in self.starts:
            other = few.matrix_of(self.with_value(few.models.instrument, start))
            if few.left(other) < few.left(matrix):
                light, matrix = start, other
        if matrix is not few.own:
            rate = self.rate(few, light, matrix)
        for _ in range(_N_STEPS):
            # At a new value the border may cut no subaperture, and then nothing determines a
            # further step.
            if not few.depends_on(matrix, rate):
                break
            before, left = light, matrix
            light = self.limit(light + float(few.step(matrix, rate)[-1]))
            if light == before:
                break
            matrix = few.matrix_of(self.with_value(few.models.instrument, light))
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


def try_pupils(few: FitSubset) -> Iterator[Alternative]:
    """Yield other pupils, each at the value that explains the most.

    They are computed to first order only, if the residual is smaller than a pupil would have to
    explain, or if the pupil explains next to nothing.
    """
    about = few.models.instrument
    # Light that fades outwards looks like a narrower pupil as well, and explains more then.
    most = min(PREFERRED_SHARE, few.uneven_light.misfit)
    for number in _numbers(about):
        rate = number.rate(few, number.reported**number.power, few.own)
        # To first order first, because each further value takes the matrix of another sensor model.
        value, found = number.near(few, rate)
        if few.residual_fraction >= number.explained and found.misfit < EXCLUDED_SHARE:
            value, matrix = number.found(few, rate)
            found = few.compare(matrix)
            if number.key in {ARMS, TURN}:
                for _ in range(_N_STEPS):
                    other = number.with_value(about, value)
                    step, share, moved = few.fit_again(
                        other, number.rate(few, value, few.matrix_of(other))
                    )
                    value, found = (
                        number.limit(value + step),
                        replace(found, share=share, moved=moved),
                    )
                    if abs(step) < number.notable:
                        break
        notable = (
            abs(value - number.reported) >= number.notable
            and found.explained(few.residual_fraction) >= number.explained
        )
        yield _judge(few, found, number.words(about, value), notable=notable, most=most)
    yield from _try_other_ways_round(few)


def _judge(
    few: FitSubset, found: Alternative, words: str, *, notable: bool, most: float
) -> Alternative:
    """Return another pupil with its verdict: an instrument of its own if it explains enough."""
    explains = notable and found.misfit < most
    return few.judge(
        found,
        words,
        FAR_PREFERRED_SHARE,
        key=words,
        notable=explains,
        min_explained=MIN_EXPLAINED,
        is_number=True,
        is_instrument=explains,
    )


def _turn(about: Instrument, turn_deg: float) -> Instrument:
    """Return the instrument with its arms or its pupil map turned, from +x towards +y."""
    own = about.pupil
    if own is None:
        angles = tuple((angle + turn_deg) % 360.0 for angle in about.spiders_deg)
        return replace(about, spiders_deg=angles)
    turned = scipy.ndimage.rotate(own.lit, -turn_deg, reshape=False, order=1)
    return replace(about, pupil=replace(own, lit=np.clip(turned, 0.0, 1.0)))


def _try_other_ways_round(few: FitSubset) -> Iterator[Alternative]:
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
        if few.depends_on(few.own, rate) and few.step(few.own, rate)[-1] > 0.0:
            share = few.compare(few.own, rate).misfit
            best = min(best, (words, other, share), key=lambda one: one[2])
    words, other, _ = best
    if other is not about:
        found = few.compare(few.matrix_of(other))
        yield _judge(few, found, f"{MAP_WORDS}{words}", notable=True, most=PREFERRED_SHARE)


def _light(few: FitSubset, about: Instrument) -> Array:
    """Return the light of a pupil at each slope ``(n_slopes,)``, of a full subaperture."""
    # the pupil moves with the mirror if that is the stop
    x, y = few.here.vector[:2] if about.stop is Stop.MIRROR else (0.0, 0.0)
    seen = scipy.ndimage.shift(light_per_subaperture(about), (y, x), order=1)
    return np.tile(seen[few.target.valid], about.slopes.kind.n_planes)
