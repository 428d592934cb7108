"""``pyrcal instrument``: template by the schema, check that says everything, picture."""

import re
import tomllib

import h5py
import numpy as np
import pytest

from pyrcal.__main__ import main
from pyrcal.fitting.system_file import SystemFile
from pyrcal.instruments.program import (
    EXAMPLES,
    derive_properties,
    describe_properties,
    make_template,
)
from pyrcal.instruments.schema_texts import tables_of
from service.errors import ConfigurationError
from service.instrument import load_instrument
from service.instrument.schema import whole_of
from service.model.sensors.registry import KINDS
from tests.support.lamps import counts_of
from tests.support.repository import ROOT

TINY = ROOT / "tests" / "data" / "tiny" / "tiny.toml"
LENSLETS = ROOT / "tests" / "data" / "lenslets.toml"

WRONG = """
[instrument]
name = "b"
diameter_m = -3.0
stop = "mirror"
colour = "red"
[wfs]
kind = "pyramid"
n_subapertures = "many"
wavelength_m = 750e-9
[mirror]
layout = "grid"
[slopes]
order = "zy"
"""

CONTRADICTS = """
[instrument]
name = "b"
diameter_m = 3.0
stop = "mirror"
pupil = "no.h5:/x"
[wfs]
kind = "pyramid"
n_subapertures = 20
wavelength_m = 750e-9
modulation_lambda_over_d = 3.0
valid_subapertures = "mask.h5:/x"
[mirror]
layout = "grid"
n_across = 12
[slopes]
order = "pixels"
"""


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_file_is_an_instrument_and_has_every_key(kind, tmp_path, capsys):
    path = tmp_path / "bench.toml"
    assert main(["instrument", "new", str(path), "--kind", kind]) == 0
    assert load_instrument(path).wfs.kind == kind
    text = path.read_text("utf-8")
    for table in tables_of(whole_of(KINDS[kind])):
        assert re.search(rf"^#?{re.escape(table.header)}$", text, re.M)
        for key in table.keys:
            assert re.search(rf"^#?{key.name} =", text, re.M), key.name
    assert "instrument check" in capsys.readouterr().out


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_file_must_have_is_set_and_nothing_else_but_a_mirror(kind):
    for table in tables_of(whole_of(KINDS[kind])):
        needed = {key.name for key in table.keys if key.needed} - {"kind"}
        if "." not in table.header and table.header != "[mirror]":
            assert set(EXAMPLES.get(table.header, {})) >= needed, table.header
    assert set(tomllib.loads(make_template(KINDS[kind]))["mirror"]) == set(EXAMPLES["[mirror]"])


def test_a_file_that_is_there_is_kept(tmp_path, capsys):
    path = tmp_path / "bench.toml"
    path.write_text("mine")
    assert main(["instrument", "new", str(path)]) == 2
    assert "File exists" in capsys.readouterr().err
    assert path.read_text() == "mine"


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        (
            WRONG,
            (
                *("instrument.diameter_m", "instrument.colour", "wfs.n_subapertures"),
                *("slopes.order", "wfs.modulation_lambda_over_d"),
            ),
        ),
        (
            CONTRADICTS,
            ("wfs.valid_subapertures", "mirror.pitch_m", "instrument.pupil", "slopes.order"),
        ),
    ],
)
def test_everything_that_is_wrong_is_said_at_once(text, keys, tmp_path, capsys):
    path = tmp_path / "bench.toml"
    path.write_text(text)
    assert main(["instrument", "check", str(path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(": ")[1] for line in lines] == list(keys)
    with pytest.raises(ConfigurationError, match=rf"\(and {len(keys) - 1} more\)$"):
        load_instrument(path)


def test_a_good_file_is_told_what_it_implies(capsys):
    assert main(["instrument", "check", str(TINY)]) == 0
    out = capsys.readouterr().out
    instrument = load_instrument(TINY)
    assert f"modes       {instrument.modes.n_modes}\n" in out
    (condition,) = re.findall(r"^condition +([\d.]+) of all", out, re.M)
    assert 1.0 < float(condition) < 100.0
    assert re.search(r"^time +[\d.e+]+ s for", out, re.M)


def test_a_matrix_that_takes_more_than_was_allowed_is_not_computed():
    found = derive_properties(load_instrument("flao-lbt"), most_gb=0.2)
    assert found.seconds is None
    assert 0.2 < found.expected_gb < 2.0
    assert "--memory-gb" in describe_properties(load_instrument("flao-lbt"), found)[-1]


def test_more_modes_than_slopes_have_no_condition(tmp_path):
    path = tmp_path / "many.toml"
    path.write_text(
        TINY.read_text("utf-8").replace("n_subapertures = 12", "n_subapertures = 4"), "utf-8"
    )
    found = derive_properties(load_instrument(path), most_gb=4.0)
    assert found.n_modes > found.n_slopes
    assert found.condition_number is None


def test_what_the_model_cannot_work_with_is_said(tmp_path, capsys):
    path = tmp_path / "empty.toml"
    text = re.sub(r"^pitch_m.*", "pitch_m = 30.0", TINY.read_text("utf-8"), flags=re.M)
    path.write_text(text, "utf-8")
    assert main(["instrument", "check", str(path)]) == 1
    assert "expected metres in the pupil plane" in capsys.readouterr().out


def test_places_of_the_pupil_images_are_printed_as_a_line_of_the_file(tmp_path, capsys):
    about = load_instrument(TINY)
    path = tmp_path / "flux.npy"
    np.save(path, counts_of(about))
    assert main(["instrument", "check", str(TINY), "--light", str(path)]) == 0
    places = tomllib.loads(capsys.readouterr().out.splitlines()[-1])["image_offsets_px"]
    np.testing.assert_allclose(places, np.zeros((4, 2)), atol=0.005)


@pytest.mark.parametrize(
    ("file", "arrays", "reason"),
    [
        (TINY, {"a": np.ones((4, 4)), "b": np.ones(3)}, "no dataset flux; it holds a (4, 4), b"),
        (TINY, {"flux": np.zeros((4, 12, 12))}, "no light"),
        (LENSLETS, {"flux": np.ones((30, 30))}, "has no pupil images"),
    ],
)
def test_light_that_shows_no_places_is_refused(tmp_path, capsys, file, arrays, reason):
    path = tmp_path / "light.h5"
    with h5py.File(path, "w") as out:
        for name, values in arrays.items():
            out[name] = values
    assert main(["instrument", "check", str(file), "--light", str(path)]) != 0
    said = capsys.readouterr()
    assert reason in said.out + said.err


def test_the_picture_is_drawn(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    picture = tmp_path / "tiny.png"
    assert main(["instrument", "show", str(TINY), str(picture)]) == 0
    assert capsys.readouterr().out == f"{picture}: drawn\n"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_picture_that_cannot_be_written_is_refused(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    assert main(["instrument", "show", str(TINY), str(tmp_path / "tiny.nothing")]) == 2
    assert "cannot write" in capsys.readouterr().err


def test_a_list_of_fixed_length_is_said_to_be_one():
    """Their outer list was dropped: an array of two stood in the manual as one number."""
    every = [
        key
        for whole in (whole_of(next(iter(KINDS.values()))), SystemFile)
        for table in tables_of(whole)
        for key in table.keys
    ]
    types = {key.name: key.type for key in every}
    assert types["influence_table"] == "list of 2: integer ≥ 1"
    assert types["star_arcsec"] == types["shift_m"] == "list of 2: number"
