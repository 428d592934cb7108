"""Puts a simulated RTC together from its options; takes a few seconds."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.errors import ConfigurationError
from service.model.instrument import Instrument, KarhunenLoeve
from service.model.interaction import InteractionModel
from service.model.mirror import mirror_surface
from service.model.misregistration import Misregistration
from service.model.modes import ModalBasis, karhunen_loeve_basis
from service.wire import CHUNK_LIMIT, Manifest, layout_of
from sim_rtc.atmosphere import fried_parameter_m, frozen_layers
from sim_rtc.computer import RealTimeComputer
from sim_rtc.detector import Detector
from sim_rtc.diffractive_plant import DiffractivePlant
from sim_rtc.dither import DitherLimits
from sim_rtc.drive import MirrorDrive
from sim_rtc.feed import Block, Feed, OpenLoopFeed
from sim_rtc.gains import by_group
from sim_rtc.influence import read_influence
from sim_rtc.mirror import MirrorFaults
from sim_rtc.motion import MovingOptics, background_executor
from sim_rtc.options import Options
from sim_rtc.phases import PhaseFeed
from sim_rtc.pixels import PixelDetector, binned
from sim_rtc.plant import LinearPlant, Plant
from sim_rtc.reconstructors import Reconstructor, truncated_inverse
from sim_rtc.scene import PlayedTurbulence, SceneKind
from sim_rtc.schedule import Schedule, random_registration
from sim_rtc.sky import Sky, Turbulence
from sim_rtc.telemetry import Identity, LoopSettings
from sim_rtc.vibration import Vibrations

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


def build_telescope(options: Options, instrument: Instrument) -> Telescope:
    """Return the telescope of these options.

    Raises
    ------
    ConfigurationError
        If more modes are to be controlled than the instrument has.
    """
    devices = options.devices
    n_modes = instrument.modes.n_modes
    if options.n_controlled > n_modes:
        raise ConfigurationError(
            f"--n-controlled: found {options.n_controlled}; {instrument.name} has {n_modes} modes"
        )
    plant_rng, sky_rng, noise_rng, alpha_rng = np.random.default_rng(options.seed).spawn(4)
    basis = karhunen_loeve_basis(instrument)
    basis = binned_basis(instrument, basis, devices.binning)
    instrument = binned(instrument, devices.binning)
    plant = build_plant(options, instrument, basis, plant_rng)
    schedule = Schedule(
        start=options.alpha or random_registration(alpha_rng),
        drift=options.drift,
        flexure=options.sky.flexure,
        walk=replace(options.sky.walk, seed=int(alpha_rng.integers(2**63))),
        jumps=options.jumps,
    )
    optics = MovingOptics(plant, schedule, background_executor())
    detector = Detector(
        instrument,
        images=optics.start().images,
        valid=plant.valid,
        magnitude=options.magnitude,
        frame_rate_hz=options.frame_rate_hz,
        camera=devices.camera,
        silent=plant.slope_errors.silent,
    )
    sky = build_sky(options, instrument, basis, plant, sky_rng)
    jump_times_s = tuple(jump.time_s for jump in options.jumps)
    feed: Feed
    if options.plant == "diffractive":
        feed = PhaseFeed(
            sky=sky,
            optics=optics,
            detector=PixelDetector(
                electrons_per_light=detector.electrons_per_frame, camera=devices.camera
            ),
            frame_rate_hz=options.frame_rate_hz,
            jump_times_s=jump_times_s,
            rng=noise_rng,
        )
    else:
        feed = OpenLoopFeed(
            sky=sky,
            optics=optics,
            sensor_opd_m=plant.sensor_opd_m,
            detector=detector,
            frame_rate_hz=options.frame_rate_hz,
            jump_times_s=jump_times_s,
            rng=noise_rng,
        )
    double_pass = options.sky.scene.passes == 2
    identity = replace(identity_of(instrument, plant.valid), double_pass=double_pass)
    return Telescope(
        feed=feed,
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


def build_plant(
    options: Options, instrument: Instrument, basis: ModalBasis, rng: np.random.Generator
) -> Plant:
    """Return the plant of these options, for an instrument that is binned already.

    Raises
    ------
    ConfigurationError
        If actuators are to fail, or pixels to be binned, on a plant that cannot show it, or the
        influence functions are not of this mirror.
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
    if faults != MirrorFaults() or binning > 1:
        raise ConfigurationError(
            "--dead-actuators, --stuck-actuators and a binned sensor (--preset) need "
            "--plant diffractive; found --plant linear"
        )
    return LinearPlant(
        instrument,
        basis,
        rng=rng,
        imperfections=options.sky.imperfections,
        scene=options.sky.scene,
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


def initial_reconstructor(
    instrument: Instrument, basis: ModalBasis, identity: Identity, n_controlled: int
) -> Reconstructor:
    """Return what an observatory has before any flexure: the nominal model's inverse at α = 0."""
    aligned = Misregistration()
    interaction = InteractionModel(instrument, basis).interaction_matrix(aligned)
    matrix = truncated_inverse(interaction[:, :n_controlled])
    layout = layout_of(matrix, CHUNK_LIMIT)
    manifest = Manifest(
        id=f"initial-{n_controlled}-{layout.sha256[:8]}",
        layout=layout,
        alpha=aligned.to_boundary(),
        sigma=None,
        im_id=None,
        parent=None,
        basis_id=identity.basis_id,
        config_id=identity.config_id,
        system=identity.system,
        created_ns=time.time_ns(),
    )
    return Reconstructor(manifest=manifest, matrix=matrix)


def identity_of(instrument: Instrument, valid: NDArray[np.bool_]) -> Identity:
    """Return the names of basis and sensor configuration: they change when either does."""
    mirror, wfs = instrument.analytic_mirror, instrument.wfs
    basis = hashlib.sha256(np.round(mirror.positions_m, 6).tobytes())
    basis.update(repr((mirror.influence, mirror.coupling, instrument.modes)).encode())
    sensor = hashlib.sha256(np.packbits(valid).tobytes())
    sensor.update(
        repr((wfs.wavelength_m, wfs.modulation_lambda_over_d, wfs.pupil_separation_subap)).encode()
    )
    return Identity(
        system=instrument.name,
        basis_id=f"kl-{instrument.modes.n_modes}-{basis.hexdigest()[:8]}",
        config_id=f"pyramid-{wfs.n_subapertures}-{sensor.hexdigest()[:8]}",
    )
