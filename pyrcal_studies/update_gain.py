"""What a mis-registered reconstructor costs: predicted by the service, and seen on the telescope.

For every registration and gain two loops run under the same sky, one with the reconstructor of a
perfect registration, one with that of the true one; the difference of their wavefront errors stands
beside what ``service.control.expected_gain`` says of it. Each is run with the registration and with
its mirror image: a reconstructor shifted along the wind foresees the turbulence and wins what it
loses when shifted against it. ``--plant linear`` or ``diffractive``.
Run: ``python -m pyrcal_studies.update_gain --plant linear --seconds 4``.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from service.control.expected_gain import (
    ExpectedGain,
    Sky,
    estimate_slope_noise,
    expected_gain,
    extrapolate_variance_m2,
)
from service.control.loop import ControlLoop
from service.control.reconstructor import invert
from service.files import parse_alpha
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from sim_rtc.assembly import Telescope, build_telescope
from sim_rtc.computer.feed import BATCH_FRAMES
from sim_rtc.computer.loop import LoopTerms, ModalLoop
from sim_rtc.options import parse_options
from sim_rtc.telescope.atmosphere import fried_parameter_m

Array32 = NDArray[np.float32]

CASES = (
    "0.05,0,0,1",
    "0.1,0,0,1",
    "0.2,0,0,1",
    "0.3,0,0,1",
    "0,0,0.2,1",
    "0,0,0.5,1",
    "0,0,1,1",
    "0,0,0,1.003",
    "0,0,0,1.01",
    "0,0,0,1.02",
)
STROKE_M = 3e-5
SETTLING_FRAMES = 500
SEEING_ARCSEC = 1.0
OPTICAL_GAIN = 0.6
"""Of the diffractive telescope on average; the linear one is asked to have 1."""


def mirrored(alpha: Misregistration) -> Misregistration:
    """Return the registration on the other side of the perfect one."""
    return Misregistration.from_vector(2.0 * Misregistration().vector - alpha.vector)


def telescope_of(alpha: Misregistration, given: argparse.Namespace) -> Telescope:
    """Return a fresh telescope: the same sky every time."""
    place = ",".join(str(value) for value in alpha.to_boundary().values())
    words = (
        f"--plant {given.plant} --alpha {place} --seed {given.seed} --mag {given.mag} "
        f"--n-controlled {given.modes} --wind {given.wind},40 --imperfections ideal "
        f"--vibration none --seeing {SEEING_ARCSEC}"
    )
    return build_telescope(parse_options(words.split()), load_instrument("flao-lbt"))


def wavefront_errors_nm(
    telescope: Telescope, matrices: list[Array32], gain: float, given: argparse.Namespace
) -> list[float]:
    """Return the RMS of what each reconstructor leaves of the same turbulence, nm."""
    weights = telescope.weights.astype(np.float32)
    n_modes = len(telescope.settings.gains)
    loops = [ModalLoop(n_modes=n_modes, delay_frames=2, stroke_m=STROKE_M) for _ in matrices]
    gains = np.full(given.modes, gain, np.float32)
    power: list[list[float]] = [[] for _ in matrices]
    n_frames = 0
    for block in telescope.feed.blocks():
        terms = [LoopTerms.of(block.optics, matrix, gains, given.leak) for matrix in matrices]
        for row in range(0, block.n_frames, BATCH_FRAMES):
            incoming = None
            for one, (loop, term) in enumerate(zip(loops, terms, strict=True)):
                rows = block.run(row, loop, term, None)
                if n_frames < SETTLING_FRAMES:
                    continue
                if incoming is None:
                    incoming = block.phase_at(row)
                left = incoming + block.optics.opd_per_command @ rows.commands_m[0]
                power[one].append(float(weights @ (left - weights @ left) ** 2))
            n_frames += BATCH_FRAMES
        if n_frames >= given.seconds * telescope.settings.frame_rate_hz + SETTLING_FRAMES:
            break
    return [1e9 * float(np.sqrt(np.mean(seen))) for seen in power]


def predicted(
    model: InteractionModel, matrices: list[Array32], alpha: Misregistration, gain: float,
    given: argparse.Namespace,
) -> ExpectedGain:  # fmt: skip
    """Return what the service would say, knowing seeing, wind, star and optical gain."""
    instrument, turbulence = model.instrument, model.instrument.modes
    r0_m = fried_parameter_m(SEEING_ARCSEC)
    stronger = (turbulence.r0_m / r0_m) ** (5 / 3)
    noise = estimate_slope_noise(
        instrument, magnitude=float(given.mag), frame_rate_hz=1000.0, n_valid=model.n_slopes // 2
    )
    sky = Sky(
        variance_m2=model.basis.variance_m2 * stronger,
        beyond_m2=extrapolate_variance_m2(model.basis.variance_m2) * stronger,
        crossing_hz=given.wind / instrument.diameter_m,
        slope_noise=noise,
    )
    timing = ControlLoop(
        frame_rate_hz=1000.0,
        delay_frames=2.0,
        leak=given.leak,
        gains=np.full(given.modes, gain),
        optical_gain=np.full(model.basis.n_modes, 1.0 if given.plant == "linear" else OPTICAL_GAIN),
    )
    in_use, fresh = matrices
    return expected_gain(in_use, fresh, model.interaction_matrix(alpha), timing, sky)


def row(
    case: str, gain: float, nominal: Array32, model: InteractionModel, given: argparse.Namespace
) -> str:
    """Return what is predicted and seen of one registration, both its signs."""
    said, seen = [], []
    for alpha in (parse_alpha(case), mirrored(parse_alpha(case))):
        fresh = invert(model.interaction_matrix(alpha), given.modes).matrix
        said.append(predicted(model, [nominal, fresh], alpha, gain, given))
        seen.append(wavefront_errors_nm(telescope_of(alpha, given), [nominal, fresh], gain, given))
    lost = [now - then for now, then in seen]
    return (
        f"| {case} | {gain:g} | {said[0].pole_radius:.3f}, {said[0].fresh_pole_radius:.3f} "
        f"| {said[0].wavefront_m * 1e9:.1f} | {seen[0][1]:.1f} "
        f"| {np.mean([one.loss_m for one in said]) * 1e9:.2f} | {np.mean(lost):.2f} "
        f"| {lost[0]:+.2f}, {lost[1]:+.2f} |\n"
    )


def main() -> None:
    """Print a row for every registration and gain."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--plant", default="linear")
    parser.add_argument("--case", action="append", metavar="X,Y,ROT_DEG,MAG")
    parser.add_argument("--gain", type=float, action="append", help="default 0.3 and 0.5")
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--modes", type=int, default=400)
    parser.add_argument("--leak", type=float, default=0.999)
    parser.add_argument("--wind", type=float, default=12.0)
    parser.add_argument("--mag", default="8")
    parser.add_argument("--seed", type=int, default=3)
    given = parser.parse_args()
    sys.stdout.write(
        "| registration | gain | pole radius, new one's | new one, predicted nm | seen "
        "| lost, predicted nm | seen, mean of both signs | each sign |\n"
        "|---|---|---|---|---|---|---|---|\n"
    )
    with threadpool_limits(1):
        instrument = load_instrument("flao-lbt")
        model = InteractionModel(instrument, karhunen_loeve_basis(instrument))
        nominal = invert(model.interaction_matrix(Misregistration()), given.modes).matrix
        for case in given.case or CASES:
            for gain in given.gain or [0.3, 0.5]:
                sys.stdout.write(row(case, gain, nominal, model, given))
                sys.stdout.flush()


if __name__ == "__main__":
    main()
