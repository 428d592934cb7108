"""The parts of a telescope, each from the options that are its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.errors import ConfigurationError
from service.model.instrument import Instrument, KarhunenLoeve
from service.model.mirror import mirror_surface
from service.model.modes import ModalBasis
from sim_rtc.atmosphere import fried_parameter_m
from sim_rtc.detector import Detector
from sim_rtc.diffractive_plant import DiffractivePlant
from sim_rtc.drive import MirrorDrive
from sim_rtc.feed import BATCH_FRAMES, Feed, OpenLoopFeed
from sim_rtc.flow import frozen_layers
from sim_rtc.influence import read_influence
from sim_rtc.motion import MovingOptics
from sim_rtc.options import Options
from sim_rtc.phases import PhaseFeed
from sim_rtc.pixels import PixelDetector, binned
from sim_rtc.plant import LinearPlant, Plant, TelescopeOptics
from sim_rtc.scene import PlayedTurbulence, SceneKind
from sim_rtc.schedule import Schedule, random_registration
from sim_rtc.sky import Sky, Turbulence
from sim_rtc.vibration import Vibrations


def build_plant(
    options: Options, instrument: Instrument, basis: ModalBasis, rng: np.random.Generator
) -> Plant:
    """Return the plant of these options, for an instrument that is binned already.

    Raises
    ------
    ConfigurationError
        If pixels are to be binned on a plant that cannot, or actuators to fail that the mirror does
        not have, or the influence functions are not of this mirror.
    """
    faults, binning = options.devices.faults, options.devices.binning
    influence = None
    if options.devices.influence is not None:
        influence = read_influence(options.devices.influence, instrument)
    if options.plant == "diffractive":
        return DiffractivePlant(
            instrument,
            basis,
            rng=rng,
            imperfections=options.sky.imperfections,
            scene=options.sky.scene,
            faults=faults,
            influence=influence,
            binning=binning,
        )
    if binning > 1:
        raise ConfigurationError(
            "--preset: a binned sensor needs --plant diffractive; found --plant linear"
        )
    return LinearPlant(
        instrument,
        basis,
        rng=rng,
        imperfections=options.sky.imperfections,
        scene=options.sky.scene,
        faults=faults,
        influence=influence,
    )


def build_sky(
    options: Options,
    instrument: Instrument,
    basis: ModalBasis,
    plant: Plant,
    rng: np.random.Generator,
) -> Sky:
    """Return what comes to the sensor of this plant, and what is played on its mirror."""
    sky, scene = options.sky, options.sky.scene
    layers = frozen_layers(
        sky.layers,
        points_m=plant.points_m,
        pitch_m=plant.pitch_m,
        turbulence=KarhunenLoeve(
            r0_m=fried_parameter_m(sky.seeing.start_arcsec), outer_scale_m=options.outer_scale_m
        ),
        rng=rng,
    )
    vibrations = Vibrations(
        sky.vibrations,
        points=plant.points_m,
        weights=plant.weights,
        frame_rate_hz=options.frame_rate_hz,
        rng=rng.spawn(1)[0],
    )
    played = None
    if scene.kind is SceneKind.DAYTIME:
        modes = basis.render(plant.points_m / instrument.subaperture_m).astype(np.float32)
        played = PlayedTurbulence(modes, plant.weights, passes=scene.passes)
    return Sky(turbulence=Turbulence(layers, sky.seeing), vibrations=vibrations, played=played)


def build_drive(options: Options, instrument: Instrument, basis: ModalBasis) -> MirrorDrive | None:
    """Return what limits and slows the mirror; None for a linear plant's ideal one."""
    devices = options.devices
    if options.plant == "linear" and not devices.needs_drive:
        return None
    return MirrorDrive(
        instrument.analytic_mirror,
        basis.mode_to_actuator,
        frame_rate_hz=options.frame_rate_hz,
        rise_s=devices.rise_s,
        limits=devices.limits,
    )


def binned_basis(instrument: Instrument, basis: ModalBasis, binning: int) -> ModalBasis:
    """Return the same modes in the larger subapertures of a binned sensor.

    They are found with the finest ones: coarser, they could not be told from one another.
    """
    if binning == 1:
        return basis
    surface = mirror_surface(instrument.analytic_mirror, binned(instrument, binning).subaperture_m)
    coefficients = surface.coefficients(basis.mode_to_actuator)
    return replace(basis, surface=surface, coefficients=coefficients)


def build_schedule(options: Options, instrument: Instrument, rng: np.random.Generator) -> Schedule:
    """Return how the registration moves; one that was not given begins near the nominal one."""
    return Schedule(
        start=options.alpha or random_registration(rng, instrument.start.rotation_rad),
        drift=options.drift,
        flexure=options.sky.flexure,
        walk=replace(options.sky.walk, seed=int(rng.integers(2**63))),
        jumps=options.jumps,
    )


def build_detector(
    options: Options, instrument: Instrument, plant: Plant, optics: TelescopeOptics
) -> Detector:
    """Return the detector under the light of these optics."""
    return Detector(
        instrument,
        images=optics.images,
        valid=plant.valid,
        magnitude=options.magnitude,
        frame_rate_hz=options.frame_rate_hz,
        camera=options.devices.camera,
        silent=plant.slope_errors.silent,
    )


def build_feed(
    options: Options,
    plant: Plant,
    sky: Sky,
    optics: MovingOptics,
    detector: Detector,
    rng: np.random.Generator,
    batch_frames: int = BATCH_FRAMES,
) -> Feed:
    """Return what feeds the loop: slopes of a linear plant, phases for any other.

    ``batch_frames`` are a linear plant's: of any other a frame takes milliseconds.
    """
    jump_times_s = tuple(jump.time_s for jump in options.jumps)
    if options.plant == "diffractive":
        return PhaseFeed(
            sky=sky,
            optics=optics,
            detector=PixelDetector(
                electrons_per_light=detector.electrons_per_frame, camera=options.devices.camera
            ),
            frame_rate_hz=options.frame_rate_hz,
            jump_times_s=jump_times_s,
            rng=rng,
        )
    return OpenLoopFeed(
        sky=sky,
        optics=optics,
        sensor_opd_m=plant.sensor_opd_m,
        detector=detector,
        frame_rate_hz=options.frame_rate_hz,
        jump_times_s=jump_times_s,
        rng=rng,
        batch_frames=batch_frames,
    )
