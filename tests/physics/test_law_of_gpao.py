"""The law of pointing of a telescope that has one: GPAO's, as published, found in matrices.

A&A 2026, 55666-25, table B.1: rotation of mirror on sensor ``azimuth - 12.984 deg`` and an offset
for each of the four telescopes, a scaling, and anamorphoses of which the largest is 3.7 %. Matrices
are made by spots transformed, which share nothing with the model; a fit that begins where the law
leads finds the table's numbers to half of their last digit. The sensor here has 12 x 12 lenslets,
GPAO's 40 x 40.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.kinds import Stop
from service.model.misregistration import Misregistration, rotation
from service.model.modes import modal_basis
from service.model.pointing_law import PointingLaw, Term
from service.model.pupil import valid_subapertures
from service.model.sensors.shack_hartmann.table import PartlyLit
from tests.support.fft_spots import pushed, sampled

FILE = Path(__file__).parents[1] / "data" / "lenslets.toml"
LAW = PointingLaw(rotation_deg=Term("azimuth - 12.984"))

NGS_VIS = {
    "GPAO1": (0.60, 102.8),
    "GPAO2": (1.21, 103.5),
    "GPAO3": (-1.14, 102.1),
    "GPAO4": (-2.95, 103.5),
}
"""Offset of the rotation, degrees, and scaling, per cent: natural star, visible, 40 x 40."""

LGS = {
    "GPAO1": (-88.00, 101.3, -0.2, 0.1),
    "GPAO2": (-91.74, 102.2, -0.1, 0.0),
    "GPAO3": (-88.65, 101.2, -0.2, 0.1),
    "GPAO4": (-88.35, 102.0, -0.2, 0.0),
}
"""The same of the laser star's sensor, with both anamorphoses, per cent: 0 and 45 deg."""

NGS_IR = {
    "GPAO1": (78.71, 96.4, 0.6, 0.6),
    "GPAO2": (80.01, 95.4, 3.7, -0.6),
    "GPAO3": (83.81, 101.1, -0.4, -0.8),
    "GPAO4": (81.11, 97.7, 0.3, 0.0),
}
"""The same of the infrared sensor."""

EVERY = {("NGS VIS", one): (*numbers, 0.0, 0.0) for one, numbers in NGS_VIS.items()} | {
    (sensor, one): numbers
    for sensor, table in (("LGS", LGS), ("NGS IR", NGS_IR))
    for one, numbers in table.items()
}
LATER = [("NGS VIS", "GPAO3"), ("LGS", "GPAO2"), ("NGS IR", "GPAO1")]
"""One line of each table, with the long tests; the largest anamorphosis with every run."""

MOUNTED_DEG = {"NGS VIS": 0.0, "LGS": -90.0, "NGS IR": 80.0}
"""How each sensor is turned, roughly: where fits of its matrices begin."""

AZIMUTHS = {"GPAO1": 20.0, "GPAO2": 105.0, "GPAO3": 200.0, "GPAO4": 310.0}
MODES = np.array([0, 1, 3, 6, 10, 15, 21, 30, 40, 55])


@pytest.fixture(scope="module")
def lenslets():
    """The small sensor, its cut lenslets left out: there the spots' cells are black or white."""
    instrument = load_instrument(FILE)
    wfs = replace(instrument.wfs, partly_lit=PartlyLit.LEAVE_OUT)
    return replace(instrument, stop=Stop.TELESCOPE, wfs=wfs)


@pytest.fixture(scope="module")
def shapes(lenslets):
    return sampled(modal_basis(lenslets).subset(MODES), 9)


def measured(instrument, shapes, alpha, stretch=(0.0, 0.0)):
    """Return a matrix of spots, the mirror's image turned, scaled and stretched on the sensor."""
    along, across = stretch
    image = np.array([[1.0 + along, across], [across, 1.0 - along]])

    def opd_at(points):
        on_mirror = np.linalg.solve(image, points.T).T @ rotation(alpha.rotation_rad)
        return shapes(on_mirror / alpha.magnification)

    slopes = pushed(instrument, opd_at, (0.0, 0.0), np.ones_like)
    matrix = slopes[:, valid_subapertures(instrument)].reshape(-1, len(MODES))
    return Reference(matrix=matrix, modes=MODES)


def nominal(azimuth_deg):
    return LAW.at({"azimuth": azimuth_deg})


@pytest.mark.parametrize(
    ("sensor", "telescope"),
    [("NGS IR", "GPAO2"), *(pytest.param(*one, marks=pytest.mark.long) for one in LATER)],
)
def test_offset_scaling_and_anamorphoses_are_those_of_the_table(
    lenslets, shapes, sensor, telescope
):
    """Each to half of the table's last digit; the fit begins where the law and the sensor lead."""
    offset_deg, scaling, along, askew = EVERY[sensor, telescope]
    law = nominal(AZIMUTHS[telescope])
    begin = replace(law, rotation_rad=law.rotation_rad + np.deg2rad(MOUNTED_DEG[sensor]))
    true = Misregistration(
        rotation_rad=law.rotation_rad + np.deg2rad(offset_deg), magnification=scaling / 100
    )
    reference = measured(lenslets, shapes, true, (along / 200, askew / 200))
    fit = fit_matrix(lenslets, reference, FitOptions(start=begin))
    found_deg = np.rad2deg(fit.alpha.rotation_rad - law.rotation_rad)
    assert found_deg == pytest.approx(offset_deg, abs=0.005)
    assert 100 * fit.alpha.magnification == pytest.approx(scaling, abs=0.05)
    assert 200 * fit.anamorphosis == pytest.approx([along, askew], abs=0.05)
