"""The registration as it leaves over REST: estimate, worth, history, watchdog."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.routes.service import Snapshot
from service.routes.views import FourView, Number, View
from service.state import Registration, Source, Validity


class PointingView(View):
    """Where the telescope looks."""

    elevation_deg: Number
    """Above the horizon."""

    azimuth_deg: Number
    """From north over east."""


class ModeGainView(View):
    """The optical gain of one mode."""

    mode: int
    """0-based basis index."""

    gain: Number
    """Sensor's response over the model's."""

    gain_sigma: Number = Field(validation_alias="sigma")
    """1 σ of it."""

    gain_scatter: Number = Field(validation_alias="scatter")
    """1 σ of a single window."""

    t_ns_utc: int
    """End of the last window that held this mode."""


class AlphaView(View):
    """The current estimate of the registration."""

    alpha: FourView
    """The estimate."""

    sigma: FourView
    """1 σ now: grown with the time since, model-error floor included."""

    floor: FourView
    """1 σ of the model error alone, which no integration removes."""

    covariance: list[list[Number]] = Field(min_length=4, max_length=4)
    """4 x 4, now, floor included, in the units of the names and the order of ``parameters``."""

    parameters: tuple[str, ...] = PARAMETERS
    """Order of rows and columns of the covariance."""

    t_ns_utc: int
    """End of the last telemetry that entered it, the RTC's clock."""

    age_s: float
    """Since that arrived, seconds."""

    window_age_s: Number
    """Since the last dithered window arrived, seconds; null: not known."""

    n_windows: int
    """Windows that agree with one another since it began, jumped, went stale or was restored."""

    validity: Validity
    """Whether it may be relied on."""

    validity_reason: str
    """Why it is not fresh."""

    valid_until_ns_utc: int | None
    """When it goes stale if nothing else is measured, the service's clock; null: it is not valid,
    or never will go stale."""

    restored_ns_utc: int | None
    """When it was taken over from before a restart of the service; null: it was not."""

    jumped_ns_utc: int | None
    """When it was last found to have jumped, the service's clock; null: it has not."""

    suspected: FourView | None
    """Where the last window saw it, too far away to be believed before another one has; null: no
    jump is suspected."""

    optical_gain: Number
    """Mean optical gain of the dithered modes; null: not measured."""

    optical_gains: tuple[ModeGainView, ...]
    """Of each mode that was dithered, followed over the windows."""

    passive_bias: FourView | None
    """What the passive estimate reads more than α, as far as learnt; null: nothing is known."""

    passive_bias_sigma: FourView | None
    """1 σ of it."""

    pointing: PointingView | None
    """Of the telescope when it was last measured; null: not known."""

    @classmethod
    def of(cls, registration: Registration, snapshot: Snapshot) -> AlphaView:
        """Return the view of the registration at the time of the snapshot."""
        covariance = registration.total_covariance * np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)
        same = {
            name: getattr(registration, name)
            for name in cls.model_fields
            if hasattr(registration, name)
        }
        bias, standing, candidate = (
            registration.bias,
            registration.standing,
            registration.candidate,
        )
        window_ns = registration.window_ns_utc
        return cls.model_validate(
            same
            | {
                "covariance": covariance.tolist(),
                "age_s": age_s(registration, snapshot),
                "window_age_s": (snapshot.now_ns - window_ns) / 1e9 if window_ns else None,
                "validity": standing.validity,
                "validity_reason": standing.reason,
                "valid_until_ns_utc": standing.until_ns_utc,
                "suspected": candidate and candidate.alpha,
                "passive_bias": bias and bias.offset,
                "passive_bias_sigma": bias and np.sqrt(np.diag(bias.covariance)),
            }
        )


def age_s(registration: Registration, snapshot: Snapshot) -> float:
    """Return the age of the estimate, seconds."""
    arrival_ns = snapshot.estimate_arrival_ns
    then_ns = registration.t_ns_utc if arrival_ns is None else arrival_ns
    return (snapshot.now_ns - then_ns) / 1e9


class HistoryEntryView(View):
    """One measurement's own estimate and the filtered one after it."""

    t_ns_utc: int
    """End of the telemetry."""

    measured: FourView
    """What this measurement alone says; a passive one without the bias learnt."""

    measured_sigma: FourView
    """1 σ of it."""

    filtered: FourView
    """The estimate after it."""

    filtered_sigma: FourView
    """1 σ of it, floor included."""

    innovation: Number
    """Normalised innovation squared (4 degrees of freedom)."""

    misfit: Number
    """Goodness of fit: residual power over what noise explains. 1: the model explains the data;
    more: the floor of α grows with it; null: not known."""

    source: Source
    """What it was made from."""

    entered: bool
    """False: it was too far out to be believed, and did not enter the estimate."""


class HistoryView(View):
    """The last estimates."""

    entries: tuple[HistoryEntryView, ...]
    """Oldest first."""


class WatchdogView(View):
    """The passive estimate, from ordinary telemetry."""

    alpha: FourView
    """As read: its bias is in it."""

    sigma: FourView
    """1 σ of it as a reading of α, once the bias known is taken off; null: it cannot tell."""

    bias: FourView
    """What is known of its bias."""

    misfit: Number
    """Goodness of fit: residual power over what noise explains. 1: the model explains the
    telemetry; far from it, either way: turbulence is in it, and the shifts are worth less; null:
    too young to tell."""

    t_ns_utc: int
    consistent: bool
    """False: it contradicts the current estimate."""

    text: str
    """What to know about it."""
