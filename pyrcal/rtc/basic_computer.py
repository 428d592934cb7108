"""The bookkeeping of an RTC: session, matrices on their way, gains, dither, status."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pyrcal.rtc.dither import Dither, check_dither
from pyrcal.rtc.identity import Identity, Reconstructor, new_session
from pyrcal.rtc.references import ReferenceOffset
from pyrcal.rtc.replies import FinishedMeasurement
from pyrcal.rtc.staging import Terms
from service import wire

Array32 = NDArray[np.float32]

_MAX_DITHER_DURATION_S = 3600.0

_DITHER_LEAD_S = 0.05
"""Time from the acceptance of a dither to its first frame: the reply must arrive before it."""


class BasicComputer:
    """A :class:`Computer` that keeps the books of the contract; the program does the rest.

    The program runs the loop in batches of frames::

        dither_m = computer.begin_batch(n_frames)     # a new reconstructor is in use from here on
        ...                                           # expose, reconstruct, command
        header, rows = computer.end_batch(slopes, commands_m, dither_m)

    Between the two calls it reads :attr:`reconstructor`, :attr:`gains`, :attr:`leak` and
    :attr:`closed`. A program that lets the service set reference slopes also reads
    :meth:`reference_offset` in each batch. All other methods are called by the link, from other
    threads.

    Parameters
    ----------
    identity
        System, modal basis and sensor configuration.
    matrix
        The first control matrix, ``(n_controlled, n_slopes)``, metres of OPD per unit of slope.
    gains
        Integrator gain of each mode, ``(n_modes,)``; 0 for modes that are not controlled.
    leak
        Factor of the integrator per frame, 0 to 1.
    frame_rate_hz
        Frame rate.
    delay_frames
        Frames from an exposure to the first exposure with the command that answers it.
    max_dither_m
        Largest dither of a mode, metres of OPD RMS. 0 if the mirror cannot be dithered.
    max_dither_modes
        Largest number of modes dithered at the same time.
    """

    def __init__(
        self,
        identity: Identity,
        matrix: ArrayLike,
        *,
        gains: ArrayLike,
        leak: float,
        frame_rate_hz: float,
        delay_frames: float,
        max_dither_m: float,
        max_dither_modes: int = 8,
    ) -> None:
        self.identity = identity
        """Names. Replace them by others (``dataclasses.replace``) between two batches."""
        self.gains = np.asarray(gains, dtype=np.float64)
        """Gain of each mode, ``(n_modes,)``."""
        self.leak = leak
        """Factor of the integrator per frame."""
        self.closed = True
        """True if the loop is closed. When it opens, the integrator must be set to zero."""
        self.seq = 0
        """Sequence number of the next frame."""
        self._start_ns = time.time_ns()
        self._session = new_session()
        self._reconstructor = Reconstructor.own(
            f"own-{self._start_ns}",
            np.asarray(matrix, dtype=np.float32),
            identity,
            created_ns=self._start_ns,
        )
        self._n_next = len(self._reconstructor.matrix)
        self._frame_rate_hz = frame_rate_hz
        self._delay_frames = delay_frames
        self._max_dither_m = max_dither_m
        self._max_dither_modes = max_dither_modes
        self._dither: Dither | None = None
        self._staged: Reconstructor | None = None
        self._swaps: list[tuple[str, int]] = []
        self._n_exposing = 0
        self._offset = ReferenceOffset(self.n_slopes)
        self._offsets: Array32 | None = None
        self._named: str | None = None
        self._subtracts_offset = False
        self._lock = threading.Lock()

    @property
    def n_modes(self) -> int:
        """Number of modes of the basis."""
        return len(self.gains)

    @property
    def n_slopes(self) -> int:
        """Number of slopes."""
        return int(self._reconstructor.matrix.shape[1])

    @property
    def session(self) -> str:
        """Session of the frames to come. It changes when the loop opens."""
        return self._session

    @property
    def reconstructor(self) -> Reconstructor:
        """The control matrix in use."""
        return self._reconstructor

    @property
    def largest_matrix_bytes(self) -> int:
        """Size of a control matrix for all modes."""
        return 4 * self.n_modes * self.n_slopes

    @property
    def has_swapped(self) -> bool:
        """True if a swap has not been reported yet: call ``RtcLink.report_matrices``."""
        return bool(self._swaps)

    def begin_batch(self, n_frames: int) -> Array32:
        """Begin the next frames: swap in a staged reconstructor, end a finished dither.

        Returns
        -------
        The dither of these frames, ``(n_frames, n_modes)`` metres of OPD, zero without a dither.
        """
        with self._lock:
            if self._staged is not None:
                self._reconstructor, self._staged = self._staged, None
                self._swaps.append((self._reconstructor.manifest.id, self.seq))
            if self._dither is not None and self.seq >= self._dither.stop_seq:
                self._dither = None
            self._n_exposing = n_frames
            self._offsets = self._offset.advance(self.seq, n_frames)
            if self._offset.name is not None and self._offset.name != self._named:
                self._named = self._offset.name
                self.identity = replace(self.identity, reference_id=self._named)
            played = None if self._dither is None else self._dither.commands(self.seq, n_frames)
        return np.zeros((n_frames, self.n_modes), dtype=np.float32) if played is None else played

    def reference_offset(self) -> Array32:
        """Return what to subtract from the slopes of these frames, ``(n_frames, n_slopes)``.

        It comes on top of the program's own reference slopes, and is zero until the service
        requests references. Such requests are refused until this method has been called, because
        an acknowledgement would claim references that are not subtracted.
        """
        if self._offsets is None:
            raise RuntimeError("reference_offset: expected a call of begin_batch before it")
        self._subtracts_offset = True
        return self._offsets

    def references_in_use(self) -> wire.ReferencesInUse:
        """Return the offset that is subtracted now."""
        with self._lock:
            return self._offset.in_use(self.identity.reference_id or self.identity.config_id)

    def end_batch(
        self, slopes: ArrayLike, commands_m: ArrayLike, dither_m: ArrayLike
    ) -> tuple[wire.FrameHeader, Array32]:
        """Return header and rows of the frames just exposed, for ``RtcLink.publish_frames``.

        Parameters
        ----------
        slopes
            ``(n_frames, n_slopes)``.
        commands_m
            ``(n_frames, n_modes)`` metres of OPD on the mirror during each exposure, dither
            included.
        dither_m
            What ``begin_batch`` has returned.
        """
        rows = np.hstack([slopes, commands_m, dither_m]).astype(np.float32)
        with self._lock:
            header = wire.FrameHeader(
                session=self._session,
                seq0=self.seq,
                n=len(rows),
                t0_ns=self.time_ns(self.seq),
                dt_ns=round(1e9 / self._frame_rate_hz),
                n_slopes=self.n_slopes,
                n_modes=self.n_modes,
                dither=True,
                cm_id=self._reconstructor.manifest.id,
                basis_id=self.identity.basis_id,
                config_id=self.identity.config_id,
                reference_id=self.identity.reference_id,
            )
            self.seq += len(rows)
            self._n_exposing = 0
        return header, rows

    def time_ns(self, seq: int) -> int:
        """Return the end of exposure of a frame, nanoseconds since the Unix epoch, UTC."""
        # From the sequence and not from the clock: timestamps must be even, however late a batch is
        # processed.
        return self._start_ns + round(seq * 1e9 / self._frame_rate_hz)

    def status(self) -> wire.Status:
        """Return the present status, for ``RtcLink.publish_status``."""
        with self._lock:
            return wire.Status(
                session=self._session,
                seq=self.seq - 1 if self.seq else None,
                t_ns=self.time_ns(max(self.seq - 1, 0)),
                loop=wire.Loop.CLOSED if self.closed else wire.Loop.OPEN,
                frame_rate_hz=self._frame_rate_hz,
                delay_frames=self._delay_frames,
                gains=tuple(self.gains.tolist()),
                leak=self.leak,
                n_slopes=self.n_slopes,
                n_modes=self.n_modes,
                n_controlled=len(self._reconstructor.matrix),
                cm_id=self._reconstructor.manifest.id,
                basis_id=self.identity.basis_id,
                config_id=self.identity.config_id,
                reference_id=self.identity.reference_id,
                dither=None if self._dither is None else self._dither.status,
                max_dither_m=self._max_dither_m,
                max_dither_modes=self._max_dither_modes,
                magnitude=None,
            )

    def terms(self) -> Terms:
        """Return what a new reconstructor must agree with at present."""
        return Terms(
            session=self._session,
            identity=self.identity,
            n_slopes=self.n_slopes,
            # A dict keeps the order, so that a refusal names the present number first.
            n_controlled=tuple(dict.fromkeys((len(self._reconstructor.matrix), self._n_next))),
        )

    def stage(self, reconstructor: Reconstructor) -> None:
        """Accept a checked matrix; the next ``begin_batch`` swaps it in."""
        with self._lock:
            self._staged = reconstructor

    def take_swaps(self) -> list[tuple[str, int]]:
        """Return id and first frame of each matrix swapped in since the last call."""
        with self._lock:
            swaps, self._swaps = self._swaps, []
        return swaps

    def take_measured(self) -> tuple[FinishedMeasurement, ...]:
        """Return no measurement. A program that measures matrices overrides this."""
        return ()

    def execute(self, command: wire.Command) -> wire.Reply:
        """Execute a command and return the reply; a refusal carries its reason."""
        with self._lock:
            reason, start_seq = self._change(command)
        return wire.Reply(id=command.id, accepted=not reason, reason=reason, start_seq=start_seq)

    def _change(self, command: wire.Command) -> tuple[str, int | None]:
        """Apply a command; return the reason of a refusal and the first frame of a dither."""
        match command:
            case wire.DitherRequest():
                return self._begin_dither(command)
            case wire.DitherStop():
                self._dither = None
            case wire.LoopRequest():
                return self._change_loop(command), None
            case wire.ReferencesRequest() if self._subtracts_offset:
                return self._change_references(command)
            case _:
                return "unsupported: this RTC has no such command", None
        return "", None

    def _begin_dither(self, request: wire.DitherRequest) -> tuple[str, int | None]:
        if self._dither is not None:
            return f"busy: dither {self._dither.request.id} plays", None
        refusal = check_dither(
            request,
            n_modes=self.n_modes,
            frame_rate_hz=self._frame_rate_hz,
            max_amplitude_m=self._max_dither_m,
            max_duration_s=_MAX_DITHER_DURATION_S,
            max_modes=self._max_dither_modes,
        )
        if refusal:
            return refusal, None
        # The batch that is being exposed was begun without the dither, however long it is.
        start_seq = self.seq + self._n_exposing + round(_DITHER_LEAD_S * self._frame_rate_hz)
        self._dither = Dither(
            request,
            start_seq=start_seq,
            n_modes=self.n_modes,
            frame_rate_hz=self._frame_rate_hz,
        )
        return "", start_seq

    def _change_references(self, request: wire.ReferencesRequest) -> tuple[str, int | None]:
        refusal = self._offset.check(request, self.identity.config_id)
        if refusal:
            return refusal, None
        start_seq = self.seq + self._n_exposing
        self._offset.begin(request, start_seq, self._frame_rate_hz)
        return "", start_seq

    def _change_loop(self, request: wire.LoopRequest) -> str:
        if request.gains is not None:
            if len(request.gains) != self.n_modes:
                return f"range: {len(request.gains)} gains, expected {self.n_modes}"
            self.gains = np.array(request.gains)
        if request.leak is not None:
            self.leak = request.leak
        # The number changes with the next matrix: the one in use has its own rows.
        self._n_next = request.n_controlled or self._n_next
        if request.loop is wire.Loop.OPEN and self.closed:
            # Zeroing the integrator begins a new session by the contract. A dither and a
            # matrix that waits to be swapped in belong to the session that ends.
            self._session, self._dither, self.closed = new_session(), None, False
            self._staged = None
        elif request.loop is wire.Loop.CLOSED:
            self.closed = True
        return ""
