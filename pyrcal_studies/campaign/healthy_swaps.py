"""Try probation on healthy swaps in turbulence that changes, and on matrices that are worse.

Run: ``python -m pyrcal_studies.campaign.healthy_swaps --plant outside --healthy 140 --worse 40
--diverging 20 --output var/healthy_swaps.jsonl``. Plants: ``outside`` has optics, modes and
turbulence of its own (8 m, 16 x 16 subapertures, Gaussian influence functions, mean gradients,
frozen von Karman screens made by Fourier transform); ``linear`` and ``diffractive`` are the
simulator's small telescope of 3 m.

A healthy swap replaces the matrix of a slightly misregistered mirror by the right one. The seeing
changes by a factor of two in 10 s, the wind is 5 to 30 m/s, the frame rate 200 to 2000 Hz, and a
gust raises the residual 1.6 times for one second at a random moment around the swap. A worse
matrix raises the residual of the same stretch of turbulence by 1.5; a diverging one makes the loop
unstable. Telemetry goes to the service's own comparison, in blocks of 50 ms, and to its watch of
the loop and (of the simulator's telescope) of commands that are not played, which must raise no
alarm while a healthy matrix is in use.

A healthy swap on the simulator's telescope that is judged worse is played once more with the matrix
before under the new id. If that is judged worse too, the turbulence has lost the loop and the
matrix is not the cause (``unchanged_verdict``, and the true wavefront errors of both).
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import SMALL, Dome, bench_of
from pyrcal_studies.campaign.rows import RowFile
from service.control.reconstructor import Recipe, reconstruct
from service.estimation import health
from service.estimation.comparison import REFERENCE_PERIOD_S, Verdict
from service.estimation.description import actuator_watch
from service.estimation.frames import FrameBlock
from service.estimation.health import LoopHealth, PlayedCommands, observe_played
from service.estimation.probation import Comparison, observe
from service.model.misregistration import Misregistration
from service.tracking import alarms

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

RATES_HZ = (200.0, 500.0, 1000.0, 2000.0)
WINDS_M_S = (5.0, 30.0)
SEEING_ARCSEC = (0.6, 1.1)
SEEING_DOUBLES_S = 10.0
GUST_RATIO = 1.6
GUST_S = 1.0
GUST_FROM_S = (-4.0, 4.5)
"""When a gust begins, after the swap."""

BEFORE_S = (2.0, 10.0)
"""Telemetry with the matrix before."""

AFTER_S = 6.0
CLOSING_S = 0.5
"""The loop closes in it; its telemetry is not shown."""

SLOW_SHARES = (0.2, 0.12)
"""Of the loop gain, in a worse matrix of the simulator's telescope."""

BLOCK_S = 0.05
WORSE_RATIO = 1.5
DELAY_FRAMES = 2
LIMIT_M = 2e-5
"""Commands are clipped there: the loop that diverges does not overflow."""

# The simulator's telescope
N_SMALL = 60
SWAP_EVERY_S = 6.0
SWAPS_A_NIGHT = 10
SWAPS_A_HARD_NIGHT = 2
GUST_SEEING = GUST_RATIO ** (6 / 5)
"""Of the seeing: the wavefront goes with its power of 5/6."""

# The outside plant
N_SUBAP = 16
PX = 2
"""Grid steps in one subaperture."""

SUBAP_M = 0.5
N_MODES = 150
N_CONTROLLED = 120
OUTER_SCALE_M = 25.0
START = (0.14, 0.0, np.deg2rad(0.3))
"""Shift in subapertures and rotation of the mirror, unknown to the matrix before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One swap."""

    seed: int
    plant: str
    kind: str
    """``healthy``, ``worse`` or ``diverging``."""

    rate_hz: float
    wind_m_s: float
    seeing_arcsec: float
    seeing_trend: int
    """1: it doubles in 10 s; -1: it halves; 0: it stays."""

    gust: str
    """``seeing``, ``wind``, ``vibration``, ``residual`` or ``none``."""

    gust_from_s: float
    before_s: float
    gain: float
    noise: float
    """RMS noise of a slope over the RMS slope of the residual in the outside plant."""


def drawn(plant: str, kind: str, seed: int) -> Trial:
    """Return a trial of random conditions."""
    rng = np.random.default_rng([seed, 37])
    gusts = ("seeing", "wind", "vibration", "residual")
    return Trial(
        seed=seed,
        plant=plant,
        kind=kind,
        rate_hz=float(rng.choice(RATES_HZ)),
        wind_m_s=float(rng.uniform(*WINDS_M_S)),
        seeing_arcsec=float(rng.uniform(*SEEING_ARCSEC)),
        seeing_trend=int(rng.integers(-1, 2)),
        gust=str(rng.choice(gusts)) if kind == "healthy" else "none",
        gust_from_s=float(rng.uniform(*GUST_FROM_S)),
        before_s=float(rng.uniform(*BEFORE_S)),
        gain=float(rng.uniform(0.3, 0.6)),
        noise=float(rng.uniform(0.1, 1.0)),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Optics:
    """The outside plant's sensor and mirror."""

    subapertures: NDArray[np.intp]
    """``(n, 2)`` row and column of the valid ones."""

    pupil: NDArray[np.bool_]
    modes: Array
    """``(n_points, N_MODES)`` over the pupil's points."""

    response: Array
    """``(n_slopes, N_MODES)`` of the mirror as it truly is."""

    nominal: Array


@cache
def outside_optics() -> Optics:
    """Return the outside plant."""
    half = N_SUBAP / 2
    edges = np.arange(-half, half + 0.5 / PX, 1.0 / PX)
    y, x = np.meshgrid(edges, edges, indexing="ij")
    pupil = np.hypot(x, y) <= half
    centres = np.arange(N_SUBAP) - half + 0.5
    cy, cx = np.meshgrid(centres, centres, indexing="ij")
    rows = np.argwhere((np.hypot(cx, cy) <= half - 0.4) & (np.hypot(cx, cy) > 1.0))
    actuators = np.argwhere(np.hypot(*np.meshgrid(*2 * [np.arange(-9, 10)])) <= half + 1.0) - 9.0

    def surfaces(shift_x: float, shift_y: float, rotation: float) -> Array:
        c, s = np.cos(rotation), np.sin(rotation)
        ay, ax = actuators.T
        px, py = c * ax - s * ay + shift_x, s * ax + c * ay + shift_y
        square = (x[..., None] - px) ** 2 + (y[..., None] - py) ** 2
        return np.asarray(0.3**square)

    true, nominal = surfaces(*START), surfaces(0.0, 0.0, 0.0)
    flat = nominal[pupil] - nominal[pupil].mean(axis=0)
    _, sizes, right = np.linalg.svd(flat, full_matrices=False)
    to_actuators = right[:N_MODES].T / sizes[:N_MODES] * np.sqrt(pupil.sum())
    return Optics(
        subapertures=rows,
        pupil=pupil,
        modes=true[pupil] @ to_actuators,
        response=np.asarray(_slopes(np.moveaxis(true @ to_actuators, -1, 0), rows).T),
        nominal=np.asarray(_slopes(np.moveaxis(nominal @ to_actuators, -1, 0), rows).T),
    )


def _slopes(phase: Array, rows: NDArray[np.intp]) -> Array:
    """Return ``(n, n_slopes)`` mean gradients of ``(n, ny, nx)``, per subaperture."""
    y0, x0 = rows.T * PX
    weight = np.array([0.5, 1.0, 0.5]) / PX

    def side(dy: int, dx: int, *, along_y: bool) -> Array:
        if along_y:
            parts = [w * phase[:, y0 + k, x0 + dx] for k, w in enumerate(weight)]
        else:
            parts = [w * phase[:, y0 + dy, x0 + k] for k, w in enumerate(weight)]
        return np.asarray(np.sum(parts, axis=0))

    gx = side(0, PX, along_y=True) - side(0, 0, along_y=True)
    gy = side(PX, 0, along_y=False) - side(0, 0, along_y=False)
    return np.concatenate([gx, gy], axis=1)


def _screen(rng: np.random.Generator, n_along: int, n_across: int, r0_m: float) -> Array:
    """Return a periodic von Karman screen, metres of optical path at any wavelength."""
    pitch = SUBAP_M / PX
    fy, fx = np.meshgrid(
        np.fft.fftfreq(n_across, pitch), np.fft.rfftfreq(n_along, pitch), indexing="ij"
    )
    power = 0.0229 * r0_m ** (-5 / 3) * (fx**2 + fy**2 + OUTER_SCALE_M**-2) ** (-11 / 6)
    power[0, 0] = 0.0
    white = np.fft.rfft2(rng.standard_normal((n_across, n_along)))
    phase = np.fft.irfft2(white * np.sqrt(power) / pitch, s=(n_across, n_along))
    return np.asarray(phase * 500e-9 / (2.0 * np.pi))


class OutsideTurbulence:
    """Two frozen layers, along x and along y, as slopes and as a wavefront."""

    def __init__(self, trial: Trial, optics: Optics) -> None:
        rng, self._optics = np.random.default_rng([trial.seed, 1]), optics
        r0_m = 0.98 * 500e-9 / (trial.seeing_arcsec * np.pi / 180 / 3600)
        n = N_SUBAP * PX + PX
        self._layers = [
            np.asarray(np.sqrt(share) * _screen(rng, 4096, 128, r0_m)[:n], np.float32)
            for share in (0.7, 0.3)
        ]

    def at(self, travelled_m: Array, *, every: int) -> tuple[Array32, Array32]:
        """Return slopes ``(n, n_slopes)`` of each position, and every n-th wavefront's points."""
        position = travelled_m / (SUBAP_M / PX)
        y, x = self._optics.subapertures.T * PX
        rows, columns = np.nonzero(self._optics.pupil)
        one, other = self._layers
        gx, gy = _gradients(one)
        hy, hx = _gradients(other)  # this one lies on its side
        slopes = np.concatenate(
            [
                _moved(gx, y, x, position) + _moved(hx, x, y, 0.6 * position),
                _moved(gy, y, x, position) + _moved(hy, x, y, 0.6 * position),
            ],
            axis=1,
        )
        some = position[::every]
        points = _moved(one, rows, columns, some) + _moved(other, columns, rows, 0.6 * some)
        return slopes, points


def _gradients(screen: Array32) -> tuple[Array32, Array32]:
    """Return the mean gradients along columns and rows of a subaperture that begins there."""
    low, middle, high = (np.roll(screen, -k, axis=1) for k in range(3))
    across = (0.5 * low + middle + 0.5 * high) / PX
    along = screen[:-PX] * 0.5 + screen[1 : 1 - PX] + screen[PX:] * 0.5
    along /= PX
    gx = np.roll(along, -PX, axis=1) - along
    return np.asarray(gx, np.float32), np.asarray(across[PX:] - across[:-PX], np.float32)


def _moved(
    layer: Array32, rows: NDArray[np.intp], columns: NDArray[np.intp], position: Array
) -> Array32:
    """Return ``(n, n_points)`` of a layer that has moved so many grid steps."""
    whole = np.floor(position).astype(int)
    share = np.asarray(position - whole, np.float32)[:, None]
    flat, n = layer.ravel(), layer.shape[1]
    at = (whole[:, None] + columns) % n
    after = np.where(at == n - 1, 1 - n, 1)
    start = at + rows * n
    return np.asarray(flat[start] * (1 - share) + flat[start + after] * share, np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sky:
    """What comes to the outside plant: the same for every matrix that is tried on it."""

    slopes: Array32
    points: Array32
    noise: Array32
    n_before: int
    every: int


def _profile(trial: Trial, t_s: Array) -> tuple[Array, Array]:
    """Return strength of the turbulence and wind, both relative, after the swap's time."""
    strength = 2.0 ** (trial.seeing_trend * t_s / SEEING_DOUBLES_S * 5 / 6)
    blows = (t_s >= trial.gust_from_s) & (t_s < trial.gust_from_s + GUST_S)
    wind = np.ones_like(t_s)
    if trial.gust == "seeing":
        strength = np.where(blows, GUST_RATIO * strength, strength)
    if trial.gust == "wind":
        wind = np.where(blows, GUST_RATIO ** (6 / 5), wind)
    return strength, wind


def sky_of(trial: Trial, optics: Optics) -> Sky:
    """Return the turbulence and noise of a trial."""
    rng = np.random.default_rng([trial.seed, 2])
    n_before = round(trial.before_s * trial.rate_hz)
    n_frames = n_before + round(AFTER_S * trial.rate_hz)
    t_s = (np.arange(n_frames) - n_before) / trial.rate_hz
    strength, wind = _profile(trial, t_s)
    travelled = np.cumsum(wind) * trial.wind_m_s / trial.rate_hz
    every = max(round(trial.rate_hz / 100), 1)
    slopes, points = OutsideTurbulence(trial, optics).at(travelled, every=every)
    slopes *= np.asarray(strength, np.float32)[:, None]
    points *= np.asarray(strength, np.float32)[::every, None]
    noise = rng.standard_normal(slopes.shape, np.float32)
    return Sky(slopes=slopes, points=points, noise=noise, n_before=n_before, every=every)


def _added_gust(trial: Trial, sky: Sky, optics: Optics, calm: Played) -> Sky:
    """Return the sky with a gust that no model of turbulence explains: residual or vibration."""
    if trial.gust not in {"residual", "vibration"}:
        return sky
    t_s = (np.arange(len(sky.slopes)) - sky.n_before) / trial.rate_hz
    blows = (t_s >= trial.gust_from_s) & (t_s < trial.gust_from_s + GUST_S)
    rng = np.random.default_rng([trial.seed, 3])
    wanted_m = calm.residual_m * np.sqrt(GUST_RATIO**2 - 1.0)
    n = N_CONTROLLED if trial.gust == "residual" else 2
    if trial.gust == "vibration":
        turns = 25.0 / trial.rate_hz
        extra = np.sin(2 * np.pi * np.outer(np.arange(len(t_s)) * turns, [1.0, 1.2]))
    else:
        turns = min(40.0 / trial.rate_hz, 0.1)
        pole = np.exp(-2 * np.pi * turns)
        extra = scipy.signal.lfilter([1.0], [1.0, -pole], rng.normal(size=(len(t_s), n)), axis=0)
    spectrum = calm.spectrum[:n] if trial.gust == "residual" else np.ones(n)
    extra *= spectrum / np.sqrt(np.sum(np.mean(extra**2, axis=0) * spectrum**2))
    # the loop takes some of it: about what it leaves of that frequency
    extra *= wanted_m * blows[:, None]
    extra = np.asarray(extra, np.float32)
    added = extra @ optics.response[:, :n].T
    points = sky.points + extra[:: sky.every] @ optics.modes[:, :n].T
    return replace(
        sky,
        slopes=np.asarray(sky.slopes + added, np.float32),
        points=np.asarray(points, np.float32),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Played:
    """Telemetry of a loop, and the truth."""

    slopes: Array32
    commands_m: Array32
    true_m: Array
    """RMS wavefront of every n-th frame, in what the controlled modes hold."""

    residual_m: float
    spectrum: Array


def play(trial: Trial, sky: Sky, optics: Optics, before: Array, after: Array) -> Played:
    """Let the loop run with one matrix and then the other."""
    n, gain = len(sky.slopes), trial.gain
    level = trial.noise * 0.3 * float(np.sqrt(np.mean(np.diff(sky.slopes[:400:4], axis=0) ** 2)))
    seen = sky.slopes + level * sky.noise
    d = optics.response[:, :N_CONTROLLED]
    read = np.concatenate([seen[: sky.n_before] @ before.T, seen[sky.n_before :] @ after.T])
    inner = {False: before @ d, True: after @ d}
    commands = np.zeros((n + DELAY_FRAMES, N_CONTROLLED))
    for k in range(n):
        error = read[k] + inner[k >= sky.n_before] @ commands[k]
        following = 0.999 * commands[k + DELAY_FRAMES - 1] - gain * error
        commands[k + DELAY_FRAMES] = np.clip(following, -LIMIT_M, LIMIT_M)
    commands = commands[:n]
    left = sky.points + commands[:: sky.every] @ optics.modes[:, :N_CONTROLLED].T
    left -= left.mean(axis=1, keepdims=True)
    fitted = left @ _projector(optics)
    calm = fitted[: sky.n_before // sky.every][-300:]
    padded = np.pad(commands, ((0, 0), (0, N_MODES - N_CONTROLLED)))
    return Played(
        slopes=np.asarray(seen + commands @ d.T, np.float32),
        commands_m=np.asarray(padded, np.float32),
        true_m=np.sqrt(np.sum(fitted**2, axis=1)),
        residual_m=float(np.sqrt(np.mean(np.sum(calm**2, axis=1)))),
        spectrum=np.sqrt(np.mean(calm**2, axis=0)),
    )


@cache
def _projector(optics: Optics) -> Array:
    return np.asarray(np.linalg.pinv(optics.modes[:, :N_CONTROLLED]).T)


def matrix_of(response: Array) -> Array:
    """Return the reconstructor of the controlled modes."""
    return np.asarray(np.linalg.pinv(response[:, :N_CONTROLLED], rcond=0.03))


def blocks_of(trial: Trial, played: Played, n_before: int) -> Iterator[FrameBlock]:
    """Yield the telemetry as the link hands it on."""
    n, step = len(played.slopes), max(round(BLOCK_S * trial.rate_hz), 1)
    cuts = sorted({*range(round(CLOSING_S * trial.rate_hz), n, step), n_before, n})
    dt_ns = round(1e9 / trial.rate_hz)
    for first, end in itertools.pairwise(cuts):
        yield FrameBlock(
            session="s",
            first_seq=first,
            t0_ns_utc=first * dt_ns,
            dt_ns=dt_ns,
            slopes=played.slopes[first:end],
            commands_m=played.commands_m[first:end],
            dither_m=None,
            cm_id="before" if first < n_before else "after",
        )


def outside_trial(trial: Trial) -> dict[str, object]:
    """Swap the right matrix in, or a worse one, and return what the comparison finds."""
    optics = outside_optics()
    before, right = matrix_of(optics.nominal), matrix_of(optics.response)
    sky = sky_of(trial, optics)
    healthy = play(trial, sky, optics, before, right)
    if trial.kind == "healthy":
        sky = _added_gust(trial, sky, optics, healthy)
        tried = play(trial, sky, optics, before, right)
        return _row(trial, judge(trial, tried, sky.n_before, before, right), ratio=1.0)
    way = ("slow", "strong", "registration")[trial.seed % 3]
    if trial.kind == "diverging":
        after = right * 4.0 if way == "strong" else _flipped(right, trial.seed % N_CONTROLLED)
        tried = play(trial, sky, optics, before, after)
        return _row(trial, judge(trial, tried, sky.n_before, before, after), way=way)
    low, high = 0.0, 1.0
    for _ in range(6):
        middle = (low + high) / 2
        after = _worse(optics, right, way, middle)
        tried = play(trial, sky, optics, before, after)
        ratio = _true_ratio(healthy, tried, sky, trial)
        low, high = (middle, high) if ratio < WORSE_RATIO else (low, middle)
    after = _worse(optics, right, way, high)
    tried = play(trial, sky, optics, right, after)
    ratio = _true_ratio(healthy, tried, sky, trial)
    return _row(trial, judge(trial, tried, sky.n_before, right, after), way=way, ratio=ratio)


def _true_ratio(healthy: Played, tried: Played, sky: Sky, trial: Trial) -> float:
    """Return the true RMS of the controlled modes over that of the right matrix, 4 s after."""
    first = (sky.n_before + round(0.1 * trial.rate_hz)) // sky.every
    last = (sky.n_before + round(4.0 * trial.rate_hz)) // sky.every
    rms = [np.sqrt(np.mean(np.square(p.true_m[first:last]))) for p in (tried, healthy)]
    return float(rms[0] / rms[1])


def _worse(optics: Optics, right: Array, way: str, much: float) -> Array:
    if way == "slow":
        return right * (1.0 - 0.9 * much)
    if way == "strong":
        return right * (1.0 + 3.0 * much)
    turned = optics.response + 6.0 * much * (optics.nominal - optics.response)
    return matrix_of(turned)


def _flipped(matrix: Array, mode: int) -> Array:
    flipped = matrix.copy()
    flipped[mode] *= -1.0
    return flipped


Watched = tuple[Comparison, frozenset[str]]
"""A comparison that has ended, and the alarms that the watch of the loop raised meanwhile."""


def judge(trial: Trial, played: Played, n_before: int, before: Array, after: Array) -> Watched:
    """Return the comparison after it has seen all telemetry, or found something."""
    state, loop, modes = Comparison(), LoopHealth(), np.arange(N_CONTROLLED)
    variance = np.mean(np.square(played.commands_m[:n_before], dtype=float), axis=0)
    matrices = {"before": np.asarray(before, np.float32), "after": np.asarray(after, np.float32)}
    raised: frozenset[str] = frozenset()
    for block in blocks_of(trial, played, n_before):
        state = observe(state, block, modes, matrix=matrices[str(block.cm_id)])
        loop = health.observe(loop, block, variance, modes)
        raised |= {alarms.DIVERGING} if loop.diverging else set()
        if state.found is not None and trial.kind != "healthy":
            break
    return state, raised


def _row(trial: Trial, watched: Watched, **more: object) -> dict[str, object]:
    state, raised = watched
    found = state.found
    row = asdict(trial) | more | {"alarms": sorted(raised)}
    if found is None:
        return row | {"verdict": "none"}
    return row | {
        "verdict": found.verdict.value,
        "after_s": found.after_s,
        "residual_ratio": found.residual_ratio,
        "residual_limit": found.residual_limit,
        "mode_ratio": found.mode_ratio,
        "limit": found.limit,
        "common_ratio": found.common_ratio,
        "text": found.text,
    }


class SimulatedNight:
    """The simulator's small telescope, with a swap every few seconds."""

    def __init__(self, trial: Trial, n_swaps: int) -> None:
        self._rng = np.random.default_rng([trial.seed, 4])
        self._trial = trial
        words = [
            f"--instrument={SMALL}",
            f"--plant={trial.plant}",
            f"--n-controlled={N_SMALL}",
            f"--gain={trial.gain}",
            f"--rate={trial.rate_hz:g}",
            f"--wind={trial.wind_m_s:.1f},20",
            f"--seed={trial.seed}",
            "--mag=8",
            f"--seeing={trial.seeing_arcsec:.2f}",
            *self._seeing_words(n_swaps),
        ]
        if trial.plant == "linear":
            words.append("--optical-gain=0.7,0.9")
        else:
            words.append("--imperfections=realistic")
        self.dome, self._n_swaps, self._n_planned = Dome(words), 0, n_swaps
        self._matrices: dict[str | None, Array32] = {}
        about = bench_of(SMALL).describe()
        self._variance = about.mode_variance_m2
        self._watch = (
            actuator_watch(about.actuators, self._variance, np.arange(N_SMALL))
            if about.actuators is not None
            else None
        )
        self.loop, self.played = LoopHealth(), PlayedCommands()
        self.alarms: frozenset[str] = frozenset()
        self.state = Comparison()
        self._swap(self._matrix(0.1))
        self._pass(CLOSING_S)
        self.state = Comparison()
        self._pass(SWAP_EVERY_S - CLOSING_S)

    def swaps(self, n: int) -> Iterator[dict[str, object]]:
        """Swap right matrices and slightly misregistered ones in, in turns."""
        for k in range(n):
            row = self._swap_row(k, self._matrix(0.1 if k % 2 else 0.0))
            if row["verdict"] == Verdict.WORSE:
                row |= SimulatedNight(self._trial, self._n_planned).unchanged(k)
            yield row

    def unchanged(self, k: int) -> dict[str, object]:
        """Play the night as far as swap ``k`` and leave its matrix in use under the new id."""
        for earlier in range(k):
            self._swap_row(earlier, self._matrix(0.1 if earlier % 2 else 0.0))
        row = self._swap_row(k, next(reversed(self._matrices.values())))
        return {f"unchanged_{key}": row[key] for key in ("verdict", "text", "after_nm")}

    def _swap_row(self, k: int, matrix: Array32) -> dict[str, object]:
        """Swap a matrix in, let the time until the next pass, and return what is found."""
        begun_s, found_before = self.dome.time_s, self.state.found
        before_nm = self._wavefront_nm(REFERENCE_PERIOD_S)
        self._swap(matrix)
        self._pass(SWAP_EVERY_S)
        found = self.state if self.state.found is not found_before else Comparison()
        after_nm = self._wavefront_nm(SWAP_EVERY_S)
        more = {"swap_s": begun_s, "swap": k, "before_nm": before_nm, "after_nm": after_nm}
        return _row(self._trial, (found, self.alarms), **more)

    def worse(self, share: float, healthy_nm: float | None = None) -> dict[str, object]:
        """Swap a matrix of so much of the loop gain in.

        The ratio is that of the wavefront error to ``healthy_nm``, of the same night with the right
        matrix, or to that before the swap.
        """
        before_nm = self._wavefront_nm(REFERENCE_PERIOD_S)
        right = next(reversed(self._matrices.values()))
        self._swap(np.asarray(share * right, np.float32))
        self._pass(4.5)
        ratio = self._wavefront_nm(4.0) / (before_nm if healthy_nm is None else healthy_nm)
        return _row(self._trial, (self.state, self.alarms), way="slow", ratio=ratio)

    def healthy_nm(self) -> float:
        """Return the wavefront error of the 4 s after a swap to the same matrix."""
        self.worse(1.0)
        return self._wavefront_nm(4.0)

    def _seeing_words(self, n_swaps: int) -> Iterator[str]:
        """Yield a seeing that changes by two in 10 s, and a gust of a second around each swap."""
        t = self._trial
        end_s, gust = (n_swaps + 1) * SWAP_EVERY_S, GUST_SEEING
        times = np.arange(1.0, end_s, 1.0)
        slow = 2.0 ** (t.seeing_trend * (1.0 - np.abs(times % 20.0 - 10.0) / 10.0))
        points = dict(zip(times.tolist(), (t.seeing_arcsec * slow).tolist(), strict=True))
        if t.gust != "none":
            for k in range(n_swaps):
                from_s = (k + 1) * SWAP_EVERY_S + self._rng.uniform(-4.0, 4.0)
                for at_s, factor in ((-0.1, 1.0), (0.0, gust), (1.0, gust), (1.1, 1.0)):
                    level = np.interp(from_s + at_s, times, t.seeing_arcsec * slow)
                    points[round(from_s + at_s, 2)] = float(level) * factor
        for time_s, arcsec in sorted(points.items()):
            if time_s > 0.0:
                yield f"--seeing-at={time_s:.2f}:{min(arcsec, 5.0):.3f}"

    def _matrix(self, off_subap: float) -> Array32:
        alpha = self.dome.alpha.vector + np.array([off_subap, 0.0, 2.0 * off_subap / 57.3, 0.0])
        response = bench_of(SMALL).response(Misregistration.from_vector(alpha))
        return np.ascontiguousarray(reconstruct(response, Recipe(n_modes=N_SMALL)).matrix)

    def _swap(self, matrix: Array32) -> None:
        self._n_swaps += 1
        name = f"cm-{self._n_swaps}"
        self._matrices[name] = matrix
        known = self.dome.computer.reconstructor
        manifest = replace(known.manifest, id=name)
        self.dome.stage(replace(known, matrix=matrix, manifest=manifest))

    def _pass(self, seconds: float) -> None:
        end_s, modes = self.dome.time_s + seconds - 1e-6, np.arange(N_SMALL)
        self.alarms = frozenset()
        while self.dome.time_s < end_s:
            for block in self.dome.play():
                matrix = self._matrices.get(block.cm_id)
                self.state = observe(self.state, block, modes, matrix=matrix)
                self.loop = health.observe(self.loop, block, self._variance, modes)
                if matrix is not None and self._watch is not None:
                    self.played = observe_played(self.played, block, self._watch, matrix)
                self.alarms |= {alarms.DIVERGING} if self.loop.diverging else set()
                self.alarms |= {alarms.NOT_PLAYED} if self.played.unplayed else set()

    def _wavefront_nm(self, seconds: float) -> float:
        since_s = self.dome.time_s - seconds
        last = [m.wavefront_nm for m in self.dome.moments if m.time_s > since_s]
        return float(np.sqrt(np.mean(np.square(last))))


def simulated_rows(
    plant: str, kind: str, n: int, seed: int, *, fixed: Mapping[str, Any], hard: bool = False
) -> Iterator[dict[str, object]]:
    """Yield what comes of swaps on the simulator's telescope, a few in each night.

    ``fixed`` are conditions that are not drawn. ``hard``: the seeing doubles in every night, with
    few swaps, so that a lost loop ends it soon.
    """
    done = night_number = 0
    while done < n:
        usual_hz = RATES_HZ[night_number % len(RATES_HZ)]
        trial = replace(drawn(plant, kind, seed + night_number), rate_hz=usual_hz)
        trial = replace(trial, **fixed)
        if hard:
            trial = replace(trial, seeing_trend=1)
        if plant == "diffractive" and kind != "healthy":
            trial = _calm(trial, night_number)
        most = SWAPS_A_HARD_NIGHT if hard else SWAPS_A_NIGHT
        n_swaps = min(most if kind == "healthy" else 1, n - done)
        night = SimulatedNight(trial, n_swaps)
        if kind == "healthy":
            yield from night.swaps(n_swaps)
        elif kind == "worse":
            healthy_nm = SimulatedNight(trial, n_swaps).healthy_nm()
            yield night.worse(SLOW_SHARES[night_number // 2 % 2], healthy_nm)
        else:
            yield night.worse(-0.5)
        done, night_number = done + n_swaps, night_number + 1


def _calm(trial: Trial, night_number: int) -> Trial:
    """Return it in seeing that this small pyramid stands: doubled, it loses every loop."""
    return replace(
        trial,
        rate_hz=RATES_HZ[night_number % 2],
        seeing_trend=min(trial.seeing_trend, 0),
        seeing_arcsec=0.5 + 0.4 * (trial.seeing_arcsec - 0.5),
    )


def rows_of(
    plant: str, kind: str, n: int, seed: int, *, fixed: Mapping[str, Any], hard: bool
) -> Iterator[dict[str, object]]:
    """Yield a row for each swap; ``fixed`` are conditions that are not drawn."""
    if plant != "outside":
        return simulated_rows(plant, kind, n, seed, fixed=fixed, hard=hard)
    trials = (drawn(plant, kind, seed + k) for k in range(n))
    return (outside_trial(replace(trial, **fixed)) for trial in trials)


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m pyrcal_studies.campaign.healthy_swaps")
    parser.add_argument("--plant", choices=("outside", "linear", "diffractive"), default="outside")
    parser.add_argument("--healthy", type=int, default=10, metavar="N")
    parser.add_argument("--worse", type=int, default=0, metavar="N")
    parser.add_argument("--diverging", type=int, default=0, metavar="N")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rate", type=float, metavar="HZ", help="all swaps at this frame rate")
    parser.add_argument("--seeing", type=float, metavar="ARCSEC", help="all nights begin with it")
    parser.add_argument("--hard", action="store_true", help="the seeing doubles in each night")
    parser.add_argument("--output", type=Path, default=Path("var/healthy_swaps.jsonl"))
    given = parser.parse_args()
    file, begun = RowFile(given.output), time.process_time()
    asked = {"rate_hz": given.rate, "seeing_arcsec": given.seeing}
    fixed = {key: value for key, value in asked.items() if value is not None}
    with threadpool_limits(1):
        for kind in ("healthy", "worse", "diverging"):
            n = getattr(given, kind)
            for row in rows_of(given.plant, kind, n, given.seed, fixed=fixed, hard=given.hard):
                file.add(row)
    sys.stdout.write(f"{time.process_time() - begun:.0f} s of processor time\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
