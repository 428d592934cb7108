"""Fit the measured matrices of two real benches, and write the page with their pictures.

PAPYRUS (Observatoire de Haute-Provence) and AO188 (Subaru) publish interaction matrices as frames
of a pyramid's camera, under licences that do not allow them here: they are read from a folder that
holds ``papyrus/`` and ``ao188/`` as those projects name their files. With ``--wrong`` they are also
fitted with one value of the instrument file wrong; answers are kept in ``var/benches``. With
``--centres`` AO188 is fitted with other centres of its pupil images, and no page is written.
Run: ``python -m pyrcal_studies.benches --data PATH --wrong``.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.alternatives import systematic_terms
from pyrcal.fitting.disjoint_sets import DisjointSets
from pyrcal.fitting.figures import shown_modes
from pyrcal.fitting.fit_file import fit_file
from pyrcal.fitting.fitted import Fit, Registration
from pyrcal.fitting.matrix import FitOptions
from pyrcal_studies.campaign.rows import RowFile
from pyrcal_studies.peers import ROOT
from pyrcal_studies.shared import save_picture, study_parser
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.model.pupil_images import find_pupil_images
from service.model.slopes import as_maps, side_by_side

Array = NDArray[np.float64]

PAGE = ROOT / "docs" / "results" / "real_benches.md"

KEPT = ROOT / "var" / "benches" / "wrong.jsonl"

MAX_SIGMA = 3.0

PAPYRUS_MODES = (1, 5, 10, 20, 30, 50, 80, 100, 150)
"""Columns of the M2C that were pushed."""

PAPYRUS = """
[instrument]
name = "papyrus"
diameter_m = 0.0375
stop = "telescope"
[wfs]
kind = "pyramid"
n_subapertures = 38
pupil_diameter_subap = 37.0
pixels_per_subaperture = 2
input = "frames"
pupil_centres_px = [[50.35, 183.12], [53.65, 53.01], [182.60, 187.30], [186.03, 55.68]]
pupil_separation_subap = 65
wavelength_m = 640e-9
modulation_lambda_over_d = 5.0
[mirror]
layout = "positions"
positions = "matrix.h5:/positions"
pitch_m = 0.0025
mode_to_actuator = "matrix.h5:/m2c"
influence = "gaussian"
coupling = "unknown"
stroke = "unknown"
"""

AO188 = """
[instrument]
name = "ao188"
diameter_m = 7.92
obscuration_ratio = 0.30
stop = "telescope"
[wfs]
kind = "pyramid"
n_subapertures = 36
pupil_diameter_subap = 35.5
pixels_per_subaperture = 2
input = "frames"
pupil_centres_px = "auto"
pupil_separation_subap = 40
wavelength_m = 1.2e-6
modulation_lambda_over_d = "unknown"
[mirror]
layout = "positions"
positions = "matrix.h5:/positions"
influence = "gaussian"
coupling = "unknown"
stroke = "unknown"
basis = "zonal"
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """A bench whose matrix was measured."""

    name: str
    """Of its folder."""

    words: str
    """What it is, in a sentence."""

    instrument: str
    """Its instrument file."""

    write: Callable[[Path, h5py.File], None]
    """Write what was measured in a folder as pyrcal reads it."""


def write_papyrus(folder: Path, file: h5py.File) -> None:
    """Write PAPYRUS' frames, its mask as the flux, its actuators and modes."""
    frames = np.load(folder / "int_mat.npy").T.reshape(-1, 240, 240)
    lit = np.load(folder / "valid_pixel.npy").astype(np.float64)
    line = (np.arange(17) - 8) * 2.5e-3
    y, x = np.meshgrid(line, line, indexing="ij")
    grid = np.column_stack([x.ravel(), y.ravel()])
    nearest = np.sort(np.argsort(np.hypot(*grid.T), kind="stable")[:241])
    file["interaction_matrix"] = frames
    file["flux_frame"] = lit / lit.sum()
    file["positions"] = grid[nearest]
    file["m2c"] = np.load(folder / "M2C.npy").astype(np.float64)
    file["modes"] = np.array(PAPYRUS_MODES)


def write_ao188(folder: Path, file: h5py.File) -> None:
    """Write AO188's frames, its reference frame as the flux, and its actuators."""
    from astropy.io import fits

    with fits.open(folder / "respM.fits.fz") as found:
        file["interaction_matrix"] = next(one.data for one in found if one.data is not None)
    file["flux_frame"] = fits.getdata(folder / "wfsref.fits").astype(np.float64)
    file["positions"] = np.loadtxt(folder / "act2Dpos.txt")[:, 1:] * 7.92 / 2.0


BENCHES = (
    Bench(
        name="papyrus",
        words="PAPYRUS: a pyramid with an ALPAO mirror of 241 actuators; nine KL modes as frames "
        "of 240 x 240 pixels, strokes unknown",
        instrument=PAPYRUS,
        write=write_papyrus,
    ),
    Bench(
        name="ao188",
        words="AO188 of Subaru with its near-infrared pyramid: 188 actuators of a bimorph as "
        "frames of 160 x 160 pixels, strokes and modulation unknown",
        instrument=AO188,
        write=write_ao188,
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class WrongValue:
    """One value of a bench's instrument file that is changed."""

    bench: str
    words: str
    old: str
    """Line of the instrument file."""

    new: str


COARSE = {
    "papyrus": {
        "n_subapertures = 38": "n_subapertures = 19",
        "pupil_diameter_subap = 37.0": "pupil_diameter_subap = 18.5",
        "pixels_per_subaperture = 2": "pixels_per_subaperture = 4",
        "pupil_separation_subap = 65": "pupil_separation_subap = 32.5",
    },
    "ao188": {
        "n_subapertures = 36": "n_subapertures = 18",
        "pupil_diameter_subap = 35.5": "pupil_diameter_subap = 17.75",
        "pixels_per_subaperture = 2": "pixels_per_subaperture = 4",
        "pupil_separation_subap = 40": "pupil_separation_subap = 20",
    },
}
"""Half as many subapertures across, which a fit takes a fifth of the time for."""

_STOP = 'stop = "telescope"'


def _spiders(bench: str, words: str, width_m: float, angles: list[int]) -> WrongValue:
    new = f"{_STOP}\nspiders_m = {width_m}\nspiders_deg = {angles}"
    return WrongValue(bench=bench, words=words, old=_STOP, new=new)


def _wrong(bench: str, key: str, old: str, new: str) -> WrongValue:
    return WrongValue(
        bench=bench, words=f"{key} = {new}", old=f"{key} = {old}", new=f"{key} = {new}"
    )


WRONG_VALUES = (
    WrongValue(
        bench="papyrus",
        words="obscuration_ratio = 0.15",
        old=_STOP,
        new=f"{_STOP}\nobscuration_ratio = 0.15",
    ),
    WrongValue(
        bench="papyrus",
        words="obscuration_ratio = 0.30",
        old=_STOP,
        new=f"{_STOP}\nobscuration_ratio = 0.30",
    ),
    _wrong("papyrus", "modulation_lambda_over_d", "5.0", "3.0"),
    _wrong("papyrus", "modulation_lambda_over_d", "5.0", "8.0"),
    _wrong("papyrus", "coupling", '"unknown"', "0.20"),
    _wrong("papyrus", "coupling", '"unknown"', "0.45"),
    _wrong("papyrus", "stop", '"telescope"', '"mirror"'),
    _spiders("papyrus", "four spider arms of 1 % of the diameter", 0.0004, [0, 90, 180, 270]),
    _spiders("papyrus", "four spider arms of 2 % of the diameter", 0.0008, [45, 135, 225, 315]),
    _wrong("ao188", "obscuration_ratio", "0.30", "0.20"),
    _wrong("ao188", "obscuration_ratio", "0.30", "0.40"),
    _wrong("ao188", "modulation_lambda_over_d", '"unknown"', "3.0"),
    _wrong("ao188", "modulation_lambda_over_d", '"unknown"', "8.0"),
    _wrong("ao188", "coupling", '"unknown"', "0.35"),
    _wrong("ao188", "coupling", '"unknown"', "0.70"),
    _wrong("ao188", "stop", '"telescope"', '"mirror"'),
    _spiders("ao188", "four spider arms of 2 % of the diameter", 0.15, [40, 140, 220, 320]),
    _spiders("ao188", "four spider arms of 4 % of the diameter", 0.30, [40, 140, 220, 320]),
)


def fit_bench(bench: Bench, data: Path, modes: NDArray[np.intp] | None = None) -> Fit:
    """Return the fit of a bench's matrix in the folder ``data``; ``modes`` None: of all columns."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with h5py.File(folder / "matrix.h5", "w") as file:
            bench.write(data / bench.name, file)
        told = folder / f"{bench.name}.toml"
        told.write_text(bench.instrument, encoding="utf-8")
        report = fit_file(
            load_instrument(told), folder / "matrix.h5", FitOptions(modes=modes), threads=1
        )
    return report.fit


def some_columns(name: str) -> NDArray[np.intp] | None:
    """Return the columns that are fitted with wrong values; None: all."""
    return np.arange(0, 188, 3) if name == "ao188" else None


def coarse_bench(name: str) -> Bench:
    """Return a bench with half as many subapertures across."""
    (bench,) = (one for one in BENCHES if one.name == name)
    text = bench.instrument
    for old, new in COARSE[name].items():
        text = text.replace(old, new)
    return replace(bench, instrument=text)


def answer(wrong: WrongValue, data: Path, right: Fit) -> dict[str, Any]:
    """Return the fit with one wrong value, compared with the fit of the right file."""
    bench = coarse_bench(wrong.bench)
    if wrong.old not in bench.instrument:
        raise ValueError(f"{wrong.bench}: found no {wrong.old!r} in its file")
    text = bench.instrument.replace(wrong.old, wrong.new)
    fit = fit_bench(replace(bench, instrument=text), data, some_columns(wrong.bench))
    return {
        "bench": wrong.bench,
        "words": wrong.words,
        "determined": bool(fit.accepted),
        "error": list((fit.alpha.vector - right.alpha.vector) * BOUNDARY_SCALE),
        "sigma": list(fit.sigma * BOUNDARY_SCALE),
        "says": fit.recommendation,
    }


def kept_answers() -> list[dict[str, Any]]:
    """Return the answers to wrong values that were measured before."""
    return RowFile(KEPT).rows


def ask_wrong(bench: Bench, data: Path) -> None:
    """Fit a bench with every wrong value that has no answer yet, and keep the answers."""
    file = RowFile(KEPT)
    known = {(one["bench"], one["words"]) for one in file.rows}
    right = fit_bench(coarse_bench(bench.name), data, some_columns(bench.name))
    for wrong in WRONG_VALUES:
        if wrong.bench != bench.name or (wrong.bench, wrong.words) in known:
            continue
        file.add(answer(wrong, data, right))
        print(json.dumps(file.rows[-1]), flush=True)


def draw(fit: Fit, path: Path) -> None:
    """Draw measured, modelled and residual maps, and where disjoint sets lead."""
    from matplotlib.figure import Figure

    columns = shown_modes(fit)
    columns = columns[np.linspace(0, len(columns) - 1, 3).round().astype(int)]
    figure = Figure(figsize=(12.0, 9.0), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(3, 2), squeeze=False).ravel()
    grid = upper.subplots(3, 3)
    for row, column in zip(grid, columns, strict=True):
        measured = as_maps(fit.measured[:, column], fit.valid)
        model = as_maps(fit.synthetic[:, column] * fit.gains[column], fit.valid)
        limit = 3.0 * float(np.nanstd(measured))
        for axes, name, values in zip(
            row,
            ("measured", "model", "residual"),
            (measured, model, measured - model),
            strict=True,
        ):
            axes.imshow(values, origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit)
            axes.set(xticks=[], yticks=[], title=f"{name}, column {fit.modes[column]}: Sx | Sy")
    left, right = lower.subplots(1, 2)
    image = left.imshow(100.0 * side_by_side(fit.residual_map), origin="lower", vmin=0.0)
    left.set(title="left over: Sx | Sy, % of the measured RMS", xticks=[], yticks=[])
    figure.colorbar(image, ax=left, shrink=0.7)
    _draw_sets(right, fit)
    save_picture(figure, path)


def _draw_sets(axes: Any, fit: Fit) -> None:  # noqa: ANN401 - matplotlib's, imported when drawn
    """Draw the shift of each disjoint set alone, with its 1 σ."""
    sets = () if fit.registration is None else fit.registration.sets
    for number, one in enumerate(sets):
        at = one.steps[:, :2] + fit.alpha.vector[:2]
        axes.errorbar(
            at[:, 0],
            at[:, 1],
            xerr=one.sigma[:, 0],
            yerr=one.sigma[:, 1],
            fmt="o" if one.even else "x",
            markersize=4.0,
            linewidth=0.6,
            color=f"C{number}",
            label=one.words,
        )
    axes.plot(*fit.alpha.vector[:2], "k+", markersize=14.0)
    axes.set(
        title="shift of disjoint sets",
        xlabel="shift x, subapertures",
        ylabel="shift y, subapertures",
    )
    axes.legend(fontsize="x-small")


def page(found: dict[str, Fit]) -> str:
    """Return the page in Markdown."""
    lines = [
        "# Matrices of real benches",
        "",
        "Matrices that PAPYRUS and AO188 have published, fitted with what is public of them. There "
        "is no true registration to compare with. Disjoint sets of modes, actuators and "
        "subapertures are therefore fitted alone and compared, and fits are repeated with one "
        "value of the instrument file wrong. Shifts are in subapertures, rotations in degrees.",
        "",
        "## Targets and results",
        "| | Target | " + " | ".join(found) + " |",
        "| --- | --- |" + " --- |" * len(found),
        *_results(found),
        "",
        "**Command**: `python -m pyrcal_studies.benches --data PATH --wrong`, which writes this "
        f"page. **Date**: {datetime.now(tz=UTC):%Y-%m-%d}. **Conditions**: one thread. With a "
        "wrong value pixels are binned to half as many subapertures, and of AO188 every third "
        "actuator is used; the fit of the right file that these are compared with is made in the "
        "same way.",
        "",
        "The combined σ of two sets comes from leaving out modes, from leaving out regions of the "
        "pupil where the sets use different ones, and from what a distortion of the mirror moves "
        "each. Halves and quadrants of the pupil do not enter σ of α: what moves opposite halves "
        "in opposite directions cancels in the whole. The pupil images stay within 0.15 pixel of "
        "where their light is; three fits that began with them up to 1.6 pixels off ended within "
        "0.06 σ of the same α.",
        "",
    ]
    for bench in BENCHES:
        if bench.name in found:
            lines += _of_bench(bench, found[bench.name])
    return "\n".join(lines)


def _of_bench(bench: Bench, fit: Fit) -> list[str]:
    registration, control = fit.registration, fit.reconstructor
    if registration is None or control is None:
        return []
    names = dict(zip(PARAMETERS, ("shift x", "shift y", "rotation", "magnification"), strict=True))
    values = fit.alpha.vector * BOUNDARY_SCALE
    rows = zip(
        names.values(),
        values,
        registration.sigma_statistical * BOUNDARY_SCALE,
        registration.sigma_systematic * BOUNDARY_SCALE,
        strict=True,
    )
    left = "" if fit.left_over is None else fit.left_over.words
    terms = "; ".join(
        f"{one.words} ({float(np.max(sigma / fit.sigma)):.1f} of σ)"
        for one, sigma in systematic_terms(fit.alternatives, fit.residual_fraction, fit.sigma)[:3]
    )
    causes = "; ".join(f"{one.share:.0%} ± {one.sigma:.0%} {one.words}" for one in fit.causes)
    return [
        f"## {bench.name}",
        "",
        f"{bench.words}.",
        "",
        f"![Maps and disjoint sets of {bench.name}](real_benches_{bench.name}.png)",
        "",
        f"- **Registration: {'' if registration.determined else 'not '}determined.** "
        f"{registration.reason}.",
        f"- **Reconstructor:** {control.reason}.",
        f"- Advice: {fit.recommendation}.",
        f"- Explanations that add most to the systematic part of σ: {terms or 'none'}.",
        f"- What is left over: {left or 'nothing significant'}.",
        f"- Its power by cause: {causes}.",
        "",
        "| α | Value | Statistical σ | Systematic σ |",
        "| --- | --- | --- | --- |",
        *(f"| {name} | {value:.4f} | {one:.4f} | {two:.4f} |" for name, value, one, two in rows),
        "",
        *_of_sets(fit, registration),
        *_of_wrong([one for one in kept_answers() if one["bench"] == bench.name]),
    ]


def _ratios(fit: Fit) -> Array:
    """Return the differences of every two disjoint sets over their combined σ ``(n, 4)``."""
    sets = () if fit.registration is None else fit.registration.sets
    return np.concatenate([one.ratios for one in sets])


def _results(found: dict[str, Fit]) -> Iterator[str]:
    """Yield the rows of the table of targets."""
    ratios = [_ratios(fit) for fit in found.values()]
    largest = [f"{one.max():.1f} σ" for one in ratios]
    scatter = [f"{1.0 / float(np.sqrt(np.mean(one**2))):.2f}" for one in ratios]
    determined = ["yes" if fit.accepted else "no" for fit in found.values()]
    yield f"| registration determined | yes | {' | '.join(determined)} |"
    yield f"| largest difference of two disjoint sets | 3 σ | {' | '.join(largest)} |"
    yield f"| σ over scatter of the sets | 0.5 to 2 | {' | '.join(scatter)} |"
    wrong = [[one for one in kept_answers() if one["bench"] == name] for name in found]
    bad = [
        f"{sum(one['determined'] and _over_sigma(one) > MAX_SIGMA for one in each)} of {len(each)}"
        for each in wrong
    ]
    yield (
        "| one value of the file wrong: determined and more than "
        f"{MAX_SIGMA:g} σ from the fit of the right file | 0 | {' | '.join(bad)} |"
    )


def _of_sets(fit: Fit, registration: Registration) -> Iterator[str]:
    """Yield how far disjoint sets agree, and the distortion that moves them."""
    ratios = _ratios(fit)
    each = ", ".join(f"{value:.2f}" for value in np.sqrt(np.mean(ratios**2, axis=0)))
    straight = max(float(one.straight_tension.max()) for one in registration.sets)
    yield (
        f"{ratios.size} differences of disjoint sets: RMS over combined σ {each} (x, y, rotation, "
        f"magnification), the largest {ratios.max():.1f}."
    )
    if registration.distortion is not None:
        found = registration.distortion
        yield (
            f"Their σ contains a smooth distortion of the mirror of {found.rms_subap:.2f} "
            f"subapertures RMS, which leaves {found.share:.1%} of the misfit; without it the "
            f"largest difference is {straight:.1f} σ."
        )
    yield ""
    yield "| Largest difference of | Shift x, y | Rotation | Magnification | Largest, σ |"
    yield "| --- | --- | --- | --- | --- |"
    for even in (True, False):  # those that enter σ of α, then those of one side of the pupil
        yield _sets_row([one for one in registration.sets if one.even == even])
    yield ""


def _sets_row(sets: Sequence[DisjointSets]) -> str:
    """Return the largest difference of every parameter, and the largest one over its σ."""
    spans = [np.ptp(one.steps, axis=0) * BOUNDARY_SCALE for one in sets]
    x, y, turn, size = np.max(spans, axis=0)
    worst = max(sets, key=lambda one: float(one.tension.max()))
    return (
        f"| {', '.join(one.words for one in sets)} | {x:.3f}, {y:.3f} | {turn:.3f} | {size:.4f} | "
        f"{worst.tension.max():.1f} ({worst.words}) |"
    )


def _of_wrong(found: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the values that were made wrong one by one, and the largest move of α."""
    if not found:
        return
    worst = max(found, key=_over_sigma)
    x, y, turn, size = worst["error"]
    refused = [one["words"] for one in found if not one["determined"]]
    yield (
        f"**One wrong value** ({'; '.join(one['words'] for one in found)}): "
        f"{len(found) - len(refused)} of {len(found)} determined"
        f"{', all but ' + '; '.join(refused) if refused else ''}. The largest move of α is "
        f"{_over_sigma(worst):.1f} σ, with {worst['words']}: {x:+.3f}, {y:+.3f}, {turn:+.3f} deg, "
        f"{size:+.4f}."
    )
    yield ""


def _over_sigma(one: dict[str, Any]) -> float:
    return float(np.max(np.abs(one["error"]) / np.array(one["sigma"])))


def choose_centres(data: Path) -> None:
    """Fit AO188 with circles at three levels of the light, and print what α moves over σ."""
    from astropy.io import fits

    light = fits.getdata(data / "ao188" / "wfsref.fits").astype(np.float64)
    bright = np.maximum(light - np.percentile(light, 2), 0.0)
    first: Fit | None = None
    for level in (0.5, 0.25, 0.71):
        power = float(np.log(0.5) / np.log(level))
        centres = find_pupil_images(bright**power, "ao188").centres_px
        key = f"pupil_centres_px = {np.round(centres, 3).tolist()}"
        told = AO188.replace('pupil_centres_px = "auto"', key)
        fit = fit_bench(replace(BENCHES[1], instrument=told), data)
        first = first or fit
        moved = fit.alpha.vector - first.alpha.vector
        print(level, key, *np.round(moved * BOUNDARY_SCALE, 4), "over sigma", moved / first.sigma)


def main() -> int:
    """Fit, draw, and write the page."""
    parser = study_parser("pyrcal_studies.benches", __doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of papyrus/ and ao188/")
    parser.add_argument("--wrong", action="store_true", help="fit with wrong values as well")
    parser.add_argument("--centres", action="store_true", help="only AO188, three sets of centres")
    given = parser.parse_args()
    if given.centres:
        choose_centres(given.data)
        return 0
    found = {}
    for bench in BENCHES:
        if not (given.data / bench.name).is_dir():
            print(f"{bench.name}: not in {given.data}, left out", file=sys.stderr)
            continue
        fit = found[bench.name] = fit_bench(bench, given.data)
        draw(fit, PAGE.with_name(f"real_benches_{bench.name}.png"))
        print(f"{bench.name}: {fit.recommendation}", flush=True)
        if given.wrong:
            ask_wrong(bench, given.data)
    PAGE.write_text(page(found), encoding="utf-8")
    print(PAGE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
