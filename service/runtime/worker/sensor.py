"""The sensor's model at a flat wavefront or at its working point.

The working point is one of a loop whose residual is not known beforehand: the seeing, the star and
the loop's gains all play a part. How strong it is can be read off the dithered modes, whose
optical gain is what that residual makes of them, so the model follows them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.model.instrument import Instrument
from service.model.interaction import Linearisation, RtcInteractionModel
from service.model.misregistration import Misregistration
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import WorkingPoint
from service.records.estimates import DitheredEstimate

Array = NDArray[np.float64]

LINEAR_STEP = np.array([0.03, 0.03, 1.5e-3, 3e-3])
"""Step, numeric units, below which the linearisation error is less than ``LINEARISATION_ERROR``: D
is almost linear, and another linearisation would cost more than it gains."""

LINEARISATION_ERROR = np.array([2.5e-4, 2.5e-4, 1.5e-5, 3e-5])
"""Largest linearisation error of such a step of all four parameters, on FLAO with any set of modes
(numeric units); it grows with the square of the step. It is a fifteenth of the floor of a flat
model."""

LINEAR_STRETCH = float(LINEAR_STEP[3])
"""The same of an anamorphosis: it is a length as a magnification is."""

MAX_LINEAR_STEPS = 4.0
"""A step this long, in units of ``LINEAR_STEP``, ends well within one of them."""

NEGLIGIBLE_ERROR_SIGMA = 0.1
"""Linearisation error, as a fraction of an estimate's σ, below which no further linearisation is
made."""

MIN_GAIN_CHANGE = 0.04
"""Logarithmic difference of gains from the model's that moves the working point: 0.02 % in
magnification. Less needs no further linearisation."""

STRENGTH_RANGE = (0.05, 4.0)
"""Variance of the residual over that at the instrument's r0. Of the first a wavefront is all but
flat, and gains above 1 ask for less; the second is 2.3" of seeing."""

ModelOf = Callable[[WorkingPoint | None], RtcInteractionModel]


class SensorAtWork:
    """The response at work, its last linearisation, and what it is of that to a flat wavefront.

    ``model_of`` makes the model of a working point. Without ``n_controlled`` modes, or where the
    kind of sensor has no working point, the response is that to a flat wavefront for good.
    """

    def __init__(
        self, model_of: ModelOf, instrument: Instrument, n_controlled: int | None, sampling: int
    ) -> None:
        self.flat = model_of(None)
        self._model_of = model_of
        self._instrument = instrument
        self._n_controlled = n_controlled
        self._sampling = sampling
        self._strength = 1.0
        self._model = self._at_work()
        self.linearised_at: Misregistration | None = None
        """Registration of the linearisation at hand; None if there is none since the working point
        has changed."""

        self._linearisation: Linearisation | None = None
        self._ratio: Array | None = None

    @property
    def is_flat(self) -> bool:
        """Return True if it is the response to a flat wavefront."""
        return self._n_controlled is None

    @property
    def models(self) -> tuple[RtcInteractionModel, ...]:
        """The models of both responses."""
        return (self.flat,) if self._model is self.flat else (self.flat, self._model)

    @property
    def strength(self) -> float:
        """Variance of the residual over that expected at the instrument's r0."""
        return 0.0 if self.is_flat else self._strength

    def restore(self, strength: float, linearised_at: Misregistration | None) -> None:
        """Be at this working point and linearisation, which is computed again if it is needed."""
        if strength != self._strength:
            self._move(strength)
        if linearised_at != self.linearised_at:
            self.linearised_at, self._linearisation, self._ratio = linearised_at, None, None

    @property
    def place(self) -> tuple[float, Misregistration | None]:
        """Working point and linearisation, as :meth:`restore` takes them."""
        return self._strength, self.linearised_at

    @property
    def at_hand(self) -> Linearisation | None:
        """The last linearisation; None if there is none since the working point has changed."""
        if self._linearisation is None and self.linearised_at is not None:
            self._linearisation = self._model.linearise(self.linearised_at)
        return self._linearisation

    def near(self, alpha: Misregistration) -> Linearisation:
        """Return the linearisation at hand if it is close enough, else a new one."""
        at = self.linearised_at
        kept = None if at is None or self._apart(alpha, at) else self.at_hand
        return self.linearise(alpha) if kept is None else kept

    def _apart(self, *both: Misregistration) -> bool:
        """Return whether a linearisation at one of two registrations is not for the other."""
        one, other = (self._instrument.with_anamorphosis(alpha) for alpha in both)
        stretched = np.abs(one.stretches - other.stretches) > LINEAR_STRETCH
        return bool(np.any(np.abs(one.vector - other.vector) > LINEAR_STEP) or np.any(stretched))

    def linearise(self, alpha: Misregistration) -> Linearisation:
        """Return a new linearisation about ``alpha``, and keep it."""
        found = self.compute(alpha)
        self.keep(found)
        return found

    def compute(self, alpha: Misregistration) -> Linearisation:
        """Return a linearisation at this working point, without keeping it."""
        return self._model.linearise(alpha)

    def keep(self, linearisation: Linearisation) -> None:
        """Take a linearisation of this very sensor, wherever it comes from, as the one at hand."""
        self._linearisation, self._ratio = linearisation, None
        self.linearised_at = linearisation.alpha

    def ratio(self) -> Array:
        """Return ``(n_modes,)`` how much of the flat response is left of each mode at work.

        Of the linearisation at hand, projected on the flat response: the optical gain the model
        expects. Ones where there is none.
        """
        kept = None if self.is_flat else self.at_hand
        if kept is None:
            return np.ones(self.flat.basis.n_modes)
        if self._ratio is None:
            flat = self.flat.interaction_matrix(kept.alpha)
            power = np.einsum("ij,ij->j", flat, flat)
            self._ratio = np.einsum("ij,ij->j", kept.matrix, flat) / power
        return np.asarray(self._ratio, dtype=np.float64)

    def at_unit_gain(self, alpha: Misregistration) -> Linearisation:
        """Return the linearisation near ``alpha``, each mode as strong as for a flat wavefront.

        An optical gain multiplies it; what the working point does to the shape of a mode stays.
        """
        return self.to_unit_gain(self.near(alpha))

    def to_unit_gain(self, near: Linearisation) -> Linearisation:
        """Return the linearisation at hand, each mode as strong as for a flat wavefront."""
        if self.is_flat:
            return near
        ratio = self.ratio().astype(np.float32)
        return replace(
            near,
            matrix=near.matrix / ratio,
            derivatives=near.derivatives / ratio,
            stretches=None if near.stretches is None else near.stretches / ratio,
        )

    def follow(self, modes: tuple[int, ...], optical_gain: NDArray[np.complex128]) -> bool:
        """Take the working point from the optical gains of dithered modes; whether it moved.

        ``optical_gain`` ``(n,)`` is relative to the flat response. Its logarithm is the residual's
        variance times what the model of the same modes says for the present one.
        """
        if self.is_flat or not modes:
            return False
        seen = float(np.log(np.abs(optical_gain)).mean())
        expected = float(np.log(self.ratio()[list(modes)]).mean())
        if abs(seen - expected) <= MIN_GAIN_CHANGE:
            return False
        strength = float(np.clip(self._strength * seen / expected, *STRENGTH_RANGE))
        if strength == self._strength:
            return False
        self._move(strength)
        return True

    def _move(self, strength: float) -> None:
        self._strength = strength
        self._model = self._at_work()
        self._linearisation = self.linearised_at = None

    def _at_work(self) -> RtcInteractionModel:
        if self._n_controlled is None:
            return self.flat
        found = kind_of(self._instrument).working_point(
            self._instrument,
            n_controlled=self._n_controlled,
            # a residual's variance goes with r0^(-5/3)
            r0_m=self._instrument.modes.r0_m * self._strength ** (-3 / 5),
            sampling=self._sampling,
        )
        if found is None:
            self._n_controlled = None
            return self.flat
        return self._model_of(found)


def length(step: Array) -> float:
    """Return the length of a step ``(4,)`` of α, in units of what counts as settled."""
    return float(np.abs(step / LINEAR_STEP).max())


def settled(estimate: DitheredEstimate) -> bool:
    """Return whether a fit may stay where its step has led it."""
    return near_enough(estimate.step, estimate.covariance) and estimate.stretched < LINEAR_STRETCH


def near_enough(step: Array, covariance: Array) -> bool:
    """Return whether a fit that made this step may stay: its linearisation is lost in the noise."""
    borne = float(
        (NEGLIGIBLE_ERROR_SIGMA * np.sqrt(np.diag(covariance)) / LINEARISATION_ERROR).min()
    )
    return length(step) <= min(float(np.sqrt(max(1.0, borne))), MAX_LINEAR_STEPS)
