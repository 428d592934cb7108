"""A matrix, modes and a stream against the numbered rules: what is good keeps them all, and each of
more than forty mutations breaks the rule that it is about.
"""

import re
from dataclasses import replace

import h5py
import pytest

import pyrcal
from pyrcal import conventions
from pyrcal.__main__ import main
from pyrcal.conventions import check
from pyrcal.importers.oopao import from_saved
from pyrcal.importers.saved import read_npz
from service.instrument import load_instrument
from service.model.modes import modal_basis
from tests.support.mutations import GOOD_FILE, MATRICES, STREAMS, good
from tests.support.repository import ROOT

DATA = ROOT / "pyrcal" / "samples" / "data"
RULES = {
    *(conventions.AXES, conventions.ROTATION, conventions.OPD, conventions.MODES),
    *(conventions.ORDER, conventions.SIGN, conventions.MATRIX, conventions.LAW),
    *(conventions.PASSES, conventions.TIME),
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return good(tmp_path_factory.mktemp("good"))


def broken(findings):
    return {one.rule for one in findings if not one.kept}


def named(rules):
    return set(rules) if isinstance(rules, tuple) else {rules}


def test_what_is_good_keeps_every_rule_that_can_be_measured(files):
    findings = check(files.instrument, files.matrix, stream=files.stream)
    assert broken(findings) == set()
    assert {one.rule for one in findings} == RULES - {conventions.PASSES}


def test_there_are_forty_mutations():
    assert len(MATRICES) + len(STREAMS) >= 40


@pytest.mark.parametrize(
    "name",
    # no start is near the rolled one: its fit takes as long as ten others
    [pytest.param(k, marks=[pytest.mark.long] * ("shifted by three" in k)) for k in MATRICES],
)
def test_a_mutated_matrix_breaks_its_rule(name, files):
    mutate, rules = MATRICES[name]
    assert broken(check(files.instrument, mutate(files))) & named(rules)


@pytest.mark.parametrize("name", STREAMS)
def test_a_mutated_stream_breaks_its_rule_and_no_other(name, files):
    mutate, rules = STREAMS[name]
    assert broken(check(files.instrument, stream=mutate(files))) == named(rules)


@pytest.mark.parametrize("factor", [1e9, 1e6, 1e-3])
def test_modes_in_another_unit_break_theirs(factor, files):
    strokes = modal_basis(files.instrument).mode_to_actuator * factor
    mirror = replace(files.instrument.mirror, mode_to_actuator=strokes)
    assert broken(check(replace(files.instrument, mirror=mirror))) == {conventions.MODES}


def test_what_a_file_leaves_open_breaks_no_rule(files):
    """Axes and signs that are "auto", strokes that are unknown."""
    slopes = replace(files.instrument.slopes, orientation=None)
    mirror = replace(files.instrument.mirror, stroke_known=False, nominal_rotation_rad=None)
    silent = replace(files.instrument, slopes=slopes, mirror=mirror)
    for name in ("all signs", "rows counted from the top", "axes exchanged"):
        assert broken(check(silent, MATRICES[name][0](files))) == set(), name
    assert broken(check(silent, 3.0 * files.matrix)) == set()


def test_imported_lenslets_keep_them(tmp_path):
    """The other good imports are in test_imported_files_mutated."""
    imported = from_saved(read_npz(DATA / "oopao-lenslets.npz"), "it")
    saved = imported.save(tmp_path / "lenslets")
    findings = check(load_instrument(saved.instrument), imported.arrays["interaction_matrix"])
    assert broken(findings) == set()


def test_the_command_says_which_rules_are_broken(files, tmp_path, capsys):
    path = tmp_path / "good.toml"
    path.write_text(GOOD_FILE, "utf-8")
    for name, matrix, status in (("im", files.matrix, 0), ("turned", -files.matrix, 1)):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file["interaction_matrix"] = matrix
        assert main(["conventions", str(path), str(tmp_path / f"{name}.h5")]) == status
    assert re.findall(r"^rule (\d+) BROKEN", capsys.readouterr().out, re.M) == ["11"]
    assert pyrcal.conventions is conventions


def test_the_rules_have_the_numbers_of_the_page():
    page = (ROOT / "docs" / "reference" / "conventions.md").read_text("utf-8")
    texts = dict(re.findall(r"^(\d+)\. (.*)", page, re.M))
    for rule, word in (
        (conventions.AXES, "reference frame"),
        (conventions.ROTATION, "Rotation"),
        (conventions.OPD, "optical path difference"),
        (conventions.MODES, "Modes"),
        (conventions.ORDER, "Slopes"),
        (conventions.SIGN, "positive mean Sx"),
        (conventions.MATRIX, "Interaction matrix"),
        (conventions.LAW, "Closed loop"),
        (conventions.PASSES, "Double pass"),
        (conventions.TIME, "Time"),
    ):
        assert word in texts[str(rule)]
    assert [*map(int, texts)] == list(range(1, len(texts) + 1))
