"""The report of ``pyrcal commission``: one HTML file with its figures inside."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pyrcal.fitting.figures import check_plots, new_figure
from pyrcal.maintenance.acceptance import (
    Commissioning,
    Criterion,
    Judgement,
    compare_residuals,
    residuals_per_mode,
)
from service.errors import ConfigurationError
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.records.alarms import ALARMS
from service.records.registration import Source
from service.version import software_version

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LABELS = ("shift x, subap", "shift y, subap", "rotation, deg", "magnification")

_BLUE, _GREY, _RED, _GREEN, _AMBER = "#1f6fb2", "#7f8c8d", "#c0392b", "#1d7f4e", "#d98a00"

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1d2433; background: #fff;
       max-width: 1000px; margin: 24px auto; padding: 0 20px; }
h1 { font-size: 26px; margin-bottom: 4px; } h2 { font-size: 19px; margin-top: 34px; }
table { border-collapse: collapse; width: 100%; margin: 10px 0; font-size: 14px; }
th, td { border-bottom: 1px solid #d8dde6; padding: 5px 8px; text-align: left;
         vertical-align: top; overflow-wrap: break-word; }
th { background: #f3f5f9; } .scroll { overflow-x: auto; }
.pass { color: #14633b; font-weight: 600; } .fail { color: #b3261e; font-weight: 600; }
.missing { color: #8a5a00; font-weight: 600; }
.verdict { padding: 10px 14px; border-radius: 6px; font-weight: 600; margin: 14px 0; }
.verdict.pass { background: #e3f4ea; } .verdict.fail { background: #fbe6e4; }
.verdict.missing { background: #fdf3d8; }
figure { margin: 14px 0; } figcaption { color: #4a5366; font-size: 13px; }
svg, img { max-width: 100%; height: auto; } .note { color: #4a5366; }
@media print { body { max-width: none; } figure { break-inside: avoid; } }
"""


def write_page(data: Commissioning, criteria: Sequence[Criterion], path: Path) -> None:
    """Write the report.

    Raises
    ------
    ConfigurationError
        If matplotlib is not installed, or the file cannot be written.
    """
    check_plots("pyrcal commission")
    text = format_page(data, criteria)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"--output: cannot write {path}: {error}") from error


def format_page(data: Commissioning, criteria: Sequence[Criterion]) -> str:
    """Return the report as HTML that needs no other file."""
    n_passed = sum(one.outcome is Judgement.PASS for one in criteria)
    accepted = n_passed == len(criteria)
    verdict = "ACCEPTED" if accepted else "NOT ACCEPTED"
    parts = [
        f'<p class="note">{_time(data.first_ns)} to {_time(data.last_ns)} UTC. Written '
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC by pyrcal {software_version()}.</p>",
        f'<p class="verdict {"pass" if accepted else "fail"}">{verdict}: '
        f"{n_passed} of {len(criteria)} criteria passed</p>",
        "<h2>Acceptance</h2>",
        _criteria_table(criteria),
        "<h2>Instrument and sources</h2>",
        format_table(("", ""), _instrument_rows(data)),
        "<h2>RTC against the contract</h2>",
        _checks(data),
        "<h2>Fit of the measured interaction matrix</h2>",
        _fit(data),
        "<h2>Registration over time</h2>",
        _figure(
            _draw_alpha(data),
            "α with 1 σ after each measurement, and the single measurements. Dashed lines: a "
            "matrix of the service came into use."
            + (" Dotted: the fit of the measured matrix." if data.fit else ""),
        ),
        "<h2>Matrices and their probation</h2>",
        _matrices(data),
        "<h2>Wavefront before and after</h2>",
        _figure(
            _draw_wavefront(data),
            "Residual per controlled mode as the matrix in use measures it (not corrected for "
            "optical gain), and the largest closed-loop pole radius over its bound.",
        ),
        "<h2>Alarms</h2>",
        _alarms(data),
    ]
    return format_html(f"Commissioning of {data.instrument.name}", parts)


def format_html(title: str, parts: Iterable[str]) -> str:
    """Return a page of parts that are HTML already, with a heading and this style."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body>\n"
        f"<h1>{escape(title)}</h1>\n" + "\n".join(parts) + "\n</body></html>\n"
    )


def _criteria_table(criteria: Sequence[Criterion]) -> str:
    rows = (
        (
            one.group,
            one.name,
            one.found,
            one.limit,
            _mark(one.outcome, one.outcome),
            "" if one.outcome is Judgement.PASS else one.remedy,
        )
        for one in criteria
    )
    return format_table(
        ("Part", "Criterion", "Measured", "Limit", "Outcome", "If not passed"), rows
    )


def _instrument_rows(data: Commissioning) -> Iterable[tuple[str, str]]:
    instrument = data.instrument
    yield "Instrument", instrument.name
    yield "Telescope", f"{instrument.diameter_m:g} m, obscuration {instrument.obscuration_ratio:g}"
    sensor = instrument.wfs
    yield "Sensor", f"{sensor.kind}, {sensor.n_subapertures} subapertures across"
    yield "Modes wanted", f"{data.settings.control.n_modes_target}"
    yield "Mode of the service at the start", data.settings.service.mode
    for what, where in data.origins.items():
        yield f"Source: {what}", where


def _checks(data: Commissioning) -> str:
    if data.checks is None:
        return "<p>No result of pyrcal check-rtc was given.</p>"
    classes = {"ok": "pass", "wrong": "fail", "seen": "missing", "skipped": "note"}
    rows = (
        (
            str(one["check"]),
            # The file may come from a check-rtc of another version.
            ", ".join(map(str, one.get("requirements", ()))),
            _mark(str(one["outcome"]), classes.get(one["outcome"], "note")),
            str(one["found"]),
        )
        for one in data.checks
    )
    return format_table(("Check", "Requirements", "Outcome", "Finding"), rows)


def _fit(data: Commissioning) -> str:
    if data.fit is None:
        return "<p>No result of pyrcal fit was given.</p>"
    fit = data.fit
    rows = [
        (label, f"{fit[name]:.5g}", f"{fit['sigma'][name]:.2g}")
        for label, name in zip(_LABELS, PARAMETERS, strict=True)
    ]
    control = fit["reconstructor"]
    text = f"<p>Registration: {escape(str(fit['verdict']))}.</p>"
    if control is not None:
        text += (
            f"<p>Reconstructor: {control['stable_modes']} of {control['n_modes']} modes are "
            f"stable at gain {control['gain']:g}. {escape(str(control['reason']))}</p>"
        )
    return (
        text
        + format_table(("Parameter, unit", "Fit", "1 σ"), rows)
        + _figure(_draw_gains(fit), "Gain of each mode of the measured matrix over the model's.")
    )


def _matrices(data: Commissioning) -> str:
    # The last state of a probation counts, in the order of the audit trail.
    verdicts: dict[str, str] = {}
    for _, state, text in data.probations:
        name, _, words = text.partition(": ")
        verdicts[name] = f"{state}: {words}"
    rows = (
        (
            one.id,
            str(one.n_modes),
            str(one.state),
            "" if one.gate is None else f"{one.gate.worst_pole_radius:.3f} of {one.gate.bound:g}",
            verdicts.get(one.id, ""),
            one.reason,
        )
        for one in sorted(data.matrices, key=lambda one: one.created_ns_utc)
    )
    return format_table(
        ("Matrix", "Modes", "State", "Largest pole radius", "Probation", "Reason"), rows
    )


def _alarms(data: Commissioning) -> str:
    if not data.alarms:
        return "<p>None.</p>"
    rows = []
    for name, begin_ns, end_ns in data.alarms:
        # An alarm that is not in the table is a rule of the observatory's own settings.
        known = ALARMS.get(name)
        severity, means = (
            ("a rule of the settings", "") if known is None else (known.severity, known.means)
        )
        rows.append((name, severity, _time(begin_ns), f"{(end_ns - begin_ns) * 1e-9:.0f} s", means))
    return format_table(("Alarm", "Severity", "Began (UTC)", "Lasted", "Meaning"), rows)


# --- figures


def _draw(n_rows: int, height_in: float) -> tuple[Figure, list[Axes]]:
    figure = new_figure(9.6, height_in, "pyrcal commission")
    axes = figure.subplots(n_rows, 1, sharex=True, squeeze=False)[:, 0]
    for one in axes:
        one.spines[["top", "right"]].set_visible(False)
        one.grid(alpha=0.25)
    return figure, list(axes)


def _draw_alpha(data: Commissioning) -> Figure:
    figure, axes = _draw(4, 7.6)
    entered = [one for one in data.estimates if one.entered]
    minutes = _minutes(data, [one.t_ns_utc for one in entered])
    filtered = np.array([one.filtered.vector for one in entered]).reshape(-1, 4) * BOUNDARY_SCALE
    sigma = np.array([one.filtered_sigma for one in entered]).reshape(-1, 4) * BOUNDARY_SCALE
    for k, (axis, label) in enumerate(zip(axes, _LABELS, strict=True)):
        _mark_swaps(axis, data)
        low, high = filtered[:, k] - sigma[:, k], filtered[:, k] + sigma[:, k]
        axis.fill_between(minutes, low, high, color=_BLUE, alpha=0.2, lw=0, label="1 σ")
        axis.plot(minutes, filtered[:, k], color=_BLUE, lw=1.6, marker=".", ms=4, label="α")
        for source, colour, name in (
            (Source.LOCK_IN, _GREY, "windows"),
            (Source.RANDOM, _AMBER, "random signs"),
        ):
            mine = [one for one in data.estimates if one.source is source]
            if mine:
                times = _minutes(data, [one.t_ns_utc for one in mine])
                values = [one.measured.vector[k] * BOUNDARY_SCALE[k] for one in mine]
                axis.plot(times, values, "+", ms=6, color=colour, label=name)
        if data.fit is not None:
            axis.axhline(data.fit[PARAMETERS[k]], color=_GREEN, lw=1.0, ls=":", label="fit")
        axis.set_ylabel(label)
    axes[0].legend(loc="upper left", ncols=5, fontsize=8, frameon=False)
    axes[-1].set_xlabel("minutes")
    return figure


def _draw_wavefront(data: Commissioning) -> Figure:
    figure, (residual, margin) = _draw(2, 4.6)
    judged = [(one.t_ns_utc, one.margin) for one in data.samples if one.margin is not None]
    residuals_nm = [(t_ns, 1e9 * value_m) for t_ns, value_m in residuals_per_mode(data)]
    for axis, points in ((residual, residuals_nm), (margin, judged)):
        _mark_swaps(axis, data)
        times = _minutes(data, [t_ns for t_ns, _ in points])
        axis.plot(times, [value for _, value in points], color=_BLUE, marker=".", lw=1.4)
    # The two medians that the criterion compares, over the time between which it looks for them.
    before, after = compare_residuals(data)
    limits = [data.swaps_ns[0], data.swaps_ns[-1]] if data.swaps_ns else []
    for values, ends_ns in (
        (before, (data.first_ns, *limits[:1])),
        (after, (*limits[1:], data.last_ns)),
    ):
        if values and len(ends_ns) == 2:
            median_nm = 1e9 * float(np.median(values))
            residual.plot(_minutes(data, ends_ns), [median_nm] * 2, color=_GREEN, lw=1.2, ls="--")
    residual.set_ylabel("nm RMS per mode")
    residual.set_ylim(bottom=0.0)
    margin.axhline(1.0, color=_RED, lw=1.0)
    margin.set(ylabel="pole radius / bound", xlabel="minutes")
    return figure


def _draw_gains(fit: dict[str, Any]) -> Figure:
    figure, (axis,) = _draw(1, 2.4)
    # A mode without a gain leaves a gap in the line.
    gains = [np.nan if one is None else one for one in fit["gains"]]
    axis.plot(gains, color=_BLUE, marker=".", ms=3, lw=0.8)
    axis.axhline(1.0, color=_GREY, lw=0.8)
    axis.set(xlabel="fitted mode", ylabel="gain")
    return figure


def _mark_swaps(axis: Axes, data: Commissioning) -> None:
    for minutes in _minutes(data, data.swaps_ns):
        axis.axvline(minutes, color=_GREEN, lw=1.0, ls="--")


def _minutes(data: Commissioning, times_ns: Iterable[int]) -> list[float]:
    return [(t_ns - data.first_ns) / 60e9 for t_ns in times_ns]


# --- HTML


class _Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def _mark(text: str, kind: str) -> _Html:
    """Return a word in the colour of its class."""
    return _Html(f'<span class="{kind}">{escape(text)}</span>')


def format_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table with a heading; text is escaped."""

    def cells(kind: str, row: Sequence[str]) -> str:
        texts = (one if isinstance(one, _Html) else escape(one) for one in row)
        return "<tr>" + "".join(f"<{kind}>{text}</{kind}>" for text in texts) + "</tr>"

    top = f"<thead>{cells('th', head)}</thead>" if any(head) else ""
    body = "\n".join(cells("td", row) for row in rows)
    return f'<div class="scroll"><table>{top}<tbody>{body}</tbody></table></div>'


def _figure(figure: Figure, caption: str) -> str:
    from matplotlib import rc_context

    stream = io.StringIO()
    # Text stays text, so that the report can be searched; a fixed salt makes it reproducible.
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "pyrcal"}):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    svg = stream.getvalue()
    svg = svg[svg.index("<svg") :]
    return f"<figure>{svg}<figcaption>{escape(caption)}</figcaption></figure>"


def _time(t_ns: int) -> str:
    return f"{datetime.fromtimestamp(t_ns // 1_000_000_000, UTC):%Y-%m-%d %H:%M:%S}"
