"""The registration and the estimates it is made of."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from service.control.gains import ModeGain
from service.estimation.estimate import PASSIVE_BIAS, BiasBlock
from service.estimation.kalman import Bias
from service.model.misregistration import Determination, Misregistration
from service.wire import Pointing

Array = NDArray[np.float64]
_Timed = TypeVar("_Timed", bound="TimedEstimate")


class Source(StrEnum):
    """Sources of a measurement of α."""

    LOCK_IN = "lock-in"
    """A window of sinusoidal dither."""

    RANDOM = "random"
    """A window of random dither."""

    PASSIVE = "passive"
    """Ordinary telemetry: biased by the wind."""


class Validity(StrEnum):
    """Whether α may be relied on."""

    FRESH = "fresh"
    """σ is below half of the limit."""

    AGEING = "ageing"
    """σ grows towards the limit."""

    STALE = "stale"
    """σ has passed the limit, or nothing has confirmed α since a restart."""

    INVALID = "invalid"
    """α may be elsewhere: nothing is made from it by itself."""


class Purpose(StrEnum):
    """What telemetry may be void for."""

    MEASURE = "measure"
    """As a measurement of α, in a dithered window or without one."""

    PASSIVE = "passive"
    """As a passive estimate: it is of two places at once."""

    SETTLE = "settle"
    """To settle a doubt about α: it was taken before what cast the doubt."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VoidInterval:
    """Telemetry that began before a time is void."""

    until_ns_utc: int
    """That time, by the RTC's clock."""

    because: str
    """What was the matter."""

    purpose: Purpose = Purpose.MEASURE


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidityState:
    """Whether α may be relied on, why, and until when."""

    level: Validity = Validity.FRESH
    reason: str = ""
    """Why it is not fresh."""

    until_ns_utc: int | None = None
    """When it goes stale if nothing else is measured, by the service's clock; None: it is not
    valid, or never will go stale."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimedEstimate(Determination):
    """A dithered window as it was measured, whatever the filter made of it."""

    t_ns_utc: int
    """End of the telemetry it is of, the RTC's clock."""

    began_ns_utc: int = 0
    """Begin of that telemetry; 0: not kept."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointedEstimate(TimedEstimate):
    """An estimate of α, and where the telescope pointed."""

    pointing: Pointing | None
    """Of the telescope then; None: not known."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreviousEstimate(PointedEstimate):
    """The estimate before the last one: a jump inside that one is seen from here."""

    next_window: TimedEstimate | None = None
    """The window that entered next; None: it is not kept."""

    previous_estimate: PreviousEstimate | None = None
    """Before the window before that; None: that was the first, or it is not kept."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassiveBias(Bias):
    """The learnt bias of the passive estimate, with its σ."""

    offset: Array = field(default_factory=lambda: np.zeros(4))
    """``(4,)`` what a passive estimate reads more than α, numeric units."""

    covariance: Array = field(default_factory=lambda: np.zeros((4, 4)))
    """``(4, 4)`` of it."""

    shared: Array = field(default_factory=lambda: np.zeros((4, 4)))
    """``(4, n + 4 k)`` covariance of it (rows) with the ``n`` numbers of α, 6 with its
    anamorphosis, and the ``k`` biases before it (columns)."""

    looked_ns_utc: int = 0
    """End of the telemetry of the last passive estimate, the RTC's clock; 0: there was none."""

    loop: tuple[float, ...] = ()
    """``estimation.loop.loop_numbers`` of the loop it is the bias of; empty: not known."""

    previous_estimate: PreviousEstimate | None = None
    """α and bias together before that one; None: it was the first, or has been doubted."""


def without_previous(biases: tuple[PassiveBias, ...]) -> tuple[PassiveBias, ...]:
    """Return biases without what was known before their last looks: it tells nothing of now."""
    return tuple(replace(bias, previous_estimate=None) for bias in biases)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownStretches:
    """How well the anamorphosis in α is known; the numbers themselves are α's."""

    covariance: Array
    """``(2, 2)`` of both."""

    shared: Array
    """``(2, 4)`` covariance of both (rows) with the four of α (columns)."""

    @property
    def sigma(self) -> Array:
        """``(2,)`` 1 σ of both."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SuspectedJump(TimedEstimate):
    """A window far from all before, held until the next one says which of them was right.

    Where those before it have told the same place, it began with the first of them.
    """

    held_ns_utc: int
    """When it was put aside, by the service's clock."""

    text: str = ""
    """How far out it lies, for its alarm."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """The current estimate of α and how sure the service is of it."""

    alpha: Misregistration
    """The estimate."""

    covariance: Array
    """``(4, 4)`` at ``t_ns_utc``, numeric units (subapertures, radians, ratio), model-error floor
    not included."""

    floor: Array
    """``(4,)`` 1 σ of the model error that no integration removes, numeric units."""

    t_ns_utc: int
    """End of the last telemetry that entered the estimate, the RTC's clock."""

    arrived_ns_utc: int
    """When that arrived, by the service's clock: age is judged by arrival, never by comparing
    clocks."""

    n_windows: int
    """Windows that entered the estimate since it began, jumped, went stale or was restored."""

    scatter: float = 1.0
    """How much more windows scatter than they say, in variance, one beside the other: in bad seeing
    a pyramid's gains swing. Allowed for where a window is asked whether the mirror has jumped."""

    window_ns_utc: int = 0
    """When the last dithered window arrived, by the service's clock; 0: not known."""

    window_began_ns_utc: int = 0
    """When that window began, by the RTC's clock; 0: not known."""

    grown: Array = field(default_factory=lambda: np.zeros(4))
    """``(4,)`` variance that drift and flexure have added since ``t_ns_utc``, numeric units."""

    optical_gain: float | None = None
    """Mean modulus of the measured complex gain of the dithered modes; None: not measured."""

    optical_gains: tuple[ModeGain, ...] = ()
    """Of every mode that was dithered, in the order of the modes, bounded."""

    biases: tuple[PassiveBias, ...] = ()
    """Of the passive estimates that have told anything, in the order of the filter."""

    pointing: Pointing | None = None
    """Of the telescope at ``t_ns_utc``; None: not known."""

    window_pointing: Pointing | None = None
    """Of the telescope at the last dithered window; None: not known."""

    previous_estimate: PreviousEstimate | None = None
    """Before the last window; None: that was the first, or it was the first after a jump."""

    jumped_ns_utc: int | None = None
    """When it was last found to have jumped, by the service's clock; None: it has not."""

    suspected_jump: SuspectedJump | None = None
    """A jump that the next window confirms or denies; None: there is none."""

    doubt: str = ""
    """Why α may be somewhere else, until a dithered window decides; empty: no doubt."""

    doubt_voids: bool = True
    """Whether α is invalid for that: a look at ordinary telemetry alone only asks for a window."""

    validity: ValidityState = ValidityState()
    """How much it is worth now."""

    restored_ns_utc: int | None = None
    """When it was taken over from before a restart of the service; None: it is of this run."""

    basis_id: str | None = None
    """Of the modes it was measured with; None: not known."""

    config_id: str | None = None
    """Of the RTC's configuration; None: not known."""

    nominal: Misregistration | None = None
    """Where the law of pointing had the mirror when α was as it is here; None: there is no law."""

    stretches: KnownStretches | None = None
    """How well its anamorphosis is known; None: that is not followed."""

    def bias(self, block: BiasBlock) -> PassiveBias | None:
        """Return what is known of a bias; None: nothing is."""
        return next((bias for bias in self.biases if bias.block.name == block.name), None)

    @property
    def total_covariance(self) -> Array:
        """``(4, 4)`` covariance as it is now: growth and model-error floor added."""
        return self.covariance + np.diag(self.grown + self.floor**2)

    @property
    def covariance_to_hold_in(self) -> Array:
        """``(4, 4)`` as :attr:`total_covariance`, or ``(6, 6)`` with the anamorphosis.

        A stretch is a length as a magnification is: the model errs in it as much.
        """
        known = self.stretches
        if known is None:
            return self.total_covariance
        own = known.covariance + np.eye(2) * self.floor[3] ** 2
        return np.block([[self.total_covariance, known.shared.T], [known.shared, own]])

    @property
    def sigma(self) -> Array:
        """``(4,)`` 1 σ now, floor included, numeric units (rotation in radians)."""
        return np.sqrt(np.diag(self.total_covariance))

    @property
    def usable(self) -> bool:
        """Whether anything may be made or published from it without being asked for."""
        return self.validity.level is not Validity.INVALID


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HistoryEntry:
    """One measurement's own estimate and the filtered one after it."""

    t_ns_utc: int
    """End of the telemetry."""

    measured: Misregistration
    """What this measurement alone says; a passive one without the bias learnt."""

    measured_sigma: Array
    """``(4,)`` its 1 σ from the data, numeric units."""

    filtered: Misregistration
    """The Kalman estimate after it."""

    filtered_sigma: Array
    """``(4,)`` 1 σ of the filtered estimate, floor included, numeric units."""

    innovation: float
    """Normalised innovation squared (4 degrees of freedom); 0 for the first window."""

    misfit: float
    """Residual power over what noise explains; 1: the model explains the data. NaN: not known."""

    source: Source = Source.LOCK_IN
    """What it was made from."""

    entered: bool = True
    """False: it was too far out to be believed, and did not enter the estimate."""

    in_use: str | None = None
    """Id of the matrix in use when it was looked at; None: unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LawLeap:
    """A leap of what the law of pointing is told, that may be a mistake."""

    to: Misregistration
    """Where the law would have the mirror."""

    since_ns_utc: int
    worked_out_ns_utc: int
    """When it leapt, and when it was told last, by the service's clock."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LawState:
    """The nominal registration by the law of pointing."""

    nominal: Misregistration | None = None
    """Where it has the mirror now; None: there is no law, or nobody tells what it is of."""

    worked_out_ns_utc: int = 0
    """When that was worked out, by the service's clock."""

    way: tuple[tuple[int, Misregistration], ...] = ()
    """Where it had the mirror, and when by the RTC's clock: oldest first, bounded."""

    problem: str = ""
    """Why it is not followed, and what to do; empty: it is, or there is none."""

    leap: LawLeap | None = None
    """None: what it is told is believed."""

    pointing: Pointing | None = None
    """Where the telescope pointed when the nominal registration was worked out."""


def moved(registration: Registration, step: Array) -> Registration:
    """Return what is known of α with all of it a step ``(4,)`` further, numeric units."""
    return replace(
        registration,
        alpha=registration.alpha.stepped(step),
        previous_estimate=_previous_moved(registration.previous_estimate, step),
        suspected_jump=_moved(registration.suspected_jump, step),
        biases=tuple(
            replace(bias, previous_estimate=_previous_moved(bias.previous_estimate, step))
            for bias in registration.biases
        ),
    )


def _previous_moved(previous: PreviousEstimate | None, step: Array) -> PreviousEstimate | None:
    if previous is None:
        return None
    return replace(
        previous,
        alpha=previous.alpha.stepped(step),
        next_window=_moved(previous.next_window, step),
        previous_estimate=_previous_moved(previous.previous_estimate, step),
    )


def _moved(estimate: _Timed | None, step: Array) -> _Timed | None:
    return None if estimate is None else replace(estimate, alpha=estimate.alpha.stepped(step))


class OffloadState(StrEnum):
    """Outcomes of a demand to move the mirror's image."""

    ASKED = "asked"
    """No reply yet."""

    MOVED = "moved"
    """The device has taken it; α is expected where it should be, and measured again."""

    REFUSED = "refused"
    FAILED = "failed"
    """No reply: it may have moved or not."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Offload:
    """The last demand to move the mirror's image, with a lens or a stage."""

    id: str
    state: OffloadState = OffloadState.ASKED
    text: str = ""
    """The device's reason, or what it is waited for."""

    step: Array
    """``(4,)`` by how much α was to change, numeric units."""

    total: Array
    """``(4,)`` of all demands that were carried out, numeric units; outlives the service."""

    asked_ns_utc: int
    n_moves: int = 0
    """Demands that were carried out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassiveState:
    """The passive estimate, from ordinary telemetry, beside the dithered one."""

    alpha: Misregistration
    """As read: the bias is in it."""

    sigma: Array
    """``(4,)`` 1 σ of it as a reading of α, once the bias known is taken off; numeric units.
    Infinite where it cannot tell."""

    misfit: float
    """Residual power over what noise explains; 1: the model explains the telemetry. NaN: too young
    to tell."""

    t_ns_utc: int
    consistent: bool
    """False when it disagrees with the current α by more than its own uncertainty allows."""

    text: str
    """What the operator should know."""

    bias: Array = field(default_factory=lambda: np.zeros(4))
    """``(4,)`` what is known of its bias, numeric units; 0: nothing."""

    estimator: str = PASSIVE_BIAS.name
    """Which estimate it is, by the name of its bias: of several the last is shown."""
