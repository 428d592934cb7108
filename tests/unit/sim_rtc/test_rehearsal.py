from dataclasses import replace

import h5py
import numpy as np
import pytest

from service.errors import ConfigurationError
from service.files.toml import read_toml
from service.instrument import load_instrument
from service.model.instrument import instrument_sha256
from service.model.kinds import BasisKind
from sim_rtc.rehearsal import with_modes, write_live_instrument
from tests.support.night import INSTRUMENT

BENCH = """
[instrument]
name = "bench"
diameter_m = 1.0
stop = "telescope"

[wfs]
kind = "pyramid"
n_subapertures = 10
pupil_diameter_subap = 9.5
wavelength_m = 1e-6
modulation_lambda_over_d = "unknown"
input = "frames"
pixels_per_subaperture = 2
pupil_centres_px = [[12.0, 12.5], [12.0, 40.5], [40.0, 12.5], [40.0, 40.5]]
valid_subapertures = "arrays.h5:/mask"

[mirror]
layout = "positions"
positions = "arrays.h5:/positions"
influence = "gaussian"
coupling = "unknown"
basis = "zonal"
stroke = "unknown"

[slopes]
orientation = { swap_xy = true, flip_x = false, flip_y = true, sign = [1, -1] }
"""


@pytest.fixture
def bench(tmp_path):
    folder = tmp_path / "bench"
    folder.mkdir()
    axis = np.linspace(-0.5, 0.5, 6)
    x, y = np.meshgrid(axis, axis)
    with h5py.File(folder / "arrays.h5", "w") as file:
        file["positions"] = np.column_stack([x.ravel(), y.ravel()])
        file["mask"] = np.hypot(*np.indices((10, 10)) - 4.5) < 4.8
    path = folder / "bench.toml"
    path.write_text(BENCH, encoding="utf-8")
    return path


def test_the_services_file_has_slopes_known_strokes_and_modes(bench, tmp_path):
    live = tmp_path / "live.toml"
    write_live_instrument(bench, live, 20)
    given, found = load_instrument(bench), load_instrument(live)
    assert (given.frames is None, given.mirror.stroke_known) == (False, False)
    assert (found.frames, found.mirror.stroke_known) == (None, True)
    assert found.modes.n_modes == 20
    assert found.mirror.basis is BasisKind.KARHUNEN_LOEVE
    assert found.slopes == given.slopes
    assert found.unknown == given.unknown
    np.testing.assert_array_equal(found.wfs.valid_subapertures, given.wfs.valid_subapertures)
    np.testing.assert_array_equal(found.mirror.positions_m, given.mirror.positions_m)
    assert "pupil_centres_px" not in read_toml(live)["wfs"]


@pytest.mark.parametrize("name", ["flao-lbt", "gpao-ut", "soul-lbt", "aof-ut4", str(INSTRUMENT)])
def test_a_file_of_slopes_and_metres_is_the_same_instrument(name, tmp_path):
    write_live_instrument(name, tmp_path / "live.toml")
    given, found = load_instrument(name), load_instrument(tmp_path / "live.toml")
    assert instrument_sha256(found) == instrument_sha256(given)


def test_single_actuators_give_way_to_half_as_many_modes(bench):
    zonal = load_instrument(bench)
    assert with_modes(zonal, None).modes.n_modes == 18
    assert with_modes(zonal, 7).modes.n_modes == 7
    for n_modes in (1, 36):
        with pytest.raises(ConfigurationError, match="--modes"):
            with_modes(zonal, n_modes)
    modal = load_instrument("flao-lbt")
    assert with_modes(modal, None) is modal
    with pytest.raises(ConfigurationError, match="--modes"):
        with_modes(modal, 100)
    own = replace(zonal, mirror=replace(zonal.mirror, mode_to_actuator=np.eye(36)[:, :5]))
    assert with_modes(own, None) is own


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(ConfigurationError, match="--write-instrument"):
        write_live_instrument("flao-lbt", tmp_path / "nowhere" / "live.toml")
