"""What the service knows: one frozen record, replaced as a whole, read by REST and metrics."""

from service.state.journal import Alarm, Level, LogEntry
from service.state.measurements import MeasurementRecord, MeasurePattern, MeasureState
from service.state.reconstructors import MatrixState, ReconstructorRecord
from service.state.registration import HistoryEntry, Registration, Watchdog
from service.state.rtc import CommandState, DitherKind, DitherView, LoopCommand, RtcView
from service.state.tracker import Mode, TrackerState

__all__ = [
    "Alarm",
    "CommandState",
    "DitherKind",
    "DitherView",
    "HistoryEntry",
    "Level",
    "LogEntry",
    "LoopCommand",
    "MatrixState",
    "MeasurePattern",
    "MeasureState",
    "MeasurementRecord",
    "Mode",
    "ReconstructorRecord",
    "Registration",
    "RtcView",
    "TrackerState",
    "Watchdog",
]
