"""The report of a twin: values with σ and origin, left-over maps, budget, what to measure next."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from pyrcal.fitting.budget import advise_measurement
from pyrcal.fitting.figures import draw_sheet
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.report import FitReport, document
from pyrcal.importers.imported import UNKNOWN, Imported, format_toml
from pyrcal.maintenance.commission_page import format_html, format_table
from pyrcal.twins.bench import Bench
from pyrcal.twins.sampled import Exported
from service.errors import ConfigurationError, shown
from service.files.documents import json_text, pick
from service.model.instrument import Instrument
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS

_UNITS = ("subaperture", "subaperture", "deg", "ratio")
_MILLIMETRES = "mm of the pupil plane"

MAX_DECIMALS = 6
"""Number of decimals above which a value is written with an exponent."""

_FROM_FILES = {
    *("n_subapertures", "pupil_diameter_subap", "pupil_centres_px", "obscuration_ratio"),
    *("pixels_per_subaperture", "valid_subapertures", "pupil_separation_subap", "pupil", "input"),
    *("influence_functions", "modes", "mode_to_actuator", "modes_pitch_m", "positions", "fft_grid"),
}
"""Keys of the instrument file that the importers measure on the arrays."""


_DEFAULTS = ("auto", "normalised-frames")
"""Values of such keys that an importer takes where no array shows any."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Twin:
    """The fitted model of a bench and the files that were written."""

    folder: Path
    """Folder of all files."""

    bench: Bench
    """The files as they were read."""

    imported: Imported
    """Instrument file and matrix as they were fitted, with corrected values."""

    instrument: Instrument
    """The same instrument as it was loaded."""

    report: FitReport
    """Fit of the matrix."""

    before: FitReport | None = None
    """Fit with the values of the files, if some were corrected; None otherwise."""

    exported: tuple[Exported, ...] = ()
    """Models that were written for other programs."""

    checks: tuple[str, ...] = ()
    """Outcome of running them, one sentence each."""

    @property
    def residual(self) -> float:
        """RMS of the signal that the model leaves over."""
        return self.report.fit.residual_fraction


class Value(NamedTuple):
    """One value of the model."""

    name: str
    value: Any
    sigma: float | None
    """1 σ; None if it is not known."""

    unit: str
    origin: str
    """``measured``, ``stated`` or ``assumed``, and how."""


def list_values(made: Twin) -> Iterator[Value]:
    """Yield every value of the model with its σ and where it comes from."""
    fit = made.report.fit
    yield from _list_registration(made)
    measured = dict(_list_fitted(made))
    yield from measured.values()
    if fit.image_offsets_px is not None:
        places = (fit.image_offsets_px.round(3) + 0.0).tolist()  # without the sign of a zero
        yield Value("image_offsets_px", places, None, "px", "measured: fitted")
    yield _describe_stroke(made)
    for table, keys in made.imported.tables.items():
        for key, value in keys.items():
            if key not in measured and key not in {"stroke", "name"}:
                origin = _find_origin(made, table, key)
                yield Value(f"{table}.{key}", value, None, _unit(key), origin)


def _list_registration(made: Twin) -> Iterator[Value]:
    """Yield α, with its shifts in millimetres as well: the unit in which mounts are moved."""
    fit, subaperture_mm = made.report.fit, 1e3 * made.instrument.subaperture_m
    yield Value("subaperture", subaperture_mm, None, _MILLIMETRES, "diameter over subapertures")
    alpha, sigmas = fit.alpha.vector * BOUNDARY_SCALE, fit.sigma * BOUNDARY_SCALE
    for name, value, sigma, unit in zip(PARAMETERS, alpha, sigmas, _UNITS, strict=True):
        yield Value(name, value, sigma, unit, "measured: fitted")
        if name.endswith("_subap"):
            lengths = value * subaperture_mm, sigma * subaperture_mm
            yield Value(name.replace("subap", "mm"), *lengths, _MILLIMETRES, "measured: the same")
    if fit.anamorphosis is not None and fit.anamorphosis_sigma is not None:
        for name, value, sigma in zip(
            ("along x", "along 45 deg"), fit.anamorphosis, fit.anamorphosis_sigma, strict=True
        ):
            yield Value(f"anamorphosis {name}", value, sigma, "ratio", "measured: fitted")


def _list_fitted(made: Twin) -> Iterator[tuple[str, Value]]:
    """Yield the optical quantities that a fit has found, by key, those of the last fit last."""
    hidden = {"order"}
    if "modulation_ellipse" in made.imported.tables["wfs"]:
        hidden.add("modulation_lambda_over_d")  # the two axes say it
    for report in filter(None, (made.before, made.report)):
        optics = {one.key: one for one in report.fit.optics if one.found is not None}
        origins = {one.key: one for one in report.fit.origins if one.correct or one.key in optics}
        for key in dict.fromkeys([*origins, *optics]):
            optic = optics.get(key)
            value = origins[key].found if optic is None else optic.found
            sigma = None if optic is None else optic.found_sigma
            how = origins[key].how if key in origins else "fitted"
            if key not in hidden:
                origin = f"measured: {how}; {_quote_files(made, key)}"
                yield key, Value(key, value, sigma, _unit(key), origin)


def _quote_files(made: Twin, key: str) -> str:
    """Return which value a key of the instrument file has in the files of the bench."""
    tables = made.bench.imported[-1].tables.values()
    known = next((table[key] for table in tables if key in table), UNKNOWN)
    return "no file has it" if known == UNKNOWN else f"the files say {format_toml(known)}"


def _unit(key: str) -> str:
    """Return the unit of a key of the instrument file."""
    endings = {
        "_m": "m",
        "_nm": "nm",
        "_lambda_over_d": "λ/D",
        "_ellipse": "λ/D, deg",
        "_px": "px",
        "_subap": "subaperture",
    }
    return next((unit for end, unit in endings.items() if key.endswith(end)), "")


def _find_origin(made: Twin, table: str, key: str) -> str:
    """Return where a value comes from that no fit has as a number of its own."""
    value = made.imported.tables[table][key]
    read = [one.tables.get(table, {}).get(key) for one in made.bench.imported]
    if value == UNKNOWN:
        return "assumed: no file contains it, and the matrix does not determine it"
    if key in {"orientation", "order"} and made.report.fit.accepted:
        return "measured: scanned with the lowest modes"
    if value not in read:
        return f"measured: it explains the matrix better; {_quote_files(made, key)}"
    if key in made.bench.stated:
        return "stated"
    if key in _FROM_FILES and value not in _DEFAULTS:
        return "measured: on the arrays of the files"
    return "assumed: the importer's default, or the instrument file's value"


def _describe_stroke(made: Twin) -> Value:
    """Return the unit of the commands, where the matrix determines it."""
    fit = made.report.fit
    stroke = fit.stroke
    if stroke is None or stroke.metres_per_unit is None:
        reason = "unknown" if stroke is None else stroke.condition
        return Value("stroke", "not determined", None, "", reason)
    condition = f", if {stroke.condition}" if stroke.condition else ""
    return Value(
        "stroke",
        stroke.metres_per_unit,
        stroke.sigma,
        "m of OPD per unit of the commands",
        f"measured: median gain of the modes{condition}",
    )


def list_lines(made: Twin) -> Iterator[str]:
    """Yield the report as lines of text."""
    yield from (shown(line) for line in made.bench.inventory)
    yield ""
    fit = made.report.fit
    yield fit.recommendation
    yield fit.verdict_line
    # What a refused fit has found may be anything.
    if fit.accepted:
        for one in list_values(made):
            if "." not in one.name:
                yield f"{one.name:32s}{_text(one)}  {one.unit}  ({one.origin})"
    yield f"{'left over':32s}{100.0 * made.residual:.2f} % of the signal"
    if fit.accepted and fit.causes:
        yield from (
            f"  {one.share:.0%} +- {one.sigma:.0%} of its power: {one.words}" for one in fit.causes
        )
        yield f"measure next: {advise_measurement(fit.causes)}"
    exported = (remark for one in made.exported for remark in one.remarks)
    remarks = dict.fromkeys((*fit.remarks, *exported))
    yield from (f"note: {remark}" for remark in remarks)
    yield from made.checks
    yield f"written to {made.folder}: open twin.html"


def _text(one: Value) -> str:
    """Return a value with its σ, both to the second digit of the σ."""
    if isinstance(one.value, float) and one.sigma:
        n_digits = max(0, 1 - math.floor(math.log10(one.sigma)))
        if n_digits > MAX_DECIMALS and one.value:
            n_digits += 1 + math.floor(math.log10(abs(one.value)))
            return f"{one.value:.{max(n_digits, 1)}g} +- {one.sigma:.2g}"
        value = round(one.value, n_digits) + 0.0  # without the sign of a zero
        return f"{value:.{n_digits}f} +- {one.sigma:.{n_digits}f}"
    if isinstance(one.value, str):
        text = one.value
    else:
        text = f"{one.value:.5g}" if isinstance(one.value, float) else format_toml(one.value)
    return text if one.sigma is None else f"{text} +- {one.sigma:.2g}"


def write_report(made: Twin) -> None:
    """Write ``twin.json`` and ``twin.html`` into the folder."""
    (made.folder / "twin.json").write_text(json_text(_document(made), indent=1), encoding="utf-8")
    (made.folder / "twin.html").write_text(_page(made), encoding="utf-8")


def _document(made: Twin) -> dict[str, Any]:
    """Return the report for JSON."""
    return {
        "values": [one._asdict() for one in list_values(made)],
        "left_over": made.residual,
        "causes": [pick(one, "words share sigma remedy") for one in made.report.fit.causes],
        "measure_next": advise_measurement(made.report.fit.causes),
        "files": made.bench.inventory,
        "notes": made.imported.notes,
        "models": [{"file": one.path.name, "remarks": one.remarks} for one in made.exported],
        "checks": made.checks,
        "fit": document(made.report),
    }


def _page(made: Twin) -> str:
    """Return the report as HTML that needs no other file."""
    fit = made.report.fit
    mark = "pass" if fit.accepted else "fail"
    values = (
        (one.name, _text(one).replace("+-", "±"), one.unit, one.origin) for one in list_values(made)
    )
    models = [(one.path.name, " ".join(one.remarks) or "complete") for one in made.exported]
    notes = (*made.imported.notes, *made.report.notes)
    return format_html(
        f"Twin of {made.instrument.name}",
        [
            f'<p class="verdict {mark}">{escape(fit.recommendation)}</p>',
            f"<p>{escape(fit.verdict_line)}</p>",
            "<h2>Values of the model</h2>",
            format_table(("Value", "Found ± 1 σ", "Unit", "Origin"), values),
            "<h2>Measured, modelled, left over</h2>",
            _figure(made),
            f"<h2>What is left over: {made.residual:.1%} of the signal</h2>",
            _describe_left_over(fit),
            "<h2>Models for other programs</h2>",
            format_table(("File", "What it does not contain or assumes"), models),
            *(f"<p>{escape(one)}</p>" for one in made.checks),
            "<h2>Files and notes</h2>",
            *(f'<p class="note">{escape(one)}</p>' for one in (*made.bench.inventory, *notes)),
        ],
    )


def _describe_left_over(fit: Fit) -> str:
    """Return the causes of what is left over as HTML."""
    if not fit.accepted or not fit.causes:
        reason = "The fit was refused" if not fit.accepted else "Too little is left over"
        return f"<p>{reason}: it is not divided among causes.</p>"
    causes = ((one.words, f"{one.share:.0%} ± {one.sigma:.0%}", one.remedy) for one in fit.causes)
    table = format_table(("Cause", "Share of the power left over", "Remedy"), causes)
    return f"{table}<p>{escape(advise_measurement(fit.causes))}</p>"


def _figure(made: Twin) -> str:
    """Return the figures of the fit, or why there are none."""
    stream = io.BytesIO()
    try:
        draw_sheet(made.report.fit, "", made.instrument).savefig(stream, format="png", dpi=80)
    except ConfigurationError as error:
        return f"<p>{escape(str(error))}</p>"
    data = base64.b64encode(stream.getvalue()).decode()
    return f'<figure><img alt="figures of the fit" src="data:image/png;base64,{data}"></figure>'
