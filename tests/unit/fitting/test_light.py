"""A flux map of the tiny bench: what it does to a fit, and which way it lies."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest

from pyrcal.fitting.fit_file import fit_file
from pyrcal.fitting.light import read_light
from pyrcal.fitting.light_rotation import Arms, LightRotation, find_rotation
from pyrcal.fitting.matrix import FitOptions
from service.errors import MatrixError, ModelError
from service.instrument import load_instrument
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from service.model.sensors.pyramid.light import PyramidLight
from service.model.sensors.sensor import CannotTell, PupilPosition
from service.model.slopes import Orientation
from sim_rtc.telescope.diffractive import DiffractivePlant
from tests.data.tiny.make import ALPHA, HERE, ORIENTATION, SEED
from tests.support.lamps import beam, counts_of, flao, gaussian
from tests.support.pyramid_light_illumination import at


def oriented(orientation):
    instrument = load_instrument(HERE / "tiny.toml")
    return replace(instrument, slopes=replace(instrument.slopes, orientation=orientation))


@pytest.fixture(scope="module")
def instrument():
    return oriented(ORIENTATION)


@pytest.fixture(scope="module")
def light(instrument):
    """Counts ``(2, n, 2, n)`` of the sensor that measured the tiny matrix, axes of conventions."""
    rng, _ = np.random.default_rng(SEED).spawn(2)
    plant = DiffractivePlant(instrument, karhunen_loeve_basis(instrument), rng=rng)
    optics = plant.optics(Misregistration.from_boundary(ALPHA))
    flat = np.zeros(len(optics.opd_per_command), dtype=np.float32)
    return 1000.0 * optics.light(flat).astype(np.float64)


def as_four(light):
    return light.transpose(0, 2, 1, 3).reshape(4, 12, 12)


@pytest.fixture
def path(light, tmp_path):
    """The map as the RTC has it: rows from the top of the detector."""
    path = tmp_path / "flux.h5"
    rows_from_top = light.reshape(24, 24)[::-1].reshape(2, 12, 2, 12)
    with h5py.File(path, "w") as file:
        file["flux"] = as_four(rows_from_top)
    return path


def test_a_flux_map_is_turned_with_its_images(light, instrument):
    rows_from_top = light.reshape(24, 24)[::-1].reshape(2, 12, 2, 12)
    np.testing.assert_array_equal(
        PyramidLight(instrument=instrument).orient_counts(as_four(rows_from_top)), as_four(light)
    )
    swapped = light.reshape(24, 24).T.reshape(2, 12, 2, 12)
    np.testing.assert_array_equal(
        PyramidLight(instrument=oriented(Orientation(swap_xy=True))).orient_counts(
            as_four(swapped)
        ),
        as_four(light),
    )
    signed = oriented(Orientation(sign_x=-1, sign_y=-1))
    np.testing.assert_array_equal(
        PyramidLight(instrument=signed).orient_counts(as_four(light)), as_four(light)
    )


def test_the_light_alone_puts_the_pupil_within_a_tenth_of_a_subaperture(path, instrument):
    found = read_light(path, instrument)
    assert abs(found.position.at[0] - ALPHA["shift_x_subap"]) < 0.1
    assert abs(found.position.at[1] - ALPHA["shift_y_subap"]) < 0.1
    assert "x = -0." in found.note


def test_a_model_lit_as_measured_leaves_less_over(path, instrument):
    matrix = HERE / "tiny.h5"
    even = fit_file(instrument, matrix, FitOptions()).fit
    lit = FitOptions(illumination=read_light(path, instrument).illumination)
    found = fit_file(instrument, matrix, lit).fit
    assert found.residual_fraction < 0.75 * even.residual_fraction
    assert abs(found.alpha.shift_x_subap - ALPHA["shift_x_subap"]) < 0.005


def test_the_axes_of_a_flux_map_must_be_known(path):
    with pytest.raises(MatrixError, match='orientation = "auto"'):
        read_light(path, oriented(None))


def test_other_arrays_are_no_flux_map(tmp_path, instrument):
    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file["light"] = np.ones((4, 12, 12))
    with pytest.raises(MatrixError, match=r"no dataset flux; it holds light \(4, 12, 12\)"):
        read_light(path, instrument)
    with h5py.File(path, "a") as file:
        file["flux"] = np.ones((4, 11, 12))
    with pytest.raises(MatrixError, match=r"expected \(4, 12, 12\)"):
        read_light(path, instrument)


def test_a_map_without_a_pupil_is_refused(tmp_path, instrument):
    path = tmp_path / "noise.h5"
    with h5py.File(path, "w") as file:
        file["flux"] = np.random.default_rng(1).exponential(size=(4, 12, 12))
    with pytest.raises(MatrixError, match=str(path)):
        read_light(path, instrument)


class TestTurn:
    """How far the light is turned, told beside where it lies."""

    @pytest.fixture
    def telescope(self):
        """FLAO with its axes written down, its mirror hung at about 65 deg."""
        plain = flao()
        return replace(
            plain,
            slopes=replace(plain.slopes, orientation=Orientation()),
            mirror=replace(plain.mirror, nominal_rotation_rad=np.deg2rad(65.0)),
        )

    @staticmethod
    def stored(path, counts):
        with h5py.File(path, "w") as file:
            file["flux"] = counts
        return path

    def test_three_arms_tell_the_rotation_about_the_nominal_one(self, telescope, tmp_path):
        """Alike after 120 deg: 50.3 deg it is, and not 170.3, for the mirror is at about 65."""
        counts = counts_of(telescope, SHIFT, shaded(TRIPOD, 50.3))
        path = self.stored(tmp_path / "flux.h5", counts)
        found = read_light(path, telescope, arms(TRIPOD))
        assert np.rad2deg(found.turn.rotation_rad) == pytest.approx(50.3, abs=1.0)
        assert "turned by +50." in found.note

    def test_without_a_nominal_rotation_alike_arms_are_ambiguous(self, telescope, tmp_path):
        anywhere = replace(telescope, mirror=replace(telescope.mirror, nominal_rotation_rad=None))
        counts = counts_of(telescope, SHIFT, shaded(TRIPOD, 50.3))
        path = self.stored(tmp_path / "flux.h5", counts)
        assert "rotation is unknown: ambiguous" in read_light(path, anywhere, arms(TRIPOD)).note

    def test_uneven_light_tells_it_against_another_day(self, telescope, tmp_path):
        before = self.stored(tmp_path / "before.h5", counts_of(telescope, light=beam(gaussian)))
        now = counts_of(telescope, SHIFT, turned(gaussian, -30.0))
        found = read_light(self.stored(tmp_path / "now.h5", now), telescope, before)
        assert np.rad2deg(found.turn.rotation_rad) == pytest.approx(-30.0, abs=2.0)

    def test_who_gives_no_reference_is_not_told(self, path, instrument):
        found = read_light(path, instrument)
        assert found.turn is None
        assert found.note.endswith("subapertures")


# --- a rotation from spider arms or uneven light


LIGHT = PyramidLight(instrument=flao())

SHIFT = (-0.4, 0.3)
PLACE = at(*SHIFT)
TRIPOD = np.deg2rad([90.0, 210.0, 330.0])
WIDTH_SUBAP = 0.9
"""25 cm at FLAO, as a large telescope's."""

LOPSIDED = np.deg2rad([90.0, 200.0, 300.0])


def arms(angles, turn_deg: float = 0.0) -> Arms:
    return Arms(
        angles_rad=tuple(np.asarray(angles) + np.deg2rad(turn_deg)), width_subap=WIDTH_SUBAP
    )


def turned(function, turn_deg: float):
    cosine, sine = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    return beam(lambda x, y: function(cosine * x + sine * y, cosine * y - sine * x))


def shaded(angles, turn_deg: float, width: float = WIDTH_SUBAP):
    """Light behind arms, itself uneven; drawn by distance, as grey as a pupil point is wide."""

    def light(x, y):
        left = gaussian(x, y)
        for angle in np.asarray(angles) + np.deg2rad(turn_deg):
            along = x * np.cos(angle) + y * np.sin(angle)
            beside = np.abs(y * np.cos(angle) - x * np.sin(angle))
            hidden = np.clip((width / 2 - beside) * 3 + 0.5, 0.0, 1.0)
            left = left * np.where(along > 0, 1.0 - hidden, 1.0)
        return left

    return beam(light, size=320, step=0.125)


def seen_through(light):
    return LIGHT.relative(counts_of(flao(), SHIFT, light), PLACE)


@pytest.mark.parametrize("turn_deg", [0.0, -11.0, 24.7])
def test_three_arms_tell_the_rotation_within_a_degree(turn_deg):
    light, known = seen_through(shaded(TRIPOD, turn_deg))
    found = find_rotation(light, known, PLACE, arms(TRIPOD), within_rad=np.deg2rad(40))
    assert isinstance(found, LightRotation), found
    assert np.rad2deg(found.rotation_rad) == pytest.approx(turn_deg, abs=1.0)
    assert np.rad2deg(found.sigma_rad) < 2.0


def test_arms_evenly_spread_are_ambiguous_over_a_full_turn():
    light, known = seen_through(shaded(TRIPOD, 5.0))
    found = find_rotation(light, known, PLACE, arms(TRIPOD))
    assert isinstance(found, CannotTell)
    assert "ambiguous" in found.reason


@pytest.mark.parametrize("turn_deg", [64.5, 180.0])
def test_arms_unevenly_spread_tell_it_over_a_full_turn(turn_deg):
    light, known = seen_through(shaded(LOPSIDED, turn_deg))
    found = find_rotation(light, known, PLACE, arms(LOPSIDED))
    assert isinstance(found, LightRotation), found
    error = np.rad2deg(found.rotation_rad) - turn_deg
    assert (error + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize("turn_deg", [-30.0, 65.0])
def test_uneven_light_tells_it_against_a_map_of_another_day(turn_deg):
    before = LIGHT.illumination(counts_of(flao(), light=beam(gaussian)), at())
    light, known = seen_through(turned(gaussian, turn_deg))
    found = find_rotation(light, known, PLACE, before)
    assert isinstance(found, LightRotation), found
    assert np.rad2deg(found.rotation_rad) == pytest.approx(turn_deg, abs=2.0)


def test_an_even_pupil_tells_no_rotation():
    light, known = seen_through(None)
    found = find_rotation(light, known, PLACE, arms(TRIPOD))
    assert isinstance(found, CannotTell)


def test_arms_beyond_the_range_searched_are_not_invented():
    light, known = seen_through(shaded(TRIPOD, 30.0))
    found = find_rotation(light, known, PLACE, arms(TRIPOD), within_rad=np.deg2rad(10))
    assert isinstance(found, CannotTell)


def test_maps_that_do_not_match_are_refused():
    with pytest.raises(ModelError, match="same square map"):
        find_rotation(np.ones((5, 5)), np.ones((4, 4), dtype=bool), PLACE, arms(TRIPOD))


def test_the_position_is_taken_into_account():
    """Turned about the wrong point, arms do not fit."""
    light, known = seen_through(shaded(TRIPOD, 0.0))
    right = find_rotation(light, known, PLACE, arms(TRIPOD), within_rad=0.5)
    wrong_place = PupilPosition(at=(1.5, -1.5), sigma=(0.1, 0.1))
    wrong = find_rotation(light, known, wrong_place, arms(TRIPOD), within_rad=0.5)
    assert isinstance(right, LightRotation)
    assert isinstance(wrong, CannotTell) or wrong.correlation < 0.9 * right.correlation
