"""Options of the devices: the mirror's limits and faults, the detector's noise, the presets."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field

from service.errors import ConfigurationError
from sim_rtc import arguments
from sim_rtc.detector import Camera
from sim_rtc.drive import MirrorLimits
from sim_rtc.influence import InfluenceFile
from sim_rtc.mirror import MirrorFaults
from sim_rtc.pixels import FLAO_PRESETS, preset_for

_MICROMETRE = 1e-6

PRESETS = "\n".join(
    f"    to R = {preset.faintest:4.1f}: {preset.frame_rate_hz:5.0f} Hz, binning {preset.binning}, "
    f"{preset.n_controlled} modes"
    for preset in FLAO_PRESETS
)
"""What ``--preset flao`` chooses, for the manual."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceOptions:
    """How mirror and detector are made."""

    faults: MirrorFaults = field(default_factory=MirrorFaults)
    influence: InfluenceFile | None = None
    """Measured influence functions; None: those of the plant."""

    limits: MirrorLimits = field(default_factory=MirrorLimits)
    rise_s: float = 0.0
    """From 10 to 90 % of a step of the mirror."""

    camera: Camera = field(default_factory=Camera)
    binning: int = 1
    """Detector pixels per side of a subaperture, in pixels of the finest one."""

    @property
    def needs_drive(self) -> bool:
        """Whether a linear plant, too, must follow its mirror's movements one by one."""
        return self.rise_s > 0.0 or self.limits != MirrorLimits()


def add_devices(parser: argparse.ArgumentParser) -> None:
    """Add the groups of mirror and detector."""
    _add_mirror(parser.add_argument_group("mirror"))
    _add_detector(parser.add_argument_group("detector"))


def apply_preset(found: argparse.Namespace) -> None:
    """Replace rate, binning and number of modes by those that a preset has for the magnitude.

    Raises
    ------
    ConfigurationError
        If there is none for so faint a star.
    """
    found.binning = 1
    if found.preset is not None:
        preset = preset_for(found.mag)
        found.rate, found.n_controlled = preset.frame_rate_hz, preset.n_controlled
        found.binning = preset.binning


def device_options(found: argparse.Namespace) -> DeviceOptions:
    """Return the options of the devices.

    Raises
    ------
    ConfigurationError
        If a pitch is given of influence functions that are not.
    """
    influence = None
    if found.influence is not None:
        influence = InfluenceFile(reference=found.influence, pitch_m=found.influence_pitch)
    elif found.influence_pitch is not None:
        raise ConfigurationError("--influence-pitch: found alone; expected --influence beside it")
    return DeviceOptions(
        influence=influence,
        faults=MirrorFaults(dead=found.dead_actuators, stuck=tuple(found.stuck_actuators or ())),
        limits=MirrorLimits(
            stroke_m=found.actuator_stroke * _MICROMETRE,
            bend_m=found.actuator_bend * _MICROMETRE,
        ),
        rise_s=found.rise_ms * 1e-3,
        camera=Camera(
            read_noise_electrons=found.read_noise,
            excess_noise=found.excess_noise,
        ),
        binning=found.binning,
    )


def _add_mirror(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--influence",
        type=arguments.dataset,
        metavar="FILE:/DATASET",
        help="influence functions (n_actuators, ny, nx) in HDF5, instead of the plant's own",
    )
    group.add_argument(
        "--influence-pitch",
        type=arguments.within(1e-5, 10.0),
        metavar="M",
        help="distance of their points in the pupil (default: the dataset's attribute pitch_m)",
    )
    group.add_argument(
        "--rise-ms",
        type=arguments.within(0.0, 100.0),
        default=0.0,
        metavar="MS",
        help="time of the mirror from 10 to 90 %% of a step; FLAO's takes 0.7 (default: at once)",
    )
    group.add_argument(
        "--actuator-stroke",
        type=arguments.within(0.1, 1000.0),
        default=MirrorLimits().stroke_m / _MICROMETRE,
        metavar="UM",
        help="largest OPD of one actuator either way (default: %(default)g um)",
    )
    group.add_argument(
        "--actuator-bend",
        type=arguments.within(0.1, 1000.0),
        default=MirrorLimits().bend_m / _MICROMETRE,
        metavar="UM",
        help="largest OPD between an actuator and its neighbours' mean (default: %(default)g um)",
    )
    group.add_argument(
        "--dead-actuators",
        type=arguments.indices,
        default=(),
        metavar="N,N...",
        help="actuators that are switched off and follow their neighbours",
    )
    group.add_argument(
        "--stuck-actuators",
        type=arguments.stuck_actuator,
        action="append",
        metavar="N:METRES",
        help="an actuator that stays at this OPD; may be repeated",
    )


def _add_detector(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--read-noise",
        type=arguments.within(0.0, 1000.0),
        default=Camera().read_noise_electrons,
        metavar="E",
        help="electrons RMS per pixel (default: %(default)g)",
    )
    group.add_argument(
        "--excess-noise",
        type=arguments.within(1.0, 4.0),
        default=1.0,
        metavar="F2",
        help="variance of the photon noise over Poisson's, 2 for an EMCCD (default: %(default)g)",
    )
    group.add_argument(
        "--preset",
        choices=["flao"],
        help="frame rate, binning and modes that FLAO would choose for this magnitude; "
        "overrides --rate and --n-controlled; binning needs the diffractive plant",
    )
