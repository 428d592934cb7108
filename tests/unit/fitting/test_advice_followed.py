"""Each piece of advice that names a key of the instrument file, followed once as it stands.

A matrix is made for one instrument file and fitted with another that differs in one thing. What the
fit advises is written into that file, by its key, without any thought; the second fit must then be
accepted and right. Where nothing is advised, the first fit must be.
"""

import re
import tomllib
from dataclasses import dataclass, replace

import h5py
import numpy as np
import pytest

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from service.errors import MatrixError
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import rtc_valid_subapertures

EXPLAIN = FitOptions(explain=True)

ALPHA = Misregistration(
    shift_x_subap=0.21, shift_y_subap=-0.12, rotation_rad=0.012, magnification=1.004
)
NOISE = 0.003
"""1 sigma of a slope, of the largest."""

LENSLETS = {
    "instrument": {"name": "bench", "diameter_m": 4.0, "stop": "telescope"},
    "wfs": {"kind": "shack-hartmann", "n_subapertures": 10, "wavelength_m": 650e-9},
    "mirror": {
        "layout": "grid",
        "n_across": 8,
        "pitch_m": 0.6,
        "diameter_m": 4.9,
        "influence": "gaussian",
        "coupling": 0.3,
        "basis": "zonal",
    },
    "slopes": {"orientation": {"sign": 1}},
}
PYRAMID = LENSLETS | {
    "wfs": {
        "kind": "pyramid",
        "n_subapertures": 10,
        "wavelength_m": 650e-9,
        "modulation_lambda_over_d": 3.0,
    }
}
SECTION = {
    "stop": "instrument",
    "obscuration_ratio": "instrument",
    "double_pass": "instrument",
    "order": "slopes",
    "orientation": "slopes",
    "normalisation": "slopes",
    "coupling": "mirror",
    "influence": "mirror",
    "stroke": "mirror",
    "pupil_diameter_subap": "wfs",
    "spiders_m": "instrument",
    "spiders_deg": "instrument",
    "modulation_lambda_over_d": "wfs",
    "wavelength_m": "wfs",
}
"""Where each key stands that advice names."""


def changed(tables, **keys):
    made = {name: dict(table) for name, table in tables.items()}
    for key, value in keys.items():
        made[SECTION[key]][key] = value
    return made


def as_toml(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {as_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


def loaded(folder, tables, mask=None):
    """Return the instrument of these tables, with a mask of its own if one is given."""
    lines = []
    for name, table in tables.items():
        lines += [f"[{name}]", *(f"{key} = {as_toml(value)}" for key, value in table.items())]
        if name == "wfs" and mask is not None:
            lines.append('valid_subapertures = "mask.h5:/valid"')
    if mask is not None:
        with h5py.File(folder / "mask.h5", "w") as file:
            file["valid"] = mask.astype(np.uint8)
    path = folder / "bench.toml"
    path.write_text("\n".join(lines))
    return load_instrument(path)


def mask_of(diameter):
    x = np.arange(10) - 4.5
    return np.hypot(x, x[:, None]) <= diameter / 2.0


def measured(about, spoil=lambda values: values):
    model = RtcInteractionModel(about, modal_basis(about), pupil_sampling=4, detector_nodes=4)
    values = np.asarray(model.interaction_matrix(ALPHA), float)
    scatter = np.random.default_rng(4).normal(size=values.shape)
    return spoil(values) + NOISE * np.abs(spoil(values)).max() * scatter


_ADVICE = re.compile(r"\b([a-z_]+) = (\"[a-z-]+\"|[-+.\de]+|true|false|\{[^}]*\})")


def first_line_of(found):
    """Return the values that the first line of a fit advises by their keys."""
    return {
        key: tomllib.loads(f"it = {value.rstrip('.')}")["it"]
        for key, value in _ADVICE.findall(found.recommendation)
        if key in SECTION
    }


def advice_of(found):
    """Return the first value that the fit advises for each key."""
    said = (found.recommendation, found.verdict, *found.remarks)
    listed = {}
    for sentence in said:
        for key, value in _ADVICE.findall(sentence):
            if key in SECTION:
                listed.setdefault(key, tomllib.loads(f"it = {value.rstrip('.')}")["it"])
    for one in found.origins:
        if one.correct and one.key in SECTION:
            value = tomllib.loads(f"it = {one.found.partition(' +-')[0]}")["it"]
            listed.setdefault(one.key, value)
    return listed


@dataclass(frozen=True, kw_only=True)
class Case:
    """One thing that a file does not say rightly, and the key that the advice names."""

    key: str
    true: dict
    stated: dict
    base: dict = None
    spoil: object = staticmethod(lambda values: values)
    mask: float | None = None
    advised: bool = True
    """Whether the matrix shows it clearly enough to be advised; else sigma must cover it."""

    scale: float = 1.0
    """Diameter of the true pupil over that of the stated one, which the magnification refers to."""


WITHOUT_COUPLING = LENSLETS | {
    "mirror": {key: value for key, value in LENSLETS["mirror"].items() if key != "coupling"}
}

CASES = {
    "stop, mirror": Case(key="stop", true={"stop": "mirror"}, stated={"stop": "telescope"}),
    "stop, telescope": Case(
        key="stop", true={"stop": "telescope"}, stated={"stop": "mirror"}, advised=False
    ),
    "obscuration": Case(
        key="obscuration_ratio",
        true={"obscuration_ratio": 0.3},
        stated={"obscuration_ratio": 0.1},
        mask=10.0,
        advised=False,
    ),
    "pupil diameter": Case(
        key="pupil_diameter_subap",
        true={"pupil_diameter_subap": 9.6},
        stated={"pupil_diameter_subap": 10.0},
        mask=9.6,
        advised=False,
        scale=0.96,
    ),
    "coupling": Case(key="coupling", true={"coupling": 0.2}, stated={"coupling": 0.4}),
    "coupling unknown": Case(
        key="coupling", true={"coupling": 0.2}, stated={"coupling": "unknown"}
    ),
    "influence": Case(
        key="influence",
        true={"influence": "thin-plate"},
        stated={"influence": "gaussian"},
        base=WITHOUT_COUPLING,
    ),
    "order": Case(
        key="order",
        true={"order": "yx"},
        stated={"order": "xy", "orientation": "auto"},
    ),
    "modulation": Case(
        key="modulation_lambda_over_d",
        true={"modulation_lambda_over_d": 5.0},
        stated={"modulation_lambda_over_d": 3.0},
        base=PYRAMID,
    ),
    "normalisation, global": Case(
        key="normalisation",
        true={"normalisation": "global"},
        stated={"normalisation": "local"},
        base=PYRAMID,
    ),
    "normalisation, local": Case(
        key="normalisation",
        true={"normalisation": "local"},
        stated={"normalisation": "global"},
        base=PYRAMID,
    ),
    "spiders": Case(
        key="spiders_m",
        true={"spiders_m": 0.15, "spiders_deg": [0.0, 90.0, 180.0, 270.0]},
        stated={},
        advised=False,
    ),
    "modulation unknown": Case(
        key="modulation_lambda_over_d",
        true={"modulation_lambda_over_d": 5.0},
        stated={"modulation_lambda_over_d": "unknown"},
        base=PYRAMID,
    ),
    "wavelength unknown": Case(
        key="wavelength_m", true={"wavelength_m": 650e-9}, stated={"wavelength_m": "unknown"}
    ),
    "double pass": Case(key="double_pass", true={}, stated={}, spoil=lambda values: 2.0 * values),
    "gains that scatter": Case(
        key="stroke",
        true={},
        stated={},
        spoil=lambda values: values * np.geomspace(0.2, 5.0, values.shape[1]),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_advice_followed_once_gives_a_fit_that_is_accepted_and_right(name, tmp_path):
    case = CASES[name]
    base = case.base or LENSLETS
    mask = None if case.mask is None else mask_of(case.mask)
    true = loaded(tmp_path, changed(base, **case.true), mask)
    values = measured(true, case.spoil)
    stated = changed(base, **case.stated)
    about = loaded(tmp_path, stated, mask)
    first = fit_matrix(about, Reference(matrix=values, double_pass=about.double_pass), EXPLAIN)
    advice = advice_of(first)
    if not case.advised:
        assert case.key not in advice
        check_right(first, case.scale)
        return
    assert case.key in advice
    if not first.accepted:
        assert first_line_of(first) == {case.key: advice[case.key]}
    about = loaded(tmp_path, changed(stated, **{case.key: advice[case.key]}), mask)
    check_right(fit_matrix(about, Reference(matrix=values, double_pass=about.double_pass), EXPLAIN))


def fitted(about, values, modes=None, **options):
    reference = Reference(matrix=values, modes=modes, double_pass=about.double_pass)
    return fit_matrix(about, reference, FitOptions(explain=True, **options))


def test_a_pupil_that_is_narrower_than_the_file_says_is_named_with_its_width(tmp_path):
    """The width is seen in whole subapertures; sigma of the magnification covers the rest."""
    everywhere = mask_of(10.0)
    true = loaded(tmp_path, changed(LENSLETS, pupil_diameter_subap=8.0), everywhere)
    values = measured(true)
    first = fitted(loaded(tmp_path, LENSLETS, everywhere), values)
    assert not first.accepted
    (width,) = re.findall(r"looks (\d+) subapertures wide", first.recommendation)
    assert "pupil_diameter_subap" in first.recommendation
    stated = changed(LENSLETS, pupil_diameter_subap=float(width))
    found = fitted(loaded(tmp_path, stated, everywhere), values)
    assert found.accepted
    true_vector = ALPHA.vector * [1.0, 1.0, 1.0, 8.0 / float(width)]
    assert np.all(np.abs(found.alpha.vector - true_vector) < 3.0 * found.sigma)


def test_a_pupil_off_the_middle_is_named_and_right_once_it_is_written(tmp_path):
    about = loaded(tmp_path, LENSLETS)
    values = measured(replace(about, pupil_shift_subap=(0.3, 0.1)))
    first = fitted(about, values)
    check_right(first)
    (x, y) = re.search(
        r"the pupil ([-+.\d]+), ([-+.\d]+) subapertures off", str(first.remarks)
    ).groups()
    followed = fitted(replace(about, pupil_shift_subap=(float(x), float(y))), values)
    check_right(followed)
    assert followed.residual_fraction < first.residual_fraction


def test_uneven_light_is_right_with_a_gain_map_and_with_the_light(tmp_path):
    about = loaded(tmp_path, LENSLETS)
    valid = rtc_valid_subapertures(about)
    y, x = (np.stack(np.nonzero(valid)) - 4.5) / 5.0
    uneven = np.tile(1.0 - 0.6 * (x**2 + y**2), 2)[:, np.newaxis]
    values = measured(about, lambda matrix: matrix * uneven)
    first = fitted(about, values)
    assert "--gain-map" in " ".join(first.remarks)
    check_right(fitted(about, values, gain_map=True))


@pytest.mark.parametrize(
    ("words", "spoilt", "columns"),
    [
        (
            "first column is additional",
            lambda m: np.column_stack([m.mean(axis=1), m]),
            slice(1, None),
        ),
        ("first column is missing", lambda m: m[:, 1:], slice(None)),
    ],
)
def test_columns_one_place_off_are_right_once_they_are_listed_as_advised(
    words, spoilt, columns, tmp_path
):
    about = loaded(tmp_path, LENSLETS)
    n_modes = modal_basis(about).n_modes
    values = spoilt(measured(about))
    listed = np.arange(min(values.shape[1], n_modes))
    first = fitted(about, values[:, listed], listed)
    assert not first.accepted
    assert words in first.recommendation
    missing = "missing" in words
    places = listed if missing else listed[:-1]
    modes = places + 1 if missing else places
    check_right(fitted(about, values[:, columns][:, : len(modes)], modes))


@pytest.mark.parametrize(
    ("unit", "words"),
    [(650e-9, "per wave of OPD"), (650e-9 / (2.0 * np.pi), "per radian of phase")],
)
def test_a_matrix_in_waves_or_radians_is_refused_by_those_names(unit, words, tmp_path):
    about = loaded(tmp_path, LENSLETS)
    values = measured(about) * unit
    with pytest.raises(MatrixError, match=words):
        fitted(about, values)
    check_right(fitted(about, values / unit))


def test_a_matrix_of_both_passes_is_right_once_it_is_divided_by_the_number_named(tmp_path):
    about = loaded(tmp_path, LENSLETS)
    values = measured(about) * 4.0
    (named,) = re.findall(r"divide it by ([\d.]+)", " ".join(fitted(about, values).remarks))
    found = fitted(about, values / float(named))
    check_right(found)
    assert np.median(found.gains) == pytest.approx(1.0, abs=0.01)


def check_right(found, scale=1.0):
    true = ALPHA.vector * [1.0, 1.0, 1.0, scale]
    assert found.accepted, found.verdict
    assert np.all(np.abs(found.alpha.vector - true) < 3.0 * found.sigma)
