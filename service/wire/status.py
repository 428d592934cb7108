"""What the RTC says about itself and its reconstructors, and what the service tells everyone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.errors import WireError
from service.model.misregistration import PARAMETERS
from service.wire.commands import DitherRequest, Loop, read_dither
from service.wire.fields import MESSAGE_LIMIT, Fields, pack

STATUS_LIMIT: Final = MESSAGE_LIMIT + 16 * 512**2
"""Bytes: a longer status is refused unread; its images come on top of what a message may have."""

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

RATE_LIMIT_HZ: Final = 1e6
DELAY_LIMIT_FRAMES: Final = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DitherStatus:
    """The dither the RTC is playing."""

    request: DitherRequest
    """What was asked for."""

    start_seq: int
    """First frame whose exposure contains it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointingStatus:
    """Where the telescope looks, as far as the RTC knows."""

    elevation_deg: float
    """Above the horizon."""

    azimuth_deg: float
    """From north over east."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """The RTC's own account of its loop, a few times a second."""

    session: str
    seq: int | None
    """The last frame processed; None: there has been none yet."""

    t_ns: int
    """Nanoseconds since the Unix epoch, UTC."""

    loop: Loop
    frame_rate_hz: float
    delay_frames: float
    """End to end, from exposure to the command that answers it."""

    gains: tuple[float, ...]
    """One per mode of the basis, 0 where uncontrolled."""

    leak: float
    """Per frame; 1 forgets nothing."""

    n_slopes: int
    n_modes: int
    n_controlled: int
    cm_id: str | None
    """The reconstructor in use; None when the RTC does not know."""

    basis_id: str
    config_id: str
    dither: DitherStatus | None
    max_dither_m: float
    """Most the RTC accepts for one mode, metres RMS."""

    max_dither_modes: int
    """Most modes the RTC dithers at once."""

    magnitude: float | None
    """Of the guide star."""

    flux: bytes | None
    """``<f4`` ``[4, n_subapertures, n_subapertures]``, counts per frame averaged over a second."""

    pointing: PointingStatus | None = None
    """An extension: an RTC that does not know it may leave the key out."""

    @property
    def flux_images(self) -> NDArray[np.float32] | None:
        """``(4, n_subapertures, n_subapertures)``, in row-major order of their place."""
        if self.flux is None:
            return None
        side = math.isqrt(len(self.flux) // 16)
        return np.frombuffer(self.flux, dtype="<f4").reshape(4, side, side)


class AckState(StrEnum):
    """How far a reconstructor has come in the RTC."""

    STAGED = "staged"
    APPLIED = "applied"
    REJECTED = "rejected"


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledgement:
    """The RTC's word on one reconstructor."""

    session: str
    id: str | None
    """None: the commit that is rejected could not be read."""

    sha256: str | None
    """Of the matrix meant, 64 lower-case hex digits; None where ``id`` is."""

    state: AckState
    reason: str
    """Why it was rejected; empty otherwise."""

    frame_seq: int | None
    """First frame whose slopes the new matrix multiplies; None unless applied."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StateMessage:
    """What the service knows, for whoever listens; an RTC ignores it."""

    system: str
    t_ns: int
    """When it was said, nanoseconds since the Unix epoch, UTC."""

    mode: str
    """How much the service may do by itself: auto, propose or hold."""

    alpha: Mapping[str, float] | None
    """Registration: shifts in subapertures, rotation in degrees, ratio; None: not known yet."""

    sigma: Mapping[str, float] | None
    """1 σ of ``alpha``, same names and units."""

    in_use: str | None
    """The reconstructor the RTC multiplies with; None: unknown."""

    validity: str | None = None
    """Whether ``alpha`` may be relied on: fresh, ageing, stale or invalid; None: nothing is known,
    or a service of before this key said it."""

    waiting_for: tuple[str, ...] = ()
    """Whom the service waits for and what they should do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmMessage:
    """One alarm that came or went, for whoever listens."""

    system: str
    t_ns: int
    """When it came or went, nanoseconds since the Unix epoch, UTC."""

    name: str
    """Machine-readable."""

    active: bool
    """False: it is over."""

    text: str
    """What was found, and what to do."""


def encode_status(status: Status) -> bytes:
    """Return the payload of a status message.

    Raises
    ------
    WireError
        If the record breaks the contract.
    """
    playing = status.dither
    dither = None
    if playing is not None:
        request = {f.name: getattr(playing.request, f.name) for f in fields(playing.request)}
        dither = {**request, "start_seq": playing.start_seq}
    pointing = None if status.pointing is None else asdict(status.pointing)
    data = pack(status, dither=dither, pointing=pointing)
    decode_status(data)
    return data


def decode_status(data: bytes) -> Status:
    """Return the RTC's account of its loop.

    Raises
    ------
    WireError
        If a key is missing or out of range, or the message is too long.
    """
    message = _checked(data).of_this_version()
    n_modes = message.integer("n_modes", 1)
    gains = message.numbers("gains", low=0.0)
    if len(gains) != n_modes:
        raise message.refusal("gains", list(gains), f"one for each of {n_modes} modes")
    return Status(
        session=message.opaque("session"),
        seq=message.optional("seq", message.integer),
        t_ns=message.integer("t_ns"),
        loop=message.choice("loop", Loop),
        frame_rate_hz=message.number("frame_rate_hz", above=0.0, high=RATE_LIMIT_HZ),
        delay_frames=message.number("delay_frames", 0.0, DELAY_LIMIT_FRAMES),
        gains=gains,
        leak=message.number("leak", 0.0, 1.0),
        n_slopes=message.integer("n_slopes", 1),
        n_modes=n_modes,
        n_controlled=message.integer("n_controlled", 0, n_modes),
        cm_id=message.optional("cm_id", message.identifier),
        basis_id=message.opaque("basis_id"),
        config_id=message.opaque("config_id"),
        dither=message.optional("dither", lambda key: _dither(message.child(key))),
        max_dither_m=message.number("max_dither_m", 0.0),
        max_dither_modes=message.integer("max_dither_modes"),
        magnitude=message.optional("magnitude", message.number),
        flux=message.optional("flux", lambda key: _flux(message, key)),
        pointing=message.extension("pointing", lambda key: _pointing(message.child(key))),
    )


def essentials(data: bytes) -> tuple[object, ...]:
    """Return what of a status must not be missed, unchecked; two that differ in it both count.

    Raises
    ------
    WireError
        If the message is no map, or too long.
    """
    message = _checked(data)
    return tuple(message.extension(key, message.get) for key in ESSENTIAL)


def _checked(data: bytes) -> Fields:
    """Return the map of a status that is no longer than its limit, its images left aside."""
    message = Fields.unpack(data, "a status", STATUS_LIMIT)
    flux = message.extension("flux", message.get)
    n_bytes = len(data) - (len(flux) if isinstance(flux, bytes) else 0)
    if n_bytes > MESSAGE_LIMIT:
        raise WireError(
            f"range: a status has {n_bytes} bytes besides its flux, expected at most "
            f"{MESSAGE_LIMIT}"
        )
    return message


def _pointing(message: Fields) -> PointingStatus:
    return PointingStatus(
        elevation_deg=message.number("elevation_deg", -90.0, 90.0),
        azimuth_deg=message.number("azimuth_deg", -720.0, 720.0),
    )


def _dither(message: Fields) -> DitherStatus:
    return DitherStatus(request=read_dither(message), start_seq=message.integer("start_seq"))


def _flux(message: Fields, key: str) -> bytes:
    value = message.get(key)
    if not isinstance(value, bytes) or 16 * math.isqrt(len(value) // 16) ** 2 != len(value):
        raise message.refusal(key, value, "bytes of four square float32 images")
    return value


def encode_acknowledgement(acknowledgement: Acknowledgement) -> bytes:
    """Return the payload of an acknowledgement.

    Raises
    ------
    WireError
        If the record breaks the contract.
    """
    data = pack(acknowledgement)
    decode_acknowledgement(data)
    return data


def decode_acknowledgement(data: bytes) -> Acknowledgement:
    """Return the RTC's word on one reconstructor.

    Raises
    ------
    WireError
        If a key is missing or out of range.
    """
    message = Fields.unpack(data, "an acknowledgement").of_this_version()
    state = message.choice("state", AckState)
    frame_seq = message.optional("frame_seq", message.integer)
    if (frame_seq is not None) != (state is AckState.APPLIED):
        raise message.refusal("frame_seq", frame_seq, "a number if and only if applied")
    matrix_id = message.optional("id", message.identifier)
    sha256 = message.optional("sha256", message.sha256)
    if state is not AckState.REJECTED and (matrix_id is None or sha256 is None):
        raise message.refusal("id, sha256", (matrix_id, sha256), "both, unless rejected")
    return Acknowledgement(
        session=message.opaque("session"),
        id=matrix_id,
        sha256=sha256,
        state=state,
        reason=message.optional("reason", message.text) or "",
        frame_seq=frame_seq,
    )


def encode_state(message: StateMessage) -> bytes:
    """Return the payload of a state message."""
    return pack(message)


def decode_state(data: bytes) -> StateMessage:
    """Return what the service said it knows.

    Raises
    ------
    WireError
        If a key is missing or out of range.
    """
    message = Fields.unpack(data, "a state message").of_this_version()
    return StateMessage(
        system=message.identifier("system"),
        t_ns=message.integer("t_ns"),
        mode=message.text("mode"),
        alpha=message.optional("alpha", lambda key: message.named_numbers(key, PARAMETERS)),
        sigma=message.optional("sigma", lambda key: message.named_numbers(key, PARAMETERS)),
        in_use=message.optional("in_use", message.identifier),
        validity=message.extension("validity", message.text),
        waiting_for=message.extension("waiting_for", message.texts) or (),
    )


def encode_alarm(message: AlarmMessage) -> bytes:
    """Return the payload of an alarm message."""
    return pack(message)


def decode_alarm(data: bytes) -> AlarmMessage:
    """Return an alarm the service raised or took back.

    Raises
    ------
    WireError
        If a key is missing or out of range.
    """
    message = Fields.unpack(data, "an alarm message").of_this_version()
    return AlarmMessage(
        system=message.identifier("system"),
        t_ns=message.integer("t_ns"),
        name=message.text("name", low=1),
        active=message.flag("active"),
        text=message.text("text"),
    )
