"""A bench that OOPAO simulated becomes an OOPAO model with the same objects."""

import runpy
import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from pyrcal.twins.check import Checked, check_oopao_model
from pyrcal.twins.oopao_model import write_oopao_model
from pyrcal.twins.sampled import sample_bench
from tests.support.twin import find_interpreter


class Anything(ModuleType):
    """A module of OOPAO that is not installed: every name is a class that keeps its arguments."""

    def __getattr__(self, name):
        return dict


def read_model(path, monkeypatch):
    for name in ("DeformableMirror", "MisRegistration", "Pyramid", "Source", "Telescope"):
        monkeypatch.setitem(sys.modules, f"OOPAO.{name}", Anything(name))
    monkeypatch.setitem(sys.modules, "OOPAO", Anything("OOPAO"))
    return runpy.run_path(str(path))


def test_the_model_has_the_numbers_of_the_bench(bench, dump, tmp_path, monkeypatch):
    exported = write_oopao_model(sample_bench(*bench), tmp_path)
    model = read_model(exported.path, monkeypatch)
    number = {name: float(dump[name]) for name in ("tel.D", "wfs.modulation", "dm.mechCoupling")}
    assert model["RESOLUTION"] == int(dump["tel.resolution"])
    assert model["WIDTH_M"] == pytest.approx(number["tel.D"])
    # what the fit found, to what 8 subapertures and 30 modes tell
    assert model["MODULATION"] == pytest.approx(number["wfs.modulation"], rel=0.05)
    assert model["COUPLING"] == pytest.approx(number["dm.mechCoupling"], rel=0.05)
    subaperture_m = number["tel.D"] / 8
    moved = model["MISREGISTRATION"]
    assert moved["shiftX"] == pytest.approx(0.2 * subaperture_m, abs=0.005 * subaperture_m)
    assert moved["shiftY"] == pytest.approx(0.0, abs=0.005 * subaperture_m)
    assert moved["rotationAngle"] == pytest.approx(2.0, abs=0.1)


def test_the_model_has_the_rooftop_of_the_bench(bench, tmp_path, monkeypatch):
    """In OOPAO's unit: the import of what it writes has the length of the bench."""
    instrument, fit = bench
    wfs = replace(instrument.wfs, rooftop_lambda_over_d=-0.4)
    drawn = sample_bench(replace(instrument, wfs=wfs), fit)
    model = read_model(write_oopao_model(drawn, tmp_path).path, monkeypatch)
    apart = model["N_PIXELS"] + model["N_PIX_SEPARATION"]
    assert model["ROOFTOP"] * model["RESOLUTION"] / (np.pi * apart) == pytest.approx(-0.4)


def test_the_model_lists_signals_as_the_bench_does(bench, dump, tmp_path, monkeypatch):
    model = read_model(write_oopao_model(sample_bench(*bench), tmp_path).path, monkeypatch)
    n_slopes = dump["calib.D"].shape[0]
    assert model["SHAPE"] == (n_slopes,)
    # OOPAO's own order: its slopes are those of the bench, and the mirror has its sign
    signal = np.arange(n_slopes, dtype=float)
    assert np.array_equal(model["list_signals"](signal), signal)
    assert model["SIGN"] == 1


def test_a_program_that_is_not_installed_is_named(bench, tmp_path):
    write_oopao_model(sample_bench(*bench), tmp_path)
    found = check_oopao_model(tmp_path, *bench, python=tmp_path / "no-python")
    assert isinstance(found, str)
    assert found.startswith("OOPAO could not be run")


@pytest.mark.long
@pytest.mark.timeout(300)
def test_oopao_measures_the_bench_with_its_model(bench, tmp_path):
    python = find_interpreter("OOPAO")
    write_oopao_model(sample_bench(*bench), tmp_path)
    found = check_oopao_model(tmp_path, *bench, python=python)
    assert isinstance(found, Checked), found
    # the target of a noise-free bench of the same sampling
    assert found.left_over <= 0.015
    assert found.correlation.min() > 0.9995
