"""Telemetry as arrays, of any recorder: as the messages in which an RTC would have sent it.

An HDF5 file, or an ``.npz`` of NumPy's, with

    slopes            (n_frames, n_slopes)   in the RTC's own order and sign
    commands_m        (n_frames, n_modes)    on the mirror during the exposure, dither included
    dither_m          (n_frames, n_modes)    optional: the dither's share of the command
    reconstructor     (n_controlled, n_slopes)  optional: metres per slope
    seq               (n_frames,)            optional: counts frames, those missing too
    gains             (n_modes,) or one      optional: 0 where not controlled, default 0.5
    dither_modes, dither_frequencies_hz, dither_amplitude_m   optional, (n_dithered,): sines that
                                             begin with the first frame

and the numbers ``frame_rate_hz``, ``delay_frames`` (default 2), ``leak`` (default 1), ``t0_ns_utc``
(default 0), as attributes of the HDF5 file or arrays of one number. Metres are metres of OPD.

Small arrays are checked before anything is played. Slopes and commands may be larger than the
memory: they are checked as they are read, and frames that hold a number that is not finite are left
out, as the service leaves them out.
"""

from __future__ import annotations

import contextlib
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from pyrcal.importers.saved import read_npz
from pyrcal.playback.alignment import MAX_FRAMES, measure_delay
from pyrcal.rtc.identity import Identity, Reconstructor
from service import wire
from service.errors import ConfigurationError, say
from service.files import FileKind, kind_of
from service.files.container import opened
from service.files.recording import Message, RecordedKind
from service.files.whole import open_hdf5
from service.model.instrument import Instrument
from service.tracking.policy import SECOND_NS

Array = NDArray[np.float64]

STATUS_S: Final = 0.5
"""Time between two statuses, seconds."""

MAX_NUMBER: Final = 1e12
"""Largest slope, command (m) or element of a reconstructor (m per slope), in whatever unit: larger
ones overflow single precision once they are squared and summed."""

MIN_APART_FRAMES: Final = 1.5
"""Smallest difference of measured and stated delay that is reported as an offset of the streams; a
stated delay need not be an integer."""

_N_CHECKED_FRAMES: Final = 2000
"""Number of frames of the dither in which each of its modes must move."""

MAX_RATE_HZ: Final = 1e6
MAX_DELAY_FRAMES: Final = 100.0
MAX_SPAN_S: Final = 86_400.0
"""Longest time from the first frame to the last: the contract's limit for a dither."""

_FINITE: Final = f"finite numbers up to {MAX_NUMBER:g}"

_MOST_EXACT: Final = 2**53
_MOST_SEQ: Final = 2**62
"""Largest frame numbers that a double and a message can hold; room is left for what follows."""

SESSION: Final = "file"
MATRIX_ID: Final = "of-the-file"


@contextmanager
def open_arrays(path: Path) -> Iterator[Arrays]:
    """Open a file of arrays and close it at the end of the ``with`` block.

    Raises
    ------
    ConfigurationError
        If the file is of another kind, lacks a required array, or its arrays do not fit together.
    """
    with contextlib.ExitStack() as stack:
        try:
            if zipfile.is_zipfile(path):
                found: dict[str, Any] = dict(read_npz(path, max_bytes=None))
            elif kind_of(path) is FileKind.HDF5:
                file = stack.enter_context(open_hdf5(path))
                # Numbers may be attributes; an attribute does not take the place of an array.
                found = {name: np.asarray(value) for name, value in file.attrs.items()}
                found |= {k: v for k, v in file.items() if isinstance(v, h5py.Dataset)}
            elif kind_of(path) is FileKind.MATLAB:
                with opened(path) as container:
                    found = {name: stored.read() for name, stored in container.arrays.items()}
            else:
                raise ConfigurationError(f"{path}: expected telemetry in HDF5, .npz or .mat")
        except (OSError, RuntimeError, ValueError, KeyError) as error:
            raise ConfigurationError(f"{path}: damaged: {error}") from error
        yield Arrays(path=path, found=found)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Arrays:
    """Telemetry in a file; large arrays are read when they are played."""

    path: Path
    found: Mapping[str, Any]
    """Arrays and numbers by name, as they are in the file."""

    def messages(self, instrument: Instrument) -> Iterator[Message]:
        """Yield it as an RTC would have sent it: matrix, statuses, frames.

        Raises
        ------
        ConfigurationError
            If something is missing, of the wrong shape or out of its range, or if no frame is
            finite: what was found and expected, and where.
        """
        n_modes = instrument.modes.n_modes
        n_frames, n_slopes = self._shape("slopes", (None, None))
        _, n_given = self._shape("commands_m", (n_frames, None))
        if n_given > n_modes:
            raise self._refusal("commands_m", f"{n_given} modes", f"at most the basis's {n_modes}")
        if self._has("dither_m"):
            self._shape("dither_m", (n_frames, n_given))
        seq = self._sequence(n_frames)
        matrix = self._reconstructor(n_slopes, n_modes)
        n_controlled = n_given if matrix is None else len(matrix)
        status = self._status(instrument, n_slopes, n_given, n_controlled)
        if matrix is not None:
            yield _matrix_message(matrix, status)
        every = max(1, round(STATUS_S * status.frame_rate_hz))
        last_status, unusable = -1, np.zeros(0, np.intp)
        n_at_once = max(
            1, min(wire.FRAMES_PER_BATCH, wire.BATCH_LIMIT // (4 * (n_slopes + 2 * n_modes)))
        )
        for start, stop in _batches(seq, n_at_once):
            rows = self._rows(start, stop, n_modes)
            # A comparison with NaN is false, so it is left out as well.
            usable = np.all(np.abs(rows) <= MAX_NUMBER, axis=1)
            unusable = np.concatenate([unusable, start + np.flatnonzero(~usable)])
            for first, last in _runs(usable):
                numbers = seq[[start + first, start + last - 1]]
                since = numbers - seq[0]
                # By frames and not by time: a status comes before the first frame after a gap.
                if since[0] // every != last_status:
                    last_status = since[0] // every
                    yield _status_message(status, int(numbers[0]), int(since[0]))
                header = self._header(status, int(numbers[0]), last - first, int(since[0]))
                payload, attachment = wire.encode_frames(header, rows[first:last])
                at_s = float(since[1] + 1) / status.frame_rate_hz
                yield Message(at_s, RecordedKind.FRAMES, payload, attachment)
        self._report_unusable(unusable, n_frames)

    def misalignment(self) -> str:
        """Return in words how far apart slopes and commands were stored; empty if they were not.

        A whole number of frames is recognised, and only in a loop that is closed.
        """
        stated = self._number("delay_frames", 2.0, MAX_DELAY_FRAMES)
        n_frames, n_slopes = self._shape("slopes", (None, None))
        _, n_given = self._shape("commands_m", (n_frames, None))
        # Only frames before the first gap: a delay in frames has no meaning across one.
        edges = np.flatnonzero(np.diff(self._sequence(n_frames)) > 1)
        n = min(int(edges[0]) + 1 if len(edges) else n_frames, MAX_FRAMES)
        rows = self._rows(0, n, n_given).astype(float)
        usable = np.all(np.abs(rows) <= MAX_NUMBER, axis=1)
        rows = rows[: n if usable.all() else int(np.argmin(usable))]
        commands = rows[:, n_slopes : n_slopes + n_given]
        if self._has("dither_m"):
            # The dither is not a response to slopes.
            commands = commands - rows[:, n_slopes + n_given :]
        found = measure_delay(rows[:, :n_slopes], commands, stated)
        if found is None or abs(found - stated) < MIN_APART_FRAMES:
            return ""
        return (
            f"commands change {found} frames after the slopes that led to them, delay_frames is "
            f"{stated:g}: slopes and commands were stored {abs(found - stated):g} frames apart, or "
            f"delay_frames is {found}; give seq, or shift one of the two"
        )

    def _report_unusable(self, frames: NDArray[np.intp], n_frames: int) -> None:
        """Name frames that were left out.

        Raises
        ------
        ConfigurationError
            If that leaves none.
        """
        if not len(frames):
            return
        name, column, value = self._unusable_number(int(frames[0]))
        where = f"{value:g} in row {frames[0]}, column {column}"
        if len(frames) == n_frames:
            raise self._refusal(name, f"{where}, and no frame without such a number", _FINITE)
        say(
            f"note: {self.path}: {name}: found {where}; {len(frames)} of {n_frames} frames hold "
            "such numbers and are left out"
        )

    def _unusable_number(self, row: int) -> tuple[str, int, float]:
        """Return array, column and value of the first number of a frame that cannot be used."""
        for name in ("slopes", "commands_m", "dither_m"):
            if self._has(name):
                values = np.asarray(self.found[name][row], float)
                (places,) = np.nonzero(~(np.abs(values) <= MAX_NUMBER))
                if len(places):
                    return name, int(places[0]), float(values[places[0]])
        raise AssertionError(f"row {row} of {self.path} is finite")

    def _header(self, status: wire.Status, seq0: int, n: int, since: int) -> wire.FrameHeader:
        return wire.FrameHeader(
            session=status.session,
            seq0=seq0,
            n=n,
            t0_ns=status.t_ns + round(since / status.frame_rate_hz * SECOND_NS),
            dt_ns=round(SECOND_NS / status.frame_rate_hz),
            n_slopes=status.n_slopes,
            n_modes=status.n_modes,
            dither=self._has("dither_m"),
            cm_id=status.cm_id,
            basis_id=status.basis_id,
            config_id=status.config_id,
        )

    def _rows(self, first: int, last: int, n_modes: int) -> NDArray[np.float32]:
        """Return some frames in wire format; modes missing from the file are zero."""
        # What overflows single precision becomes infinite, and is left out as such.
        with np.errstate(over="ignore"):
            parts = [np.asarray(self.found["slopes"][first:last], np.float32)]
            for name in ("commands_m", "dither_m"):
                if self._has(name):
                    given = np.asarray(self.found[name][first:last], np.float32)
                    parts.append(np.pad(given, ((0, 0), (0, n_modes - given.shape[1]))))
        return np.hstack(parts)

    def _status(
        self, instrument: Instrument, n_slopes: int, n_given: int, n_controlled: int
    ) -> wire.Status:
        n_modes = instrument.modes.n_modes
        gains = np.zeros(n_modes)
        given = self._values("gains", 1) if self._has("gains") else np.array([0.5])
        if len(given) not in {1, n_controlled, n_modes}:
            expected = f"one number, {n_controlled} or {n_modes}"
            raise self._refusal("gains", f"{len(given)} numbers", expected)
        self._check_each(
            "gains",
            given,
            (given >= 0.0) & (given <= MAX_NUMBER),
            f"gains from 0 to {MAX_NUMBER:g}",
        )
        gains[: max(n_controlled, len(given) if len(given) > 1 else 0)] = given
        rate_hz = self._number("frame_rate_hz", None, MAX_RATE_HZ)
        n_frames, _ = self._shape("slopes", (None, None))
        # Written with not, so that NaN is refused too.
        if not rate_hz * MAX_SPAN_S >= n_frames:
            found = f"{rate_hz:g}, at which {n_frames} frames last longer than a day"
            raise self._refusal("frame_rate_hz", found, "frames a second")
        return wire.Status(
            delay_frames=self._number("delay_frames", 2.0, MAX_DELAY_FRAMES),
            gains=tuple(gains.tolist()),
            leak=self._number("leak", 1.0, 1.0),
            session=SESSION,
            seq=None,
            t_ns=int(self._number("t0_ns_utc", 0.0, 2.0**62)),
            loop=wire.Loop.CLOSED if n_controlled and gains.any() else wire.Loop.OPEN,
            frame_rate_hz=rate_hz,
            n_slopes=n_slopes,
            n_modes=n_modes,
            n_controlled=n_controlled,
            cm_id=MATRIX_ID if self._has("reconstructor") else None,
            basis_id=instrument.basis_id or SESSION,
            config_id=instrument.config_id or SESSION,
            dither=self._dither(rate_hz, n_given, n_frames),
            max_dither_m=1.0,
            max_dither_modes=n_modes,
            magnitude=None,
        )

    def _dither(self, rate_hz: float, n_given: int, n_frames: int) -> wire.DitherStatus | None:
        """Return the sines that play from the first frame; None if the file describes none."""
        names = ("dither_modes", "dither_frequencies_hz", "dither_amplitude_m")
        if not any(map(self._has, names)):
            return None
        modes, frequencies, amplitudes = (self._values(name, 1) for name in names)
        if not len(modes) == len(frequencies) == len(amplitudes):
            sizes = f"{len(modes)} modes, {len(frequencies)} frequencies, {len(amplitudes)} strokes"
            raise self._refusal("dither_modes", sizes, "one of each for every mode")
        if len(np.unique(modes)) < len(modes) or not len(modes):
            raise self._refusal("dither_modes", f"{modes.tolist()}", "each mode once")
        indices = f"indices of columns of commands_m, counted from 0 to {n_given - 1}"
        fits = (modes >= 0) & (modes < n_given) & (modes == np.round(modes))
        self._check_each("dither_modes", modes, fits, indices)
        # A sine of a mode that does not move would be fitted to noise.
        if self._has("dither_m"):
            moving = np.any(self.found["dither_m"][:_N_CHECKED_FRAMES], axis=0)
            still = "modes that dither_m moves (indices are counted from 0)"
            self._check_each("dither_modes", modes, moving[modes.astype(int)], still)
        # A sine above half of the frame rate is sampled as another frequency.
        most_hz = rate_hz / 2.0
        fits = (frequencies > 0.0) & (frequencies < most_hz)
        below = f"above 0 and below half of frame_rate_hz, {most_hz:g} Hz"
        self._check_each("dither_frequencies_hz", frequencies, fits, below)
        fits = (amplitudes > 0.0) & (amplitudes <= 1.0)
        self._check_each("dither_amplitude_m", amplitudes, fits, "above 0 and at most 1 m of OPD")
        request = wire.DitherRequest(
            id="dither-of-the-file",
            modes=tuple(int(mode) for mode in modes),
            amplitude_m=tuple(amplitudes.tolist()),
            kind=wire.DitherKind.SINE,
            frequency_hz=tuple(frequencies.tolist()),
            duration_s=n_frames / rate_hz,
        )
        return wire.DitherStatus(request=request, start_seq=int(self._sequence(n_frames)[0]))

    def _reconstructor(self, n_slopes: int, n_modes: int) -> NDArray[np.float32] | None:
        if not self._has("reconstructor"):
            return None
        n_controlled, _ = self._shape("reconstructor", (None, n_slopes))
        if n_controlled > n_modes:
            raise self._refusal("reconstructor", f"{n_controlled} rows", f"at most {n_modes}")
        values = np.asarray(self.found["reconstructor"][()], float)
        self._check_each("reconstructor", values, np.abs(values) <= MAX_NUMBER, _FINITE)
        return np.ascontiguousarray(values, "<f4")

    def _sequence(self, n_frames: int) -> NDArray[np.int64]:
        """Return the number of every frame, as integers: doubles end at 2^53."""
        if not self._has("seq"):
            return np.arange(n_frames, dtype=np.int64)
        array = self.found["seq"]
        if array.shape != (n_frames,) or array.dtype.kind not in "iuf":
            found = f"{array.dtype} of shape {array.shape}"
            raise self._refusal("seq", found, f"whole numbers ({n_frames},)")
        given = np.asarray(array[()])
        # A double beyond 2^53 cannot hold every whole number: neighbours would be equal.
        limit = _MOST_EXACT if given.dtype.kind == "f" else _MOST_SEQ
        expected = f"whole numbers from 0 to {limit}"
        if given.dtype.kind == "f" and len(given) and np.nanmax(given) > limit:
            expected += ", or larger ones as integers"
        fits = (given >= 0) & (given <= limit)
        # Checked before the conversion to integers, which would cut fractions off.
        if given.dtype.kind == "f":
            fits &= given == np.round(given)
        self._check_each("seq", given, fits, expected)
        seq = given.astype(np.int64)
        falls = np.flatnonzero(np.diff(seq) <= 0)
        if len(falls):
            k = int(falls[0])
            found = f"{seq[k + 1]} in row {k + 1} after {seq[k]}"
            raise self._refusal("seq", found, "numbers that only rise")
        return seq

    # --- what is in the file

    def _has(self, name: str) -> bool:
        return name in self.found

    def _shape(self, name: str, expected: tuple[int | None, int | None]) -> tuple[int, int]:
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in expected) + ")"
        if not self._has(name):
            there = ", ".join(sorted(self.found)) or "nothing"
            raise self._refusal(name, f"no such array among {there}", f"one of shape {wanted}")
        array = self.found[name]
        fits = len(array.shape) == 2 and all(
            n > 0 and want in {None, n} for n, want in zip(array.shape, expected, strict=True)
        )
        if not fits or array.dtype.kind not in "iuf":
            raise self._refusal(name, f"{array.dtype} of shape {array.shape}", f"numbers {wanted}")
        return array.shape[0], array.shape[1]

    def _values(self, name: str, n_dimensions: int) -> Array:
        if not self._has(name):
            raise self._refusal(name, "no such array", "one")
        array = self.found[name]
        values = array[()] if array.dtype.kind in "iuf" else None
        values = None if values is None else np.atleast_1d(np.asarray(values, float))
        if values is None or values.ndim != n_dimensions:
            raise self._refusal(name, f"{array.dtype} of shape {array.shape}", "finite numbers")
        self._check_each(name, values, np.isfinite(values), "finite numbers")
        return values

    def _check_each(
        self, name: str, values: NDArray[Any], fits: NDArray[np.bool_], expected: str
    ) -> None:
        """Refuse values of which one does not fit, with its place.

        Raises
        ------
        ConfigurationError
            Naming the first.
        """
        if not fits.all():
            place = tuple(np.argwhere(~fits)[0].tolist())
            # All digits of a double, because neighbours of 2^53 differ in the last one.
            shown = f"{values[place]:.17g}" if values.dtype.kind == "f" else str(values[place])
            where = ", ".join(
                f"{axis} {k}" for axis, k in zip(("row", "column"), place, strict=False)
            )
            raise self._refusal(name, f"{shown} in {where}", expected)

    def _number(self, name: str, default: float | None, limit: float) -> float:
        given = self.found.get(name, default)
        if given is None:
            raise self._refusal(name, "no such number", "it as an attribute or an array of one")
        try:
            value = float(np.asarray(given[()] if hasattr(given, "shape") else given).item())
        except (TypeError, ValueError) as error:
            raise self._refusal(name, str(given), "one number") from error
        if not 0.0 <= value <= limit:
            raise self._refusal(name, f"{value:g}", f"a number from 0 to {limit:g}")
        return value

    def _refusal(self, name: str, found: str, expected: str) -> ConfigurationError:
        return ConfigurationError(f"{self.path}: {name}: found {found}, expected {expected}")


def _matrix_message(matrix: NDArray[np.float32], status: wire.Status) -> Message:
    identity = Identity(system=SESSION, basis_id=status.basis_id, config_id=status.config_id)
    manifest = Reconstructor.own(MATRIX_ID, matrix, identity, created_ns=status.t_ns).manifest
    return Message(0.0, RecordedKind.MATRIX, matrix.tobytes(), wire.encode(manifest))


def _status_message(status: wire.Status, seq: int, since: int) -> Message:
    """Return the status of a frame, ``since`` frames after the first."""
    seconds = since / status.frame_rate_hz
    later_status = replace(status, seq=seq, t_ns=status.t_ns + round(seconds * SECOND_NS))
    return Message(seconds, RecordedKind.STATUS, wire.encode(later_status))


def _runs(usable: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Return first and end of runs of usable rows."""
    # With False at both ends every run has a start and an end.
    edges = np.flatnonzero(np.diff(usable, prepend=False, append=False)).tolist()
    return zip(edges[::2], edges[1::2], strict=True)


def _batches(seq: NDArray[np.int64], n_at_once: int) -> Iterator[tuple[int, int]]:
    """Yield first and end of runs of frames without a gap, of at most so many."""
    edges = [0, *(np.flatnonzero(np.diff(seq) > 1) + 1).tolist(), len(seq)]
    for run, end in pairwise(edges):
        for first in range(run, end, n_at_once):
            yield first, min(first + n_at_once, end)
