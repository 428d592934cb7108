"""Interaction matrices measured on the simulated telescope: how well, and how fast.

Measures it with every pattern, as the RTC does on command, without a network and as fast as it
goes, and compares with the linear plant's own matrix: time on the telescope, noise of an element,
error of the whole, and how much of it is bias.
Run: ``python -m pyrcal_studies.measured_matrix --mag 7 --scene daytime``.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.rtc.identity import Identity
from service.config import load_instrument
from service.wire import MeasureRequest, Pattern
from sim_rtc.assembly import build_telescope
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.options import parse_options
from sim_rtc.telescope.linear import LinearOptics

N_MODES = 400
STROKE_M = 20e-9
TONE_M = 5e-9
SINE_MODES = tuple(range(0, N_MODES, 10))
SINE_S = 10.0
ALPHA = "0.1,-0.05,0.2,1.002"

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One measurement against the truth."""

    n_frames: int
    noise: float
    """RMS error of an element, slope per metre OPD."""

    error: float
    """Frobenius norm of the error over that of the matrix."""

    bias: float
    """Gain of the measured matrix on the true one, minus 1."""


def requests(n_average: int) -> tuple[MeasureRequest, ...]:
    """Return one measurement of each pattern."""
    modes = tuple(range(N_MODES))
    pushed = tuple(
        MeasureRequest(
            id=f"study-{pattern}",
            pattern=pattern,
            modes=modes,
            amplitude_m=(STROKE_M,) * N_MODES,
            n_average=n_average,
        )
        for pattern in (Pattern.PUSH_PULL_MODAL, Pattern.PUSH_PULL_ZONAL, Pattern.HADAMARD)
    )
    sine = MeasureRequest(
        id="study-sine",
        pattern=Pattern.SINE,
        modes=SINE_MODES,
        amplitude_m=(TONE_M,) * len(SINE_MODES),
        frequency_hz=tuple(51.0 + 10.0 * k for k in range(len(SINE_MODES))),
        duration_s=SINE_S,
    )
    return (*pushed, sine)


def measure(computer: RealTimeComputer, request: MeasureRequest, truth: Array) -> Outcome:
    """Carry one measurement out and compare it.

    Raises
    ------
    ValueError
        If the telescope refuses it or no matrix comes of it.
    """
    reply = computer.execute(request)
    if not reply.accepted:
        raise ValueError(f"{request.pattern}: refused: {reply.reason}")
    n_frames = 0
    while not (ended := computer.take_measured()):
        n_frames += len(computer.next_batch().slopes)
    here = Identity(system="study", basis_id="basis", config_id="sensor")
    manifest, matrix = ended[0].product(here, created_ns=0)
    if matrix is None:
        raise ValueError(f"{request.pattern}: {manifest.reason}")
    expected = truth[:, list(request.modes)]
    error = matrix - expected
    return Outcome(
        n_frames=n_frames,
        noise=float(error.std()),
        error=float(np.linalg.norm(error) / np.linalg.norm(expected)),
        bias=float(np.sum(matrix * expected) / np.sum(expected**2) - 1.0),
    )


def main() -> int:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--mag", type=float, default=7.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scene", choices=["onsky", "daytime"], default="onsky")
    parser.add_argument("--averages", type=int, default=10)
    given = parser.parse_args()
    words = [f"--mag={given.mag}", f"--seed={given.seed}", f"--alpha={ALPHA}"]
    options = parse_options([*words, f"--scene={given.scene}"])
    with threadpool_limits(1):
        telescope = build_telescope(options, load_instrument(options.instrument))
        computer = telescope.computer(iter(telescope.feed.blocks()))
        computer.prepare()
        optics = telescope.optics.at(0.0)
        if not isinstance(optics, LinearOptics):
            raise TypeError("the study needs the linear plant: only there is a true matrix")
        truth = optics.slopes_per_command.astype(np.float64)
        sys.stdout.write(f"magnitude {given.mag:g}, {given.scene}; RMS of D {truth.std():.3g} /m\n")
        sys.stdout.write(
            f"{'pattern':18s}{'seconds':>9s}{'noise /m':>12s}{'error':>9s}{'bias':>10s}\n"
        )
        for request in requests(given.averages):
            found = measure(computer, request, truth)
            seconds = found.n_frames / options.frame_rate_hz
            sys.stdout.write(
                f"{request.pattern:18s}{seconds:9.1f}{found.noise:12.3g}{found.error:9.2%}"
                f"{found.bias:+10.1e}\n"
            )
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
