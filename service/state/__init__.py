"""What the service knows: one frozen record, replaced as a whole, read by REST and metrics."""

from service.state.acquisition import Acquisition, AcquisitionStage, Interruption, LoopFound
from service.state.dithering import Dithering, DitherPhase, DitherPlan, Precision
from service.state.journal import Alarm, Level, LogEntry, Party, Waiting
from service.state.measurements import MeasurementRecord, MeasurePattern, MeasureState
from service.state.noisy import ModeSet, NoisyFinding, NoisyRecord, NoisyState
from service.state.pointing import Pointing
from service.state.reconstructors import Judged, MatrixState, ReconstructorRecord
from service.state.registration import (
    Candidate,
    Earlier,
    HistoryEntry,
    ModeGain,
    PassiveBias,
    Registration,
    Seen,
    Source,
    Standing,
    Validity,
    Watchdog,
)
from service.state.rtc import CommandState, DitherKind, DitherView, LoopCommand, RtcView
from service.state.saved import Orders, Saved
from service.state.tracker import Mode, Retries, TrackerState
from service.state.updates import Assessment, ModeLimit

__all__ = [
    "Acquisition",
    "AcquisitionStage",
    "Alarm",
    "Assessment",
    "Candidate",
    "CommandState",
    "DitherKind",
    "DitherPhase",
    "DitherPlan",
    "DitherView",
    "Dithering",
    "Earlier",
    "HistoryEntry",
    "Interruption",
    "Judged",
    "Level",
    "LogEntry",
    "LoopCommand",
    "LoopFound",
    "MatrixState",
    "MeasurePattern",
    "MeasureState",
    "MeasurementRecord",
    "Mode",
    "ModeGain",
    "ModeLimit",
    "ModeSet",
    "NoisyFinding",
    "NoisyRecord",
    "NoisyState",
    "Orders",
    "Party",
    "PassiveBias",
    "Pointing",
    "Precision",
    "ReconstructorRecord",
    "Registration",
    "Retries",
    "RtcView",
    "Saved",
    "Seen",
    "Source",
    "Standing",
    "TrackerState",
    "Validity",
    "Waiting",
    "Watchdog",
]
