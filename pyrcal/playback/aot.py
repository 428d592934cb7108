"""Telemetry and α of an AOT file, as arrays that ``pyrcal track`` plays.

What ``pyrcal archive aot`` wrote comes back: signals, commands, reconstructor and frame numbers bit
for bit; times are doubles of seconds there, 2.4e-7 s apart.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pyrcal.offline.importers.aot import places_of, read_system, registrations_between
from pyrcal.offline.importers.registration import SECOND_NS, Dated
from service.errors import MatrixError
from service.model.instrument import Instrument
from service.model.pupil import rtc_valid_subapertures, valid_subapertures
from service.model.slopes import to_rtc

Array = NDArray[Any]

UNITS_M = {None: 1.0, "": 1.0, "m": 1.0, "um": 1e-6, "nm": 1e-9}
"""Metres of OPD in a unit of modal commands; without one they are metres."""


class AotTelemetry(NamedTuple):
    """What an AOT file holds of a night."""

    arrays: dict[str, Array]
    """As ``pyrcal.playback.arrays`` names them, in the RTC's order; empty: no frames."""

    registrations: tuple[Dated, ...]
    """The file's own α over time; empty: it says none."""

    left_out: tuple[str, ...]
    """Loops that are not in the arrays: the one with the most frames is."""


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
    if len(system.wavefront_sensors) != 1 or len(system.wavefront_correctors) != 1:
        raise MatrixError(
            f"{path}: found {len(system.wavefront_sensors)} sensors and "
            f"{len(system.wavefront_correctors)} mirrors, expected one of each"
        )
    (sensor,), (mirror,) = system.wavefront_sensors, system.wavefront_correctors
    told = registrations_between(mirror, sensor, instrument.subaperture_m, str(path))
    loops = [loop for loop in system.loops if getattr(loop, "modal_coefficients", None)]
    arrays: dict[str, Array] = {}
    left_out: tuple[str, ...] = ()
    if loops and sensor.measurements is not None:
        loops.sort(key=lambda loop: -len(loop.modal_coefficients.data))
        arrays = _arrays(loops[0], sensor, instrument, path)
        left_out = tuple(loop.uid for loop in loops[1:])
    return AotTelemetry(arrays, () if told is None else told.over_time, left_out)


def _arrays(loop: Any, sensor: Any, instrument: Instrument, path: Path) -> dict[str, Array]:  # noqa: ANN401
    """Return the frames of a loop; slopes are those that its commands are of."""
    image, commands = sensor.measurements, loop.modal_coefficients
    if image.unit not in {None, ""}:
        raise MatrixError(
            f"{path}: measurements: found the unit {image.unit}, expected slopes without one"
        )
    listed = _listed(sensor, instrument, path)
    slopes = _as_rtc(np.asarray(image.data), listed, instrument, path)
    every, seqs = _frames(image, path), _frames(commands, path)
    t_ns = [round(float(stamp) * SECOND_NS) for stamp in commands.time.timestamps]
    places = {seq: k for k, seq in enumerate(every)}
    if alone := [seq for seq in seqs if seq not in places]:
        raise MatrixError(
            f"{path}: loop {loop.uid}: found a command of frame {alone[0]}, which has no slopes"
        )
    if not loop.framerate:
        raise MatrixError(f"{path}: loop {loop.uid}: found no framerate, expected frames a second")
    arrays = {
        "slopes": slopes[[places[seq] for seq in seqs]],
        "commands_m": _in_metres(commands, path),
        "seq": np.array(seqs, np.int64),
        "frame_rate_hz": np.array(float(loop.framerate)),
        "t0_ns_utc": np.array(float(t_ns[0])),
    }
    if loop.delay is not None:
        arrays["delay_frames"] = np.array(float(loop.delay))
    if loop.measurements_to_modes is not None:
        control = _in_metres(loop.measurements_to_modes, path)
        arrays["reconstructor"] = _as_rtc(control, listed, instrument, path)
    return arrays


def _listed(sensor: Any, instrument: Instrument, path: Path) -> Array:  # noqa: ANN401
    """Return where the file lists each of the instrument's subapertures, row by row."""
    if sensor.subaperture_mask is None:
        raise MatrixError(f"{path}: found no subaperture_mask, expected one")
    valid, places = valid_subapertures(instrument), np.asarray(sensor.subaperture_mask.data)
    if places.shape != valid.shape or not np.array_equal(places >= 0, valid):
        raise MatrixError(
            f"{path}: subaperture_mask: found {int((places >= 0).sum())} valid subapertures in "
            f"{places.shape}, expected the {int(valid.sum())} in {valid.shape} of {instrument.name}"
        )
    return places_of(places, str(path))


def _as_rtc(values: Array, listed: Array, instrument: Instrument, path: Path) -> Array:
    """Return signals ``(n, 2, n_valid)``, pixels 4, as the RTC lists them: ``(n, n_slopes)``."""
    recipe, mask = instrument.slopes, rtc_valid_subapertures(instrument)
    planes = recipe.kind.n_planes
    if values.ndim != 3 or values.shape[1:] != (planes, len(listed)):
        raise MatrixError(
            f"{path}: found signals of shape {values.shape}, expected (n, {planes}, {len(listed)})"
        )
    ours = values[..., listed].reshape(len(values), -1)
    return np.ascontiguousarray(to_rtc(ours.T, recipe, mask).T)


def _in_metres(image: Any, path: Path) -> Array:  # noqa: ANN401
    if image.unit not in UNITS_M:
        raise MatrixError(
            f"{path}: {image.name}: found the unit {image.unit}, expected one of m, um, nm"
        )
    values, unit_m = np.asarray(image.data), UNITS_M[image.unit]
    return values if unit_m == 1.0 else values * unit_m


def _frames(image: Any, path: Path) -> list[int]:  # noqa: ANN401
    """Return the numbers of the frames that an image is of."""
    time = image.time
    numbers = [] if time is None else [int(number) for number in time.frame_numbers]
    if len(numbers) != len(image.data) or len(time.timestamps) != len(numbers):
        raise MatrixError(
            f"{path}: {image.name}: found {len(numbers)} frame numbers of {len(image.data)} "
            "frames, expected one each, and a time"
        )
    return numbers
