"""Messages sent continuously: frames and status of the RTC; state, gains and alarms of pyrcal.

A batch of frames is a payload of raw float32 rows with a msgpack attachment that describes them.
The other messages are msgpack maps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import compress
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from service.errors import WireError
from service.wire import codec, commands

# --- frames


BATCH_LIMIT: Final = 4_000_000
"""Largest payload of a batch, in bytes; a longer one is refused before it is parsed."""

ATTACHMENT_LIMIT: Final = 4096
"""Largest attachment of a batch, in bytes; a longer one is refused before it is parsed."""

FRAMES_PER_BATCH: Final = 50
"""Largest number of frames in one batch."""

COLUMN_LIMIT: Final = BATCH_LIMIT // 4
"""Largest number of float32 values in one row."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameHeader:
    """Description of the rows of a batch."""

    session: codec.Opaque
    """Session; a new one begins when the RTC starts, or resets its sequence or integrator."""

    seq0: Annotated[int, codec.integer(high=2**62)]
    """Sequence number of row 0; row i is ``seq0 + i``."""

    n: Annotated[int, codec.integer(1, FRAMES_PER_BATCH)]
    """Number of rows."""

    t0_ns: Annotated[int, codec.integer(high=2**62)]
    """End of exposure of row 0."""

    dt_ns: Annotated[int, codec.integer(1, 10**12)]
    """Nominal frame period."""

    n_slopes: Annotated[int, codec.integer(1, COLUMN_LIMIT)]
    """Number of slopes in a row."""

    n_modes: Annotated[int, codec.integer(1, COLUMN_LIMIT)]
    """Number of modal commands in a row: all modes of the basis."""

    dither: bool
    """True if each row has dither columns."""

    cm_id: codec.Id | None
    """Reconstructor in use; None if the RTC does not know its id."""

    basis_id: codec.Opaque
    """Modal basis; changes with modes, order and scale."""

    config_id: codec.Opaque
    """Sensor configuration; changes with mask, slope recipe, binning, modulation."""

    reference_id: codec.Opaque | None = None
    """Reference slopes in use; nil or absent: the RTC does not name them."""

    @property
    def n_columns(self) -> int:
        """Number of floats in a row: slopes, commands and, if present, dither."""
        return self.n_slopes + self.n_modes * (2 if self.dither else 1)

    @property
    def reference_name(self) -> str:
        """Name of the reference slopes; an RTC of version 1 may have only ``config_id`` for it."""
        return self.reference_id or self.config_id


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameBatch:
    """Batch of consecutive frames as received.

    Row k has the slopes of one exposure and the command that was on the mirror during it. The
    arrays are read-only views of the received bytes.
    """

    header: FrameHeader
    """Description of the rows."""

    rows: NDArray[np.float32]
    """Rows ``(n, n_columns)``: slopes | commands | dither, if present."""

    @property
    def slopes(self) -> NDArray[np.float32]:
        """Slopes ``(n, n_slopes)``, in the order and with the signs of the RTC."""
        return self.rows[:, : self.header.n_slopes]

    @property
    def commands_m(self) -> NDArray[np.float32]:
        """Total modal commands ``(n, n_modes)``, dither included, metres OPD."""
        return self.rows[:, self.header.n_slopes : self.header.n_slopes + self.header.n_modes]

    @property
    def dither_m(self) -> NDArray[np.float32] | None:
        """Dither ``(n, n_modes)`` within the commands, metres OPD; None if not sent."""
        if not self.header.dither:
            return None
        return self.rows[:, self.header.n_slopes + self.header.n_modes :]


def encode_frames(header: FrameHeader, rows: NDArray[np.float32]) -> tuple[bytes, bytes]:
    """Return payload and attachment of one batch.

    Parameters
    ----------
    header
        Description of the rows.
    rows
        Rows ``(n, n_columns)``: slopes | commands, metres OPD | dither if ``header.dither``.

    Raises
    ------
    WireError
        If the shape of the rows contradicts the header, or the batch is too long.
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
    """Return the batch of a payload and its attachment, without copying the rows.

    The values are not checked here, so that a NaN costs one frame and not the whole batch.

    Raises
    ------
    WireError
        If attachment or payload break the contract or contradict each other.
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


codec.register(
    FrameHeader,
    "the attachment of a frame batch",
    optional_keys=("reference_id",),
    unpack=lambda data, where: codec.unpack(data, where, ATTACHMENT_LIMIT),
    keys=lambda keys: codec.without_nil(keys, "reference_id"),
)


def _check_sizes(payload: bytes, header: FrameHeader) -> None:
    expected = 4 * header.n * header.n_columns
    if len(payload) != expected or expected > BATCH_LIMIT:
        raise WireError(
            f"range: a frame batch has {len(payload)} bytes, expected {expected} for {header.n} "
            f"rows of {header.n_columns} float32, at most {BATCH_LIMIT}"
        )


# --- status, state, alarms


# Four images of 512 x 512 pixels, 4 bytes each.
STATUS_LIMIT: Final = codec.MESSAGE_LIMIT + 16 * 512**2
"""Largest status, in bytes; its flux images may add to the size of an ordinary message."""

STATUS_NAME: Final = "a status"

ESSENTIAL_KEYS: Final = (
    "session",
    "loop",
    "cm_id",
    "dither",
    "n_controlled",
    "n_slopes",
    "n_modes",
    "basis_id",
    "config_id",
    "reference_id",
)
"""Keys of a status whose changes must not be missed, even if a newer status has come already."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherStatus:
    """Dither that the RTC is playing."""

    request: commands.DitherRequest
    """Command that started it."""

    start_seq: codec.Count
    """First frame whose exposure contains the dither."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pointing:
    """Pointing of the telescope."""

    elevation_deg: Annotated[float, codec.number(-90.0, 90.0)]
    """Elevation above the horizon."""

    azimuth_deg: Annotated[float, codec.number(-720.0, 720.0)]
    """Azimuth from north over east."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlLaw:
    """Integrator of the loop: ``c[k+d] = leak * c[k+d-1] - gain * R s[k]``."""

    delay_frames: Annotated[float, codec.number(0.0, 100.0)]
    """Delay d from an exposure to its correction."""

    gains: tuple[Annotated[float, codec.number(0.0)], ...]
    """Integrator gain of each mode of the basis."""

    leak: Annotated[float, codec.number(0.0, 1.0)]
    """Leak factor per frame; 1: pure integrator."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Status(ControlLaw):
    """Status of the RTC's loop, sent a few times a second."""

    session: codec.Opaque
    """Session of the RTC."""

    seq: codec.Count | None
    """Last processed frame; None before the first."""

    t_ns: codec.Count
    """Time of the status."""

    loop: commands.Loop
    """State of the loop; partial: closed with some gains at 0."""

    frame_rate_hz: Annotated[float, codec.above(0.0, 1e6)]
    """Frame rate, nominal or measured."""

    n_slopes: Annotated[int, codec.integer(1)]
    """Number of slopes in a frame."""

    n_modes: Annotated[int, codec.integer(1)]
    """Number of modes of the basis."""

    n_controlled: codec.Count
    """Number of modes that the reconstructor commands, the first ones."""

    cm_id: codec.Id | None
    """Reconstructor in use; None if the RTC does not know its id."""

    basis_id: codec.Opaque
    """Modal basis."""

    config_id: codec.Opaque
    """Sensor configuration."""

    dither: DitherStatus | None
    """Running dither."""

    max_dither_m: Annotated[float, codec.number(0.0)]
    """Largest amplitude that the RTC accepts, RMS of one mode."""

    max_dither_modes: codec.Count
    """Largest number of modes dithered at once."""

    magnitude: codec.Finite | None
    """Magnitude of the guide star."""

    flux: bytes | None = field(default=None, repr=False)
    """Pupil images, ``<f4`` ``[4, n_subapertures, n_subapertures]``, counts per frame."""

    pointing: Pointing | None = None
    """Pointing of the telescope."""

    trouble: codec.Text | None = None
    """Fault of the RTC, for people."""

    reference_id: codec.Opaque | None = None
    """Reference slopes in use; nil or absent: the RTC does not name them."""

    @property
    def reference_name(self) -> str:
        """Name of the reference slopes, as :attr:`FrameHeader.reference_name`."""
        return self.reference_id or self.config_id

    @property
    def dither_id(self) -> str | None:
        """Id of the dither that is running; None if there is none."""
        return None if self.dither is None else self.dither.request.id

    @property
    def in_loop(self) -> tuple[int, ...]:
        """Modes that the loop moves: controlled, with a gain above 0; empty if it is open.

        A "partial" loop is a closed loop of the modes that have a gain.
        """
        if self.loop == commands.Loop.OPEN:
            return ()
        return tuple(compress(range(self.n_controlled), self.gains))

    @property
    def flux_images(self) -> NDArray[np.float32] | None:
        """Flux images ``(4, n_subapertures, n_subapertures)``, row-major on the detector."""
        if self.flux is None:
            return None
        side = math.isqrt(len(self.flux) // 16)
        return np.frombuffer(self.flux, dtype="<f4").reshape(4, side, side)


@dataclass(frozen=True, slots=True, kw_only=True)
class StateMessage:
    """State of the service, for all subscribers; an RTC ignores it."""

    system: codec.Id
    """The ``{system}`` of the keys."""

    t_ns: codec.Count
    """Time of the message."""

    mode: codec.Text
    """Mode of the service: auto, propose or hold."""

    alpha: Mapping[str, float] | None
    """Registration; None if unknown."""

    sigma: Mapping[str, float] | None
    """1 σ of ``alpha``."""

    in_use: codec.Id | None
    """Reconstructor that the RTC uses; None if unknown."""

    validity: codec.Text | None = None
    """Validity of ``alpha``: fresh, ageing, stale, predicted or invalid."""

    waiting_for: tuple[codec.Text, ...] = ()
    """Conditions that the service waits for, each with its remedy."""

    operation: codec.Text | None = None
    """State and operation, like "Operational, Tracking"."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmMessage:
    """Alarm that began or ended, for all subscribers."""

    system: codec.Id
    """The ``{system}`` of the keys."""

    t_ns: codec.Count
    """Time at which it began or ended."""

    name: codec.Opaque
    """Name of the alarm."""

    active: bool
    """True if it began, false if it ended."""

    text: codec.Text
    """Finding and remedy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GainsMessage:
    """Optical gains of all modes, for all subscribers; an RTC may ignore it."""

    system: codec.Id
    """The ``{system}`` of the keys."""

    t_ns: codec.Count
    """End of the last window in which a mode was dithered, the RTC's clock."""

    modes: tuple[codec.Count, ...]
    """0-based indices of the modes that were measured; the others are inferred from them."""

    optical_gain: bytes = field(repr=False)
    """Measured over modelled response of each mode of the basis, ``<f4`` ``[n_modes]``."""

    sigma: bytes = field(repr=False)
    """1 σ of each, ``<f4`` ``[n_modes]``."""

    reference_id: codec.Opaque | None
    """Reference slopes in use; nil if unknown."""

    magnitude: codec.Finite | None
    """Magnitude of the guide star; nil if unknown."""

    frame_rate_hz: codec.Positive | None
    """Frame rate; nil if unknown."""


def essentials(data: bytes) -> tuple[object, ...]:
    """Return the values of :data:`ESSENTIAL_KEYS` in the bytes of a status, unchecked.

    The link drops a status that the next one has overtaken, unless these values differ.

    Raises
    ------
    WireError
        If the message is not a map, or is too long.
    """
    values = _unpack_status(data, STATUS_NAME)
    return tuple(values.get(key) for key in ESSENTIAL_KEYS)


def _unpack_status(data: bytes, where: str) -> codec.Map:
    """Return the map of a status after the check of its size, with and without flux images."""
    values = codec.unpack(data, where, STATUS_LIMIT)
    flux = values.get("flux")
    # The images must not make room for an oversized text elsewhere in the status.
    n_bytes = len(data) - (len(flux) if isinstance(flux, bytes) else 0)
    if n_bytes > codec.MESSAGE_LIMIT:
        raise WireError(
            f"range: a status has {n_bytes} bytes besides its flux, expected at most "
            f"{codec.MESSAGE_LIMIT}"
        )
    return values


def _status_keys(keys: codec.Map) -> codec.Map:
    playing, keys = keys["dither"], codec.without_nil(keys, "trouble", "reference_id")
    if playing is None:
        return keys
    return {**keys, "dither": {**codec.to_map(playing.request), "start_seq": playing.start_seq}}


def _status_fields(values: codec.Map, where: str) -> codec.Map:
    playing, inside = codec.require(values, "dither", where), f"'dither' of {where}"
    if playing is None:
        return values
    request = codec.from_map(commands.DitherRequest, codec.require_map(playing, inside), inside)
    start_seq = codec.require(playing, "start_seq", inside)
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
    four = {key: codec.read_registration(values, key, where) for key in ("alpha", "sigma")}
    return {**values, **four, "waiting_for": values.get("waiting_for") or ()}


codec.register(
    Status,
    STATUS_NAME,
    first=("session", "seq", "t_ns", "loop", "frame_rate_hz"),
    optional_keys=("pointing", "trouble", "reference_id"),
    unpack=_unpack_status,
    keys=_status_keys,
    fields=_status_fields,
    check=_check_status,
)
codec.register(
    StateMessage,
    "a state message",
    optional_keys=("validity", "waiting_for", "operation"),
    fields=_state_fields,
    checked_when_sent=False,
)
codec.register(
    GainsMessage,
    "a gains message",
    unpack=partial(codec.unpack, limit=STATUS_LIMIT),
    checked_when_sent=False,
)
codec.register(AlarmMessage, "an alarm message", checked_when_sent=False)
