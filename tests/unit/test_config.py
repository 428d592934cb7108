"""Instrument files and settings: what is read, and the one line that says what is wrong."""

import re
import sys
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from astropy.io import fits

from service.config import Settings, load_settings
from service.errors import ConfigurationError, ModelError
from service.files.toml import read_toml
from service.instrument import crops, load_instrument, packaged_file
from service.instrument.mirrors import coincident, grid, hexagonal, rings, typical_pitch
from service.model import interaction
from service.model.instrument import instrument_sha256
from service.model.interaction import InteractionModel
from service.model.kinds import Influence, LoopFacts, Normalisation, SignalKind, SlopeOrder, Stop
from service.model.local import LocalShapes
from service.model.memory import work_of
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import (
    instrument_pupil,
    lit_subapertures,
    rtc_valid_subapertures,
    valid_subapertures,
)
from service.model.sensors.registry import kind_of
from service.model.slopes import Orientation
from service.records.state import Mode
from sim_rtc.telescope.diffractive import build_centred_pupil
from tests.support.config import ABOUT, MIRROR, MODES
from tests.support.numerics import SOMEWHERE

WFS = (
    '[wfs]\nkind = "pyramid"\nn_subapertures = 20\nwavelength_m = 750e-9\n'
    "modulation_lambda_over_d = 3.0\n"
)
APART = WFS + "pupil_separation_subap = 24\n"


ROUND = APART.replace("modulation_lambda_over_d = 3.0", "modulation_ellipse = {}")


@pytest.fixture
def write(tmp_path):
    def _write(text, name="bench.toml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return _write


def refusal(load, *args) -> str:
    with pytest.raises(ConfigurationError) as caught:
        load(*args)
    message = str(caught.value)
    assert "\n" not in message
    return message


# --- files that no parser should meet


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 100_000, "found more, expected at most 32 tables"),
        ("a = " + "{a = " * 2000, "found more, expected at most 32 tables"),
        ("a = " + "[" * 40 + "]" * 40, "found more, expected at most 32 tables"),
        ("[" + "a . " * 200_000 + "a]", "found a longer dotted key, expected at most 32"),
        ("a" + '."b"' * 200_000 + " = 1", "found a longer dotted key, expected at most 32"),
        ("a = " + "9" * 5000, "not valid TOML"),
        ("# no\n" * 1_000_000, "found a larger file, expected at most 4 MB"),
    ],
)
def test_deep_long_and_endless_toml_is_refused_in_one_line_at_once(write, text, words):
    began_s = time.process_time()
    assert words in refusal(load_instrument, str(write(text)))
    assert time.process_time() - began_s < 2.0


def test_many_dots_that_are_no_key_are_read(write):
    text = f'a = "{"see 1.2.3. " * 1000}" # {"www.a.b " * 100}\nb = [{"0.5, " * 10_000}]\n'
    assert len(read_toml(write(text))["b"]) == 10_000


# --- layouts


def test_rings_2_to_14_hold_the_663_actuators_of_flao():
    assert rings(2, 14, 0.30).shape == (663, 2)


def test_the_first_ring_has_nine_actuators_at_half_a_pitch_the_first_on_plus_x():
    ring = rings(1, 1, 0.30)
    assert len(ring) == 9
    np.testing.assert_allclose(np.hypot(*ring.T), 0.15, rtol=1e-12)
    np.testing.assert_allclose(ring[0], [0.15, 0.0], atol=1e-15)
    assert ring[1, 1] > 0, "actuators follow one another from +x towards +y"


def test_rings_are_their_own_mirror_image_under_a_flip_of_y():
    positions = rings(2, 5, 0.3)
    flipped = positions * [1, -1]
    distances = np.linalg.norm(positions[:, None] - flipped[None], axis=2)
    assert distances.min(axis=1).max() < 1e-12


def test_an_11_by_11_grid_in_a_circle_has_the_97_actuators_of_an_alpao_dm97():
    positions = grid(11, 0.5, 11 * 0.5)
    assert positions.shape == (97, 2)
    np.testing.assert_allclose(positions.mean(axis=0), 0, atol=1e-12)
    assert typical_pitch(positions) == pytest.approx(0.5)


def test_a_17_by_17_grid_in_a_circle_has_the_241_actuators_of_an_alpao_dm241():
    assert len(grid(17, 1.5e-3, 17.5 * 1.5e-3)) == 241


def test_a_hexagonal_layout_has_six_neighbours_each_and_one_in_the_middle():
    positions = hexagonal(0.5, 5 * 0.5)
    assert len(positions) == 1 + 6 + 6 + 6
    apart = np.linalg.norm(positions[:, None] - positions, axis=2)
    middle = int(np.argmin(np.hypot(*positions.T)))
    np.testing.assert_allclose(positions[middle], 0.0, atol=1e-12)
    for one in range(len(positions)):
        if np.hypot(*positions[one]) < 0.8:
            np.testing.assert_allclose(np.sort(apart[one])[1:7], 0.5)
    assert typical_pitch(positions) == pytest.approx(0.5)
    mirrored = np.linalg.norm(positions[:, None] - positions * [1, -1], axis=2)
    assert mirrored.min(axis=1).max() < 1e-12


def test_a_hole_leaves_out_what_is_nearer_to_the_middle_than_half_of_it():
    every, around = hexagonal(0.5, 4.0), hexagonal(0.5, 4.0, 1.01)
    inner = np.linalg.norm(every, axis=1) < 0.505
    assert inner.sum() == 7
    np.testing.assert_array_equal(around, every[~inner])


def test_a_file_may_ask_for_a_hexagonal_layout(write):
    mirror = '[mirror]\nlayout = "hexagonal"\npitch_m = 0.5\ndiameter_m = 8.5\n'
    bench = load_instrument(write(ABOUT + APART + mirror + MODES))
    np.testing.assert_allclose(bench.mirror.positions_m, hexagonal(0.5, 8.5))
    assert bench.mirror.pitch_m == 0.5
    message = refusal(load_instrument, write(ABOUT + APART + mirror + "n_across = 9\n" + MODES))
    assert 'n_across: belongs to layout = "grid"' in message


def test_a_grid_keeps_the_points_that_lie_on_its_circle():
    assert len(grid(3, 0.1, 0.2)) == 5


def test_two_actuators_in_one_place_are_named():
    assert coincident(np.array([[0.0, 0], [1, 0], [0, 1], [1, 0]])) == (1, 3)
    assert coincident(rings(1, 3, 0.3)) is None


# --- instrument files


def test_the_packaged_flao_is_what_the_paper_describes():
    flao = load_instrument("flao-lbt")
    assert flao.name == "flao-lbt"
    assert (flao.diameter_m, flao.obscuration_ratio) == (8.22, 0.11)
    assert flao.stop is Stop.MIRROR
    assert not flao.double_pass
    assert flao.subaperture_m == pytest.approx(0.274)
    assert flao.wfs.pupil_separation_subap == 36
    assert flao.wfs.wavelength_m == 750e-9
    assert flao.wfs.modulation_lambda_over_d == 3
    assert (flao.wfs.flux_threshold, flao.wfs.valid_subapertures) == (0.5, None)
    assert flao.mirror.positions_m.shape == (663, 2)
    assert flao.mirror.pitch_m == 0.30
    assert flao.mirror.shape.influence is Influence.THIN_PLATE
    assert (flao.modes.n_modes, flao.modes.r0_m, flao.modes.outer_scale_m) == (594, 0.10, 25.0)
    assert (flao.basis_id, flao.config_id) == (None, None)


def test_the_packaged_soul_is_what_its_sources_say():
    """Of SPECULA's own file: 220 x 0.037372727 m, pyramid, 0.588 ms, 500 modes."""
    soul = load_instrument("soul-lbt")
    assert soul.diameter_m == pytest.approx(220 * 0.037372727, abs=1e-4)
    assert (soul.wfs.n_subapertures, soul.wfs.pupil_separation_subap) == (40, 48)
    assert (soul.wfs.wavelength_m, soul.wfs.modulation_lambda_over_d) == (750e-9, 3.0)
    assert (soul.loop.delay_frames, soul.loop.n_controlled) == (2, 500)
    assert 1 / soul.loop.frame_rate_hz == pytest.approx(0.588e-3, rel=1e-3)
    assert soul.modes.outer_scale_m == 40.0
    assert soul.modes.r0_m == pytest.approx(0.98 * 500e-9 / np.deg2rad(0.8 / 3600), rel=0.01)


def test_the_packaged_gpao_is_what_its_sources_say():
    """Table B.1 of aa55666-25: the pupil fills 97.0 % of 40, the pitch is 102.8 % of one."""
    gpao = load_instrument("gpao-ut")
    assert gpao.wfs.kind == "shack-hartmann"
    assert gpao.wfs.n_subapertures == 40
    assert gpao.wfs.pupil_diameter == pytest.approx(0.970 * 40)
    assert gpao.mirror.pitch_m / gpao.subaperture_m == pytest.approx(1.028, abs=1e-3)
    assert len(gpao.mirror.positions_m) == 1433
    assert gpao.wfs.pixel_lambda_over_d(gpao.subaperture_m) == pytest.approx(1.0, abs=0.01)
    assert not gpao.remarks


def test_the_packaged_aof_is_what_its_sources_say():
    """Of SynIM's own file: 160 x 0.05 m, 40 x 40 with six pixels of 0.85", 589 nm, 1 ms."""
    aof = load_instrument("aof-ut4")
    assert aof.diameter_m == pytest.approx(160 * 0.05)
    assert aof.wfs.kind == "shack-hartmann"
    assert (aof.wfs.n_subapertures, aof.wfs.pixels_per_subaperture) == (40, 6)
    assert 6 * aof.wfs.pixel_scale_arcsec == pytest.approx(5.1)
    assert aof.wfs.wavelength_m == 589e-9
    assert len(aof.mirror.positions_m) == 1170
    # the mask of GALACSI and ERIS that aotpy has: a hole of 6 x 6 subapertures without its corners
    valid = valid_subapertures(aof)
    assert int(valid.sum()) == 1240
    hole = [2, 4, 6, 6, 4, 2]
    assert [int(row[15:25].size - row[15:25].sum()) for row in valid[17:23]] == hole
    assert [int(row.sum()) for row in valid[:4]] == [8, 16, 20, 22]
    assert 1 / aof.loop.frame_rate_hz == 0.001
    assert aof.modes.outer_scale_m == 25.0
    assert aof.modes.r0_m == pytest.approx(0.98 * 500e-9 / np.deg2rad(0.644 / 3600), rel=0.01)
    assert not aof.remarks


def test_the_packaged_maps_has_the_published_rings():
    """act2Dpos.txt of cacao's example: 336 actuators on ten rings, out to .976 of the radius."""
    maps = load_instrument("maps-mmt")
    radii = np.hypot(*maps.mirror.positions_m.T) / 3.25
    found, numbers = np.unique(np.round(radii, 2), return_counts=True)
    assert found.tolist() == [0.13, 0.23, 0.33, 0.42, 0.52, 0.62, 0.72, 0.81, 0.91, 0.98]
    assert numbers.tolist() == [6, 12, 18, 24, 30, 36, 42, 48, 60, 60]
    assert maps.mirror.shape.influence is Influence.GAUSSIAN
    assert (maps.diameter_m, maps.wfs.kind, maps.stop) == (6.5, "pyramid", Stop.MIRROR)
    assert not maps.remarks


def test_the_packaged_papyrus_is_what_its_twin_and_its_data_say():
    """ALPAO DM 241 at a pitch of 2.5 mm, of which the calibration pupil lights 37.5 mm."""
    papyrus = load_instrument("papyrus")
    assert len(papyrus.mirror.positions_m) == 241
    assert papyrus.diameter_m / papyrus.mirror.pitch_m == pytest.approx(15.0, abs=1e-3)
    assert papyrus.obscuration_ratio == 0.0
    assert (papyrus.wfs.wavelength_m, papyrus.wfs.modulation_lambda_over_d) == (640e-9, 5.0)
    assert papyrus.wfs.pupil_diameter == 37.0
    assert not papyrus.remarks


@pytest.mark.parametrize(
    ("rings", "says"),
    [
        ("ring_actuators = [6, 12]", "ring_radii_m: missing"),
        ("ring_actuators = [6, 12]\nring_radii_m = [1.0]", "found 1 radii"),
        ("ring_actuators = [6]\nring_radii_m = [1.0]\nlast_ring = 3", "last_ring: has no effect"),
        ("ring_actuators = [3]\nring_radii_m = [1.0]", "found 3 actuators"),
    ],
)
def test_rings_that_are_listed_belong_together(rings, says, tmp_path):
    text = packaged_file("maps-mmt").read_text("utf-8")
    text = re.sub(r"ring_radii_m = .*\n", "", text)
    path = tmp_path / "it.toml"
    path.write_text(re.sub(r"ring_actuators = .*", rings, text), "utf-8")
    with pytest.raises(ConfigurationError, match=says):
        load_instrument(path)


def test_the_packaged_canary_is_what_soapys_tutorial_says():
    canary = load_instrument("canary")
    assert canary.diameter_m == 4.2
    assert canary.obscuration_ratio * 4.2 == pytest.approx(1.2, abs=1e-3)
    assert (canary.wfs.n_subapertures, canary.wfs.pixels_per_subaperture) == (7, 14)
    assert 14 * canary.wfs.pixel_scale_arcsec == pytest.approx(2.5, abs=1e-3)
    assert len(canary.mirror.positions_m) == 52
    assert canary.loop.frame_rate_hz == 200
    assert not canary.remarks


def test_a_users_file_gives_an_instrument(write):
    pins = 'basis_id = "kl-7"\nconfig_id = "b1"\ndouble_pass = true\n'
    extra = 'influence = "gaussian"\ncoupling = 0.2\n'
    bench = load_instrument(
        write(ABOUT + pins + WFS + "pupil_diameter_subap = 19.5\n" + MIRROR + extra + MODES)
    )
    assert bench.stop is Stop.TELESCOPE
    assert bench.double_pass
    assert (bench.basis_id, bench.config_id) == ("kl-7", "b1")
    assert bench.wfs.pupil_diameter == 19.5
    assert (bench.mirror.shape.influence, bench.mirror.shape.coupling) == (Influence.GAUSSIAN, 0.2)
    assert len(bench.mirror.positions_m) == 97
    assert bench.modes.n_modes == 50


def test_only_the_mandatory_keys_are_needed_for_rings(write):
    bench = load_instrument(write(ABOUT + WFS + '[mirror]\nlayout = "rings"\n'))
    assert len(bench.mirror.positions_m) == 663
    assert bench.obscuration_ratio == 0.0
    assert bench.modes.n_modes == 594


def test_a_smaller_mirror_has_nine_tenths_of_its_modes_unless_told(write):
    """97 actuators make 96 modes without piston; FLAO's file has 594 of 662."""
    assert load_instrument(write(ABOUT + WFS + MIRROR)).modes.n_modes == 86


def test_positions_come_from_a_dataset_beside_the_file(write, tmp_path):
    positions = grid(5, 1.0, 6.0)
    with h5py.File(tmp_path / "act.h5", "w") as file:
        file["geometry/xy_m"] = positions
    bench = load_instrument(
        write(
            ABOUT
            + WFS
            + '[mirror]\nlayout = "positions"\npositions = "act.h5:/geometry/xy_m"\n'
            + "[modes]\nn_modes = 9\n"
        )
    )
    np.testing.assert_array_equal(bench.mirror.positions_m, positions)
    assert bench.mirror.pitch_m == 1.0


def test_a_mask_of_valid_subapertures_comes_from_a_dataset(write, tmp_path):
    mask = np.zeros((20, 20), np.uint8)
    mask[3, 7] = 1
    with h5py.File(tmp_path / "mask.h5", "w") as file:
        file["valid"] = mask
    bench = load_instrument(
        write(ABOUT + WFS + 'valid_subapertures = "mask.h5:/valid"\n' + MIRROR + MODES)
    )
    assert bench.wfs.valid_subapertures.dtype == bool
    np.testing.assert_array_equal(np.argwhere(bench.wfs.valid_subapertures), [[3, 7]])


def test_values_that_ask_for_nothing_new_are_accepted(write):
    extra = 'nominal_rotation_deg = 0.0\nparity = 1\nstroke = "known"\n'
    slopes = (
        '[slopes]\norder = "xy"\nnormalisation = "global"\n'
        "orientation = { swap_xy = false, flip_x = false, flip_y = false, sign = 1 }\n"
    )
    wfs = WFS + 'input = "slopes"\n'
    assert load_instrument(write(ABOUT + wfs + MIRROR + extra + MODES + slopes)).name == "bench"
    auto = '[slopes]\norientation = "auto"\n'
    assert load_instrument(write(ABOUT + WFS + MIRROR + MODES + auto)).name == "bench"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            ABOUT.replace("diameter_m", "diamter_m") + WFS + MIRROR,
            "instrument.diamter_m: unknown key, did you mean diameter_m?",
        ),
        (
            ABOUT + "obscuration = 0.1\n" + WFS + MIRROR,
            "instrument.obscuration: unknown key, did you mean obscuration_ratio?",
        ),
        (ABOUT + WFS + MIRROR + "[mode]\n", "mode: unknown key, did you mean modes?"),
        (
            ABOUT + WFS + MIRROR + "[zzzz]\n",
            "zzzz: unknown key; known: instrument, law, loop, mirror",
        ),
        (ABOUT.replace("8.0", '"8"') + WFS + MIRROR, "instrument.diameter_m: found '8', expected"),
        (ABOUT.replace("8.0", "-8.0") + WFS + MIRROR, "found -8.0, expected greater than 0"),
        (ABOUT.replace("8.0", "inf") + WFS + MIRROR, "found inf, expected a finite number"),
        (
            ABOUT.replace('"telescope"', '"pupil"') + WFS + MIRROR,
            "instrument.stop: found 'pupil', expected 'mirror' or 'telescope'",
        ),
        (
            ABOUT.replace('"bench"', '"a/b"') + WFS + MIRROR,
            "instrument.name: found 'a/b', expected text that matches",
        ),
        (ABOUT + "wfs = 3\n" + MIRROR, "instrument.wfs: unknown key"),
        ("wfs = 3\n" + ABOUT + MIRROR, "wfs: found 3, expected a table [wfs]"),
        (ABOUT + APART.replace("20", "40") + MIRROR + MODES, "the images would overlap"),
        (ABOUT + WFS + "[mirror]\n", "expected one of layout, modes, influence_functions"),
        (
            ABOUT + WFS + MIRROR + "first_ring = 1\n",
            'mirror.first_ring: belongs to layout = "rings", found layout = "grid"',
        ),
        (ABOUT + WFS + MIRROR + "coupling = 0.3\n", 'belongs to influence = "gaussian"'),
        (
            ABOUT + WFS + MIRROR.replace("pitch_m = 0.8\n", ""),
            'mirror.pitch_m: missing, layout = "grid" needs n_across, pitch_m, diameter_m',
        ),
        (
            ABOUT + WFS + '[mirror]\nlayout = "rings"\nlast_ring = 1\n',
            "mirror.last_ring: found 1, expected at least first_ring = 2",
        ),
        (
            ABOUT + WFS + MIRROR.replace("8.8", "0.1"),
            "mirror: found 1 actuators, expected",
        ),
        (
            ABOUT + WFS + MIRROR + "[modes]\nn_modes = 594\n",
            "modes.n_modes: found 594, expected at most 96: 97 actuators make 96 modes",
        ),
        (ABOUT + WFS + '[mirror]\nlayout = "positions"\n', "mirror.positions: missing"),
        (
            ABOUT + WFS + MIRROR + "[slopes]\norientation = { flip_z = true }\n",
            "slopes.orientation.flip_z: unknown key, did you mean flip_",
        ),
        ("[instrument\n", "not valid TOML"),
    ],
)
def test_a_wrong_instrument_file_is_refused_in_one_line_with_file_and_key(write, text, expected):
    path = write(text)
    message = refusal(load_instrument, path)
    assert message.startswith(f"{path}: ")
    assert expected in message


@pytest.mark.parametrize(
    ("reference", "expected"),
    [
        ("mask.h5", "found 'mask.h5', expected path:/dataset"),
        ("absent.h5:/valid", "cannot be read: No such file"),
        ("mask.h5:/vlid", "it holds empty (20, 20), grey (20, 20)"),
        ("mask.h5:/vlid", "no dataset /vlid in"),
        ("mask.h5:/group", "no dataset /group in"),
        ("mask.h5:/small", "shape (3, 3), expected (n_subapertures, n_subapertures) = (20, 20)"),
        ("mask.h5:/grey", "values other than 0 and 1"),
        ("mask.h5:/empty", "no valid subaperture"),
        ("mask.h5:/text", "expected numbers"),
        ("text.h5:/valid", "expected HDF5, FITS, NumPy or MATLAB"),
    ],
)
def test_a_mask_that_cannot_be_used_is_refused(write, tmp_path, reference, expected):
    with h5py.File(tmp_path / "mask.h5", "w") as file:
        file["small"] = np.ones((3, 3), bool)
        file["grey"] = np.full((20, 20), 0.5)
        file["empty"] = np.zeros((20, 20), bool)
        file["text"] = "valid"
        file.create_group("group")
    write("not HDF5", "text.h5")
    path = write(ABOUT + WFS + f'valid_subapertures = "{reference}"\n' + MIRROR + MODES)
    message = refusal(load_instrument, path)
    assert message.startswith(f"{path}: wfs.valid_subapertures: ")
    assert expected in message


def test_a_flux_threshold_beside_a_mask_file_is_refused(write):
    wfs = WFS + 'valid_subapertures = "mask.h5:/valid"\nflux_threshold = 0.5\n'
    message = refusal(load_instrument, write(ABOUT + wfs + MIRROR + MODES))
    assert "wfs.flux_threshold: has no effect" in message


@pytest.mark.parametrize(
    ("positions", "expected"),
    [
        (np.zeros((7, 3)), "shape (7, 3), expected (n_actuators, 2)"),
        (np.array([[0.0, 0], [1, 0], [0, 1], [1, 1], [0, 1]]), "actuators 2 and 4 in the same"),
        (np.array([[0.0, 0], [1, 0], [0, np.nan], [1, 1]]), "not finite"),
        (np.array([[0.0, 0], [1, 0]]), "found 2 actuators"),
    ],
)
def test_positions_that_make_no_mirror_are_refused(write, tmp_path, positions, expected):
    with h5py.File(tmp_path / "act.h5", "w") as file:
        file["xy_m"] = positions
    mirror = '[mirror]\nlayout = "positions"\npositions = "act.h5:/xy_m"\n'
    message = refusal(load_instrument, write(ABOUT + WFS + mirror + "[modes]\nn_modes = 3\n"))
    assert expected in message


FOUR = "\n".join(f'[[wfs.mode]]\nconfig_id = "b{k}"\nbinning = {k}\n' for k in (1, 2, 4, 5))


def test_modes_of_the_sensor_are_its_subapertures_binned(write):
    bench = load_instrument(write(ABOUT + APART + FOUR + MIRROR + MODES))
    assert (bench.config_id, bench.binning) == ("b1", 1)
    coarse = bench.in_mode("b4")
    assert (coarse.wfs.n_subapertures, coarse.wfs.pupil_separation_subap) == (5, 6)
    assert coarse.subaperture_m == pytest.approx(4 * bench.subaperture_m)
    assert (coarse.config_id, coarse.binning, coarse.finest.binning) == ("b4", 4, 1)
    assert coarse.in_mode("b1").wfs is bench.wfs


def test_a_file_with_modes_has_another_digest_and_one_without_the_same_as_ever(write):
    alone = load_instrument(write(ABOUT + APART + MIRROR + MODES))
    modes = load_instrument(write(ABOUT + APART + FOUR + MIRROR + MODES, "modes.toml"))
    assert instrument_sha256(alone) != instrument_sha256(modes)
    none = replace(modes, wfs=alone.wfs, sensor_modes=(), config_id=None, loop=None)
    assert instrument_sha256(none) == instrument_sha256(alone)


def test_what_a_mode_leaves_open_is_the_loops(write):
    modes = FOUR.replace("binning = 2\n", "binning = 2\nframe_rate_hz = 500\nn_controlled = 20\n")
    loop = "[loop]\nframe_rate_hz = 1000\ndelay_frames = 2\nn_controlled = 40\n"
    bench = load_instrument(write(ABOUT + APART + modes + MIRROR + MODES + loop))
    assert bench.in_mode("b2").loop == LoopFacts(frame_rate_hz=500, delay_frames=2, n_controlled=20)
    assert bench.in_mode("b2").in_mode("b4").loop == bench.loop
    assert bench.loop == LoopFacts(frame_rate_hz=1000, delay_frames=2, n_controlled=40)


def test_a_binned_mode_has_a_mask_of_its_own(write, tmp_path):
    with h5py.File(tmp_path / "mask.h5", "w") as file:
        file["fine"], file["coarse"] = np.ones((20, 20)), np.eye(10)
    masked = APART + 'valid_subapertures = "mask.h5:/fine"\n'
    modes = '[[wfs.mode]]\nconfig_id = "b2"\nbinning = 2\n'
    assert "bench.toml: wfs.mode[0].valid_subapertures: missing" in refusal(
        load_instrument, write(ABOUT + masked + modes + MIRROR + MODES)
    )
    own = modes + 'valid_subapertures = "mask.h5:/coarse"\n'
    bench = load_instrument(write(ABOUT + masked + own + MIRROR + MODES))
    assert bench.wfs.valid_subapertures.sum() == 10
    wrong = modes + 'valid_subapertures = "mask.h5:/fine"\n'
    assert "wfs.mode[0].valid_subapertures: found shape (20, 20)" in refusal(
        load_instrument, write(ABOUT + masked + wrong + MIRROR + MODES)
    )


@pytest.mark.parametrize(
    ("about", "modes", "expected"),
    [
        ("", 'config_id = "b3"\nbinning = 3\n', "wfs.mode[0].binning: found 3 of 20 subapertures"),
        ("", 'config_id = "b"\nbinning = 2\nn_subapertures = 5\n', "found 5 across a pupil image"),
        (
            "",
            'config_id = "b"\n[[wfs.mode]]\nconfig_id = "b"\n',
            "mode[1].config_id: found 'b' again",
        ),
        ("", "binning = 2\n", "wfs.mode.0.config_id: missing"),
        ("", 'config_id = "b"\nbinnign = 2\n', "unknown key, did you mean binning?"),
        ("", 'config_id = "b"\nn_controlled = 51\n', "mode[0].n_controlled: found 51, expected at"),
        ('config_id = "b"\n', 'config_id = "b"\n', "instrument.config_id: has no effect"),
    ],
)
def test_modes_that_cannot_be_are_refused_in_one_line(write, about, modes, expected):
    text = ABOUT + about + APART + "[[wfs.mode]]\n" + modes + MIRROR + MODES
    assert expected in refusal(load_instrument, write(text))


def test_modes_belong_to_slopes(write):
    framed = APART + 'input = "frames"\n[[wfs.mode]]\nconfig_id = "b"\n'
    text = ABOUT + framed + MIRROR + MODES
    assert 'mode: belongs to input = "slopes"' in refusal(load_instrument, write(text))


def test_a_mode_may_be_named_behind_the_file(write, tmp_path):
    path = write(ABOUT + APART + FOUR + MIRROR + MODES)
    assert load_instrument(f"{path}@b4").config_id == "b4"
    assert load_instrument("soul-lbt@soul-bin3").wfs.n_subapertures == 14
    assert len(load_instrument(f"{path}@b4").sensor_modes) == 4
    assert "bench.toml: bench: found mode b3, expected one of: b1, b2" in refusal(
        load_instrument, f"{path}@b3"
    )
    assert "flao-lbt: found mode b1, expected one of: no mode" in refusal(
        load_instrument, "flao-lbt@b1"
    )
    assert "neither a packaged name" in refusal(load_instrument, "nobody@b1")
    at = tmp_path / "a@b"
    at.mkdir()
    (at / "bench.toml").write_text(path.read_text())
    assert load_instrument(at / "bench.toml").config_id == "b1"


def test_an_unknown_mode_names_those_that_are_known(write):
    bench = load_instrument(write(ABOUT + APART + FOUR + MIRROR + MODES))
    with pytest.raises(ModelError, match="bench: found mode b3, expected one of: b1, b2, b4, b5"):
        bench.in_mode("b3")


def test_an_unknown_packaged_name_lists_the_known_ones():
    assert (
        "neither a packaged name (aof-ut4, canary, flao-lbt, gpao-ut, maps-mmt, metis-elt, "
        "micado-elt, papyrus, soul-lbt)" in refusal(load_instrument, "flao-lbtt")
    )


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    assert "no.toml: cannot be read: No such file" in refusal(load_instrument, tmp_path / "no.toml")
    (tmp_path / "latin.toml").write_bytes(b'name = "\xe9"\n')
    assert "not UTF-8" in refusal(load_instrument, tmp_path / "latin.toml")


# --- the slopes, the loop, and frames


def test_the_rtcs_own_slopes_are_described_as_they_are(write):
    slopes = (
        '[slopes]\norder = "interleaved"\nnormalisation = "local"\n'
        "orientation = { swap_xy = true, flip_y = true, sign = -1 }\n"
    )
    recipe = load_instrument(write(ABOUT + WFS + MIRROR + MODES + slopes)).slopes
    assert recipe.order is SlopeOrder.INTERLEAVED
    assert recipe.normalisation is Normalisation.LOCAL
    assert recipe.orientation == Orientation(swap_xy=True, flip_y=True, sign_x=-1, sign_y=-1)


def test_pixels_are_described_by_their_kind_and_listed_image_after_image(write):
    text = ABOUT + WFS + MIRROR + MODES + '[slopes]\nkind = "intensity"\n'
    assert load_instrument(write(text)).slopes.order is SlopeOrder.IMAGES
    recipe = load_instrument(write(text + 'order = "detector"\n')).slopes
    assert (recipe.kind, recipe.order) == (SignalKind.INTENSITY, SlopeOrder.DETECTOR)


def test_the_signs_of_the_two_components_may_differ(write):
    slopes = "[slopes]\norientation = { sign = [1, -1] }\n"
    recipe = load_instrument(write(ABOUT + WFS + MIRROR + MODES + slopes)).slopes
    assert recipe.orientation == Orientation(sign_x=1, sign_y=-1)


def test_an_orientation_that_is_not_given_is_not_known(write):
    assert load_instrument(write(ABOUT + WFS + MIRROR + MODES)).slopes.orientation is None


def test_what_is_known_of_the_loop_is_carried(write):
    loop = "[loop]\nframe_rate_hz = 500\ndelay_frames = 1.5\nn_controlled = 40\n"
    bench = load_instrument(write(ABOUT + WFS + MIRROR + MODES + loop))
    assert bench.loop == LoopFacts(frame_rate_hz=500.0, delay_frames=1.5, n_controlled=40)
    assert load_instrument(write(ABOUT + WFS + MIRROR + MODES)).loop is None


def test_full_frames_have_windows(write):
    wfs = (
        WFS + 'input = "frames"\npixels_per_subaperture = 2\n'
        "pupil_centres_px = [[93, 92], [20.5, 93], [92, 21], [20, 21.5]]\n"
    )
    bench = load_instrument(write(ABOUT + wfs + MIRROR + MODES))
    frames = bench.frames
    assert bench.wfs.pupil_separation_subap == pytest.approx((72 + 72.5 + 71.5 + 71) / 8)
    assert frames.pixels_per_subaperture == 2
    np.testing.assert_array_equal(frames.centres_px[1], [20.5, 93.0])
    auto = WFS + 'input = "frames"\npupil_centres_px = "auto"\n'
    assert load_instrument(write(ABOUT + auto + MIRROR + MODES)).frames.centres_px is None
    assert load_instrument(write(ABOUT + WFS + MIRROR + MODES)).frames is None


# --- the mount, and modes of the user's own


def save(path, **datasets):
    with h5py.File(path, "w") as file:
        for name, values in datasets.items():
            file[name] = values


def test_how_a_mirror_is_mounted_is_told_or_not_known(write):
    mount = 'nominal_rotation_deg = -130.0\nparity = -1\nstroke = "unknown"\n'
    mirror = load_instrument(write(ABOUT + WFS + MIRROR + mount + MODES)).mirror
    assert mirror.nominal_rotation_rad == pytest.approx(np.deg2rad(-130))
    assert (mirror.parity, mirror.y_sign, mirror.stroke_known) == (-1, -1.0, False)
    bench = load_instrument(write(ABOUT + WFS + MIRROR + MODES))
    assert (bench.mirror.nominal_rotation_rad, bench.mirror.parity) == (None, None)
    assert bench.mirror.stroke_known
    assert bench.start == Misregistration()


def test_a_mirror_seen_from_behind_shows_its_modes_with_y_reversed(write):
    seen, behind = (
        modal_basis(load_instrument(write(ABOUT + WFS + MIRROR + more + MODES)))
        for more in ("", "parity = -1\n")
    )
    points = np.random.default_rng(1).uniform(-9, 9, (30, 2))
    direction = points[::-1]
    flip = np.array([1.0, -1.0])
    np.testing.assert_array_equal(behind.render(points), seen.render(points * flip))
    np.testing.assert_array_equal(
        behind.render_slope(points, direction), seen.render_slope(points * flip, direction * flip)
    )
    np.testing.assert_array_equal(replace(behind, y_sign=1.0).render(points), seen.render(points))


ALPAO = '[mirror]\nlayout = "grid"\nn_across = 11\npitch_m = 0.75\ndiameter_m = 8.25\n'


def test_a_mode_to_actuator_matrix_makes_the_users_modes_of_an_alpao(write, tmp_path):
    strokes = np.random.default_rng(2).normal(size=(97, 7))
    save(tmp_path / "m2c.h5", m2c=strokes.astype(">f4"))
    bench = load_instrument(
        write(ABOUT + WFS + ALPAO + 'mode_to_actuator = "m2c.h5:/m2c"\nmodes_kind = "surface"\n')
    )
    assert bench.modes.n_modes == 7
    basis = modal_basis(bench)
    assert basis.n_modes == 7
    at_actuators = basis.render(bench.mirror.positions_m / bench.subaperture_m)
    np.testing.assert_allclose(at_actuators, 2 * strokes, rtol=1e-4, atol=1e-6)
    assert basis.known(np.array([[0.0, 30.0]])).all()
    some = basis.subset([4, 1])
    points = np.array([[0.3, 0.7], [2.0, -4.0]])
    np.testing.assert_allclose(some.render(points), basis.render(points)[:, [4, 1]])
    np.testing.assert_array_equal(some.variance_m2, basis.variance_m2[[4, 1]])


def test_a_zonal_basis_is_the_actuators_themselves(write):
    bench = load_instrument(write(ABOUT + WFS + ALPAO + 'basis = "zonal"\n'))
    assert bench.modes.n_modes == 97
    at_actuators = modal_basis(bench).render(bench.mirror.positions_m / bench.subaperture_m)
    np.testing.assert_allclose(at_actuators, np.eye(97), atol=1e-9)


def measured_modes(n=90, pitch=0.1):
    """Tip, tilt and defocus on a grid, metres."""
    line = (np.arange(n) - (n - 1) / 2) * pitch
    x, y = np.meshgrid(line, line)
    return np.array([x, y, x**2 + y**2]), np.hypot(x, y)


CUBE = '[mirror]\nmodes = "cube.h5:/modes"\nmodes_pitch_m = 0.1\n'


def test_a_cube_of_measured_modes_is_what_it_says_whatever_its_byte_order(write, tmp_path):
    cube, _ = measured_modes()
    save(tmp_path / "cube.h5", modes=cube.astype(">f8"))
    for kind, factor in (("opd", 1.0), ("surface", 2.0)):
        bench = load_instrument(write(ABOUT + APART + CUBE + f'modes_kind = "{kind}"\n'))
        assert bench.remarks == ()
        assert bench.modes.n_modes == 3
        points = np.array([[1.0, -2.0], [0.0, 0.0], [7.5, 3.0]])
        x, y = (points * bench.subaperture_m).T
        np.testing.assert_allclose(
            modal_basis(bench).render(points),
            factor * np.column_stack([x, y, x**2 + y**2]),
            atol=1e-6,
        )


def test_a_cube_that_is_zero_outside_the_pupil_is_told_of_and_continued(write, tmp_path):
    cube, radius = measured_modes()
    save(tmp_path / "cube.h5", modes=np.where(radius < 3.8, cube, 0.0))
    bench = load_instrument(write(ABOUT + WFS + CUBE))
    assert "44% of the table is zero in every mode" in bench.remarks[0]
    basis = modal_basis(bench)
    points = np.array([[9.8, 0.0], [9.0, 0.0]])
    np.testing.assert_array_equal(basis.known(points), [False, True])
    np.testing.assert_allclose(basis.render(points)[:, 0], points[:, 0] * 0.4, rtol=1e-3)


def test_influence_functions_and_a_matrix_make_modes(write, tmp_path):
    rng = np.random.default_rng(3)
    functions, strokes = rng.normal(size=(5, 90, 90)), rng.normal(size=(5, 2))
    save(tmp_path / "ifs.h5", cube=functions, m2c=strokes)
    mirror = '[mirror]\ninfluence_functions = "ifs.h5:/cube"\nmodes_pitch_m = 0.1\n'
    bench = load_instrument(write(ABOUT + WFS + mirror + 'mode_to_actuator = "ifs.h5:/m2c"\n'))
    np.testing.assert_allclose(
        bench.mirror.cube, np.einsum("am,ayx->myx", strokes, functions), rtol=1e-12
    )
    zonal = load_instrument(write(ABOUT + WFS + mirror + 'basis = "zonal"\n'))
    np.testing.assert_array_equal(zonal.mirror.cube, functions)


def test_a_surface_of_influence_functions_counts_twice_not_four_times(write, tmp_path):
    save(tmp_path / "ifs.h5", cube=np.random.default_rng(3).normal(size=(5, 90, 90)), m2c=np.eye(5))
    mirror = '[mirror]\ninfluence_functions = "ifs.h5:/cube"\nmodes_pitch_m = 0.1\n'
    mirror += 'mode_to_actuator = "ifs.h5:/m2c"\n'
    opd = load_instrument(write(ABOUT + WFS + mirror))
    surface = load_instrument(write(ABOUT + WFS + mirror + 'modes_kind = "surface"\n'))
    np.testing.assert_allclose(surface.mirror.cube, 2.0 * opd.mirror.cube)


CROPPED = (
    '[mirror]\ninfluence_functions = "ifs.h5:/crops"\ninfluence_origin = "ifs.h5:/origin"\n'
    "influence_table = [90, 92]\nmodes_pitch_m = 0.1\n"
)


def cropped_functions():
    """Bumps on a grid, some of them over the rim of the table; whole and cropped."""
    y, x = np.mgrid[:90, :92]
    places = [(r, c) for r in range(2, 90, 9) for c in range(3, 92, 9)]
    radius = [np.hypot(y - r, x - c) for r, c in places]
    whole = np.array(
        [np.where(d < 10, np.cos(np.pi * np.minimum(d, 10) / 20) ** 4, 0) for d in radius]
    )
    around = np.pad(whole, ((0, 0), (10, 10), (10, 10)))
    crops = np.array(
        [one[r : r + 21, c : c + 21] for one, (r, c) in zip(around, places, strict=True)]
    )
    return whole, crops, np.array(places) - 10


def test_cropped_influence_functions_are_the_whole_ones(write, tmp_path):
    whole, crops, origin = cropped_functions()
    strokes = np.random.default_rng(4).normal(size=(len(whole), 7))
    save(tmp_path / "ifs.h5", cube=whole, crops=crops, origin=origin, m2c=strokes)
    for modes in ('mode_to_actuator = "ifs.h5:/m2c"\n', 'basis = "zonal"\n'):
        bench = load_instrument(write(ABOUT + WFS + CROPPED + modes))
        dense = CROPPED.partition("influence_origin")[0].replace("crops", "cube")
        dense += "modes_pitch_m = 0.1\n"
        full = load_instrument(write(ABOUT + WFS + dense + modes, "full.toml"))
        np.testing.assert_allclose(bench.mirror.cube, full.mirror.cube, atol=1e-12)
        assert bench.mirror.known.all()
        assert not any("cut where" in remark for remark in bench.remarks)


def test_functions_that_are_cropped_too_far_are_remarked_on(write, tmp_path):
    _, crops, origin = cropped_functions()
    save(tmp_path / "ifs.h5", crops=crops[:, 5:-5, 5:-5], origin=origin + 5)
    (remark,) = [
        r
        for r in load_instrument(write(ABOUT + WFS + CROPPED + 'basis = "zonal"\n')).remarks
        if "cut where" in r
    ]
    assert "cut where a function still has 25% of its height" in remark


@pytest.mark.parametrize(
    ("change", "origin", "expected"),
    [
        (
            ("influence_table = [90, 92]\n", ""),
            None,
            "influence_table: missing; mirror.influ",
        ),
        (("[90, 92]", "[90000, 92000]"), None, "100 modes over 90000 x 92000 points, 6624.0 GB"),
        (("[90, 92]", "[90]"), None, "mirror.influence_table"),
        ((":/origin", ":/none"), None, "no dataset /none"),
        (("", ""), np.zeros((3, 2)), "found shape (3, 2), expected (100, 2): row and column"),
        (("", ""), np.full((100, 2), 0.5), "rows or columns that are no whole numbers"),
        (("", ""), np.full((100, 2), 95), "found function 0 at row 95, column 95, expected all"),
        (("influence_functions", "modes"), None, "has no effect together with mirror.modes"),
    ],
)
def test_crops_that_cannot_be_placed_are_refused(write, tmp_path, change, origin, expected):
    _, crops, good = cropped_functions()
    save(tmp_path / "ifs.h5", crops=crops, origin=good if origin is None else origin)
    basis = "" if change[1] == "modes" else 'basis = "zonal"\n'
    text = CROPPED.replace(*change) if change[0] else CROPPED
    assert expected in refusal(load_instrument, write(ABOUT + WFS + text + basis))


def test_arrays_come_from_fits_files_too(write, tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    cube, _ = measured_modes()
    images = [
        fits.PrimaryHDU(),
        fits.ImageHDU(cube.astype(np.float32), name="MODES"),
        fits.ImageHDU(np.ones((20, 20), np.uint8)),
    ]
    fits.HDUList(images).writeto(tmp_path / "bench.fits")
    mask = 'valid_subapertures = "bench.fits:2"\n'
    for reference in ("bench.fits", "bench.fits:modes", "bench.fits:1"):
        text = CUBE.replace("cube.h5:/modes", reference)
        bench = load_instrument(write(ABOUT + WFS + mask + text))
        np.testing.assert_array_equal(bench.mirror.cube, cube.astype(np.float32))
        assert bench.mirror.cube.dtype.isnative
        assert bench.wfs.valid_subapertures.all()
    missing = CUBE.replace("cube.h5:/modes", "bench.fits:nothing")
    message = refusal(load_instrument, write(ABOUT + WFS + missing))
    assert "no dataset /nothing in" in message
    assert "it holds MODES (3, 90, 90)" in message


def test_without_astropy_a_fits_file_is_refused_with_what_to_install(write, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "astropy.io", None)
    (tmp_path / "cube.fits").write_bytes(b"SIMPLE  =                    T")
    message = refusal(
        load_instrument, write(ABOUT + WFS + CUBE.replace("cube.h5:/modes", "cube.fits"))
    )
    assert "mirror.modes: " in message
    assert "pip install astropy" in message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (WFS + CUBE + "[modes]\nn_modes = 3\n", "modes.n_modes: found it together with"),
        (WFS + CUBE + 'layout = "rings"\n', "found layout and modes, expected one of"),
        (WFS + CUBE + "pitch_m = 0.3\n", "mirror.pitch_m: has no effect"),
        (WFS + CUBE + 'basis = "zonal"\n', "mirror.basis: has no effect"),
        (
            WFS + CUBE.replace("modes_pitch_m = 0.1\n", ""),
            "mirror.modes_pitch_m: missing, mirror.modes needs the step of its grid",
        ),
        (
            WFS + CUBE.replace("0.1", "0.25"),
            "found 0.25 m, 1.6 table points per subaperture, expected at least 2",
        ),
        (WFS + CUBE.replace("= 0.1", "= 100.0"), "table points per subaperture, expected"),
        (WFS + CUBE.replace("= 0.1", "= 0.0001"), "a surface known over 0% of the pupil's area"),
        (WFS + CUBE.replace("/modes", "/flat"), "found shape (90, 90), expected (n, ny, nx)"),
        (WFS + CUBE.replace("/modes", "/nothing"), "mirror.modes: found no dataset /nothing in"),
        (WFS + CUBE.replace("/modes", "/wide"), "a table of 25 pupil diameters, expected at most"),
        (WFS + CUBE.replace("/modes", "/dark"), "a surface known over 0% of the pupil's area"),
        (
            WFS + '[mirror]\ninfluence_functions = "cube.h5:/modes"\nmodes_pitch_m = 0.1\n',
            "mirror.mode_to_actuator: missing, mirror.influence_functions needs it",
        ),
        (
            WFS + ALPAO + 'mode_to_actuator = "cube.h5:/turned"\n',
            "shape (7, 97) (it looks transposed), expected (97 actuators, n_modes)",
        ),
        (WFS + ALPAO + 'mode_to_actuator = "cube.h5:/nan"\n', "strokes that are not finite"),
        (
            WFS + ALPAO + 'mode_to_actuator = "cube.h5:/m2c"\nbasis = "KL"\n',
            "mirror.basis: found it together with mirror.mode_to_actuator",
        ),
        (WFS + ALPAO + 'modes_kind = "surface"\n', "mirror.modes_kind: found it, expected it "),
        (WFS + ALPAO + "modes_pitch_m = 0.1\n", "mirror.modes_pitch_m: has no effect"),
        (
            WFS + ALPAO + 'mode_to_actuator = "cube.h5:/m2c"\n[loop]\nn_controlled = 8\n',
            "loop.n_controlled: found 8, expected at most the 7 modes of the basis",
        ),
        (
            WFS + "pixels_per_subaperture = 2\n" + MIRROR + MODES,
            'wfs.pixels_per_subaperture: belongs to input = "frames", found input = "slopes"',
        ),
        (
            WFS + "pupil_centres_px = [[1, 2], [1, 9], [9, 2], [9, 9]]\n" + MIRROR + MODES,
            'wfs.pupil_centres_px: belongs to input = "frames"',
        ),
        (
            WFS
            + 'input = "frames"\npupil_centres_px = [[1, 2], [1, 3], [9, 2], [9, 1]]\n'
            + MIRROR
            + MODES,
            "wfs.pupil_centres_px: found pupil images at",
        ),
        (
            WFS
            + 'input = "frames"\npupil_separation_subap = 36\n'
            + "pupil_centres_px = [[20, 20], [20, 50], [50, 20], [50, 50]]\n"
            + MIRROR
            + MODES,
            "pupil_separation_subap: found 36, expected about 30.0, the distance of",
        ),
        (
            WFS + 'input = "frames"\npupil_centres_px = [1, 2, 3, 4]\n' + MIRROR + MODES,
            'expected "auto" or four pairs [row, column]',
        ),
        (
            WFS + 'input = "frames"\n' + MIRROR + MODES + '[slopes]\norder = "xy"\n',
            "slopes.order: has no effect with wfs.input",
        ),
        (
            WFS + MIRROR + MODES + '[slopes]\nkind = "intensity"\norder = "xy"\n',
            'slopes.order: found xy with kind = "intensity", expected images or images-yx or',
        ),
        (
            WFS + MIRROR + MODES + '[slopes]\norder = "detector"\n',
            'slopes.order: found detector with kind = "xy", expected xy or yx or interleaved',
        ),
        (
            WFS + MIRROR + MODES + "[slopes]\norientation = { sign = 0 }\n",
            "slopes.orientation.sign: found 0, expected 1, -1 or two of them",
        ),
        (WFS + MIRROR + "parity = 2\n" + MODES, "mirror.parity: found 2, expected -1 or 1"),
        (
            WFS + "modulation_ellipse = { axes_lambda_over_d = [4, 5] }\n" + MIRROR + MODES,
            "wfs.modulation_ellipse: found modulation_lambda_over_d as well, expected one of them",
        ),
        (
            ROUND.format("{ axes_lambda_over_d = [4.0, 0.0] }") + MIRROR + MODES,
            "wfs.modulation_ellipse.axes_lambda_over_d.1: found 0.0, expected",
        ),
        (
            ROUND.format("{ angle_deg = 30.0 }") + MIRROR + MODES,
            "wfs.modulation_ellipse.axes_lambda_over_d: missing",
        ),
    ],
)
def test_what_contradicts_itself_or_its_arrays_is_refused_in_one_line(
    write, tmp_path, text, expected
):
    cube, _ = measured_modes()
    save(
        tmp_path / "cube.h5",
        modes=cube,
        flat=cube[0],
        wide=np.ones((1, 2000, 2000), np.float32),
        dark=np.zeros((2, 90, 90)),
        m2c=np.ones((97, 7)),
        turned=np.ones((7, 97)),
        nan=np.full((97, 7), np.nan),
    )
    path = write(ABOUT + text)
    message = refusal(load_instrument, path)
    assert message.startswith(f"{path}: ")
    assert expected in message


def test_a_coarse_table_is_told_of(write, tmp_path):
    cube, _ = measured_modes(45, 0.2)
    save(tmp_path / "cube.h5", modes=cube)
    cube = CUBE.replace("0.1", "0.18")
    bench = load_instrument(write(ABOUT + WFS + cube))
    assert "2.2 table points per subaperture; below 4 the high modes" in bench.remarks[0]
    # A simulation has as few points itself.
    grid = "fft_grid = { points_per_subaperture = 2, width_subap = 48.0 }\n"
    bench = load_instrument(write(ABOUT + WFS + grid + cube))
    assert not any("table points" in one for one in bench.remarks)


def test_the_mask_is_in_the_rtcs_axes_and_the_model_turns_it(write, tmp_path):
    mask = np.zeros((20, 20), np.uint8)
    mask[3, 7] = mask[3, 8] = mask[4, 7] = 1
    save(tmp_path / "mask.h5", valid=mask)
    wfs = WFS + 'valid_subapertures = "mask.h5:/valid"\n'
    slopes = "[slopes]\norientation = { flip_x = true, swap_xy = true }\n"
    bench = load_instrument(write(ABOUT + wfs + MIRROR + MODES + slopes))
    np.testing.assert_array_equal(rtc_valid_subapertures(bench), mask.astype(bool))
    np.testing.assert_array_equal(valid_subapertures(bench), mask[:, ::-1].T.astype(bool))


# --- settings


def test_without_file_or_environment_the_defaults_hold():
    settings = load_settings(None, {})
    assert settings == Settings()
    assert settings.service.mode == Mode.PROPOSE
    assert settings.service.data_dir == Path("var")
    assert settings.zenoh.listen == ("tcp/127.0.0.1:7447",)
    assert settings.control.n_modes_target == 500


def test_command_line_beats_environment_beats_file_beats_default(write):
    path = write("[api]\nport = 1\nhost = 'file'\n[dither]\nwindow_s = 4\n", "settings.toml")
    env = {"PYRCAL_API__PORT": "2", "PYRCAL_API__HOST": "environment", "HOME": "/"}
    settings = load_settings(path, env, {"api.port": 3})
    assert settings.api.port == 3
    assert settings.api.host == "environment"
    assert settings.dither.window_s == 4.0
    assert settings.dither.budget_m == 8e-9


def test_where_a_client_asks_and_with_which_key_is_no_setting():
    assert load_settings(None, {"PYRCAL_URL": "http://ao", "PYRCAL_API_KEY": "k"}) == Settings()


def test_environment_values_take_the_type_of_their_key():
    settings = load_settings(
        None,
        {
            "PYRCAL_SERVICE__SYSTEM": "12",
            "PYRCAL_SERVICE__MODE": "auto",
            "PYRCAL_SERVICE__DATA_DIR": "/data/7",
            "PYRCAL_DITHER__ENABLED": "false",
            "PYRCAL_DITHER__MODES": "[501, 450]",
            "PYRCAL_DITHER__FREQUENCIES_HZ": "[210, 250.5]",
            "PYRCAL_ZENOH__CONNECT": '["tcp/rtc:7447"]',
        },
    )
    assert settings.service.system == "12"
    assert settings.service.mode == Mode.AUTO
    assert settings.service.data_dir == Path("/data/7")
    assert settings.dither.enabled is False
    assert settings.dither.modes == (501, 450)
    assert settings.dither.frequencies_hz == (210.0, 250.5)
    assert settings.zenoh.connect == ("tcp/rtc:7447",)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[servise]\n", "servise: unknown key, did you mean service?"),
        ("[service]\nmod = 1\n", "service.mod: unknown key, did you mean mode?"),
        (
            "[service]\nmode = 'x'\n",
            "service.mode: found 'x', expected 'auto', 'propose' or",
        ),
        ("[service]\nsystem = 'a/b'\n", "service.system: found 'a/b', expected text that matches"),
        ("service = 1\n", "service: found 1, expected a table [service]"),
        ("[api]\nport = 70000\n", "api.port: found 70000, expected less than or equal to 65535"),
        ("[api]\nport = '80'\n", "api.port: found '80', expected a valid integer"),
        ("[api]\nport = true\n", "api.port: found True, expected a valid integer"),
        ("[api]\nport = -1\nhost = 3\n", "(and 1 more)"),
        ("[zenoh]\nchunk_bytes = 8000000\n", "zenoh.chunk_bytes: found 8000000"),
        ("[dither]\nmodes = [5, -1]\n", "dither.modes.1: found -1"),
        (
            "[dither]\nmodes = [5, 6]\nfrequencies_hz = [200]\n",
            "dither: found 1 frequencies_hz for 2 modes, expected one for each",
        ),
        (
            "[dither]\namplitude_m = 6e-9\n",
            "dither: found amplitude_m for 12 nm RMS of 4 modes together, expected no more than "
            "budget_m, 8 nm",
        ),
        ("[control]\npole_radius_bound = 1.0\n", "control.pole_radius_bound: found 1.0, expected"),
        ("[tracking]\nfloor_rotation_deg = nan\n", "found nan, expected a finite number"),
    ],
)
def test_a_wrong_settings_file_is_refused_in_one_line_with_file_and_key(write, text, expected):
    path = write(text, "settings.toml")
    message = refusal(load_settings, path, {})
    assert message.startswith(f"{path}: ")
    assert expected in message


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("PYRCAL_API__PROT", "1", "unknown key, did you mean port?"),
        ("PYRCAL_APU__PORT", "1", "unknown section apu, did you mean api?"),
        ("PYRCAL_API_PORT", "1", "expected PYRCAL_<SECTION>__<KEY>, like PYRCAL_API__PORT"),
        ("PYRCAL_API__PORT", "eighty", "found 'eighty', expected a valid integer"),
        ("PYRCAL_DITHER__MODES", "5", "found 5, expected an array"),
    ],
)
def test_a_wrong_environment_variable_is_refused_by_its_own_name(write, name, value, expected):
    path = write("[api]\nport = 1\n", "settings.toml")
    message = refusal(load_settings, path, {name: value})
    assert message.startswith(f"environment: {name}: ")
    assert expected in message


def test_a_wrong_command_line_value_is_refused_as_such():
    message = refusal(load_settings, None, {}, {"api.port": -1})
    assert message.startswith("command line: api.port: found -1")


# --- what the file does not say


def test_a_separation_that_is_not_told_is_that_of_no_other_telescope_and_is_said(write):
    assert load_instrument(write(ABOUT + APART + MIRROR + MODES)).remarks == ()
    bench = load_instrument(write(ABOUT + WFS + MIRROR + MODES))
    assert bench.wfs.pupil_separation_subap == 24.0
    assert "pupil_separation_subap: not given, taken as 24 (1.2 pupil diam" in bench.remarks[0]


def test_an_elliptic_modulation_is_two_axes_and_an_angle(write):
    ellipse = ROUND.format("{ axes_lambda_over_d = [4, 5.0], angle_deg = 30 }")
    bench = load_instrument(write(ABOUT + ellipse + MIRROR + MODES))
    assert bench.wfs.modulation_lambda_over_d == pytest.approx(np.sqrt(20.0))
    longer, shorter, angle_rad = bench.wfs.modulation_axes
    assert (longer, shorter) == pytest.approx((5.0, 4.0))
    assert np.degrees(angle_rad) % 180.0 == pytest.approx(120.0)
    circle = load_instrument(write(ABOUT + APART + MIRROR + MODES))
    assert circle.wfs.modulation_stretch is None
    wfs = replace(circle.wfs, modulation_stretch=(0.1, 0.0))
    assert instrument_sha256(replace(circle, wfs=wfs)) != instrument_sha256(circle)


def test_a_rooftop_is_a_signed_length(write):
    bench = load_instrument(
        write(ABOUT + APART + "rooftop_lambda_over_d = -0.5\n" + MIRROR + MODES)
    )
    assert bench.wfs.rooftop_lambda_over_d == -0.5
    tip = load_instrument(write(ABOUT + APART + MIRROR + MODES))
    assert tip.wfs.rooftop_lambda_over_d == 0.0
    assert instrument_sha256(bench) != instrument_sha256(tip)
    assert kind_of(bench).identity(bench.wfs) != kind_of(tip).identity(tip.wfs)


def test_what_is_unknown_is_where_a_fit_begins_and_is_said(write):
    unknown = APART.replace("750e-9", '"unknown"').replace("3.0", '"unknown"')
    mirror = MIRROR + 'influence = "gaussian"\ncoupling = "unknown"\n'
    bench = load_instrument(write(ABOUT + unknown + mirror + MODES))
    keys = ("wfs.wavelength_m", "wfs.modulation_lambda_over_d", "mirror.coupling")
    assert bench.unknown == keys
    for key in keys:
        assert any(f"{key}: unknown; a fit" in remark for remark in bench.remarks)
    known = load_instrument(write(ABOUT + APART + MIRROR + MODES))
    assert instrument_sha256(known) != instrument_sha256(replace(known, unknown=keys))


def test_only_what_a_matrix_can_tell_may_be_unknown(write):
    words = refusal(load_instrument, write(ABOUT.replace("8.0", '"unknown"') + APART + MIRROR))
    assert "instrument.diameter_m" in words


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "millimetres"), (1e6, "micrometres")])
def test_positions_in_another_unit_are_named(write, tmp_path, factor, unit):
    save(tmp_path / "dm.h5", positions=grid(11, 0.8, 8.8) * factor)
    mirror = '[mirror]\nlayout = "positions"\npositions = "dm.h5:/positions"\n'
    words = refusal(load_instrument, write(ABOUT + APART + mirror + MODES))
    assert f"pupil diameters: they look like {unit}" in words
    assert "metres in the pupil plane: about diameter_m = 8" in words


# --- measured influence functions that end: known near their actuators, seen as whole ones are


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
LOCAL_CROPPED = """influence_functions = "ifs.h5:/crops"
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


@pytest.mark.parametrize(
    "given", [WHOLE + ZONAL, LOCAL_CROPPED + MODAL, WHOLE + "parity = -1\n" + MODAL]
)
def test_d_and_its_derivatives_are_those_of_whole_tables(loaded, given, monkeypatch):
    # a mirror this small is drawn as a dense array, which is quicker
    monkeypatch.setattr(interaction, "_MAX_DENSE_PRODUCT", 0.0)
    ending, whole = (model(loaded(given, local)) for local in (True, False))
    assert (ending.instrument.mirror.cube, whole.instrument.mirror.local) == (None, None)
    assert isinstance(ending._render_modes(SOMEWHERE), LocalShapes)
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


# --- pupils of instrument files: maps and spiders, and the one line that says what is wrong


REST = """
[wfs]
kind = "pyramid"
n_subapertures = 20
pupil_separation_subap = 24
wavelength_m = 750e-9
modulation_lambda_over_d = 3.0

[mirror]
layout = "grid"
n_across = 11
pitch_m = 0.8
diameter_m = 8.8

[modes]
n_modes = 50
"""


def ring(n=160, hole=0.25):
    u = (np.arange(n) - (n - 1) / 2) * 2 / n
    radius = np.hypot(u, u[:, None])
    return ((radius <= 1.0) & (radius >= hole)).astype(float)


@pytest.fixture
def bench(tmp_path):
    def _bench(keys="", lit=None):
        with h5py.File(tmp_path / "pupil.h5", "w") as file:
            file["lit"] = ring() if lit is None else lit
        path = tmp_path / "bench.toml"
        path.write_text(ABOUT + keys + REST, encoding="utf-8")
        return load_instrument(path)

    return _bench


MAP = 'pupil = "pupil.h5:/lit"\n'


def test_a_ring_as_a_map_is_the_ring_but_for_its_points(bench):
    drawn, mapped = bench("obscuration_ratio = 0.25\n"), bench(MAP)
    assert mapped.pupil.pitch_m == pytest.approx(8.0 / 160)
    assert mapped.collecting_area_m2 == pytest.approx(drawn.collecting_area_m2, rel=2e-3)
    both = [instrument_pupil(instrument, 3).amplitude for instrument in (drawn, mapped)]
    assert np.abs(both[0] - both[1]).max() < 0.2
    assert both[1].sum() == pytest.approx(both[0].sum(), rel=2e-3)
    assert (lit_subapertures(drawn) == lit_subapertures(mapped)).all()


@pytest.mark.parametrize("name", ["pupil.fits", "pupil.npy"])
def test_a_map_may_be_a_fits_image_or_a_numpy_file(bench, tmp_path, name):
    if name.endswith("npy"):
        np.save(tmp_path / name, ring().astype(np.uint8))
    else:
        fits.writeto(tmp_path / name, ring().astype(">f4"))
    assert (bench(f'pupil = "{name}"\n').pupil.lit == ring()).all()


def test_a_map_keeps_its_axes(bench):
    """[y, x]: dark at low rows is dark at low y, in the model and in the simulator's own pupil."""
    lit = ring()
    lit[:60, 80:] = 0.0
    instrument = bench(MAP, lit)
    for pupil in (instrument_pupil(instrument, 2), build_centred_pupil(instrument, 2)):
        n = len(pupil.amplitude)
        low_y_high_x = pupil.amplitude[: n // 4, 3 * n // 5 :]
        assert low_y_high_x.max() < 1e-9
        assert pupil.amplitude[3 * n // 4 :, 3 * n // 5 :].max() > 0.99
        area = pupil.amplitude.sum() * (instrument.subaperture_m / pupil.sampling) ** 2
        assert area == pytest.approx(instrument.collecting_area_m2, rel=5e-3)


def test_an_arm_lies_in_its_direction_and_hides_its_width(bench):
    arms = "obscuration_ratio = 0.2\nspiders_m = 0.4\nspiders_deg = [90.0, 200.0]\n"
    instrument, open_ = bench(arms), bench("obscuration_ratio = 0.2\n")
    hidden = open_.collecting_area_m2 - instrument.collecting_area_m2
    assert hidden == pytest.approx(2 * 0.4 * 3.2)
    for drawn in (instrument_pupil, build_centred_pupil):
        pupil, plain = drawn(instrument, 4), drawn(open_, 4)
        lost = (plain.amplitude - pupil.amplitude).sum() * (0.4 / 4) ** 2
        assert lost == pytest.approx(hidden, rel=0.01)
        u = pupil.coordinates
        x, y = np.meshgrid(u, u)
        up, down = (np.abs(x) < 0.4) & (y > 3.0) & (y < 8.0), (np.abs(x) < 0.4) & (y < -3.0)
        assert pupil.amplitude[up].max() < 1e-9
        assert pupil.amplitude[down & (y > -8.0)].min() > 0.99


def test_what_has_neither_has_the_digest_that_it_has_always_had(bench):
    """Counted before there were maps and arms."""
    assert instrument_sha256(load_instrument("flao-lbt")) == FLAO
    digests = {instrument_sha256(bench(keys)) for keys in ("", MAP, ARMS)}
    assert len(digests) == 3


FLAO = "e889ab451b0994e260c9ad7b9989786ecf7da12697f57f43031e3ec1787b2648"
ARMS = "spiders_m = 0.4\nspiders_deg = [90.0]\n"


@pytest.mark.parametrize(
    ("keys", "lit", "expected"),
    [
        (MAP, np.ones((2, 3, 4)), "instrument.pupil: found shape (2, 3, 4), expected (ny, nx)"),
        (MAP, 2 * ring(), "found values that are not 0 to 1"),
        (MAP, np.full((160, 160), np.nan), "found values that are not 0 to 1"),
        (MAP, np.zeros((160, 160)), "found no lit point, expected a pupil of 8 m"),
        (MAP + "pupil_pitch_m = 50.0\n", ring(), "pupil_pitch_m: found 50 m between points"),
        (MAP + "pupil_pitch_m = 0.03\n", ring(), "along the other: correct pupil_pitch_m"),
        (MAP, np.pad(ring(80), 40), "light over 4 m along x and 4 m along y, expected about diam"),
        (MAP, np.pad(ring(80), 40), "along the other: give pupil_pitch_m"),
        (MAP, ring()[60:100], "found light over 8 m along x and 2 m along y, expected about"),
        (MAP, np.pad(ring(140), ((0, 20), (10, 10))), "m from the centre of the array along y"),
        (MAP, ring(12), "pupil_pitch_m: found 0.667 m between points, expected at most a suba"),
        (MAP + "obscuration_ratio = 0.1\n", ring(), "obscuration_ratio: has no effect"),
        (MAP + ARMS, ring(), "spiders_m: has no effect"),
        ("pupil_pitch_m = 0.05\n", ring(), "has no meaning without instrument.pupil"),
        (
            "spiders_m = 0.4\n",
            ring(),
            "instrument.spiders_deg: missing",
        ),
        ("spiders_deg = [3.0]\n", ring(), "instrument.spiders_m: missing"),
        ('pupil = "pupil.h5"\n', ring(), "expected path:/dataset of an HDF5 file, path.fits:EXTN"),
        ('pupil = "none.npy"\n', ring(), "none.npy"),
    ],
)
def test_a_pupil_that_cannot_be_is_refused_in_one_line(bench, keys, lit, expected):
    with pytest.raises(ConfigurationError) as refused:
        bench(keys, lit)
    assert expected in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_pupil_of_an_off_axis_telescope_may_be_an_ellipse(bench):
    u = (np.arange(160) - 79.5) / 80.0
    ellipse = np.hypot(u, u[:, None] / 0.75) <= 1.0
    mapped = bench(MAP, ellipse.astype(float))
    assert mapped.collecting_area_m2 == pytest.approx(0.75 * np.pi * 16.0, rel=3e-3)


# --- segmented mirrors of instrument files, and the instruments of the ELT


@pytest.mark.long
def test_the_packaged_instruments_of_the_elt_are_what_their_sources_say():
    """Of Deo et al. 2021, table 2, 6020 valid subapertures: 3 % more than behind our spider."""
    metis, micado = load_instrument("metis-elt"), load_instrument("micado-elt")
    assert (metis.wfs.n_subapertures, metis.wfs.pupil_separation_subap) == (90, 108)
    assert (micado.wfs.n_subapertures, micado.wfs.wavelength_m) == (92, 658e-9)
    assert micado.slopes.kind.n_planes * valid_subapertures(micado).sum() == pytest.approx(
        24_080, rel=0.03
    )
    for elt in (metis, micado):
        assert elt.diameter_m == pytest.approx(512 * 0.0762, rel=1e-3)
        assert (elt.mirror.pitch_m, elt.mirror.shape.coupling) == (0.54, 0.24)
        assert len(elt.mirror.positions_m) == 4410
        assert elt.spiders_deg == elt.mirror.segments_deg
        assert (elt.modes.n_modes, elt.loop.frame_rate_hz, elt.loop.delay_frames) == (4300, 500, 2)
        assert [remark.split(": ")[1] for remark in elt.remarks] == ["mirror.segments_deg"]


@pytest.mark.parametrize(("name", "sources"), [("metis-elt", "SOFD"), ("micado-elt", "SOD")])
def test_every_value_of_the_packaged_instruments_of_the_elt_names_its_source(name, sources):
    lines = packaged_file(name).read_text(encoding="utf-8").splitlines()
    values = [line for line in lines if "=" in line and not line.startswith("#")]
    named = re.compile(rf"# (\[[{sources}]\]|assumed)")
    assert [value for value in values if not named.search(value)] == [f'name = "{name}"']


SEGMENTED = MIRROR + 'influence = "gaussian"\n'


@pytest.mark.parametrize(
    ("keys", "complaint"),
    [
        ("segments_deg = [10.0]\n", "expected at least two gaps"),
        ("segments_deg = [10.0, 370.0]\n", "expected at least two gaps"),
        ("segments_deg = [10.0, 10.001]\n", "actuators in 1 segments"),
    ],
)
def test_segments_that_cannot_be_are_refused(write, keys, complaint):
    assert complaint in refusal(load_instrument, write(ABOUT + WFS + SEGMENTED + keys))


def test_segments_belong_to_functions_that_end(write):
    complaint = refusal(
        load_instrument, write(ABOUT + WFS + MIRROR + "segments_deg = [0.0, 180.0]\n")
    )
    assert 'mirror.segments_deg: belongs to influence = "gaussian"' in complaint


def test_no_actuator_of_a_grid_stands_on_a_gap(write):
    """Of 11 x 11 on a circle the middle row goes, 11 of 97."""
    keys = "segments_deg = [0.0, 180.0]\n"
    positions = load_instrument(write(ABOUT + WFS + SEGMENTED + keys)).mirror.positions_m
    assert np.abs(positions[:, 1]).min() == pytest.approx(0.8)
    assert len(positions) == len(grid(11, 0.8, 8.8)) - 11
