"""The settings of the tracker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import Misregistration
from service.model.pointing_law import PointingLaw
from service.tracking.alarms import Interlock, Severity

if TYPE_CHECKING:
    from service.wire import Status

SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """An operators' own rule, as the settings have it."""

    name: str
    about: str
    """Name of a value that is told, or of a field of the state."""

    how: str
    """``==``, ``!=``, ``<``, ``<=``, ``>`` or ``>=``."""

    than: bool | float | str
    blocks: frozenset[Interlock]
    """What is forbidden while it holds."""

    severity: Severity
    text: str
    """What is the matter, and what to do."""

    holds_unknown: bool
    """Whether it holds while nobody tells the value."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Offloading:
    """Limits of offloads; all arrays ``(4,)``, numeric units."""

    share: float
    """Of the way back to the nominal registration that is asked for at once."""

    near: NDArray[np.float64]
    """Nearer than this nothing is asked for."""

    max_step: NDArray[np.float64]
    """Of one demand."""

    travel: NDArray[np.float64]
    """Of all demands together, either way; 0: what cannot be moved."""

    settle_s: float
    """From the reply until the image stands still, where the reply does not say."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorModePolicy:
    """What the tracker must know of a mode of the sensor."""

    subaperture_m: float
    """Width of a subaperture in the pupil plane: α's shifts are in it."""

    n_controlled: int | None
    """Modes to control at most; None: as many as are wanted."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Policy:
    """The settings of the tracker; :func:`service.config.policy.policy_of` makes it of the user's.

    What users decide has its default there, and no other here.
    """

    dither_enabled: bool
    dither_amplitude_m: float | None
    """RMS of each dithered mode, metres OPD; None: as little as serves."""

    dither_budget_m: float
    """Largest RMS of all modes together, metres OPD."""

    dither_sigma: NDArray[np.float64]
    """``(4,)`` 1 σ of α to be kept by dithering, numeric units, model error not included."""

    dither_avoid_hz: tuple[float, ...]
    """Vibrations the dither keeps clear of, besides those that are heard."""

    longest_pause_s: float
    """Between two windows, for so long a jump may go unseen; 0: no pause at all."""

    dither_modes: tuple[int, ...] | None
    """None: the four that tell most among those the loop will not control."""

    mode_information: NDArray[np.float64] | None = None
    """``(n_modes, 4, 4)`` what each mode tells of α; None: the model is not known yet."""

    start: Misregistration = field(default_factory=Misregistration)
    """Where the fit of a window begins while α is not known: the mirror's nominal rotation."""

    dither_frequencies_hz: tuple[float, ...] | None
    """None: spread over 0.2-0.35 of the frame rate."""

    dither_duration_s: float = 120.0
    """Of a request of an operator's who does not say."""

    window_s: float
    """Shortest window of dithered telemetry."""

    longest_window_s: float
    """Longest one; faint stars and small budgets need long windows."""

    drift_rate: NDArray[np.float64]
    """``(4,)`` random walk σ after one second, numeric units."""

    floor: NDArray[np.float64]
    """``(4,)`` 1 σ model error, numeric units."""

    bias_memory_s: float
    """After so long what was learnt of the passive estimate's bias is worth 1/e."""

    passive: str
    """What the passive estimate is made of: slopes or commands."""

    flexure_per_degree: NDArray[np.float64]
    """``(4,)`` 1 σ of what a degree of elevation does to α, numeric units."""

    slew_limit_deg: float
    """A telescope that has moved further than this makes α invalid until the next window."""

    stale_sigma: NDArray[np.float64]
    """``(4,)`` 1 σ from which on α is stale, numeric units, beyond what the model error adds."""

    useless_sigma: NDArray[np.float64]
    """``(4,)`` 1 σ of a window or of α that is too large to be useful, numeric units, beyond what
    the model error adds."""

    tolerance: NDArray[np.float64]
    """``(4,)`` how much more misregistration this loop tolerates than that of FLAO, 1 or more."""

    acquires: bool
    """Whether the service finds α from nothing by itself, in mode auto."""

    acquisition_amplitude_m: float
    """RMS of each mode dithered while the loop is open for it, metres OPD."""

    n_modes_target: int
    """Modes to control once the registration is known."""

    update_threshold: NDArray[np.float64]
    """``(4,)`` change of α that makes a new reconstructor whatever it wins, numeric units."""

    update_gain_m: float
    """Expected loss of wavefront error that makes a new reconstructor worthwhile, metres."""

    update_margin: float
    """The same of the stability margin: share of a new one's that is lost."""

    minimum_interval_s: float
    """Least time between two reconstructors."""

    rules: tuple[Rule, ...]
    """Operators' own."""

    opens_lost_loop: bool | None
    """Whether a loop that is lost with a matrix just applied is asked to open where going back does
    not help; None: where the mode was auto when it was applied."""

    offloading: Offloading | None
    """None: α is corrected by the matrix alone."""

    sensor_modes: Mapping[str, SensorModePolicy] = field(default_factory=dict)
    """Modes that the sensor may change to, by their ``config_id``; empty: it has one alone."""

    law: PointingLaw | None = None
    """Where the mirror lies at any pointing; None: at the same place."""

    refused_interval_s: float = 30.0
    """The same after one was refused, rejected or not acknowledged."""

    def wanted_modes(self, rtc: Status) -> int:
        """Return how many modes are to be controlled once the registration is known."""
        mode = self.sensor_modes.get(rtc.config_id)
        most = rtc.n_modes if mode is None or mode.n_controlled is None else mode.n_controlled
        return min(self.n_modes_target, rtc.n_modes, most)

    def alpha_scale(self, before: str | None, now: str | None) -> NDArray[np.float64] | None:
        """Return what ``(4,)`` numbers of α become in another mode: they are multiplied by this.

        The mirror's image stays where it is, and subapertures have another width. None: one of the
        two is no mode of the sensor.
        """
        modes = self.sensor_modes
        if before is None or now is None or not {before, now} <= modes.keys():
            return None
        shift = modes[before].subaperture_m / modes[now].subaperture_m
        return np.array([shift, shift, 1.0, 1.0])
