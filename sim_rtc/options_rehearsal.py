"""Options of a rehearsal: recording, replaying, faults."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from service.errors import ConfigurationError
from sim_rtc.faults import Fault, manual, read_fault

_RECORDING = """\
recording
  --record writes everything that is sent (frames, status, acknowledgements, liveliness, matrices
  in use) byte for byte to HDF5, from when a service is there. It is flushed twice a second and
  survives a kill -9; read it with h5py.File(FILE, "r", swmr=True), also while it is written:
    /messages  time_s, kind (0 frames, 1 status, 2 acknowledgement, 3 liveliness, 4 matrix),
               start, payload_bytes, attachment_bytes
    /bytes     all payloads, each followed by its attachment
    /dropped   messages that were not written
  --replay plays it, faults included, under the recorded session, sequence and timestamps, at
  --speed (0: as fast as it goes; above 2 a service gives up windows that it has no time to fit).
  It begins when the service says what it knows, or after 20 s. It serves the recorded matrix;
  commands and reconstructors are refused: "unsupported: a replay". A service in mode hold that
  finds the recorded dither in the status adopts it and gives the answers of that night.
"""

EPILOG = manual() + "\n" + _RECORDING
"""For the manual."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RehearsalOptions:
    """What is recorded, replayed, or goes wrong on purpose."""

    record: Path | None = None
    replay: Path | None = None
    faults: tuple[Fault, ...] = ()


def add_rehearsal(group: argparse._ArgumentGroup) -> None:
    """Add the options to a group of the command line."""
    group.add_argument(
        "--fault",
        type=read_fault,
        action="append",
        metavar="KIND@T[:ARGS]",
        help="something goes wrong at T seconds; may be repeated; kinds below",
    )
    group.add_argument(
        "--record", type=Path, metavar="FILE", help="write all that is sent to this new HDF5 file"
    )
    group.add_argument(
        "--replay", type=Path, metavar="FILE", help="play a recording instead of a telescope"
    )


def rehearsal_options(found: argparse.Namespace) -> RehearsalOptions:
    """Return the options.

    Raises
    ------
    ConfigurationError
        If a replay is to be recorded or disturbed.
    """
    if found.replay is not None and (found.record is not None or found.fault):
        raise ConfigurationError("--replay: plays a file as it is; found --record or --fault too")
    return RehearsalOptions(
        record=found.record, replay=found.replay, faults=tuple(found.fault or ())
    )
