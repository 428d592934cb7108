"""Follow each piece of advice of a fit once, as it is printed, on matrices with known truth.

Each provocation is a matrix of ``pyrcal_studies.drawn_fits`` with an instrument file that has one
wrong value, or with one fault of the matrix. Instrument file and matrix are written, read and
fitted as ``pyrcal fit`` does. Values that the fit recommends (``Fit.corrections``) are written into
the file; what is to be done with the matrix is done by ``REMEDIES``. Then it is fitted again.

``python -m pyrcal_studies.advice_followed --codes fft --draws 2`` appends a line of JSON for each
provocation and draw to ``var/drawn/advice.jsonl``, and prints the table of all that is there.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.fitting.alternatives import LIGHT_KEY
from pyrcal.fitting.fit_file import fit_file
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import FitOptions
from pyrcal.importers.imported import Imported, in_arrays_file
from pyrcal_studies.campaign.rows import RowFile
from pyrcal_studies.drawn_fits import (
    AS_IT_IS,
    CODES,
    FOLDER,
    MAX_SIGMA,
    TOLD,
    Condition,
    Draw,
    error,
    instrument_of,
    measured,
)
from pyrcal_studies.peers_pushpull import Measured
from pyrcal_studies.shared import study_parser
from service.errors import ConfigurationError, MatrixError, ModelError
from service.instrument import load_instrument
from service.model.kinds import Influence
from service.model.sensors.pyramid.description import pyramid_in

Array = NDArray[Any]
Tables = dict[str, dict[str, Any]]

NOISE_RATIO, STROKE_RATIO = 8.0, 5.0
"""How much less noise a matrix has after more averaging, and how much smaller its strokes are."""

TURNED_WAYS: dict[str, Callable[[Array], Array]] = {
    "turned by 90 deg": lambda lit: np.rot90(lit, -1),
    "turned by 180 deg": lambda lit: np.rot90(lit, -2),
    "turned by 270 deg": lambda lit: np.rot90(lit, -3),
    "mirrored along x": lambda lit: lit[:, ::-1],
    "mirrored along y": lambda lit: lit[::-1],
    "mirrored at a diagonal": lambda lit: lit.T,
    "mirrored at the other diagonal": lambda lit: lit[::-1, ::-1].T,
}
"""What is done with a pupil map, by the words that a fit has for it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Case:
    """An instrument file and a matrix file before they are written, and options of the fit."""

    draw: Draw
    tables: Tables
    arrays: dict[str, Array]
    options: FitOptions = field(default_factory=FitOptions)

    whole: dict[str, Array] = field(default_factory=dict)
    """Arrays as they were before a part was left out."""

    def fit(self) -> Fit:
        """Return the fit of the files, written as an importer writes them."""
        made = Imported(source="a draw", tables=self.tables, arrays=self.arrays)
        with tempfile.TemporaryDirectory() as folder:
            saved = made.save(folder)
            return fit_file(
                load_instrument(saved.instrument), saved.matrix, self.options, threads=1
            ).fit

    def worst(self, found: Fit) -> float:
        """Return the largest error over σ, of a magnification in the width of the pupil stated."""
        told = TOLD[self.draw.condition.told]
        n = self.draw.bench.n_subapertures
        wide = self.tables["wfs"].get("pupil_diameter_subap", n) / n
        told = replace(told, size=wide if "pupil image" in told.words else wide * told.size)
        return float(np.max(np.abs(error(found.alpha, self.draw.alpha, told) / found.sigma)))

    def with_values(self, values: Mapping[str, Any]) -> Case:
        """Return the case with values in its instrument file; None removes a key."""
        tables, arrays = {name: dict(table) for name, table in self.tables.items()}, self.arrays
        for place, value in values.items():
            table, key = place.split(".")
            if place == "instrument.pupil":
                arrays = {**arrays, "pupil": _turned(arrays["pupil"], value)}
            elif value is None:
                tables[table].pop(key, None)
            else:
                tables[table][key] = value
        return replace(self, tables=tables, arrays=arrays)

    def with_columns(self, matrix: Array, modes: Array | None = None) -> Case:
        """Return the case with another matrix, whose columns are of these modes."""
        changed = {"interaction_matrix": matrix} | ({} if modes is None else {"modes": modes})
        return replace(self, arrays={**self.arrays, **changed}, whole=self.arrays)

    def measured_again(self, **condition: Any) -> Case:  # noqa: ANN401 - fields of a condition
        """Return the case with a matrix measured in another way."""
        draw = replace(self.draw, condition=replace(self.draw.condition, **condition))
        return replace(self.with_columns(measure(draw).matrix), draw=draw)

    @property
    def matrix(self) -> Array:
        """``(n_slopes, n_modes)`` as measured."""
        return self.arrays["interaction_matrix"]


def _turned(lit: Array, way: str) -> Array:
    """Return a pupil map as a fit advises; other angles as an image editor turns."""
    if way in TURNED_WAYS:
        return TURNED_WAYS[way](lit)
    angle = float(way.removeprefix("turned by ").removesuffix(" deg"))
    turned = scipy.ndimage.rotate(lit, -angle, reshape=False, order=1)
    return np.asarray(np.clip(turned, 0.0, 1.0))


def measure(draw: Draw) -> Measured:
    """Return the matrix of a draw, which does not depend on what its instrument file says."""
    return _measure(replace(draw, condition=replace(draw.condition, told=AS_IT_IS.words)))


@cache
def _measure(draw: Draw) -> Measured:
    ((_, found),) = measured([draw])
    return found


def describe(draw: Draw, found: Measured) -> Case:
    """Return the files that a user of the code would write."""
    about = instrument_of(draw, found)
    mirror, wfs = about.analytic_mirror, pyramid_in(about)
    arrays = {
        "interaction_matrix": found.matrix,
        "valid": found.valid.astype(np.uint8),
        "positions": mirror.positions_m,
        "mode_to_actuator": np.asarray(mirror.mode_to_actuator),
    }
    instrument: dict[str, Any] = {
        "name": "drawn",
        "diameter_m": about.diameter_m,
        "stop": str(about.stop),
        "double_pass": False,
    }
    if about.pupil is not None:
        arrays["pupil"] = about.pupil.lit
        instrument |= {"pupil": in_arrays_file("pupil"), "pupil_pitch_m": about.pupil.pitch_m}
    else:
        instrument["obscuration_ratio"] = about.obscuration_ratio
    if about.spiders_deg:
        instrument |= {"spiders_m": about.spiders_m, "spiders_deg": list(about.spiders_deg)}
    sensor: dict[str, Any] = {
        "kind": "pyramid",
        "n_subapertures": wfs.n_subapertures,
        "pupil_separation_subap": wfs.pupil_separation_subap,
        "wavelength_m": wfs.wavelength_m,
        "modulation_lambda_over_d": wfs.modulation_lambda_over_d,
        "valid_subapertures": in_arrays_file("valid"),
    }
    if wfs.pupil_diameter != wfs.n_subapertures:
        sensor["pupil_diameter_subap"] = wfs.pupil_diameter
    if wfs.image_offsets_subap is not None:
        sensor["image_offsets_px"] = [list(one) for one in wfs.image_offsets_subap]
    drawn: dict[str, Any] = {
        "layout": "positions",
        "positions": in_arrays_file("positions"),
        "pitch_m": mirror.pitch_m,
        "influence": str(mirror.shape.influence),
        "mode_to_actuator": in_arrays_file("mode_to_actuator"),
    }
    if mirror.shape.influence is Influence.GAUSSIAN:
        drawn["coupling"] = mirror.shape.coupling
    slopes = {
        "order": str(about.slopes.order),
        "orientation": "auto" if about.slopes.orientation is None else {"sign": 1},
        "normalisation": str(about.slopes.normalisation),
    }
    tables = {"instrument": instrument, "wfs": sensor, "mirror": drawn, "slopes": slopes}
    return Case(draw=draw, tables=tables, arrays=arrays)


# --- what provokes advice

Spoil = Callable[[Case], Case]


@dataclass(frozen=True, slots=True, kw_only=True)
class Provocation:
    """One thing that is wrong."""

    condition: Condition = field(default_factory=Condition)
    values: Mapping[str, Any] = field(default_factory=dict)
    """Values of the instrument file."""

    spoil: Spoil | None = None
    """Fault of the matrix; None if it has none."""

    peers: bool = True
    """True if other codes are of interest: the fault is not one of the matrix alone."""


def _scaled(by: float) -> Spoil:
    return lambda case: case.with_columns(case.matrix * by)


def _scale_modes(case: Case) -> Case:
    factors = np.exp(np.random.default_rng(case.draw.seed).normal(0.0, 0.6, case.matrix.shape[1]))
    return case.with_columns(case.matrix * factors)


def _normalise(case: Case) -> Case:
    return case.with_columns(case.matrix / np.linalg.norm(case.matrix, axis=0) * 1e6)


def _turn_two(case: Case) -> Case:
    signs = np.ones(case.matrix.shape[1])
    signs[[3, 8]] = -1.0
    return case.with_columns(case.matrix * signs)


def _smear(case: Case) -> Case:
    smeared = np.array(case.matrix)
    for k in range(1, smeared.shape[1]):
        smeared[:, k] = 0.85 * case.matrix[:, k] + 0.15 * smeared[:, k - 1]
    return case.with_columns(smeared)


def _add_piston(case: Case) -> Case:
    return case.with_columns(np.column_stack([case.matrix.mean(axis=1), case.matrix[:, :-1]]))


def _few(n_modes: int) -> Spoil:
    return lambda case: case.with_columns(case.matrix[:, :n_modes], np.arange(n_modes))


def _move_some(case: Case) -> Case:
    """Return the case with two modes measured at another registration."""
    other = measure(replace(case.draw, seed=case.draw.seed + 2))
    mixed = np.array(case.matrix)
    mixed[:, [4, 11]] = other.matrix[:, [4, 11]]
    return case.with_columns(mixed)


def _shade(case: Case) -> Case:
    """Return the case with light that fades outwards and along x."""
    valid = case.arrays["valid"].astype(bool)
    y, x = (np.stack(np.nonzero(valid)) - (len(valid) - 1) / 2) / (len(valid) / 2)
    light = 1.0 - 0.5 * (x**2 + y**2) + 0.2 * x
    return case.with_columns(case.matrix * np.tile(light / light.mean(), 2)[:, None])


_UNKNOWN = {
    "coupling": "mirror.coupling",
    "modulation": "wfs.modulation_lambda_over_d",
    "wavelength": "wfs.wavelength_m",
}
_TOLD = [words for words in TOLD if words not in {AS_IT_IS.words, "mirror image"}]

PROVOCATIONS: dict[str, Provocation] = {
    "nothing": Provocation(),
    **{
        words: Provocation(
            condition=Condition(
                arms=words.startswith(("arms turned", "arms twice", "map", "no arms")),
                images_px=0.2 if words == "images on the grid" else 0.0,
                modulation_lambda_over_d=0.0 if words == "modulation 3" else 3.0,
                told=words,
            )
        )
        for words in _TOLD
    },
    **{f"{words} unknown": Provocation(values={key: "unknown"}) for words, key in _UNKNOWN.items()},
    "modulation unknown, truth 0": Provocation(
        condition=Condition(modulation_lambda_over_d=0.0),
        values={_UNKNOWN["modulation"]: "unknown"},
    ),
    "wavelength unknown, truth 0": Provocation(
        condition=Condition(modulation_lambda_over_d=0.0),
        values={_UNKNOWN["wavelength"]: "unknown"},
    ),
    "slopes twice": Provocation(spoil=_scaled(2.0), peers=False),
    "slopes half, two passes": Provocation(values={"instrument.double_pass": True}, peers=False),
    "slopes per surface": Provocation(
        values={"instrument.double_pass": True}, spoil=_scaled(4.0), peers=False
    ),
    "slopes four times": Provocation(spoil=_scaled(4.0), peers=False),
    "slopes of the other sign": Provocation(spoil=_scaled(-1.0), peers=False),
    "per millimetre": Provocation(spoil=_scaled(1e-3), peers=False),
    "per wave": Provocation(spoil=_scaled(750e-9), peers=False),
    "modes scaled": Provocation(spoil=_scale_modes, peers=False),
    "columns normalised": Provocation(spoil=_normalise, peers=False),
    "two signs turned": Provocation(spoil=_turn_two, peers=False),
    "pokes not settled": Provocation(spoil=_smear, peers=False),
    "a column too many": Provocation(spoil=_add_piston, peers=False),
    "two modes": Provocation(spoil=_few(2), peers=False),
    "four modes": Provocation(spoil=_few(4), peers=False),
    "two modes moved": Provocation(spoil=_move_some, peers=False),
    "uneven light": Provocation(spoil=_shade, peers=False),
    "noise 1": Provocation(condition=Condition(noise=1.0), peers=False),
    "noise 4": Provocation(condition=Condition(noise=4.0), peers=False),
    "noise 20": Provocation(condition=Condition(noise=20.0), peers=False),
    "pokes of 150 nm": Provocation(
        condition=Condition(stroke_m=150e-9, modulation_lambda_over_d=1.0), peers=False
    ),
}

# --- what is done with a matrix

Remedy = Callable[[Case, Fit], Case]


def _exchange(case: Case, found: Fit) -> Case:
    order = np.arange(case.matrix.shape[1])
    for one, other in re.findall(r"(\d+) and (\d+)", found.recommendation):
        order[[int(one), int(other)]] = order[[int(other), int(one)]]
    return case.with_columns(case.matrix[:, order])


def _turn_signs(case: Case, found: Fit) -> Case:
    signs = np.ones(case.matrix.shape[1])
    listed = found.recommendation.partition("wrong sign: ")[2]
    signs[[int(one) for one in re.findall(r"\d+", listed)]] = -1.0
    return case.with_columns(case.matrix * signs)


def _leave_out(case: Case, found: Fit) -> Case:
    worst = [] if found.left_over is None else [mode for mode, _ in found.left_over.modes]
    kept = np.setdiff1d(np.arange(case.matrix.shape[1]), worst)
    return replace(case, options=replace(case.options, modes=kept))


def _times(factor: float) -> Remedy:
    return lambda case, _: case.with_columns(case.matrix * factor)


REMEDIES: dict[str, Remedy] = {
    "average more": lambda case, _: case.measured_again(
        noise=case.draw.condition.noise / NOISE_RATIO
    ),
    "smaller stroke": lambda case, _: case.measured_again(
        stroke_m=case.draw.condition.stroke_m / STROKE_RATIO
    ),
    "push six or more": lambda case, _: replace(case, arrays=case.whole),
    "more modes": lambda case, _: replace(case, arrays=case.whole),
    "modes do not determine": lambda case, _: replace(case, arrays=case.whole),
    "divide it by two": _times(0.5),
    "divide it by 4": _times(0.25),
    "multiply it by 1000": _times(1000.0),
    "divide it by the wavelength": _times(1.0 / 750e-9),
    "first column is additional": lambda case, _: case.with_columns(
        case.matrix[:, 1:], np.arange(case.matrix.shape[1] - 1)
    ),
    "first column is missing": lambda case, _: case.with_columns(
        case.matrix[:, :-1], np.arange(1, case.matrix.shape[1])
    ),
    "in reverse order": lambda case, _: case.with_columns(case.matrix[:, ::-1]),
    "have changed places": _exchange,
    "of the wrong sign": _turn_signs,
    "(--modes)": _leave_out,
    LIGHT_KEY: lambda case, _: replace(case, options=replace(case.options, gain_map=True)),
}
"""What is done with a matrix, or which option is given, by a part of the advice."""


def list_advice(case: Case, found: Fit) -> Iterator[tuple[str, Case]]:
    """Yield each piece of advice by name, with the case in which it is followed."""
    if found.corrections:
        name = ", ".join(_format_value(*one) for one in found.corrections.items())
        yield name, case.with_values(found.corrections)
    said = "\n".join((found.recommendation, *(one for one in found.remarks if LIGHT_KEY in one)))
    yield from ((words, do(case, found)) for words, do in REMEDIES.items() if words in said)


def _format_value(place: str, value: object) -> str:
    key = place.partition(".")[2]
    return f'{key} = "{value}"' if isinstance(value, str) and key != "pupil" else key


# --- fits


def follow(name: str, draw: Draw, found: Measured) -> Iterator[dict[str, Any]]:
    """Yield a row for each piece of advice that a provocation leads to, or one without advice."""
    wrong = PROVOCATIONS[name]
    case = describe(draw, found).with_values(wrong.values)
    if wrong.spoil is not None:
        case = wrong.spoil(case)
    kept = {"provocation": name, "code": draw.code, "seed": draw.seed}
    first = _outcome(case)
    kept |= {"first": first}
    advice = [] if isinstance(first["fit"], str) else list(list_advice(case, first["fit"]))
    first["fit"] = None
    if not advice:
        yield {**kept, "advice": "", "followed": None}
    for words, then in advice:
        yield {**kept, "advice": words, "followed": _outcome(then) | {"fit": None}}


def _outcome(case: Case) -> dict[str, Any]:
    try:
        found = case.fit()
    except (ConfigurationError, MatrixError, ModelError) as refused:
        return {"accepted": False, "worst": None, "said": str(refused), "fit": str(refused)}
    worst, said = case.worst(found), found.recommendation
    return {"accepted": found.accepted, "worst": worst, "said": said, "fit": found}


def run(file: RowFile, code: str, seeds: range, names: list[str]) -> None:
    """Append the rows that are not there yet."""
    known = {(one["provocation"], one["code"], one["seed"]) for one in file.rows}
    for name, seed in product(names, seeds):
        wrong = PROVOCATIONS[name]
        # The axes of a code's detector are found by a poke, which an unmodulated pyramid spreads.
        spread = wrong.condition.modulation_lambda_over_d == 0.0
        if (name, code, seed) in known or (code != "fft" and (spread or not wrong.peers)):
            continue
        draw = Draw(code=code, condition=wrong.condition, seed=seed)
        file.add(*follow(name, draw, measure(draw)))


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield a table in Markdown, a row for each piece of advice."""
    yield (
        "| Advice | Provoked by | Times | Accepted and right | Accepted and wrong | "
        "Refused again | Largest error over σ, accepted |"
    )
    yield "|" + " --- |" * 7
    for words in sorted({one["advice"] for one in rows} - {""}):
        these = [one for one in rows if one["advice"] == words]
        done = [one["followed"] for one in these]
        taken = [one["worst"] for one in done if one["accepted"]]
        right = sum(one < MAX_SIGMA for one in taken)
        by = ", ".join(dict.fromkeys(one["provocation"] for one in these))
        yield (
            f"| `{words}` | {by} | {len(these)} | {right} | {len(taken) - right} | "
            f"{len(done) - len(taken)} | {max(taken, default=float('nan')):.1f} |"
        )
    none = [one["first"] for one in rows if not one["advice"]]
    taken = [one["worst"] for one in none if one["accepted"]]
    right = sum(one < MAX_SIGMA for one in taken)
    yield (
        f"| none | | {len(none)} | {right} | {len(taken) - right} | {len(none) - len(taken)} | "
        f"{max(taken, default=float('nan')):.1f} |"
    )


def main(words: list[str]) -> int:
    """Follow the advice that is not followed yet, and print the table."""
    parser = study_parser("pyrcal_studies.advice_followed", __doc__)
    parser.add_argument("--codes", nargs="+", choices=CODES, default=CODES)
    parser.add_argument("--draws", type=int, default=2, help="of each code and provocation")
    parser.add_argument("--first-seed", type=int, default=700)
    parser.add_argument("--only", nargs="+", choices=PROVOCATIONS, default=list(PROVOCATIONS))
    options = parser.parse_args(words)
    file = RowFile(FOLDER / "advice.jsonl")
    with threadpool_limits(1):
        for code in options.codes:
            seeds = range(options.first_seed, options.first_seed + options.draws)
            run(file, code, seeds, options.only)
    print("\n".join(table(file.rows)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
