"""Matrices on their way to cacao: written when they may be, in use when cacao restarts."""

import json

import numpy as np
import pytest

from cacao_bridge.calibration import Calibration, consent
from cacao_bridge.settings import load
from cacao_bridge.streams import StreamError, create, path_of
from service.errors import ConfigurationError
from tests.support.calibration import (
    IDENTITY,
    INDEX,
    SHAPE,
    UNIT,
    begun,
    in_stream,
    matrix,
    settings_in,
)
from tests.support.milk import keywords_in


@pytest.fixture
def settings(tmp_path):
    return settings_in(tmp_path)


def test_a_matrix_waits_for_an_operator_and_then_for_a_restart(settings, tmp_path):
    calibration, own = begun(settings, tmp_path)
    calibration.stage(matrix("cm-1", 1))
    assert calibration.look(100, SHAPE) is None
    assert keywords_in(in_stream(tmp_path).path) == {}, "nobody has said that it may be written"
    with pytest.raises(ConfigurationError, match="found cm-2, expected cm-1"):
        consent(settings, "cm-2")
    assert consent(settings, "waiting") == "cm-1"
    assert calibration.look(100, SHAPE) is None, "written, but cacao has copied before"
    assert calibration.in_use.manifest.id == own
    stream = in_stream(tmp_path)
    ((value, comment),) = keywords_in(stream.path).values()
    assert comment == "cm-1"
    cube = stream.latest().reshape(3, -1)
    np.testing.assert_allclose(cube[:, INDEX] * UNIT, matrix("cm-1", 1).matrix, rtol=1e-6)
    assert not np.delete(cube, INDEX, axis=1).any()
    np.testing.assert_array_equal(
        in_stream(tmp_path, "aol1_DMmodes").latest(), np.arange(18.0).reshape(3, 2, 3)
    )
    told = json.loads((tmp_path / "matrices" / "cm-1.json").read_text())
    assert told["sha256"].startswith(value)
    assert (told["im_id"], told["parent"]) == ("im-1", "p")

    assert calibration.look(101, SHAPE) == "cm-1"
    assert (calibration.in_use.manifest.id, calibration.waiting) == ("cm-1", None)
    assert calibration.look(101, SHAPE) is None
    with pytest.raises(ConfigurationError, match="expected none: none waits"):
        consent(settings, "waiting")


def test_a_restart_before_it_is_written_changes_nothing(settings, tmp_path):
    calibration, own = begun(settings, tmp_path)
    calibration.stage(matrix("cm-1", 1))
    assert calibration.look(101, SHAPE) is None
    assert (calibration.in_use.manifest.id, calibration.waiting) == (own, "cm-1")


def test_without_the_interlock_it_is_written_at_once_and_not_yet_in_use(tmp_path):
    settings = settings_in(tmp_path, "restart")
    calibration, own = begun(settings, tmp_path)
    calibration.stage(matrix("cm-1", 1))
    assert calibration.look(100, SHAPE) is None
    assert keywords_in(in_stream(tmp_path).path)["PYRCAL"][1] == "cm-1"
    assert calibration.in_use.manifest.id == own
    assert calibration.look(101, SHAPE) == "cm-1"


def test_another_bridge_knows_what_is_in_use_and_what_waits(tmp_path):
    settings = settings_in(tmp_path, "restart")
    calibration, own = begun(settings, tmp_path)
    calibration.stage(matrix("cm-1", 1))
    calibration.look(100, SHAPE)
    again = Calibration(settings, IDENTITY)
    assert again.look(100, SHAPE) is None
    assert again.in_use.manifest.id == own, "the stream holds cm-1, cacao still has its own"
    np.testing.assert_allclose(again.in_use.matrix, np.full((3, 4), UNIT))
    after = Calibration(settings, IDENTITY)
    assert after.look(101, SHAPE) == "cm-1", "cacao restarted while there was no bridge"


def test_what_somebody_else_has_written_has_a_name_of_its_own(settings, tmp_path):
    calibration, own = begun(settings, tmp_path)
    create(path_of("aol1_modesWFS", str(tmp_path)), np.full((2, *SHAPE), 3.0, np.float32), {})
    assert calibration.look(100, SHAPE) is None, "cacao has not copied it"
    other = calibration.look(101, SHAPE)
    assert other.startswith("own-")
    assert other != own
    assert calibration.in_use.matrix.shape == (2, 4)
    create(path_of("aol1_modesWFS", str(tmp_path)), np.ones((2, 4), np.float32), {})
    with pytest.raises(StreamError, match="aol1_modesWFS: 4 values a slice, expected at least 6"):
        calibration.look(102, SHAPE)


def test_a_newer_one_takes_the_place_of_one_that_waits(settings, tmp_path):
    calibration, _ = begun(settings, tmp_path)
    calibration.stage(matrix("cm-1", 1))
    calibration.stage(matrix("cm-2", 2))
    consent(settings, "cm-2")
    calibration.look(100, SHAPE)
    assert calibration.look(101, SHAPE) == "cm-2"


@pytest.mark.parametrize(
    ("key", "array", "expected"),
    [
        ("dm_modes", np.ones((4, 2, 3)), r"found shape \(4, 2, 3\), expected 5 modes"),
        ("dm_modes", np.full((5, 6), np.nan), "expected 5 modes of one or two axes, all finite"),
        ("slopes_index", np.array([0, 0, 1, 2]), "expected 4 places from 0 on, none twice"),
        ("slopes_index", np.ones(4), r"found float64 \(4,\), expected 4 places"),
    ],
)
def test_arrays_of_other_sizes_are_refused_by_key(settings, key, array, expected):
    np.save(getattr(settings.calibration, key), array)
    with pytest.raises(ConfigurationError, match=f"calibration.{key}: .*{expected}"):
        Calibration(settings, IDENTITY)


def test_settings_say_what_is_wrong_where(tmp_path):
    path = tmp_path / "cacao.toml"
    path.write_text("[wire]\nsystem = 'a b'\n")
    with pytest.raises(ConfigurationError, match=r"cacao.toml: .*system"):
        load(path)
