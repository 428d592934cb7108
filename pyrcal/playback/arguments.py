"""Arguments of ``pyrcal track``; quick to import."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pyrcal.fitting.arguments import INSTRUMENT
from service.parser import words

_TRACK = """
Run the estimators of the service on recorded telemetry, without an RTC. The result is alpha over
time with 1 sigma from each estimator, the filtered alpha, alarms, and the noisy matrix of a random
dither.
"""

_EPILOG = """
TELEMETRY is a recording (pyrcal recordings start, pyrcal sim --record), an AOT file, a folder of
the pyRTC recorder, or an HDF5 file, .mat or .npz with the arrays slopes (n_frames, n_slopes) and
commands_m (n_frames, n_modes), the number frame_rate_hz, and the optional arrays of
docs/howto/tracking.md. Exit status: 0 alpha was estimated; 1 it was not (the table says why); 2
input that cannot be used.
"""


def declare(commands: Any) -> None:  # noqa: ANN401 - argparse's own
    """Add the command to a command line."""
    commands.add_parser(
        "track",
        help="track the registration in recorded telemetry",
        module="pyrcal.playback.track",
        description=_TRACK,
        epilog=_EPILOG,
        examples=(
            "flao-lbt recording.h5",
            "bench.toml telemetry.fits --plot alpha.png --output track.h5",
        ),
        options=(
            words("instrument INSTRUMENT", INSTRUMENT),
            words("telemetry TELEMETRY", "recording, AOT, pyRTC, HDF5, .mat or .npz", type=Path),
            words("--config FILE", "settings of the service, TOML", type=Path),
            words("--json", "print JSON"),
            words("--plot FILE.png", "draw alpha over time", type=Path),
            words("--output FILE.h5", "write all results", type=Path),
        ),
    )
