"""The live service on a plant that is a measured interaction matrix, in simulated time.

The plant is linear: slopes are ``M (turbulence + command) + noise`` with a matrix M that the
service's model explains only in part. M is a measurement (``--matrix``), or the model's own matrix
at a registration that is hidden from the service, with an error of a given share of the norm of
each mode's column. Half of that error is what a mirror with other influence functions would show,
half a random smooth pattern. The turbulence of each mode is an autoregressive process, and the
RTC starts with the pseudo-inverse of the first columns of M.

With ``--plant diffractive`` the plant is the diffractive simulated telescope, and M is its
interaction matrix by push-pull of 10 nm without noise. The service's instrument file is wrong:
misplaced actuators, another obscuration, another modulation and, in half of the draws from 20 %
on, other influence functions. Together they leave the given share of the columns unexplained at
the true registration. With ``--twin`` the service has the instrument instead that ``pyrcal twin``
makes of the calibration matrix with noise and of the modes' shapes.

With ``--plant measured`` the plant is that of ``pyrcal sim --plant measured`` for the folder of a
twin (``--instrument``), and the service has the twin's instrument.

Run: ``python -m pyrcal_studies.campaign.measured_plant --output var/measured_plant.jsonl --table
table.md``. Rows that are in the file already are not computed again.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from threadpoolctl import threadpool_limits
from typing_extensions import override

import pyrcal
from pyrcal.rtc.identity import Identity, Reconstructor
from pyrcal_studies.campaign.observatory import (
    START_NS,
    Dome,
    Latencies,
    Moment,
    Observatory,
    true_response,
)
from pyrcal_studies.campaign.rows import Row, RowFile, heading, line, tell
from service.config import load_settings
from service.control.loop import pole_radius
from service.estimation.own_matrix import recognise_modes
from service.instrument import load_instrument
from service.instrument.paths import TWIN_LIVE_FILE
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel, RtcInteractionModel
from service.model.kinds import Influence, InfluenceShape
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import analytic_basis, modal_basis
from service.model.pupil import rtc_valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.surface import mirror_surface
from service.records import commands as cmd
from service.records.products import MatrixState
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, OpticsWorker
from service.wire import Status, checksum, decode, encode
from sim_rtc.assembly import Telescope
from sim_rtc.computer.feed import BATCH_FRAMES, Block, OpenLoopBlock
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.computer.reconstructors import own_reconstructor
from sim_rtc.computer.telemetry import Batch, FrameClock, LoopSettings
from sim_rtc.options import Options
from sim_rtc.telescope.diffractive import DiffractiveOptics
from sim_rtc.telescope.linear import LinearOptics

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

INSTRUMENT = "tests/data/bench.toml"
DIFFRACTIVE = "tests/system/small.toml"
"""Instrument of the diffractive plant: pyramid of 12 subapertures, 144 actuators, 90 modes."""

ALPHA = (-0.30, -0.03, -3.1, 1.008)
"""Registration of the plant, boundary units: a bench whose mirror is mounted 3 deg askew."""

FRAME_RATE_HZ = 500.0
GAIN, LEAK, DELAY_FRAMES = 0.4, 0.99, 2
TURBULENCE_M = 336e-9
"""RMS of the turbulence over all modes, metres."""

MEMORY = 0.998
"""Correlation of the turbulence from one frame to the next."""

MAX_DITHER_MODES = 8
"""Modes that the RTC dithers at once, as that of examples/rtc.py."""

SLOPE_NOISE = 2e-3
POKE_M = 10e-9
MIN_GAUSSIAN_ERROR = 0.2
"""Model error from which on an instrument file may have other influence functions: they alone leave
16 to 19 % of the columns."""

N_FIRST = 20
"""Modes that the RTC controls at the start."""

OTHER_COUPLING = 0.15
"""Mechanical coupling of the mirror whose response makes the smooth half of the error."""

TWIN_NOISE = 0.1
"""Noise of the matrix of which a twin is made, over the norm of a mode's column."""

TWIN_POINTS_PER_SUBAPERTURE = 6
"""Sampling of the modes' shapes that a twin is made of."""

LATE_S = 8.0
"""Length of the end of a run over which the wavefront error is taken."""

_BLOCK_FRAMES = 500


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One run of the service on one plant."""

    error: float = 0.2
    """RMS error of the model over the norm of a mode's column."""

    mode: str = "auto"
    plant: str = "linear"
    """"linear", "diffractive", or "measured": the matrix of a twin, whose folder is
    ``instrument``."""

    matrix: str = ""
    """File of a measured matrix, npz with ``D`` (n_slopes, n_modes); empty: made from the model."""

    instrument: str = INSTRUMENT
    seed: int = 1
    n_first: int = N_FIRST
    seconds: float = 36.0
    slope_noise: float = SLOPE_NOISE
    twin: bool = False
    """Whether the service's instrument is the twin of the bench."""

    settings: tuple[tuple[str, float | str | bool], ...] = ()

    @property
    def is_measured(self) -> bool:
        """Whether the plant's matrix is a measured one, whose registration nobody knows."""
        return bool(self.matrix) or self.plant == "measured"


class ModalDome(Dome):
    """A telescope whose response is a given matrix, and whose modes are orthonormal."""

    def __init__(
        self,
        instrument: Instrument,
        response: Array,
        *,
        alpha: Misregistration,
        seed: int = 1,
        slope_noise: float = SLOPE_NOISE,
        n_first: int = N_FIRST,
        own: Array | None = None,
    ) -> None:
        """Take the plant's matrix ``(n_slopes, n_modes)`` and its registration, for the record.

        ``own`` ``(n_first, n_slopes)`` is the reconstructor that the RTC begins with; None: the
        pseudo-inverse of the first columns of the plant's matrix.
        """
        n_modes = response.shape[1]
        self.instrument, self.rate_hz = instrument, FRAME_RATE_HZ
        self.jump_times_s, self.frame, self.moments, self.orders = (), 0, [], []
        self._rng, self._noise = np.random.default_rng(seed), slope_noise
        weights = np.arange(2.0, n_modes + 2.0) ** -0.9
        self._sigma_m = TURBULENCE_M * weights / np.linalg.norm(weights)
        self._turbulence = self._sigma_m * self._rng.standard_normal(n_modes)
        single = np.asfortranarray(response, np.float32)
        self._response = single
        self._optics = LinearOptics(
            alpha=alpha,
            opd_per_command=np.eye(n_modes, dtype=np.float32),
            stuck_opd_m=np.zeros(n_modes, np.float32),
            images=np.zeros((2, 2, 2, 2)),
            slopes_per_command=single,
        )
        identity = Identity(
            system=instrument.name.lower(),
            basis_id=instrument.basis_id or "plant-1",
            config_id=instrument.config_id or "plant-1",
        )
        theirs = np.linalg.pinv(response[:, :n_first]) if own is None else own
        first = theirs.astype(np.float32)
        self.computer = RealTimeComputer(
            self._blocks(),
            identity=identity,
            settings=LoopSettings(
                frame_rate_hz=FRAME_RATE_HZ,
                delay_frames=DELAY_FRAMES,
                gains=(GAIN,) * n_modes,
                leak=LEAK,
                n_controlled_next=n_first,
            ),
            reconstructor=Reconstructor.own(
                f"own-{n_first}-{checksum(first)[:8]}", first, identity, created_ns=START_NS
            ),
            optics=self._optics,
            stroke_m=10e-6,
        )
        self._dt_ns = round(1e9 / FRAME_RATE_HZ)
        self._clock = FrameClock(start_ns_utc=START_NS, dt_ns=self._dt_ns)
        self._block_batches = 5

    @override
    def status(self) -> Status:
        status = self._clock.stamp_status(self.computer.status())
        return decode(Status, encode(replace(status, max_dither_modes=MAX_DITHER_MODES)))

    @override
    def _blocks(self) -> Iterator[Block]:
        frame, response = 0, self._response
        kick = np.sqrt(1.0 - MEMORY**2) * self._sigma_m
        while True:
            wind = np.empty((_BLOCK_FRAMES, len(kick)))
            for row in wind:
                self._turbulence = MEMORY * self._turbulence + kick * self._rng.standard_normal(
                    len(kick)
                )
                row[:] = self._turbulence
            noise = self._noise * self._rng.standard_normal((len(wind), len(response)))
            yield OpenLoopBlock(
                first_frame=frame,
                optics=self._optics,
                phases_m=wind[::BATCH_FRAMES].astype(np.float32),
                slopes=(wind @ response.T + noise).astype(np.float32),
            )
            frame += _BLOCK_FRAMES

    @override
    def _moment(self, batches: list[Batch]) -> Moment:
        errors = [batch.phase_m + batch.commands_m[0] for batch in batches]
        power = np.mean([np.sum(error.astype(float) ** 2) for error in errors])
        last = batches[-1]
        dithers = [np.zeros(1) if b.dither_m is None else b.dither_m for b in batches]
        return Moment(
            time_s=self.time_s,
            alpha=last.optics.alpha,
            wavefront_nm=1e9 * float(np.sqrt(power)),
            n_clipped=sum(batch.n_clipped for batch in batches),
            cm_id=last.cm_id,
            n_controlled=last.n_controlled,
            closed=last.closed,
            dither_nm=1e9
            * float(np.sqrt(np.mean([float(np.sum(d**2)) / len(d) for d in dithers]))),
        )


@lru_cache(maxsize=2)
def models_of(file: str) -> tuple[Instrument, RtcInteractionModel, InteractionModel]:
    """Return the instrument, its model, and the model of a mirror with another coupling."""
    instrument = load_instrument(file)
    basis = analytic_basis(instrument)
    mirror = instrument.analytic_mirror
    other = replace(
        instrument, mirror=replace(mirror, shape=replace(mirror.shape, coupling=OTHER_COUPLING))
    )
    # the same strokes of actuators on a mirror of narrower influence functions
    narrow = basis.of_surface(mirror_surface(other.analytic_mirror, other.subaperture_m))
    return (
        instrument,
        RtcInteractionModel(instrument, basis, pupil_sampling=4, detector_nodes=4),
        RtcInteractionModel(other, narrow, pupil_sampling=4, detector_nodes=4),
    )


def wrong_response(plan: Plan) -> Array:
    """Return a plant ``(n_slopes, n_modes)`` that the model explains but for ``plan.error``."""
    _, model, other = models_of(plan.instrument)
    rng = np.random.default_rng([plan.seed, 36])
    alpha = true_alpha(plan)
    drawn = model.interaction_matrix(alpha).astype(float)
    norm = np.linalg.norm(drawn, axis=0)
    narrow = other.interaction_matrix(alpha).astype(float)
    parts = [narrow - drawn * (np.sum(narrow * drawn, axis=0) / norm**2)]
    # smooth patterns that differ from mode to mode: what neighbouring modes look like
    place = np.arange(drawn.shape[1])
    mix = rng.standard_normal((len(place), len(place)))
    mix *= np.exp(-0.5 * ((place[:, None] - place) / 6.0) ** 2)
    np.fill_diagonal(mix, 0.0)
    parts.append((drawn / norm) @ mix)
    white = rng.standard_normal(drawn.shape)
    parts.append(white)
    shares = np.array([0.6, 0.6, 0.5])
    error: Array = np.sum(
        [
            share * part / np.linalg.norm(part, axis=0)
            for share, part in zip(shares, parts, strict=True)
        ],
        axis=0,
    )
    error /= np.linalg.norm(error, axis=0)
    # the highest modes are explained worst, as on every bench measured so far
    grown = np.linspace(0.8, 1.3, len(place)) * rng.uniform(0.7, 1.3, len(place))
    grown *= plan.error / np.sqrt(np.mean(grown**2))
    gains = rng.uniform(0.9, 1.1, len(place))
    return np.asarray(gains * (drawn + error * norm * grown))


def true_alpha(plan: Plan) -> Misregistration:
    """Return where the mirror of a made plant lies: about ``ALPHA``, another place in each draw."""
    rng = np.random.default_rng([plan.seed, 63])
    spread = np.array([0.2, 0.2, 1.5, 0.006]) * rng.uniform(-1.0, 1.0, 4)
    return Misregistration.from_vector((np.array(ALPHA) + spread) / BOUNDARY_SCALE)


class DiffractiveDome(Dome):
    """The diffractive telescope, whose RTC begins with its own matrix of the true registration."""

    def __init__(self, plan: Plan) -> None:
        """Take the plan of the run."""
        self._n_first = plan.n_first
        alpha = ",".join(f"{value:.6f}" for value in true_alpha(plan).vector * BOUNDARY_SCALE)
        super().__init__(
            f"--plant diffractive --imperfections ideal --instrument {plan.instrument} --mag 8 "
            f"--rate {FRAME_RATE_HZ} --gain {GAIN} --leak {LEAK} --delay {DELAY_FRAMES} "
            f"--n-controlled {plan.n_first} --seed {plan.seed} --alpha={alpha}".split()
        )

    @override
    def _built(self, options: Options) -> Telescope:
        telescope = super()._built(options)
        optics = telescope.optics.start()
        if not isinstance(optics, DiffractiveOptics):
            raise TypeError(f"study: found {type(optics).__name__}; expected diffractive optics")
        self.response = noise_free_matrix(optics)
        first = self.response[:, : self._n_first]
        return replace(telescope, reconstructor=own_reconstructor(first, telescope.identity))


def noise_free_matrix(optics: DiffractiveOptics) -> Array:
    """Return the matrix by push-pull without noise, ``(n_slopes, n_modes)``."""
    rng = np.random.default_rng(0)
    columns = []
    for shape in optics.opd_per_command.T:
        push, pull = (optics.slopes(sign * POKE_M * shape, None, rng) for sign in (1.0, -1.0))
        columns.append((push - pull).astype(float) / (2.0 * POKE_M))
    return np.column_stack(columns)


@lru_cache(maxsize=8)
def _wrong_model(plan: Plan) -> tuple[Instrument, RtcInteractionModel]:
    """Return a wrong instrument and its model, which leave ``plan.error`` of the columns."""
    right, response = load_instrument(plan.instrument), response_of(plan)
    mirror, wfs, alpha = right.analytic_mirror, right.wfs, true_alpha(plan)
    rng = np.random.default_rng([plan.seed, round(100 * plan.error), 36])
    of_places, of_modulation, of_obscuration = rng.uniform(0.5, 1.0, 3)
    of_modulation *= 2.0 * rng.choice([-1.0, 1.0])
    # a shift, a rotation or a magnification of all actuators would be another true registration
    x, y = mirror.positions_m.T
    similarity = np.column_stack([np.ones_like(x), x + 1j * y])
    moved = rng.standard_normal((len(x), 2)) @ [1.0, 1.0j]
    moved = moved - similarity @ np.linalg.lstsq(similarity, moved, rcond=None)[0]
    displacements_m = mirror.pitch_m * np.column_stack([moved.real, moved.imag])
    shape = mirror.shape
    if plan.error >= MIN_GAUSSIAN_ERROR and rng.uniform() < 0.5:
        shape = InfluenceShape(influence=Influence.GAUSSIAN, coupling=OTHER_COUPLING)
    strokes = analytic_basis(right).mode_to_actuator
    key = kind_of(right).find_fitted_key(wfs)

    def make_wrong(size: float) -> tuple[Instrument, RtcInteractionModel]:
        optics = {} if key is None else {key: getattr(wfs, key) * np.exp(size * of_modulation)}
        positions_m = mirror.positions_m + size * of_places * displacements_m
        about = replace(
            right,
            # the RTC's mask is known, whatever else the file has wrong
            wfs=replace(wfs, valid_subapertures=rtc_valid_subapertures(right), **optics),
            obscuration_ratio=right.obscuration_ratio + size * of_obscuration,
            mirror=replace(mirror, shape=shape, positions_m=positions_m, mode_to_actuator=strokes),
        )
        return about, RtcInteractionModel(about, modal_basis(about))

    def excess(size: float) -> float:
        matrix = make_wrong(size)[1].interaction_matrix(alpha).astype(float)
        gains = np.sum(response * matrix, axis=0) / np.sum(matrix**2, axis=0)
        left = np.linalg.norm(response - matrix * gains, axis=0) / np.linalg.norm(response, axis=0)
        return float(np.sqrt(np.mean(left**2))) - plan.error

    return make_wrong(0.0 if excess(0.0) > 0.0 else brentq(excess, 0.0, 0.5, xtol=1e-3))


@lru_cache(maxsize=8)
def _twin_model(plan: Plan) -> tuple[Instrument, RtcInteractionModel]:
    """Return the twin that is made of the bench's files, and its model."""
    right, response = load_instrument(plan.instrument), response_of(plan)
    n = right.wfs.n_subapertures
    side = TWIN_POINTS_PER_SUBAPERTURE * n
    along = ((np.arange(side) + 0.5) / side - 0.5) * n
    y, x = np.meshgrid(along, along, indexing="ij")
    shapes = analytic_basis(right).render(np.column_stack([x.ravel(), y.ravel()]))
    noise = np.random.default_rng([plan.seed, 52]).standard_normal(response.shape)
    noise *= TWIN_NOISE * np.linalg.norm(response, axis=0) / np.sqrt(len(response))
    with tempfile.TemporaryDirectory() as name:
        bench = Path(name) / "bench"
        bench.mkdir()
        np.save(bench / "interaction_matrix.npy", response + noise)
        np.save(bench / "valid.npy", rtc_valid_subapertures(right))
        np.save(bench / "influence_functions.npy", shapes.T.reshape(-1, side, side))
        twin = pyrcal.twin(
            bench,
            bench.with_name("twin"),
            diameter_m=right.diameter_m,
            wavelength_m=right.wfs.wavelength_m,
            stop=str(right.stop),
            unit="m",
            threads=1,
        )
        instrument = load_instrument(twin.folder / TWIN_LIVE_FILE)
    return instrument, RtcInteractionModel(instrument, modal_basis(instrument))


def service_model(plan: Plan) -> tuple[Instrument, RtcInteractionModel]:
    """Return the instrument of the service, and its model."""
    if plan.twin:
        return _twin_model(replace(plan, error=0.0, mode="", seconds=0.0, settings=()))
    if plan.plant == "linear":
        return models_of(plan.instrument)[:2]
    if plan.plant == "measured":
        instrument = load_instrument(Path(plan.instrument) / TWIN_LIVE_FILE)
        return instrument, RtcInteractionModel(instrument, modal_basis(instrument))
    return _wrong_model(replace(plan, mode="", seconds=0.0, n_first=N_FIRST, settings=()))


def dome_of(plan: Plan, response: Array, own: Array | None = None) -> Dome:
    """Return the telescope; ``own`` as for ``ModalDome``."""
    if plan.plant == "diffractive":
        return DiffractiveDome(plan)
    if plan.plant == "measured":
        return Dome(
            f"--plant measured --instrument {plan.instrument} --n-controlled {plan.n_first} "
            f"--seed {plan.seed}".split()
        )
    return ModalDome(
        models_of(plan.instrument)[0],
        response,
        alpha=true_alpha(plan),
        seed=plan.seed,
        slope_noise=plan.slope_noise,
        n_first=plan.n_first,
        own=own,
    )


def response_of(plan: Plan) -> Array:
    """Return the plant's matrix ``(n_slopes, n_modes)``."""
    if plan.plant == "diffractive":
        return DiffractiveDome(plan).response
    if plan.plant == "measured":
        n_modes = service_model(plan)[0].modes.n_modes
        return true_response(dome_of(plan, np.empty(0)).optics, n_modes).astype(float)
    if plan.matrix:
        with np.load(plan.matrix) as file:
            return np.asarray(file["D"], float)
    return wrong_response(plan)


def fitted_alpha(plan: Plan, response: Array) -> Misregistration:
    """Return the registration that best explains all columns of the plant's matrix."""
    _, model = service_model(plan)
    start = model.instrument.start if plan.is_measured else true_alpha(plan)
    found = recognise_modes(
        np.linalg.pinv(response, rcond=1e-6).astype(np.float32), model.linearise, start
    )
    if found is None:
        raise ValueError("plant: found a matrix of zeros; expected a response of each mode")
    return found.alpha


def best_nm(plan: Plan, n_modes: int) -> float:
    """Return the wavefront error with the measured matrix' own inverse of so many modes."""
    seconds = LATE_S + 2.0 if plan.plant == "linear" else plan.seconds
    return _best_nm(replace(plan, mode="", seconds=seconds, n_first=n_modes, settings=()))


@lru_cache(maxsize=16)
def _best_nm(plan: Plan) -> float:
    """Return the same; whatever the service does on this plant, it is computed once."""
    dome = dome_of(plan, response_of(plan))
    while dome.time_s < plan.seconds:
        dome.play()
    return late_nm(dome.moments)


def late_nm(moments: Sequence[Moment]) -> float:
    """Return the RMS wavefront error of the end of a run, nm."""
    end_s = moments[-1].time_s - LATE_S
    return float(np.sqrt(np.mean([m.wavefront_nm**2 for m in moments if m.time_s > end_s])))


def stable_modes(plan: Plan, response: Array, alpha: Misregistration) -> int:
    """Return how many modes the model's reconstructor at ``alpha`` holds on the plant."""
    _, model = service_model(plan)
    matrix, most = model.interaction_matrix(alpha), 0
    for n in range(1, response.shape[1] + 1):
        inverse = np.linalg.pinv(matrix[:, :n], rcond=0.01)
        values = np.linalg.eigvals(GAIN * inverse @ response[:, :n])
        if float(pole_radius(values, leak=LEAK, delay_frames=DELAY_FRAMES).max()) < 0.97:
            most = n
    return most


class Night(Observatory):
    """The service at such a plant; keeps what alarms have said and when."""

    def __init__(self, plan: Plan, response: Array, own: Array | None = None) -> None:
        """Take the plant's matrix and, if it is another than that of the plan, the RTC's own."""
        instrument, _ = service_model(plan)
        settings = load_settings(None, {}, dict(plan.settings))
        self.said: dict[tuple[str, str], float] = {}
        dome = dome_of(plan, response, own)
        dome.instrument = instrument
        super().__init__(
            (),
            policy_of(settings, instrument),
            Mode(plan.mode),
            OpticsWorker(instrument, Compute(threads=1)),
            latencies=Latencies(fit_s=0.1, make_s=0.2, judge_s=0.2, watch_s=0.1, listen_s=0.3),
            with_poles=False,
            dome=dome,
        )

    def pass_(self, until_s: float) -> None:
        """Let time pass; an operator approves in mode propose."""
        while self.time_s < until_s - 1e-9:
            self.advance(0.5)
            for alarm in self.state.alarms.active:
                self.said.setdefault((alarm.name, alarm.text), round(self.time_s, 2))
            if self.state.operator.mode is Mode.PROPOSE:
                for record in self.state.matrices.reconstructors:
                    if record.state is MatrixState.PROPOSED:
                        try:
                            self.command(cmd.Approve(id=record.id, by="study"))
                        except Exception as error:  # noqa: BLE001 - a study that goes on
                            self.said.setdefault(("approve", str(error)), self.time_s)


def play(plan: Plan) -> Row:
    """Run the service on one plant, and return what came of it."""
    begun = time.process_time()
    with threadpool_limits(1):
        response = response_of(plan)
        fit = fitted_alpha(plan, response)
        night = Night(plan, response)
        night.pass_(plan.seconds)
        return {
            **asdict(plan),
            **came_of(plan, night, response, fit),
            "cpu_s": round(time.process_time() - begun, 1),
        }


def came_of(plan: Plan, night: Night, response: Array, fit: Misregistration) -> Row:
    """Return what came of a run."""
    registration, last = night.state.alpha.registration, night.dome.moments[-1]
    row: Row = {"fit": fit.to_boundary()}
    if registration is not None:
        off = registration.alpha.vector - fit.vector
        row |= {
            "alpha": registration.alpha.to_boundary(),
            "off_sigma": (off / registration.sigma).tolist(),
            "sigma": (registration.sigma * BOUNDARY_SCALE).tolist(),
            "off": (off * BOUNDARY_SCALE).tolist(),
            "validity": str(registration.validity.level),
        }
        if not plan.is_measured:  # nobody knows the true registration of a measured one
            error = registration.alpha.vector - true_alpha(plan).vector
            row |= {"error_sigma": (error / registration.sigma).tolist()}
    proposed = [r for r in night.state.matrices.reconstructors if r.parent is not None]
    first_ns = min((r.created_ns_utc for r in proposed), default=None)
    return row | {
        "first_s": None if first_ns is None else (first_ns - START_NS) / 1e9,
        "swaps": [(round(s.time_s, 1), s.n_modes) for s in night.swaps],
        "n_modes": last.n_controlled,
        "n_stable": stable_modes(plan, response, fit),
        "late_nm": late_nm(night.dome.moments),
        "best_nm": best_nm(plan, last.n_controlled),
        "accepted": night.state.windows.accepted,
        "refused": night.state.windows.refused,
        "said": [(at, name, text) for (name, text), at in night.said.items()],
        "hindrance": night.state.matrices.hindrance,
        "closed": last.closed,
        "always_closed": all(moment.closed for moment in night.dome.moments),
        "misfit": night.state.matrices.mode_proof.own_misfit_ratio,
    }


def plans(given: argparse.Namespace) -> list[Plan]:
    """Return the runs that are asked for."""
    diffractive = given.plant == "diffractive"
    return [
        Plan(
            error=error,
            mode=mode,
            plant=given.plant,
            seed=seed,
            matrix=given.matrix,
            instrument=given.instrument or diffractive * DIFFRACTIVE or INSTRUMENT,
            n_first=given.n_first or (60 if diffractive else N_FIRST),
            seconds=given.seconds,
            twin=given.twin,
        )
        for seed in range(given.first, given.first + given.draws)
        for error in given.errors
        for mode in given.modes
    ]


def table(rows: Iterable[Row]) -> str:
    """Return the rows in Markdown."""
    text = heading(
        *("model error", "mode", "draw", "off, σ", "σ", "first matrix", "modes (stable)"),
        *("wavefront (measured matrix)", "windows", "alarms"),
    )
    for row in rows:
        off = "-" if "off" not in row else " ".join(f"{v:+.1f}" for v in row["off_sigma"])
        sigma = "-" if "off" not in row else " ".join(f"{v:.3g}" for v in row["sigma"])
        text += line(
            *(row["matrix"] or f"{row['error']:.0%}", row["mode"], row["seed"], off, sigma),
            "-" if row["first_s"] is None else f"{row['first_s']:.1f} s",
            f"{row['n_modes']} ({row['n_stable']})",
            f"{row['late_nm']:.1f} ({row['best_nm']:.1f}) nm",
            f"{row['accepted']} + {row['refused']}",
            ", ".join(sorted({name for _, name, _ in row["said"]})) or "none",
        )
    return text


def summary(rows: Iterable[Row]) -> str:
    """Return one line for each size of the model error and each mode of the service, Markdown."""
    text = heading(
        *("model error per mode", "service mode", "draws", "difference / σ: RMS", "largest"),
        *("error / σ: RMS", "largest"),
        *("first reconstructor, s: median", "latest", "all stable modes", "wavefront error ratio"),
        *("largest", "runs with an alarm"),
    )
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        kind = Path(row["matrix"]).stem if row["matrix"] else f"{row['error']:.0%}"
        groups.setdefault((kind, row["mode"]), []).append(row)
    for (kind, mode), group in groups.items():
        off = np.array([row["off_sigma"] for row in group if "off_sigma" in row])
        error = np.array([row["error_sigma"] for row in group if "error_sigma" in row])
        first = [row["first_s"] for row in group if row["first_s"] is not None]
        ratio = [row["late_nm"] / row["best_nm"] for row in group]
        n_all = sum(row["n_modes"] == row["n_stable"] for row in group)
        text += line(
            *(kind, mode, len(group)),
            *_rms_and_largest(off),
            *_rms_and_largest(error),
            *(f"{np.median(first):.0f}", f"{max(first):.0f}"),
            f"{n_all} of {len(group)}",
            *(f"{np.median(ratio):.3f}", f"{max(ratio):.3f}"),
            sum(bool(row["said"]) for row in group),
        )
    return text


def _rms_and_largest(errors: Array) -> tuple[str, str]:
    """Return both of errors in σ, in words; of none a dash."""
    if not errors.size:
        return "-", "-"
    return f"{np.sqrt(np.mean(errors**2)):.2f}", f"{np.abs(errors).max():.1f}"


def main() -> int:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(prog="python -m pyrcal_studies.campaign.measured_plant")
    parser.add_argument("--errors", type=float, nargs="+", default=[0.1, 0.2, 0.3, 0.4])
    parser.add_argument("--modes", nargs="+", default=["auto"], help="auto, propose")
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--first", type=int, default=1, help="first draw")
    parser.add_argument("--seconds", type=float, default=36.0, help="of each run")
    parser.add_argument("--plant", choices=["linear", "diffractive", "measured"], default="linear")
    parser.add_argument("--matrix", default="", help="a measured matrix instead, npz with D")
    parser.add_argument("--instrument", help="its instrument file")
    parser.add_argument("--n-first", type=int, help="modes of the RTC's own matrix")
    parser.add_argument("--twin", action="store_true", help="make the service's instrument so")
    parser.add_argument("--output", type=Path, default=Path("measured_plant.jsonl"))
    parser.add_argument("--table", type=Path, metavar="FILE.md")
    given = parser.parse_args()
    file = RowFile(given.output)
    for plan in file.missing(plans(given)):
        file.add(play(plan))
        sys.stderr.write(table(file.rows[-1:]).splitlines()[-1] + "\n")
    tell(summary(file.rows), given.table, "python -m pyrcal_studies.campaign.measured_plant")
    return 0


if __name__ == "__main__":
    sys.exit(main())
