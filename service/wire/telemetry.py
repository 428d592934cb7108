"""What is told again and again: frames and status by the RTC, state and alarms by the service.

A batch of frames is a msgpack attachment and raw float32 rows; the others are msgpack maps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from itertools import compress
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from service.errors import WireError
from service.wire import codec, commands

# --- frames


BATCH_LIMIT: Final = 4_000_000
"""Bytes: a longer payload is refused unread."""

ATTACHMENT_LIMIT: Final = 4096
"""Bytes: a longer attachment is refused unread."""

FRAMES_PER_BATCH: Final = 50
"""Most frames in one batch."""

COLUMN_LIMIT: Final = BATCH_LIMIT // 4


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameHeader:
    """Description of a batch's rows."""

    session: codec.Opaque
    """New when the RTC starts, or its sequence or integrator starts over."""

    seq0: Annotated[int, codec.integer(high=2**62)]
    """Sequence number of row 0; row i is ``seq0 + i``."""

    n: Annotated[int, codec.integer(1, FRAMES_PER_BATCH)]
    """Rows, 1..50."""

    t0_ns: Annotated[int, codec.integer(high=2**62)]
    """End of exposure of row 0, nanoseconds since the Unix epoch, UTC."""

    dt_ns: Annotated[int, codec.integer(1, 10**12)]
    """Nominal frame period, nanoseconds."""

    n_slopes: Annotated[int, codec.integer(1, COLUMN_LIMIT)]
    """Slopes of a row."""

    n_modes: Annotated[int, codec.integer(1, COLUMN_LIMIT)]
    """Commands of a row: the whole basis, controlled or not."""

    dither: bool
    """Whether each row ends with the dither's share of its commands."""

    cm_id: codec.Id | None
    """The reconstructor that multiplies these slopes; None when the RTC does not know."""

    basis_id: codec.Opaque
    """Of the modal basis; changes with modes, order and scale."""

    config_id: codec.Opaque
    """Of the sensor; changes with mask, slope recipe, reference slopes, binning, modulation."""

    @property
    def n_columns(self) -> int:
        """Floats of a row: slopes, commands and, if there, the dither."""
        return self.n_slopes + self.n_modes * (2 if self.dither else 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameBatch:
    """Consecutive frames as they travel.

    Row k holds the slopes and the command that was on the mirror during the exposure that made
    them; the arrays are read-only views of the received bytes.
    """

    header: FrameHeader
    """What the rows mean."""

    rows: NDArray[np.float32]
    """``(n, n_columns)``: slopes | commands | dither, if there."""

    @property
    def slopes(self) -> NDArray[np.float32]:
        """``(n, n_slopes)``, in the RTC's own order and sign."""
        return self.rows[:, : self.header.n_slopes]

    @property
    def commands_m(self) -> NDArray[np.float32]:
        """``(n, n_modes)``: total modal command, dither included, metres OPD."""
        return self.rows[:, self.header.n_slopes : self.header.n_slopes + self.header.n_modes]

    @property
    def dither_m(self) -> NDArray[np.float32] | None:
        """``(n, n_modes)``: the dither's share, metres OPD; None without dither."""
        if not self.header.dither:
            return None
        return self.rows[:, self.header.n_slopes + self.header.n_modes :]


def encode_frames(header: FrameHeader, rows: NDArray[np.float32]) -> tuple[bytes, bytes]:
    """Return payload and attachment of one batch.

    Parameters
    ----------
    header
        What the rows mean.
    rows
        ``(n, n_columns)``: slopes | commands in metres | the dither's share if ``header.dither``.

    Raises
    ------
    WireError
        If the rows are not what the header says, or the batch is longer than the limit.
    """
    if rows.shape != (header.n, header.n_columns):
        raise WireError(
            f"range: frame rows have shape {rows.shape}, expected {(header.n, header.n_columns)}"
        )
    payload = np.ascontiguousarray(rows, dtype="<f4").tobytes()
    attachment = codec.encode(header)
    _check_sizes(payload, header)
    return payload, attachment


def decode_frames(payload: bytes, attachment: bytes | None) -> FrameBatch:
    """Return the batch; its rows are a view of ``payload``, nothing is copied.

    The values are not looked at: a frame with a NaN costs one frame, not its batch.

    Raises
    ------
    WireError
        If attachment or payload break the contract or do not fit together.
    """
    if attachment is None:
        raise WireError("missing: attachment of a frame batch")
    if len(payload) > BATCH_LIMIT:
        raise WireError(
            f"range: a frame batch has {len(payload)} bytes, expected at most {BATCH_LIMIT}"
        )
    header = codec.decode(FrameHeader, attachment)
    _check_sizes(payload, header)
    rows = np.frombuffer(payload, dtype="<f4").reshape(header.n, header.n_columns)
    return FrameBatch(header=header, rows=rows)


codec.travels(
    FrameHeader,
    "the attachment of a frame batch",
    opened=lambda data, where: codec.unpack(data, where, ATTACHMENT_LIMIT),
)


def _check_sizes(payload: bytes, header: FrameHeader) -> None:
    expected = 4 * header.n * header.n_columns
    if len(payload) != expected or expected > BATCH_LIMIT:
        raise WireError(
            f"range: a frame batch has {len(payload)} bytes, expected {expected} for {header.n} "
            f"rows of {header.n_columns} float32, at most {BATCH_LIMIT}"
        )


# --- status, state, alarms


STATUS_LIMIT: Final = codec.MESSAGE_LIMIT + 16 * 512**2
"""Bytes: a longer status is refused unread; its images come on top of what a message may have."""

A_STATUS: Final = "a status"

ESSENTIAL: Final = (
    "session",
    "loop",
    "cm_id",
    "dither",
    "n_controlled",
    "n_slopes",
    "n_modes",
    "basis_id",
    "config_id",
)
"""What of a status must not be missed, however soon the next one comes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherStatus:
    """The dither the RTC is playing."""

    request: commands.DitherRequest
    """What was asked for."""

    start_seq: codec.Count
    """First frame whose exposure contains it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pointing:
    """A direction of the telescope."""

    elevation_deg: Annotated[float, codec.number(-90.0, 90.0)]
    """Above the horizon."""

    azimuth_deg: Annotated[float, codec.number(-720.0, 720.0)]
    """From north over east; only differences count."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlLaw:
    """The integrator of the loop: ``c[k+d] = leak * c[k+d-1] - gain * R s[k]``."""

    delay_frames: Annotated[float, codec.number(0.0, 100.0)]
    """End to end, from exposure to the command that answers it."""

    gains: tuple[Annotated[float, codec.number(0.0)], ...]
    """One per mode of the basis, 0 where uncontrolled."""

    leak: Annotated[float, codec.number(0.0, 1.0)]
    """Per frame; 1 forgets nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Status(ControlLaw):
    """The RTC's own account of its loop, a few times a second."""

    session: codec.Opaque
    """As in the frames."""

    seq: codec.Count | None
    """The last frame processed; None: there has been none yet."""

    t_ns: codec.Count
    """Nanoseconds since the Unix epoch, UTC."""

    loop: commands.Loop
    """Closed, open, or closed with the gain of some controlled modes at 0."""

    frame_rate_hz: Annotated[float, codec.above(0.0, 1e6)]
    """Frames a second, nominal or measured."""

    n_slopes: Annotated[int, codec.integer(1)]
    """Slopes of a frame."""

    n_modes: Annotated[int, codec.integer(1)]
    """Modes of the whole basis, controlled or not."""

    n_controlled: codec.Count
    """Modes that the reconstructor in use commands, the first ones of the basis."""

    cm_id: codec.Id | None
    """The reconstructor in use; None when the RTC does not know."""

    basis_id: codec.Opaque
    """Of the modal basis, as in the frames."""

    config_id: codec.Opaque
    """Of the sensor, as in the frames."""

    dither: DitherStatus | None
    """What plays, as it was asked for; None: nothing does."""

    max_dither_m: Annotated[float, codec.number(0.0)]
    """Most the RTC accepts for one mode, metres RMS."""

    max_dither_modes: codec.Count
    """Most modes the RTC dithers at once."""

    magnitude: codec.Finite | None
    """Of the guide star."""

    flux: bytes | None = field(default=None, repr=False)
    """``<f4`` ``[4, n_subapertures, n_subapertures]``, counts per frame averaged over a second."""

    pointing: Pointing | None = None
    """An extension: an RTC that does not know it may leave the key out."""

    trouble: codec.Text | None = None
    """An extension: what is wrong on the RTC's side, for people; None or no such key: nothing."""

    @property
    def dither_id(self) -> str | None:
        """The dither now running; None: none."""
        return None if self.dither is None else self.dither.request.id

    @property
    def in_loop(self) -> tuple[int, ...]:
        """Modes the loop moves, the controlled ones with a gain; none: it is open.

        Some gains of 0 ("partial") make it a loop of the other modes, no less closed.
        """
        if self.loop == commands.Loop.OPEN:
            return ()
        return tuple(compress(range(self.n_controlled), self.gains))

    @property
    def flux_images(self) -> NDArray[np.float32] | None:
        """``(4, n_subapertures, n_subapertures)``, in row-major order of their place."""
        if self.flux is None:
            return None
        side = math.isqrt(len(self.flux) // 16)
        return np.frombuffer(self.flux, dtype="<f4").reshape(4, side, side)


@dataclass(frozen=True, slots=True, kw_only=True)
class StateMessage:
    """The service's state for all subscribers; an RTC ignores it."""

    system: codec.Id
    """The ``{system}`` of the keys."""

    t_ns: codec.Count
    """When it was said, nanoseconds since the Unix epoch, UTC."""

    mode: codec.Text
    """How much the service may do by itself: auto, propose or hold."""

    alpha: Mapping[str, float] | None
    """Registration: shifts in subapertures, rotation in degrees, ratio; None: not known yet."""

    sigma: Mapping[str, float] | None
    """1 σ of ``alpha``, same names and units."""

    in_use: codec.Id | None
    """The reconstructor the RTC multiplies with; None: unknown."""

    validity: codec.Text | None = None
    """Whether ``alpha`` may be relied on: fresh, ageing, stale or invalid; None: nothing is known,
    or a service of before this key said it."""

    waiting_for: tuple[codec.Text, ...] = ()
    """Whom the service waits for and what they should do."""

    operation: codec.Text | None = None
    """What the service is in and does, like "Operational, Tracking"; None: a service of before this
    key said it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmMessage:
    """One alarm that began or ended, for all subscribers."""

    system: codec.Id
    """The ``{system}`` of the keys."""

    t_ns: codec.Count
    """When it came or went, nanoseconds since the Unix epoch, UTC."""

    name: codec.Opaque
    """Machine-readable."""

    active: bool
    """False: it is over."""

    text: codec.Text
    """What was found, and what to do."""


def essentials(data: bytes) -> tuple[object, ...]:
    """Return what of a status must not be missed, unchecked; two that differ in it both count.

    Raises
    ------
    WireError
        If the message is no map, or too long.
    """
    values = _opened(data, A_STATUS)
    return tuple(values.get(key) for key in ESSENTIAL)


def _opened(data: bytes, where: str) -> codec.Map:
    """Return the map of a status that is no longer than its limit, its images left aside."""
    values = codec.unpack(data, where, STATUS_LIMIT)
    flux = values.get("flux")
    n_bytes = len(data) - (len(flux) if isinstance(flux, bytes) else 0)
    if n_bytes > codec.MESSAGE_LIMIT:
        raise WireError(
            f"range: a status has {n_bytes} bytes besides its flux, expected at most "
            f"{codec.MESSAGE_LIMIT}"
        )
    return values


def _status_keys(keys: codec.Map) -> codec.Map:
    playing = keys["dither"]
    if keys["trouble"] is None:
        del keys["trouble"]
    if playing is None:
        return keys
    return {**keys, "dither": {**codec.to_map(playing.request), "start_seq": playing.start_seq}}


def _status_fields(values: codec.Map, where: str) -> codec.Map:
    playing, inside = codec.get(values, "dither", where), f"'dither' of {where}"
    if playing is None:
        return values
    request = codec.of_map(commands.DitherRequest, codec.as_map(playing, inside), inside)
    start_seq = codec.get(playing, "start_seq", inside)
    return {**values, "dither": {"request": asdict(request), "start_seq": start_seq}}


def _check_status(status: Status, where: str) -> None:
    if len(status.gains) != status.n_modes:
        raise codec.refusal("gains", status.gains, f"one for each of {status.n_modes} modes", where)
    if status.n_controlled > status.n_modes:
        expected = f"an integer from 0 to {status.n_modes}"
        raise codec.refusal("n_controlled", status.n_controlled, expected, where)
    flux = status.flux
    if flux is not None and 16 * math.isqrt(len(flux) // 16) ** 2 != len(flux):
        raise codec.refusal("flux", flux, "bytes of four square float32 images", where)


def _state_fields(values: codec.Map, where: str) -> codec.Map:
    four = {key: codec.read_four(values, key, where) for key in ("alpha", "sigma")}
    return {**values, **four, "waiting_for": values.get("waiting_for") or ()}


codec.travels(
    Status,
    A_STATUS,
    first=("session", "seq", "t_ns", "loop", "frame_rate_hz"),
    may_be_absent=("pointing", "trouble"),
    opened=_opened,
    keys=_status_keys,
    fields=_status_fields,
    check=_check_status,
)
codec.travels(
    StateMessage,
    "a state message",
    may_be_absent=("validity", "waiting_for", "operation"),
    fields=_state_fields,
    held=False,
)
codec.travels(AlarmMessage, "an alarm message", held=False)
