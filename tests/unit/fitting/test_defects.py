"""Columns, rows, modes and functions that cannot be used are named by number and left out."""

import h5py
import numpy as np
import pytest

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from service.errors import ConfigurationError
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.defects import find_defects
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis

ALPHA = Misregistration(shift_x_subap=0.1, shift_y_subap=-0.05, rotation_rad=0.01)
BENCH = """
[instrument]
name = "bench"
diameter_m = 4.0
stop = "telescope"
[wfs]
kind = "shack-hartmann"
n_subapertures = 8
wavelength_m = 650e-9
[mirror]
{mirror}
[slopes]
orientation = {{ sign = 1 }}
"""
GRID = 'layout = "grid"\nn_across = 5\npitch_m = 1.0\ndiameter_m = 5.2\n'
N_ACTUATORS, N_POINTS = 21, 40
RNG = np.random.default_rng(3)
STROKES = np.linalg.qr(RNG.normal(size=(N_ACTUATORS, 12)))[0]


def functions():
    """Influence functions of the grid, on a table as wide as the pupil and a quarter."""
    x = (np.arange(N_POINTS) - (N_POINTS - 1) / 2) * 5.0 / N_POINTS
    axis = np.arange(5) - 2.0
    places = [(x0, y0) for y0 in axis for x0 in axis if np.hypot(x0, y0) < 2.6]
    return np.array(
        [np.exp(np.log(0.3) * ((x - x0) ** 2 + (x[:, None] - y0) ** 2)) for x0, y0 in places]
    )


def bench(folder, mirror=GRID + 'basis = "zonal"', **arrays):
    with h5py.File(folder / "m.h5", "w") as file:
        for name, values in arrays.items():
            file[name] = values
    path = folder / "bench.toml"
    path.write_text(BENCH.format(mirror=mirror))
    return load_instrument(path)


def matrix(about):
    model = RtcInteractionModel(about, modal_basis(about), pupil_sampling=4, detector_nodes=4)
    return np.asarray(model.interaction_matrix(ALPHA), float)


def fitted(about, values):
    found = fit_matrix(about, Reference(matrix=values), FitOptions())
    assert found.accepted, found.verdict
    assert np.all(np.abs(found.alpha.vector - ALPHA.vector) < 3.0 * found.sigma)
    return found


@pytest.fixture(scope="module")
def zonal(tmp_path_factory):
    about = bench(tmp_path_factory.mktemp("zonal"))
    return about, matrix(about)


def test_columns_of_a_bare_matrix_that_cannot_be_used_are_named(zonal):
    about, whole = zonal
    values = whole.copy()
    values[3, 2], values[:, 5], values[:, 9] = np.nan, 0.0, whole[:, 7]
    found = fitted(about, values)
    assert set(range(N_ACTUATORS)) - set(found.modes.tolist()) == {2, 5, 9}
    said = "; ".join(found.left_out)
    assert "not finite: mode 2" in said
    assert "dead (no response): mode 5" in said
    assert "copies: mode 9 (of 7)" in said


def test_rows_of_a_bare_matrix_that_cannot_be_used_are_named(zonal):
    about, whole = zonal
    values = whole.copy()
    values[4], values[11], values[20] = np.nan, 0.0, whole[17]
    found = fitted(about, values)
    assert len(found.modes) == N_ACTUATORS
    said = "; ".join(found.left_out)
    assert "not finite: slope 4" in said
    assert "zero in every column: slope 11" in said
    assert "copies: slope 20 (of 17)" in said


def test_equal_rows_of_a_few_low_orders_are_measurements(zonal):
    about, whole = zonal
    values = np.repeat(whole[:, :3], 1, axis=1)
    values[20] = values[17]
    found = fit_matrix(about, Reference(matrix=values), FitOptions())
    assert not any("copies" in sentence for sentence in found.left_out)


SPOILT = {"not finite": np.nan, "zero": 0.0, "a copy": 1}


@pytest.mark.parametrize(("kind", "value"), SPOILT.items())
@pytest.mark.parametrize("key", ["influence_functions", "modes", "mode_to_actuator", "m2c of grid"])
def test_an_instrument_file_names_what_it_leaves_out(key, kind, value, tmp_path):
    shapes = functions()
    if key == "modes":
        shapes = np.tensordot(STROKES.T, shapes, axes=1)
    strokes = STROKES.copy()
    spoilt = strokes.T if "m" in key[:1] and key != "modes" else shapes
    good = spoilt.copy()
    spoilt[4] = spoilt[1] if kind == "a copy" else value
    mirror = {
        "influence_functions": 'influence_functions = "m.h5:/shapes"\nbasis = "zonal"',
        "modes": 'modes = "m.h5:/shapes"',
        "mode_to_actuator": 'influence_functions = "m.h5:/shapes"\n'
        'mode_to_actuator = "m.h5:/strokes"',
        "m2c of grid": GRID + 'mode_to_actuator = "m.h5:/strokes"',
    }[key]
    if "m.h5:/shapes" in mirror:
        mirror += f"\nmodes_pitch_m = {5.0 / N_POINTS}"
    about = bench(tmp_path, mirror, shapes=shapes, strokes=strokes)
    note = "; ".join(about.remarks)
    number = "4 (of 1)" if kind == "a copy" else "4"
    assert f"{number} is {kind}: left out" in note
    assert about.mirror.flat_modes.tolist() == [4]
    spoilt[:] = good
    whole = bench(tmp_path, mirror, shapes=shapes, strokes=strokes)
    assert whole.mirror.flat_modes.tolist() == []
    found = fitted(about, matrix(whole))
    assert 4 not in found.modes
    assert "without a usable shape in the instrument file: modes 4" in found.left_out


def test_strokes_of_which_no_mode_is_left_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="no mode that moves an actuator"):
        bench(tmp_path, GRID + 'mode_to_actuator = "m.h5:/strokes"', strokes=0.0 * STROKES)


def test_defects_are_found_without_a_second_copy_of_the_table():
    table = np.ones((4, 3, 3)) * np.arange(1.0, 5.0)[:, None, None]
    table[2] = table[0]
    assert find_defects(table) == {2: 0}


def smeared(values, share, seed=1):
    """Columns of pokes that had not settled: each holds a share of the one before; 1 % noise."""
    rng = np.random.default_rng(seed)
    made = (1.0 - share) * values
    made[:, 1:] += share * values[:, :-1]
    return made + 0.01 * np.abs(values).max() * rng.normal(size=values.shape)


@pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
def test_pokes_that_had_not_settled_are_named_with_their_share(tmp_path, share):
    """Taken as they are, the shift along the rows of actuators was 12 to 14 sigma off."""
    grid = GRID.replace("n_across = 5", "n_across = 7").replace("pitch_m = 1.0", "pitch_m = 0.7")
    about = bench(tmp_path, grid + 'basis = "zonal"')
    found = fitted(about, smeared(matrix(about), share))
    (note,) = [remark for remark in found.remarks if "had not settled" in remark]
    stated = float(note.partition("holds ")[2].partition("%")[0]) / 100.0
    assert stated == pytest.approx(share, abs=0.02)


def test_pokes_that_had_settled_are_not_said_to_be_smeared(zonal):
    about, whole = zonal
    for seed in range(3):
        found = fitted(about, smeared(whole, 0.0, seed))
        assert not any("settled" in remark for remark in found.remarks)
