"""Folders of cacao's, example folders and ``conf``, are imported as they are."""

import os
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

import pyrcal
from pyrcal.__main__ import main
from pyrcal.importers.cacao import from_cacao
from pyrcal.importers.files import Reported
from service.errors import MatrixError
from tests.support.import_cacao import (
    CENTRES,
    PLACES,
    RADIUS_PX,
    VARIABLES,
    a_grid,
    a_list_of_actuators,
)

REPORTED = Reported(diameter_m=2.0, stop="telescope")
BENCHES = Path(os.environ.get("PYRCAL_BENCH_DATA", "../shared/data"))
AO188 = BENCHES / "ao188"


def test_camera_pixels_and_a_list_of_actuators_are_one_command(tmp_path, capsys):
    a_list_of_actuators(tmp_path)
    np.savetxt(tmp_path / "act2Dpos.txt", PLACES)
    words = ["import", "cacao", str(tmp_path), "--diameter-m", "2"]
    assert main([*words, "--output", str(tmp_path / "bench")]) == 0
    said = capsys.readouterr().out
    assert "took respM.fits.fz" in said
    assert "ignored wfsdark.fits" in said
    instrument = pyrcal.load_instrument(tmp_path / "bench" / "instrument.toml")
    frames = instrument.frames
    np.testing.assert_allclose(frames.centres_px, CENTRES, atol=0.1)
    assert instrument.wfs.pupil_diameter * frames.pixels_per_subaperture == pytest.approx(
        2 * RADIUS_PX, abs=0.3
    )
    assert instrument.obscuration_ratio == pytest.approx(6.0 / 28.0, abs=0.02)
    assert instrument.modes.n_modes == 12


def test_a_list_of_actuators_without_positions_is_refused_and_nothing_is_left(tmp_path, capsys):
    a_list_of_actuators(tmp_path)
    words = ["import", "cacao", str(tmp_path), "--diameter-m", "2"]
    assert main([*words, "--output", str(tmp_path / "bench")]) == 2
    assert "list of 12 actuators without positions" in capsys.readouterr().err
    assert not (tmp_path / "bench").exists()


def test_influence_functions_serve_where_there_are_no_positions(tmp_path):
    a_list_of_actuators(tmp_path)
    rows, columns = np.mgrid[:20, :20]
    functions = [np.hypot(rows - k, columns - k) for k in range(12)]
    fits.writeto(tmp_path / "influ_sim.fits", np.array(functions))
    found = from_cacao(tmp_path, REPORTED)
    assert found.arrays["mode_shapes"].shape == (12, 20, 20)


def test_pokes_outside_the_mask_are_counted_and_dead_ones_named_by_their_number(tmp_path):
    maps, valid = a_grid(tmp_path)
    actuators = np.ones((4, 4), np.float32)
    actuators[0, [0, 3]] = 0.0
    fits.writeto(tmp_path / "DMmaskCTRL.fits", actuators)
    fits.writeto(tmp_path / "DMmaskEXTR.fits", actuators)
    found = from_cacao(tmp_path, REPORTED)
    assert any(note.startswith("2 of 16 pokes") for note in found.notes)
    assert "column 5 is zero: left out" in found.notes
    kept = [n for n in range(16) if n not in {0, 3, 5}]
    np.testing.assert_array_equal(found.arrays["kept_actuators"], kept)
    matrix = np.moveaxis(np.stack(np.split(maps[kept], 2, axis=2)), 1, -1)[:, valid]
    np.testing.assert_allclose(
        found.arrays["interaction_matrix"], matrix.reshape(-1, 13), rtol=1e-6
    )
    # actuator 1 is column 1 of row 0 of a grid whose 4 columns span 2 m
    np.testing.assert_allclose(found.arrays["positions"][0], [-1 / 3, -1.0])
    assert found.tables["wfs"]["kind"] == "shack-hartmann"
    found.save(tmp_path / "bench")


def test_a_grid_is_known_by_the_variables_alone_and_a_list_is_not(tmp_path):
    a_grid(tmp_path)
    assert len(from_cacao(tmp_path, REPORTED).arrays["positions"]) == 15
    (tmp_path / "cacaovars.loop.bash").write_text(
        VARIABLES.format(x=4, y=4, spatial="0", stream="shwfs", processed="ON")
    )
    with pytest.raises(MatrixError, match="16 actuators without positions"):
        from_cacao(tmp_path, REPORTED)


def test_links_to_one_file_are_one_file_and_another_response_can_be_asked_for(tmp_path):
    """The ``conf`` folder of a loop that runs links its newest response."""
    maps, _ = a_grid(tmp_path)
    (tmp_path / "RMmodesWFS").mkdir()
    (tmp_path / "loop.zrespM.fits").rename(tmp_path / "RMmodesWFS" / "zrespM-H.fits")
    (tmp_path / "RMmodesWFS" / "RMmodesWFS.fits").symlink_to(
        tmp_path / "RMmodesWFS" / "zrespM-H.fits"
    )
    fits.writeto(tmp_path / "loRM.fits", maps[:3].astype(np.float32))
    fits.writeto(tmp_path / "loRMmodes.fits", np.random.default_rng(3).normal(size=(3, 4, 4)))
    assert len(from_cacao(tmp_path, REPORTED).arrays["positions"]) == 15
    low = from_cacao(tmp_path, REPORTED, "loRM")
    assert low.arrays["mode_to_actuator"].shape == (16, 3)
    with pytest.raises(MatrixError, match="expected the response other"):
        from_cacao(tmp_path, REPORTED, "other")


def test_a_conf_folder_with_its_copies_and_hadamard_pokes_is_imported_as_it_is(tmp_path):
    """As cacao-aorun-030, 031 and 039 leave it: each result is linked or copied once more."""
    maps, _ = a_grid(tmp_path)
    modes = np.random.default_rng(5).normal(size=(16, 4, 4)).astype(np.float32)
    measured = np.tensordot(modes.reshape(16, 16), maps, axes=1).astype(np.float32)
    (tmp_path / "loop.zrespM.fits").unlink()
    for folder, name, values in (
        ("RMmodesDM", "HpokeC", modes),
        ("RMmodesWFS", "HpokeC.WFSresp", measured),
        ("CMmodesDM", "CMmodesDM", modes[:5]),
        ("CMmodesWFS", "CMmodesWFS", measured[:5]),
    ):
        (tmp_path / folder).mkdir(exist_ok=True)
        fits.writeto(tmp_path / folder / f"{name}.fits", values)
        plain = f"{folder}.fits"
        if folder.startswith("RM"):
            (tmp_path / folder / plain).symlink_to(tmp_path / folder / f"{name}.fits")
            fits.writeto(tmp_path / f"RMmeas_{folder[2:]}.fits", values)
        else:
            fits.writeto(tmp_path / plain, values)
    found = from_cacao(tmp_path, REPORTED)
    assert found.arrays["mode_to_actuator"].shape == (16, 16)
    low = from_cacao(tmp_path, REPORTED, "CMmodesWFS")
    assert low.arrays["mode_to_actuator"].shape == (16, 5)
    fits.writeto(tmp_path / "RMzrec_modesWFS.fits", maps.astype(np.float32))
    assert "mode_to_actuator" not in from_cacao(tmp_path, REPORTED).arrays


def test_two_responses_of_one_kind_are_refused_by_name(tmp_path):
    maps, _ = a_grid(tmp_path)
    fits.writeto(tmp_path / "second.zrespM.fits", 2 * maps)
    with pytest.raises(MatrixError, match=r"loop\.zrespM\.fits, second\.zrespM\.fits"):
        from_cacao(tmp_path, REPORTED)


@pytest.mark.skipif(not AO188.is_dir(), reason="the measured data are not there")
def test_the_folder_of_ao188_is_imported_as_it_is(tmp_path):
    found = from_cacao(AO188, Reported(diameter_m=7.92, stop="telescope"))
    assert found.arrays["interaction_matrix"].shape == (188, 160, 160)
    assert found.tables["instrument"]["obscuration_ratio"] == pytest.approx(0.32, abs=0.03)
    found.save(tmp_path / "bench")
