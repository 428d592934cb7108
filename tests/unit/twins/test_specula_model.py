"""A bench becomes a SPECULA model, in files that SPECULA and pyrcal's own import read."""

import os
import subprocess
from dataclasses import replace

import numpy as np
import pytest

import pyrcal
from pyrcal.fitting.specula import read_subapertures
from pyrcal.twins.check import Checked, check_oopao_model, check_specula_model
from pyrcal.twins.oopao_model import write_oopao_model
from pyrcal.twins.sampled import correlations, residual_fraction, sample_bench
from pyrcal.twins.specula_model import read_matrix, swap_slopes, write_specula_model
from service.files.container import opened
from service.model.sensors.pyramid.description import stretch_of
from tests.support.repository import ROOT
from tests.support.twin import find_interpreter


def read(folder, kind, name):
    with opened(folder / "calibration" / kind / "bench.fits") as container:
        return container.find(name).numbers()


def test_the_files_hold_the_bench(bench, tmp_path):
    instrument, fit = bench
    write_specula_model(sample_bench(instrument, fit), fit, tmp_path)
    with opened(tmp_path / "calibration" / "pupils" / "bench.fits") as container:
        mask = read_subapertures(container).mask
    margin = (len(fit.valid) - len(mask)) // 2
    assert np.array_equal(np.pad(mask, margin), fit.valid)
    stop = read(tmp_path, "pupilstop", "AMPLITUDE")
    inside = read(tmp_path, "ifunc", "MASK_INF_FUNC") > 0.0
    assert np.array_equal(stop > 0.0, inside)
    functions, m2c = read(tmp_path, "ifunc", "INFLUENCE_FUNCTION"), read(tmp_path, "m2c", "M2C")
    assert functions.shape == (inside.sum(), len(m2c))
    assert m2c.shape[1] == len(fit.modes)


def test_the_reconstructor_inverts_the_matrix_in_nanometres(bench, tmp_path):
    instrument, fit = bench
    write_specula_model(sample_bench(instrument, fit), fit, tmp_path)
    reconstructor = read(tmp_path, "rec", "RECMAT")
    # SPECULA's first slopes are Sy of conventions.md
    sx, sy = np.split(fit.synthetic * 1e-9, 2)
    assert np.allclose(reconstructor @ np.vstack([sy, sx]), np.eye(len(fit.modes)), atol=1e-3)


def test_what_the_parameter_file_cannot_say_is_said(bench, tmp_path):
    instrument, fit = bench
    plain = write_specula_model(sample_bench(instrument, fit), fit, tmp_path).remarks
    assert not [one for one in plain if "elliptic" in one]
    wfs = replace(instrument.wfs, modulation_stretch=stretch_of((3.5, 2.5), 0.3))
    remarks = write_specula_model(
        sample_bench(replace(instrument, wfs=wfs), fit), fit, tmp_path
    ).remarks
    assert [one for one in remarks if "no elliptic modulation" in one]
    wfs = replace(instrument.wfs, rooftop_lambda_over_d=0.5)
    sharp = sample_bench(replace(instrument, wfs=wfs), fit)
    remarks = write_specula_model(sharp, fit, tmp_path).remarks
    assert [one for one in remarks if "no rooftop: that of 0.5 lambda/D" in one]


SMALL = ROOT / "tests" / "system" / "small.toml"
ALPHA = pyrcal.Misregistration(shift_x_subap=0.2, shift_y_subap=-0.1, rotation_rad=0.03)


def test_an_instrument_file_and_a_registration_become_a_model(tmp_path):
    exported = pyrcal.to_specula(SMALL, tmp_path / "new", ALPHA)
    assert exported.path == tmp_path / "new" / "specula_model.yml"
    assert any("no fft_grid" in one for one in exported.remarks)
    # without an orientation in the file its slopes are those of conventions.md
    matrix = pyrcal.interaction_matrix(SMALL, ALPHA)
    reconstructor = read(exported.path.parent, "rec", "RECMAT") * 1e-9
    assert np.allclose(reconstructor @ swap_slopes(matrix), np.eye(matrix.shape[1]), atol=1e-3)
    away = pyrcal.interaction_matrix(SMALL)
    assert not np.allclose(reconstructor @ swap_slopes(away), np.eye(away.shape[1]), atol=0.1)


def test_only_a_pyramid_becomes_a_model(tmp_path):
    with pytest.raises(pyrcal.ModelError, match="expected pyramid"):
        pyrcal.to_specula(ROOT / "tests" / "data" / "lenslets.toml", tmp_path / "new")
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").touch()
    with pytest.raises(pyrcal.StorageError, match="cannot be written"):
        pyrcal.to_specula(SMALL, tmp_path / "file")


@pytest.mark.long
@pytest.mark.timeout(300)
@pytest.mark.parametrize("case", ["file", "fit", "aberration"])
def test_specula_measures_the_matrix_of_an_instrument_file(bench, case, tmp_path):
    """Its pupil moves with the mirror, and a static aberration with the pupil."""
    python = find_interpreter("specula")
    instrument, fit = bench if case == "fit" else (pyrcal.load_instrument(SMALL), None)
    if case == "aberration":
        wfs = replace(instrument.wfs, aberration_rad=(0.0, 0.0, 0.3, 0.2))
        instrument = replace(instrument, wfs=wfs)
    pyrcal.to_specula(instrument, tmp_path, fit or ALPHA)
    expected = fit.synthetic if fit else pyrcal.interaction_matrix(instrument, ALPHA)
    program = [str(python), "-m", "specula.scripts.specula_main", "--cpu", "--precision", "0"]
    subprocess.run(
        [*program, "specula_model.yml"],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "Agg"},
        capture_output=True,
        check=True,
    )
    measured = read_matrix(tmp_path) * 1e9
    # a model of few points differs by per cents from the continuous one, in the gain as well
    assert residual_fraction(expected, measured) < 0.03
    gains = np.sum(measured * expected, axis=0) / np.sum(expected**2, axis=0)
    assert np.median(gains) == pytest.approx(1.0, abs=0.03)


@pytest.mark.long
@pytest.mark.timeout(300)
@pytest.mark.parametrize("aberration_rad", [(), (0.0, 0.0, 0.3, -0.2, 0.1)])
def test_specula_measures_what_oopao_measures(aberration_rad, bench, tmp_path):
    specula, oopao = find_interpreter("specula"), find_interpreter("OOPAO")
    about = replace(bench[0], wfs=replace(bench[0].wfs, aberration_rad=aberration_rad))
    bench = about, bench[1]
    sampled = sample_bench(*bench)
    write_specula_model(sampled, bench[1], tmp_path)
    write_oopao_model(sampled, tmp_path)
    found = check_specula_model(tmp_path, *bench, python=specula)
    assert isinstance(found, Checked), found
    other = check_oopao_model(tmp_path, *bench, python=oopao)
    assert isinstance(other, Checked), other
    # the targets of the models' comparison, for a pupil of 32 points
    assert correlations(other.matrix, found.matrix).min() >= 0.9995
    assert residual_fraction(other.matrix, found.matrix) <= 0.015
    # the exported reconstructor is in SPECULA's order and unit: it inverts what SPECULA measured
    sensed = read(tmp_path, "rec", "RECMAT") @ swap_slopes(found.matrix)
    assert np.allclose(sensed, np.eye(len(sensed)), atol=0.1)


@pytest.mark.long
@pytest.mark.timeout(300)
def test_specula_closes_the_loop_with_the_exported_reconstructor(bench, tmp_path):
    python = find_interpreter("specula")
    write_specula_model(sample_bench(*bench), bench[1], tmp_path)
    program = [str(python), "-m", "specula.scripts.specula_main", "--cpu", "--precision", "0"]
    subprocess.run(
        [*program, "specula_model.yml", "specula_loop.yml"],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "Agg"},
        capture_output=True,
        check=True,
    )
    with opened(tmp_path / "loop" / "modes.fits") as container:
        (stored,) = (one for one in container.arrays.values() if len(one.shape) == 2)
        modes = np.abs(stored.numbers()).max(axis=1)
    assert modes[-1] < 1e-3 * modes[0]
