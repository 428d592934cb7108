"""Read a session of pyRTC's recorder as arrays for ``pyrcal track``.

``Telemetry.save([signal, wfc], n)`` of pyRTC 2 writes a folder: ``session.json``, and for each
stream its frames and the frame ids. An id names the exposure that a signal or a command belongs to,
so commands are paired by it. Data that no session contains are read from ``loop.npz`` in the same
folder, by the names of :mod:`pyrcal.playback.arrays`: ``delay_frames``, ``gains``, ``leak``,
``reconstructor``...
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pyrcal.importers.saved import read_npz
from service.errors import ConfigurationError
from service.files.container import NUMPY_DAMAGE
from service.model.instrument import Instrument

Array = NDArray[Any]

MANIFEST: Final = "session.json"
FACTS: Final = "loop.npz"
SLOPES, COMMANDS = "signal", "wfc"
"""Names of pyRTC's streams of slopes and commands; a name may have a prefix."""

DELAY_FRAMES: Final = 2.0


def is_session(path: Path) -> bool:
    """Return True for a folder written by pyRTC's recorder, or its ``session.json``."""
    return _folder(path).joinpath(MANIFEST).is_file()


def read_session(path: Path, instrument: Instrument) -> dict[str, Array]:
    """Return the frames whose commands are known, and the values of ``loop.npz``.

    Raises
    ------
    ConfigurationError
        If it cannot be read, or belongs to another instrument.
    """
    folder = _folder(path)
    streams = _streams(folder)
    slopes, answered = _stream(folder, streams, SLOPES)
    strokes, by = _stream(folder, streams, COMMANDS)
    facts = read_npz(folder / FACTS) if (folder / FACTS).exists() else {}
    delay = np.asarray(facts.get("delay_frames", DELAY_FRAMES))
    if delay.size != 1 or delay.dtype.kind not in "iuf" or not 1.0 <= delay.item() <= 20.0:
        raise ConfigurationError(
            f"{folder / FACTS}: delay_frames: found {delay.tolist()}, expected 1 to 20"
        )
    # pyRTC sends its modes, as M2C has them.
    n_modes = instrument.modes.n_modes
    if strokes.shape[1] > n_modes:
        raise ConfigurationError(
            f"{folder}: {COMMANDS}: found {strokes.shape[1]} numbers a frame, expected at most the "
            f"{n_modes} modes of {instrument.name}"
        )
    sent_m, known = _average_commands(strokes.astype(np.float64), by, answered, float(delay.item()))
    if not known.any():
        raise ConfigurationError(
            f"{folder}: found signals of exposures {answered[0]} to {answered[-1]} and commands "
            f"that answer {by[0]} to {by[-1]}, expected some of the same: save both at once"
        )
    arrays = {"slopes": slopes[known], "commands_m": sent_m[known], "seq": answered[known]}
    if "frame_rate_hz" not in facts:
        arrays["frame_rate_hz"] = np.array(_rate_hz(folder, streams, answered))
    return arrays | facts


def _folder(path: Path) -> Path:
    return path.parent if path.name == MANIFEST else path


def _streams(folder: Path) -> list[Mapping[str, Any]]:
    path = folder / MANIFEST
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["streams"]
        return [{**one, "name": str(one["name"])} for one in found]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(f"{path}: is no session of pyRTC 2: {error!r}") from error


def _find_stream(folder: Path, streams: list[Mapping[str, Any]], kind: str) -> Mapping[str, Any]:
    fitting = [one for one in streams if one["name"] == kind] or [
        one for one in streams if one["name"].endswith(kind)
    ]
    if len(fitting) != 1:
        there = ", ".join(one["name"] for one in streams) or "none"
        raise ConfigurationError(
            f"{folder}: found the streams {there}, expected one of {kind}: save "
            f'["{SLOPES}", "{COMMANDS}"] together'
        )
    return fitting[0]


def _stream(
    folder: Path, streams: list[Mapping[str, Any]], kind: str
) -> tuple[Array, NDArray[np.int64]]:
    """Return the frames of a stream, one per row, and the exposure each belongs to, increasing."""
    record = _find_stream(folder, streams, kind)
    frames = _load_array(folder, record, "frames_file")
    if "frame_ids_file" not in record:
        raise ConfigurationError(
            f"{folder}: {record['name']}: found no frame ids, expected those of pyRTC 2.1: without "
            "them it is unknown which command was on the mirror"
        )
    ids = _load_array(folder, record, "frame_ids_file")
    if frames.ndim < 2 or ids.shape != frames.shape[:1] or frames.dtype.kind != "f":
        raise ConfigurationError(
            f"{folder}: {record['name']}: found {frames.dtype} of shape {frames.shape} with ids of "
            f"shape {ids.shape}, expected numbers (n_frames, ...) with (n_frames,)"
        )
    # The recorder may see a frame twice, or late: each exposure is taken once, in their order.
    ids, first = np.unique(ids.astype(np.int64), return_index=True)
    return np.asarray(frames[first], np.float32).reshape(len(ids), -1), ids


def _load_array(folder: Path, record: Mapping[str, Any], key: str) -> Array:
    # The session may come from another machine: it must not name files outside its folder.
    path = (folder / str(record.get(key))).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise ConfigurationError(f"{folder / MANIFEST}: {key}: found {path}, expected a file in it")
    try:
        return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))
    except NUMPY_DAMAGE as error:
        raise ConfigurationError(f"{path}: cannot be read: {error}") from error


def _average_commands(
    commands_m: Array, answers: NDArray[np.int64], exposures: NDArray[np.int64], delay: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the mean command during each exposure, and the exposures for which it is known.

    The command for exposure n is on the mirror from n + delay on: with a delay of 1.7 frames, .3 of
    an exposure see the command for the previous one, .7 that for the one before it.
    """
    whole = int(np.ceil(delay))
    total = np.zeros((len(exposures), commands_m.shape[1]))
    known = np.ones(len(exposures), bool)
    for behind, share in ((whole - 1, whole - delay), (whole, 1.0 - (whole - delay))):
        # With a whole number of frames no exposure sees two commands.
        if share > 0.0:
            places = np.searchsorted(answers, exposures - behind).clip(max=len(answers) - 1)
            known &= answers[places] == exposures - behind
            total += share * commands_m[places]
    return total, known


def _rate_hz(folder: Path, streams: list[Mapping[str, Any]], exposures: NDArray[np.int64]) -> float:
    """Return the frame rate from the recorder's clock."""
    record = _find_stream(folder, streams, SLOPES)
    times = _load_array(folder, record, "timestamps_file").astype(float)
    seconds, n_frames = float(np.ptp(times)), int(np.ptp(exposures))
    if not (np.isfinite(seconds) and seconds > 0.0 and n_frames > 0):
        raise ConfigurationError(
            f"{folder}: {record['name']}: found timestamps over {seconds:g} s, expected some that "
            f"rise, or frame_rate_hz in {FACTS}"
        )
    return n_frames / seconds
