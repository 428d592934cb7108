"""Puts a simulated RTC together from its options; takes a few seconds."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.errors import ConfigurationError
from service.model.instrument import Instrument
from service.model.modes import ModalBasis, analytic_basis
from service.prepared import Prepared, usual_folder
from sim_rtc.beforehand import identity_of, initial_reconstructor
from sim_rtc.computer import RealTimeComputer
from sim_rtc.detector import Detector
from sim_rtc.devices import (
    binned_basis,
    build_detector,
    build_drive,
    build_feed,
    build_plant,
    build_schedule,
    build_sky,
)
from sim_rtc.dither import DitherLimits
from sim_rtc.drive import MirrorDrive
from sim_rtc.feed import BATCH_FRAMES, Block, Feed
from sim_rtc.gains import by_group
from sim_rtc.motion import MovingOptics, background_executor
from sim_rtc.options import Options
from sim_rtc.pixels import binned
from sim_rtc.plant import Plant, TelescopeOptics
from sim_rtc.playable import check_playable
from sim_rtc.reconstructors import Reconstructor
from sim_rtc.telemetry import Identity, LoopSettings

STROKE_M = 10e-6
"""Largest command of one mode, metres RMS OPD: seven times the tilt of median seeing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Telescope:
    """Everything but the computer: what feeds it and what is known of it beforehand."""

    feed: Feed
    plant: Plant
    optics: MovingOptics
    detector: Detector
    identity: Identity
    reconstructor: Reconstructor
    """In use at the start: for a perfect registration, by the nominal model."""

    settings: LoopSettings
    weights: NDArray[np.float64]
    """``(n_points,)`` share of the pupil's area at each point of the plant."""

    mode_to_actuator: NDArray[np.float64]
    """``(n_actuators, n_modes)`` of the basis."""

    drive: MirrorDrive | None
    """Limits and lag of the mirror; None: it obeys at once."""

    def computer(self, blocks: Iterator[Block]) -> RealTimeComputer:
        """Return a computer that runs on these blocks of the feed."""
        return RealTimeComputer(
            blocks,
            identity=self.identity,
            settings=self.settings,
            reconstructor=self.reconstructor,
            optics=self.optics.at(0.0),
            stroke_m=STROKE_M,
            limits=DitherLimits(most_modes=len(self.settings.gains)),
            mode_to_actuator=self.mode_to_actuator,
            drive=self.drive,
        )


def _modes(instrument: Instrument) -> ModalBasis:
    """Return the modes of an analytic mirror, from the folder that the service keeps its own in."""
    kept = Prepared(usual_folder(os.environ)).basis(instrument)
    return kept if isinstance(kept, ModalBasis) else analytic_basis(instrument)


def build_telescope(
    options: Options,
    instrument: Instrument,
    executor: Executor | None = None,
    batch_frames: int = BATCH_FRAMES,
) -> Telescope:
    """Return the telescope of these options.

    Optics to come are computed by ``executor``, a thread beside the loop unless given: then a
    movement of the registration may come late. ``batch_frames`` are processed together if the
    plant is linear.

    Raises
    ------
    ConfigurationError
        If the instrument is not simulated, or more modes are to be controlled than it has.
    """
    check_playable(instrument)
    n_modes = instrument.modes.n_modes
    if options.n_controlled > n_modes:
        raise ConfigurationError(
            f"--n-controlled: found {options.n_controlled}; {instrument.name} has {n_modes} modes"
        )
    plant_rng, sky_rng, noise_rng, alpha_rng = np.random.default_rng(options.seed).spawn(4)
    binning = options.devices.binning
    basis = binned_basis(instrument, _modes(instrument), binning)
    instrument = binned(instrument, binning)
    plant = build_plant(options, instrument, basis, plant_rng)
    sky = build_sky(options, instrument, basis, plant, sky_rng)

    def prepare(optics: TelescopeOptics) -> None:
        for _, response in optics.responses if sky.played is None else ():
            sky.turbulence.prepare(response)

    optics = MovingOptics(
        plant,
        build_schedule(options, instrument, alpha_rng),
        executor or background_executor(),
        prepare=prepare,
    )
    detector = build_detector(options, instrument, plant, optics.start())
    double_pass = options.sky.scene.passes == 2
    identity = replace(identity_of(instrument, plant.valid), double_pass=double_pass)
    return Telescope(
        feed=build_feed(options, plant, sky, optics, detector, noise_rng, batch_frames),
        plant=plant,
        optics=optics,
        detector=detector,
        identity=identity,
        reconstructor=initial_reconstructor(instrument, basis, identity, options.n_controlled),
        settings=LoopSettings(
            frame_rate_hz=options.frame_rate_hz,
            delay_frames=options.delay_frames,
            gains=by_group(options.group_gains or (options.gain,) * 3, n_modes),
            leak=options.leak,
            n_controlled_next=options.n_controlled,
        ),
        weights=plant.weights,
        mode_to_actuator=basis.mode_to_actuator,
        drive=build_drive(options, instrument, basis),
    )
