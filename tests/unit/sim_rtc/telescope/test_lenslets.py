"""Spots of the simulated Shack-Hartmann: by hand, by brute force, with noise."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.errors import ConfigurationError
from service.instrument import load_instrument
from service.model.modes import modal_basis
from service.model.pupil import fully_lit_subapertures, instrument_pupil, valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness
from service.model.sensors.shack_hartmann.table import Centroid, LaserStar
from service.model.slopes import PLAIN
from sim_rtc.assembly import departures_of
from sim_rtc.options import parse_options
from sim_rtc.telescope.detector import Camera, Detector, PixelDetector
from sim_rtc.telescope.diffractive import DiffractivePlant, build_centred_pupil
from sim_rtc.telescope.imperfections import SETS
from sim_rtc.telescope.lenslets import LENSLET_SAMPLING, DiffractiveLenslets
from tests.support.fft_spots import pushed

FILE = Path(__file__).parents[3] / "data" / "lenslets.toml"
SHIFT = (0.3, -0.2)
LASER = LaserStar(height_m=9e4, thickness_m=1.5e4, spot_arcsec=0.8, launcher_m=(2.5, 0.5))


@pytest.fixture(scope="module")
def lenslets():
    return load_instrument(FILE)


def sensor_of(instrument, shift=SHIFT):
    pupil = build_centred_pupil(instrument, LENSLET_SAMPLING)
    return DiffractiveLenslets(instrument.wfs, pupil, instrument.subaperture_m, shift), pupil


def inner(instrument):
    """Return valid subapertures that the edge does not reach at a shift of a third."""
    radius = np.hypot(*np.indices((12, 12)) - 5.5)
    return ((radius < 4.7) & (radius > 2.2))[valid_subapertures(instrument)]


def test_light_of_a_full_lenslet_is_what_its_field_holds(lenslets):
    """Within 3 λ/d of the middle sinc² has 0.966 along one axis."""
    sensor, pupil = sensor_of(lenslets, (0.0, 0.0))
    light = sensor.images(np.zeros(len(pupil.points), np.float32)).sum(axis=(1, 3))
    full = fully_lit_subapertures(lenslets)
    np.testing.assert_allclose(np.median(light[full]), 0.966**2, rtol=0.03)


def test_mean_gradients_have_no_spots(lenslets):
    about = replace(lenslets, wfs=replace(lenslets.wfs, centroid=Centroid.GRADIENT))
    with pytest.raises(ConfigurationError, match='found "gradient" with --plant diffractive'):
        sensor_of(about)


@pytest.mark.parametrize("centroid", sorted(set(Centroid) - {Centroid.GRADIENT}))
def test_small_wavefronts_move_spots_as_those_by_brute_force(lenslets, centroid):
    """3 %: four points for a lenslet, and two samples of the light for a pixel."""
    about = replace(lenslets, wfs=replace(lenslets.wfs, centroid=centroid, threshold=0.02))
    sensor, pupil = sensor_of(about)
    valid = valid_subapertures(about)
    counted = {
        Centroid.CENTRE_OF_GRAVITY: np.ones_like,
        Centroid.WEIGHTED: lambda spot: spot,
        Centroid.THRESHOLD: lambda spot: spot >= 0.02 * spot.max(),
    }[centroid]

    def opd(points):
        x, y = points.T
        return (np.sin(x / 1.7 + 0.3) * np.cos(y / 2.3) + 0.05 * x * y)[:, None]

    step = (2e-9 * opd(pupil.points)[:, 0]).astype(np.float32)
    push, pull = (sensor.signals(sensor.images(s * step), valid, PLAIN) for s in (1, -1))
    slopes = ((push - pull) / 4e-9).reshape(2, -1)[:, inner(about)]
    brute = pushed(about, opd, SHIFT, counted)[:, valid, 0][:, inner(about)]
    gain = np.vdot(brute, slopes) / np.vdot(brute, brute)
    assert abs(gain - 1.0) < (0.1 if centroid is Centroid.WEIGHTED else 0.04)
    assert np.linalg.norm(slopes - gain * brute) < 0.03 * np.linalg.norm(slopes)


@pytest.mark.parametrize(("magnitude", "read_noise"), [(8.0, 0.0), (7.0, 6.0)])
def test_noise_of_centroids_is_that_of_their_photons_and_pixels(lenslets, magnitude, read_noise):
    """A third of it is left to the shape of the pixels: a photon's place is known to one."""
    camera = Camera(read_noise_electrons=read_noise)
    plant = DiffractivePlant(
        lenslets, modal_basis(lenslets), rng=np.random.default_rng(1), imperfections=SETS["ideal"]
    )
    optics = plant.optics(lenslets.start)
    electrons = camera.electrons_per_frame(lenslets, magnitude=magnitude, frame_rate_hz=500.0)
    detector = PixelDetector(electrons_per_light=electrons, camera=camera)
    flat, rng = np.zeros(len(plant.points_m), np.float32), np.random.default_rng(2)
    slopes = np.array([optics.slopes(flat, detector, rng) for _ in range(300)])
    full = np.tile(fully_lit_subapertures(lenslets)[plant.valid], 2)
    own = electrons * optics.images.sum(axis=(1, 3))[fully_lit_subapertures(lenslets)].mean()
    told = kind_of(lenslets).slope_noise(lenslets, own, read_noise)
    assert slopes[:, full].std() == pytest.approx(told, rel=0.3)
    assert abs(slopes[:, full].mean()) < 5 * told / np.sqrt(slopes[:, full].size)


@pytest.mark.parametrize(
    ("name", "words", "gains"),
    [
        (str(FILE), (), (1.0, 1.0)),
        (str(FILE), ("--optical-gain=0.7,0.8",), (0.7, 0.8)),
        ("flao-lbt", (), (0.6, 0.9)),
    ],
)
def test_only_a_pyramid_is_given_an_optical_gain_unasked(name, words, gains):
    found = departures_of(parse_options([f"--instrument={name}", *words]), load_instrument(name))
    assert (found.lowest_optical_gain, found.highest_optical_gain) == gains


def test_a_threshold_keeps_the_noise_of_dark_pixels_out(lenslets):
    rng = np.random.default_rng(3)
    valid = valid_subapertures(lenslets)
    spread = {}
    for centroid in (Centroid.CENTRE_OF_GRAVITY, Centroid.THRESHOLD):
        about = replace(lenslets, wfs=replace(lenslets.wfs, centroid=centroid, threshold=0.2))
        sensor, pupil = sensor_of(about, (0.0, 0.0))
        light = 1000 * sensor.images(np.zeros(len(pupil.points), np.float32))
        noisy = [light + 10.0 * rng.standard_normal(light.shape) for _ in range(50)]
        spread[centroid] = np.std([sensor.signals(one, valid, PLAIN) for one in noisy])
    assert spread[Centroid.THRESHOLD] < 0.5 * spread[Centroid.CENTRE_OF_GRAVITY]


@pytest.mark.parametrize("centroid", [Centroid.CENTRE_OF_GRAVITY, Centroid.WEIGHTED])
def test_elongated_spots_move_as_the_model_says_though_they_are_made_in_another_way(
    lenslets, centroid
):
    """Sheets at their own heights against a Gaussian along a line: 1 % are the lenslets' points."""
    about = replace(lenslets, wfs=replace(lenslets.wfs, centroid=centroid, laser=LASER))
    sensor, pupil = sensor_of(about)
    valid, points = valid_subapertures(about), instrument_pupil(about, 6)

    def opd(at):
        x, y = at.T
        return np.sin(x / 1.7 + 0.3) * np.cos(y / 2.3) + 0.05 * x * y

    step = (2e-9 * opd(pupil.points)).astype(np.float32)
    push, pull = (sensor.signals(sensor.images(s * step), valid, PLAIN) for s in (1, -1))
    slopes = ((push - pull) / 4e-9).reshape(2, -1)[:, inner(about)]
    response = kind_of(about).sensor(about, points, Fineness()).at(SHIFT)
    ours = response.apply(opd(points.points)[:, None]).reshape(2, -1)[:, inner(about)]
    point = kind_of(lenslets).sensor(lenslets, points, Fineness()).at(SHIFT)
    plain = point.apply(opd(points.points)[:, None]).reshape(2, -1)[:, inner(about)]
    np.testing.assert_allclose(slopes, ours, atol=0.02 * np.abs(ours).max())
    assert np.linalg.norm(slopes - ours) < 0.2 * np.linalg.norm(slopes - plain)


def test_light_and_noise_of_elongated_spots_are_those_of_the_model(lenslets):
    """Anisotropic: σ of each slope, over 400 frames of a bright star, to 15 %."""
    about = replace(lenslets, wfs=replace(lenslets.wfs, laser=LASER))
    plant = DiffractivePlant(
        about, modal_basis(about), rng=np.random.default_rng(1), imperfections=SETS["ideal"]
    )
    optics = plant.optics(about.start)
    camera = Camera(read_noise_electrons=1.0)
    electrons = camera.electrons_per_frame(about, magnitude=5.0, frame_rate_hz=500.0)
    pixels = PixelDetector(electrons_per_light=electrons, camera=camera)
    flat, rng = np.zeros(len(plant.points_m), np.float32), np.random.default_rng(2)
    slopes = np.array([optics.slopes(flat, pixels, rng) for _ in range(400)])
    told = Detector(
        about,
        images=optics.images,
        valid=plant.valid,
        magnitude=5.0,
        frame_rate_hz=500.0,
        camera=camera,
    ).sigma
    full = np.tile(fully_lit_subapertures(about)[plant.valid], 2)
    np.testing.assert_allclose(slopes.std(axis=0)[full], told[full], rtol=0.15)
    assert told[full].max() > 1.4 * told[full].min()
