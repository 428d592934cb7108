"""Messages of the contract with an RTC, version 1: records to bytes and back.

``encode(record)`` returns the bytes of a frozen record. ``decode(kind, data)`` returns the record
of received bytes, or raises :class:`~service.errors.WireError` if they break the contract. The
text of that error begins with ``missing``, ``v``, ``id`` or ``range``, so that an RTC can return
it as the ``reason`` of a reply. The package does not use zenoh and never unpickles anything.
"""

from service.wire.codec import MESSAGE_LIMIT, TEXT_LIMIT, VERSION, decode, encode
from service.wire.commands import (
    REFERENCES_LIMIT,
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
    ReferencesInUse,
    ReferencesRequest,
    Reply,
    command_id,
    command_kind,
    decode_command,
)
from service.wire.keys import Encodings, Keys, Role, parse_chunk_index, validate_id
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
    GainsMessage,
    Pointing,
    StateMessage,
    Status,
    decode_frames,
    encode_frames,
    essentials,
)
