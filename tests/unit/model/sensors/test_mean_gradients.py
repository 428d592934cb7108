"""Lenslets of a geometric simulator: mean gradients, by hand and against a field without end."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pyrcal.fitting.matrix import fit_matrix
from service.errors import ConfigurationError
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import instrument_pupil
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness
from service.model.sensors.shack_hartmann.table import Centroid
from tests.support.numerics import SOMEWHERE

FILE = Path(__file__).parents[3] / "data" / "lenslets.toml"


@pytest.fixture(scope="module")
def lenslets():
    about = load_instrument(FILE)
    return replace(about, wfs=replace(about.wfs, centroid=Centroid.GRADIENT))


def slopes(instrument, wavefront, shift=(0.3, -0.2)):
    """Slopes ``(2, n_valid)`` of a wavefront in waves, and the light of each subaperture."""
    pupil = instrument_pupil(instrument, 4)
    sensor = kind_of(instrument).sensor(instrument, pupil, Fineness(dtype=np.float64))
    seen = sensor.at(shift)
    light = seen.light.sum(axis=(1, 3))[sensor.valid]
    opd_m = instrument.wfs.wavelength_m * wavefront(pupil.points)
    return seen.apply(opd_m[:, None])[:, 0].reshape(2, -1), light / light.max(), sensor.valid


def test_a_tilt_is_as_many_waves_however_a_subaperture_is_lit(lenslets):
    seen, light, _ = slopes(lenslets, lambda points: points @ [0.1, -0.05])
    assert light.min() < 0.9
    np.testing.assert_allclose(seen, np.outer([0.1, -0.05], np.ones(len(light))), atol=1e-5)


def test_a_cubic_has_its_mean_gradient_in_full_subapertures(lenslets):
    """Of x³ over a width of one about X: 3 X² + 1/4; beside the edge they read what goes on."""
    seen, light, valid = slopes(lenslets, lambda points: 1e-3 * points[:, 0] ** 3)
    _, x = np.nonzero(valid)
    middle = x - 5.5 - 0.3
    full = light > 0.9999
    expected = 1e-3 * (3.0 * middle**2 + 0.25)
    np.testing.assert_allclose(seen[0, full], expected[full], atol=1e-5)
    np.testing.assert_allclose(seen[1, full], 0.0, atol=1e-5)


def test_derivatives_are_those_of_the_matrix(lenslets):
    model = InteractionModel(lenslets, modal_basis(lenslets).subset(np.arange(12)), dtype=float)
    for derivative, step in zip(model.derivatives(SOMEWHERE), 1e-5 * np.eye(4), strict=True):
        less, more = (
            model.interaction_matrix(Misregistration.from_vector(SOMEWHERE.vector + side * step))
            for side in (-1.0, 1.0)
        )
        difference = (more - less) / 2e-5
        assert np.linalg.norm(derivative - difference) < 1e-5 * np.linalg.norm(difference)


def test_a_fit_leaves_out_what_the_edge_cuts_and_finds_the_registration(lenslets):
    """Told as six pixels the same matrix turns α by thousandths of a degree."""
    fine = InteractionModel(lenslets, modal_basis(lenslets), pupil_sampling=8)
    measured = Reference(matrix=fine.interaction_matrix(SOMEWHERE).astype(np.float64))
    found = fit_matrix(lenslets, measured)
    error = np.abs(found.alpha.vector - SOMEWHERE.vector)
    assert np.all(error < [1e-3, 1e-3, np.deg2rad(0.002), 1e-4]), error
    spots = replace(lenslets, wfs=replace(lenslets.wfs, centroid=Centroid.CENTRE_OF_GRAVITY))
    assert fit_matrix(spots, measured).residual_fraction > 3.0 * found.residual_fraction


def test_a_lasers_spots_have_no_mean_gradient(tmp_path):
    star = "height_m = 9e4\nthickness_m = 1e4\nspot_arcsec = 1.5\nlauncher_m = [2.0, 0.0]\n"
    words = FILE.read_text().replace(
        'kind = "shack-hartmann"', 'kind = "shack-hartmann"\ncentroid = "gradient"'
    )
    path = tmp_path / "lenslets.toml"
    path.write_text(f"{words}\n[wfs.laser]\n{star}")
    with pytest.raises(ConfigurationError, match='centroid: found "gradient"'):
        load_instrument(path)
