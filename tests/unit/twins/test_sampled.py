"""Signals in a bench's own order, with its own axes and signs, come out of the exported model."""

from dataclasses import replace

import numpy as np
import pytest

import pyrcal
from pyrcal.twins.check import Checked, check_oopao_model
from pyrcal.twins.oopao_model import write_oopao_model
from pyrcal.twins.sampled import sample_bench
from service.files.disk_cache import cached_basis
from service.model.interaction import RtcInteractionModel
from service.model.kinds import SlopeOrder, Stop
from service.model.misregistration import Misregistration
from service.model.pupil import valid_subapertures
from service.model.sensors.pyramid.table import FftGrid
from service.model.slopes import Orientation, SlopeRecipe, rtc_mask
from tests.support.twin import find_interpreter

ALPHA = Misregistration(shift_x_subap=0.2, shift_y_subap=-0.1, rotation_rad=0.03)

ABERRATION_RAD = (0.1, 0.0, 0.3, -0.2, 0.1, 0.2, -0.1)

TURNED = Orientation(swap_xy=True, flip_x=True, sign_x=1, sign_y=-1)


def describe(instrument, recipe, stop):
    """Return an aberrated bench with other habits, and OOPAO's usual grid of its sampling."""
    valid = valid_subapertures(instrument).copy()
    valid[1, 3] = False  # so that no turn of the mask is the same mask
    width = 2 * instrument.wfs.image_separation_subap
    wfs = replace(
        instrument.wfs,
        valid_subapertures=rtc_mask(valid, recipe.assumed_orientation),
        fft_grid=FftGrid(points_per_subaperture=4, width_subap=width),
        aberration_rad=ABERRATION_RAD,
    )
    return replace(instrument, slopes=recipe, wfs=wfs, stop=stop)


@pytest.mark.long
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("recipe", "stop"),
    [
        (SlopeRecipe(order=SlopeOrder.YX, orientation=TURNED), Stop.TELESCOPE),
        (SlopeRecipe(order=SlopeOrder.PIXELS, orientation=TURNED), Stop.TELESCOPE),
        (SlopeRecipe(orientation=Orientation()), Stop.MIRROR),
    ],
)
def test_oopao_measures_what_pyrcal_computes(recipe, stop, bench, tmp_path):
    python = find_interpreter("OOPAO")
    about = describe(bench[0], recipe, stop)
    model = RtcInteractionModel(about, cached_basis(about), pupil_sampling=4, detector_nodes=4)
    fit = pyrcal.fit(about, model.interaction_matrix(ALPHA), threads=1)
    write_oopao_model(sample_bench(about, fit), tmp_path)
    found = check_oopao_model(tmp_path, about, fit, python=python)
    assert isinstance(found, Checked), found
    # OOPAO's circle has twenty points; a wrong order or sign leaves most of the signal
    assert found.left_over <= 0.02
    assert found.correlation.min() > 0.998


def test_the_light_that_a_fit_finds_is_in_the_exported_pupil(bench):
    instrument, fit = bench
    falling = np.linspace(1.5, 0.5, len(fit.valid)) * np.ones(fit.valid.shape)
    even = sample_bench(instrument, fit).amplitude
    lit = sample_bench(instrument, replace(fit, gain_map=falling)).amplitude
    sampling, seen = len(even) // len(fit.valid), even > 0.0
    along = (np.arange(len(even)) + 0.5) / sampling - 0.5
    expected = np.interp(along, np.arange(len(falling)), falling[0]) * np.ones(even.shape)
    assert (lit[seen] / even[seen]) ** 2 == pytest.approx(expected[seen], rel=1e-6)
    # beyond the valid subapertures the light is that of the nearest one
    cut = np.where(fit.valid, falling, np.nan)
    lit = sample_bench(instrument, replace(fit, gain_map=cut)).amplitude
    assert np.all((lit > 0.0) == seen)


def test_the_pupil_of_the_sky_is_on_the_array_of_the_calibration(bench, tmp_path):
    sampled = sample_bench(*bench)
    y, x = np.indices((40, 40)) - 19.5
    ring = (np.hypot(x, y) <= 20.0) & (np.hypot(x, y) >= 6.0)
    exported = write_oopao_model(sampled, tmp_path, ring)
    with np.load(exported.path.with_suffix(".npz")) as arrays:
        sky, calibration = arrays["sky_amplitude"], arrays["amplitude"]
    assert sky.shape == calibration.shape
    middle = len(sky) // 2
    assert sky[middle, middle] == 0.0
    assert sky.sum() == pytest.approx(ring.mean() * sky.size, rel=0.02)
