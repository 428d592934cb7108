"""What tests of several modules share of unit.playback.test_aot."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from pyrcal.importers.aot import read_telemetry
from service.model.pupil import rtc_valid_subapertures

aotpy = pytest.importorskip("aotpy")


N, N_CONTROLLED, RATE_HZ = 6, 5, 500.0


SEQ = [3, 4, 5, 7, 8, 9]
"""One is missing."""


RNG = np.random.default_rng(4)


class Hand:
    """Someone's own AOT file of an instrument, to be spoilt before it is written."""

    def __init__(self, about):
        self.others = []
        mask = rtc_valid_subapertures(about)
        n_valid = int(mask.sum())
        places = np.full(mask.shape, -1)
        places[mask] = np.arange(n_valid)
        self.slopes = RNG.normal(size=(N, 2, n_valid)).astype(np.float32)
        self.modal_m = RNG.normal(size=(N, 20)).astype(np.float32)
        self.control = RNG.normal(size=(N_CONTROLLED, 2, n_valid)).astype(np.float32)
        stamps = [1.7e9 + seq / RATE_HZ for seq in SEQ]
        self.time = aotpy.Time("when", timestamps=stamps, frame_numbers=SEQ)
        self.telescope = aotpy.MainTelescope("telescope", enclosing_diameter=about.diameter_m)
        self.sensor = aotpy.Pyramid(
            uid="sensor",
            n_sides=4,
            source=aotpy.NaturalGuideStar("star"),
            n_valid_subapertures=n_valid,
            subaperture_mask=aotpy.Image("mask", places),
            measurements=aotpy.Image("slopes", self.slopes, time=self.time),
        )
        self.mirror = aotpy.DeformableMirror("dm", telescope=self.telescope, n_valid_actuators=9)
        self.loop = aotpy.ControlLoop(
            "loop",
            input_sensor=self.sensor,
            commanded_corrector=self.mirror,
            framerate=RATE_HZ,
            delay=1.5,
            modal_coefficients=aotpy.Image("modal", self.modal_m, unit="m", time=self.time),
            measurements_to_modes=aotpy.Image("control", self.control),
        )

    def filter(self, above, below):
        self.loop.time_filter_num = aotpy.Image("num", np.array(above))
        self.loop.time_filter_den = aotpy.Image("den", np.array(below))

    def read(self, folder, about):
        system = aotpy.AOSystem(
            ao_mode="SCAO",
            name="by hand",
            main_telescope=self.telescope,
            sources=[self.sensor.source, *(one.source for one in self.others)],
            wavefront_sensors=[self.sensor, *self.others],
            wavefront_correctors=[self.mirror],
            loops=[self.loop],
        )
        path = folder / "hand.fits"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            system.write_to_file(path, "fits")
        return read_telemetry(path, about)
