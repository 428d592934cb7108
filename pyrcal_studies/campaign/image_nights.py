"""Nights of a telescope whose pupil images are off the pixel grid, unknown to the service.

The telescope is linear, everything else about it ideal; the service tracks in ``auto``, in
simulated time. A row has the mean error of α of one night, and the median of σ with and without
the allowance for places of images that the instrument file does not state. With ``--poles`` FLAO's
loop is examined instead: pole radii on a plant with displaced images, of the reconstructor of the
true registration and of the one that fits the displaced plant best.

Run: ``python -m pyrcal_studies.campaign.image_nights --rms 0.1 --seeds 1:17 --output
var/image_nights.jsonl``; nights that are there already are not run again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import SETTINGS, SMALL, KeptNight
from pyrcal_studies.campaign.other_modes import (
    CALIBRATED,
    LATENCIES,
    OtherDome,
    OtherLink,
    Plan,
    Truth,
)
from pyrcal_studies.campaign.rows import Row, RowFile, heading, line, range_of
from service.config import load_settings
from service.control.loop import pole_radius
from service.instrument import load_instrument
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import analytic_basis
from service.model.sensors.registry import kind_of
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, OpticsWorker
from service.tracking.state import Mode

FLAO = "flao-lbt"
N_FIRST = 45
N_POLES = (400, 500)
GAINS = (0.5, 0.6, 0.8)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageNight:
    """One night."""

    seed: int = 1
    rms_px: float = 0.1
    """Displacement of an image along an axis, RMS."""

    seconds: float = 60.0

    @property
    def words(self) -> list[str]:
        """The simulator's command line."""
        magnitude = round(float(np.random.default_rng([5, self.seed]).uniform(7.0, 11.0)), 1)
        plan = Plan(instrument=SMALL, n_controlled=N_FIRST, magnitude=magnitude, seed=self.seed)
        offset = [f"--image-offset-rms={self.rms_px}"] if self.rms_px else []
        return [*plan.words, "--imperfections=ideal", *offset]


def play(night: ImageNight) -> Row:
    """Run one night."""
    # floors as the service takes them, so that σ is that of a user
    asked = {key: value for key, value in SETTINGS.items() if not key.startswith("tracking")}
    instrument = load_instrument(SMALL)
    calibrated = Misregistration.from_vector(np.array(CALIBRATED) / BOUNDARY_SCALE)
    service = KeptNight(
        policy_of(load_settings(None, {}, asked), instrument),
        Mode.AUTO,
        OpticsWorker(instrument, Compute(threads=1)),
        None,
        latencies=LATENCIES,
        dome=OtherDome(night.words, Truth(), calibrated),
        link=OtherLink,
    )
    errors, sigmas, shown = [], [], []
    levels, alarms = set(), set()
    while service.time_s < night.seconds:
        service.advance(1.0)
        known = service.state.alpha.registration
        alarms |= {alarm.name for alarm in service.state.alarms.active}
        if known is None or known.n_windows < 2:
            continue
        errors.append(known.alpha.vector - service.dome.moments[-1].alpha.vector)
        sigmas.append(known.sigma)
        shown.append(known.shown_sigma)
        levels.add(str(known.validity.level))
    moments = [one for one in service.dome.moments if one.time_s > night.seconds - 8.0]
    return asdict(night) | {
        "error": (np.mean(errors, axis=0) * BOUNDARY_SCALE).tolist(),
        "sigma": (np.median(sigmas, axis=0) * BOUNDARY_SCALE).tolist(),
        "shown_sigma": (np.median(shown, axis=0) * BOUNDARY_SCALE).tolist(),
        "largest": np.max(np.abs(errors) / np.array(sigmas), axis=0).tolist(),
        "shown_largest": np.max(np.abs(errors) / np.array(shown), axis=0).tolist(),
        "levels": sorted(levels),
        "alarms": sorted(alarms),
        "modes": moments[-1].n_controlled,
        "wavefront_nm": float(np.sqrt(np.mean([one.wavefront_nm**2 for one in moments]))),
    }


def table(rows: Sequence[Row]) -> str:
    """Return a row for each displacement."""
    text = heading(
        *("pixel RMS", "nights", "error RMS: x, y (subap), rotation (deg)"),
        *("error over σ without images: RMS; largest", "with images: RMS; largest", "modes"),
        *("levels", "nights with alarms"),
    )
    for rms in sorted({row["rms_px"] for row in rows}):
        these = [row for row in rows if row["rms_px"] == rms]
        error = np.array([row["error"] for row in these])
        text += line(
            *(rms, len(these), _numbers(_rms(error)[:3], 4)),
            *(_over(these, error, name) for name in ("", "shown_")),
            "/".join(sorted({str(row["modes"]) for row in these})),
            ", ".join(sorted({level for row in these for level in row["levels"]})),
            sum(bool(row["alarms"]) for row in these),
        )
    return text


def _over(rows: Sequence[Row], error: NDArray[np.float64], name: str) -> str:
    over = _rms(error / np.array([row[f"{name}sigma"] for row in rows]))
    largest = np.max([row[f"{name}largest"] for row in rows])
    return f"{_numbers(over, 2)}; {largest:.1f}"


def _rms(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _numbers(values: NDArray[np.float64], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def poles(seed: int, rms_px: float) -> Iterator[str]:
    """Yield pole radii of FLAO's loop on a plant with displaced images."""
    instrument, true = load_instrument(FLAO), Misregistration()
    offsets = np.random.default_rng(seed).standard_normal((4, 2))
    offsets -= offsets.mean(axis=0)
    offsets *= rms_px / np.sqrt(np.mean(offsets**2))
    basis = analytic_basis(instrument)
    displaced = replace(instrument, wfs=kind_of(instrument).with_images_at(instrument, offsets))
    near, there = (
        RtcInteractionModel(each, basis).linearise(true) for each in (instrument, displaced)
    )
    plant = there.matrix.astype(float)
    model, rates = near.matrix.astype(float), near.derivatives[:4].astype(float)
    squares = np.sum(model**2, axis=0)
    gains = np.sum(plant * model, axis=0) / squares
    # every mode has a gain of its own
    across = [
        rate * gains - model * (np.sum(rate * gains * model, axis=0) / squares) for rate in rates
    ]
    jacobian = np.stack([one.ravel() for one in across], axis=1)
    step = np.linalg.lstsq(jacobian, (plant - model * gains).ravel(), rcond=None)[0]
    yield f"seed {seed}, {rms_px} pixel: α is off by {np.round(step * BOUNDARY_SCALE, 4).tolist()}"
    for n_modes in N_POLES:
        for name, alpha in (("true α", np.zeros(4)), ("fitted α", step)):
            matrix = (model + np.tensordot(alpha, rates, 1))[:, :n_modes]
            found = np.linalg.eigvals(np.linalg.pinv(matrix) @ plant[:, :n_modes])
            radii = [pole_radius(g * found, leak=0.999, delay_frames=2.0).max() for g in GAINS]
            yield f"  {n_modes} modes, {name}: {', '.join(f'{radius:.3f}' for radius in radii)}"


def main() -> int:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=range_of, default=range(1, 17), metavar="FIRST:END")
    parser.add_argument("--rms", type=float, nargs="+", default=[0.1])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--output", type=Path, default=Path("var/image_nights.jsonl"))
    parser.add_argument("--poles", action="store_true", help="pole radii at gains 0.5, 0.6, 0.8")
    given = parser.parse_args()
    with threadpool_limits(1):
        if given.poles:
            for rms in given.rms:
                for seed in given.seeds:
                    print("\n".join(poles(seed, rms)), flush=True)
            return 0
        file = RowFile(given.output)
        nights = [
            ImageNight(seed=seed, rms_px=rms, seconds=given.seconds)
            for rms in given.rms
            for seed in given.seeds
        ]
        for night in file.missing(nights):
            file.add(play(night))
    print(table(file.rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
