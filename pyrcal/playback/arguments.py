"""Arguments of ``pyrcal track``; quick to import."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pyrcal.options import add, words

_TRACK = """
Play recorded telemetry to the estimators of the service, without an RTC: alpha over time with 1
sigma from every estimator, the filtered alpha, alarms, and the noisy matrix of a random dither.
"""

_EPILOG = """
TELEMETRY is a recording (pyrcal record, pyrcal sim --record), an AOT file, a folder of pyRTC's
recorder, or an HDF5 file or .npz with the arrays slopes (n_frames, n_slopes) and commands_m
(n_frames, n_modes), the number frame_rate_hz, and what else docs/howto/tracking.md lists. Exit
status: 0 alpha was found, 1 it was not (the table says why; what ordinary telemetry says by itself
is no alpha that the service would use), 2 input that cannot be used.
"""


def declare(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    """Add the command to a command line."""
    track = commands.add_parser("track", help="track the registration in recorded telemetry")
    track.set_defaults(module="pyrcal.playback.track")
    track.description, track.epilog = _TRACK, _EPILOG
    add(
        track,
        words("instrument INSTRUMENT", "TOML file, or a packaged name"),
        words("telemetry TELEMETRY", "recording, AOT, session of pyRTC, HDF5 or .npz", type=Path),
        words("--config FILE", "the service's settings, TOML", type=Path),
        words("--json", "print one JSON object, not a table"),
        words("--plot FILE.png", "draw alpha over time", type=Path),
        words("--output FILE.h5", "write everything found", type=Path),
    )
