"""The options of scene, sky, imperfections and moving registration."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from service.errors import ConfigurationError
from sim_rtc import arguments
from sim_rtc.atmosphere import Layer
from sim_rtc.elevation import Elevation
from sim_rtc.imperfections import SETS, Imperfections
from sim_rtc.profiles import PROFILES
from sim_rtc.scene import Scene, SceneKind
from sim_rtc.schedule import Flexure, Walk
from sim_rtc.seeing import SeeingSchedule
from sim_rtc.vibration import DAYTIME_LINES, VibrationLine

_MOST_LAYERS = 3
_NIGHT_MAGNITUDE, _FIBRE_MAGNITUDE = 8.0, 7.0
_NIGHT_GAIN = 0.4

EPILOG = """\
scenes
  onsky: a star through frozen-flow turbulence, the mirror seen once. daytime: a fibre and a
  retro-reflector; the light meets the mirror twice, so a command's slopes double and --gain is
  0.2 unless given (the loop gain stays). There is no atmosphere: a turbulence of --seeing, as the
  sensor sees it, is played on the mirror, and tip, tilt and focus vibrate. The command column is
  all that is on the mirror: integrator, dither and played turbulence; the dither column is the
  dither alone. Wavefront errors in the truth file are those at the sensor, after both passes.

atmosphere
  Screens are extruded row by row from noise that is never used twice: nothing repeats, however
  long the run. Profiles: single (12 m/s), three-layer, paranal-like (five layers); a linear plant
  works as hard as the sum of their speeds (12, 41, 67 m/s: .12, .21, .28 ms of processor time
  a frame). Seeing is that at 500 nm for an infinite outer scale; between two --seeing-at it changes
  smoothly, then stays.

imperfections
  ideal: none. usual (the default): light uneven by 10 %, actuators off by 2 % of their pitch,
  optical gain .6 to .9. realistic: light uneven by 20 %, actuators off by 2 %, optical gain .45 to
  .75, 6 dead pixels, 0.1 subapertures of radial distortion, 0.2 % of anamorphosis, 10 % more
  modulation, slope axes turned by 1 deg, 30 nm of non-common path. An option of its own overrides
  its part of the set. --truth realistic means --imperfections realistic (a truth file of that name
  is ./realistic).

vibrations
  tip rises along +x, tilt along +y. Strength is in nm RMS of wavefront at the sensor; DAMPING is
  that of the resonance noise shakes (default 0.01), 0 a pure sine. By day the default is tip:13:60,
  tilt:22:40 and focus:47:15, by night none; --vibration none switches them off.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneOptions:
    """What is looked at, through what, and how it changes."""

    scene: Scene
    imperfections: Imperfections
    seeing: SeeingSchedule
    layers: tuple[Layer, ...]
    vibrations: tuple[VibrationLine, ...]
    flexure: Flexure
    walk: Walk
    elevation: Elevation
    """Of the telescope, as the status tells it."""

    truth: Path | None
    """File of the truth."""


def apply_scene(found: argparse.Namespace) -> None:
    """Give magnitude and gain the defaults of the scene.

    By day a command counts twice: half the gain makes the same loop of the same matrix.
    """
    by_day = found.scene == SceneKind.DAYTIME
    if found.mag is None:
        found.mag = _FIBRE_MAGNITUDE if by_day else _NIGHT_MAGNITUDE
    if found.gain is None:
        found.gain = _NIGHT_GAIN / 2 if by_day else _NIGHT_GAIN


def scene_options(found: argparse.Namespace) -> SceneOptions:
    """Return the options of this module, together possible.

    Raises
    ------
    ConfigurationError
        If they are not: one line that names the option.
    """
    by_day = found.scene == SceneKind.DAYTIME
    files = [given for given in found.truth or () if isinstance(given, Path)]
    if len(files) > 1:
        raise ConfigurationError(f"--truth: found {len(files)} files; expected one")
    lines = DAYTIME_LINES if by_day else ()
    if found.vibration is not None:
        lines = tuple(line for line in found.vibration if line is not None)
    for line in lines:
        if line.frequency_hz >= found.rate / 2:
            raise ConfigurationError(
                f"--vibration: found {line.frequency_hz:g} Hz; expected less than half the frame "
                f"rate of {found.rate:g} Hz"
            )
    return SceneOptions(
        scene=Scene(kind=SceneKind(found.scene), spiders=found.spiders),
        imperfections=_imperfections(found),
        seeing=SeeingSchedule(start_arcsec=found.seeing, later=tuple(found.seeing_at or ())),
        layers=_layers(found),
        vibrations=lines,
        flexure=found.flexure,
        walk=found.walk,
        elevation=replace(found.elevation, slews=tuple(found.slew or ())),
        truth=files[0] if files else None,
    )


def _layers(found: argparse.Namespace) -> tuple[Layer, ...]:
    if found.wind is None:
        return PROFILES[found.profile or "single"]
    if found.profile is not None:
        raise ConfigurationError("--profile: found beside --wind; expected one of them")
    if len(found.wind) > _MOST_LAYERS:
        raise ConfigurationError(
            f"--wind: found {len(found.wind)} layers; expected at most {_MOST_LAYERS}"
        )
    return tuple(found.wind)


def _imperfections(found: argparse.Namespace) -> Imperfections:
    named = {given for given in found.truth or () if isinstance(given, str)}
    if found.imperfections is not None:
        named.add(found.imperfections)
    if len(named) > 1:
        sets = " and ".join(sorted(named))
        raise ConfigurationError(f"--imperfections: found {sets}; expected one set")
    changes: dict[str, Any] = {
        name: getattr(found, name) for name in _SINGLE if getattr(found, name) is not None
    }
    if found.optical_gain is not None:
        if found.plant != "linear":
            raise ConfigurationError(
                f"--optical-gain: found --plant {found.plant}, whose own light decides it; "
                "expected --plant linear"
            )
        changes["lowest_optical_gain"], changes["highest_optical_gain"] = found.optical_gain
    return replace(SETS[named.pop() if named else "usual"], **changes)


def add_scene(group: argparse._ArgumentGroup) -> None:
    """Add the options of the scene."""
    group.add_argument(
        "--scene",
        choices=[kind.value for kind in SceneKind],
        default=SceneKind.ONSKY.value,
        help="star and atmosphere, or fibre and retro-reflector (default: %(default)s)",
    )
    group.add_argument(
        "--spiders",
        type=arguments.spiders,
        metavar="N:WIDTH_M",
        help="arms in front of the pupil, evenly spread, the first upwards (default: none)",
    )
    group.add_argument(
        "--profile",
        choices=list(PROFILES),
        help="named layers of turbulence (default: single)",
    )
    group.add_argument(
        "--seeing-at",
        type=arguments.seeing_at,
        action="append",
        metavar="T:ARCSEC",
        help="seeing at T seconds; it changes smoothly; may be repeated",
    )
    group.add_argument(
        "--vibration",
        type=arguments.vibration,
        action="append",
        metavar="SHAPE:HZ:NM[:DAMPING]",
        help="a line on tip, tilt or focus; may be repeated; none: no line",
    )


def add_motion(group: argparse._ArgumentGroup) -> None:
    """Add the ways the registration moves."""
    group.add_argument(
        "--flexure",
        type=arguments.flexure,
        default=Flexure(),
        metavar="X,Y,ROT_DEG,MAG:PERIOD_S",
        help="sinusoid around the registration, by these amplitudes, period 120 s or longer",
    )
    group.add_argument(
        "--walk",
        type=arguments.walk,
        default=Walk(),
        metavar="X,Y,ROT_DEG,MAG",
        help="random walk: standard deviations after a minute",
    )
    group.add_argument(
        "--elevation",
        type=arguments.elevation,
        default=Elevation(),
        metavar="DEG[,DEG_PER_MIN]",
        help="of the telescope, in the status; what it does to the registration is yours to say "
        "with --drift, --jump or --flexure (default: 60)",
    )
    group.add_argument(
        "--slew",
        type=arguments.slew,
        action="append",
        metavar="T:DEG",
        help="change of elevation that begins at T seconds, 1 deg/s; may be repeated",
    )


_SINGLE: dict[str, tuple[str, float, float, str]] = {
    "unevenness": ("RATIO", 0.0, 0.9, "largest departure of the light from its mean"),
    "position_error": ("PITCHES", 0.0, 0.3, "RMS error of actuator positions per axis"),
    "distortion_subap": ("SUBAP", -2.0, 2.0, "radial distortion of the pupil image at its edge"),
    "anamorphosis": ("RATIO", -0.1, 0.1, "stretch of the pupil image along x"),
    "modulation_error": ("RATIO", -0.5, 1.0, "true modulation over the nominal one, less 1"),
    "slope_rotation_deg": ("DEG", -45.0, 45.0, "turn of the slope axes, +x towards +y"),
    "ncpa_nm": ("NM", 0.0, 300.0, "static wavefront only the sensor sees, RMS"),
    "bad_pixels": ("N", 0, 100, "dead pixels: dark, and their subapertures read slopes of 0"),
}
"""Field of ``Imperfections``: unit, range and meaning of its option."""


def add_imperfections(group: argparse._ArgumentGroup) -> None:
    """Add one option for the set and one for each imperfection."""
    group.add_argument(
        "--imperfections",
        "--truth-model",
        choices=list(SETS),
        help="how far the telescope is from the drawing (default: usual)",
    )
    group.add_argument(
        "--optical-gain",
        type=arguments.gain_range,
        metavar="LOW,HIGH",
        help="of the first and the last mode; linear plant only",
    )
    for field, (unit, low, high, meaning) in _SINGLE.items():
        name = field.removesuffix("_subap").removesuffix("_deg").removesuffix("_nm")
        is_count = isinstance(low, int)
        group.add_argument(
            "--" + name.replace("_", "-"),
            type=arguments.count(int(low), int(high)) if is_count else arguments.within(low, high),
            dest=field,
            metavar=unit,
            help=meaning,
        )
