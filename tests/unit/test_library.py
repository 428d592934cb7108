"""``import pyrcal``: what there is, and that it costs nothing before it is used."""

import subprocess
import sys

import pytest

import pyrcal
from pyrcal import __main__ as program
from pyrcal import __main__ as service_program


@pytest.mark.parametrize("name", pyrcal.__all__)
def test_everything_that_is_offered_is_there(name):
    assert getattr(pyrcal, name) is not None


def test_nothing_else_is_offered():
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        _ = pyrcal.nonsense


@pytest.mark.parametrize("module", ["pyrcal", "pyrcal.client.rest", "pyrcal.offline"])
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
