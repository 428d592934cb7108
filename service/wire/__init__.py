"""Bytes <-> records: version 1 of the contract with an RTC.

``encode(record)`` turns a frozen record into bytes, ``decode(kind, data)`` does the reverse and
refuses whatever breaks the contract with a :class:`~service.errors.WireError`. The refusal's text
begins with ``missing``, ``v``, ``id`` or ``range``, so an RTC can put it into the ``reason`` of a
reply. Nothing here knows zenoh, and nothing is ever unpickled.
"""

from service.wire.codec import MESSAGE_LIMIT, TEXT_LIMIT, VERSION, decode, encode
from service.wire.commands import (
    Command,
    CommandKind,
    DitherKind,
    DitherRequest,
    DitherStop,
    Loop,
    LoopRequest,
    MatrixStrokes,
    MeasureRequest,
    OffloadRequest,
    Pattern,
    RampRequest,
    Reply,
    command_id,
    command_kind,
    decode_command,
)
from service.wire.keys import Encodings, Keys, Role, checked_id, chunk_index
from service.wire.matrices import (
    CHUNK_LIMIT,
    Acknowledgement,
    AckState,
    ChunkAssembler,
    Manifest,
    MatrixLayout,
    MeasuredManifest,
    checksum,
    layout_of,
    split,
)
from service.wire.telemetry import (
    ATTACHMENT_LIMIT,
    BATCH_LIMIT,
    FRAMES_PER_BATCH,
    STATUS_LIMIT,
    AlarmMessage,
    ControlLaw,
    DitherStatus,
    FrameBatch,
    FrameHeader,
    Pointing,
    StateMessage,
    Status,
    decode_frames,
    encode_frames,
    essentials,
)
