"""Modulations down to none are fitted, to matrices of an FFT pyramid that is not the model."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import numpy as np
import pytest

from pyrcal.fitting import matrix as fit_matrix_module
from pyrcal.fitting.instrument_checks import list_optics
from pyrcal.fitting.matrix import AxesDoubt, FitOptions, fit_matrix
from pyrcal.fitting.models import LOGARITHM_ABOVE, Optic, moved_sensor_number, sensor_coordinate
from pyrcal_studies.drawn_fits import Condition, Draw, instrument_of, model_of
from pyrcal_studies.drawn_fits import measured as drawn_matrices
from pyrcal_studies.fft_pyramid import EllipticPyramid
from pyrcal_studies.image_offsets import SEPARATION, N
from service.estimation.reference import Reference

KEY = "modulation_lambda_over_d"


def fitted(true, stated):
    """The fit of a matrix of the FFT pyramid, the error of α, and the modulation with its σ."""
    draw = Draw(code="fft", condition=Condition(modulation_lambda_over_d=true), seed=3)
    ((_, measured),) = drawn_matrices([draw])
    about = instrument_of(draw, measured)
    wfs = replace(about.wfs, **{KEY: 3.0 if stated is None else stated})
    unknown = (f"wfs.{KEY}",) if stated is None else ()
    found = fit_matrix(
        replace(about, wfs=wfs, unknown=unknown), Reference(matrix=measured.matrix), FitOptions()
    )
    (modulation,) = (one for one in found.optics if one.key == KEY)
    return found, found.alpha.vector - draw.alpha.vector, modulation


@pytest.mark.parametrize(
    ("true", "stated"),
    [(0.0, None), (0.5, None), (0.5, 0.0), pytest.param(0.0, 0.0, marks=pytest.mark.long)],
)
def test_a_modulation_below_one_is_found_whatever_the_file_says(true, stated):
    found, error, modulation = fitted(true, stated)
    assert found.accepted
    assert np.all(np.abs(error) < 3.0 * found.sigma)
    assert np.all(np.abs(error) < [0.003, 0.003, np.deg2rad(0.02), 0.003])
    assert modulation.found == pytest.approx(true, abs=0.15)
    assert 0.0 < modulation.found_sigma < 0.2


def test_a_stated_modulation_of_none_is_questioned():
    found, error, modulation = fitted(3.0, 0.0)
    assert modulation.found == pytest.approx(3.0, rel=0.03)
    assert np.all(np.abs(error) < [0.003, 0.003, np.deg2rad(0.02), 0.003])
    assert f"{KEY} = 3" in found.recommendation


def test_a_signal_that_the_model_cannot_explain_makes_the_modulation_uncertain():
    """Halves of PAPYRUS's modes are 10.45 and 11.62 λ/D: within 2 σ of their difference."""
    models = SimpleNamespace(
        sensor_key=KEY, sensor_number=10.5, coupling=None, exact=lambda _: True
    )
    nuisances = SimpleNamespace(
        changes=lambda _: {Optic.SENSOR: 0.0}, first_optic=0, unknown=frozenset()
    )
    settled = SimpleNamespace(nuisances=nuisances, solution=SimpleNamespace(nuisances=None))
    sure = SimpleNamespace(nuisance_sigma=[0.01])
    clean, unexplained = (
        list_optics(models, settled, sure, structure)[0].found_sigma for structure in (0.005, 0.12)
    )
    assert clean == pytest.approx(0.105, rel=0.05)
    assert 11.62 - 10.45 < 2.0 * np.sqrt(2.0) * unexplained < 2.0


def test_the_coordinate_is_the_logarithm_or_the_square_and_ends_at_none():
    for number in (0.0, 0.3, 0.999, 1.001, 3.0):
        assert moved_sensor_number(number, 0.0) == pytest.approx(number)
    assert moved_sensor_number(2.0, np.log(3.0)) == pytest.approx(6.0)
    assert moved_sensor_number(0.0, 0.02) == pytest.approx(LOGARITHM_ABOVE * 0.2)
    assert moved_sensor_number(3.0, -50.0) == 0.0
    step = 1e-6
    below, above = (
        (sensor_coordinate(LOGARITHM_ABOVE + side * step) - sensor_coordinate(LOGARITHM_ABOVE))
        for side in (-1.0, 1.0)
    )
    assert -below == pytest.approx(above, rel=1e-5)


AXES, ANGLE_DEG = (3.0, 4.0), 25.0


@cache
def elliptic():
    """A bench modulated on an ellipse, and its matrix of the FFT pyramid."""
    draw = Draw(code="fft", condition=Condition(), seed=3)
    model, told = model_of(draw.telescope), draw.bench
    pyramid = EllipticPyramid(
        amplitude=model.pupil.amplitude,
        sampling=4,
        wavelength_m=told.wavelength_m,
        n_subapertures=N,
        image_separation_subap=SEPARATION,
        axes_lambda_over_d=AXES,
        angle_deg=ANGLE_DEG,
        n_modulation=40,
        n_nodes=3,
        padded_subap=6 * N,
    )
    matrix = pyramid.jacobian(draw.shapes_m, model.valid, told.image_shift_subap)
    ((_, round_one),) = drawn_matrices([draw])
    return draw, instrument_of(draw, round_one), Reference(matrix=matrix)


def test_an_elliptic_modulation_is_found_where_the_file_calls_it_unknown():
    draw, about, reference = elliptic()
    wfs = replace(about.wfs, **{KEY: 4.0})
    unknown = (f"wfs.{KEY}", "wfs.modulation_ellipse")
    found = fit_matrix(replace(about, wfs=wfs, unknown=unknown), reference, FitOptions())
    assert found.accepted
    assert np.all(np.abs(found.alpha.vector - draw.alpha.vector) < 3.0 * found.sigma)
    assert found.residual_fraction < 0.02
    (entry,) = (one.entry for one in found.origins if one.key == "modulation_ellipse")
    assert not any(one.key == KEY for one in found.origins)
    ellipse = tomllib.loads(entry)["modulation_ellipse"]
    assert ellipse["axes_lambda_over_d"] == pytest.approx([4.0, 3.0], rel=0.01)
    assert ellipse["angle_deg"] == pytest.approx(ANGLE_DEG + 90.0, abs=1.0)
    # what is advised is a file that can be read
    assert found.corrections["wfs.modulation_ellipse"] == ellipse
    assert found.corrections[f"wfs.{KEY}"] is None


def test_a_circle_that_is_none_is_named():
    _, about, reference = elliptic()
    found = fit_matrix(about, reference, FitOptions())
    (named,) = (one for one in found.alternatives if one.key == 'modulation_ellipse = "unknown"')
    assert named.preferred
    assert named.misfit < 0.2
    assert named.key in found.recommendation


def test_a_circle_is_not_taken_for_an_ellipse():
    found, _, _ = fitted(3.0, 3.0)
    assert not any("ellipse" in one.key for one in found.alternatives)
    assert not any("rooftop" in one.key for one in found.alternatives)


def test_axes_are_searched_with_other_modulations_where_an_unknown_one_shows_none(monkeypatch):
    """So a bench of 36 subapertures, unmodulated and turned by half a turn, was refused."""
    _, about, reference = elliptic()
    searched = []

    def find_axes(about, *_):
        searched.append(about.wfs.modulation_lambda_over_d)
        return about.slopes, None, AxesDoubt("none" if searched[-1] else ""), None

    monkeypatch.setattr(fit_matrix_module, "_find_axes", find_axes)
    find = partial(
        fit_matrix_module._find_axes_and_sensor,
        usable=reference,
        basis=None,
        options=FitOptions(),
        mapper=map,
    )
    found, _ = find(replace(about, unknown=(f"wfs.{KEY}",)))
    assert found.wfs.modulation_lambda_over_d == 0.0
    assert searched == [3.0, 0.0]
    assert find(about)[0] is about
    assert searched[2:] == [3.0]
