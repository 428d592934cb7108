"""The settings of the tracker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from service.model.misregistration import Misregistration
from service.model.pointing_law import PointingLaw
from service.records.alarms import Interlock, Severity

if TYPE_CHECKING:
    from service.wire import Status

SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """An operators' own rule, as the settings have it."""

    name: str
    about: str
    """Name of a reported value, or of a field of the state."""

    how: str
    """``==``, ``!=``, ``<``, ``<=``, ``>`` or ``>=``."""

    than: bool | float | str
    blocks: frozenset[Interlock]
    """Actions that are forbidden while the condition holds."""

    severity: Severity
    text: str
    """Description of the condition, and what to do."""

    holds_unknown: bool
    """True if the condition holds while the value is unknown."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Offloading:
    """Limits of offloads; all arrays ``(4,)``, numeric units."""

    share: float
    """Fraction of the distance to the nominal registration that is requested at once."""

    near: NDArray[np.float64]
    """Distance below which nothing is requested."""

    max_step: NDArray[np.float64]
    """Largest change in one demand."""

    travel: NDArray[np.float64]
    """Range of all demands together, in either direction; 0 for a parameter that cannot be moved.
    """

    settle_s: float
    """Time from the reply until the image is at rest, if the reply does not state it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorModePolicy:
    """Properties of a sensor mode that the tracker needs."""

    subaperture_m: float
    """Width of a subaperture in the pupil plane: α's shifts are in it."""

    n_controlled: int | None
    """Modes to control at most; None: as many as are wanted."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Policy:
    """The settings of the tracker; :func:`service.runtime.policy.policy_of` makes it of the user's.

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
    """Vibrations that the dither avoids, in addition to those that are detected."""

    longest_pause_s: float
    """Longest pause between two windows, during which a jump may stay undetected; 0 for none."""

    dither_modes: tuple[int, ...] | None
    """Modes to dither; None for the four with most information among those the loop will not
    control."""

    mode_information: NDArray[np.float64] | None = None
    """``(n_modes, 4, 4)`` information on α in each mode; None if the model is not computed yet."""

    start: Misregistration = field(default_factory=Misregistration)
    """Start of a window's fit while α is unknown: the mirror's nominal rotation."""

    dither_frequencies_hz: tuple[float, ...] | None
    """None: spread over 0.2-0.35 of the frame rate."""

    window_s: float
    """Shortest window of dithered telemetry."""

    longest_window_s: float
    """Longest one; faint stars and small budgets need long windows."""

    drift_rate: NDArray[np.float64]
    """``(4,)`` random walk σ after one second, numeric units."""

    floor: NDArray[np.float64]
    """``(4,)`` 1 σ model error, numeric units."""

    image_floor: NDArray[np.float64]
    """``(4,)`` 1 σ of α by places of pupil images that the instrument file does not state."""

    image_sigma: NDArray[np.float64]
    """``(4,)`` 1 σ of α by unmeasured places of pupil images; ``image_floor``, or a part of
    ``floor`` if the instrument file calls them unknown."""

    bias_memory_s: float
    """Time after which the information learnt on the passive estimate's bias has decayed to 1/e."""

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
    """True if the service acquires an unknown α on its own initiative, in mode auto."""

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

    worst_seeing_arcsec: float = 1.2
    """Seeing in which the loop must survive with the references of a shape."""

    references_ramp_s: float = 1.0
    """Duration of the ramp to other references."""

    rules: tuple[Rule, ...]
    """Operators' own."""

    opens_lost_loop: bool | None
    """True if a loop that is lost with a new matrix is opened when a rollback does not help; None
    to do so if the mode was auto when the matrix was applied."""

    offloading: Offloading | None
    """None: α is corrected by the matrix alone."""

    sensor_modes: Mapping[str, SensorModePolicy] = field(default_factory=dict)
    """Modes that the sensor may change to, by their ``config_id``; empty: it has one alone."""

    law: PointingLaw | None = None
    """Registration as a function of the pointing; None if it is constant."""

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
        # Only shifts are measured in subapertures; rotation and magnification have no width.
        return np.array([shift, shift, 1.0, 1.0])
