"""Each piece of advice that names a key of the instrument file, followed once as it stands.

A matrix is made for one instrument file and fitted with another that differs in one thing. What the
fit advises is written into that file, by its key, without any thought; the second fit must then be
accepted and right. Where nothing is advised, the first fit must be.
"""

import json
import re
import tomllib
from dataclasses import dataclass, replace

import h5py
import numpy as np
import pytest

from pyrcal.__main__ import main
from pyrcal.fitting.advice import Advice
from pyrcal.fitting.matrix import LIGHT_FOUND_WORDS, FitOptions, Method, fit_matrix
from pyrcal_studies.advice_followed import PROVOCATIONS, follow, measure
from pyrcal_studies.drawn_fits import Draw
from pyrcal_studies.fft_pyramid import FftPyramid
from service.errors import MatrixError, ModelError
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import Illumination, rtc_valid_subapertures
from tests.support.lamps import counts_of

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


def measured(about, spoil=lambda values: values, *, alpha=ALPHA, illumination=None):
    model = RtcInteractionModel(
        about,
        modal_basis(about),
        pupil_sampling=4,
        detector_nodes=4,
        illumination=illumination,
    )
    values = np.asarray(model.interaction_matrix(alpha), float)
    scatter = np.random.default_rng(4).normal(size=values.shape)
    return spoil(values) + NOISE * np.abs(spoil(values)).max() * scatter


_ADVICE = re.compile(r"\b([a-z_]+) = (\"[a-z-]+\"|[-+.\de]+|true|false|\{[^}]*\})")


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
        assert first.corrections == {f"{SECTION[case.key]}.{case.key}": advice[case.key]}
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


def test_uneven_light_is_right_with_a_gain_map(tmp_path):
    about = loaded(tmp_path, LENSLETS)
    valid = rtc_valid_subapertures(about)
    y, x = (np.stack(np.nonzero(valid)) - 4.5) / 5.0
    uneven = np.tile(1.0 - 0.6 * (x**2 + y**2), 2)[:, np.newaxis]
    values = measured(about, lambda matrix: matrix * uneven)
    first = fitted(about, values)
    assert LIGHT_FOUND_WORDS in first.remarks
    check_right(first)
    even = fitted(about, values, find_light=False)
    assert "--gain-map" in " ".join(even.remarks)
    check_right(fitted(about, values, gain_map=True))


def command(capsys, *words):
    """Type ``pyrcal fit``; return its exit status, its JSON document, and the errors."""
    status = main(["fit", *map(str, words), "--json"])
    said = capsys.readouterr()
    return status, json.loads(said.out or "{}"), said.err


def cut_out(frame):
    """Return the four pupil images of a frame ``(2n, 2n)`` in the order of its rows and columns."""
    upper, lower = np.split(frame, 2)
    return np.stack([image for rows in (upper, lower) for image in np.split(rows, 2, axis=1)])


@pytest.mark.parametrize("flip_y", [False, True])
def test_uneven_light_is_right_with_a_file_of_the_light(flip_y, tmp_path, capsys):
    """A beam that fades outwards and along x; the detector may be read from its top row.

    The file of the orientation says "auto", so the advice of the first fit leads to a second one,
    which asks for the orientation found; with both the fit is accepted and right.
    """
    x = np.linspace(-6.0, 6.0, 49)
    fading = 1.0 - 0.7 * (x[:, np.newaxis] ** 2 + x**2) / 25.0 + 0.05 * x
    light = Illumination(coordinates=x, intensity=np.maximum(fading, 0.05))
    true = {"swap_xy": False, "flip_x": False, "flip_y": flip_y, "sign": 1}
    about = loaded(tmp_path, changed(PYRAMID, orientation=true))
    with h5py.File(tmp_path / "im.h5", "w") as file:
        file["interaction_matrix"] = values = measured(about, illumination=light)
    images = counts_of(about, light=light).reshape(2, 2, 10, 10)
    frame = images.transpose(0, 2, 1, 3).reshape(20, 20)
    with h5py.File(tmp_path / "flux.h5", "w") as file:
        file["flux"] = cut_out(frame[::-1] if flip_y else frame)

    stated = changed(PYRAMID, orientation="auto")
    loaded(tmp_path, stated)
    bench, matrix = tmp_path / "bench.toml", tmp_path / "im.h5"
    with_map = (bench, matrix, "--flux-map", tmp_path / "flux.h5")
    _, first, _ = command(capsys, bench, matrix)
    assert "--flux-map" in " ".join(first["notes"])
    status, _, err = command(capsys, *with_map)
    assert status == 2
    assert "copy the orientation found" in err
    order = first["orientation"].pop("order")
    loaded(tmp_path, changed(stated, order=order, orientation=first["orientation"]))
    status, found, _ = command(capsys, *with_map)
    assert status == 0
    for name, value in ALPHA.to_boundary().items():
        assert abs(found[name] - value) < 3.0 * found["sigma"][name], name
    # The first fit has found most of the light in the matrix.
    assert found["residual_fraction"] < first["residual_fraction"] < 0.07
    even = fitted(load_instrument(bench), values, find_light=False)
    assert found["residual_fraction"] < 0.4 * even.residual_fraction


def test_modes_measured_at_another_registration_are_right_once_they_are_left_out(tmp_path):
    """Two of 52 were pushed after the mirror had moved by half a subaperture."""
    about = loaded(tmp_path, LENSLETS)
    moved = replace(ALPHA, shift_x_subap=ALPHA.shift_x_subap + 0.5)
    values, later = measured(about), measured(about, alpha=moved)
    values[:, [0, 48]] = later[:, [0, 48]]
    first = fitted(about, values)
    assert not first.accepted
    assert "(--modes)" in first.recommendation
    (named,) = re.findall(r"than the others: (.*) left over", first.recommendation)
    left_out = [int(mode) for mode in re.findall(r"(\d+) \(", named)]
    assert sorted(left_out) == [0, 48]
    modes = np.setdiff1d(np.arange(values.shape[1]), left_out)
    check_right(fitted(about, values[:, modes], modes))


def test_a_start_from_which_the_paper_s_method_is_lost_is_right_once_it_is_left_out(
    tmp_path, capfd
):
    about = loaded(tmp_path, LENSLETS)
    values = measured(about)
    far = Misregistration(shift_x_subap=4.0, rotation_rad=1.2)
    with pytest.raises(ModelError, match="--start"):
        fitted(about, values, method=Method.PAPER, start=far)
    assert capfd.readouterr().out == ""  # LAPACK's own lines would spoil a JSON document
    check_right(fitted(about, values, method=Method.PAPER))
    near = Misregistration(shift_x_subap=1.5, rotation_rad=0.3)
    check_right(fitted(about, values, method=Method.PAPER, start=near))


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
    [
        (650e-9, "per wave of OPD"),
        (650e-9 / (2.0 * np.pi), "per radian of phase"),
        (1e-6, "per micrometre"),
        (1e-9, "per nanometre"),
    ],
)
def test_a_matrix_in_another_unit_is_refused_by_its_name_and_right_once_converted(
    unit, words, tmp_path
):
    about = loaded(tmp_path, LENSLETS)
    values = measured(about) * unit
    with pytest.raises(MatrixError, match=words):
        fitted(about, values)
    check_right(fitted(about, values / unit))


def test_a_matrix_per_millimetre_is_right_once_it_is_multiplied_by_the_number_named(tmp_path):
    about = loaded(tmp_path, LENSLETS)
    values = measured(about) * 1e-3
    first = fitted(about, values)
    assert not first.accepted
    (factor,) = re.findall(r"per millimetre: multiply it by (\d+)", first.recommendation)
    check_right(fitted(about, values * float(factor)))


def test_a_matrix_of_both_passes_is_right_once_it_is_divided_by_the_number_named(tmp_path):
    about = loaded(tmp_path, LENSLETS)
    values = measured(about) * 4.0
    (named,) = re.findall(r"divide it by ([\d.]+)", " ".join(fitted(about, values).remarks))
    found = fitted(about, values / float(named))
    check_right(found)
    assert np.median(found.gains) == pytest.approx(1.0, abs=0.01)


NARROW = PYRAMID | {
    "mirror": PYRAMID["mirror"] | {"pitch_m": 0.4, "n_across": 12, "diameter_m": 4.6},
    "wfs": PYRAMID["wfs"] | {"modulation_lambda_over_d": 1.0},
}


def poked(about, stroke_m, *, pull):
    """Return the matrix that an FFT pyramid measures with pokes of this stroke."""
    basis, wfs = modal_basis(about), about.wfs
    model = RtcInteractionModel(about, basis, pupil_sampling=4, detector_nodes=2)
    sensor = FftPyramid(
        amplitude=model.pupil.amplitude,
        sampling=4,
        wavelength_m=wfs.wavelength_m,
        n_subapertures=wfs.n_subapertures,
        image_separation_subap=wfs.pupil_separation_subap,
        modulation_lambda_over_d=wfs.modulation_lambda_over_d,
        n_modulation=16,
        padded_subap=60,
    )
    u = sensor.coordinates
    points = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    # on_mirror turns and scales; the shift is taken off before
    shapes = basis.render(ALPHA.on_mirror(points - ALPHA.vector[:2]))
    maps = stroke_m * shapes.T.reshape(-1, len(u), len(u))
    if pull:
        return sensor.jacobian(maps, model.valid, stroke_m=1.0) / stroke_m
    flat = sensor.slopes(np.zeros_like(maps[0]), model.valid)
    return np.stack([sensor.slopes(one, model.valid) - flat for one in maps], axis=1) / stroke_m


def test_pokes_beyond_the_linear_range_are_right_once_they_are_smaller(tmp_path):
    """Averaging does not help: hardly any of the 13 % that is left over is noise."""
    about = loaded(tmp_path, NARROW)
    first = fitted(about, poked(about, 300e-9, pull=False))
    check_right(first)
    assert first.recommendation.startswith(f"{Advice.MEASURE_MORE}:")
    assert "smaller stroke" in first.recommendation
    assert "average more" not in first.recommendation
    followed = fitted(about, poked(about, 40e-9, pull=True))
    check_right(followed)
    assert followed.recommendation.startswith(f"{Advice.USE}:")
    assert np.all(followed.sigma < 0.5 * first.sigma)


def check_right(found, scale=1.0):
    true = ALPHA.vector * [1.0, 1.0, 1.0, scale]
    assert found.accepted, found.verdict
    assert np.all(np.abs(found.alpha.vector - true) < 3.0 * found.sigma)


@pytest.mark.parametrize(
    ("provocation", "seed", "advice"),
    [
        # Found on the coarse grid, a turn was 0.4 to 0.8 deg beyond the right one.
        ("arms turned by 1 deg", 701, "spiders_deg"),
        ("map turned by 6 deg", 707, "pupil"),
    ],
)
def test_advice_on_a_drawn_matrix_followed_once_is_accepted_and_right(provocation, seed, advice):
    draw = Draw(code="fft", condition=PROVOCATIONS[provocation].condition, seed=seed)
    (row,) = follow(provocation, draw, measure(draw))
    assert row["advice"] == advice
    assert row["followed"]["accepted"]
    assert row["followed"]["worst"] < 3.0


def test_light_that_fades_outwards_in_a_drawn_matrix_is_found_and_no_narrower_pupil():
    draw = Draw(code="fft", condition=PROVOCATIONS["uneven light"].condition, seed=701)
    (row,) = follow("uneven light", draw, measure(draw))
    assert row["advice"] == ""
    assert row["first"]["accepted"]
    assert row["first"]["worst"] < 3.0
