"""Optical gains of all modes against the true ones, on the diffractive telescope.

A night is a telescope, a star, a seeing and a dither of a few modes; the service's lock-in measures
the gains of these, its table infers those of all modes. The true modal gain is the response to a
poke of the mode on the residual wavefronts of the same seconds, without noise, along the model's
response to a flat wavefront: the mean over many residuals.

Run: ``python -m pyrcal_studies.campaign.modal_gains --seeings 0.6,0.9,1.2 --magnitudes 8,11
--seeds 0:2``; nights that are there already are not run again. With ``--then ARCSEC`` the seeing
changes within 2 s in the middle of each night, and the table has the windows after that.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal_studies.campaign.night import Night, loop_of, start_dither, windows
from pyrcal_studies.campaign.observatory import Dome, Moment
from pyrcal_studies.campaign.rows import (
    Row,
    add_workers,
    campaign_parser,
    complete,
    floats,
    grouped,
    heading,
    line,
    range_of,
    tell,
)
from service.control.gains import gain_table
from service.estimation.lockin import LockIn
from service.instrument import load_instrument
from service.model.misregistration import Misregistration
from service.records.estimates import WindowRefused
from service.records.registration import ModeGain
from service.runtime.worker import Compute, OpticsWorker, Sampling
from service.tracking.filtering import update_gains
from sim_rtc.computer.feed import BATCH_FRAMES
from sim_rtc.computer.telemetry import Batch
from sim_rtc.telescope.diffractive import DiffractiveOptics

Array = NDArray[np.float64]

POKE_M = 5e-9
"""RMS of a poke whose response is the true gain; the slopes have no noise."""

POKED = (0, 1, 2, 4, 7, 11, 16, 22, 30, 42, 58, 80, 110, 150, 200, 260, 330, 399, 450, 520, 580)
"""Modes whose true gain is computed, besides the dithered ones."""

POKE_INTERVAL_S = 0.3
"""Time from one poked residual to the next."""

CHANGE_S = 2.0
"""Duration of a change of the seeing."""

TRUTH_S = 4.0
"""Pokes within this time of the end of a window are its truth, where the seeing changes."""

SETTLED_BATCHES = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class GainNight(Night):
    """A night whose seeing is given."""

    seeing_arcsec: float = 1.0
    low_nm: float = 1.96
    """RMS of a dithered mode that the loop controls."""

    then_arcsec: float | None = None
    """Seeing of the second half of the night; None if it stays."""

    @property
    @override
    def words(self) -> list[str]:
        words = [*super(GainNight, self).words, f"--seeing={self.seeing_arcsec:g}"]
        if self.then_arcsec is not None:
            began_s = self.n_windows // 2 * self.window_s
            words.append(f"--seeing-at={began_s}:{self.seeing_arcsec:g}")
            words.append(f"--seeing-at={began_s + CHANGE_S}:{self.then_arcsec:g}")
        return [*words, "--alpha=0,0,0,1"]

    @property
    @override
    def amplitudes_nm(self) -> tuple[float, ...]:
        """RMS of each dithered mode, nm."""
        return tuple(
            self.low_nm if mode < self.n_controlled else self.amplitude_nm for mode in self.dithered
        )


class PokedDome(Dome):
    """A telescope whose residual wavefronts are poked now and then, beside the loop."""

    def __init__(self, night: GainNight, response: Array) -> None:
        """Take the model's flat response ``(n_slopes, n_modes)``."""
        super().__init__(night.words)
        n_modes = response.shape[1]
        wanted = {*POKED, *night.dithered}
        self.poked = sorted(mode for mode in wanted if mode < n_modes)
        self.responses: list[Array] = []
        """``(n_poked,)`` gains of each residual."""

        self.times_s: list[float] = []
        """When each was poked."""

        self._unit = response[:, self.poked] / np.square(response[:, self.poked]).sum(axis=0)
        self._n_batches = 0

    @override
    def _moment(self, batches: list[Batch]) -> Moment:
        for batch in batches:
            self._n_batches += 1
            every = round(POKE_INTERVAL_S * self.rate_hz / BATCH_FRAMES)
            if self._n_batches > SETTLED_BATCHES and self._n_batches % every == 0:
                self.responses.append(self._poke(batch))
                self.times_s.append(self._n_batches * BATCH_FRAMES / self.rate_hz)
        return super()._moment(batches)

    def _poke(self, batch: Batch) -> Array:
        optics, rng = batch.optics, np.random.default_rng(0)
        if not isinstance(optics, DiffractiveOptics):
            raise TypeError("modal gains: found a linear plant; expected a diffractive one")
        left = optics.mirror_opd_m(batch.commands_m[0]) + batch.phase_m
        found = np.empty(len(self.poked))
        for k, mode in enumerate(self.poked):
            poke = POKE_M * optics.opd_per_command[:, mode]
            seen = optics.slopes(left + poke, None, rng) - optics.slopes(left - poke, None, rng)
            found[k] = seen @ self._unit[:, k] / (2 * POKE_M)
        return found


def play(night: GainNight) -> Row:
    """Run one night."""
    with threadpool_limits(1):
        bench = OpticsWorker(
            load_instrument(night.instrument),
            Compute(threads=1, sampling=Sampling(working_point_modes=night.working_point_modes)),
        )
        dome = PokedDome(night, np.asarray(bench.response(Misregistration()), dtype=np.float64))
        dome.play()
        sums = LockIn(plan=start_dither(night, dome))
        loop, known = loop_of(dome), Misregistration()
        gains: tuple[ModeGain, ...] = ()
        history: list[tuple[float, tuple[ModeGain, ...]]] = []
        refused, amplitude_m = 0, 0.0
        for window, _ in itertools.islice(windows(dome, sums), night.n_windows):
            outcome = (
                window if isinstance(window, WindowRefused) else bench.fit(window, loop, known)
            )
            if isinstance(outcome, WindowRefused):
                refused += 1
                continue
            known, amplitude_m, seen = outcome.alpha, outcome.dither_m, np.abs(outcome.optical_gain)
            gains = update_gains(gains, outcome.modes, seen, outcome.gain_sigma, outcome.t_ns_utc)
            history.append((dome.time_s, gains))
        true = np.array(dome.responses)
        return asdict(night) | {
            "history": [_departures(dome, *one) for one in history],
            "refused": refused,
            "dither_m": amplitude_m,
            "wavefront_nm": float(np.mean([one.wavefront_nm for one in dome.moments[-20:]])),
            "measured": [asdict(gain) for gain in gains],
            "poked": dome.poked,
            "true": true.mean(axis=0).tolist(),
            "true_sigma": (true.std(axis=0) / np.sqrt(len(true))).tolist(),
        }


def _departures(dome: PokedDome, time_s: float, gains: tuple[ModeGain, ...]) -> Row:
    """Return relative errors and σ of the dithered modes after a window that ended at a time."""
    near = np.abs(np.array(dome.times_s) - time_s) < TRUTH_S / 2.0
    places = [dome.poked.index(gain.mode) for gain in gains]
    true = np.array(dome.responses)[near][:, places].mean(axis=0)
    return {
        "time_s": time_s,
        "error": (np.array([gain.gain for gain in gains]) / true - 1.0).tolist(),
        "sigma": (np.array([gain.sigma for gain in gains]) / true).tolist(),
    }


def compare(row: Row) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return modes, relative errors of the table, its relative σ, and which were dithered."""
    measured = [ModeGain(**gain) for gain in row["measured"]]
    modes, true = np.array(row["poked"]), np.array(row["true"])
    table = gain_table(measured, int(modes.max()) + 1)
    error = table.optical_gain[modes] / true - 1.0
    dithered = np.isin(modes, [gain.mode for gain in measured])
    return modes, error, table.relative_sigma[modes], dithered


HEADER = heading(
    *("magnitude, seeing", "windows (refused)", "true gain, low, high", "dithered, largest error"),
    *("others, largest error", "modes 0 to 30", "error / σ RMS", "wavefront, nm", "dither, nm"),
)


def table_of_change(rows: list[Row]) -> str:
    """Return errors and σ of the dithered modes, RMS, by the number of windows since the change.

    The first one is that which has more than half of the change behind it when it ends.
    """
    text = heading("magnitude, seeing", "window", "error, %", "σ, %", "error / σ RMS")
    for group in grouped(rows, GainNight, "seed"):
        found: dict[str, list[Row]] = {}
        for row in group:
            began_s = row["n_windows"] // 2 * row["window_s"]
            before = [one for one in row["history"] if one["time_s"] < began_s - TRUTH_S / 2]
            after = [one for one in row["history"] if one["time_s"] > began_s + CHANGE_S / 2]
            found.setdefault("last before", []).append(before[-1])
            for number, one in enumerate(after, 1):
                found.setdefault(str(number) if number < 4 else "4 and later", []).append(one)
        name = "{magnitude:g}, {seeing_arcsec:g} to {then_arcsec:g} arcsec".format(**group[0])
        for window, some in found.items():
            error, sigma = (np.array([one[what] for one in some]) for what in ("error", "sigma"))
            parts = (100 * error, 100 * sigma, error / sigma)
            rms = [np.sqrt(np.mean(part**2)) for part in parts]
            text += line(name, window, f"{rms[0]:.1f}", f"{rms[1]:.1f}", f"{rms[2]:.2f}")
    return text


def table(rows: list[Row]) -> str:
    """Return the campaign as a Markdown table."""
    return HEADER + "".join(_line(group) for group in grouped(rows, GainNight, "seed"))


def _line(rows: list[Row]) -> str:
    found = [compare(row) for row in rows if row["measured"]]
    first = rows[0]
    n = sum(row["n_windows"] for row in rows)
    name = f"{first['magnitude']:g}, {first['seeing_arcsec']:g} arcsec"
    if not found:
        return line(name, n, *"-------")
    modes = np.concatenate([one[0] for one in found])
    error, sigma, dithered = (np.concatenate([one[k] for one in found]) for k in (1, 2, 3))
    low = (modes <= 30) & ~dithered
    true = [row["true"][0] for row in rows], [row["true"][-1] for row in rows]
    return line(
        name,
        f"{n} ({sum(row['refused'] for row in rows)})",
        f"{np.mean(true[0]):.3f}, {np.mean(true[1]):.3f}",
        f"{_signed(error[dithered])} %",
        f"{_signed(error[~dithered])} %",
        f"{_signed(error[low])} %",
        f"{np.sqrt(np.mean((error / sigma) ** 2)):.2f}",
        f"{np.mean([row['wavefront_nm'] for row in rows]):.0f}",
        f"{1e9 * np.mean([row['dither_m'] for row in rows]):.1f}",
    )


def _signed(error: Array) -> str:
    return f"{100 * error.min():+.1f} to {100 * error.max():+.1f}"


def main() -> int:
    """Run what is missing, then print the table."""
    parser = campaign_parser("modal_gains", __doc__)
    parser.add_argument("--seeds", type=range_of, default=range(1), metavar="FIRST:END")
    parser.add_argument("--magnitudes", type=floats, default=(8.0, 11.0), metavar="R,R...")
    parser.add_argument("--seeings", type=floats, default=(0.6, 0.9, 1.2), metavar="ARCSEC,...")
    parser.add_argument("--then", type=float, metavar="ARCSEC", help="seeing of the second half")
    parser.add_argument("--rate", type=float, metavar="HZ", help="frames per second")
    parser.add_argument("--gain", type=float, default=0.6)
    parser.add_argument("--n-controlled", type=int, default=400)
    parser.add_argument(
        "--modes",
        type=_modes,
        default=(409, 427, 445, 463, 11),
        metavar="MODE,...",
        help="that are dithered",
    )
    parser.add_argument("--amplitude-nm", type=float, default=3.88, help="RMS of a free mode")
    parser.add_argument("--low-nm", type=float, default=1.96, help="RMS of a controlled mode")
    parser.add_argument("--window-s", type=float, default=5.0)
    parser.add_argument("--windows", type=int, default=3)
    parser.add_argument("--instrument", default="flao-lbt", metavar="NAME|FILE")
    add_workers(parser, 1)
    given = parser.parse_args()
    rows = complete(play, _nights(given), given)
    text = table(rows) if given.then is None else table_of_change(rows)
    tell(text, given.table, parser.prog)
    return 0


def _nights(given: argparse.Namespace) -> Iterator[GainNight]:
    grid = itertools.product(given.seeds, given.seeings, given.magnitudes)
    for seed, seeing, magnitude in grid:
        yield GainNight(
            magnitude=magnitude,
            seeing_arcsec=seeing,
            seed=seed,
            gain=given.gain,
            n_controlled=given.n_controlled,
            amplitude_nm=given.amplitude_nm,
            low_nm=given.low_nm,
            modes=given.modes,
            window_s=given.window_s,
            n_windows=given.windows,
            instrument=given.instrument,
            then_arcsec=given.then,
            rate_hz=given.rate,
        )


def _modes(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(","))


if __name__ == "__main__":
    sys.exit(main())
