"""The diffractive telescope's pyramid before an outside judge: HCIPy.

Ten modes of 20 nm RMS, pushed and pulled, through both; prints correlation and gain of the slopes.
HCIPy sums its detector samples over a subaperture where ours integrates: at 3 samples that alone
makes mode 399 read 3 % more (sin(k/2)/(k/2) against the mean of three cosines), so it gets 6. It
must be installed for this only. Run: ``python -m benchmarks.judge``.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.peers import hcipy_slopes
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.modes import karhunen_loeve_basis
from service.model.sensors.pyramid.description import pyramid_in
from service.model.sensors.pyramid.signals import reference_slopes
from sim_rtc.telescope.diffractive import DiffractivePyramid, centred_pupil

MODES = (0, 1, 2, 5, 20, 50, 100, 200, 300, 399)
STROKE_M = 20e-9

JUDGE_SAMPLING = 6
"""HCIPy's samples per subaperture."""

Array = NDArray[np.float64]


def main() -> None:
    """Print a line for each mode."""
    threadpool_limits(1)
    instrument = load_instrument("flao-lbt")
    basis = karhunen_loeve_basis(instrument)
    model = InteractionModel(instrument, basis, pupil_sampling=JUDGE_SAMPLING, detector_nodes=1)
    judge = hcipy_slopes(model)
    pupil = centred_pupil(instrument, 3)
    pyramid = DiffractivePyramid(pyramid_in(instrument), pupil)

    def judged(mode: int, sign: float) -> Array:
        opd_m = np.zeros_like(model.pupil.amplitude)
        opd_m[model.pupil.lit] = sign * STROKE_M * basis.render(model.pupil.points)[:, mode]
        return judge(opd_m)

    def ours(mode: int, sign: float) -> Array:
        shape = sign * STROKE_M * basis.render(pupil.points)[:, mode]
        slopes, _ = reference_slopes(pyramid.images(shape), model.valid)
        return np.asarray(slopes)

    sys.stdout.write("mode  correlation   gain\n")
    for mode in MODES:
        theirs = judged(mode, 1.0) - judged(mode, -1.0)
        own = ours(mode, 1.0) - ours(mode, -1.0)
        correlation = own @ theirs / np.sqrt((own @ own) * (theirs @ theirs))
        gain = own @ theirs / (theirs @ theirs)
        sys.stdout.write(f"{mode:4d}  {correlation:11.6f} {gain:6.4f}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
