"""Arguments of ``pyrcal demo``; quick to import."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from service.program import OneLineParser

FORWARDED = {
    "alpha": ("X,Y,ROT_DEG,MAG", "true registration; default far away, see --near"),
    "mag": ("M", "magnitude of the star, default 8"),
    "gain": ("G", "integrator gain, default 0.4"),
    "plant": ("NAME", "simulated telescope: linear (default), diffractive or measured"),
    "matrix": ("FILE", "measured interaction matrix of --instrument, with --plant measured"),
    "scene": ("NAME", "onsky (default) or daytime"),
    "seeing": ("ARCSEC", "default 1"),
    "profile": ("NAME", "layers of turbulence, default single"),
    "imperfections": ("NAME", "ideal, usual (default) or realistic"),
}
REPEATED = {
    "jump": ("T:DX,DY,DROT_DEG,DMAG", "sudden change of the registration; repeatable"),
    "drift": ("DX,DY,DROT_DEG,DMAG", "steady change, per minute"),
    "wind": ("SPEED,DIR_DEG[,SHARE]", "a layer instead of a profile; repeatable"),
    "fault": ("KIND@T[:ARGS]", "something goes wrong; repeatable, see pyrcal sim --help"),
}
"""Options of the simulator that the demo passes on."""


def demo_parser() -> argparse.ArgumentParser:
    """Return the parser of the demo's command line."""
    demo = OneLineParser(
        prog="pyrcal demo",
        description="Start the service and a simulated RTC, show what happens, judge the outcome. "
        "Exit status 0: the registration was found, the margin recovered, the wavefront error "
        "fell; 1: not so, and why is printed; 2: an argument makes no sense.",
    )
    demo.add_argument(
        "--seconds",
        type=_seconds,
        metavar="N",
        help="end when all has come out right and held for 5 s, at the latest N s of telemetry "
        "after model and simulator are ready (with --jump, --drift or --fault: N s in any case); "
        "default: run until Ctrl-C",
    )
    for name, (metavar, text) in FORWARDED.items():
        demo.add_argument(f"--{name}", metavar=metavar, help=text)
    for name, (metavar, text) in REPEATED.items():
        demo.add_argument(f"--{name}", action="append", metavar=metavar, help=text)
    demo.add_argument(
        "--instrument",
        default="flao-lbt",
        metavar="NAME|FILE",
        help="the telescope, of service and simulator: packaged instrument or instrument file",
    )
    demo.add_argument(
        "--near",
        action="store_true",
        help="begin at a registration that a loop of 400 modes holds, at random; so it is with "
        "--plant or --scene, too. Else the RTC begins with the 120 modes that its matrix can hold",
    )
    demo.add_argument("--seed", type=_seed, default=1, metavar="S", help="of everything random")
    demo.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    demo.add_argument("--plot", type=Path, metavar="FILE", help="draw the wavefront error there")
    demo.add_argument("--port", type=_port, default=8080, help="of the REST API")
    demo.add_argument("--zenoh-port", type=_port, default=7447, help="of the link to the RTC")
    demo.add_argument(
        "--dir", type=Path, default=Path("var/demo"), help="logs, truth, archive; emptied first"
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
