"""Records of α: the estimate in force, its gains and bias, history, law and offload."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import Determination, Misregistration
from service.wire import Pointing

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeGain:
    """Optical gain of one mode, averaged over the windows in which it was dithered."""

    mode: int
    """0-based basis index."""

    gain: float
    """Modulus of the measured over the modelled response."""

    sigma: float
    """1 σ of ``gain`` at ``t_ns_utc``."""

    scatter: float
    """1 σ of a single window, from the scatter of the windows."""

    t_ns_utc: int
    """End of the last window in which the mode was dithered, ns since the Unix epoch, UTC."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredGains:
    """Optical gains of the dithered modes at one moment, and the conditions then."""

    measured: tuple[ModeGain, ...]
    """Gain of every mode that was dithered, in mode order."""

    n_modes: int
    """Modes of the basis."""

    reference_id: str | None = None
    """Reference slopes that the RTC used; None if unknown."""

    magnitude: float | None = None
    """Magnitude of the guide star; None if unknown."""

    frame_rate_hz: float | None = None
    """Frame rate; None if unknown."""

    @property
    def t_ns_utc(self) -> int | None:
        """End of the last window in which a mode was dithered, the RTC's clock; None if none."""
        return max((gain.t_ns_utc for gain in self.measured), default=None)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bias:
    """State of the bias of the passive estimate, besides mean and covariance."""

    excess: Array = field(default_factory=lambda: np.zeros(4))
    """``(4,)`` variance of the bias beyond its floor that estimates have indicated, and that is in
    the covariance or has been learnt since."""

    scatter: float = 1.0
    """Ratio of the scatter of estimates to their covariances, in variance; at least 1."""


class Source(StrEnum):
    """Sources of a measurement of α."""

    LOCK_IN = "lock-in"
    """A window of sinusoidal dither."""

    RANDOM = "random"
    """A window of random dither."""

    PASSIVE = "passive"
    """Ordinary telemetry: biased by the wind."""


class Validity(StrEnum):
    """Validity of α: whether it may be used."""

    FRESH = "fresh"
    """σ, less the model error, is below half of the limit."""

    AGEING = "ageing"
    """σ grows towards the limit."""

    STALE = "stale"
    """σ, less the model error, is beyond the limit, or α is unconfirmed since a restart."""

    PREDICTED = "predicted"
    """The pointing law has leapt: nothing is made from α until a window has confirmed it."""

    INVALID = "invalid"
    """α may have changed: nothing is made from it without an order."""


class Purpose(StrEnum):
    """Uses for which an interval of telemetry may be void."""

    MEASURE = "measure"
    """Measurement of α, with or without a dither."""

    PASSIVE = "passive"
    """Passive estimate. The interval contains telemetry of two registrations."""

    SETTLE = "settle"
    """To settle a doubt about α: it was taken before what cast the doubt."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VoidInterval:
    """Telemetry that began before a time is void."""

    until_ns_utc: int
    """End of the interval, by the RTC's clock."""

    because: str
    """Reason why the interval is void."""

    purpose: Purpose = Purpose.MEASURE


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidityState:
    """Validity of α, its reason, and its end."""

    level: Validity = Validity.FRESH
    reason: str = ""
    """Why it is not fresh."""

    until_ns_utc: int | None = None
    """Time at which α becomes stale without a new measurement, by the service's clock. None if α is
    not valid or never becomes stale."""


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
    """Pointing of the telescope at that time; None if unknown."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreviousEstimate(PointedEstimate):
    """The estimate before the last one: a jump inside that one is seen from here."""

    next_window: TimedEstimate | None = None
    """The window that entered next; None: it is not kept."""

    previous_estimate: PreviousEstimate | None = None
    """Estimate before the previous window; None if that window was the first or its estimate is not
    kept."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassiveBias(Bias):
    """The learnt bias of the passive estimate, with its σ."""

    offset: Array = field(default_factory=lambda: np.zeros(4))
    """``(4,)`` what a passive estimate reads more than α, numeric units."""

    covariance: Array = field(default_factory=lambda: np.zeros((4, 4)))
    """``(4, 4)`` of it."""

    shared: Array = field(default_factory=lambda: np.zeros((4, 4)))
    """``(4, n)`` covariance of it (rows) with the ``n`` numbers of α, 6 with its anamorphosis
    (columns)."""

    looked_ns_utc: int = 0
    """End of the telemetry of the last passive estimate, the RTC's clock; 0: there was none."""

    loop: tuple[float, ...] = ()
    """``estimation.loop.loop_numbers`` of the loop it is the bias of; empty: not known."""

    previous_estimate: PreviousEstimate | None = None
    """α and bias together before that one; None: it was the first, or has been doubted."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownStretches:
    """Accuracy of the anamorphosis in α; its values are part of α."""

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
    """A window far from all previous ones, held until the next window confirms or refutes it.

    If earlier windows have found the same registration, the jump began with the first of them.
    """

    held_ns_utc: int
    """Time at which the window was put aside, by the service's clock."""

    text: str = ""
    """Size of the deviation in words, for the alarm."""


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
    """Arrival time of that telemetry, by the service's clock. Age is measured by arrival times
    only, because the RTC's clock may be wrong."""

    n_windows: int
    """Windows that entered the estimate since it began, jumped, went stale or was restored."""

    scatter: float = 1.0
    """Ratio of the variance between windows to the variance that they predict. In bad seeing the
    optical gains of a pyramid fluctuate. The jump detection takes it into account."""

    window_ns_utc: int = 0
    """Arrival time of the last dithered window, by the service's clock; 0 if unknown."""

    window_began_ns_utc: int = 0
    """Start of that window, by the RTC's clock; 0 if unknown."""

    image_floor: Array = field(default_factory=lambda: np.zeros(4))
    """``(4,)`` 1 σ by places of pupil images that the instrument file does not state, numeric
    units. It is no part of ``total_covariance``: a reconstructor of this α compensates for the
    displaced images, one of the true α does not."""

    grown: Array = field(default_factory=lambda: np.zeros(4))
    """``(4,)`` variance that drift and flexure have added since ``t_ns_utc``, numeric units."""

    optical_gain: float | None = None
    """Mean modulus of the measured complex gain of the dithered modes; None: not measured."""

    optical_gains: tuple[ModeGain, ...] = ()
    """Optical gain of every mode that was dithered, in mode order, bounded in number."""

    bias: PassiveBias | None = None
    """Bias of the passive estimate; None if none has contributed."""

    pointing: Pointing | None = None
    """Pointing of the telescope at ``t_ns_utc``; None if unknown."""

    window_pointing: Pointing | None = None
    """Pointing of the telescope during the last dithered window; None if unknown."""

    previous_estimate: PreviousEstimate | None = None
    """Estimate before the last window; None if that window was the first, or the first after a
    jump."""

    jumped_ns_utc: int | None = None
    """Time of the last jump found, by the service's clock; None if there was none."""

    suspected_jump: SuspectedJump | None = None
    """A jump that the next window confirms or denies; None: there is none."""

    doubt: str = ""
    """Why α may be somewhere else, until a dithered window decides; empty: no doubt."""

    doubt_voids: bool = True
    """True if the suspected jump makes α invalid. A jump suspected from ordinary telemetry alone
    only requests a dithered window."""

    validity: ValidityState = ValidityState()
    """Present validity of α."""

    restored_ns_utc: int | None = None
    """Time at which α was restored from before a restart, by the service's clock; None if it was
    measured since."""

    basis_id: str | None = None
    """Modal basis that α was measured with; None if unknown."""

    config_id: str | None = None
    """Sensor configuration that α was measured with; None if unknown."""

    nominal: Misregistration | None = None
    """Registration by the pointing law at the time of this α; None if there is no law."""

    stretches: KnownStretches | None = None
    """Accuracy of its anamorphosis; None if anamorphosis is not tracked."""

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
    def tracking_sigma(self) -> Array:
        """``(4,)`` 1 σ of changes of α now: without the model error, the same for every window.

        Limits of age apply to it. The model error is neither age nor reduced by a window: it
        includes unknown places of pupil images, a coarse mirror and what windows leave unexplained.
        Whether a loop is safe with it is decided by the stability gate, which examines α ± 3σ.
        """
        return np.sqrt(np.diag(self.covariance) + self.grown)

    @property
    def shown_covariance(self) -> Array:
        """``(4, 4)`` covariance of the error of α now, unstated places of images included."""
        return self.total_covariance + np.diag(self.image_floor**2)

    @property
    def shown_sigma(self) -> Array:
        """``(4,)`` 1 σ of the error of α now, unstated places of images included."""
        return np.sqrt(np.diag(self.shown_covariance))

    @property
    def usable(self) -> bool:
        """Return True if reconstructors may be computed and published from it without an order."""
        return self.validity.level not in {Validity.INVALID, Validity.PREDICTED}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HistoryEntry:
    """One measurement's own estimate and the filtered one after it."""

    t_ns_utc: int
    """End of the telemetry."""

    measured: Misregistration
    """Result of this measurement alone; for a passive one, without the learnt bias."""

    measured_sigma: Array
    """``(4,)`` its 1 σ from the data, numeric units."""

    filtered: Misregistration
    """The Kalman estimate after it."""

    filtered_sigma: Array
    """``(4,)`` 1 σ of the filtered estimate, numeric units, floor and unstated places of images
    included."""

    innovation: float
    """Normalised innovation squared (4 degrees of freedom); 0 for the first window."""

    misfit: float
    """Residual power over what noise explains; 1: the model explains the data. NaN: not known."""

    source: Source = Source.LOCK_IN
    """Kind of measurement."""

    entered: bool = True
    """False if the measurement was rejected as an outlier and is not part of the estimate."""

    in_use: str | None = None
    """Id of the matrix in use when it was looked at; None: unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LawLeap:
    """A step of the pointing law that no window has confirmed: α is on one side of it."""

    step: tuple[float, ...]
    """Step of the law, numeric units."""

    taken: bool
    """True if α has been moved by it."""

    far: bool = False
    """True if no fit reaches across it. If it lasts, α takes it without a window."""

    since_ns_utc: int
    """Time of the step, by the service's clock."""

    text: str
    """Values that have leapt and what follows, for the alarm."""

    @property
    def other_side(self) -> Array:
        """Way ``(4,)`` from α to where it is if the other side is right, numeric units."""
        return np.array(self.step) * (-1.0 if self.taken else 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LawState:
    """The nominal registration by the law of pointing."""

    nominal: Misregistration | None = None
    """Present registration by the law; None if there is no law or its input is not reported."""

    reported: tuple[tuple[str, float], ...] = ()
    """Values that the law depends on, by name, as they were then."""

    worked_out_ns_utc: int = 0
    """Time at which it was computed, by the service's clock."""

    way: tuple[tuple[int, Misregistration], ...] = ()
    """Previous registrations by the law with their times by the RTC's clock, oldest first, bounded
    in number."""

    usual_step: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    """Size of its recent steps from one report to the next."""

    usual_ns_utc: int = 0
    """Time of the last of them, by the service's clock."""

    problem: str = ""
    """Why it is not followed, and what to do; empty: it is, or there is none."""

    leap: LawLeap | None = None
    """Step that no window has confirmed; None if there is none."""


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
    """``(4,)`` of all demands that were, or may have been, carried out, numeric units; outlives
    the service."""

    asked_ns_utc: int
    n_moves: int = 0
    """Demands that were carried out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassiveState:
    """The passive estimate from ordinary telemetry, shown next to the dithered one."""

    alpha: Misregistration
    """α as estimated, its bias included."""

    sigma: Array
    """``(4,)`` 1 σ as a measurement of α after the known bias is subtracted, numeric units.
    Infinite where the telemetry contains no information."""

    misfit: float
    """Residual power divided by the power that noise explains; 1 if the model explains the
    telemetry. NaN if there is too little telemetry."""

    t_ns_utc: int
    consistent: bool
    """False when it disagrees with the current α by more than its own uncertainty allows."""

    text: str
    """Explanation for the operator."""

    bias: Array = field(default_factory=lambda: np.zeros(4))
    """``(4,)`` what is known of its bias, numeric units; 0: nothing."""

    estimator: str = "passive"
    """Name of the estimator."""
