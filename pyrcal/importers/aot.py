"""AOT files: import a loop, read the telemetry of a night, write telemetry, matrices and α.

The standard is Gomes et al. 2024 (doi:10.1051/0004-6361/202348486); ``aotpy``, the extra ``aot``,
reads and writes it. AOT has no unit of commands, so strokes of an imported matrix are unknown.
Telemetry that ``pyrcal archive aot`` wrote comes back: signals, commands, reconstructor and frame
numbers bit for bit; times are doubles of seconds there, 2.4e-7 s apart. Its signals are in the axes
of conventions.md; those of any other file are as its instrument lists them.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pyrcal.importers.files import Reported, from_arrays
from pyrcal.importers.imported import Array, Imported
from pyrcal.importers.registration import (
    SECOND_NS,
    Aot,
    Dated,
    Registrations,
    affine,
    registrations_of,
)
from service.errors import ConfigurationError, MatrixError, WireError
from service.files.container import opened
from service.files.recording import RecordedKind, Recording
from service.model.instrument import Instrument, Mirror
from service.model.pupil import rtc_valid_subapertures, valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.slopes import to_conventions, to_rtc
from service.wire import FrameBatch, Manifest, Status, decode, decode_frames

SENSORS = {"Pyramid": "pyramid", "ShackHartmann": "shack-hartmann"}
"""Kinds of sensors by AOT's class names."""

_HEADER_BYTES = 20 * 2880
"""Number of leading bytes that must contain the version."""


def import_aotpy() -> Aot:
    """Return the module of the standard.

    Raises
    ------
    ConfigurationError
        If it is not installed.
    """
    try:
        import aotpy
    except ImportError as error:
        raise ConfigurationError(
            "AOT files need aotpy, which is not installed: pip install 'pyrcal[aot]'"
        ) from error
    return aotpy


def read_system(path: Path) -> Aot:
    """Return aotpy's system of a file.

    Raises
    ------
    ConfigurationError
        If ``aotpy`` is not installed.
    MatrixError
        If it is no AOT file.
    """
    aotpy = import_aotpy()
    _check(path)
    try:
        with warnings.catch_warnings():
            # aotpy warns of whatever a file leaves empty.
            warnings.simplefilter("ignore")
            system = aotpy.AOSystem.read_from_file(path)
    # aotpy does not export the class of its errors.
    except Exception as error:
        raise MatrixError(f"{path}: found {error}, expected an AOT file") from error
    for part in (*system.wavefront_sensors, *system.wavefront_correctors, *system.loops):
        for name, value in vars(part).items():
            if isinstance(value, aotpy.Image) and value.data is None:
                # An image without data says as little as none.
                setattr(part, name, None)
    return system


def _check(path: Path) -> None:
    """Raise if a file is not an AOT file.

    aotpy's own message suggests unusable options, and it reads the parts of some damaged files
    without end.
    """
    try:
        with path.open("rb") as file:
            begins = file.read(_HEADER_BYTES)
    except OSError as error:
        raise MatrixError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not begins.startswith(b"SIMPLE"):
        raise MatrixError(f"{path}: found no FITS, expected an AOT file")
    if b"AOT-VERS" not in begins:
        raise MatrixError(f"{path}: found FITS without AOT-VERS, expected an AOT file")
    # Opening refuses a damaged file.
    with opened(path):
        pass


def from_aot(
    path: Path, reported: Reported, loop: str | None = None, positions: Array | None = None
) -> Imported:
    """Return the telescope, the sensor, the mirror and the matrix of one loop of an AOT file.

    Parameters
    ----------
    path
        The file.
    reported
        What it does not say.
    loop
        Number of the loop, from 1, or its uid; None if only one has an interaction matrix.
    positions
        ``(n_actuators, 2)`` of a mirror without coordinates and influence functions, metres.

    Raises
    ------
    ConfigurationError
        If ``aotpy`` is not installed.
    MatrixError
        If the file cannot be read, or has no such loop with an interaction matrix.
    """
    system = read_system(path)
    chosen = _choose_loop(path, system, loop)
    sensor, mirror = chosen.input_sensor, chosen.commanded_corrector
    kind = SENSORS.get(type(sensor).__name__)
    if kind is None or sensor.subaperture_mask is None:
        raise MatrixError(
            f"{path}: loop {chosen.uid}: found a {type(sensor).__name__}, expected "
            f"{' or '.join(SENSORS)} with its subaperture_mask"
        )
    places = np.asarray(sensor.subaperture_mask.data)
    matrix = _by_rows(chosen.interaction_matrix.data, places, str(path))
    notes: list[str] = []
    arrays = {
        "matrix": matrix,
        "valid": places >= 0,
        **_mirror(mirror, chosen, matrix.shape[1], notes),
    }
    if positions is not None:
        arrays["positions"] = positions
        arrays.pop("modes", None)
    elif "modes" not in arrays and "positions" not in arrays:
        raise MatrixError(
            f"{path}: found no coordinates and no influence functions of the mirror {mirror.uid}, "
            f"which has {mirror.n_valid_actuators} actuators; give --positions FILE, x and y in "
            "metres"
        )
    # What the file says is preferred to what was given: it cannot be mistyped.
    telescope = system.main_telescope
    diameter_m = telescope.enclosing_diameter or reported.diameter_m
    dated = registrations_between(mirror, sensor, diameter_m / max(places.shape), str(path))
    imported = from_arrays(
        f"AOT, {path}",
        arrays,
        replace(
            reported,
            sensor=kind,
            diameter_m=diameter_m,
            obscuration_ratio=(telescope.obstruction_diameter or 0.0) / diameter_m
            or reported.obscuration_ratio,
            wavelength_m=sensor.wavelength or reported.wavelength_m,
        ),
    ).with_notes(*notes)
    if dated is None:
        return imported
    return replace(
        imported,
        tables={**imported.tables, "mirror": {**imported.tables["mirror"], **dated.mirror}},
        arrays={**imported.arrays, **dated.arrays},
    ).with_notes(dated.text)


def _choose_loop(path: Path, system: Aot, wanted: str | None) -> Aot:
    """Return the requested loop, or the only one with an interaction matrix."""
    loops = list(enumerate(system.loops, start=1))
    listed = "; ".join(f"{k} {one.uid} ({_describe_loop(one)})" for k, one in loops) or "none"
    if wanted is not None:
        # The first one only: the uid of one loop may be the number of another.
        loops = [(k, one) for k, one in loops if wanted in {str(k), one.uid}][:1]
        if not loops:
            raise MatrixError(f"{path}: --loop: found {wanted}, expected one of {listed}")
    measured = [one for _, one in loops if getattr(one, "interaction_matrix", None) is not None]
    if len(measured) != 1:
        what = f"{len(measured)} loops" if measured else "no loop"
        raise MatrixError(
            f"{path}: found {what} with an interaction matrix, expected one: choose with --loop: "
            f"{listed}"
        )
    return measured[0]


def _describe_loop(loop: Aot) -> str:
    """Return the contents of a loop as text."""
    matrix = getattr(loop, "interaction_matrix", None)
    sensor = loop.input_sensor
    about = "no interaction matrix" if matrix is None else f"matrix {np.shape(matrix.data)}"
    return f"{type(sensor).__name__} {sensor.uid}, {about}"


def registrations_between(
    mirror: Aot, sensor: Aot, subaperture_m: float, where: str
) -> Registrations | None:
    """Return α of a mirror on a sensor over time; None if the file has none.

    Raises
    ------
    MatrixError
        If it cannot be read, or the sensor is moved as well.
    """
    if mirror.transformation_matrix is None:
        return None
    # α is the mirror on the sensor: a sensor that is moved as well would be counted twice.
    own = sensor.transformation_matrix
    if own is not None and not np.allclose(
        np.moveaxis(np.reshape(own.data, (3, 3, -1)), -1, 0), np.eye(3), rtol=0.0, atol=1e-6
    ):
        raise MatrixError(
            f"{where}: found a transformation_matrix of the sensor, too; expected the mirror's "
            "alone, from its coordinates to the sensor"
        )
    return registrations_of(mirror.transformation_matrix, subaperture_m, where)


def _mirror(mirror: Aot, loop: Aot, n_columns: int, notes: list[str]) -> dict[str, Array]:
    found: dict[str, Array] = {}
    if mirror.influence_function is not None:
        found["modes"] = np.asarray(mirror.influence_function.data)
    elif mirror.actuator_coordinates:
        found["positions"] = np.array([[at.x, at.y] for at in mirror.actuator_coordinates])
    if loop.modes_to_commands is not None:
        strokes = np.asarray(loop.modes_to_commands.data)
        # The standard defines the matrix for actuators; some files have one for modes.
        if strokes.ndim == 2 and n_columns == len(strokes) != strokes.shape[1]:
            notes.append("the matrix is of actuators, as the standard has it: modes are left out")
        else:
            found["mode_to_actuator"] = strokes
    return found


def _by_rows(values: Aot, places: Array, where: str) -> Array:
    """Return AOT's matrix in two dimensions, all x first, subapertures row by row.

    The standard defines ``(n_valid, 2, n)``; ``(2, n_valid, n)`` and two-dimensional ones are
    accepted, too. The mask gives the order of the subapertures.
    """
    listed = places_of(places, where)
    n_valid = len(listed)
    matrix = np.asarray(values)
    if matrix.ndim == 3 and matrix.shape[:2] == (n_valid, 2):
        matrix = np.moveaxis(matrix, 1, 0)
    elif matrix.ndim == 2 and len(matrix) == 2 * n_valid:
        matrix = matrix.reshape(2, n_valid, -1)
    if matrix.ndim != 3 or matrix.shape[:2] != (2, n_valid):
        raise MatrixError(
            f"{where}: interaction_matrix: found shape {matrix.shape}, expected ({n_valid}, 2, n)"
        )
    return matrix[:, listed].reshape(2 * n_valid, -1)


def places_of(places: Array, where: str) -> Array:
    """Return the position of each valid subaperture in AOT's list, row by row.

    Raises
    ------
    MatrixError
        If they are not each of 0 to ``n_valid - 1`` once.
    """
    # In the order of the mask's rows, which is that of pyrcal's slopes.
    listed = places[places >= 0].ravel()
    n_valid = len(listed)
    if n_valid and listed.min() == 1:
        # Some writers count from 1.
        listed = listed - 1
    if places.ndim != 2 or not np.array_equal(np.sort(listed), np.arange(n_valid)):
        raise MatrixError(
            f"{where}: subaperture_mask: expected -1 or the place of each valid subaperture, 0 to "
            f"{n_valid - 1}, once"
        )
    return listed.astype(int)


# --- telemetry of a night, as arrays that ``pyrcal track`` plays


UNITS_M = {None: 1.0, "": 1.0, "m": 1.0, "um": 1e-6, "nm": 1e-9}
"""Metres of OPD in a unit of modal commands; without one they are metres."""

MAX_TIME_OFFSET = 0.25
"""Largest deviation of a time from the frame rate, frames."""

MAX_UNMODELLED_SHARE = 1e-2
"""Largest RMS share of the actuator commands outside the modes' span; with a larger one, modes do
not represent the commands."""


@dataclass(kw_only=True, slots=True)
class AotTelemetry:
    """Contents of an AOT file of a night."""

    registrations: tuple[Dated, ...]
    """α over time from the file itself; empty if it has none."""

    arrays: dict[str, Array] = field(default_factory=dict)
    """Arrays by the names of ``pyrcal.playback.arrays``, in the RTC's order; empty without frames.
    """

    notes: list[str] = field(default_factory=list)
    """Notes on assumptions and on data that are not played, one sentence each."""


def read_telemetry(path: Path, instrument: Instrument) -> AotTelemetry:
    """Return the frames of the loop that has most of them, and α over time.

    Raises
    ------
    ConfigurationError
        If ``aotpy`` is not installed.
    MatrixError
        If it is no AOT file, or not of this instrument: what was found and expected.
    """
    system = read_system(path)
    sensors = [one for one in system.wavefront_sensors if _belongs_to(one, instrument)]
    if not sensors:
        listed = ", ".join(
            f"{one.uid} ({type(one).__name__}, {_n_valid(one)} subapertures)"
            for one in system.wavefront_sensors
        )
        expected = int(rtc_valid_subapertures(instrument).sum())
        raise MatrixError(
            f"{path}: found the sensors {listed or 'none'}, expected one whose mask is "
            f"that of {instrument.name}: {expected} valid subapertures"
        )
    playable = [
        one
        for one in system.loops
        if any(one.input_sensor is sensor for sensor in sensors)
        and one.input_sensor.measurements is not None
        and _commands(one) is not None
    ]
    # pyrcal writes a loop for each reconstructor in use: the one in use longest has most frames.
    loop = max(playable, key=lambda one: len(_commands(one).data), default=None)
    sensor = sensors[0] if loop is None else loop.input_sensor
    mirror = _only_mirror(path, system) if loop is None else loop.commanded_corrector
    dated = registrations_between(mirror, sensor, instrument.subaperture_m, str(path))
    night = AotTelemetry(registrations=() if dated is None else dated.over_time)
    if len(system.wavefront_sensors) > 1:
        night.notes.append(
            f"of {len(system.wavefront_sensors)} sensors {sensor.uid} is taken, whose mask is the "
            "instrument's"
        )
    if loop is not None:
        reader = _Reader(path=path, instrument=instrument, notes=night.notes)
        night.arrays = reader.arrays(loop, sensor)
        if rest := [one.uid for one in system.loops if one is not loop]:
            night.notes.append(f"one loop is played; left out: {', '.join(rest)}")
    return night


def _n_valid(sensor: Aot) -> int:
    """Return how many subapertures the mask of a sensor lists; 0 without a mask."""
    mask = getattr(sensor, "subaperture_mask", None)
    return 0 if mask is None else int((np.asarray(mask.data) >= 0).sum())


def _belongs_to(sensor: Aot, instrument: Instrument) -> bool:
    """Return True if a sensor may be the instrument's; one without a mask is rejected later."""
    mask = getattr(sensor, "subaperture_mask", None)
    if mask is None:
        return True
    places = np.asarray(mask.data) >= 0
    masks = valid_subapertures(instrument), rtc_valid_subapertures(instrument)
    return any(places.shape == one.shape and np.array_equal(places, one) for one in masks)


def _only_mirror(path: Path, system: Aot) -> Aot:
    if len(system.wavefront_correctors) != 1:
        raise MatrixError(
            f"{path}: found {len(system.wavefront_correctors)} mirrors and no loop with commands, "
            "expected one of either"
        )
    return system.wavefront_correctors[0]


def _commands(loop: Aot) -> Aot:
    """Return the image of a loop's commands, modal if available; None if it has none."""
    modal = getattr(loop, "modal_coefficients", None)
    return loop.commands if modal is None else modal


@dataclass(frozen=True, kw_only=True, slots=True)
class _Reader:
    path: Path
    instrument: Instrument
    notes: list[str]

    def arrays(self, loop: Aot, sensor: Aot) -> dict[str, Array]:
        """Return the frames of a loop; slopes are those that its commands are of."""
        image, commands = sensor.measurements, _commands(loop)
        # pyrcal's slopes have no unit: those in pixels or radians have another scale.
        if image.unit not in {None, ""}:
            raise self._refusal(
                f"measurements: found the unit {image.unit}, expected slopes without one"
            )
        if not loop.framerate:
            raise self._refusal(f"loop {loop.uid}: found no framerate, expected frames a second")
        # Files of pyrcal are in the axes of conventions.md, all others in the RTC's.
        own = is_own(image)
        listed = self._list_positions(sensor, own=own)
        slopes = self._order_as_rtc(np.asarray(image.data), listed, own=own)
        every, seqs = self._frames(image, commands, float(loop.framerate))
        places = {seq: k for k, seq in enumerate(every)}
        if alone := [seq for seq in seqs if seq not in places]:
            raise self._refusal(
                f"loop {loop.uid}: found a command of frame {alone[0]}, which has no slopes"
            )
        stamps = _stamps(commands)
        if not np.all(np.isfinite(stamps)):
            raise self._refusal(f"loop {loop.uid}: found times that are not finite numbers")
        arrays = {
            "slopes": slopes[[places[seq] for seq in seqs]],
            "commands_m": self._compute_modal_commands(loop),
            "seq": np.array(seqs, np.int64),
            "frame_rate_hz": np.array(float(loop.framerate)),
            "t0_ns_utc": np.array(float(round(stamps[0] * SECOND_NS)) if stamps else 0.0),
            **self._filter(loop),
        }
        if loop.delay is not None:
            arrays["delay_frames"] = np.array(float(loop.delay))
        if loop.measurements_to_modes is not None:
            control = self._convert_to_metres(loop.measurements_to_modes)
            arrays["reconstructor"] = self._order_as_rtc(control, listed, own=own)
        return arrays

    # --- signals

    def _list_positions(self, sensor: Aot, *, own: bool) -> Array:
        """Return the position of each of the instrument's subapertures in the file, row by row."""
        if sensor.subaperture_mask is None:
            raise self._refusal("found no subaperture_mask, expected one")
        valid = (valid_subapertures if own else rtc_valid_subapertures)(self.instrument)
        places = np.asarray(sensor.subaperture_mask.data)
        if places.shape != valid.shape or not np.array_equal(places >= 0, valid):
            raise self._refusal(
                f"subaperture_mask: found {int((places >= 0).sum())} valid subapertures in "
                f"{places.shape}, expected the {int(valid.sum())} in {valid.shape} of "
                f"{self.instrument.name}"
            )
        return places_of(places, str(self.path))

    def _order_as_rtc(self, values: Array, listed: Array, *, own: bool) -> Array:
        """Return signals ``(n, 2, n_valid)``, pixels 4, as the RTC lists them: ``(n, n_slopes)``.

        A file that pyrcal has not written has the RTC's axes and signs, as ``pyrcal import aot``
        takes them.
        """
        recipe = self.instrument.slopes
        planes = recipe.kind.n_planes
        if values.ndim != 3 or values.shape[1:] != (planes, len(listed)):
            raise self._refusal(
                f"found signals of shape {values.shape}, expected (n, {planes}, {len(listed)})"
            )
        by_row = np.ascontiguousarray(
            values[..., listed].reshape(len(values), planes * len(listed))
        )
        if not own:
            return by_row
        return np.ascontiguousarray(
            to_rtc(by_row.T, recipe, rtc_valid_subapertures(self.instrument)).T
        )

    # --- frames

    def _frames(self, image: Aot, commands: Aot, rate_hz: float) -> tuple[list[int], list[int]]:
        """Return the numbers of the frames of signals and commands."""
        n_numbers = [len(_numbers(one)) for one in (image, commands)]
        if n_numbers == [len(image.data), len(commands.data)]:
            return _numbers(image), _numbers(commands)
        stamps = [_stamps(one) for one in (image, commands)]
        if [len(one) for one in stamps] == [len(image.data), len(commands.data)]:
            self.notes.append("frames have no numbers: counted by their times")
            first = min(stamps[0][0], stamps[1][0])
            every, seqs = (self._number_frames(one, first, rate_hz) for one in stamps)
            return every, seqs
        if any(n_numbers) or any(stamps) or len(image.data) != len(commands.data):
            raise self._refusal(
                f"found {n_numbers[0]} frame numbers and {len(stamps[0])} times of "
                f"{len(image.data)} measurements, {n_numbers[1]} and {len(stamps[1])} of "
                f"{len(commands.data)} commands, expected one of either each"
            )
        self.notes.append("frames have neither numbers nor times: taken as all there are, in order")
        return list(range(len(image.data))), list(range(len(image.data)))

    def _number_frames(self, stamps: list[float], first: float, rate_hz: float) -> list[int]:
        beats = (np.array(stamps) - first) * rate_hz
        numbers = np.round(beats)
        off = float(np.max(np.abs(beats - numbers)))
        # Written with not, so that NaN is refused too.
        if not off <= MAX_TIME_OFFSET or np.any(np.diff(numbers) <= 0):
            raise self._refusal(
                f"found times that are {off:.2g} of a frame off the loop's {rate_hz:g} Hz, or "
                f"twice in one, expected at most {MAX_TIME_OFFSET:g}; give frame_numbers"
            )
        return [int(number) for number in numbers]

    # --- commands

    def _compute_modal_commands(self, loop: Aot) -> Array:
        """Return the commands ``(n, n_modes)`` of the instrument's modes, metres."""
        if loop.modal_coefficients is not None:
            return self._convert_to_metres(loop.modal_coefficients)
        strokes_m = self._convert_to_metres(loop.commands)
        if loop.ref_commands is not None:
            strokes_m = strokes_m - self._convert_to_metres(loop.ref_commands).ravel()
        mirror = self.instrument.mirror
        to_actuators = mirror.mode_to_actuator if isinstance(mirror, Mirror) else None
        if to_actuators is None or strokes_m.shape[1:] != to_actuators.shape[:1]:
            found = f"commands of {strokes_m.shape[1:]} actuators"
            raise self._refusal(
                f"found {found} and no modal_coefficients, expected modal_coefficients, or an "
                "instrument file with the mode_to_actuator of these actuators"
            )
        # By least squares, and checked: commands outside the modes' span would be lost silently.
        modal = strokes_m @ np.linalg.pinv(to_actuators).T
        left = np.linalg.norm(strokes_m - modal @ to_actuators.T) / np.linalg.norm(strokes_m)
        if not left <= MAX_UNMODELLED_SHARE:
            raise self._refusal(
                f"commands: found {left:.0%} of them that no mode of mode_to_actuator makes, "
                f"expected at most {MAX_UNMODELLED_SHARE:.0%}: other actuators, or another order"
            )
        self.notes.append("commands of actuators: turned into modes by mode_to_actuator")
        return np.asarray(modal)

    def _filter(self, loop: Aot) -> dict[str, Array]:
        """Return gains and leak, where the loop's time filter is an integrator."""
        if loop.time_filter_num is None or loop.time_filter_den is None:
            return {}
        above, below = (
            np.atleast_2d(np.asarray(one.data, np.float64))
            for one in (loop.time_filter_num, loop.time_filter_den)
        )
        leaks = -below[:, 1] if below.shape[1] > 1 else np.zeros(1)
        simple = not above[:, 1:].any() and not below[:, 2:].any() and np.all(below[:, 0] == 1.0)
        if simple and np.ptp(leaks) == 0.0 and 0.0 < leaks[0] <= 1.0:
            return {"gains": above[:, 0], "leak": np.array(leaks[0])}
        self.notes.append("the time filter is no integrator with one leak: gains are taken as 0.5")
        return {}

    def _convert_to_metres(self, image: Aot) -> Array:
        if image.unit not in UNITS_M:
            raise self._refusal(
                f"{image.name}: found the unit {image.unit}, expected one of m, um, nm"
            )
        values, unit_m = np.asarray(image.data), UNITS_M[image.unit]
        return values if unit_m == 1.0 else values * unit_m

    def _refusal(self, what: str) -> MatrixError:
        return MatrixError(f"{self.path}: {what}")


def _numbers(image: Aot) -> list[int]:
    """Return the numbers of the frames that an image is of, -1 where one is missing.

    Empty if it has none.
    """
    given = [] if image.time is None else image.time.frame_numbers
    return [-1 if number is None else int(number) for number in given]


def _stamps(image: Aot) -> list[float]:
    """Return the times of an image in seconds, NaN if one is missing; empty if it has none."""
    given = [] if image.time is None else image.time.timestamps
    return [math.nan if stamp is None else float(stamp) for stamp in given]


# --- export


FRAMES = "frames"
"""Name of the time of all measurements, by which files written by pyrcal are recognised."""


@dataclass(slots=True, kw_only=True)
class Excerpt:
    """Some seconds of a recording."""

    batches: list[FrameBatch] = field(default_factory=list)
    status: Status | None = None
    """Last status of the excerpt, or before it; None if there is none."""

    matrices: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    """Reconstructors ``(n_modes, n_slopes)`` in the RTC's order, by id."""

    n_damaged: int = 0
    """Number of messages that break the contract and are left out."""

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return sum(batch.header.n for batch in self.batches)

    @property
    def first_ns_utc(self) -> int:
        """End of the first frame, by the RTC's clock."""
        return self.batches[0].header.t0_ns

    @property
    def last_ns_utc(self) -> int:
        """End of the last frame."""
        header = self.batches[-1].header
        return header.t0_ns + (header.n - 1) * header.dt_ns


def excerpt(path: Path, first_s: float, seconds: float) -> Excerpt:
    """Return some seconds of a recording.

    Parameters
    ----------
    path
        As ``service.files.recording`` has it.
    first_s
        Seconds since its beginning.
    seconds
        How much of it.

    Raises
    ------
    ConfigurationError
        If it cannot be read, or has no frames of this time.
    """
    found = Excerpt()
    with Recording(path) as recording:
        for message in recording.messages():
            if message.time_s > first_s + seconds:
                break
            # Status and matrices from before the excerpt are kept: they hold during it.
            try:
                if message.kind is RecordedKind.STATUS:
                    found.status = decode(Status, message.payload)
                elif message.kind is RecordedKind.MATRIX:
                    manifest = decode(Manifest, message.attachment)
                    numbers = np.frombuffer(message.payload, "<f4")
                    found.matrices[manifest.id] = numbers.reshape(manifest.layout.shape)
                elif message.kind is RecordedKind.FRAMES and message.time_s >= first_s:
                    found.batches.append(decode_frames(message.payload, message.attachment))
            except (WireError, ValueError):
                found.n_damaged += 1
    if not found.batches:
        raise ConfigurationError(
            f"{path}: found no frames from {first_s:g} s on for {seconds:g} s, expected some"
        )
    # Another session counts its frames from 0 again: one loop of the standard cannot hold both.
    session = found.batches[0].header.session
    found.batches = [batch for batch in found.batches if batch.header.session == session]
    return found


def write_aot(
    path: Path, instrument: Instrument, estimates: Iterable[Dated], taken: Excerpt | None
) -> None:
    """Write telemetry and α over time as AOT FITS.

    Slopes are in the order, axes and signs of conventions.md, ``(t, 2, n_valid)``, pixels
    ``(t, 4, n_valid)``; modal commands are metres OPD, ``(t, n_modes)``. Each reconstructor in use
    has a loop of its own. α is the ``transformation_matrix`` ``(3, 3, t)`` of the mirror: from
    metres in the pupil, as its actuators are drawn, to metres on the sensor.

    Parameters
    ----------
    path
        Ends in ``.fits``; must not exist.
    instrument
        Of the telemetry.
    estimates
        α over time, oldest first.
    taken
        Telemetry; None: none.

    Raises
    ------
    ConfigurationError
        If ``aotpy`` is not installed, or the file cannot be written.
    ModelError
        If the telemetry is not of this instrument.
    """
    aotpy = import_aotpy()
    if path.exists():
        raise ConfigurationError(f"{path}: exists already; expected a new file")
    system = _system(aotpy, instrument, tuple(estimates))
    if taken is not None:
        _add_telemetry(aotpy, system, instrument, taken)
    try:
        with warnings.catch_warnings():
            # Missing fields stay empty: without telemetry there is no loop to describe
            warnings.filterwarnings("ignore", message=".*contains no data")
            system.write_to_file(path, "fits")
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be written: {error}") from error


def _system(aotpy: Aot, instrument: Instrument, estimates: tuple[Dated, ...]) -> Aot:
    telescope = aotpy.MainTelescope(
        uid="telescope",
        enclosing_diameter=instrument.diameter_m,
        obstruction_diameter=instrument.obscuration_ratio * instrument.diameter_m,
    )
    source = aotpy.NaturalGuideStar(uid="source")
    valid = valid_subapertures(instrument)
    # The standard's mask lists each subaperture's place among the slopes, -1 where there is none.
    places = np.full(valid.shape, -1, dtype=np.int32)
    places[valid] = np.arange(valid.sum())
    aot_class, own = kind_of(instrument).aot(instrument.slopes)
    sensor = getattr(aotpy, aot_class)(
        **own,
        uid="sensor",
        source=source,
        n_valid_subapertures=int(valid.sum()),
        subaperture_mask=aotpy.Image("subaperture mask", places),
        wavelength=instrument.wfs.wavelength_m,
    )
    corrector = aotpy.DeformableMirror(
        uid="mirror",
        telescope=telescope,
        n_valid_actuators=1,
        transformation_matrix=_over_time(aotpy, instrument, estimates),
    )
    if isinstance(instrument.mirror, Mirror):
        # α acts on positions as they are drawn, with the mirror seen from its front.
        drawn = instrument.mirror.positions_m * [1.0, instrument.mirror.y_sign]
        corrector.n_valid_actuators = len(drawn)
        corrector.actuator_coordinates = [aotpy.Coordinates(x, y) for x, y in drawn.tolist()]
    return aotpy.AOSystem(
        ao_mode="SCAO",
        name=instrument.name,
        main_telescope=telescope,
        sources=[source],
        wavefront_sensors=[sensor],
        wavefront_correctors=[corrector],
    )


def _over_time(aotpy: Aot, instrument: Instrument, estimates: tuple[Dated, ...]) -> Aot:
    """Return α over time; None if there is no estimate."""
    if not estimates:
        return None
    seconds = [at.t_ns_utc / SECOND_NS for at in estimates if at.t_ns_utc is not None]
    matrices = [affine(at.alpha, instrument.subaperture_m) for at in estimates]
    time = aotpy.Time(uid="time of registration", timestamps=seconds) if seconds else None
    return aotpy.Image("registration", np.stack(matrices, axis=-1), time=time)


def _add_telemetry(aotpy: Aot, system: Aot, instrument: Instrument, taken: Excerpt) -> None:
    headers = [batch.header for batch in taken.batches]
    rows = [np.arange(header.n) for header in headers]
    seqs = np.concatenate([h.seq0 + row for h, row in zip(headers, rows, strict=True)])
    t_ns = np.concatenate([h.t0_ns + row * h.dt_ns for h, row in zip(headers, rows, strict=True)])
    ids = np.concatenate([np.full(h.n, h.cm_id or "unknown", dtype=object) for h in headers])
    commands_m = np.concatenate([batch.commands_m for batch in taken.batches])
    slopes = _as_listed(np.concatenate([batch.slopes for batch in taken.batches]), instrument)
    (sensor,), (corrector,) = system.wavefront_sensors, system.wavefront_correctors
    sensor.measurements = aotpy.Image("slopes", slopes, time=_time(aotpy, FRAMES, t_ns, seqs))
    system.date_beginning, system.date_end = (
        datetime.fromtimestamp(int(t) / SECOND_NS, UTC).replace(tzinfo=None)
        for t in (t_ns[0], t_ns[-1])
    )
    status = taken.status
    # A loop has one reconstructor in the standard: frames of another one are another loop.
    for cm_id in dict.fromkeys(ids.tolist()):
        those, matrix = ids == cm_id, taken.matrices.get(cm_id)
        time = _time(aotpy, f"frames of {cm_id}", t_ns[those], seqs[those])
        control = None
        if matrix is not None:
            control = aotpy.Image(f"reconstructor {cm_id}", _as_listed(matrix, instrument), "m")
        system.loops.append(
            aotpy.ControlLoop(
                uid=cm_id,
                input_sensor=sensor,
                commanded_corrector=corrector,
                closed=status is None or status.loop == "closed",
                framerate=SECOND_NS / headers[0].dt_ns,
                delay=None if status is None else status.delay_frames,
                time=time,
                modal_coefficients=aotpy.Image(
                    f"commands {cm_id}", commands_m[those], "m", time=time
                ),
                measurements_to_modes=control,
            )
        )


def is_own(measurements: Aot) -> bool:
    """Return True if measurements in an AOT file were written by pyrcal, in its axes."""
    time = measurements.time
    return time is not None and str(time.uid).casefold() == f"time of {FRAMES}"


def _time(aotpy: Aot, name: str, t_ns: NDArray[np.int64], seqs: NDArray[np.int64]) -> Aot:
    seconds = (t_ns / SECOND_NS).tolist()
    return aotpy.Time(uid=f"time of {name}", timestamps=seconds, frame_numbers=seqs.tolist())


def _as_listed(values: NDArray[np.float32], instrument: Instrument) -> NDArray[np.float32]:
    """Return the RTC's signals ``(n, n_slopes)`` in pyrcal's order: ``(n, 2, n_valid)``, or 4."""
    recipe = instrument.slopes
    mask = rtc_valid_subapertures(instrument)
    ours = to_conventions(values.T, recipe, mask)
    return np.ascontiguousarray(ours.T).reshape(len(values), recipe.kind.n_planes, -1)
