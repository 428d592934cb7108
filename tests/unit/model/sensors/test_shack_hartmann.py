"""A geometric Shack-Hartmann: slopes by hand, rates against differences, its instrument file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy

from pyrcal.fitting.matrix import fit_matrix
from service.errors import ConfigurationError
from service.estimation.reference import Reference, target_of
from service.instrument import load_instrument
from service.model.instrument import instrument_sha256
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import (
    Illumination,
    fully_lit_subapertures,
    instrument_pupil,
    valid_subapertures,
)
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import CannotTell, Fineness
from service.model.sensors.shack_hartmann.table import LaserStar
from tests.support.numerics import SOMEWHERE

FILE = Path(__file__).parents[3] / "data" / "lenslets.toml"
DOUBLE = Fineness(dtype=np.float64)
LASER = LaserStar(height_m=9e4, thickness_m=1.5e4, spot_arcsec=0.8, launcher_m=(2.5, 0.5))
DIGEST = "8b7f65efd1a2ec806dd4989fbe3521d37e4d59b531372dc9fab59a4a29479506"
STAR = "height_m = 9e4\nthickness_m = 1e4\nspot_arcsec = 1.5\nlauncher_m = [2.0, 0.0]\n"
""""[wfs.laser]" of a file."""


@pytest.fixture(scope="module")
def lenslets():
    return load_instrument(FILE)


def sensor_of(instrument, sampling=3):
    pupil = instrument_pupil(instrument, sampling)
    return kind_of(instrument).sensor(instrument, pupil, DOUBLE), pupil.points


def full_gain():
    """Return slopes of full lenslets over the gradient: six pixels of λ/d each, by hand.

    A spot sinc² u moves light over the edges of pixels, the whole numbers: it is dark on all but
    the middle one. Light that moves over that edge counts one pixel, over what is in the field.
    """
    inside, _ = scipy.integrate.quad(lambda u: np.sinc(u) ** 2, -3.0, 3.0, limit=200)
    return 1.0 / inside


def test_a_tilt_is_as_many_waves_across_each_full_subaperture(lenslets):
    sensor, points = sensor_of(lenslets)
    seen = sensor.at((0.3, -0.2))
    slopes = seen.apply(np.outer(points[:, 0], [75e-9]))[:, 0].reshape(2, -1)
    light = seen.light.sum(axis=(1, 3))
    full = light[sensor.valid] > 0.9999 * light.max()
    np.testing.assert_allclose(slopes[0, full], 0.1 * full_gain(), rtol=1e-3)
    np.testing.assert_allclose(slopes[1, full], 0.0, atol=1e-6)


def test_a_wide_field_tells_the_mean_gradient_however_a_subaperture_is_lit(lenslets):
    """Centroid and gradient are one where nothing is cut; 2 % are wings beyond 20 λ/d."""
    wide = replace(lenslets, wfs=replace(lenslets.wfs, pixels_per_subaperture=40))
    sensor, points = sensor_of(wide)
    slopes = sensor.at((0.3, -0.2)).apply(np.outer(points[:, 1], [75e-9]))[:, 0].reshape(2, -1)
    np.testing.assert_allclose(slopes[1], 0.1, rtol=0.03)
    np.testing.assert_allclose(slopes[0], 0.0, atol=0.003)


def test_the_slope_of_a_parabola_is_that_in_the_middle_of_a_lit_subaperture(lenslets):
    sensor, points = sensor_of(lenslets)
    seen = sensor.at((0.0, 0.0))
    slopes = seen.apply((points**2 @ [0.5, 0.5])[:, None] * 750e-9)[:, 0]
    y, x = np.nonzero(sensor.valid)
    middle = np.column_stack([x, y]) - 5.5
    full = (np.hypot(*middle.T) < 4.0) & (np.hypot(*middle.T) > 2.0)
    found = slopes.reshape(2, -1)[:, full]
    np.testing.assert_allclose(found, full_gain() * middle[full].T, rtol=1e-3)


@pytest.mark.parametrize("laser", [None, LASER])
@pytest.mark.parametrize("stop", Stop)
def test_derivatives_are_those_of_the_matrix(lenslets, stop, laser):
    """Nodes that pass a point of the pupil within the step are what is left."""
    about = replace(lenslets, stop=stop, wfs=replace(lenslets.wfs, laser=laser))
    model = InteractionModel(about, modal_basis(about).subset(np.arange(12)), dtype=np.float64)
    for derivative, step in zip(model.derivatives(SOMEWHERE), 1e-5 * np.eye(4), strict=True):
        less, more = (
            model.interaction_matrix(Misregistration.from_vector(SOMEWHERE.vector + side * step))
            for side in (-1.0, 1.0)
        )
        difference = (more - less) / 2e-5
        assert np.linalg.norm(derivative - difference) < 1e-5 * np.linalg.norm(difference)


def test_a_subaperture_that_the_shift_leaves_in_the_dark_does_not_spoil_a_fit(lenslets):
    """Seven have less than 5 % of their light at 0.9 subapertures; the truth has finer grids."""
    truth = Misregistration(
        shift_x_subap=0.9, shift_y_subap=-0.5, rotation_rad=0.04, magnification=0.98
    )
    basis = modal_basis(lenslets)
    fine = InteractionModel(lenslets, basis, pupil_sampling=6)
    light = fine.sensor.at((0.9, -0.5)).light.sum(axis=(1, 3))[fine.valid]
    assert np.sum(light < 0.05) == 7
    measured = fine.interaction_matrix(truth).astype(np.float64)
    found = fit_matrix(lenslets, Reference(matrix=measured), basis=basis)
    error = np.abs(found.alpha.vector - truth.vector)
    assert np.all(error < [0.0025, 0.002, np.deg2rad(0.01), 2e-4]), error


def test_uneven_light_is_read_as_it_lies_in_the_pupil(lenslets):
    """A ramp: a subaperture has the light of its middle."""
    pupil = instrument_pupil(lenslets, 3)
    ramp = Illumination(
        coordinates=pupil.coordinates,
        intensity=np.broadcast_to(1.0 + 0.1 * pupil.coordinates, pupil.amplitude.shape),
    )
    even, uneven = (
        kind_of(lenslets).sensor(lenslets, one, DOUBLE).at((0.0, 0.0)).light.sum(axis=(1, 3))
        for one in (pupil, pupil.lit_by(ramp))
    )
    middle = np.broadcast_to(1.0 + 0.1 * (np.arange(12) - 5.5), (12, 12))
    full = fully_lit_subapertures(lenslets)
    np.testing.assert_allclose(uneven[full], middle[full] * even[full], rtol=3e-3)


def test_k_is_what_is_applied(lenslets):
    sensor, points = sensor_of(lenslets)
    shapes = np.random.default_rng(1).normal(size=(len(points), 3))
    seen = sensor.at((0.1, 0.2))
    np.testing.assert_allclose(seen.jacobian() @ shapes, seen.apply(shapes), rtol=1e-4, atol=1.0)


def test_its_light_tells_nothing_of_the_pupil(lenslets):
    found = kind_of(lenslets).light(lenslets)
    assert isinstance(found, CannotTell)
    assert "a shack-hartmann" in found.reason


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("wavelength_m", 'centroid = "threshold"\nwavelength_m', "threshold: found none"),
        ("wavelength_m", "threshold = 0.1\nwavelength_m", 'found 0.1 with centroid = "cog"'),
        (
            "wavelength_m",
            'centroid = "threshold"\nthreshold = 0.1\npartly_lit = "use"\nwavelength_m',
            'partly_lit: found "use" with a threshold of 0.1, expected "leave out"',
        ),
        ("wavelength_m", "pixel_scale_arcsec = 0.001\nwavelength_m", "expected 1.5 to 60"),
        ("wavelength_m", "guide_star_height_m = 9e4\nwavelength_m", "a table [wfs.laser]"),
        (
            "[mirror]",
            f'guide_star_height_m = "infinity"\n[wfs.laser]\n{STAR}[mirror]',
            "guide_star_height_m: has no effect",
        ),
        ("[mirror]", f"[wfs.laser]\n{STAR}[mirror]".replace("launcher_m", "#"), "laser.launcher_m"),
        ("[mirror]", f"[wfs.laser]\n{STAR}[mirror]".replace("9e4", "90"), "laser.height_m"),
        ("[mirror]", f"[wfs.laser]\n{STAR}[mirror]".replace("1.5", "0.1"), "expected 0.5 λ/d"),
        (
            "[mirror]",
            f"[wfs.laser]\n{STAR}[mirror]".replace("[2.0, 0.0]", "[200.0, 0.0]"),
            "laser.thickness_m: found spots of up to 51.3 arcseconds in a field of 3.71",
        ),
        (
            "wavelength_m",
            'centroid = "threshold"\nthreshold = 0.5\nwavelength_m',
            "threshold: found 0.5: a spot that moves by 0.2 λ/d moves its centroid by 1.7 times",
        ),
        (
            "wavelength_m",
            'pixels_per_subaperture = 7\ncentroid = "threshold"\nthreshold = 0.3\nwavelength_m',
            "threshold: found 0.3",
        ),
        ("wavelength_m", 'centroid = "matched"\nwavelength_m', "wfs.centroid"),
        ("wavelength_m", "pixels_per_subaperture = 1\nwavelength_m", "pixels_per_subaperture"),
        ("shack-hartmann", "curvature", "'curvature', expected 'pyramid' or 'shack-hartmann'"),
        ("n_subapertures", "tilt = 3.0\nn_subapertures", "wfs.tilt: unknown key"),
        (
            "n_subapertures",
            "modulation_lambda_over_d = 3.0\nn_subapertures",
            'wfs.modulation_lambda_over_d: belongs to kind = "pyramid", found kind = '
            '"shack-hartmann": leave it out, or give the other sensor a file of its own',
        ),
        ('kind = "shack-hartmann"', 'centroid = "cog"', "wfs.centroid: belongs to kind"),
        (
            "[mirror]",
            '[[wfs]]\nkind = "pyramid"\nn_subapertures = 30\n[mirror]',
            "wfs: found 2 tables [[wfs]], expected one table [wfs]: a service has one sensor",
        ),
        ("[modes]", '[slopes]\nkind = "intensity"\n[modes]', "intensity of a shack-hartmann"),
        (
            "[modes]",
            '[slopes]\nnormalisation = "local"\n[modes]',
            "slopes.normalisation: has no effect",
        ),
    ],
)
def test_what_is_no_lenslets_is_refused_in_one_line(tmp_path, old, new, said):
    path = tmp_path / "other.toml"
    text = FILE.read_text("utf-8").replace(old, new, 1)
    if "[[wfs]]" in new:
        text = text.replace("[wfs]", "[[wfs]]", 1)
    path.write_text(text, "utf-8")
    with pytest.raises(ConfigurationError) as refused:
        load_instrument(path)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_may_have_a_laser_star_and_one_without_has_the_digest_it_had(tmp_path, lenslets):
    path = tmp_path / "laser.toml"
    path.write_text(
        FILE.read_text("utf-8").replace("[mirror]", f"[wfs.laser]\n{STAR}[mirror]"), "utf-8"
    )
    laser = load_instrument(path).wfs.laser
    assert laser == LaserStar(height_m=9e4, thickness_m=1e4, spot_arcsec=1.5, launcher_m=(2.0, 0.0))
    assert instrument_sha256(lenslets) == DIGEST
    assert instrument_sha256(replace(lenslets, wfs=replace(lenslets.wfs, laser=laser))) != DIGEST


def test_beside_a_threshold_fits_leave_out_what_the_edge_cuts_and_say_so(tmp_path):
    path = tmp_path / "threshold.toml"
    lines = 'centroid = "threshold"\nthreshold = 0.05\nwavelength_m'
    path.write_text(FILE.read_text("utf-8").replace("wavelength_m", lines, 1), "utf-8")
    about = load_instrument(path)
    assert any('partly_lit: not given, taken as "leave out"' in remark for remark in about.remarks)
    left_out = kind_of(about).left_out(about)
    valid = valid_subapertures(about)
    seen = kind_of(about).sensor(about, instrument_pupil(about, 4), DOUBLE).at((0.0, 0.0))
    light = seen.light.sum(axis=(1, 3)) / seen.light.sum(axis=(1, 3)).max()
    assert np.all(light[valid & ~left_out.subapertures] > 0.98)
    assert np.all(light[left_out.subapertures] < 0.999)
    model = InteractionModel(about, modal_basis(about).subset(np.arange(20)))
    measured = model.interaction_matrix(SOMEWHERE)
    target = target_of(Reference(matrix=measured), about)
    np.testing.assert_array_equal(target.rows, np.tile(~left_out.subapertures[valid], 2))
