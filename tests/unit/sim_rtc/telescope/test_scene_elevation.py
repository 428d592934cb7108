"""Where the simulated telescope looks."""

import pytest

from sim_rtc.options import parse_options
from sim_rtc.telescope.scene import Elevation


def test_it_stays_where_it_is_unless_told_otherwise():
    assert Elevation().at(0.0) == Elevation().at(3600.0)
    assert Elevation().at(0.0).elevation_deg == 60.0


def test_it_tracks_and_a_slew_takes_a_second_for_a_degree():
    found = Elevation(start_deg=50.0, rate_deg_per_minute=0.5, slews=((60.0, -10.0),))
    assert found.at(60.0).elevation_deg == pytest.approx(50.5)
    assert found.at(64.0).elevation_deg == pytest.approx(50.5 - 4.0 + 0.5 * 4 / 60)
    assert found.at(120.0).elevation_deg == pytest.approx(41.0)


def test_it_goes_no_further_than_the_zenith():
    assert Elevation(slews=((1.0, 60.0),)).at(1e3).elevation_deg == 90.0


def test_it_is_an_option_of_the_simulator():
    found = parse_options(["--elevation", "45,-0.25", "--slew", "30:12", "--slew", "90:-5"])
    assert found.elevation == Elevation(
        start_deg=45.0, rate_deg_per_minute=-0.25, slews=((30.0, 12.0), (90.0, -5.0))
    )


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--elevation", "91"], "--elevation: found '91'; expected DEG or DEG,DEG_PER_MIN"),
        (["--elevation", "60,11"], "--elevation: found '60,11'"),
        (["--slew", "5"], "--slew: found '5'; expected T:DEG"),
        (["--slew", "0:5"], "--slew: found '0:5'"),
    ],
)
def test_an_impossible_one_is_one_line(capsys, words, text):
    with pytest.raises(SystemExit):
        parse_options(words)
    assert text in capsys.readouterr().err
