"""A mask and a pupil that disagree are named with their numbers, wherever both are known."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from pyrcal.__main__ import main
from pyrcal.fitting.advice import Advice
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.aperture import check_mask, find_offset, measure_aperture
from service.model.interaction import RtcInteractionModel
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import rtc_valid_subapertures

BENCH = """
[instrument]
name = "bench"
diameter_m = 4.0
stop = "telescope"
[wfs]
kind = "shack-hartmann"
n_subapertures = 16
wavelength_m = 650e-9
{more}
[mirror]
layout = "grid"
n_across = 5
pitch_m = 1.0
diameter_m = 5.2
basis = "zonal"
[slopes]
orientation = {{ sign = 1 }}
"""


def mask_of(diameter, shift=(0.0, 0.0)):
    rows, columns = np.mgrid[:16, :16] - 7.5
    return np.hypot(rows - shift[1], columns - shift[0]) <= diameter / 2


def bench(folder, mask=None, more=""):
    if mask is not None:
        with h5py.File(folder / "mask.h5", "w") as file:
            file["valid"] = mask.astype(np.uint8)
        more += '\nvalid_subapertures = "mask.h5:/valid"'
    path = folder / "bench.toml"
    path.write_text(BENCH.format(more=more))
    return path


@pytest.mark.parametrize(("diameter", "x"), [(16.0, 0.0), (15.2, 0.0), (16.8, 0.0), (16.0, 0.2)])
def test_a_mask_as_wide_as_its_pupil_is_not_mentioned(diameter, x, tmp_path):
    assert load_instrument(bench(tmp_path, mask_of(diameter, (x, 0.0)))).remarks[1:] == ()


@pytest.mark.parametrize(
    ("mask", "more", "said"),
    [
        (mask_of(8.0), "", ("{mask:.1f} subapertures across", "wfs.pupil_diameter_subap")),
        (
            mask_of(16.0),
            "pupil_diameter_subap = 12.0",
            ("{mask:.1f} subap", "wfs.pupil_diameter_subap"),
        ),
    ],
)
def test_a_mask_unlike_its_pupil_is_named_with_numbers(mask, more, said, tmp_path, capsys):
    path = bench(tmp_path, mask, more)
    (note,) = [one for one in load_instrument(path).remarks if "valid_subapertures" in one]
    wide = measure_aperture(mask).diameter_subap
    assert all(words.format(mask=wide) in note for words in said)
    assert main(["instrument", "check", str(path), "--memory-gb=0.001"]) == 0
    assert f"note: {note}" in capsys.readouterr().out


@pytest.mark.parametrize("hole", [0.0, 4.0])
@pytest.mark.parametrize("way", ["column", "three columns", "row and column", "corner", "arm"])
def test_a_part_that_is_missing_neither_moves_nor_narrows_a_pupil(way, hole):
    mask = mask_of(16.0) & ~mask_of(hole)
    whole, wide = measure_aperture(mask), measure_aperture(np.pad(mask, 1))
    assert whole.is_round
    assert (whole.n_across, wide.n_across) == (16, 16)
    mask[:, 0] &= way not in {"column", "three columns", "row and column"}
    mask[:, 1:3] &= way != "three columns"
    mask[-1] &= way != "row and column"
    mask[:5, :5] &= way != "corner"
    mask[10] &= way != "arm"
    cut = measure_aperture(mask)
    assert np.hypot(*cut.centre) < 0.15
    assert abs(cut.diameter_subap - whole.diameter_subap) < 0.2
    assert cut.n_across == 16
    assert find_offset(mask, 16.0) is None


def test_a_mask_of_which_much_is_missing_says_nothing_of_the_place_of_the_pupil():
    mask = mask_of(16.0)
    mask[:3, :], mask[:, :3] = False, False
    assert not measure_aperture(mask).is_round
    assert find_offset(mask, 16.0) is None


def test_lenslets_see_the_pupil_where_the_whole_mask_shows_it(tmp_path):
    path = bench(tmp_path, mask_of(15.0, (-0.5, 0.0)), "pupil_diameter_subap = 15.0")
    about = load_instrument(path)
    assert check_mask(about) is None
    seen, told, centred = (
        RtcInteractionModel(one, modal_basis(one), pupil_sampling=3, detector_nodes=3)
        .interaction_matrix(Misregistration())
        .astype(float)
        for one in (
            about,
            replace(about, pupil_shift_subap=(-0.5, 0.0)),
            replace(about, pupil_shift_subap=(1e-9, 0.0)),
        )
    )
    assert np.abs(seen - told).max() < 0.05 * np.abs(told - centred).max()


def test_the_pupil_moves_with_the_mirror_where_that_is_the_stop(tmp_path):
    about = load_instrument(bench(tmp_path, mask_of(15.0, (-0.5, 0.0)), "pupil_diameter_subap=15"))
    about = replace(about, stop=Stop.MIRROR)
    assert check_mask(about) is None
    assert check_mask(about, (-0.5, 0.0)) is None
    assert "-0.50, +0.00" in check_mask(about, (0.1, 0.0))


def test_an_import_names_a_told_pupil_that_is_not_the_masks(tmp_path, capsys):
    mask = mask_of(15.0)[::2, ::2]
    rng = np.random.default_rng(1)
    np.savez(
        tmp_path / "all.npz",
        matrix=rng.normal(size=(2 * int(mask.sum()), 5)),
        valid=mask,
        modes=rng.normal(size=(5, 12, 12)),
    )
    words = ["import", "files", str(tmp_path / "all.npz"), "--diameter-m", "2", "--pupil-subap"]
    assert main([*words, "5", "--output", str(tmp_path / "out")]) == 0
    assert "pupil_diameter_subap" in capsys.readouterr().out


def test_a_refused_fit_names_mask_and_pupil_instead_of_another_stop(tmp_path):
    true = load_instrument(bench(tmp_path, more="pupil_diameter_subap = 8.0"))
    mask = rtc_valid_subapertures(true)
    model = RtcInteractionModel(true, modal_basis(true), pupil_sampling=3, detector_nodes=3)
    alpha = Misregistration(shift_x_subap=0.1, shift_y_subap=-0.05, rotation_rad=0.01)
    values = np.asarray(model.interaction_matrix(alpha), float)
    stated = load_instrument(bench(tmp_path, mask))
    found = fit_matrix(stated, Reference(matrix=values), FitOptions(explain=True))
    assert not found.accepted
    assert found.recommendation.startswith(Advice.DO_NOT_USE)
    assert check_mask(stated) in found.recommendation
    corrected = load_instrument(bench(tmp_path, mask, "pupil_diameter_subap = 8.0"))
    found = fit_matrix(corrected, Reference(matrix=values), FitOptions(explain=True))
    assert found.accepted
    assert np.all(np.abs(found.alpha.vector - alpha.vector) < 3.0 * found.sigma)
