"""Arguments of ``pyrcal demo``; quick to import."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from service.parser import OneLineParser

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
    demo = OneLineParser(
        prog="pyrcal demo",
        description="Run the service and a simulated RTC, show what happens, judge the outcome. "
        "Exit status: 0 registration found, margin recovered and wavefront error reduced; "
        "1 one of these failed (the reason is printed); 2 wrong argument.",
        examples=("pyrcal demo", "pyrcal demo --seconds 120 --jump 60:0.2,0,0,0 --plot demo.png"),
    )
    demo.add_argument(
        "--seconds",
        type=_seconds,
        metavar="N",
        help="end once the outcome is good and has lasted for 5 s, at the latest after N s of "
        "telemetry (with --jump, --drift or --fault: after N s); default: run until Ctrl-C",
    )
    for name, (metavar, text) in FORWARDED.items():
        demo.add_argument(f"--{name}", metavar=metavar, help=text)
    for name, (metavar, text) in REPEATED.items():
        demo.add_argument(f"--{name}", action="append", metavar=metavar, help=text)
    demo.add_argument(
        "--instrument",
        default="flao-lbt",
        metavar="NAME|FILE",
        help="packaged instrument or instrument file, default flao-lbt",
    )
    demo.add_argument(
        "--near",
        action="store_true",
        help="begin near the nominal registration, where a loop of 400 modes is stable (as with "
        "--plant or --scene); by default the RTC begins with 120 modes, far from it",
    )
    demo.add_argument(
        "--seed", type=_seed, default=1, metavar="S", help="seed of all random numbers, default 1"
    )
    demo.add_argument("--json", type=Path, metavar="FILE", help="write the results there")
    demo.add_argument("--plot", type=Path, metavar="FILE", help="draw the wavefront error there")
    demo.add_argument(
        "--port",
        type=_port,
        default=8080,
        metavar="PORT",
        help="port of the REST API, default 8080",
    )
    demo.add_argument(
        "--zenoh-port",
        type=_port,
        default=7447,
        metavar="PORT",
        help="port of the link to the RTC, default 7447",
    )
    demo.add_argument(
        "--dir",
        type=Path,
        default=Path("var/demo"),
        metavar="DIR",
        help="folder of logs, truth and archive, default var/demo; emptied first",
    )
    return demo


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number of seconds > 0")
    return value


def _seed(text: str) -> int:
    if not (text.isascii() and text.isdecimal()):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a whole number from 0")
    return int(text)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and 1 <= int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a port from 1 to 65535")
    return int(text)
