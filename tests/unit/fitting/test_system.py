"""What pairs see of a system: hand cases, rates, and D in the drawing or by α."""

from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.system import ARCSEC_RAD, SHIFTS, Pair
from pyrcal.fitting.system_file import load_system
from service.errors import ConfigurationError
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import Misregistration
from tests.support import systems

NUMBER = {"lgs1": 0, "lgs2": 1, "ngs": 2, "dm1": 0, "dm2": 1}


@pytest.fixture(scope="module")
def system(tmp_path_factory):
    text = systems.SYSTEM.replace('ground.toml"', 'ground.toml"\nstars = "direction and height"', 1)
    return systems.written(tmp_path_factory.mktemp("system"), text)


def changed(system, **by_name):
    """Return the nominal numbers with some of ``owner__name`` changed, boundary units."""
    values = system.nominal.copy()
    for key, change in by_name.items():
        owner, name = key.split("__")
        (place,) = (
            k for k, one in enumerate(system.parameters) if (one.owner, one.name) == (owner, name)
        )
        values[place] += change / system.parameters[place].boundary
    return values


def alpha_of(system, values, sensor, mirror):
    found = dict(zip(system.pairs, system.alphas(values), strict=True))
    return found[Pair(NUMBER[sensor], NUMBER[mirror])]


def test_nominally_every_pair_lies_where_its_drawing_has_it(system):
    assert system.alphas(system.nominal) == pytest.approx(
        np.tile([0.0, 0.0, 0.0, 1.0], (6, 1)), abs=1e-12
    )


def test_a_mirror_shifted_on_the_ground_is_shifted_as_far_in_every_sensor(system):
    """0.4 m are half a subaperture of 0.8 m; the grid of lgs1 is turned by 6 deg."""
    values = changed(system, dm1__shift_x_m=0.4)
    assert alpha_of(system, values, "lgs2", "dm1") == pytest.approx([0.5, 0.0, 0.0, 1.0])
    turned = [0.5 * np.cos(np.deg2rad(6)), 0.5 * np.sin(np.deg2rad(6)), 0.0, 1.0]
    assert alpha_of(system, values, "lgs1", "dm1") == pytest.approx(turned)
    assert alpha_of(system, values, "lgs1", "dm2") == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-12)


def test_a_cone_magnifies_the_shift_of_a_high_mirror(system):
    """9 of 90 km: 0.36 m up there are 0.4 m on the pupil; a natural star sees 0.36 m."""
    values = changed(system, dm2__shift_y_m=0.36)
    assert alpha_of(system, values, "lgs2", "dm2") == pytest.approx([0.0, 0.5, 0.0, 1.0])
    assert alpha_of(system, values, "ngs", "dm2") == pytest.approx([0.0, 0.45, 0.0, 1.0])


def test_a_star_that_is_elsewhere_shifts_high_mirrors_alone(system):
    """3 arcsec over 9 km are 0.131 m against them, through a cone 0.145 m."""
    values = changed(system, lgs2__star_x_arcsec=3.0)
    shift = -3.0 * ARCSEC_RAD * 9000.0 / 0.9 / 0.8
    assert alpha_of(system, values, "lgs2", "dm2") == pytest.approx([shift, 0.0, 0.0, 1.0])
    assert alpha_of(system, values, "lgs2", "dm1") == pytest.approx([0.0, 0.0, 0.0, 1.0])


def test_a_sensor_turned_about_the_pupil_moves_what_parallax_has_moved(system):
    values = changed(system, ngs__rotation_deg=1.0)
    on_ground = alpha_of(system, values, "ngs", "dm1")
    assert on_ground == pytest.approx([0.0, 0.0, np.deg2rad(1.0), 1.0])
    assert alpha_of(system, values, "ngs", "dm2")[2] == pytest.approx(np.deg2rad(1.0))


def test_rates_are_those_of_differences(system):
    values = systems.moved(system, np.random.default_rng(3))
    rates = system.rates(values)
    for k, parameter in enumerate(system.parameters):
        if not np.isfinite(values[k]):
            assert not rates[:, :, k].any()
            continue
        step = np.zeros(len(values))
        step[k] = 1e-5 * parameter.subap
        difference = (system.alphas(values + step) - system.alphas(values - step)) / (2 * step[k])
        assert rates[:, :, k] * parameter.subap == pytest.approx(
            difference * parameter.subap, abs=1e-8
        )


def test_the_numbers_of_a_system_are_those_it_was_put_at(system):
    values = systems.moved(system, np.random.default_rng(4))
    assert system.at(values).nominal == pytest.approx(values)


@pytest.mark.parametrize("pair", [Pair(0, 1), Pair(2, 1), Pair(1, 0)])
def test_d_at_alpha_is_that_of_the_system_moved_there(system, pair):
    """By α of the nominal drawing, or drawn where everything is: the same matrix."""
    values = systems.moved(system, np.random.default_rng(5))
    alpha = Misregistration.from_vector(system.alphas(values)[system.pairs.index(pair)])
    shift = tuple(values[system.of_sensor(pair.sensor)][SHIFTS])
    model = RtcInteractionModel(
        replace(system.instrument(pair), pupil_shift_subap=shift),
        system.basis(pair),
        pupil_sampling=4,
        detector_nodes=4,
    )
    ours, drawn = model.interaction_matrix(alpha), systems.matrix(system, pair, values)
    assert np.abs(ours - drawn).max() < 2e-5 * np.abs(drawn).max()


def test_actuators_outside_the_light_are_known(system):
    """The light of lgs1 meets dm2 0.87 m off its middle and is 7.2 m wide."""
    lit = system.lit(Pair(0, 1))
    dm2 = system.mirrors[1]
    met = dm2.place.points(dm2.instrument.mirror.positions_m)
    aside = np.linalg.norm(met - [20 * ARCSEC_RAD * 9000.0, 0.0], axis=1)
    assert set(lit) == set(np.flatnonzero(aside <= 3.6))
    assert system.lit(Pair(0, 0)) is None


# --- the system file


def test_what_a_file_leaves_out_is_nominal(tmp_path):
    system = systems.written(tmp_path)
    lgs1, _, ngs = system.sensors
    assert lgs1.star.direction_rad == pytest.approx(20 * ARCSEC_RAD)
    assert np.angle(lgs1.place.turn, deg=True) == pytest.approx(6.0)
    assert np.isinf(ngs.star.height_m)
    assert ngs.place.turn == 1.0
    assert system.mirrors[0].altitude_m == 0.0
    assert not system.stars_move
    assert not system.heights_move


def test_a_mirror_is_turned_as_its_own_file_says_unless_this_one_does(tmp_path):
    systems.written(tmp_path)
    high = tmp_path / "high.toml"
    high.write_text(high.read_text().replace("[mirror]", "[mirror]\nnominal_rotation_deg = 30.0"))
    turned = [load_system(tmp_path / "system.toml").mirrors[1]]
    told = tmp_path / "system.toml"
    told.write_text(told.read_text().replace("rotation_deg = -4.0", ""))
    turned.append(load_system(told).mirrors[1])
    angles = [np.angle(one.place.turn, deg=True) for one in turned]
    assert angles == pytest.approx([-4.0, 30.0])


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("altitude_m = 9000.0", "altitude_m = 95e3", "mirrors.1.altitude_m: found a mirror at an "
         "altitude of 95000 m and a star at 90000 m, expected the mirror below the star of lgs1"),
        ("altitude_m", "altitude", "mirrors.1.altitude: unknown key, did you mean altitude_m?"),
        ('name = "lgs2"', 'name = "lgs1"', "name: found 'lgs1' 2 times, expected each name once"),
        ("star_height_m = 90e3", 'star_height_m = "sodium"', "sensors.0.star_height_m"),
        ("star_height_m = 90e3", "star_height_m = 1e308", "sensors.0.star_height_m"),
        ("star_height_m = 90e3", "shift_subap = [1e308, 0.0]", "sensors.0.shift_subap"),
        ('[system]\nname = "small"\ninstrument = "ground.toml"', '[system]\nname = "small"',
         "sensors.0.instrument: missing, and system.instrument is, too"),
        ('name = "ngs"', 'name = "ngs"\ninstrument = "flao-lbt"',
         "found diameter_m = 8.22 of ngs, expected 8, as lgs1 has it"),
        ('name = "ngs"', 'name = "n/gs"', "sensors.2.name: found 'n/gs'"),
        ("ground.toml", "nowhere.toml", "nowhere.toml: cannot be read"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_one_line_with_the_key(tmp_path, before, after, message):
    with pytest.raises(ConfigurationError) as refusal:
        systems.written(tmp_path, systems.SYSTEM.replace(before, after, 1))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('"telescope"', '"mirror"', 'found 9000, expected 0 where high says stop = "mirror"'),
        ('basis = "zonal"', "", "its KL modes are those of the pupil"),
    ],
)
def test_a_mirror_of_which_too_little_is_known_must_lie_at_the_pupil(
    tmp_path, before, after, message
):
    systems.written(tmp_path)
    for name in ("ground", "high"):
        file = tmp_path / f"{name}.toml"
        file.write_text(file.read_text().replace(before, after))
    with pytest.raises(ConfigurationError) as refusal:
        load_system(tmp_path / "system.toml")
    assert f"mirrors.1.altitude_m: {message}" in str(refusal.value).replace(
        'found 9000, expected 0, or mirror.basis = "zonal" or mode_to_actuator: ', ""
    )


def test_instruments_of_two_stops_are_refused(tmp_path):
    systems.written(tmp_path)
    high = tmp_path / "high.toml"
    high.write_text(high.read_text().replace('"telescope"', '"mirror"'))
    with pytest.raises(ConfigurationError, match='found stop = "mirror" of dm2'):
        load_system(tmp_path / "system.toml")
