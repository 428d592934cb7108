"""Looks at ordinary telemetry of other codes' healthy loops, held against their own σ.

Run by an interpreter that has OOPAO and SPECULA, from the repository's root:
``python -m pyrcal_studies.passive_peers oopao --seeds 0:20``. Sensor and turbulence are theirs, the
loop runs on the matrix that the sensor itself shows, and α is known: the mirror was put there.

With ``--track FOLDER`` telemetry and an instrument file are written there, as a user would have
them, and what ``pyrcal track`` makes of each is held against the truth, from a perfect registration
on: the last estimate of each seed.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import io
import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from OOPAO.Atmosphere import Atmosphere

from pyrcal.playback.arrays import open_arrays
from pyrcal.playback.player import Player
from pyrcal_studies.peers_cases import mirror_points
from pyrcal_studies.peers_oopao import Oopao
from pyrcal_studies.peers_pushpull import Bench
from service.config import load_settings
from service.estimation import passive
from service.estimation.estimate import PassiveEstimate
from service.estimation.frames import FrameBlock
from service.instrument import load_instrument
from service.model.interaction import Linearisation, RtcInteractionModel
from service.model.kinds import Stop
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import ModalBasis, karhunen_loeve_basis

Array = NDArray[Any]

INSTRUMENT = Path("tests/unit/runtime/small.toml")
BENCH = Bench(
    diameter_m=3.0,
    obscuration_ratio=0.1,
    n_subapertures=12,
    pupil_separation_subap=16,
    wavelength_m=790e-9,
    modulation_lambda_over_d=3.0,
    n_modulation=22,
    sampling=4,
)
N_MODES, RATE_HZ, GAIN, LEAK, SETTLING, LOOK = 90, 500.0, 0.4, 0.995, 300, 1200
STROKE_M, DITHER_M = 5e-9, 4e-9
LINES = np.array([0.211, 0.239, 0.283, 0.331])
"""Over the frame rate, of the four highest modes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sky:
    """What a night is like, drawn by its seed."""

    alpha: Misregistration
    n_controlled: int
    wind_m_s: float
    photons: float
    """In a subaperture and a frame."""

    r0_m: float
    directions_deg: tuple[float, float]

    @classmethod
    def drawn(cls, rng: np.random.Generator, photons: float | None, n_controlled: int) -> Sky:
        """Return the sky of a seed; what is given is not drawn."""
        shift, turn = rng.uniform(-0.2, 0.2, 2), np.deg2rad(rng.uniform(-1.0, 1.0))
        magnification = 1.0 + rng.uniform(-0.01, 0.01)
        return cls(
            alpha=Misregistration.from_vector(np.array([*shift, turn, magnification])),
            n_controlled=n_controlled or int(rng.choice([45, 60])),
            wind_m_s=float(rng.choice([8.0, 12.0, 16.0])),
            photons=photons or float(rng.choice([200.0, 1000.0, 5000.0])),
            r0_m=float(rng.choice([0.1, 0.15])),
            directions_deg=(float(rng.uniform(0, 360)), float(rng.uniform(0, 360))),
        )


class Quadrants:
    """A peer's frames, and slopes of them over the mean light, in the model's own order."""

    def __init__(self, peer: str) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            self.telescope = Oopao(BENCH)
        self.valid = self.telescope.valid
        self._frame = self.telescope.frame
        if peer == "specula":
            from pyrcal_studies.peers_specula import Specula

            self._frame = Specula(BENCH).frame

    def slopes(self, opd_m: Array, rng: np.random.Generator | None = None, n: float = 1.0) -> Array:
        """Return ``(n_slopes,)``; with a generator of as many photons in all."""
        frame = np.asarray(self._frame(np.asarray(opd_m, float)), float)
        if rng is not None:
            frame = rng.poisson(np.maximum(frame, 0.0) * (n / frame.sum())).astype(float)
        half, apart, n_sub = len(frame) // 2, BENCH.pupil_separation_subap, BENCH.n_subapertures
        low, high = (half + (sign * apart - n_sub) // 2 for sign in (-1, 1))
        one, two, three, four = (
            frame[y : y + n_sub, x : x + n_sub] for y in (low, high) for x in (low, high)
        )
        light = (one + two + three + four)[self.valid].mean()
        along, across = (one + three) - (two + four), (one + two) - (three + four)
        return np.asarray(np.concatenate([along[self.valid], across[self.valid]]) / light)


@cache
def basis() -> ModalBasis:
    """Return the modes of the small telescope's mirror."""
    return karhunen_loeve_basis(load_instrument(str(INSTRUMENT)))


def shapes(alpha: Misregistration) -> Array:
    """Return the modes where the mirror lies, on the peer's pupil ``(n_modes, n * n)``."""
    points = mirror_points(BENCH, alpha, Stop.TELESCOPE)
    return np.asarray(basis().render(points), np.float32).T


def telemetry(
    sensor: Quadrants, sky: Sky, seed: int, n_frames: int, *, dithered: bool
) -> tuple[Array, Array, Array, Array]:
    """Return slopes, commands and dither of a closed loop, and the sensor's own matrix."""
    rng, n = np.random.default_rng([seed, 1]), BENCH.n_pupil
    modes = shapes(sky.alpha)
    response = np.stack(
        [
            sensor.slopes(STROKE_M * mode.reshape(n, n))
            - sensor.slopes(-STROKE_M * mode.reshape(n, n))
            for mode in modes
        ],
        axis=1,
    ) / (2 * STROKE_M)
    reconstructor = np.linalg.pinv(response[:, : sky.n_controlled])
    flat, lit = sensor.slopes(np.zeros((n, n))), BENCH.amplitude() > 0.0
    with contextlib.redirect_stdout(io.StringIO()):
        telescope = sensor.telescope.telescope
        telescope.samplingTime = 1.0 / RATE_HZ
        air = Atmosphere(
            telescope,
            sky.r0_m,
            25.0,
            windSpeed=[sky.wind_m_s, 1.5 * sky.wind_m_s],
            fractionalR0=[0.7, 0.3],
            windDirection=list(sky.directions_deg),
            altitude=[0, 5000],
        )
        air.initializeAtmosphere(telescope)
        air.generateNewPhaseScreen(seed)
    decided, rows = np.zeros((2, N_MODES)), []
    for k in range(n_frames + SETTLING):
        with contextlib.redirect_stdout(io.StringIO()):
            air.update()
        moved = np.zeros(N_MODES)
        if dithered:
            moved[-len(LINES) :] = DITHER_M * np.sqrt(2.0) * np.sin(2 * np.pi * LINES * k)
        opd = np.array(air.OPD, float)
        opd = opd - opd[lit].mean() + ((decided[0] + moved) @ modes).reshape(n, n)
        seen = sensor.slopes(opd, rng, sky.photons * sensor.valid.sum()) - flat
        rows.append((seen, decided[0] + moved, moved))
        new = LEAK * decided[1]
        new[: sky.n_controlled] -= GAIN * (reconstructor @ seen)
        decided = np.stack([decided[1], new])
    slopes, commands, dither = (
        np.array(part, np.float32)[SETTLING:] for part in zip(*rows, strict=True)
    )
    return slopes, commands, dither, response


def looks(
    sky: Sky, near: Linearisation, slopes: Array, commands: Array, dither: Array | None
) -> list[PassiveEstimate]:
    """Return what looks of ``LOOK`` frames each say."""
    found, step_ns = [], round(1e9 / RATE_HZ)
    for begin in range(0, len(slopes) - LOOK + 1, LOOK):
        state = passive.Passive(n_modes=sky.n_controlled, memory_frames=10.0 * RATE_HZ)
        for first in range(begin, begin + LOOK, 50):
            rows = slice(first, first + 50)
            block = FrameBlock(
                session="s",
                first_seq=first,
                t0_ns_utc=first * step_ns,
                dt_ns=step_ns,
                slopes=slopes[rows],
                commands_m=commands[rows],
                dither_m=None if dither is None else dither[rows],
                cm_id="own",
            )
            state = passive.accumulate(state, block)
        look = passive.fit(state, near)
        found += [] if look is None else [look]
    return found


def instrument_file(folder: Path, valid: Array) -> Path:
    """Write what a user of the peer would say of it, and return where."""
    with h5py.File(folder / "mask.h5", "w") as file:
        file["valid"] = valid
    text = INSTRUMENT.read_text()
    text = re.sub('stop = "mirror"', f'stop = "{Stop.TELESCOPE.value}"', text)
    text = re.sub("wavelength_m = .*", f"wavelength_m = {BENCH.wavelength_m}", text)
    text = text.replace("[mirror]", 'valid_subapertures = "mask.h5:/valid"\n\n[mirror]')
    path = folder / "instrument.toml"
    path.write_text(text)
    return path


def tracked(
    folder: Path, seed: int, sky: Sky, slopes: Array, commands: Array, response: Array
) -> tuple[Array, Array]:
    """Return error and σ of the last look of ``pyrcal track`` at a file, ``(4,)`` each."""
    path = folder / f"{seed}.npz"
    np.savez(
        path,
        slopes=slopes,
        commands_m=commands,
        reconstructor=np.linalg.pinv(response[:, : sky.n_controlled]),
        gains=GAIN,
        leak=LEAK,
        frame_rate_hz=RATE_HZ,
        delay_frames=2.0,
        alpha=sky.alpha.vector * BOUNDARY_SCALE,
    )
    instrument = load_instrument(str(folder / "instrument.toml"))
    player = Player(instrument, load_settings(None, {}), instrument.name)
    with open_arrays(path) as arrays:
        track = asyncio.run(player.play(arrays.messages(instrument), lambda _: None))
    found = track.passive[-1]  # the one before begins at a perfect registration
    return found.alpha.vector - sky.alpha.vector, found.sigma


def main() -> None:
    """Play the nights that are asked for, and say how far looks lie from the truth by their σ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("peer", choices=("oopao", "specula"))
    parser.add_argument("--seeds", default="0:20", metavar="FIRST:END")
    parser.add_argument("--frames", type=int, default=2 * LOOK)
    parser.add_argument("--photons", type=float, help="default: 200, 1000 or 5000, drawn")
    parser.add_argument("--modes", type=int, default=0, help="controlled; default: 45 or 60, drawn")
    parser.add_argument("--dithered", action="store_true", help="the four highest modes, 4 nm each")
    parser.add_argument("--track", type=Path, metavar="FOLDER", help="with pyrcal track")
    given = parser.parse_args()
    sensor = Quadrants(given.peer)
    if given.track is not None:
        given.track.mkdir(parents=True, exist_ok=True)
        instrument_file(given.track, sensor.valid)
    drawn = load_instrument(str(INSTRUMENT))
    wfs = replace(drawn.wfs, valid_subapertures=sensor.valid, wavelength_m=BENCH.wavelength_m)
    model = RtcInteractionModel(
        replace(drawn, wfs=wfs, stop=Stop.TELESCOPE), basis(), pupil_sampling=BENCH.sampling
    )
    errors = []
    for seed in range(*map(int, given.seeds.split(":"))):
        sky = Sky.drawn(np.random.default_rng(seed), given.photons, given.modes)
        near = model.linearise(sky.alpha)
        slopes, commands, dither, response = telemetry(
            sensor, sky, seed, given.frames, dithered=given.dithered
        )
        if given.track is not None:
            error, sigma = tracked(given.track, seed, sky, slopes, commands, response)
            own = np.where(np.isfinite(sigma), error / sigma, np.inf)
            errors.append((own, own))
            said = (*(error * BOUNDARY_SCALE), *(sigma * BOUNDARY_SCALE))
            print(seed, *(f"{value:+.4f}" for value in said), flush=True)
            continue
        sign = np.sign(np.sum(response * near.matrix))
        shown = dither if given.dithered else None
        for look in looks(sky, near, sign * slopes, commands, shown):
            error = look.alpha.vector - sky.alpha.vector
            own = np.sqrt(np.diag(look.covariance))
            errors.append((error / own, error / look.sigma))
            print(
                seed, *(f"{value:+.2f}" for value in (*errors[-1][0], *errors[-1][1])), flush=True
            )
    if given.track is not None:
        within = np.abs([own for own, _ in errors]) < 2.0
        print("within 2 sigma", within.sum(axis=0), "of", len(within))
        return
    scatter, sigma = np.array(errors).transpose(1, 0, 2)
    print("RMS error over scatter", np.sqrt((scatter**2).mean(axis=0)).round(2))
    print("within 2 sigma", (np.abs(sigma) < 2.0).mean(axis=0).round(3), "of", len(sigma))


if __name__ == "__main__":
    main()
