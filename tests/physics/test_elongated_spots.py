"""D of a laser star's spots against spots by brute force, blurred by what the star looks like."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy

from service.instrument import load_instrument
from service.model.interaction import InteractionModel, RtcInteractionModel
from service.model.kinds import SlopeOrder
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.sensors.registry import kind_of
from service.model.sensors.shack_hartmann.table import Centroid, LaserStar
from service.model.slopes import Orientation, SlopeRecipe
from tests.support.fft_spots import FINE, PADDED, PUSH_M, SAMPLES, centroids, fine_points

FILE = Path(__file__).parents[1] / "data" / "lenslets.toml"
N_PIXELS = 6
STAR = LaserStar(height_m=9e4, thickness_m=1.5e4, spot_arcsec=0.8, launcher_m=(2.5, 0.5))
FWHM = 2.3548
SHIFT = (0.18, -0.12)


@pytest.fixture(scope="module")
def lenslets():
    found = load_instrument(FILE)
    return replace(found, wfs=replace(found.wfs, laser=STAR))


def light_at(field):
    """Return the light of a point star on a fine grid, its middle in the middle."""
    aside = np.exp(-1j * np.pi / PADDED * np.arange(SAMPLES))
    seen = np.fft.fft2(field * np.outer(aside, aside), s=(PADDED, PADDED))
    return np.fft.fftshift(np.abs(seen) ** 2, axes=(-2, -1))


def star_seen(instrument, y, x):
    """Return what the star looks like to a lenslet: a Gaussian streak, drawn and blurred."""
    width_m = instrument.subaperture_m
    lambda_over_d = instrument.wfs.wavelength_m / width_m
    place = width_m * (np.array([x, y]) - (instrument.wfs.n_subapertures - 1) / 2)
    along = (place - np.array(STAR.launcher_m)) * STAR.thickness_m / STAR.height_m**2
    z = np.linspace(-4.0, 4.0, 801)
    places = FINE * np.outer(z, along / FWHM / lambda_over_d)
    borders = np.arange(-40.5, 41.5)
    drawn, _, _ = np.histogram2d(
        places[:, 1], places[:, 0], bins=(borders, borders), weights=np.exp(-(z**2) / 2)
    )
    across = FINE * np.deg2rad(STAR.spot_arcsec / 3600) / FWHM / lambda_over_d
    blurred = scipy.ndimage.gaussian_filter(drawn, across, mode="constant")
    return blurred / blurred.sum()


def on_pixels(light, star):
    blurred = scipy.signal.fftconvolve(light, star, mode="same")
    side = N_PIXELS * FINE // 2
    middle = slice(PADDED // 2 - side, PADDED // 2 + side)
    pixels = blurred[middle, middle].reshape(N_PIXELS, FINE, N_PIXELS, FINE)
    return pixels.sum(axis=(1, 3))


def pushed(instrument, basis, some, counted):
    """Return slopes ``(2, n_some, n_modes)`` per metre of lenslets ``(y, x)``."""
    wave = 2j * np.pi / instrument.wfs.wavelength_m
    every = list(fine_points(instrument.wfs.n_subapertures, SHIFT))
    found = []
    for y, x in some:
        star, points = star_seen(instrument, y, x), every[y][x]
        counts = counted(on_pixels(light_at(np.ones((SAMPLES, SAMPLES))), star))
        opd = basis.render(points.reshape(-1, 2)).T.reshape(-1, SAMPLES, SAMPLES)
        moved = [
            centroids(
                np.array([counts * on_pixels(light_at(np.exp(s * wave * o)), star) for o in opd])
            )
            for s in (PUSH_M, -PUSH_M)
        ]
        found.append((moved[0] - moved[1]) / (2 * PUSH_M))
    return np.stack(found, axis=1)


@pytest.mark.parametrize(
    ("centroid", "counted"),
    [(Centroid.CENTRE_OF_GRAVITY, np.ones_like), (Centroid.WEIGHTED, lambda spot: spot)],
)
def test_the_matrix_is_that_of_spots_blurred_by_the_star(lenslets, centroid, counted):
    """2 % of mode 30 are the model's three points; the drawn streak is in steps of 1/8 λ/d."""
    about = replace(lenslets, wfs=replace(lenslets.wfs, centroid=centroid))
    basis = modal_basis(about).subset(np.array([0, 1, 5, 30]))
    some = [(3, 4), (6, 9), (8, 2), (2, 7)]
    brute = pushed(about, basis, some, counted)
    model = InteractionModel(about, basis, dtype=np.float64)
    alpha = Misregistration(shift_x_subap=SHIFT[0], shift_y_subap=SHIFT[1])
    ours = model.interaction_matrix(alpha).reshape(2, -1, 4)
    rows = [int(model.valid.ravel()[: y * 12 + x].sum()) for y, x in some]
    error = np.linalg.norm(ours[:, rows] - brute, axis=(0, 1)) / np.linalg.norm(brute, axis=(0, 1))
    assert np.all(error < [0.006, 0.006, 0.01, 0.03]), error


def test_an_elongated_spot_loses_gain_along_its_axis(lenslets):
    """A tilt of one wave: less is seen of it along the axis of a long spot than across.

    Weights as wide as the spot give half of any Gaussian; what is left is a point's share in it.
    """
    weighted = replace(lenslets, wfs=replace(lenslets.wfs, centroid=Centroid.WEIGHTED))
    model = InteractionModel(weighted, modal_basis(weighted))
    points = model.pupil.points
    seen = model.sensor.at((0.0, 0.0)).apply(points * weighted.wfs.wavelength_m)
    along, across = seen.reshape(2, -1, 2)[(0, 1), :, (0, 1)]
    at = [int(model.valid.ravel()[: y * 12 + x].sum()) for y, x in ((6, 1), (6, 10))]
    assert 0.5 * 0.95 < along[at[0]] < 0.92 * across[at[0]]  # 3.6 m from the launcher, at +x
    assert along[at[0]] < along[at[1]] < across[at[1]]  # 1.4 m from it
    assert across[at[0]] == pytest.approx(across[at[1]], rel=0.01)


def test_more_is_uncertain_along_the_axis_of_a_spot_than_across(lenslets):
    """Of photons; a streak of Gaussian σ adds its square, but what the field cuts away."""
    shape = kind_of(lenslets).noise_shape(lenslets)
    valid = InteractionModel(lenslets, modal_basis(lenslets)).valid
    at = int(valid.ravel()[: 6 * 12 + 1].sum())
    along, across = shape.reshape(2, -1)[:, at]
    assert along > 1.3 * across
    assert np.sqrt(np.mean(shape**2)) == pytest.approx(1.0)


def test_noise_stands_as_the_rtc_lists_its_slopes(lenslets):
    """Interleaved, mirrored along x and with signs of its own: σ has none."""
    plain = kind_of(lenslets).noise_shape(lenslets).reshape(2, -1)
    recipe = SlopeRecipe(
        order=SlopeOrder.INTERLEAVED, orientation=Orientation(flip_x=True, sign_x=-1)
    )
    about = replace(lenslets, slopes=recipe)
    model = RtcInteractionModel(about, modal_basis(about).subset(np.arange(3)))
    mask = model.valid
    maps = np.full((2, *mask.shape), np.nan)
    maps[:, mask] = plain
    turned = maps[:, :, ::-1]
    np.testing.assert_allclose(
        model.noise_shape.reshape(-1, 2).T, turned[:, mask[:, ::-1]], rtol=1e-6
    )
    at = Misregistration(shift_x_subap=0.1)
    np.testing.assert_array_equal(model.linearise(at).noise_shape, model.noise_shape)
    np.testing.assert_allclose(model.slope_noise(0.3), 0.3 * model.noise_shape)
