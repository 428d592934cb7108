"""A snapshot of the service for REST, metrics and page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from service.control.gains import gain_table
from service.link.statistics import LinkStatistics
from service.model.misregistration import COVARIANCE_SCALE, PARAMETERS, Misregistration
from service.records.alarms import (
    ALARMS,
    Alarm,
    AlarmDefinition,
    AlarmRecord,
    Prerequisite,
    Severity,
)
from service.records.commands import GainGroup
from service.records.messages import Value
from service.records.products import ReferencesRecord
from service.records.registration import MeasuredGains, ModeGain, Registration
from service.records.state import LogEntry, ReferenceStates, TrackerState
from service.tracking.alarm_records import muted_records, record_of, stale_records, worst_severity
from service.tracking.interlocks import Permission, permissions
from service.tracking.operations.running import Operating, operating
from service.tracking.policy import Policy
from service.tracking.reconstructors import check_return
from service.tracking.references import explain_waiting
from service.wire import Status

IMAGES_LIMIT = "measure the places of the pupil images: pyrcal instrument check FILE --light FRAME"
"""Remedy where the places of the pupil images are most of the variance of α."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerLoad:
    """Processor time of the last minute, and whether the worker keeps up."""

    worker_per_s: float | None = None
    """Processor time of the worker for each second of telemetry; None: there was none."""

    by_job: Mapping[str, float] = field(default_factory=dict)
    """The same by kind of job, what costs most first."""

    service_per_s: float | None = None
    """Processor time of the service itself for each second of the clock."""

    busy_ratio: float | None = None
    """Share of the time in which the worker had a job."""

    window_s: float | None = None
    """Mean length of the windows fitted, seconds; None: none was."""

    windows_late: int = 0
    """Windows that came while another still waited for the worker, and were joined to it."""


def in_words(waiting_for: tuple[Prerequisite, ...]) -> str:
    """Return what the service waits for, or that it is ready."""
    return "; ".join(f"{wait.responsible}: {wait.text}" for wait in waiting_for) or "ready"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """State of the service at one moment, for all readers."""

    tracker: TrackerState
    """Registration, reconstructors, operations and alarms."""

    policy: Policy
    """The user's numbers that the service goes by."""

    link: LinkStatistics
    """Statistics of the link."""

    now_ns: int
    """Time of the snapshot by the service's clock, nanoseconds since the Unix epoch."""

    started_ns: int
    """Start of the service by the same clock."""

    ready: bool
    """True if the service can do its work."""

    ready_reason: str
    """Prerequisite that the service waits for, or that there is none."""

    waiting_for: tuple[Prerequisite, ...] = ()
    """Whom the service waits for and what they should do, what hinders most first."""

    worker_load: WorkerLoad = field(default_factory=WorkerLoad)
    """Processor time and memory of the worker."""

    archive_failures: int = 0
    """Attempts to write that the disk has refused."""

    archive_waiting: int = 0
    """Lines of the audit trail that are not on the disk yet."""

    instrument_remarks: tuple[str, ...] = ()
    """Remarks on the instrument file: assumptions and missing values, such as petals that no mode
    can move."""

    stalled: str = ""
    """Part of the service that has stopped responding, and for how long; empty if there is none."""

    @property
    def uptime_s(self) -> float:
        """Time since the service started, seconds."""
        return (self.now_ns - self.started_ns) / 1e9

    @property
    def operating(self) -> Operating:
        """State and operation of the service, in a control room's terms."""
        hindered = "; ".join(wait.text for wait in self.waiting_for if wait.blocks)
        return operating(self.tracker, hindered, self.now_ns)

    @property
    def permitted(self) -> Mapping[str, Permission]:
        """Orders by name, each with its permission; a refusal has the reason and what to do."""
        return permissions(self.tracker, self.policy, self.now_ns)

    @property
    def window_refusal(self) -> LogEntry | None:
        """The last window that was refused, and why; null: none was."""
        last = self.tracker.windows.refusal
        return last and replace(last, t_ns_utc=last.last_ns_utc or last.t_ns_utc)

    @property
    def alarms(self) -> tuple[AlarmStatus, ...]:
        """Active alarms, in the order in which they were raised."""
        raised = self.tracker.alarms.active
        return tuple(
            AlarmStatus(record=record_of(self.tracker, alarm), alarm=alarm) for alarm in raised
        )

    @property
    def stale_alarms(self) -> tuple[AlarmStatus, ...]:
        """Alarms that ended and were not acknowledged."""
        return tuple(AlarmStatus(record=record) for record in stale_records(self.tracker))

    @property
    def muted_alarms(self) -> tuple[AlarmRecord, ...]:
        """Muted alarms, whether active or not."""
        return muted_records(self.tracker)

    @property
    def worst_severity(self) -> Severity | None:
        """Highest severity of active and unacknowledged alarms; null if there are none."""
        return worst_severity(self.tracker)

    @property
    def alpha(self) -> Alpha | None:
        """Null until the first accepted window."""
        registration = self.tracker.alpha.registration
        return None if registration is None else Alpha(registration=registration, snapshot=self)

    @property
    def no_return(self) -> str | None:
        """Why the matrix in use could not be sent back after another one; null: it could."""
        return check_return(self.tracker)

    @property
    def references(self) -> References:
        """The shape that the loop is to hold, and the references for it."""
        return References(tracker=self.tracker)

    @property
    def rtc(self) -> Rtc | None:
        """Null: no RTC has been seen, or it has vanished."""
        known = self.tracker.loop.rtc
        return None if known is None else Rtc(status=known)


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmStatus:
    """An alarm that lasts, or went unseen: how much it matters, what to do, who knows of it."""

    record: AlarmRecord
    alarm: Alarm | None = None
    """None: it does not last."""

    @property
    def severity(self) -> Severity | None:
        """Null: it does not last."""
        return None if self.alarm is None else self.alarm.definition.severity

    @property
    def code(self) -> str | None:
        """Code of the message; null if the alarm does not last."""
        return None if self.alarm is None else self.alarm.message.code

    @property
    def values(self) -> Mapping[str, Value]:
        """Values in the message; empty if the alarm does not last."""
        return {} if self.alarm is None else self.alarm.message.values

    @property
    def cause(self) -> str:
        """Meaning of an alarm of this name."""
        return self._known.means if self._known else ""

    @property
    def do(self) -> str:
        """Remedy for an alarm of this name."""
        return self._known.do if self._known else ""

    @property
    def _known(self) -> AlarmDefinition | None:
        return self.alarm.definition if self.alarm else ALARMS.get(self.record.name)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alpha:
    """The current estimate of the registration."""

    registration: Registration
    snapshot: Snapshot

    @property
    def covariance(self) -> list[list[float]]:
        """4 x 4, of the error of α now, in units of the names and the order of ``parameters``."""
        found: list[list[float]] = (self.registration.shown_covariance * COVARIANCE_SCALE).tolist()
        return found

    @property
    def parameters(self) -> tuple[str, ...]:
        """Order of rows and columns of the covariance."""
        return PARAMETERS

    @property
    def anamorphosis_sigma(self) -> tuple[float, ...] | None:
        """1 σ of both numbers of α's anamorphosis; null: it is not followed."""
        known = self.registration.stretches
        return None if known is None else tuple(known.sigma.tolist())

    @property
    def sigma_limit(self) -> str | None:
        """Cause of sigma that can be measured, with the remedy; null if none is known."""
        images = self.snapshot.policy.image_sigma
        return IMAGES_LIMIT if np.any(images > self.registration.shown_sigma / np.sqrt(2)) else None

    @property
    def age_s(self) -> float:
        """Age of the last telemetry that entered the estimate, by its arrival, seconds."""
        return (self.snapshot.now_ns - self.registration.arrived_ns_utc) / 1e9

    @property
    def window_age_s(self) -> float | None:
        """Age of the last dithered window, by its arrival, seconds; null if unknown."""
        window_ns = self.registration.window_ns_utc
        return (self.snapshot.now_ns - window_ns) / 1e9 if window_ns else None

    @property
    def suspected(self) -> Misregistration | None:
        """Registration of the last window if a jump is suspected; null otherwise.

        It is too far away to be accepted before another window confirms it.
        """
        return (
            None
            if self.registration.suspected_jump is None
            else self.registration.suspected_jump.alpha
        )

    @property
    def passive_bias(self) -> NDArray[np.float64] | None:
        """Bias of the passive estimate, as far as learnt; null: unknown."""
        bias = self.registration.bias
        return None if bias is None else bias.offset

    @property
    def passive_bias_sigma(self) -> NDArray[np.float64] | None:
        """1 σ of it."""
        bias = self.registration.bias
        return None if bias is None else np.sqrt(np.diag(bias.covariance))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class References:
    """The shape that the loop is to hold, and the references for it."""

    tracker: TrackerState

    @property
    def kept(self) -> ReferenceStates:
        """All that is known of them."""
        return self.tracker.references

    @property
    def used(self) -> ReferencesRecord | None:
        """References of the service that the RTC uses; null if it uses none of them."""
        return self.tracker.references_of(self.kept.used_id)

    @property
    def newest(self) -> ReferencesRecord | None:
        """References made last, such as those that wait for approval; null if none were made."""
        return next(iter(self.kept.records[::-1]), None)

    @property
    def verified(self) -> bool:
        """True if the RTC has shown that it subtracts what was sent."""
        return self.kept.used_id is not None and self.kept.used_id == self.kept.verified_id

    @property
    def waiting(self) -> str:
        """Reason why no references are made or followed now; empty if they are."""
        return explain_waiting(self.tracker)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rtc:
    """The RTC as its last status message shows it."""

    status: Status

    @property
    def gains(self) -> tuple[GainGroup, ...]:
        """Gains of all modes of the basis, 0 where uncontrolled: neighbours with the same gain."""
        groups, first = [], 0
        for gain, run in groupby(self.status.gains):
            last = first + sum(1 for _ in run) - 1
            groups.append(GainGroup(first=first, last=last, gain=gain))
            first = last + 1
        return tuple(groups)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeGainTable:
    """Optical gains, and the factors of the loop gains that undo them, mode by mode."""

    reconstructor: str | None
    """The one it goes with; None: the present gains, with whichever is in use."""

    measured: tuple[ModeGain, ...]
    """Empty: the table is only what is expected at 1 arcsec of seeing."""

    optical_gain: list[float]
    """Ratio of the sensor's response to the model's, for each mode."""

    relative_sigma: list[float]
    """1 σ of each as a share of it; it grows away from the measured modes."""

    sigma: list[float]
    """1 σ of each."""

    factor: list[float]
    """Factor for one loop gain of all modes, for each mode: mean 1, range 0.5 to 2."""

    t_ns_utc: int | None
    """End of the last window in which one of them was measured; None if none was."""

    reference_id: str | None
    """Reference slopes that the RTC used; None if unknown."""

    magnitude: float | None
    """Magnitude of the guide star then; None if unknown."""

    frame_rate_hz: float | None
    """Frame rate then; None if unknown."""

    @classmethod
    def of(cls, gains: MeasuredGains, matrix_id: str | None = None) -> ModeGainTable:
        """Infer the gains of all modes from the measured ones."""
        table = gain_table(gains.measured, gains.n_modes)
        return cls(
            reconstructor=matrix_id,
            measured=gains.measured,
            optical_gain=table.optical_gain.tolist(),
            relative_sigma=table.relative_sigma.tolist(),
            sigma=(table.optical_gain * table.relative_sigma).tolist(),
            factor=table.factors.tolist(),
            t_ns_utc=gains.t_ns_utc,
            reference_id=gains.reference_id,
            magnitude=gains.magnitude,
            frame_rate_hz=gains.frame_rate_hz,
        )


def present_gains(state: TrackerState) -> MeasuredGains | None:
    """Return the measured gains with the present conditions; None without an RTC."""
    rtc, registration = state.loop.rtc, state.alpha.registration
    if rtc is None:
        return None
    return MeasuredGains(
        measured=() if registration is None else registration.optical_gains,
        n_modes=rtc.n_modes,
        reference_id=state.loop.reference_id,
        magnitude=rtc.magnitude,
        frame_rate_hz=rtc.frame_rate_hz,
    )
