"""A bundle comes into cacao as one piece, and what was there goes back as one."""

import numpy as np
import pytest

from cacao_bridge.calibration import Calibration, Parts, apply, roll_back
from cacao_bridge.settings import Settings
from cacao_bridge.streams import StreamError, create, path_of
from service.errors import ConfigurationError, PyrcalError
from service.files.bundle import Bundle, write_bundle
from tests.support.calibration import (
    IDENTITY,
    INDEX,
    N_MODES,
    N_SLOPES,
    SHAPE,
    UNIT,
    begun,
    in_stream,
    matrix,
    settings_in,
)

LOOP_GAIN = 0.4
GAINS_BEFORE = np.linspace(0.3, 0.5, N_MODES).astype(np.float32)
REFERENCE_BEFORE = np.linspace(-1.0, 1.0, 6).astype(np.float32).reshape(SHAPE)
FACTORS = np.array([1.0, 0.8, 0.5], np.float32)
REFERENCE = np.array([0.1, -0.2, 0.3, 0.4], np.float32)


@pytest.fixture
def settings(tmp_path):
    values = settings_in(tmp_path).model_dump()
    values["streams"]["reference"] = "aol1_wfsrefc"
    values["loop"]["gain"] = LOOP_GAIN
    create(path_of("aol1_mgain", str(tmp_path)), GAINS_BEFORE, {})
    create(path_of("aol1_wfsrefc", str(tmp_path)), REFERENCE_BEFORE, {})
    return Settings.model_validate(values)


@pytest.fixture
def calibration(settings, tmp_path):
    return begun(settings, tmp_path)[0]


def arrays(**changes):
    modes = np.arange(N_MODES * 6, dtype=np.float64).reshape(N_MODES, 6)
    return {
        "reconstructor": matrix("any", 7).matrix,
        "gain_factor": FACTORS,
        "reference_slopes": REFERENCE,
        "mode_to_actuator": 1e-6 * modes.T,  # the same strokes in metres
    } | changes


def bundle_in(folder, *, name="cm-7.h5", matrix_id="cm-7", facts=None, **changes):
    path = folder / name
    facts = {"instrument": "small", "record": {"config_id": "c"}} if facts is None else facts
    write_bundle(path, Bundle(id=matrix_id, arrays=arrays(**changes), facts=facts))
    return path


def live(folder):
    return {name: in_stream(folder, name).latest() for name in ("aol1_mgain", "aol1_wfsrefc")}


def everything(folder):
    """All bytes of streams and matrices, by name."""
    files = [*folder.glob("*.im.shm"), *(folder / "matrices").iterdir()]
    return {path.name: path.read_bytes() for path in files}


@pytest.mark.parametrize("name", ["cm-7.h5", "cm-7.fits"])
def test_all_of_it_is_there_once_cacao_has_restarted_and_nothing_acts_before(
    settings, calibration, tmp_path, name
):
    assert apply(settings, bundle_in(tmp_path, name=name)) == "cm-7"
    assert calibration.look(100, SHAPE) is None
    cube = in_stream(tmp_path).latest().reshape(3, -1)
    np.testing.assert_allclose(cube[:, INDEX] * UNIT, arrays()["reconstructor"], rtol=1e-6)
    np.testing.assert_array_equal(live(tmp_path)["aol1_mgain"], GAINS_BEFORE)
    np.testing.assert_array_equal(live(tmp_path)["aol1_wfsrefc"], REFERENCE_BEFORE)

    assert calibration.look(101, SHAPE) == "cm-7"
    found = live(tmp_path)
    np.testing.assert_allclose(found["aol1_mgain"][:3], LOOP_GAIN * FACTORS)
    np.testing.assert_array_equal(found["aol1_mgain"][3:], GAINS_BEFORE[3:])
    np.testing.assert_array_equal(found["aol1_wfsrefc"].ravel()[INDEX], REFERENCE)
    np.testing.assert_array_equal(calibration.in_use.matrix, arrays()["reconstructor"])


def test_frames_in_another_unit_get_matrix_and_reference_in_theirs(settings, tmp_path):
    begun(settings, tmp_path)
    loop = settings.loop.model_copy(update={"slope_per_value": 4.0})
    settings = settings.model_copy(update={"loop": loop})
    calibration = Calibration(settings, IDENTITY)
    apply(settings, bundle_in(tmp_path))
    calibration.look(100, SHAPE)
    cube = in_stream(tmp_path).latest().reshape(3, -1)
    np.testing.assert_allclose(cube[:, INDEX] * UNIT, 4.0 * arrays()["reconstructor"], rtol=1e-6)
    calibration.look(101, SHAPE)
    reference = live(tmp_path)["aol1_wfsrefc"].ravel()[INDEX]
    np.testing.assert_allclose(4.0 * reference, REFERENCE)
    np.testing.assert_array_equal(calibration.in_use.matrix, arrays()["reconstructor"])


def test_what_was_there_goes_back_bit_for_bit_and_forth_again(settings, calibration, tmp_path):
    own, before = calibration.in_use.manifest.id, live(tmp_path)
    slices = in_stream(tmp_path).latest()
    apply(settings, bundle_in(tmp_path))
    calibration.look(100, SHAPE)
    calibration.look(101, SHAPE)
    after = live(tmp_path)

    assert roll_back(settings) == own
    calibration.look(101, SHAPE)
    np.testing.assert_array_equal(live(tmp_path)["aol1_mgain"], after["aol1_mgain"])
    assert calibration.look(102, SHAPE) == own
    for name, values in before.items():
        np.testing.assert_array_equal(live(tmp_path)[name], values)
    np.testing.assert_array_equal(in_stream(tmp_path).latest()[:, *_where()], slices[:, *_where()])

    assert roll_back(settings) == "cm-7"
    calibration.look(102, SHAPE)
    assert calibration.look(103, SHAPE) == "cm-7"
    for name, values in after.items():
        np.testing.assert_array_equal(live(tmp_path)[name], values)


def _where():
    """Places of slopes in a slice: where there is none a bridge writes 0."""
    return np.unravel_index(INDEX, SHAPE)


BAD = {
    "another telescope": ({"facts": {"instrument": "other"}}, "of other, expected one of small"),
    "another sensor": (
        {"facts": {"instrument": "small", "record": {"config_id": "d"}}},
        "configuration d, expected c",
    ),
    "other slopes": (
        {"reconstructor": np.ones((3, N_SLOPES + 1), np.float32)},
        "3 modes, 5 slopes, expected at most 5, and 4",
    ),
    "a mode turned over": (
        {"mode_to_actuator": arrays()["mode_to_actuator"] * [1.0, -1.0, 1.0, 1.0, 1.0]},
        "mode 1 has a cosine of -1.000",
    ),
    "another mirror": ({"mode_to_actuator": np.ones((7, N_MODES))}, "of 7 actuators, expected"),
    "a gain below 0": ({"gain_factor": -FACTORS}, "the least -1"),
    "fewer gains": ({"gain_factor": FACTORS[:2]}, "found 2 gain factors"),
    "another reference": ({"reference_slopes": REFERENCE[:3]}, "found 3 reference slopes"),
    "a path": ({"matrix_id": "../cm-7"}, "id: '../cm-7'"),
}


@pytest.mark.parametrize("what", BAD)
def test_one_that_does_not_fit_changes_nothing(settings, calibration, tmp_path, what):
    changes, told = BAD[what]
    before = everything(tmp_path)
    with pytest.raises(PyrcalError, match=told.replace("(", r"\(")):
        apply(settings, bundle_in(tmp_path, **changes))
    assert everything(tmp_path) == before
    assert calibration.look(101, SHAPE) is None


@pytest.mark.parametrize("damage", [lambda b: b[:-2000], lambda b: b.replace(b"cm-7", b"cm-8")])
def test_one_that_is_not_as_it_was_written_changes_nothing(settings, calibration, tmp_path, damage):
    path = bundle_in(tmp_path)
    data = damage(path.read_bytes())
    path.unlink()
    path.write_bytes(data)
    before = everything(tmp_path)
    with pytest.raises(PyrcalError):
        apply(settings, path)
    assert everything(tmp_path) == before


@pytest.mark.parametrize(
    ("table", "key", "told"),
    [
        ("streams", "gains", "gain factors"),
        ("loop", "gain", "gain factors"),
        ("streams", "reference", "reference slopes"),
    ],
)
def test_what_has_no_place_here_is_a_reason(settings, calibration, tmp_path, table, key, told):
    values = settings.model_dump()
    values[table][key] = 0.0 if table == "loop" else ""
    with pytest.raises(ConfigurationError, match=f"found {told}.*no place.*nothing was changed"):
        apply(Settings.model_validate(values), bundle_in(tmp_path))


def test_other_numbers_under_a_known_id_are_refused(settings, calibration, tmp_path):
    calibration.stage(matrix("cm-7", 1))
    with pytest.raises(ConfigurationError, match="other numbers under cm-7"):
        apply(settings, bundle_in(tmp_path))


def test_a_bridge_that_ends_before_the_gains_are_set_sets_them_when_it_runs_again(
    settings, calibration, tmp_path, monkeypatch
):
    apply(settings, bundle_in(tmp_path))
    calibration.look(100, SHAPE)
    with monkeypatch.context() as patch:
        patch.setattr(Parts, "set", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            calibration.look(101, SHAPE)
    np.testing.assert_array_equal(live(tmp_path)["aol1_mgain"], GAINS_BEFORE)
    again = Calibration(settings, IDENTITY)
    assert again.look(101, SHAPE) is None
    assert again.in_use.manifest.id == "cm-7"
    np.testing.assert_allclose(live(tmp_path)["aol1_mgain"][:3], LOOP_GAIN * FACTORS)
    assert roll_back(settings).startswith("own-")


def test_gains_that_cannot_be_set_are_a_complaint_until_they_can(settings, calibration, tmp_path):
    apply(settings, bundle_in(tmp_path))
    calibration.look(100, SHAPE)
    path = path_of("aol1_mgain", str(tmp_path))
    create(path, GAINS_BEFORE[:4], {})
    for _ in range(2):
        with pytest.raises(StreamError, match="found 4 values, expected 5 of cm-7"):
            calibration.look(101, SHAPE)
    np.testing.assert_array_equal(live(tmp_path)["aol1_wfsrefc"], REFERENCE_BEFORE)
    create(path, GAINS_BEFORE, {})
    calibration.look(101, SHAPE)
    np.testing.assert_array_equal(live(tmp_path)["aol1_wfsrefc"].ravel()[INDEX], REFERENCE)


def test_a_newer_matrix_of_the_service_takes_its_place_and_leaves_the_gains(
    settings, calibration, tmp_path
):
    apply(settings, bundle_in(tmp_path))
    calibration.look(100, SHAPE)
    calibration.stage(matrix("cm-8", 8))
    (tmp_path / "matrices" / "apply").write_text("cm-8")
    calibration.look(100, SHAPE)
    assert calibration.look(101, SHAPE) == "cm-8"
    np.testing.assert_array_equal(live(tmp_path)["aol1_mgain"], GAINS_BEFORE)


def test_nothing_before_is_said(settings, calibration):
    with pytest.raises(ConfigurationError, match="found no matrix before the one in use"):
        roll_back(settings)
