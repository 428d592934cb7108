import numpy as np
import pytest

from service.errors import ConfigurationError
from service.model.misregistration import Misregistration
from service.model.pupil import instrument_pupil
from sim_rtc.assembly import build_telescope
from sim_rtc.options import parse_options
from sim_rtc.telescope.linear import LinearPlant
from sim_rtc.telescope.scene import Elevation, PlayedTurbulence, Scene, SceneKind, Spiders

ALIGNED = Misregistration()
DAYTIME = Scene(kind=SceneKind.DAYTIME)


def plant(instrument, basis, scene):
    return LinearPlant(instrument, basis, rng=np.random.default_rng(1), scene=scene)


def test_by_day_a_command_counts_twice(small_instrument, small_basis):
    day, night = (
        plant(small_instrument, small_basis, scene).optics(ALIGNED) for scene in (DAYTIME, Scene())
    )
    np.testing.assert_allclose(day.slopes_per_command, 2 * night.slopes_per_command, rtol=1e-6)
    np.testing.assert_allclose(day.opd_per_command, 2 * night.opd_per_command)
    np.testing.assert_array_equal(day.slopes_per_phase, night.slopes_per_phase)


@pytest.mark.parametrize("n_arms", [1, 3, 4])
def test_arms_hide_what_they_cover(small_instrument, n_arms):
    pupil = instrument_pupil(small_instrument, 4)
    scene = Scene(spiders=Spiders(n_arms=n_arms, width_m=0.2))
    lit = scene.light(pupil, small_instrument.subaperture_m).amplitude
    cell_m2 = (small_instrument.subaperture_m / 4) ** 2
    hidden_m2 = (pupil.amplitude - lit).sum() * cell_m2
    radius_m = small_instrument.diameter_m / 2
    expected = n_arms * 0.2 * radius_m * (1 - small_instrument.obscuration_ratio)
    # An eighth of a cell at the inner end of 4 m, and the edges of slanted arms.
    assert hidden_m2 == pytest.approx(expected, rel=0.02)


def test_arms_darken_the_images(small_instrument, small_basis):
    scene = Scene(spiders=Spiders(n_arms=4, width_m=0.5))
    # The subapertures beside the upper arm, five rows out: half of each is hidden.
    images = [
        plant(small_instrument, small_basis, s).optics(ALIGNED).images.sum(axis=(0, 2))
        for s in (scene, Scene())
    ]
    shaded, open_ = (image / image[2, 2] for image in images)
    assert shaded[8, 4:6].max() < 0.8 * open_[8, 4:6].min()


def test_the_fibre_shines_past_no_arm():
    with pytest.raises(ConfigurationError, match=r"--spiders: .* expected --scene onsky"):
        Scene(kind=SceneKind.DAYTIME, spiders=Spiders(n_arms=2, width_m=0.1))


def test_played_turbulence_looks_like_the_real_one_to_a_sensor_that_sees_it_twice():
    rng = np.random.default_rng(1)
    modes = rng.standard_normal((200, 6)).astype(np.float32)
    weights = np.full(200, 1 / 200)
    wanted = rng.standard_normal(6)
    commands = PlayedTurbulence(modes, weights, passes=2).commands_per_phase @ (modes @ wanted)
    np.testing.assert_allclose(2 * commands, wanted, rtol=1e-4)


@pytest.mark.parametrize("plant", ["linear", "diffractive"])
def test_by_day_the_commands_explain_the_slopes_and_the_loop_closes(small_instrument, plant):
    words = ["--scene", "daytime", "--plant", plant, "--imperfections", "ideal", "--mag", "-5"]
    words += ["--vibration", "none", "--alpha", "0,0,0,1", "--n-controlled", "30", "--seed", "2"]
    telescope = build_telescope(parse_options([*words, "--seeing", "0.15"]), small_instrument)
    computer = telescope.computer(iter(telescope.feed.blocks()))
    batches = [computer.next_batch() for _ in range(40)]
    commands = np.concatenate([batch.commands_m for batch in batches])
    # The mirror plays and corrects: what is left on it is small, nothing is in the air.
    assert not any(batch.phase_m.any() for batch in batches)
    assert commands[-100:, :30].std() < 0.2 * commands[:2, :30].std()
    if plant == "linear":
        slopes = np.concatenate([batch.slopes for batch in batches])
        expected = commands @ batches[0].optics.slopes_per_command.T
        # A star of R = -5 gives 3e10 electrons a frame.
        np.testing.assert_allclose(slopes, expected, atol=2e-3 * expected.std())


# --- elevation


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
