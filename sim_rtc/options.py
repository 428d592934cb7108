"""Every option of the simulated RTC."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import Field, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from service.config.link_tables import DEFAULT_ENDPOINT, Router, router_of
from service.errors import ConfigurationError
from service.instrument.paths import TWIN_MATRIX
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from sim_rtc import arguments as read
from sim_rtc import manual
from sim_rtc.arguments import as_they_are, count, option, several, within
from sim_rtc.faults import Fault, read_fault
from sim_rtc.telescope.atmosphere import PROFILES, Layer
from sim_rtc.telescope.detector import Camera
from sim_rtc.telescope.imperfections import SETS, Imperfections
from sim_rtc.telescope.mirror import MirrorFaults, MirrorLimits
from sim_rtc.telescope.registration import Drift, Flexure, Jump, Walk
from sim_rtc.telescope.scene import Elevation, Scene, SceneKind, Spiders
from sim_rtc.telescope.sky import DAYTIME_LINES, SeeingSchedule, VibrationLine

USUAL_MODES, FAR_MODES = 400, 120
"""Modes in the loop at the start, if the instrument has as many: registered, and far from it."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """The command line: one field an option, then properties derived from several."""

    instrument: str = option(
        "--instrument NAME|FILE",
        "packaged instrument or instrument file",
        default="flao-lbt",
        chapter="instrument and truth",
    )
    sensor_mode: str | None = option(
        "--sensor-mode CONFIG_ID",
        "mode of the sensor, by its name in the instrument file (default: the first there)",
    )
    plant: str = option(
        "--plant",
        "model of the telescope; measured: the interaction matrix of --matrix",
        default="linear",
        choices=["linear", "diffractive", "measured"],
    )
    matrix: Path | None = option(
        "--matrix FILE",
        "measured interaction matrix of --plant measured, as pyrcal import writes it and pyrcal "
        "fit reads it",
        Path,
    )
    dataset: str | None = option(
        "--dataset NAME", "array of that file (default: interaction_matrix)"
    )
    own_matrix: str | None = option(
        "--own-matrix",
        "reconstructor at the start with --plant measured: pseudo-inverse of the first measured "
        "columns, or of the model at the nominal registration (default: measured)",
        choices=["measured", "model"],
    )
    sky_diameter_m: float | None = option(
        "--sky-diameter M",
        "with --plant measured: diameter of the telescope whose turbulence and star the pupil sees "
        "(default: that of the instrument file, or 8 m if that is a bench of less than 0.5 m)",
        within(0.01, 100.0),
    )
    given_modes: int | None = option(
        "--modes N",
        "with --plant measured and the actuators of an instrument file as its basis: number of "
        "Karhunen-Loeve modes that take their place (default: half of the actuators)",
        count(2),
    )
    write_instrument: Path | None = option(
        "--write-instrument FILE",
        "with --plant measured: write the instrument file with which the service is run, without "
        "detector frames and unknown strokes, and end",
        Path,
    )
    alpha: Misregistration | None = several(
        "--alpha X,Y,ROT_DEG,MAG",
        "true registration (default: at random, |shift| <= 0.2, 0.3 deg, 0.5 %%); its anamorphosis "
        "is the instrument file's",
        lambda *boundary: Misregistration.from_vector(np.array(boundary) / BOUNDARY_SCALE),
        limits=", subapertures, degrees and a ratio > 0",
    )
    far: bool = option(
        "--far",
        "begin so far away that few modes can be controlled: a true registration at random, 0.4 "
        "subapertures and 0.65 deg off; at most 120 modes in the loop unless --n-controlled",
        action="store_true",
    )
    jumps: tuple[Jump, ...] = several(
        "--jump T:DX,DY,DROT_DEG,DMAG",
        "sudden change of the registration at T seconds",
        lambda time_s, *change: Jump.of(change, time_s=time_s),
        lambda time_s, *_: time_s > 0.0,
        ", T > 0 seconds",
        many=True,
    )
    drift: Drift = several(
        "--drift DX,DY,DROT_DEG,DMAG",
        "steady change of the registration, per minute",
        lambda *change: Drift.of(change),
        limits=" per minute",
        absent=Drift(),
    )
    flexure: Flexure = several(
        "--flexure DX,DY,DROT_DEG,DMAG:PERIOD_S",
        "sinusoid around the registration, by these amplitudes, period 120 s or longer",
        lambda *found: Flexure.of(found[:4], period_s=found[4]),
        lambda *found: 120.0 <= found[4] <= 86400.0,
        ", 120 to 86400 seconds",
        absent=Flexure(),
    )
    walk: Walk = several(
        "--walk X,Y,ROT_DEG,MAG",
        "random walk: standard deviations after a minute",
        lambda *sigma: Walk.of(sigma),
        lambda *sigma: min(sigma) >= 0.0,
        " after a minute, none negative",
        absent=Walk(),
    )
    pointing: Elevation = several(
        "--elevation DEG[,DEG_PER_MIN]",
        "of the telescope, in the status; what it does to the registration, besides what the "
        "instrument's law of pointing says, is --drift, --jump or --flexure (default: 60)",
        lambda start, rate=0.0: Elevation(start_deg=start, rate_deg_per_minute=rate),
        lambda start, rate=0.0: 0.0 <= start <= 90.0 and abs(rate) <= 10.0,
        ", 0 to 90 degrees and at most 10 per minute either way",
        absent=Elevation(),
    )
    azimuth: tuple[float, float] = several(
        "--azimuth DEG[,DEG_PER_MIN]",
        "of the telescope, in the status (default: 180)",
        lambda start, rate=0.0: (start, rate),
        lambda start, rate=0.0: abs(start) <= 360.0 and abs(rate) <= 60.0,
        ", at most 360 degrees and 60 per minute either way",
        absent=(180.0, 0.0),
    )
    slews: tuple[tuple[float, float], ...] = several(
        "--slew T:DEG",
        "change of elevation that begins at T seconds, 1 deg/s",
        as_they_are,
        lambda time_s, by_deg: time_s > 0.0 and abs(by_deg) <= 90.0,
        ", T > 0 seconds and at most 90 degrees either way",
        many=True,
    )
    truths: tuple[Path | str, ...] = option(
        "--truth FILE", "write the truth there (never on the wire)", read.truth, action="append"
    )
    scene_kind: str = option(
        "--scene",
        "star and atmosphere, or fibre and retro-reflector",
        default=SceneKind.ONSKY.value,
        choices=[kind.value for kind in SceneKind],
        chapter="scene: star and sky, or fibre",
    )
    spiders: Spiders | None = several(
        "--spiders N:WIDTH_M",
        "arms in front of the pupil, evenly spread, the first upwards (default: none)",
        lambda n_arms, width_m: Spiders(n_arms=int(n_arms), width_m=width_m),
        lambda n_arms, width_m: n_arms in range(1, 13) and 0.001 <= width_m <= 1.0,
        ", 1 to 12 arms of 0.001 to 1 m",
    )
    profile: str | None = option(
        "--profile", "named layers of turbulence (default: single)", choices=list(PROFILES)
    )
    later_seeing: tuple[tuple[float, float], ...] = several(
        "--seeing-at T:ARCSEC",
        "seeing at T seconds; it changes smoothly",
        as_they_are,
        lambda time_s, arcsec: time_s > 0.0 and 0.05 <= arcsec <= 5.0,
        ", T > 0 seconds and 0.05 to 5 arcseconds",
        many=True,
    )
    given_vibrations: tuple[VibrationLine | None, ...] = option(
        "--vibration SHAPE:HZ:NM[:DAMPING]",
        "a line on tip, tilt or focus; none: no line",
        read.vibration,
        many=True,
    )
    given_magnitude: float | None = option(
        "--mag R",
        "magnitude of the guide star, or of the fibre (default: 8; by day 7)",
        within(-5.0, 20.0),
    )
    seeing_arcsec: float = option(
        "--seeing ARCSEC",
        "seeing at 500 nm; by day, of what is played",
        within(0.05, 5.0),
        default=1.0,
    )
    outer_scale_m: float = option(
        "--outer-scale M", "outer scale of the turbulence", within(1.0, 1000.0), default=25.0
    )
    wind: tuple[Layer, ...] = several(
        "--wind SPEED,DIR_DEG[,SHARE]",
        "a layer: m/s, direction it moves to, share; up to 3, instead of a profile",
        lambda speed, direction, share=1.0: Layer(
            fraction=share, speed_m_s=speed, direction_deg=direction
        ),
        lambda speed, _, share=1.0: speed > 0.0 < share,
        ", speed > 0 m/s and share > 0",
        many=True,
    )
    seed: int | None = option("--seed N", "of everything random", count(0))
    imperfection_set: str | None = option(
        "--imperfections --truth-model",
        "departures of the telescope from the instrument file (default: usual)",
        choices=list(SETS),
        chapter="imperfections",
    )
    optical_gain: tuple[float, float] | None = several(
        "--optical-gain LOW,HIGH",
        "of the first and the last mode; linear plant only",
        as_they_are,
        lambda *gains: min(gains) > 0.0 and max(gains) <= 1.0,
        ", each > 0 and at most 1",
    )
    unevenness: float | None = option(
        "--unevenness RATIO", "largest departure of the light from its mean", within(0.0, 0.9)
    )
    position_error: float | None = option(
        "--position-error PITCHES", "RMS error of actuator positions per axis", within(0.0, 0.3)
    )
    distortion_subap: float | None = option(
        "--distortion SUBAP", "radial distortion of the pupil image at its edge", within(-2.0, 2.0)
    )
    anamorphosis: float | None = option(
        "--anamorphosis RATIO", "stretch of the pupil image along x", within(-0.1, 0.1)
    )
    modulation_error: float | None = option(
        "--modulation-error RATIO",
        "true modulation over the nominal one, less 1",
        within(-0.5, 1.0),
    )
    slope_rotation_deg: float | None = option(
        "--slope-rotation DEG", "turn of the slope axes, +x towards +y", within(-45.0, 45.0)
    )
    ncpa_nm: float | None = option(
        "--ncpa NM", "static wavefront only the sensor sees, RMS", within(0.0, 300.0)
    )
    ncpa_zernike: int | None = option(
        "--ncpa-zernike NOLL",
        "Noll's number of the polynomial that it consists of, 5 and 6 for astigmatism (default: "
        "random, focus to fourth order)",
        count(2, 66),
    )
    image_offsets_px: tuple[float, ...] | None = several(
        "--image-offsets X1,Y1,X2,Y2,X3,Y3,X4,Y4",
        "displacement of each pupil image of a pyramid from its place on the pixel grid, detector "
        "pixels, of the images at -x -y, +x -y, -x +y, +x +y, less their mean",
        as_they_are,
        lambda *offsets: max(map(abs, offsets)) <= 4.0,
        ", at most 4 pixels either way",
    )
    image_offset_rms_px: float | None = option(
        "--image-offset-rms PX",
        "the same, at random: RMS of the eight numbers",
        within(0.0, 2.0),
    )
    model_error: float | None = option(
        "--model-error RATIO",
        "error of every mode, a smooth pattern of its own, about this share of its slopes; no "
        "registration explains it, and the service does not know it",
        within(0.0, 1.0),
    )
    bad_pixels: int | None = option(
        "--bad-pixels N",
        "dead pixels: dark, and their subapertures read slopes of 0",
        count(0, 100),
    )
    stage: tuple[float, float] | None = several(
        "--stage RATIO[,SECONDS]",
        "a stage moves the mirror's image on request, by so much of what it is asked, in 3 s: "
        "its optics are computed meanwhile, which takes the full instrument 10",
        lambda ratio, seconds=3.0: (ratio, seconds),
        lambda ratio, seconds=3.0: 0.1 <= ratio <= 2.0 and 0.0 <= seconds <= 45.0,
        ", 0.1 to 2 in 0 to 45 seconds",
    )
    frame_rate_hz: float = option(
        "--rate HZ", "frame rate", within(10.0, 4000.0), default=1000.0, chapter="loop"
    )
    held_rate: bool = option(
        "--held-rate",
        "run at the highest frame rate, up to --rate, that this machine holds; below 200 Hz, which "
        "a dither needs, in slow motion instead",
        action="store_true",
    )
    given_gain: float | None = option(
        "--gain G",
        "integrator gain of every controlled mode (default: 0.4; by day 0.2)",
        within(0.0, 2.0),
    )
    group_gains: tuple[float, float, float] | None = several(
        "--gains TIP_TILT,TO_100,REST",
        "gains by group of modes, instead of --gain",
        as_they_are,
        lambda *gains: min(gains) >= 0.0 and max(gains) <= 2.0,
        ", each 0 to 2",
    )
    leak: float = option(
        "--leak L", "share of the command kept from frame to frame", within(0.0, 1.0), default=0.999
    )
    delay_frames: int = option(
        "--delay FRAMES", "from an exposure to the command that answers it", count(1, 10), default=2
    )
    references: tuple[float, float] | None = several(
        "--references NM,SECONDS",
        "new reference slopes every so many seconds, each for another shape of so many nanometres "
        "RMS on the mirror, in low modes at random",
        lambda rms_nm, period_s: (rms_nm * 1e-9, period_s),
        lambda rms_nm, period_s: 0.0 <= rms_nm <= 300.0 and 0.1 <= period_s <= 86400.0,
        ", 0 to 300 nm, every 0.1 to 86400 seconds",
    )
    references_named_by: str = option(
        "--references-named-by",
        "field of frames and status that names them: reference_id, or config_id as in RTCs that "
        "have none",
        default="reference_id",
        choices=["reference_id", "config_id"],
    )
    given_n_controlled: int | None = option(
        "--n-controlled N",
        "modes in the loop at the start (default: 400, or 7 tenths of all)",
        count(1),
    )
    influence_cube: str | None = option(
        "--influence FILE:/DATASET",
        "influence functions (n_actuators, ny, nx) in HDF5, instead of the plant's own",
        read.dataset,
        chapter="mirror",
    )
    influence_pitch_m: float | None = option(
        "--influence-pitch M",
        "distance of their points in the pupil (default: the dataset's attribute pitch_m)",
        within(1e-5, 10.0),
    )
    rise_ms: float = option(
        "--rise-ms MS",
        "time of the mirror from 10 to 90 %% of a step; FLAO's takes 0.7 (default: at once)",
        within(0.0, 100.0),
        default=0.0,
    )
    actuator_stroke_um: float = option(
        "--actuator-stroke UM",
        "largest OPD of one actuator either way (default: %(default)g um)",
        within(0.1, 1000.0),
        default=MirrorLimits().stroke_m / 1e-6,
    )
    actuator_bend_um: float = option(
        "--actuator-bend UM",
        "largest OPD between an actuator and its neighbours' mean (default: %(default)g um)",
        within(0.1, 1000.0),
        default=MirrorLimits().bend_m / 1e-6,
    )
    reports_asked: bool = option(
        "--report-asked",
        "the telemetry has the commands before the mirror's limits, not those that it plays",
        action="store_true",
    )
    dead_actuators: tuple[int, ...] = option(
        "--dead-actuators N,N...",
        "actuators that are switched off and follow their neighbours",
        read.indices,
        absent=(),
    )
    stuck_actuators: tuple[tuple[int, float], ...] = several(
        "--stuck-actuators N:METRES",
        "an actuator that stays at this OPD",
        lambda index, opd_m: (int(index), opd_m),
        lambda index, opd_m: index >= 0.0 and index % 1 == 0.0 and abs(opd_m) <= 1e-4,
        ", an actuator from 0 and at most 1e-4 m of OPD either way",
        many=True,
    )
    read_noise_electrons: float = option(
        "--read-noise E",
        "electrons RMS per pixel",
        within(0.0, 1000.0),
        default=Camera().read_noise_electrons,
        chapter="detector",
    )
    excess_noise: float = option(
        "--excess-noise F2",
        "variance of the photon noise over Poisson's, 2 for an EMCCD",
        within(1.0, 4.0),
        default=1.0,
    )
    given_connect: str | None = option(
        "--connect ENDPOINT",
        f"zenoh endpoint of the service (default: {DEFAULT_ENDPOINT}); may come up later",
        read.endpoint,
        chapter="run",
    )
    config: Path | None = option(
        "--config FILE",
        "settings, TOML: [zenoh] says how to connect to a secured link, as rtc.toml of pyrcal "
        "certificates does",
        Path,
    )
    seconds: float | None = option(
        "--seconds S", "stop after this much loop time", within(0.01, 1e7)
    )
    given_speed: float | None = option(
        "--speed X",
        "loop time over wall-clock time, 0: as fast as it goes (default: 1; diffractive: 0)",
        within(0.0, 100.0),
    )
    quiet: bool = option("--quiet", "say only what is wrong", action="store_true")
    faults: tuple[Fault, ...] = option(
        "--fault KIND@T[:ARGS]",
        "something goes wrong at T seconds, by one of the kinds below",
        read_fault,
        many=True,
        chapter="rehearsal: recording, replay, faults",
    )
    record: Path | None = option(
        "--record FILE", "write all that is sent to this new HDF5 file", Path
    )
    replay: Path | None = option("--replay FILE", "play a recording instead of a telescope", Path)

    @property
    def _by_day(self) -> bool:
        return self.scene_kind == SceneKind.DAYTIME

    @property
    def magnitude(self) -> float:
        """Magnitude of the star or fibre."""
        usual = 7.0 if self._by_day else 8.0
        return usual if self.given_magnitude is None else self.given_magnitude

    @property
    def gain(self) -> float:
        """Gain of every mode; by day, when a command counts twice, half of it."""
        usual = 0.2 if self._by_day else 0.4
        return usual if self.given_gain is None else self.given_gain

    def n_controlled(self, n_modes: int, most: int | None = None) -> int:
        """Return how many of an instrument's modes are in the loop at the start.

        ``most`` is the number that the sensor mode permits; an explicit request may exceed it.

        Raises
        ------
        ConfigurationError
            If more were requested than there are.
        """
        if self.given_n_controlled is None:
            usual = FAR_MODES if self.far else USUAL_MODES
            return min(usual, max(1, 7 * n_modes // 10), most or n_modes)
        if self.given_n_controlled > n_modes:
            raise ConfigurationError(
                f"--n-controlled: found {self.given_n_controlled}; {self.instrument} has "
                f"{n_modes} modes"
            )
        return self.given_n_controlled

    @property
    def router(self) -> Router:
        """The service's router, and what it is shown."""
        return router_of(self.config, self.given_connect)

    @property
    def speed(self) -> float:
        """Loop time over wall-clock time; a diffractive telescope takes the time it needs."""
        usual = 0.0 if self.plant == "diffractive" else 1.0
        return usual if self.given_speed is None else self.given_speed

    @property
    def truth(self) -> Path | None:
        """File of the truth."""
        files = [given for given in self.truths if isinstance(given, Path)]
        if len(files) > 1:
            raise ConfigurationError(f"--truth: found {len(files)} files; expected one")
        return files[0] if files else None

    @property
    def scene(self) -> Scene:
        """The scene: star or fibre, seeing, spider."""
        return Scene(kind=SceneKind(self.scene_kind), spiders=self.spiders)

    @property
    def elevation(self) -> Elevation:
        """Elevation of the telescope over the run."""
        start_deg, rate = self.azimuth
        return replace(
            self.pointing,
            slews=self.slews,
            azimuth_deg=start_deg,
            azimuth_rate_deg_per_minute=rate,
        )

    @property
    def seeing(self) -> SeeingSchedule:
        """The seeing at any time."""
        return SeeingSchedule(start_arcsec=self.seeing_arcsec, later=self.later_seeing)

    @property
    def layers(self) -> tuple[Layer, ...]:
        """Layers of turbulence."""
        n_own = len(self.wind)
        if n_own and self.profile is not None:
            raise ConfigurationError("--profile: found together with --wind; expected one of them")
        if n_own > 3:
            raise ConfigurationError(f"--wind: found {n_own} layers; expected at most 3")
        return self.wind or PROFILES[self.profile or "single"]

    @property
    def vibrations(self) -> tuple[VibrationLine, ...]:
        """Lines of tip, tilt and focus."""
        usual = DAYTIME_LINES if self._by_day and not self.given_vibrations else ()
        lines = tuple(line for line in (*usual, *self.given_vibrations) if line is not None)
        for line in lines:
            if line.frequency_hz >= self.frame_rate_hz / 2:
                raise ConfigurationError(
                    f"--vibration: found {line.frequency_hz:g} Hz; expected less than half the "
                    f"frame rate of {self.frame_rate_hz:g} Hz"
                )
        return lines

    @property
    def imperfections(self) -> Imperfections:
        """A named set of imperfections, with single ones replaced."""
        sets = (*self.truths, self.imperfection_set)
        named = {given for given in sets if isinstance(given, str)}
        if len(named) > 1:
            found = " and ".join(sorted(named))
            raise ConfigurationError(f"--imperfections: found {found}; expected one set")
        changes: dict[str, Any] = {
            one.name: given
            for one in fields(Imperfections)
            if (given := getattr(self, one.name, None)) is not None
        }
        if self.plant == "measured" and (named or changes):
            found = ", ".join(sorted({*named, *changes}))
            raise ConfigurationError(
                f"--plant measured: found imperfections ({found}); expected none but "
                "--optical-gain: the measured matrix has those of the bench"
            )
        if self.image_offsets_px is not None and self.image_offset_rms_px is not None:
            raise ConfigurationError(
                "--image-offset-rms: found together with --image-offsets; expected one of them"
            )
        if self.optical_gain is not None:
            if self.plant == "diffractive":
                raise ConfigurationError(
                    f"--optical-gain: found --plant {self.plant}, whose own light decides it; "
                    "expected --plant linear or measured"
                )
            changes["lowest_optical_gain"], changes["highest_optical_gain"] = self.optical_gain
        usual = "ideal" if self.plant == "measured" else "usual"
        return replace(SETS[named.pop() if named else usual], **changes)

    @property
    def mirror_faults(self) -> MirrorFaults:
        """Actuators that do not obey."""
        return MirrorFaults(dead=self.dead_actuators, stuck=self.stuck_actuators)

    @property
    def mirror_limits(self) -> MirrorLimits:
        """Largest stroke and slope of the mirror."""
        stroke_m, bend_m = self.actuator_stroke_um * 1e-6, self.actuator_bend_um * 1e-6
        return MirrorLimits(stroke_m=stroke_m, bend_m=bend_m)

    @property
    def needs_drive(self) -> bool:
        """Return True if a linear plant must follow its mirror frame by frame."""
        return self.rise_ms > 0.0 or self.mirror_limits != MirrorLimits()

    @property
    def camera(self) -> Camera:
        """The noise of the detector."""
        return Camera(
            read_noise_electrons=self.read_noise_electrons, excess_noise=self.excess_noise
        )

    def check(self) -> None:
        """Check that the options are possible together.

        Raises
        ------
        ConfigurationError
            If they are not: one line that names the option.
        """
        if self.replay is not None and (self.record is not None or self.faults):
            raise ConfigurationError(
                "--replay: plays a file as it is; found --record or --fault too"
            )
        if self.far and self.alpha is not None:
            raise ConfigurationError("--far: found together with --alpha; expected one of them")
        self._check_measured()
        if self.influence_pitch_m is not None and self.influence_cube is None:
            raise ConfigurationError("--influence-pitch: found alone; expected --influence as well")
        for name, value in vars(Options).items():
            if isinstance(value, property):
                getattr(self, name)

    def _check_measured(self) -> None:
        """Refuse options that do not fit together with a measured plant, or without one."""
        if self.plant != "measured":
            options = {
                "--matrix": self.matrix,
                "--dataset": self.dataset,
                "--own-matrix": self.own_matrix,
                "--sky-diameter": self.sky_diameter_m,
                "--modes": self.given_modes,
                "--write-instrument": self.write_instrument,
            }
            _refuse_given(options, "expected --plant measured as well")
            return
        if self.matrix is None:
            raise ConfigurationError("--plant measured: expected --matrix FILE as well")
        unusable = {
            "--far": self.far,
            "--spiders": self.spiders,
            "--influence": self.influence_cube,
            "--dead-actuators": self.dead_actuators,
            "--stuck-actuators": self.stuck_actuators,
        }
        _refuse_given(unusable, "a measured plant is as it was measured; expected another --plant")
        moving = {
            "--jump": self.jumps,
            "--drift": self.drift.vector.any(),
            "--flexure": self.flexure.vector.any(),
            "--walk": self.walk.vector.any(),
            "--stage": self.stage,
        }
        if self.alpha is None:
            reason = "the registration of a measured matrix is not known; expected --alpha with "
            _refuse_given(moving, f"{reason}it, as pyrcal fit finds it in that matrix")


def _refuse_given(options: dict[str, Any], reason: str) -> None:
    """Refuse the first of these options that was given.

    Raises
    ------
    ConfigurationError
        Naming the option and the reason.
    """
    for name, value in options.items():
        if value:
            raise ConfigurationError(f"{name}: {reason}")


def sim_parser() -> manual.Parser:
    """Return the parser of the command line."""
    parser = manual.Parser()
    group: argparse._ActionsContainer = parser
    for one in _option_fields():
        if one.metadata["chapter"] is not None:
            group = parser.add_argument_group(one.metadata["chapter"])
        group.add_argument(*one.metadata["flags"], dest=one.name, **one.metadata["argparse"])
    return parser


def _option_fields() -> list[Field[Any]]:
    return [one for one in fields(Options) if one.metadata]


def parse_options(given: Sequence[str] | None = None) -> Options:
    """Return the options; an impossible one ends the program with one line and status 2."""
    parser, known = sim_parser(), _option_fields()
    found = parser.read(sys.argv[1:] if given is None else given)
    for one in known:
        if one.metadata["argparse"].get("action") == "append":
            found[one.name] = tuple(found[one.name] or ())
        elif found[one.name] is None:
            found[one.name] = one.metadata["absent"]
    # The folder of a twin has its matrix.
    matrix = Path(found["instrument"]) / TWIN_MATRIX
    if found["plant"] == "measured" and found["matrix"] is None and matrix.is_file():
        found["matrix"] = matrix
    try:
        options = Options(**found)
        options.check()
    except ConfigurationError as error:
        parser.error(str(error))
    return options


if __name__ == "__main__":  # whether options make sense, for who would start the simulator later
    parse_options()
