"""Assemble a simulated RTC from its options; takes a few seconds."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal.rtc.identity import Identity, Reconstructor
from service.errors import ConfigurationError, ModelError
from service.files.disk_cache import DiskCache, usual_folder
from service.model.instrument import Instrument, TabulatedModes
from service.model.interaction import RtcInteractionModel
from service.model.kinds import KarhunenLoeve, Normalisation
from service.model.misregistration import Misregistration
from service.model.modes import Basis, ModalBasis, analytic_basis
from service.model.pointing_law import ANGLES
from service.model.pupil import rtc_valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.slopes import Orientation
from sim_rtc.computer.feed import BATCH_FRAMES, Block, Feed, OpenLoopFeed, PhaseFeed, Source
from sim_rtc.computer.gains import by_group
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.computer.reconstructors import (
    ReferenceSchedule,
    identity_of,
    initial_reconstructor,
    own_reconstructor,
)
from sim_rtc.computer.telemetry import LoopSettings
from sim_rtc.held_rate import DITHERED_FROM_HZ, frame_s, held_rate_hz, slow_motion
from sim_rtc.options import Options
from sim_rtc.rehearsal import with_modes
from sim_rtc.telescope.atmosphere import build_layers, compute_fried_parameter_m
from sim_rtc.telescope.detector import Detector, PixelDetector
from sim_rtc.telescope.diffractive import DiffractivePlant
from sim_rtc.telescope.imperfections import Imperfections
from sim_rtc.telescope.influence import read_influence
from sim_rtc.telescope.linear import LinearPlant
from sim_rtc.telescope.measured import (
    MeasuredPlant,
    read_fitted_registration,
    read_measured_matrix,
    sky_diameter,
)
from sim_rtc.telescope.mirror import MirrorDrive
from sim_rtc.telescope.plant import Departures, Optics, Plant
from sim_rtc.telescope.registration import (
    MovingOptics,
    Schedule,
    background_executor,
    far_registration,
    random_registration,
)
from sim_rtc.telescope.scene import PlayedTurbulence, SceneKind
from sim_rtc.telescope.sky import Sky, Turbulence, Vibrations

STROKE_M = 10e-6
"""Largest command of one mode, metres RMS OPD: seven times the tilt of median seeing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Telescope:
    """Everything but the computer: feed, optics, detector."""

    feed: Feed
    plant: Plant
    optics: MovingOptics
    detector: Detector
    identity: Identity
    reconstructor: Reconstructor
    """Matrix in use at the start: for nominal registration, from the nominal model."""

    settings: LoopSettings
    weights: NDArray[np.float64]
    """``(n_points,)`` share of the pupil's area at each point of the plant."""

    mode_to_actuator: NDArray[np.float64] | None
    """``(n_actuators, n_modes)`` of the basis; None if the modes are tables of shapes."""

    drive: MirrorDrive | None
    """Limits and lag of the mirror; None: it obeys at once."""

    reports_asked: bool
    """True if the telemetry has the commands before the mirror's limits."""

    move: Callable[[NDArray[np.float64]], float] | None
    """Moves the mirror's image by ``(4,)``, numeric units, and returns the time of arrival; None if
    the telescope has no such stage."""

    references: ReferenceSchedule | None = None
    """New reference slopes of the RTC; None: it has none."""

    def computer(self, blocks: Iterator[Block]) -> RealTimeComputer:
        """Return a computer that runs on these blocks of the feed."""
        return RealTimeComputer(
            blocks,
            identity=self.identity,
            settings=self.settings,
            reconstructor=self.reconstructor,
            optics=self.optics.at(0.0),
            stroke_m=STROKE_M,
            mode_to_actuator=self.mode_to_actuator,
            drive=self.drive,
            reports_asked=self.reports_asked,
            move=self.move,
            references=self.references,
        )


def _modes(options: Options, instrument: Instrument) -> Basis:
    """Return the modes of the mirror, from the folder in which the service caches its own.

    They are computed for the finest sensor mode, because a coarser one could not distinguish them.
    """
    kept = DiskCache(usual_folder(os.environ)).basis(instrument)
    if isinstance(kept, ModalBasis) or options.plant == "measured":
        return kept
    return analytic_basis(instrument)


def _law_of(options: Options, instrument: Instrument) -> Callable[[float], Misregistration] | None:
    """Return the registration by the pointing law as a function of time, or None.

    Raises
    ------
    ConfigurationError
        If the law uses values of the observatory, which the simulator does not have.
    """
    law, elevation = instrument.law, options.elevation
    if law is None:
        return None
    others = sorted(law.names - set(ANGLES))
    if others:
        raise ConfigurationError(
            f"{instrument.name}: found a law of {', '.join(others)}; the simulated telescope has a "
            f"law of {' and '.join(ANGLES)} alone"
        )

    def nominal(time_s: float) -> Misregistration:
        now = elevation.at(time_s)
        return law.at({"azimuth": now.azimuth_deg, "elevation": now.elevation_deg})

    return nominal


def at_held_rate(options: Options, instrument: Instrument) -> Options:
    """Return the options with the highest frame rate that this machine sustains, at most theirs.

    If that is too low for a dither, the loop keeps the requested rate, in slow motion.
    """
    instrument = _select_mode(options, instrument)
    n_modes = instrument.modes.n_modes
    n_valid = int(rtc_valid_subapertures(instrument).sum())
    one_frame_s = frame_s(
        instrument.slopes.kind.n_planes * n_valid,
        n_modes,
        options.n_controlled(n_modes, most_of(instrument)),
        options.frame_rate_hz,
    )
    held_hz = held_rate_hz(options.frame_rate_hz, one_frame_s)
    if held_hz < min(DITHERED_FROM_HZ, options.frame_rate_hz):
        return replace(options, given_speed=slow_motion(options.frame_rate_hz, one_frame_s))
    return replace(options, frame_rate_hz=held_hz)


def in_sensor_mode(options: Options, instrument: Instrument) -> Instrument:
    """Return the instrument in the requested mode of its sensor, by default the first one.

    Raises
    ------
    ConfigurationError
        If it has no such mode.
    """
    if options.sensor_mode is None:
        return instrument
    try:
        return instrument.in_mode(options.sensor_mode)
    except ModelError as error:
        raise ConfigurationError(f"--sensor-mode: {error}") from error


def most_of(instrument: Instrument) -> int | None:
    """Return the number of modes that the sensor mode permits; None if it states none."""
    if not instrument.sensor_modes or instrument.loop is None:
        return None
    return instrument.loop.n_controlled


def build_telescope(
    options: Options,
    instrument: Instrument,
    executor: Executor | None = None,
    batch_frames: int = BATCH_FRAMES,
) -> Telescope:
    """Return the telescope of these options.

    Optics of later registrations are computed by ``executor``, by default a thread of its own: then
    a movement of the registration may come late. ``batch_frames`` are processed together if the
    plant is linear.

    Raises
    ------
    ConfigurationError
        If the instrument is not simulated, or more modes are to be controlled than it has.
    """
    instrument = _select_mode(options, instrument)
    # A stream for each part: a different plant does not change the sky of the same seed.
    plant_rng, sky_rng, noise_rng, alpha_rng = np.random.default_rng(options.seed).spawn(4)
    basis = _modes(options, instrument)
    n_modes = basis.n_modes
    n_controlled = options.n_controlled(n_modes, most_of(instrument))
    law = _law_of(options, instrument)
    nominal = instrument.start if law is None else law(0.0)
    draw = far_registration if options.far else random_registration
    if options.plant == "measured":  # what is not given is not known: no true one is invented
        start = options.alpha or read_fitted_registration(options.instrument) or nominal
    else:
        start = options.alpha or draw(alpha_rng, nominal.rotation_rad)
    plant = build_plant(options, instrument, basis, plant_rng, start)
    sky = build_sky(options, instrument, basis, plant, sky_rng)

    def prepare(optics: Optics) -> None:
        for _, response in optics.responses if sky.played is None else ():
            sky.turbulence.prepare(response)

    schedule = Schedule(
        start=start,
        corners_s=() if law is None else options.elevation.corners_s,
        # The start contains the law at time 0 already.
        law=None if law is None else lambda time_s: law(time_s).vector - law(0.0).vector,
        drift=options.drift,
        flexure=options.flexure,
        walk=replace(options.walk, seed=int(alpha_rng.integers(2**63))),
        jumps=options.jumps,
    )
    optics = MovingOptics(plant, schedule, executor or background_executor(), prepare=prepare)
    detector = build_detector(options, instrument, plant, optics.start())
    identity = build_identity(options, instrument, plant)
    reconstructor = build_reconstructor(
        options, instrument, basis, plant, identity, n_controlled, nominal
    )
    return Telescope(
        feed=build_feed(options, plant, sky, optics, detector, noise_rng, batch_frames),
        plant=plant,
        optics=optics,
        detector=detector,
        identity=identity,
        reconstructor=reconstructor,
        settings=LoopSettings(
            frame_rate_hz=options.frame_rate_hz,
            delay_frames=options.delay_frames,
            gains=by_group(options.group_gains or (options.gain,) * 3, n_modes),
            leak=options.leak,
            n_controlled_next=n_controlled,
        ),
        weights=plant.weights,
        mode_to_actuator=basis.mode_to_actuator if isinstance(basis, ModalBasis) else None,
        drive=build_drive(options, instrument, basis),
        reports_asked=options.reports_asked,
        move=build_stage(options, optics),
        references=build_references(options, reconstructor),
    )


def _select_mode(options: Options, instrument: Instrument) -> Instrument:
    """Return the instrument in the mode of its sensor that is simulated.

    A measured plant sends what was measured, whatever its order and axes.
    """
    instrument = in_sensor_mode(options, instrument)
    if options.plant == "measured":
        return with_modes(instrument, options.given_modes)
    check_supported(instrument)
    return instrument


def build_detector(
    options: Options, instrument: Instrument, plant: Plant, optics: Optics
) -> Detector:
    """Return the detector: its noise, and the light that the status reports."""
    magnitude = options.magnitude
    if isinstance(plant, MeasuredPlant):
        ratio = (options.sky_diameter_m or sky_diameter(instrument)) / instrument.diameter_m
        # The light grows with the area: 5 log10 of the ratio of diameters in magnitudes.
        magnitude -= 5.0 * math.log10(ratio)
    detector = Detector(
        instrument,
        images=optics.images,
        valid=plant.valid,
        magnitude=magnitude,
        frame_rate_hz=options.frame_rate_hz,
        camera=options.camera,
        silent=plant.slope_errors.silent,
        # the light of a measured matrix was not measured with it
        reports_light=not isinstance(plant, MeasuredPlant),
    )
    # abs, because an orientation may turn signs, and a σ has none.
    detector.sigma = np.abs(plant.sort_rows(detector.sigma))
    return detector


def build_identity(options: Options, instrument: Instrument, plant: Plant) -> Identity:
    """Return the names of system, basis and sensor configuration that the RTC reports."""
    double_pass = options.scene.passes == 2
    if not isinstance(plant, MeasuredPlant):
        return replace(identity_of(instrument, plant.valid), double_pass=double_pass)
    digest = plant.measured.sha256[:8]
    return Identity(
        system=instrument.name,
        basis_id=instrument.basis_id or f"measured-{plant.measured.matrix.shape[1]}-{digest}",
        config_id=instrument.config_id or f"measured-{digest}",
        double_pass=double_pass,
    )


def build_reconstructor(
    options: Options,
    instrument: Instrument,
    basis: Basis,
    plant: Plant,
    identity: Identity,
    n_controlled: int,
    nominal: Misregistration,
) -> Reconstructor:
    """Return the RTC's own reconstructor, in use at the start."""
    if not isinstance(plant, MeasuredPlant):
        return initial_reconstructor(instrument, basis, identity, n_controlled, nominal)
    if options.own_matrix != "model":
        return own_reconstructor(plant.measured.matrix[:, :n_controlled], identity)
    if not plant.knows_orientation:
        raise ConfigurationError(
            f'--own-matrix model: {instrument.name}: found slopes.orientation = "auto"; expected '
            "the orientation that pyrcal fit finds in the measured matrix"
        )
    model = RtcInteractionModel(instrument, basis).interaction_matrix(nominal)
    return own_reconstructor(model[:, :n_controlled], identity, nominal)


def build_references(options: Options, reconstructor: Reconstructor) -> ReferenceSchedule | None:
    """Return the schedule of new reference slopes; None if there is none."""
    if options.references is None:
        return None
    rms_m, period_s = options.references
    return ReferenceSchedule(
        reconstructor.matrix,
        rms_m=rms_m,
        period_s=period_s,
        named_by=options.references_named_by,
        seed=options.seed,
    )


def build_stage(
    options: Options, optics: MovingOptics
) -> Callable[[NDArray[np.float64]], float] | None:
    """Return the device that moves the mirror's image on request."""
    if options.stage is None:
        return None
    obedience, takes_s = options.stage
    return lambda vector: optics.move(obedience * vector, takes_s)


def build_plant(
    options: Options,
    instrument: Instrument,
    basis: Basis,
    rng: np.random.Generator,
    start: Misregistration | None = None,
) -> Plant:
    """Return the plant of these options.

    ``start`` is the registration at which the matrix of a measured plant was taken; None: the
    nominal one.

    Raises
    ------
    ConfigurationError
        If actuators are to fail that the mirror does not have, or the influence functions are not
        of this mirror, or the file of a measured matrix cannot be used.
    """
    if options.matrix is not None:
        measured = read_measured_matrix(options.matrix, instrument, basis, dataset=options.dataset)
        return MeasuredPlant(
            instrument,
            basis,
            measured,
            start=start or instrument.start,
            passes=options.scene.passes,
            sky_diameter_m=options.sky_diameter_m,
            imperfections=options.imperfections,
        )
    if not isinstance(basis, ModalBasis):
        raise ConfigurationError(f"{instrument.name}: found modes without actuators")
    cube, pitch_m = options.influence_cube, options.influence_pitch_m
    made: Departures = {
        "rng": rng,
        "imperfections": departures_of(options, instrument),
        "scene": options.scene,
        "faults": options.mirror_faults,
        "influence": None if cube is None else read_influence(cube, instrument, pitch_m),
    }
    if options.plant == "diffractive":
        return DiffractivePlant(instrument, basis, binning=instrument.binning, **made)
    return LinearPlant(instrument, basis, **made)


def departures_of(options: Options, instrument: Instrument) -> Imperfections:
    """Return the imperfections of the telescope, with an optical gain if it has one.

    A linear plant has the optical gain of a pyramid as a parameter. A centroid moves as far in
    turbulence as without, so its gain is 1 unless another is requested.
    """
    found = options.imperfections
    if options.optical_gain is not None or kind_of(instrument).loses_gain:
        return found
    return replace(found, lowest_optical_gain=1.0, highest_optical_gain=1.0)


def build_sky(
    options: Options,
    instrument: Instrument,
    basis: Basis,
    plant: Plant,
    rng: np.random.Generator,
) -> Sky:
    """Return the turbulence and vibrations on this plant's sensor and mirror."""
    scene, seeing = options.scene, options.seeing
    layers = build_layers(
        options.layers,
        points_m=plant.points_m,
        pitch_m=plant.pitch_m,
        turbulence=KarhunenLoeve(
            r0_m=compute_fried_parameter_m(seeing.start_arcsec), outer_scale_m=options.outer_scale_m
        ),
        rng=rng,
    )
    vibrations = Vibrations(
        options.vibrations,
        points=plant.points_m,
        weights=plant.weights,
        frame_rate_hz=options.frame_rate_hz,
        rng=rng.spawn(1)[0],
    )
    played = None
    if scene.kind is SceneKind.DAYTIME:
        modes = basis.render(plant.points_m / instrument.subaperture_m).astype(np.float32)
        played = PlayedTurbulence(modes, plant.weights, passes=scene.passes)
    return Sky(turbulence=Turbulence(layers, seeing), vibrations=vibrations, played=played)


def build_drive(options: Options, instrument: Instrument, basis: Basis) -> MirrorDrive | None:
    """Return the mirror's limits and lag; None for a linear plant's ideal one.

    Raises
    ------
    ConfigurationError
        If limits are given for a mirror whose actuators are not known.
    """
    if options.plant != "diffractive" and not options.needs_drive:
        return None
    if not isinstance(basis, ModalBasis):
        raise ConfigurationError(
            f"--rise-ms, --actuator-stroke, --actuator-bend: {instrument.name} has tables of "
            "modes; expected actuators (mirror.layout)"
        )
    return MirrorDrive(
        instrument.analytic_mirror,
        basis.mode_to_actuator,
        frame_rate_hz=options.frame_rate_hz,
        rise_s=options.rise_ms * 1e-3,
        limits=options.mirror_limits,
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
    """Return the loop's feed: slopes of a linear plant, phases of any other.

    ``batch_frames`` are a linear plant's: of any other a frame takes milliseconds.
    """
    source: Source = {
        "sky": sky,
        "optics": optics,
        "frame_rate_hz": options.frame_rate_hz,
        "jump_times_s": tuple(jump.time_s for jump in options.jumps),
        "rng": rng,
    }
    if options.plant == "diffractive":
        pixels = PixelDetector(
            electrons_per_light=detector.electrons_per_frame, camera=options.camera
        )
        return PhaseFeed(detector=pixels, **source)
    return OpenLoopFeed(
        sensor_opd_m=plant.sensor_opd_m, detector=detector, batch_frames=batch_frames, **source
    )


def check_supported(instrument: Instrument) -> None:
    """Refuse an instrument whose mirror or telemetry is not simulated.

    Raises
    ------
    ConfigurationError
        If the modes are a table, the mirror is seen from behind, or the slopes are other than the
        conventions' own.
    """
    slopes = instrument.slopes
    found = {
        "measured modes (mirror.modes, mirror.influence_functions)": isinstance(
            instrument.mirror, TabulatedModes
        ),
        "mirror.parity = -1": instrument.mirror.y_sign < 0,
        'wfs.input = "frames"': instrument.frames is not None,
        f'slopes.order = "{slopes.order}"': slopes.order is not slopes.kind.orders[0],
        "another slopes.orientation": slopes.assumed_orientation != Orientation(),
        f'slopes.normalisation = "{slopes.normalisation}"': (
            slopes.normalisation is not Normalisation.GLOBAL
        ),
    }
    for name, is_so in found.items():
        if is_so:
            raise ConfigurationError(
                f"{instrument.name}: found {name}; the simulated telescope has actuators, seen "
                "from the front, and sends slopes as conventions have them"
            )
