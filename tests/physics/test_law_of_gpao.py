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

from pyrcal.offline.matrix import FitOptions, fit_matrix
from service.config import load_instrument
from service.estimation.reference import Reference
from service.model.kinds import Stop
from service.model.misregistration import Misregistration, rotation
from service.model.modes import modal_basis
from service.model.pointing_law import PointingLaw, Term
from service.model.pupil import valid_subapertures
from service.model.sensors.shack_hartmann.table import PartlyLit
from tests.physics.fft_spots import pushed

FILE = Path(__file__).parents[1] / "data" / "lenslets.toml"
LAW = PointingLaw(rotation_deg=Term("azimuth - 12.984"))

NGS_VIS = {
    "GPAO1": (0.60, 102.8),
    "GPAO2": (1.21, 103.5),
    "GPAO3": (-1.14, 102.1),
    "GPAO4": (-2.95, 103.5),
}
"""Offset of the rotation, degrees, and scaling, per cent: natural star, visible, 40 x 40."""

NGS_IR = {"GPAO2": (80.01, 95.4, 3.7, -0.6)}
"""The same of the infrared sensor, with both anamorphoses, per cent."""

AZIMUTHS = {"GPAO1": 20.0, "GPAO2": 105.0, "GPAO3": 200.0, "GPAO4": 310.0}
MODES = np.array([0, 1, 3, 6, 10, 15, 21, 30, 40, 55])


@pytest.fixture(scope="module")
def lenslets():
    """The small sensor, its cut lenslets left out: there the spots' cells are black or white."""
    instrument = load_instrument(FILE)
    wfs = replace(instrument.wfs, partly_lit=PartlyLit.LEAVE_OUT)
    return replace(instrument, stop=Stop.TELESCOPE, wfs=wfs)


def measured(instrument, alpha, stretch=(0.0, 0.0)):
    """Return a matrix of spots, the mirror's image turned, scaled and stretched on the sensor."""
    basis = modal_basis(instrument).subset(MODES)
    along, across = stretch
    image = np.array([[1.0 + along, across], [across, 1.0 - along]])

    def opd_at(points):
        on_mirror = np.linalg.solve(image, points.T).T @ rotation(alpha.rotation_rad)
        return basis.render(on_mirror / alpha.magnification)

    slopes = pushed(instrument, opd_at, (0.0, 0.0), np.ones_like)
    matrix = slopes[:, valid_subapertures(instrument)].reshape(-1, len(MODES))
    return Reference(matrix=matrix, modes=MODES)


def nominal(azimuth_deg):
    return LAW.at({"azimuth": azimuth_deg})


@pytest.mark.parametrize(
    "name",
    ["GPAO1", *(pytest.param(k, marks=pytest.mark.long) for k in ("GPAO2", "GPAO3", "GPAO4"))],
)
def test_offset_and_scaling_are_those_of_the_table(lenslets, name):
    offset_deg, scaling = NGS_VIS[name]
    begin = nominal(AZIMUTHS[name])
    true = Misregistration(
        rotation_rad=begin.rotation_rad + np.deg2rad(offset_deg), magnification=scaling / 100
    )
    fit = fit_matrix(lenslets, measured(lenslets, true), FitOptions(start=begin))
    found_deg = np.rad2deg(fit.alpha.rotation_rad - begin.rotation_rad)
    assert found_deg == pytest.approx(offset_deg, abs=0.005)
    assert 100 * fit.alpha.magnification == pytest.approx(scaling, abs=0.05)


@pytest.mark.long
def test_the_largest_anamorphosis_is_found_beside_them(lenslets):
    """To one of the last digit: the fit takes a stretch for small, 3.7 % comes out as 3.8."""
    offset_deg, scaling, along, across = NGS_IR["GPAO2"]
    begin = nominal(AZIMUTHS["GPAO2"])
    begin = replace(begin, rotation_rad=begin.rotation_rad + np.deg2rad(80.0))
    true = Misregistration(
        rotation_rad=nominal(AZIMUTHS["GPAO2"]).rotation_rad + np.deg2rad(offset_deg),
        magnification=scaling / 100,
    )
    stretch = (along / 200, across / 200)
    reference = measured(lenslets, true, stretch)
    fit = fit_matrix(lenslets, reference, FitOptions(start=begin, anamorphosis=True))
    found_deg = np.rad2deg(fit.alpha.rotation_rad - nominal(AZIMUTHS["GPAO2"]).rotation_rad)
    assert found_deg == pytest.approx(offset_deg, abs=0.005)
    assert 100 * fit.alpha.magnification == pytest.approx(scaling, abs=0.1)
    assert 200 * fit.anamorphosis == pytest.approx([along, across], abs=0.1)
