"""``import pyrcal``: what there is, and that it costs nothing before it is used."""

import inspect
import subprocess
import sys

import pytest

import pyrcal
from pyrcal import __main__ as program
from pyrcal import __main__ as service_program


@pytest.mark.parametrize("name", pyrcal.__all__)
def test_everything_that_is_offered_is_there(name):
    assert getattr(pyrcal, name) is not None


def test_the_conventions_need_no_import_of_their_own():
    code = "import pyrcal; pyrcal.conventions.check"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_names_of_the_documents_are_the_same_things():
    assert pyrcal.InversionOptions is pyrcal.Recipe
    assert pyrcal.array_backend is pyrcal.arrays_of


def test_nothing_else_is_offered():
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        _ = pyrcal.nonsense


@pytest.mark.parametrize("module", ["pyrcal", "pyrcal.client.rest", "pyrcal.fitting"])
def test_what_is_imported_brings_no_mathematics(module):
    code = f"import sys, {module}; sys.exit('numpy' in sys.modules or 'pydantic' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("command", ["run", "key"])
def test_the_services_own_commands_are_those_of_pyrcal(capsys, command):
    said = []
    for main in (service_program.main, program.main):
        with pytest.raises(SystemExit) as ended:
            main([command, "--help"])
        assert ended.value.code == 0
        said.append(capsys.readouterr().out.partition(command)[2].replace(" ", ""))
    assert said[0] == said[1]


SIGNATURES = {
    "dither_sigma": "near, modes, amplitude_m, n_frames, slope_noise",
    "fit_file": "instrument, path, options, dataset, threads, memory_gb, basis, progress",
    "array_backend": "library",
    "arrays_of": "library",
    "fit": "instrument, matrix, modes, noise, flux_frame, double_pass, options, threads",
    "from_oopao": "tel, dm, wfs, calib, M2C, ngs",
    "interaction_matrix": "instrument, alpha",
    "load_instrument": "name_or_path",
    "modal_basis": "instrument",
    "read_bundle": "path",
    "read_fit": "path",
    "reconstruct": "interaction_matrix, recipe",
    "to_oopao": "alpha, tel, wfs",
    "track": "path, instrument, settings",
    "write_bundle": "path, bundle",
}
"""Parameters of the functions that may be relied on: docs/integrate/library.md."""


def parameters(name):
    return ", ".join(inspect.signature(getattr(pyrcal, name)).parameters)


def test_every_function_has_its_parameters_here():
    functions = {name for name in pyrcal.__all__ if inspect.isfunction(getattr(pyrcal, name))}
    assert functions == set(SIGNATURES)


@pytest.mark.parametrize("name", SIGNATURES)
def test_what_may_be_relied_on_is_called_as_before(name):
    assert parameters(name) == SIGNATURES[name]
