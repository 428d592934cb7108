"""Telemetry and α of an AOT file, as arrays that ``pyrcal track`` plays.

What ``pyrcal archive aot`` wrote comes back: signals, commands, reconstructor and frame numbers bit
for bit; times are doubles of seconds there, 2.4e-7 s apart. Its signals are in the axes of
conventions.md; those of any other file are as its instrument lists them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.importers.aot import places_of, read_system, registrations_between
from pyrcal.importers.registration import SECOND_NS, Aot, Dated
from pyrcal.maintenance.aot import is_own
from service.errors import MatrixError
from service.model.instrument import Instrument, Mirror
from service.model.pupil import rtc_valid_subapertures, valid_subapertures
from service.model.slopes import to_rtc

Array = NDArray[Any]

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
