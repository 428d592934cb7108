"""Instrument files and settings: what is read, and the one line that says what is wrong."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from service.config import Settings, load_instrument, load_settings
from service.config.layouts import coincident, grid, rings, typical_pitch
from service.errors import ConfigurationError
from service.model.instrument import Influence, Stop
from service.state import Mode

ABOUT = '[instrument]\nname = "bench"\ndiameter_m = 8.0\nstop = "telescope"\n'
WFS = (
    '[wfs]\nkind = "pyramid"\nn_subapertures = 20\nwavelength_m = 750e-9\n'
    "modulation_lambda_over_d = 3.0\n"
)
MIRROR = '[mirror]\nlayout = "grid"\nn_across = 11\npitch_m = 0.8\ndiameter_m = 8.8\n'
MODES = "[modes]\nn_modes = 50\n"


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
    assert flao.mirror.influence is Influence.THIN_PLATE
    assert (flao.modes.n_modes, flao.modes.r0_m, flao.modes.outer_scale_m) == (594, 0.10, 25.0)
    assert (flao.basis_id, flao.config_id) == (None, None)


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
    assert (bench.mirror.influence, bench.mirror.coupling) == (Influence.GAUSSIAN, 0.2)
    assert len(bench.mirror.positions_m) == 97
    assert bench.modes.n_modes == 50


def test_only_the_mandatory_keys_are_needed_for_rings(write):
    bench = load_instrument(write(ABOUT + WFS + '[mirror]\nlayout = "rings"\n'))
    assert len(bench.mirror.positions_m) == 663
    assert bench.obscuration_ratio == 0.0
    assert bench.modes.n_modes == 594


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
        (ABOUT + WFS + MIRROR + "[zzzz]\n", "zzzz: unknown key; known: instrument, loop, mirror"),
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
        (ABOUT + WFS.replace("20", "40") + MIRROR + MODES, "the images would overlap"),
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
            ABOUT + WFS + MIRROR,
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
        ("text.h5:/valid", "expected an HDF5 or a FITS file"),
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
    assert "wfs.flux_threshold: has no meaning beside a mask file" in message


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


def test_an_unknown_packaged_name_lists_the_known_ones():
    assert "neither a packaged name (flao-lbt)" in refusal(load_instrument, "flao-lbtt")


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    assert "no.toml: cannot be read: No such file" in refusal(load_instrument, tmp_path / "no.toml")
    (tmp_path / "latin.toml").write_bytes(b'name = "\xe9"\n')
    assert "not UTF-8" in refusal(load_instrument, tmp_path / "latin.toml")


# --- settings


def test_without_file_or_environment_the_defaults_hold():
    settings = load_settings(None, {})
    assert settings == Settings()
    assert settings.service.mode is Mode.PROPOSE
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
    assert settings.dither.amplitude_m == 5e-9


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
    assert settings.service.mode is Mode.AUTO
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
