"""Files of systems: what is read, and what is refused in one line."""

import numpy as np
import pytest

from pyrcal.fitting.system import ARCSEC_RAD
from pyrcal.fitting.system_file import load_system
from service.errors import ConfigurationError
from tests.unit.fitting import systems


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
