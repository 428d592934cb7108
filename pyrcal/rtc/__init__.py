"""The RTC's side of the contract, as a library.

A program becomes an RTC of pyrcal in three steps:

1. It implements the methods of :class:`Computer`: names, terms of a new matrix, commands.
2. It opens a link with ``RtcConnection(computer, router, batches_per_s=...).open()``. Commands are
   then answered, reconstructors received, checked and acknowledged, in threads of the library.
3. It publishes frames and status with :meth:`RtcLink.publish_frames` and
   :meth:`RtcLink.publish_status`, and calls :meth:`RtcLink.report_matrices` after a swap.

``examples/rtc_with_library.py`` is a complete RTC. The simulator, the bridge to cacao and the
bridge to pyRTC use the same library. The contract itself is in docs/rtc.md.
"""

from pyrcal.rtc.basic_computer import BasicComputer
from pyrcal.rtc.dither import Dither, check_dither
from pyrcal.rtc.identity import Identity, Reconstructor, new_session
from pyrcal.rtc.link import STATUS_PERIOD_S, RtcConnection, RtcLink
from pyrcal.rtc.matrices import Matrices
from pyrcal.rtc.references import ReferenceOffset
from pyrcal.rtc.replies import Computer, FinishedMeasurement, HoldsReferences
from pyrcal.rtc.staging import Terms
from service.config.link_tables import Router
from service.wire import (
    DitherRequest,
    DitherStop,
    FrameHeader,
    Loop,
    LoopRequest,
    ReferencesInUse,
    ReferencesRequest,
    Reply,
    Status,
)

__all__ = [
    "STATUS_PERIOD_S",
    "BasicComputer",
    "Computer",
    "Dither",
    "DitherRequest",
    "DitherStop",
    "FinishedMeasurement",
    "FrameHeader",
    "HoldsReferences",
    "Identity",
    "Loop",
    "LoopRequest",
    "Matrices",
    "Reconstructor",
    "ReferenceOffset",
    "ReferencesInUse",
    "ReferencesRequest",
    "Reply",
    "Router",
    "RtcConnection",
    "RtcLink",
    "Status",
    "Terms",
    "check_dither",
    "new_session",
]
