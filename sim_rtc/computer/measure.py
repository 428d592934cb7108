"""Measure an interaction matrix and send it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pyrcal.rtc.identity import Identity
from service.wire import (
    CHUNK_LIMIT,
    MatrixLayout,
    MeasuredManifest,
    MeasureRequest,
    Pattern,
    layout_of,
)
from sim_rtc.computer.strokes import (
    Demodulation,
    PushPull,
    Regression,
    Tones,
    frames_per_shape,
    hadamard_order,
    hadamard_shapes,
    modal,
    pokes,
    system_shapes,
)

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_LARGEST_M = 200e-9
"""RMS of one mode's stroke, metres OPD."""

_LINE_SPACING = 4.0
"""Least distance of two tones, in frequency bins: a Hann window's main lobe."""


class Measurement:
    """One accepted measurement, from its first frame to its last."""

    def __init__(
        self, request: MeasureRequest, strokes: PushPull | Tones, solver: Regression | Demodulation
    ) -> None:
        self.request = request
        self.session = ""
        """Session in which it ended."""
        self.failure = ""
        """Why there is no matrix; empty: there may be one."""
        self.needs_open_loop = request.pattern is not Pattern.SINE
        """True if the loop must not respond to the strokes."""
        self.start_seq = 0
        self._strokes = strokes
        self._solver = solver

    @property
    def n_slopes(self) -> int:
        """Rows of its matrix."""
        return self._solver.n_slopes

    @property
    def stop_seq(self) -> int:
        """First frame after it."""
        return self.start_seq + self._strokes.n_frames

    def commands(self, seq0: int, n_frames: int) -> Array32 | None:
        """Return the strokes of these frames ``(n_frames, n_modes)``, metres; None: not now."""
        frame = np.arange(seq0, seq0 + n_frames) - self.start_seq
        playing = (frame >= 0) & (frame < self._strokes.n_frames)
        if not playing.any():
            return None
        strokes = self._strokes.commands(frame[playing])
        if playing.all():
            return strokes
        out = np.zeros((n_frames, strokes.shape[1]), dtype=np.float32)
        out[playing] = strokes
        return out

    def take(self, seq0: int, slopes: Array32, commands_m: Array32) -> None:
        """Read back what the sensor saw and what the mirror did; a frame of NaN is left out."""
        frame = np.arange(seq0, seq0 + len(slopes)) - self.start_seq
        usable = (frame >= 0) & (frame < self._strokes.n_frames)
        usable &= np.isfinite(slopes).all(axis=1) & np.isfinite(commands_m).all(axis=1)
        if usable.any():
            self._solver.take(frame[usable], slopes[usable], commands_m[usable])

    def matrix(self) -> Array32:
        """Return ``(n_slopes, n_measured)``, slope per metre OPD; takes a moment.

        Raises
        ------
        numpy.linalg.LinAlgError
            If what was read back determines no matrix.
        """
        return self._solver.matrix()

    def product(
        self, identity: Identity, created_ns: int
    ) -> tuple[MeasuredManifest, Array32 | None]:
        """Return the manifest of the finished measurement, and its matrix.

        The matrix is None if there is none; the manifest then has the reason. ``created_ns`` is
        nanoseconds since the Unix epoch, UTC.
        """
        failure, matrix = self.failure, None
        if not failure:
            try:
                matrix = self.matrix()
            except np.linalg.LinAlgError as error:
                failure = f"what was read back determines no matrix: {error}"
        if matrix is not None and not np.isfinite(matrix).all():
            failure, matrix = "the matrix came out with numbers that are not finite", None
        request = self.request
        if matrix is None:
            layout = MatrixLayout(
                shape=(self.n_slopes, len(request.modes)),
                n_chunks=0,
                chunk_bytes=CHUNK_LIMIT,
                sha256="",
            )
        else:
            layout = layout_of(matrix, CHUNK_LIMIT)
        manifest = MeasuredManifest(
            id=request.id,
            layout=layout,
            reason=failure or None,
            modes=request.modes,
            amplitude_m=request.amplitude_m,
            n_average=request.n_average or 1,
            pattern=request.pattern,
            double_pass=identity.double_pass,
            session=self.session,
            basis_id=identity.basis_id,
            config_id=identity.config_id,
            system=identity.system,
            created_ns=created_ns,
        )
        return manifest, matrix


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasurementRules:
    """Limits and shapes that measurements use."""

    n_modes: int
    """Number of modes of the basis."""

    n_slopes: int
    frame_rate_hz: float
    mode_to_actuator: Array | None = None
    """``(n_actuators, n_modes)``; None: the mirror takes modes only."""

    longest_s: float = 1200.0
    """Duration of the whole measurement, seconds."""

    def refusal(self, request: MeasureRequest, n_controlled: int | None = None) -> str:
        """Return why a matrix cannot be measured so, in the wire's words; empty: it can.

        ``n_controlled`` modes have a row in the matrix in use; None: all have.
        """
        if max(request.modes) >= self.n_modes:
            return f"range: mode {max(request.modes)}, expected 0 to {self.n_modes - 1}"
        largest_m = max(request.amplitude_m)
        if largest_m > _LARGEST_M:
            return f"range: amplitude_m {largest_m:.3g}, expected at most {_LARGEST_M:.3g}"
        if request.pattern is Pattern.PUSH_PULL_ZONAL:
            reason = self._zonal_refusal(request)
        elif request.pattern is Pattern.SINE:
            reason = self._sine_refusal(request)
        elif request.pattern is Pattern.SYSTEM_MODES:
            reason = self._system_refusal(request, n_controlled or self.n_modes)
        else:
            reason = ""
        return reason or self._length_refusal(request)

    def measurement(
        self, request: MeasureRequest, reconstructor: Array32 | None = None
    ) -> Measurement:
        """Return the measurement of a request that :meth:`refusal` accepts.

        Only system modes need the ``reconstructor`` in use, ``(n_controlled, n_slopes)``.
        """
        strokes = self._strokes(request, reconstructor)
        if isinstance(strokes, Tones):
            return Measurement(request, strokes, Demodulation(strokes, n_slopes=self.n_slopes))
        solver = Regression(request.modes, n_modes=self.n_modes, n_slopes=self.n_slopes)
        return Measurement(request, strokes, solver)

    def _strokes(self, request: MeasureRequest, reconstructor: Array32 | None) -> PushPull | Tones:
        modes, amplitude_m = request.modes, request.amplitude_m
        if request.pattern is Pattern.SINE:
            return Tones(
                modes=np.array(modes, dtype=np.intp),
                amplitude_m=np.array(amplitude_m),
                cycles_per_frame=np.array(request.frequency_hz) / self.frame_rate_hz,
                n_modes=self.n_modes,
                n_frames=self._n_frames(request),
            )
        if request.pattern is Pattern.HADAMARD:
            shapes = hadamard_shapes(modes, amplitude_m, self.n_modes)
        elif request.pattern is Pattern.PUSH_PULL_ZONAL and self.mode_to_actuator is not None:
            shapes = pokes(self.mode_to_actuator, amplitude_m[0])
        elif request.pattern is Pattern.SYSTEM_MODES and reconstructor is not None:
            shapes = system_shapes(reconstructor, modes, amplitude_m[0], self.n_modes)
        else:
            shapes = modal(modes, amplitude_m, self.n_modes)
        return PushPull(shapes_m=shapes, n_average=request.n_average or 1)

    def _zonal_refusal(self, request: MeasureRequest) -> str:
        if self.mode_to_actuator is None:
            return "unsupported: the actuators of this mirror are not known, ask for modal"
        return self._check_evenness(request, "actuator")

    def _system_refusal(self, request: MeasureRequest, n_controlled: int) -> str:
        if max(request.modes) >= n_controlled:
            return (
                f"range: mode {max(request.modes)} has no row in the reconstructor in use, "
                f"expected 0 to {n_controlled - 1}"
            )
        return self._check_evenness(request, "system mode")

    def _check_evenness(self, request: MeasureRequest, shape: str) -> str:
        if len(set(request.amplitude_m)) > 1:
            return f"range: several values in amplitude_m, expected the same for every {shape}"
        return ""

    def _sine_refusal(self, request: MeasureRequest) -> str:
        lines_hz = np.sort(request.frequency_hz or ())
        highest_hz = self.frame_rate_hz / 2
        if lines_hz[-1] >= highest_hz:
            return f"range: frequency_hz {lines_hz[-1]:g}, expected below {highest_hz:g}"
        duration_s = request.duration_s or 0.0
        # The first tone's distance from 0 counts as well: a constant slope leaks like another tone.
        spacing_hz = float(np.diff(lines_hz, prepend=0.0).min())
        # With a margin for rounding: tones at exactly the least distance are accepted.
        if spacing_hz * duration_s < _LINE_SPACING * (1 - 1e-9):
            return (
                f"range: frequency_hz {spacing_hz:.3g} Hz apart, expected at least "
                f"{_LINE_SPACING / duration_s:.3g} Hz between any two and from 0"
            )
        return ""

    def _length_refusal(self, request: MeasureRequest) -> str:
        duration_s = self._n_frames(request) / self.frame_rate_hz
        if duration_s <= self.longest_s:
            return ""
        return f"range: this would take {duration_s:.0f} s, expected at most {self.longest_s:g} s"

    def _n_frames(self, request: MeasureRequest) -> int:
        if request.pattern is Pattern.SINE:
            return max(1, round((request.duration_s or 0.0) * self.frame_rate_hz))
        n_shapes = len(request.modes)
        if request.pattern is Pattern.HADAMARD:
            n_shapes = hadamard_order(n_shapes)
        elif request.pattern is Pattern.PUSH_PULL_ZONAL and self.mode_to_actuator is not None:
            n_shapes = len(self.mode_to_actuator)
        return n_shapes * frames_per_shape(request.n_average or 1)
