"""Measured influence functions that end: known near their actuators, seen as whole ones are."""

import h5py
import numpy as np
import pytest

from service.config import crops
from service.instrument import load_instrument
from service.model import interaction
from service.model.instrument import instrument_sha256
from service.model.interaction import InteractionModel
from service.model.local import LocalShapes
from service.model.memory import work_of
from service.model.modes import modal_basis
from tests.numerics import SOMEWHERE

N_ACROSS, N_TABLE, DIAMETER_M = 17, 84, 3.0
PITCH_M, STEP_M = DIAMETER_M / 16, 1.15 * DIAMETER_M / N_TABLE
TABLE = """
[instrument]
name = "measured"
diameter_m = 3.0
obscuration_ratio = 0.2
stop = "mirror"
[wfs]
kind = "pyramid"
n_subapertures = 16
pupil_separation_subap = 20
wavelength_m = 750e-9
modulation_lambda_over_d = 3.0
[mirror]
"""
WHOLE = 'influence_functions = "ifs.h5:/cube"\n'
CROPPED = """influence_functions = "ifs.h5:/crops"
influence_origin = "ifs.h5:/origin"
influence_table = [84, 84]
"""
ZONAL, MODAL = 'basis = "zonal"\n', 'mode_to_actuator = "ifs.h5:/m2c"\n'
SIDE = 35


def functions(hole=False):
    """289 functions that end at 2.9 pitches; with a hole nothing is known of the middle."""
    line_m = (np.arange(N_TABLE) - (N_TABLE - 1) / 2) * STEP_M
    actuators_m = (np.arange(N_ACROSS) - (N_ACROSS - 1) / 2) * PITCH_M
    y, x = np.meshgrid(actuators_m, actuators_m, indexing="ij")
    along_y, along_x = ((line_m - at.reshape(-1, 1)) / PITCH_M for at in (y, x))
    squared = along_y[:, :, None] ** 2 + along_x[:, None, :] ** 2
    found = 0.35**squared * (squared < 2.9**2)
    if hole:
        found[:, np.hypot(line_m[:, None], line_m) < 0.25] = 0.0
    return found


def cropped(cube):
    """Return crops about the middle of each function, and where each begins."""
    middle = np.rint([np.argwhere(one).mean(axis=0) for one in cube]).astype(int)
    origin = middle - SIDE // 2
    around = np.pad(cube, ((0, 0), (SIDE, SIDE), (SIDE, SIDE)))
    crops = [
        one[r + SIDE : r + 2 * SIDE, c + SIDE : c + 2 * SIDE]
        for one, (r, c) in zip(around, origin, strict=True)
    ]
    return np.array(crops), origin


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """Return an instrument of a file's mirror, its functions local, or not."""
    folder = tmp_path_factory.mktemp("measured")
    cube = functions()
    patches, origin = cropped(cube)
    with h5py.File(folder / "ifs.h5", "w") as file:
        file["cube"], file["holed"] = cube, functions(hole=True)
        file["crops"], file["origin"] = patches, origin
        file["m2c"] = np.random.default_rng(1).normal(size=(len(cube), 250))
        file["wide"] = cube + 1e-3

    def load(mirror, local=True):
        path = folder / "bench.toml"
        path.write_text(f"{TABLE}modes_pitch_m = {STEP_M}\n{mirror}")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(crops, "_MIN_CROPPED_FUNCTIONS", 0 if local else np.inf)
            return load_instrument(path)

    return load


def model(instrument):
    return InteractionModel(
        instrument, modal_basis(instrument), pupil_sampling=2, detector_nodes=2, dtype=np.float64
    )


def apart(one, other):
    return np.linalg.norm(one - other, axis=-2).max() / np.linalg.norm(other, axis=-2).max()


@pytest.mark.parametrize("given", [WHOLE + ZONAL, CROPPED + MODAL, WHOLE + "parity = -1\n" + MODAL])
def test_d_and_its_derivatives_are_those_of_whole_tables(loaded, given, monkeypatch):
    # a mirror this small is drawn as a dense array, which is quicker
    monkeypatch.setattr(interaction, "_MAX_DENSE_PRODUCT", 0.0)
    ending, whole = (model(loaded(given, local)) for local in (True, False))
    assert (ending.instrument.mirror.cube, whole.instrument.mirror.local) == (None, None)
    assert isinstance(ending._rendered(SOMEWHERE), LocalShapes)
    found, expected = ending.linearise(SOMEWHERE), whole.linearise(SOMEWHERE)
    assert apart(found.matrix, expected.matrix) < 3e-6
    assert apart(found.rates, expected.rates) < 3e-6


def test_beyond_what_is_known_the_surface_goes_on_as_that_of_a_whole_table(loaded):
    given = WHOLE.replace("cube", "holed") + ZONAL
    ending, whole = (modal_basis(loaded(given, local)) for local in (True, False))
    points = np.random.default_rng(2).uniform(-9.0, 9.0, (400, 2))
    np.testing.assert_array_equal(ending.known(points), whole.known(points))
    assert not whole.known(points).all()
    np.testing.assert_allclose(ending.render(points), whole.render(points), atol=5e-6)
    away = np.tile([0.3, -0.7], (400, 1))
    slopes = whole.render_slope(points, away)
    np.testing.assert_allclose(ending.render_slope(points, away), slopes, atol=2e-5)


def test_turbulence_moves_the_modes_as_much(loaded):
    ending, whole = (modal_basis(loaded(WHOLE + MODAL, local)) for local in (True, False))
    np.testing.assert_allclose(ending.variance_m2, whole.variance_m2, rtol=2e-3)
    some = ending.subset([3, 5])
    np.testing.assert_allclose(some.render(np.eye(2)), ending.render(np.eye(2))[:, [3, 5]])


def test_functions_that_cover_the_table_stay_a_table(loaded):
    instrument = loaded(WHOLE.replace("cube", "wide") + ZONAL)
    assert instrument.mirror.local is None
    assert len(instrument.mirror.cube) == instrument.modes.n_modes == N_ACROSS**2


def test_what_ends_is_another_file_than_what_does_not_and_takes_less(loaded):
    ending, whole = (loaded(WHOLE + MODAL, local) for local in (True, False))
    assert instrument_sha256(ending) != instrument_sha256(whole)
    assert ending.mirror.n_modes == whole.mirror.n_modes == 250
    needed = [work_of(one, model(one).sensor, model(one).pupil) for one in (ending, whole)]
    assert needed[0].memory_bytes < needed[1].memory_bytes
