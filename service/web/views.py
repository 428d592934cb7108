"""Views: response models of the service's records.

A view lists the fields of a record that REST shows, and takes their types from the record. A
registration, or its 1 σ, is shown as its four parameters in boundary units; a number that is not
finite is null; a time in nanoseconds is shown as RFC 3339, too. FastAPI describes the models in its
OpenAPI document. ``pyrcal_studies.openapi`` adds the descriptions of fields, which are the
docstrings in the records' source.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from functools import cache
from hashlib import blake2b
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    NotRequired,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from fastapi import Depends, Request, Response
from pydantic import (
    AliasPath,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    WithJsonSchema,
    create_model,
)
from pydantic_core import from_json
from typing_extensions import TypedDict  # pydantic needs it before Python 3.12

from service import errors, wire
from service.link.statistics import LinkStatistics
from service.model.misregistration import Misregistration, at_boundary
from service.records import alarms, operations, products
from service.records import commands as cmd
from service.records.products import ExpectedGain, GateVerdict, ModeLimit, ModeProof
from service.records.registration import HistoryEntry, ModeGain, Offload, PassiveState
from service.records.state import LogEntry, ObservatoryValue, TrackerState
from service.runtime import snapshot
from service.runtime.supervisor import Supervisor
from service.tracking import interlocks
from service.tracking.operations.running import Operating

Record = TypeVar("Record")

_LATEST_NS = 253_402_300_800 * 1_000_000_000
"""RFC 3339 has years of four digits."""


# --- types as which values are shown


class FourView(TypedDict):
    """The four parameters of a registration, or their 1 σ."""

    __pydantic_config__ = ConfigDict(use_attribute_docstrings=True)  # type: ignore[misc]

    shift_x_subap: float | None
    """Along sensor +x, subapertures."""

    shift_y_subap: float | None
    """Along sensor +y, subapertures."""

    rotation_deg: float | None
    """From sensor +x towards +y, degrees."""

    magnification: float | None
    """Ratio; 1 is nominal."""

    anamorphosis: NotRequired[list[float]]
    """Stretch along x over the mean of both axes, less 1, and along 45 deg; only where the service
    follows it."""


def _named(value: Any) -> Any:  # noqa: ANN401  of a field that has not been validated
    """Return a registration or a 4-vector in numeric units under its names."""
    if isinstance(value, np.ndarray):
        return at_boundary(value)
    if isinstance(value, Misregistration):
        stretched = {"anamorphosis": value.anamorphosis} if value.anamorphosis else {}
        return at_boundary(value.vector) | stretched
    return value


_Four = Annotated[FourView, BeforeValidator(_named)]


def clock_of(name: str) -> str:
    """Return the name under which a time in nanoseconds leaves by the clock; empty: it is none."""
    is_time = name.endswith("_ns_utc") or name == "now_ns"
    return f"{name.removesuffix('_utc').removesuffix('_ns')}_utc" if is_time else ""


def rfc3339(t_ns: int | None) -> str | None:
    """Return a time in UTC to the microsecond; None for one that is not known, or too late."""
    if not t_ns or not 0 < t_ns < _LATEST_NS:
        return None
    seconds, rest_ns = divmod(t_ns, 1_000_000_000)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{rest_ns // 1000:06d}Z"


_Clock = Annotated[
    str | None,
    BeforeValidator(rfc3339),
    WithJsonSchema({"anyOf": [{"type": "string", "format": "date-time"}, {"type": "null"}]}),
]


# --- views


class View(BaseModel):
    """Response model of one type of record: its fields are taken from the record's attributes."""

    model_config = ConfigDict(from_attributes=True)

    record: ClassVar[type]
    """Type of the records that it shows."""


USUAL_VIEWS: dict[type, type[View]] = {}
"""Usual view of each type of record."""


def define_view(
    name: str, record: type, fields_of: str = "", text: str = "", **below: type[View]
) -> type[View]:
    """Return the response model that shows some fields of a record.

    Parameters
    ----------
    name
        Name of its schema in OpenAPI.
    record
        The record's type; the first view of one is its usual view.
    fields_of
        Fields to show, separated by spaces; ``name=path`` for one that is shown under another name.
        Empty for all of them.
    text
        Description of the schema; empty for the record's own docstring.
    **below
        Views of the records in its fields, where they are not the usual ones.
    """
    shown: dict[str, Any] = {}
    for word in fields_of.split() or [field.name for field in fields(record)]:
        own, _, path = word.rpartition("=")
        own = own or path.rpartition(".")[2]
        steps = path.split(".")
        kind = _types_of(owner_of(record, steps))[steps[-1]]
        shown[own] = _shown_type(kind, below.get(own)), Field(validation_alias=AliasPath(*steps))
        # A time appears twice: exact in nanoseconds, and as people read it.
        if clock := clock_of(own):
            shown[clock] = _Clock, Field(validation_alias=AliasPath(*steps))
    text = text or inspect.cleandoc(record.__doc__ or "")
    made = create_model(name, __base__=View, __doc__=text, **shown)
    made.record = record
    USUAL_VIEWS.setdefault(record, made)
    return made


def owner_of(record: type, steps: Sequence[str]) -> type:
    """Return the type of the record that has the attribute at the end of a path."""
    for step in steps[:-1]:
        kind = _types_of(record)[step]
        record = next((one for one in get_args(kind) if one is not NoneType), kind)
    return record


@cache
def _types_of(record: type) -> dict[str, Any]:
    """Return the types of a record's fields and properties by name."""
    found = get_type_hints(record)
    for base in record.__mro__:
        for name, value in vars(base).items():
            if isinstance(value, property):
                known = vars(sys.modules[base.__module__])
                found.setdefault(name, get_type_hints(value.fget, known)["return"])
    return found


def _shown_type(kind: Any, below: type[View] | None) -> Any:  # noqa: ANN401  types
    """Return the type as which a value of this type is shown."""
    origin, inside = get_origin(kind), get_args(kind)
    # JSON has no NaN or infinity: any float may be null.
    if kind is float:
        return float | None
    if kind is Misregistration or origin is np.ndarray:
        return _Four
    if origin in {Union, UnionType}:
        return Union[tuple(_shown_type(one, below) for one in inside)]  # noqa: UP007
    if origin in {tuple, list}:
        return list[_shown_type(inside[0], below)]  # type: ignore[misc]
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return dict[str, _shown_type(inside[1], below)]  # type: ignore[misc]
    return below or USUAL_VIEWS[kind] if isinstance(kind, type) and is_dataclass(kind) else kind


def as_json(record: object, of: type[View] | None = None) -> str:
    """Return a record as JSON, as its usual view or another shows it."""
    return (of or USUAL_VIEWS[type(record)]).model_validate(record).model_dump_json()


def to_json(record: object, of: type[View] | None = None) -> dict[str, Any]:
    """Return the JSON object of a record, as its usual view or another shows it."""
    shown: dict[str, Any] = from_json(as_json(record, of))
    return shown


def shows(of: type[View]) -> dict[str, Any]:
    """Return the OpenAPI description of an answer that shows a record."""
    return {"description": (of.__doc__ or "").partition("\n\n")[0], "model": of}


def binary(description: str, *media_types: str) -> dict[str, Any]:
    """Return the OpenAPI description of a body of bytes."""
    schema = {"schema": {"type": "string", "format": "binary"}}
    return {"description": description, "content": dict.fromkeys(media_types, schema)}


def answer(record: object, of: type[View] | None = None) -> Response:
    """Return the answer that shows a record."""
    return Response(as_json(record, of), media_type="application/json")


def tagged(record: object, of: type[View] | None = None) -> Response:
    """Return the answer that shows a record, with an ETag that changes when it does."""
    shown = answer(record, of)
    shown.headers["ETag"] = f'"{blake2b(shown.body, digest_size=12).hexdigest()}"'
    return shown


def found_or_refuse(record: Record | None, refusal: str) -> Record:
    """Return the record, or refuse an unknown id.

    Raises
    ------
    UnknownIdError
        If there is none: ``refusal`` says of what.
    """
    if record is None:
        raise errors.UnknownIdError(refusal)
    return record


class Parameters(BaseModel):
    """Query parameters; an unknown one is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


def held(name: str) -> Any:  # noqa: ANN401  as FastAPI has it
    """Return what makes a parameter of a route what the application holds under a name."""

    # a plain function would be called in a thread, which takes as long as most answers
    async def found(request: Request) -> object:
        return getattr(request.app.state, name)

    return Depends(found)


ServiceDep = Annotated[Supervisor, held("service")]
"""The service a route works for."""


# --- what of each record leaves


define_view("PointingView", wire.Pointing)
define_view("ModeGainView", ModeGain, "mode gain gain_sigma=sigma gain_scatter=scatter t_ns_utc")
define_view("VerdictView", GateVerdict)
define_view("ExpectedGainView", ExpectedGain)
define_view("AssessmentView", products.Assessment)
define_view("ProbationFindingView", operations.ProbationFinding)
define_view(
    "ProbationView",
    operations.Probation,
    "id before state text since_ns_utc until_ns_utc finding rollback",
)
define_view("ModeLimitView", ModeLimit, "n_modes since_ns_utc until_ns_utc reason")
define_view(
    "ModeProofView",
    ModeProof,
    "n_proven contrary_modes own_response_ratio own_misfit_ratio",
)
ALPHA = define_view(
    "AlphaView",
    snapshot.Alpha,
    "registration.alpha sigma=registration.shown_sigma registration.tracking_sigma sigma_limit "
    "anamorphosis_sigma registration.floor "
    "covariance parameters "
    "registration.t_ns_utc age_s window_age_s "
    "registration.n_windows validity=registration.validity.level "
    "validity_reason=registration.validity.reason "
    "valid_until_ns_utc=registration.validity.until_ns_utc registration.restored_ns_utc "
    "registration.jumped_ns_utc "
    "suspected registration.optical_gain registration.optical_gains passive_bias "
    "passive_bias_sigma "
    "registration.pointing registration.nominal",
)
define_view("HistoryEntryView", HistoryEntry)
HISTORY = define_view("HistoryView", TrackerState, "entries=alpha.history", "The last estimates.")
define_view("PassiveView", PassiveState)

define_view("GainGroupView", cmd.GainGroup)
define_view(
    "RtcView",
    snapshot.Rtc,
    "status.session status.loop status.frame_rate_hz status.delay_frames status.leak gains "
    "status.n_controlled status.n_modes status.n_slopes status.cm_id status.basis_id "
    "status.config_id "
    "status.magnitude status.max_dither_m status.max_dither_modes t_ns_utc=status.t_ns",
)
define_view("LoopCommandView", operations.LoopCommand, "id text state reason asked_ns_utc lasts_s")
define_view(
    "DitherView",
    operations.Dither,
    "id purpose request.modes request.amplitude_m request.kind frequency_hz request.seed "
    "request.duration_s start_seq",
)
define_view("DitherPlanView", operations.DitherPlan)
define_view(
    "DitherPolicyView",
    operations.DitherPolicyState,
    "phase reason budget_m mean_cost_m plan next_ns_utc n_windows_learnt avoided_hz",
)
define_view(
    "AcquisitionView",
    operations.Acquisition,
    "stage text under_way started_ns_utc since_ns_utc held_off commanded n_attempts=attempt alpha "
    "n_modes",
)
define_view("OffloadView", Offload, "id state text step total n_moves asked_ns_utc")
RECONSTRUCTOR = define_view(
    "ReconstructorView",
    products.ReconstructorRecord,
    "id state n_modes config_id reference_id created_ns_utc alpha sigma parent origin sha256 "
    "condition_number gate reason published_ns_utc applied_frame_seq",
)
RECONSTRUCTORS = define_view(
    "ReconstructorsView",
    TrackerState,
    "matrices.in_use matrices.reconstructors",
    "The reconstructors the service remembers.",
)
GAINS = define_view("GainTableView", snapshot.ModeGainTable)
define_view("ShapeView", products.Shape, "id kind frame source by loaded_ns_utc")
REFERENCES_RECORD = define_view(
    "ReferencesRecordView",
    products.ReferencesRecord,
    "id state created_ns_utc shape rms_m alpha gain offset_rms unexplained_ratio sha256 parent "
    "reason by published_ns_utc applied_ns_utc held_ratio held_sigma",
)
define_view(
    "HeldShapeView",
    snapshot.References,
    "kept.shape used newest verified waiting kept.unsupported misapplied=kept.difference",
)
REFERENCES = define_view(
    "ReferencesView",
    TrackerState,
    "references.shape references.used_id references.records",
    "The shape that the loop is to hold, and the references that the service remembers.",
)

MEASUREMENT = define_view(
    "MeasurementView",
    operations.MeasurementRecord,
    "id state reason pattern modes amplitude_m n_average frequency_hz duration_s asked_ns_utc "
    "start_seq created_ns_utc n_slopes double_pass session basis_id config_id sha256",
)
MEASUREMENTS = define_view(
    "MeasurementsView", TrackerState, "measurements=by_rtc", "Measured interaction matrices."
)
MEASURING = define_view(
    "MeasuringView",
    operations.MeasurementRecord,
    "id state pattern modes asked_ns_utc opens_loop",
    "The interaction matrix being measured: ``/v1/measurements/{id}`` says more.",
)
NOISY_MEASUREMENT = define_view(
    "NoisyMeasurementView",
    operations.MeasurementRecord,
    "id state total_m duration_s asked_ns_utc",
    "The noisy interaction matrix under way: ``/v1/noisy-matrix/{id}`` says more.",
)

define_view("OperatorNoteView", alarms.OperatorNote)
define_view(
    "AlarmView",
    snapshot.AlarmStatus,
    "record.name severity worst_severity=record.worst record.alarm_state record.since_ns_utc "
    "record.text code values cause "
    "do record.over_ns_utc record.acknowledged record.muted",
)
define_view("RaisedView", alarms.Alarm, "name since_ns_utc text message.code message.values")
define_view("MutedView", alarms.AlarmRecord, "name muted")
define_view("OperatingView", Operating)
define_view("ObservatoryValueView", ObservatoryValue)
define_view(
    "LogEntryView",
    LogEntry,
    "t_ns_utc level name text message.code message.values n_times=times cause",
)
EVENTS = define_view(
    "EventsView", TrackerState, "alarms=alarms.active log", "What happened, and what is wrong now."
)
define_view("PrerequisiteView", alarms.Prerequisite)
define_view("PermissionView", interlocks.Permission)
define_view("WorkerLoadView", snapshot.WorkerLoad)
define_view(
    "LinkView",
    LinkStatistics,
    "rtc_alive session frame_age_s telemetry_age_s latency_p50_s frames_received frames_lost "
    "frames_recovered frames_duplicate frames_late frames_nonfinite frames_overwritten "
    "frames_refused messages_malformed",
)
STATE = define_view(
    "StateView",
    snapshot.Snapshot,
    "tracker.system tracker.operator.mode tracker.operator.stopped_because ready ready_reason "
    "now_ns uptime_s registration=alpha tracker.matrices.in_use tracker.matrices.margin "
    "tracker.matrices.assessment tracker.matrices.mode_limit tracker.matrices.mode_proof "
    "tracker.operations.probation rtc instrument_remarks tracker.alpha.pointing "
    "tracker.loop.basis_id tracker.loop.config_id tracker.loop.reference_id "
    "tracker.loop.reference_since_ns_utc references tracker.dithers.dither "
    "dither_policy=tracker.dithers.policy tracker.loop.vibrations_hz tracker.measuring "
    "tracker.noisy_measurement tracker.operations.acquisition tracker.alpha.offload "
    "loop_command=tracker.loop.command tracker.alpha.dither_due_since_ns_utc "
    "tracker.alpha.dither_due_reason "
    "tracker.alpha.passive tracker.alpha.passive_unavailable_reason waiting_for operating "
    "permitted no_return tracker.alarms.observatory_values alarms stale_alarms muted_alarms "
    "worst_severity windows_accepted=tracker.windows.accepted "
    "windows_refused=tracker.windows.refused windows_outlying=tracker.windows.outlying "
    "window_refusal worker_load link",
    "What the service knows, at one glance.",
    measuring=MEASURING,
    noisy_measurement=NOISY_MEASUREMENT,
)
ALARMS = define_view(
    "AlarmsView",
    snapshot.Snapshot,
    "alarms stale_alarms muted_alarms worst_severity",
    "The alarms that last, that went unseen, and that are muted.",
)
