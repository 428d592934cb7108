"""Arguments of ``pyrcal demo``; quick to import."""

from __future__ import annotations

import math
from pathlib import Path

from service.parser import OneLineParser, words
from service.program import such, whole

FORWARDED = {
    "alpha": ("X,Y,ROT_DEG,MAG", "true registration; default: far from nominal, see --near"),
    "mag": ("M", "magnitude of the star, default 8"),
    "gain": ("G", "integrator gain, default 0.4"),
    "plant": ("NAME", "simulated telescope: linear (default), diffractive or measured"),
    "matrix": ("FILE", "measured interaction matrix of --instrument, with --plant measured"),
    "scene": ("NAME", "scene: onsky (default) or daytime"),
    "seeing": ("ARCSEC", "seeing at 500 nm, default 1"),
    "profile": ("NAME", "layers of turbulence, default single"),
    "imperfections": ("NAME", "ideal, usual (default) or realistic"),
}
REPEATED = {
    "jump": ("T:DX,DY,DROT_DEG,DMAG", "sudden change of the registration; repeatable"),
    "drift": ("DX,DY,DROT_DEG,DMAG", "steady change, per minute"),
    "wind": ("SPEED,DIR_DEG[,SHARE]", "turbulent layer instead of a profile; repeatable"),
    "fault": ("KIND@T[:ARGS]", "fault of RTC or link; repeatable, see pyrcal sim --help"),
}
"""Options of the simulator that the demo passes on."""


def demo_parser() -> OneLineParser:
    """Return the parser of the demo's command line."""
    return OneLineParser(
        prog="pyrcal demo",
        description="Run the service and a simulated RTC, show what happens, judge the outcome. "
        "Exit status: 0 registration found, margin recovered and wavefront error reduced; "
        "1 one of these failed (the reason is printed); 2 wrong argument.",
        examples=("", "--seconds 120 --jump 60:0.2,0,0,0 --plot demo.png"),
        options=(
            words(
                "--seconds N",
                "end once the outcome is good and has lasted for 5 s, at the latest after N s of "
                "telemetry (with --jump, --drift or --fault: after N s); default: run until Ctrl-C",
                type=_seconds,
            ),
            *(words(f"--{name} {value}", text) for name, (value, text) in FORWARDED.items()),
            *(
                words(f"--{name} {value}", text, action="append")
                for name, (value, text) in REPEATED.items()
            ),
            words(
                "--instrument NAME|FILE",
                "packaged instrument or instrument file, default flao-lbt",
                default="flao-lbt",
            ),
            words(
                "--near",
                "begin near the nominal registration, where a loop of 400 modes is stable (as with "
                "--plant or --scene); by default the RTC begins with 120 modes, far from it",
            ),
            words("--seed S", "seed of all random numbers, default 1", type=_seed, default=1),
            words("--json FILE", "write the results there", type=Path),
            words("--plot FILE", "draw the wavefront error there", type=Path),
            words("--port PORT", "port of the REST API, default 8080", type=_port, default=8080),
            words(
                "--zenoh-port PORT",
                "port of the link to the RTC, default 7447",
                type=_port,
                default=7447,
            ),
            words(
                "--dir DIR",
                "folder of logs, truth and archive, default var/demo; emptied first",
                type=Path,
                default=Path("var/demo"),
            ),
        ),
    )


_seconds = such(float, lambda value: 0.0 < value < math.inf, "a number of seconds > 0")
_seed = such(whole, lambda value: value >= 0, "a whole number from 0")
# The service and the demo must know the port: 0, which leaves the choice to the system, is refused.
_port = such(whole, lambda value: 1 <= value <= 65535, "a port from 1 to 65535")
