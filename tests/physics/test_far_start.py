"""Why the demo's RTC begins with 120 modes: with its own matrix it could hold no 400."""

import os

import numpy as np

from service.files.disk_cache import DiskCache, usual_folder
from service.instrument import packaged_instrument
from service.model.interaction import InteractionModel
from sim_rtc.computer.reconstructors import truncated_inverse
from sim_rtc.options import FAR_MODES, USUAL_MODES, parse_options
from sim_rtc.telescope.registration import far_registration


def largest_pole_radius(coupling, options, optical_gain):
    """Of ``c[k+2] = leak c[k+1] - gain B c[k]`` for each eigenvalue of B: the quadratic's roots."""
    eigenvalues = options.gain * optical_gain * np.linalg.eigvals(coupling)
    spread = np.sqrt(options.leak**2 - 4.0 * eigenvalues)
    return float(np.max(np.abs([options.leak + spread, options.leak - spread])) / 2.0)


def test_the_matrix_of_a_perfect_registration_holds_120_modes_there_and_loses_400():
    """With the optical gain of the middle mode, .75 of the usual imperfections' .6 to .9."""
    instrument, options = packaged_instrument("flao-lbt"), parse_options(["--far"])
    model = InteractionModel(instrument, DiskCache(usual_folder(os.environ)).basis(instrument))
    nominal = model.interaction_matrix(instrument.start)
    rng = np.random.default_rng(7)
    for _ in range(2):
        true = model.interaction_matrix(far_registration(rng))
        few, many = (
            largest_pole_radius(
                truncated_inverse(nominal[:, :n]) @ true[:, :n], options, optical_gain=0.75
            )
            for n in (FAR_MODES, USUAL_MODES)
        )
        assert few < 0.9
        assert many > 1.0
