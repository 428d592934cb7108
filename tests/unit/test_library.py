"""``import pyrcal``: what there is, and that it costs nothing before it is used."""

import inspect
import re
import subprocess
import sys

import pytest

import pyrcal
from tests.support.repository import ROOT


def test_everything_that_is_offered_is_there_and_nothing_else():
    for name in pyrcal.__all__:
        assert getattr(pyrcal, name) is not None, name
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        _ = pyrcal.nonsense


def test_the_conventions_need_no_import_of_their_own():
    code = "import pyrcal; pyrcal.conventions.check"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("module", ["pyrcal", "pyrcal.client.rest", "pyrcal.fitting"])
def test_what_is_imported_brings_no_mathematics(module):
    code = f"import sys, {module}; sys.exit('numpy' in sys.modules or 'pydantic' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


SIGNATURES = {
    "dither_sigma": "near, modes, amplitude_m, n_frames, slope_noise",
    "fit_file": "instrument, path, options, dataset, threads, memory_gb, basis, progress",
    "array_backend": "library",
    "fit": "instrument, matrix, modes, noise, flux_frame, double_pass, options, threads",
    "fit_system": "system, reference, dataset, threads",
    "from_cacao": "folder, reported, response",
    "from_oopao": "tel, dm, wfs, calib, M2C, ngs",
    "from_specula": "paths, reported, source",
    "from_synim": "paths, reported",
    "interaction_matrix": "instrument, alpha",
    "load_instrument": "name_or_path",
    "modal_basis": "instrument",
    "read_bundle": "path",
    "read_fit": "path",
    "reconstruct": "interaction_matrix, recipe",
    "to_oopao": "alpha, tel, wfs",
    "to_specula": "instrument, folder, found",
    "track": "path, instrument, settings",
    "twin": "files, output, check, python, threads, stated",
    "write_bundle": "path, bundle",
}
"""Parameters of the functions that may be relied on: docs/reference/python.md."""


def test_what_may_be_relied_on_is_called_as_before():
    functions = {name for name in pyrcal.__all__ if inspect.isfunction(getattr(pyrcal, name))}
    found = {name: inspect.signature(getattr(pyrcal, name)).parameters for name in functions}
    assert {name: ", ".join(parameters) for name, parameters in found.items()} == SIGNATURES


EXAMPLES = sorted((ROOT / "examples" / "reference").glob("*.py"))
REFERENCE = ROOT / "docs" / "reference" / "python.md"


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_example_of_an_object_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    exec(compile(path.read_text("utf-8"), path.name, "exec"), {"__name__": "example"})


def test_every_object_of_the_library_has_a_page_and_an_example():
    lists = re.findall(r":nosignatures:\n\n((?:   \S+\n)+)", REFERENCE.read_text("utf-8"))
    named = [name for text in lists for name in text.split()]
    assert set(pyrcal.__all__) - {"Settings", "__version__"} <= set(named)
    assert sorted(name.rpartition(".")[2] for name in named) == sorted(
        path.stem.partition("_")[2] for path in EXAMPLES
    )
