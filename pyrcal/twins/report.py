"""The report of a twin: values with σ and origin, left-over maps, budget, what to measure next."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pyrcal.fitting.budget import advise_measurement
from pyrcal.fitting.figures import draw_sheet
from pyrcal.fitting.report import FitReport, document
from pyrcal.importers.imported import UNKNOWN, Imported
from pyrcal.maintenance.commission_page import format_html, format_table
from pyrcal.twins.bench import Bench
from pyrcal.twins.exported import Exported
from service.errors import ConfigurationError, shown
from service.files.documents import json_text, pick
from service.model.instrument import Instrument
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS

_UNITS = ("subaperture", "subaperture", "deg", "ratio")

_FROM_FILES = {
    *("n_subapertures", "pupil_diameter_subap", "pupil_centres_px", "obscuration_ratio"),
    *("pixels_per_subaperture", "valid_subapertures", "pupil_separation_subap", "pupil", "input"),
    *("influence_functions", "modes", "mode_to_actuator", "modes_pitch_m", "positions", "fft_grid"),
}
"""Keys of the instrument file that the importers measure on the arrays."""


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
    """``measured``, ``told`` or ``assumed``, and how."""


def list_values(made: Twin) -> Iterator[Value]:
    """Yield every value of the model with its σ and where it comes from."""
    fit = made.report.fit
    for name, value, sigma, unit in zip(
        PARAMETERS, fit.alpha.vector, fit.sigma, _UNITS, strict=True
    ):
        scale = BOUNDARY_SCALE[PARAMETERS.index(name)]
        yield Value(name, value * scale, sigma * scale, unit, "measured: fitted")
    if fit.anamorphosis is not None and fit.anamorphosis_sigma is not None:
        for name, value, sigma in zip(
            ("along x", "along 45 deg"), fit.anamorphosis, fit.anamorphosis_sigma, strict=True
        ):
            yield Value(f"anamorphosis {name}", value, sigma, "ratio", "measured: fitted")
    measured = dict(_list_fitted(made))
    yield from measured.values()
    if fit.image_offsets_px is not None:
        places = fit.image_offsets_px.round(3).tolist()
        yield Value("image_offsets_px", places, None, "px", "measured: fitted")
    yield _describe_stroke(made)
    for table, keys in made.imported.tables.items():
        for key, value in keys.items():
            if key not in measured and key != "stroke":
                yield Value(f"{table}.{key}", value, None, _unit(key), _find_origin(made, key))


def _list_fitted(made: Twin) -> Iterator[tuple[str, Value]]:
    """Yield the optical quantities that a fit has found, by key."""
    for report in filter(None, (made.report, made.before)):
        fit = report.fit
        sigmas = {one.key: one for one in fit.optics}
        for one in fit.origins:
            optic = sigmas.get(one.key)
            if (one.correct or optic is not None) and one.key != "order":
                sigma = None if optic is None else optic.found_sigma
                origin = f"measured: {one.how}; the files say {one.reported}"
                yield one.key, Value(one.key, one.found, sigma, _unit(one.key), origin)
        for optic in fit.optics:
            if optic.found is not None and optic.key not in {one.key for one in fit.origins}:
                stated = "nothing" if optic.reported is None else f"{optic.reported:g}"
                origin = f"measured: fitted; the files say {stated}"
                value = float(optic.found)
                unit = _unit(optic.key)
                yield optic.key, Value(optic.key, value, optic.found_sigma, unit, origin)


def _unit(key: str) -> str:
    """Return the unit of a key of the instrument file."""
    endings = {"_m": "m", "_lambda_over_d": "λ/D", "_px": "px", "_subap": "subaperture"}
    return next((unit for end, unit in endings.items() if key.endswith(end)), "")


def _find_origin(made: Twin, key: str) -> str:
    fit, value = made.report.fit, None
    for table in made.imported.tables.values():
        value = table.get(key, value)
    if value == UNKNOWN:
        return "assumed: no file contains it, and the matrix does not determine it"
    if key in made.bench.stated:
        return "told"
    if key in {"orientation", "order"} and fit.accepted:
        return "measured: scanned with the lowest modes"
    if key in _FROM_FILES:
        return "measured: on the arrays of the files"
    return "assumed: the importer's default, or the instrument file's value"


def _describe_stroke(made: Twin) -> Value:
    """Return the gain of the modes: the unit of the commands, where the sensor's gain is known."""
    fit = made.report.fit
    gain = float(np.median(fit.gains))
    scatter = 1.4826 * float(np.median(np.abs(fit.gains - gain)))
    about = made.instrument
    if about.mirror.stroke_known and "wfs.wavelength_m" not in about.unknown:
        return Value(
            "stroke", gain, scatter, "m OPD per stated m", "measured: median gain of the modes"
        )
    return Value(
        "stroke",
        "not determined",
        None,
        "",
        "unit of the commands and gain of the sensor are unknown, and scale all columns alike: "
        f"these are {gain:.3g} times the model's per metre",
    )


def list_lines(made: Twin) -> Iterator[str]:
    """Yield the report as lines of text."""
    yield from (shown(line) for line in made.bench.inventory)
    yield ""
    fit = made.report.fit
    yield fit.recommendation
    yield fit.verdict_line
    for one in list_values(made):
        if one.sigma is not None:
            yield f"{one.name:32s}{_text(one)}  {one.unit}  ({one.origin})"
    yield f"{'left over':32s}{100.0 * made.residual:.2f} % of the signal"
    yield from (
        f"  {one.share:.0%} +- {one.sigma:.0%} of its power: {one.words}" for one in fit.causes
    )
    if fit.causes:
        yield f"measure next: {advise_measurement(fit.causes)}"
    remarks = dict.fromkeys(remark for one in made.exported for remark in one.remarks)
    yield from (f"note: {remark}" for remark in remarks)
    yield from made.checks
    yield f"written to {made.folder}: open twin.html"


def _text(one: Value) -> str:
    """Return a value with its σ."""
    if isinstance(one.value, str):
        text = one.value
    else:
        text = f"{one.value:.5g}" if isinstance(one.value, float) else str(one.value)
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
    values = ((one.name, _text(one), one.unit, one.origin) for one in list_values(made))
    causes = ((one.words, f"{one.share:.0%} +- {one.sigma:.0%}", one.remedy) for one in fit.causes)
    models = [(one.path.name, "; ".join(one.remarks) or "complete") for one in made.exported]
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
            format_table(("Cause", "Share of the power left over", "Remedy"), causes),
            f"<p>{escape(advise_measurement(fit.causes))}</p>",
            "<h2>Models for other programs</h2>",
            format_table(("File", "What it does not contain or assumes"), models),
            *(f"<p>{escape(one)}</p>" for one in made.checks),
            "<h2>Files and notes</h2>",
            *(f'<p class="note">{escape(one)}</p>' for one in (*made.bench.inventory, *notes)),
        ],
    )


def _figure(made: Twin) -> str:
    """Return the figures of the fit, or why there are none."""
    stream = io.BytesIO()
    try:
        draw_sheet(made.report.fit, "", made.instrument).savefig(stream, format="png", dpi=80)
    except ConfigurationError as error:
        return f"<p>{escape(str(error))}</p>"
    data = base64.b64encode(stream.getvalue()).decode()
    return f'<figure><img alt="figures of the fit" src="data:image/png;base64,{data}"></figure>'
