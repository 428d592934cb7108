"""A telescope that sends pixels: the same light, of which slopes are made elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.model.kinds import SignalKind, SlopeOrder
from service.model.misregistration import Misregistration
from service.model.slopes import SlopeRecipe, slopes_of
from sim_rtc.assembly import check_supported
from sim_rtc.computer.reconstructors import identity_of
from sim_rtc.telescope.diffractive import DiffractivePlant
from sim_rtc.telescope.imperfections import SETS
from sim_rtc.telescope.linear import LinearPlant

TURNED = Misregistration(
    shift_x_subap=0.2, shift_y_subap=-0.1, rotation_rad=0.01, magnification=1.004
)


def seen(plant_of, instrument, basis):
    """A plant with every imperfection, and what it makes of a few modes at once."""
    made = {"imperfections": replace(SETS["realistic"], bad_pixels=2)}
    plant = plant_of(instrument, basis, rng=np.random.default_rng(1), **made)
    optics = plant.optics(TURNED)
    command = np.linspace(3e-8, -2e-8, 40).astype(np.float32)
    if plant_of is LinearPlant:
        return plant, optics.slopes_per_command @ command
    opd_m = optics.mirror_opd_m(command)
    return plant, optics.slopes(opd_m, None, np.random.default_rng(2))


@pytest.mark.parametrize("plant_of", [LinearPlant, DiffractivePlant])
def test_slopes_made_of_the_pixels_are_the_slopes(plant_of, small_instrument, small_basis):
    pixels = replace(small_instrument, slopes=SlopeRecipe(order=SlopeOrder.IMAGES))
    check_supported(pixels)
    plant, signals = seen(plant_of, pixels, small_basis)
    beside, slopes = seen(plant_of, small_instrument, small_basis)
    assert len(signals) == 2 * len(slopes)
    found = slopes_of(signals, SignalKind.INTENSITY).ravel()
    np.testing.assert_allclose(found, slopes, atol=2e-6 * np.abs(slopes).max())
    silent = signals.reshape(4, -1)[:, plant.slope_errors.silent]
    assert silent.size
    np.testing.assert_array_equal(silent, 0.0)
    names = [identity_of(one, plant.valid).config_id for one in (pixels, small_instrument)]
    assert names[0] != names[1]
    assert beside.slope_errors.recipe.kind is SignalKind.XY
