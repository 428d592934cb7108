from dataclasses import replace

import h5py
import numpy as np
import pytest

from service.errors import ConfigurationError
from service.model.kinds import Influence, InfluenceShape
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from service.model.surface import ThinPlate, mirror_surface
from sim_rtc.assembly import build_plant
from sim_rtc.options import parse_options
from sim_rtc.telescope.influence import InfluenceCube, read_influence
from sim_rtc.telescope.mirror import MirrorFaults, TensionedPlate, disobedient

TURNED = Misregistration(
    shift_x_subap=0.2, shift_y_subap=-0.1, rotation_rad=0.01, magnification=1.004
)
PITCH_M = 0.1
N_ACROSS = 101
"""10 m: the pupil of 8.2 m and room around it."""


def grid_m(n=N_ACROSS, pitch_m=PITCH_M):
    axis = pitch_m * (np.arange(n) - (n - 1) / 2)
    x, y = np.meshgrid(axis, axis)
    return np.column_stack([x.ravel(), y.ravel()])


def tabulated(surface, n_actuators, subaperture_m, points_m):
    """The influence functions of a surface, as a laboratory would deliver them."""
    maps = surface.basis(points_m / subaperture_m) @ surface.coefficients(np.eye(n_actuators))
    side = round(np.sqrt(len(points_m)))
    return maps.T.reshape(-1, side, side)


@pytest.fixture(scope="module")
def thin_maps(small_instrument):
    surface = mirror_surface(small_instrument.mirror, small_instrument.subaperture_m)
    n = len(small_instrument.mirror.positions_m)
    return tabulated(surface, n, small_instrument.subaperture_m, grid_m())


@pytest.fixture
def on_file(tmp_path, thin_maps):
    def write(maps=thin_maps, **attributes):
        path = tmp_path / "mirror.h5"
        with h5py.File(path, "w") as file:
            file["lab/influence"] = maps
            file["lab/influence"].attrs.update(attributes)
        return f"{path}:/lab/influence"

    return write


def plant(instrument, basis, *words):
    options = parse_options(["--imperfections", "ideal", *words])
    return build_plant(options, instrument, basis, np.random.default_rng(1))


def distance(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


@pytest.mark.parametrize("name", ["linear", "diffractive"])
def test_a_plant_has_the_mirror_of_the_file(small_instrument, small_basis, on_file, name):
    """The drawing's own functions by way of a file: the linear plant's mirror comes out again.

    Nine points to an actuator: what a cubic spline loses on them is below 1e-3.
    """
    words = ["--plant", name, "--influence", on_file(pitch_m=PITCH_M)]
    found = plant(small_instrument, small_basis, *words)
    drawn = plant(small_instrument, small_basis, "--plant", name)
    points = found.points_m / small_instrument.subaperture_m
    turn = np.array([[np.cos(0.01), -np.sin(0.01)], [np.sin(0.01), np.cos(0.01)]])
    expected = small_basis.render(points @ turn / 1.004)
    assert distance(found.optics(TURNED).opd_per_command, expected) < 1e-3
    others = distance(drawn.optics(TURNED).opd_per_command, expected)
    assert bool(others > 5e-3) is (name == "diffractive")


def test_a_file_of_the_plates_functions_makes_the_plate(small_instrument, small_basis, on_file):
    mirror, width_m = small_instrument.mirror, small_instrument.subaperture_m
    plate = TensionedPlate(
        mirror.positions_m / width_m, tension=width_m / mirror.pitch_m, softness=0.002
    )
    maps = tabulated(plate, len(mirror.positions_m), width_m, grid_m())
    drawn = plant(small_instrument, small_basis, "--plant", "diffractive").optics(TURNED)
    words = ["--plant", "diffractive", "--influence", on_file(maps, pitch_m=PITCH_M)]
    found = plant(small_instrument, small_basis, *words).optics(TURNED)
    assert distance(found.opd_per_command, drawn.opd_per_command) < 1e-3
    opd_m = 20e-9 * found.opd_per_command[:, 5]
    slopes = found.slopes(opd_m, None, None), drawn.slopes(opd_m, None, None)
    assert distance(*slopes) < 1e-4


def test_dead_and_stuck_actuators_work_on_functions_of_a_file(
    small_instrument, small_basis, on_file
):
    words = ["--plant", "diffractive", "--influence", on_file(pitch_m=PITCH_M)]
    faulty = [*words, "--dead-actuators", "20", "--stuck-actuators", "40:1e-7"]
    flawed = plant(small_instrument, small_basis, *faulty)
    optics = flawed.optics(Misregistration())
    healthy = plant(small_instrument, small_basis, *words).optics(Misregistration())
    change = distance(optics.opd_per_command, healthy.opd_per_command)
    assert 0.01 < change < 0.5
    peak_m = flawed.points_m[np.argmax(optics.stuck_opd_m)]
    held_m = small_instrument.mirror.positions_m[40]
    assert np.hypot(*(peak_m - held_m)) < 0.5 * small_instrument.mirror.pitch_m
    assert optics.stuck_opd_m.max() == pytest.approx(1e-7, rel=0.05)


def surface_of(instrument, maps, moved_m=None):
    positions_m = instrument.mirror.positions_m
    cube = InfluenceCube(maps=maps, pitch_m=PITCH_M)
    moved_m = positions_m if moved_m is None else moved_m
    return cube.surface(positions_m, moved_m, instrument.subaperture_m)


def test_a_dead_actuator_goes_where_a_thin_plate_bends_least(
    small_instrument, small_basis, thin_maps
):
    """A thin plate without one of its supports is the shape of least bending by definition.

    Over the whole plane: the file's ends at the outermost actuators, and a map has its own grid.
    """
    surface = surface_of(small_instrument, thin_maps)
    strokes = small_basis.mode_to_actuator
    weights, _ = disobedient(surface, strokes, MirrorFaults(dead=(30,)))
    positions = small_instrument.mirror.positions_m / small_instrument.subaperture_m
    held = np.arange(len(positions)) != 30
    thin = ThinPlate(positions[held])
    expected = thin.basis(positions[30:31]) @ thin.coefficients(strokes[held])
    found = surface.basis(positions[30:31]) @ weights
    assert distance(found, expected) < 0.1
    assert distance(strokes[30:31], expected) > 0.2, "it would not be there by itself"
    # Those that are held stay where they are, but for what the table loses: at an actuator the
    # curvature of a thin plate is infinite, that of a spline is not.
    others = surface.basis(positions[held]) @ weights
    assert distance(others, strokes[held]) < 5e-3


def test_actuators_out_of_place_take_their_functions_along(small_instrument, thin_maps):
    positions_m = small_instrument.mirror.positions_m
    step_m = np.array([0.07, -0.04])
    moved = surface_of(small_instrument, thin_maps, positions_m + step_m)
    still = surface_of(small_instrument, thin_maps)
    strokes = np.random.default_rng(1).standard_normal((len(positions_m), 3))
    points_m = np.random.default_rng(2).uniform(-3.0, 3.0, (200, 2))
    width_m = small_instrument.subaperture_m
    found = moved.basis((points_m + step_m) / width_m) @ moved.coefficients(strokes)
    expected = still.basis(points_m / width_m) @ still.coefficients(strokes)
    assert distance(found, expected) < 2e-3


def test_at_its_points_the_surface_is_the_table(small_instrument, thin_maps):
    surface = surface_of(small_instrument, thin_maps)
    found = surface.basis(grid_m() / small_instrument.subaperture_m) @ surface.coefficients(
        np.eye(len(thin_maps))[:, :4]
    )
    np.testing.assert_allclose(found.T, thin_maps[:4].reshape(4, -1), atol=1e-9)


def test_beyond_the_table_the_surface_goes_on_at_the_height_of_its_edge(
    small_instrument, thin_maps
):
    surface = surface_of(small_instrument, thin_maps)
    width_m = small_instrument.subaperture_m
    weights = surface.coefficients(np.eye(len(thin_maps)))
    edge, outside = (surface.basis(np.array([[x / width_m, 1.0]])) @ weights for x in (5.0, 6.0))
    np.testing.assert_allclose(outside, edge, atol=1e-12)


def test_the_option_wins_over_the_files_own_pitch(small_instrument, on_file):
    reference = on_file(pitch_m=0.12)
    assert read_influence(reference, small_instrument).pitch_m == 0.12
    assert read_influence(reference, small_instrument, 0.1).pitch_m == 0.1


def holed(maps):
    outside = np.hypot(*grid_m().T).reshape(N_ACROSS, N_ACROSS) > 3.9
    return np.where(outside, 0.0, maps)


@pytest.mark.parametrize(
    ("change", "attributes", "text"),
    [
        (lambda maps: maps[1:], {"pitch_m": 0.1}, r"shape \(.*\); expected \(.*, ny, nx\)"),
        (lambda maps: maps[0], {"pitch_m": 0.1}, r"found shape \(101, 101\)"),
        (lambda maps: np.where(maps > 0.9, np.nan, maps), {"pitch_m": 0.1}, "not finite"),
        (holed, {"pitch_m": 0.1}, "points of the pupil where every function is 0"),
        (lambda maps: maps, {"pitch_m": 0.05}, "101 x 101 points over 5 m; expected the whole"),
        (lambda maps: maps, {"pitch_m": 100.0}, "at most the actuators' pitch of 0.9 m"),
        (lambda maps: maps, {}, "no number in the attribute pitch_m .* --influence-pitch"),
        (lambda maps: maps, {"pitch_m": "10 cm"}, "no number in the attribute pitch_m"),
        (lambda maps: maps, {"pitch_m": -0.1}, "the attribute pitch_m = -0.1; expected metres"),
    ],
)
def test_functions_that_cannot_be_this_mirrors_are_refused_in_one_line(
    small_instrument, thin_maps, on_file, change, attributes, text
):
    reference = on_file(change(thin_maps), **attributes)
    with pytest.raises(ConfigurationError, match="--influence: " + ".*" + text) as refused:
        read_influence(reference, small_instrument)
    assert "\n" not in str(refused.value)


def test_a_file_that_is_not_there_or_holds_something_else_is_refused(small_instrument, on_file):
    good = on_file(pitch_m=0.1)
    for reference, text in (
        (good.replace("mirror.h5", "other.h5"), "(?i)no such file"),
        (good.replace("/lab/influence", "/lab/nothing"), "/lab/nothing"),
    ):
        with pytest.raises(ConfigurationError, match=text):
            read_influence(reference, small_instrument)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--influence", "mirror.h5"], "found 'mirror.h5'; expected FILE:/DATASET"),
        (["--influence-pitch", "0.1"], "--influence-pitch: found alone; expected --influence"),
    ],
)
def test_half_an_option_is_refused(words, text, capsys):
    with pytest.raises(SystemExit) as ended:
        parse_options(words)
    assert ended.value.code == 2
    assert text in capsys.readouterr().err


def test_a_mirror_drawn_with_gaussians_keeps_its_heights_on_the_plate(small_instrument):
    """Its strokes are not heights: Gaussians overlap, and a plate holds heights."""
    gaussian = replace(
        small_instrument,
        mirror=replace(small_instrument.mirror, shape=InfluenceShape(influence=Influence.GAUSSIAN)),
    )
    basis = karhunen_loeve_basis(gaussian)
    found = plant(gaussian, basis, "--plant", "diffractive")
    modes = found.optics(Misregistration()).opd_per_command
    drawn = basis.render(found.points_m / gaussian.subaperture_m)
    alike = (modes * drawn).sum(axis=0) / np.linalg.norm(modes, axis=0)
    alike /= np.linalg.norm(drawn, axis=0)
    size = np.linalg.norm(modes, axis=0) / np.linalg.norm(drawn, axis=0)
    assert alike[:20].min() > 0.99
    np.testing.assert_allclose(size[:20], 1.0, atol=0.1)
