"""``pyrcal track``: from recorded telemetry to α over time."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import structlog
from threadpoolctl import threadpool_limits

from pyrcal.fitting.figures import check_plots, save_figure
from pyrcal.importers.aot import read_telemetry
from pyrcal.playback.arrays import Arrays, open_arrays
from pyrcal.playback.player import Player
from pyrcal.playback.pyrtc import is_session, read_session
from pyrcal.playback.report import Track, document, draw, fill, table
from pyrcal.terminal import show_progress
from service.config import load_settings
from service.config.settings import Settings
from service.errors import ConfigurationError, say
from service.files.documents import json_text
from service.files.recording import FORMAT, Message, Recording
from service.files.whole import open_growing_hdf5, write_whole
from service.instrument import load_instrument
from service.model.instrument import Instrument

FOUND, NOTHING_FOUND = 0, 1


def main(options: argparse.Namespace) -> int:
    """Play the file, print the result, and return the exit status.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used.
    """
    # Before the telemetry is played, which may take minutes.
    if options.plot is not None:
        check_plots()
    # Standard output is for the result.
    structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
    settings = load_settings(options.config, os.environ)
    instrument = load_instrument(options.instrument)
    found = track(options.telemetry, instrument, settings)
    if options.json:
        print(json_text(document(found, options.telemetry)))
    else:
        print(table(found))
    if options.output is not None:
        write_whole(options.output, partial(fill, track=found, source=options.telemetry))
    if options.plot is not None:
        figure = draw(found, f"{instrument.name}: {options.telemetry.name}")
        save_figure(figure, options.plot)
    return NOTHING_FOUND if found.state.alpha.registration is None else FOUND


def track(
    path: str | Path, instrument: Instrument | str | Path, settings: Settings | None = None
) -> Track:
    """Return α over time from recorded telemetry, by the service's own estimators.

    ``path`` is a recording of pyrcal, arrays in ``.npz`` or HDF5, an AOT file or a session of pyRTC
    (docs/howto/tracking.md). ``instrument`` is the result or the argument of
    ``load_instrument``. ``settings`` are the defaults if None.

    Raises
    ------
    PyrcalError
        If the file, the instrument or the settings cannot be used.
    """
    path = Path(path)
    if not isinstance(instrument, Instrument):
        instrument = load_instrument(instrument)
    settings = settings or load_settings(None, {})
    # One thread, as in the service: sums of several threads differ in their last digits.
    with threadpool_limits(1):
        if _is_recording(path):
            with Recording(path) as recording:
                return _play(recording.messages(), instrument, settings, recording.system)
        if is_session(path):
            session = Arrays(path=path, found=read_session(path, instrument))
            return _play_arrays(session, instrument, settings)
        begins = _read_header(path)
        if path.is_dir() or path.suffix == ".txt" or (begins and b"AOT-VERS" not in begins):
            raise ConfigurationError(f"{path}: {ONE_STREAM}")
        if begins:
            return _play_aot(path, instrument, settings)
        with open_arrays(path) as arrays:
            return _play_arrays(arrays, instrument, settings)


def _is_recording(path: Path) -> bool:
    try:
        with open_growing_hdf5(path) as file:
            return str(file.attrs.get("format")) == FORMAT
    except (OSError, RuntimeError, KeyError):
        # Read as arrays it is refused with the reason.
        return False


ONE_STREAM = (
    "found a folder, a cube or its timing file, as recorders of MagAO-X and cacao write for each "
    "stream; expected one file (.npz, HDF5 or MATLAB) with slopes (n_frames, n_slopes), the "
    "commands_m (n_frames, n_modes) that were on the mirror meanwhile, metres of OPD, and "
    "frame_rate_hz: pair both streams by their timing files, and make slopes of camera frames"
)


def _read_header(path: Path) -> bytes:
    """Return the first keywords of a FITS file; nothing if it is another kind of file."""
    try:
        with path.open("rb") as file:
            begins = file.read(1 << 16)
    except OSError:
        # Read as arrays it is refused with the reason.
        return b""
    return begins if begins.startswith(b"SIMPLE") else b""


def _play_aot(path: Path, instrument: Instrument, settings: Settings) -> Track:
    """Play an AOT file, and keep what it says of α itself."""
    aot = read_telemetry(path, instrument)
    if not aot.arrays:
        raise ConfigurationError(
            f"{path}: found no slopes with commands, expected measurements of its sensor and "
            "modal_coefficients or commands of a loop; pyrcal import aot reads its matrix and alpha"
        )
    for note in aot.notes:
        say(f"note: {path}: {note}")
    found = _play_arrays(Arrays(path=path, found=aot.arrays), instrument, settings)
    return replace(found, stated=aot.registrations)


def _play_arrays(arrays: Arrays, instrument: Instrument, settings: Settings) -> Track:
    """Play telemetry of arrays, and say whether its streams were stored some frames apart."""
    found = _play(arrays.messages(instrument), instrument, settings, instrument.name)
    return replace(found, misaligned=arrays.misalignment())


def _play(
    messages: Iterable[Message], instrument: Instrument, settings: Settings, system: str
) -> Track:
    show_progress("preparing the optical model")
    player = Player(instrument, settings, system)
    run = partial(asyncio.run, player.play(messages, _counter()))
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return run()
    with ThreadPoolExecutor(1) as pool:  # a notebook runs a loop, in which there is no other
        return pool.submit(run).result()


def _counter() -> Callable[[float], None]:
    """Return what shows each second that was played."""
    shown = 0

    def show(seconds: float) -> None:
        nonlocal shown
        if seconds >= shown + 1:
            shown = int(seconds)
            show_progress(f"{shown} s played")

    return show
