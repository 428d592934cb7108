"""The command line of the simulated RTC, read like the manual of an instrument."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from typing_extensions import override

from service.errors import ConfigurationError
from service.model.misregistration import Misregistration
from sim_rtc import arguments
from sim_rtc.manual import DESCRIPTION, EPILOG, USAGE
from sim_rtc.options_device import (
    DeviceOptions,
    add_devices,
    apply_preset,
    device_options,
)
from sim_rtc.options_rehearsal import RehearsalOptions, add_rehearsal, rehearsal_options
from sim_rtc.options_scene import (
    SceneOptions,
    add_imperfections,
    add_motion,
    add_scene,
    apply_scene,
    scene_options,
)
from sim_rtc.schedule import Drift, Jump

_USUAL_SPEED = {"linear": 1.0, "diffractive": 0.0}
"""The diffractive plant cannot keep up with a real loop: it takes the time it needs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """What the command line asked for, each value possible by itself."""

    connect: str
    """zenoh endpoint of the service's router."""

    instrument: str
    """Name of a packaged instrument, or path of an instrument file."""

    alpha: Misregistration | None
    """True registration at the start; None: drawn at random."""

    magnitude: float
    seed: int | None
    """Of everything random; None: different every time."""

    sky: SceneOptions
    """Scene, turbulence, vibrations, imperfections, ways the registration moves."""

    outer_scale_m: float
    gain: float
    group_gains: tuple[float, float, float] | None
    """Of tip and tilt, the modes to 100, the rest; None: ``gain`` for all."""

    gain_ramp_s: float | None
    """Seconds at each gain of a ramp at the start; None: no ramp."""

    leak: float
    delay_frames: int
    n_controlled: int
    frame_rate_hz: float
    plant: str
    devices: DeviceOptions
    """Mirror and detector."""

    truth: Path | None
    jumps: tuple[Jump, ...]
    drift: Drift
    seconds: float | None
    """Loop time after which to stop; None: never."""

    speed: float
    """Loop time over wall-clock time; 0: as fast as it goes."""

    rehearsal: RehearsalOptions
    """Recording, replay, faults."""

    snapshot: Path | None
    """Picture to write instead of running the loop for a service."""

    quiet: bool


def parse_options(given: Sequence[str] | None = None) -> Options:
    """Return the options; an impossible one ends the program with one line and status 2."""
    parser = _parser()
    found = parser.parse_args(_joined(sys.argv[1:] if given is None else given))
    try:
        apply_scene(found)
        apply_preset(found)
        sky = scene_options(found)
        devices = device_options(found)
        rehearsal = rehearsal_options(found)
    except ConfigurationError as error:
        parser.error(str(error))
    return Options(
        connect=found.connect,
        instrument=found.instrument,
        alpha=found.alpha,
        magnitude=found.mag,
        seed=found.seed,
        sky=sky,
        outer_scale_m=found.outer_scale,
        gain=found.gain,
        group_gains=found.gains,
        gain_ramp_s=found.gain_ramp,
        leak=found.leak,
        delay_frames=found.delay,
        n_controlled=found.n_controlled,
        frame_rate_hz=found.rate,
        plant=found.plant,
        devices=devices,
        truth=sky.truth,
        jumps=tuple(found.jump or ()),
        drift=found.drift,
        seconds=found.seconds,
        speed=_USUAL_SPEED[found.plant] if found.speed is None else found.speed,
        rehearsal=rehearsal,
        snapshot=found.snapshot,
        quiet=found.quiet,
    )


def _joined(given: Sequence[str]) -> list[str]:
    """Tie values that begin with a minus sign to their option: argparse takes them for options."""
    joined: list[str] = []
    for argument in given:
        if joined and joined[-1].startswith("--") and re.match(r"-[\d.]", argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage that would push it off the screen."""

    @override
    def error(self, message: str) -> NoReturn:
        """End the program with status 2."""
        self.exit(2, f"{self.prog}: {message}\n")


class _ManualFormatter(argparse.RawDescriptionHelpFormatter):
    """As wide as the rest of the manual, whatever the terminal."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=100)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="sim_rtc",
        usage=USAGE,
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=_ManualFormatter,
        allow_abbrev=False,
    )
    _add_instrument(parser.add_argument_group("instrument and truth"))
    _add_sky(parser.add_argument_group("scene: star and sky, or fibre"))
    add_imperfections(parser.add_argument_group("imperfections"))
    _add_loop(parser.add_argument_group("loop"))
    add_devices(parser)
    _add_run(parser.add_argument_group("run"))
    add_rehearsal(parser.add_argument_group("rehearsal: recording, replay, faults"))
    return parser


def _add_instrument(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--instrument",
        default="flao-lbt",
        metavar="NAME|FILE",
        help="packaged instrument or instrument file (default: %(default)s)",
    )
    group.add_argument(
        "--plant",
        choices=["linear", "diffractive"],
        default="linear",
        help="model of the telescope (default: %(default)s)",
    )
    group.add_argument(
        "--alpha",
        type=arguments.alpha,
        metavar="X,Y,ROT_DEG,MAG",
        help="true registration (default: at random, |shift| <= 0.2, 0.3 deg, 0.5 %%)",
    )
    group.add_argument(
        "--jump",
        type=arguments.jump,
        action="append",
        metavar="T:DX,DY,DROT_DEG,DMAG",
        help="sudden change of the registration at T seconds; may be repeated",
    )
    group.add_argument(
        "--drift",
        type=arguments.drift,
        default=Drift(),
        metavar="DX,DY,DROT_DEG,DMAG",
        help="steady change of the registration, per minute",
    )
    add_motion(group)
    group.add_argument(
        "--truth",
        type=arguments.truth,
        action="append",
        metavar="FILE",
        help="write the truth there (never on the wire)",
    )


def _add_sky(group: argparse._ArgumentGroup) -> None:
    add_scene(group)
    group.add_argument(
        "--mag",
        type=arguments.within(-5.0, 20.0),
        metavar="R",
        help="magnitude of the guide star, or of the fibre (default: 8; by day 7)",
    )
    group.add_argument(
        "--seeing",
        type=arguments.within(0.05, 5.0),
        default=1.0,
        metavar="ARCSEC",
        help="seeing at 500 nm; by day, of what is played (default: %(default)s)",
    )
    group.add_argument(
        "--outer-scale",
        type=arguments.within(1.0, 1000.0),
        default=25.0,
        metavar="M",
        help="outer scale of the turbulence (default: %(default)s)",
    )
    group.add_argument(
        "--wind",
        type=arguments.layer,
        action="append",
        metavar="SPEED,DIR_DEG[,SHARE]",
        help="a layer: m/s, direction it moves to, share; up to 3, instead of a profile",
    )
    group.add_argument("--seed", type=arguments.count(0), metavar="N", help="of everything random")


def _add_loop(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--rate",
        type=arguments.within(10.0, 4000.0),
        default=1000.0,
        metavar="HZ",
        help="frame rate (default: %(default)s)",
    )
    group.add_argument(
        "--gain",
        type=arguments.within(0.0, 2.0),
        metavar="G",
        help="integrator gain of every controlled mode (default: 0.4; by day 0.2)",
    )
    group.add_argument(
        "--gains",
        type=arguments.group_gains,
        metavar="TIP_TILT,TO_100,REST",
        help="gains by group of modes, instead of --gain",
    )
    group.add_argument(
        "--gain-ramp",
        type=arguments.within(0.05, 60.0),
        nargs="?",
        const=1.0,
        metavar="S",
        help="at the start raise the gain of tip and tilt, of the modes to 100, and of the rest in "
        "turn, S seconds a step (default: 1), and keep those of least residual slopes; later the "
        "service may ask for another",
    )
    group.add_argument(
        "--leak",
        type=arguments.within(0.0, 1.0),
        default=0.999,
        metavar="L",
        help="share of the command kept from frame to frame (default: %(default)s)",
    )
    group.add_argument(
        "--delay",
        type=arguments.count(1, 10),
        default=2,
        metavar="FRAMES",
        help="from an exposure to the command that answers it (default: %(default)s)",
    )
    group.add_argument(
        "--n-controlled",
        type=arguments.count(1),
        default=400,
        metavar="N",
        help="modes in the loop at the start (default: %(default)s)",
    )


def _add_run(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--connect",
        type=arguments.endpoint,
        default="tcp/127.0.0.1:7447",
        metavar="ENDPOINT",
        help="zenoh endpoint of the service (default: %(default)s); may come up later",
    )
    group.add_argument(
        "--seconds",
        type=arguments.within(0.01, 1e7),
        metavar="S",
        help="stop after this much loop time",
    )
    group.add_argument(
        "--speed",
        type=arguments.within(0.0, 100.0),
        metavar="X",
        help="loop time over wall-clock time, 0: as fast as it goes (default: 1; diffractive: 0)",
    )
    group.add_argument(
        "--snapshot",
        type=Path,
        metavar="FILE",
        help="close the loop for 300 frames without a service, write a contact sheet of pupil "
        "images, slopes and residual wavefront, and end (needs the extra 'plots')",
    )
    group.add_argument("--quiet", action="store_true", help="say only what is wrong")


if __name__ == "__main__":  # whether options make sense, for who would start the simulator later
    parse_options()
