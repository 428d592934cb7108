from dataclasses import fields, replace

import numpy as np
import pytest

from service.errors import ConfigurationError
from service.instrument import load_instrument
from service.model.kinds import KarhunenLoeve, SignalKind, Stop
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from service.model.pupil import instrument_pupil
from service.model.sensors.pyramid.signals import pixel_places
from service.model.slopes import SlopeRecipe
from sim_rtc.telescope import imperfections
from sim_rtc.telescope.diffractive import DiffractiveOptics, DiffractivePlant
from sim_rtc.telescope.imperfections import (
    SETS,
    Imperfections,
    SlopeErrors,
    distort_points,
    image_offsets,
    non_common_path,
)
from sim_rtc.telescope.linear import LinearPlant

ALIGNED = Misregistration()
IDEAL = SETS["ideal"]
VALID = np.ones((5, 5), dtype=bool)
PIXELS = pixel_places(VALID)


@pytest.fixture(scope="module")
def pupil(small_instrument):
    return instrument_pupil(small_instrument, 4)


def plant(instrument, basis, **changes):
    return LinearPlant(
        instrument,
        basis,
        rng=np.random.default_rng(1),
        imperfections=replace(IDEAL, **changes),
    )


def matrix(instrument, basis, **changes):
    return plant(instrument, basis, **changes).optics(ALIGNED).slopes_per_command


def test_the_realistic_mix_has_every_imperfection_but_these():
    ideal, realistic = SETS["ideal"], SETS["realistic"]
    same = [
        f.name
        for f in fields(Imperfections)
        if getattr(ideal, f.name) == getattr(realistic, f.name)
    ]
    assert same == ["ncpa_zernike", "model_error", "image_offsets_px", "image_offset_rms_px"]
    assert SETS["usual"] == Imperfections()


def test_turned_axes_turn_the_slopes_and_keep_their_length():
    errors = SlopeErrors(PIXELS, replace(IDEAL, slope_rotation_deg=90.0), np.random.default_rng(1))
    slopes = np.arange(50, dtype=np.float32)
    read = errors.add_errors(slopes)
    np.testing.assert_allclose(read[25:], slopes[:25], atol=1e-5)
    np.testing.assert_allclose(read[:25], -slopes[25:], atol=1e-5)


@pytest.mark.parametrize("kind", SignalKind)
def test_what_is_worked_through_in_parts_is_the_same(kind, monkeypatch):
    rng = np.random.default_rng(2)
    wrong = replace(IDEAL, bad_pixels=3, slope_rotation_deg=2.0)
    errors = SlopeErrors(PIXELS, wrong, rng, SlopeRecipe(order=kind.orders[0]))
    slopes = rng.normal(size=(kind.n_planes * 25, 2500)).astype(np.float32)
    whole = errors.add_errors(slopes)
    monkeypatch.setattr(imperfections, "_WHOLE_BYTES", 0)
    np.testing.assert_array_equal(errors.add_errors(slopes), whole)


def test_a_dead_pixel_silences_both_slopes_of_its_subaperture():
    errors = SlopeErrors(PIXELS, replace(IDEAL, bad_pixels=3), np.random.default_rng(1))
    read = errors.add_errors(np.ones((50, 4), dtype=np.float32))
    silent = np.flatnonzero(errors.silent)
    assert 1 <= len(silent) <= 3
    assert set(np.flatnonzero((read == 0.0).all(axis=1))) == {*silent, *(silent + 25)}
    assert not errors.absent


def test_a_dead_pixel_is_dark_and_of_a_silent_subaperture():
    valid = VALID.copy()
    valid[0, :3] = False
    errors = SlopeErrors(
        pixel_places(valid), replace(IDEAL, bad_pixels=4), np.random.default_rng(1)
    )
    light = np.ones((2, 5, 2, 5), dtype=np.float32)
    read = errors.read(light)
    dark = read == 0.0
    assert dark.sum() == 4
    assert set(np.flatnonzero(dark.any(axis=(0, 2))[valid])) == set(np.flatnonzero(errors.silent))
    assert not dark.any(axis=(0, 2))[~valid].any()
    assert read.dtype == np.float32
    assert read.sum() == light.sum() - 4
    assert light.all(), "what comes in is left alone"


def test_light_on_pixels_that_live_is_left_alone():
    light = np.ones((2, 5, 2, 5))
    assert SlopeErrors(PIXELS, IDEAL, np.random.default_rng(1)).read(light) is light


@pytest.mark.parametrize("kind", [LinearPlant, DiffractivePlant])
def test_the_flux_of_dead_pixels_is_missing_from_images_and_from_the_mean(
    small_instrument, small_basis, kind
):
    """Slopes are normalised by the mean flux: less of it makes those that are left larger."""

    def optics(n_bad):
        return kind(
            small_instrument,
            small_basis,
            rng=np.random.default_rng(1),
            imperfections=replace(IDEAL, bad_pixels=n_bad),
        ).optics(ALIGNED)

    def slopes(seen):
        if isinstance(seen, DiffractiveOptics):
            opd_m = 5e-9 * seen.opd_per_command[:, 0]
            push, pull = (seen.slopes(sign * opd_m, None, None) for sign in (1, -1))
            return (push - pull) / 1e-8
        return seen.slopes_per_command[:, 0]

    whole, flawed = optics(0), optics(8)
    dark = (flawed.images == 0.0) & (whole.images > 0.0)
    assert dark.sum() == 8
    np.testing.assert_allclose(flawed.images[~dark], whole.images[~dark], rtol=1e-6)
    heard = slopes(flawed) != 0.0
    # a mean of about 60 subapertures of four pixels each; the aligned images are symmetric
    lost = whole.images[dark].sum() / whole.images.sum()
    ratio = slopes(flawed)[heard] @ slopes(whole)[heard] / (slopes(whole)[heard] ** 2).sum()
    assert lost > 0.01
    assert ratio == pytest.approx(1 / (1 - lost), rel=0.3 * lost)


def test_more_dead_pixels_than_there_are_silence_everything():
    errors = SlopeErrors(PIXELS, replace(IDEAL, bad_pixels=1000), np.random.default_rng(1))
    assert errors.silent.all()


def test_perfect_slopes_are_left_alone():
    slopes = np.ones((50, 4), dtype=np.float32)
    errors = SlopeErrors(PIXELS, IDEAL, np.random.default_rng(1))
    assert errors.absent
    assert errors.add_errors(slopes) is slopes


def test_a_distortion_holds_no_registration(pupil):
    points, weights = pupil.points, pupil.weights
    moved = distort_points(points, weights, replace(IDEAL, distortion_subap=0.2, anamorphosis=0.01))
    error = moved - points
    x, y = points.T
    assert np.abs(weights @ error).max() < 1e-12
    assert abs(weights @ (x * error[:, 0] + y * error[:, 1])) < 1e-12
    assert abs(weights @ (x * error[:, 1] - y * error[:, 0])) < 1e-12
    # Barrel: the edge goes out where the middle comes in, less the scale that was taken out
    # (2/3 of a cubic over a disc).
    on_x = np.abs(y) < 0.2
    edge = on_x & (np.abs(x) > 4.7)
    without = distort_points(points, weights, replace(IDEAL, distortion_subap=0.2)) - points
    outwards = (without * points).sum(axis=1) / np.hypot(x, y)
    assert outwards[edge].mean() == pytest.approx(0.2 / 3, rel=0.3)
    assert outwards[np.hypot(x, y) < 2].max() < 0.0


def test_a_distortion_is_no_registration_to_the_matrix(small_instrument, small_basis):
    perfect = matrix(small_instrument, small_basis)
    bent = matrix(small_instrument, small_basis, distortion_subap=0.1)
    change = np.linalg.norm(bent - perfect) / np.linalg.norm(perfect)
    # 0.03 subapertures RMS against 0.7 radians per subaperture in the mean mode.
    assert 0.002 < change < 0.05


def test_a_wider_modulation_lowers_every_slope(small_instrument, small_basis):
    perfect = matrix(small_instrument, small_basis)
    wide = matrix(small_instrument, small_basis, modulation_error=0.1)
    ratio = np.linalg.norm(wide, axis=0) / np.linalg.norm(perfect, axis=0)
    # In the geometric limit the slope of a tilt goes with the inverse of the modulation.
    assert ratio[:2] == pytest.approx([1 / 1.1] * 2, abs=0.02)
    assert ratio.max() < 1.0


def test_dead_pixels_silence_turbulence_and_mirror_alike(small_instrument, small_basis):
    flawed = plant(small_instrument, small_basis, bad_pixels=4)
    optics = flawed.optics(ALIGNED)
    silent = np.tile(flawed.slope_errors.silent, 2)
    assert silent.any()
    assert not optics.slopes_per_phase[silent].any()
    assert not optics.slopes_per_command[silent].any()
    assert optics.slopes_per_phase[~silent].any(axis=1).all()


def test_turned_axes_reach_turbulence_and_mirror_alike(small_instrument, small_basis):
    straight = plant(small_instrument, small_basis).optics(ALIGNED)
    turned = plant(small_instrument, small_basis, slope_rotation_deg=2.0).optics(ALIGNED)
    angle = np.deg2rad(2.0)
    for name in ("slopes_per_phase", "slopes_per_command"):
        along_x, along_y = np.split(getattr(straight, name), 2)
        expected = np.cos(angle) * along_x - np.sin(angle) * along_y
        read = np.split(getattr(turned, name), 2)[0]
        np.testing.assert_allclose(read, expected, atol=1e-5 * np.abs(expected).max())


def test_the_non_common_path_has_its_rms_and_no_tilt(pupil):
    opd = non_common_path(
        pupil.points, pupil.weights, replace(IDEAL, ncpa_nm=30.0), np.random.default_rng(1)
    )
    moments = [pupil.weights @ (opd * shape) for shape in (1.0, *pupil.points.T)]
    assert np.sqrt(pupil.weights @ opd**2) == pytest.approx(30e-9, rel=1e-5)
    assert np.abs(moments).max() < 1e-13


POLYNOMIALS = {
    2: lambda r, t: 2.0 * r * np.cos(t),
    3: lambda r, t: 2.0 * r * np.sin(t),
    4: lambda r, t: np.sqrt(3.0) * (2.0 * r**2 - 1.0),
    5: lambda r, t: np.sqrt(6.0) * r**2 * np.sin(2.0 * t),
    6: lambda r, t: np.sqrt(6.0) * r**2 * np.cos(2.0 * t),
    8: lambda r, t: np.sqrt(8.0) * (3.0 * r**3 - 2.0 * r) * np.cos(t),
    9: lambda r, t: np.sqrt(8.0) * r**3 * np.sin(3.0 * t),
    11: lambda r, t: np.sqrt(5.0) * (6.0 * r**4 - 6.0 * r**2 + 1.0),
    12: lambda r, t: np.sqrt(10.0) * (4.0 * r**4 - 3.0 * r**2) * np.cos(2.0 * t),
}
"""Of Noll 1976, table 1."""


@pytest.mark.parametrize("number", POLYNOMIALS)
def test_a_non_common_path_of_one_zernike_is_that_polynomial(pupil, number):
    flawed = replace(IDEAL, ncpa_nm=60.0, ncpa_zernike=number)
    opd = non_common_path(pupil.points, pupil.weights, flawed, np.random.default_rng(1))
    x, y = pupil.points.T / np.abs(pupil.points).max()
    expected = POLYNOMIALS[number](np.hypot(x, y), np.arctan2(y, x))
    expected -= pupil.weights @ expected
    expected *= 60e-9 / np.sqrt(pupil.weights @ expected**2)
    np.testing.assert_allclose(opd, expected, atol=1e-13)


@pytest.mark.parametrize("error", [0.1, 0.3])
def test_a_model_error_is_that_share_of_every_modes_slopes(small_instrument, small_basis, error):
    """The gradient decides; what a modulated pyramid makes of it differs by a third at most."""
    found = {}
    for size in (0.0, error):
        changes = replace(SETS["ideal"], model_error=size)
        plant = LinearPlant(
            small_instrument, small_basis, rng=np.random.default_rng(1), imperfections=changes
        )
        found[size] = plant.optics(Misregistration()).slopes_per_command
    wrong = found[error] - found[0.0]
    share = np.linalg.norm(wrong, axis=0) / np.linalg.norm(found[0.0], axis=0)
    assert np.median(share) == pytest.approx(error, rel=0.1)
    assert 0.6 * error < share.min()
    assert share.max() < 1.6 * error
    alike = wrong / np.linalg.norm(wrong, axis=0)
    others = (alike.T @ alike)[~np.eye(small_basis.n_modes, dtype=np.bool_)]
    assert np.sqrt(np.mean(others**2)) < 0.3  # each mode has an error of its own


def test_displacements_of_images_have_their_rms_and_no_mean():
    rng = np.random.default_rng(1)
    assert image_offsets(IDEAL, rng) is None
    for rms_px in (0.05, 0.3):
        drawn = image_offsets(replace(IDEAL, image_offset_rms_px=rms_px), rng)
        assert drawn.shape == (4, 2)
        np.testing.assert_allclose(drawn.mean(axis=0), 0.0, atol=1e-15)
        assert np.sqrt(np.mean(drawn**2)) == pytest.approx(rms_px)
    given = replace(IDEAL, image_offsets_px=(0.1, 0.2, 0.3, 0.2, 0.1, 0.2, 0.1, 0.2))
    found = image_offsets(given, rng)
    np.testing.assert_allclose(found, [[-0.05, 0], [0.15, 0], [-0.05, 0], [-0.05, 0]], atol=1e-15)


def test_model_errors_move_with_the_mirror(small_instrument, small_basis):
    """The stop is the telescope: the mirror's image alone moves by one point of the pupil."""
    instrument = replace(small_instrument, stop=Stop.TELESCOPE)
    changes = replace(SETS["ideal"], model_error=0.2)
    plant = LinearPlant(
        instrument, small_basis, rng=np.random.default_rng(1), imperfections=changes
    )
    step = plant.pitch_m / instrument.subaperture_m
    here = plant.optics(Misregistration()).opd_per_command
    there = plant.optics(Misregistration(shift_x_subap=step)).opd_per_command
    points = np.round(plant.points_m / plant.pitch_m * 2).astype(int)
    place = {tuple(point): k for k, point in enumerate(points)}
    pairs = [(k, place[x - 2, y]) for (x, y), k in place.items() if (x - 2, y) in place]
    now, before = np.array(pairs).T
    error = there[now] - here[before]
    assert np.sqrt(np.mean(error**2)) < 0.02 * np.sqrt(np.mean(here**2))


def test_displaced_images_of_a_linear_plant_are_those_of_the_model(small_instrument, small_basis):
    changes = replace(IDEAL, image_offset_rms_px=0.2)
    plant = LinearPlant(
        small_instrument, small_basis, rng=np.random.default_rng(1), imperfections=changes
    )
    places = tuple(map(tuple, plant.image_offsets_px))
    told = replace(small_instrument, wfs=replace(small_instrument.wfs, image_offsets_subap=places))
    expected = LinearPlant(told, small_basis, rng=np.random.default_rng(1), imperfections=IDEAL)
    found, known = (one.optics(ALIGNED).slopes_per_command for one in (plant, expected))
    np.testing.assert_allclose(found, known, rtol=0, atol=1e-6 * np.abs(known).max())
    ideal = LinearPlant(
        small_instrument, small_basis, rng=np.random.default_rng(1), imperfections=IDEAL
    )
    off_grid = found - ideal.optics(ALIGNED).slopes_per_command
    assert np.linalg.norm(off_grid) > 0.05 * np.linalg.norm(known)


def test_a_shack_hartmann_has_no_pupil_images_to_displace():
    instrument = replace(load_instrument("canary"), modes=KarhunenLoeve(n_modes=10))
    basis = karhunen_loeve_basis(instrument)
    changes = replace(IDEAL, image_offset_rms_px=0.1)
    with pytest.raises(ConfigurationError, match="--image-offsets"):
        LinearPlant(instrument, basis, rng=np.random.default_rng(1), imperfections=changes)
