"""A fit in words, for somebody who wants to know whether to believe it and then go to bed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from service.errors import shown
from service.files.report import FitReport, orientation_words, verdict_line
from service.fit.options import Fit, ScanStep
from service.model.misregistration import BOUNDARY_SCALE

_ROWS = (
    ("shift x", "subapertures", 4),
    ("shift y", "subapertures", 4),
    ("rotation", "deg", 4),
    ("magnification", "ratio", 5),
)
"""Name, unit and decimals of each parameter."""

_FAR_GAIN = 0.2
"""Gains further than this from the median are named: such modes are worth a look."""

_NAMED = 8


def table(report: FitReport) -> str:
    """Return the verdict, the registration and what it rests on, as text."""
    fit = report.fit
    lines = [
        verdict_line(fit),
        "",
        *_registration(fit),
        "",
        *_basis(report),
        *_extras(fit),
        *(f"note: {note}" for note in report.notes),
    ]
    return "\n".join(shown(line) for line in lines)


def _registration(fit: Fit) -> Iterator[str]:
    yield f"{'':15s}{'value':>11s}{'1 sigma':>11s}{'subsets':>11s}"
    values = fit.alpha.vector * BOUNDARY_SCALE
    sigma = np.sqrt(np.diag(fit.covariance)) * BOUNDARY_SCALE
    scatter = fit.subset_scatter * BOUNDARY_SCALE
    for (name, unit, decimals), value, one, spread in zip(
        _ROWS, values, sigma, scatter, strict=True
    ):
        numbers = "".join(_number(number, decimals) for number in (value, one, spread))
        yield f"{name:15s}{numbers}  {unit}"


def _number(value: float, decimals: int) -> str:
    return f"{value:11.{decimals}f}" if np.isfinite(value) else f"{'-':>11s}"


def _basis(report: FitReport) -> Iterator[str]:
    fit = report.fit
    yield f"{'residual':20s}{100.0 * fit.residual_fraction:.2f} % of the measured slopes"
    yield f"{'modes used':20s}{len(fit.modes)} ({_spans(fit)})"
    for sentence in fit.left_out:
        yield f"{'left out':20s}{sentence}"
    yield f"{'gains':20s}{_gains(fit)}"
    yield f"{'condition number':20s}{fit.condition_number:.2f}"
    words = ", ".join(
        f"{k} = {v}" for k, v in orientation_words(fit.orientation, fit.order).items()
    )
    yield f"{'slopes':20s}{words}"
    yield f"{'double pass':20s}{'yes' if report.double_pass else 'no'}"
    yield f"{'method':20s}{report.method}, {fit.n_evaluations} matrices, {report.seconds:.1f} s"
    yield f"{'reference':20s}{report.reference}"
    yield f"{'instrument':20s}{report.instrument}"


def _extras(fit: Fit) -> Iterator[str]:
    if fit.anamorphosis is not None:
        along, across = 100.0 * fit.anamorphosis
        yield f"{'anamorphosis':20s}{along:+.3f} % along x, {across:+.3f} % along 45 deg"
    if fit.gain_map is not None:
        gains = fit.gain_map[fit.valid]
        yield f"{'gain over the pupil':20s}{gains.min():.2f} to {gains.max():.2f}"
    if fit.paper_table is not None:
        yield ""
        yield from paper_lines(fit.paper_table)


def paper_lines(steps: tuple[ScanStep, ...]) -> Iterator[str]:
    """Yield the paper's Table 1: which parameter was scanned, how finely, and its minimum."""
    yield f"{'step':>4s}  {'parameter':15s}{'from':>11s}{'to':>11s}{'every':>9s}{'minimum':>11s}"
    for number, scan in enumerate(steps, start=1):
        yield (
            f"{number:4d}  {scan.parameter:15s}{scan.samples.min():11.4f}"
            f"{scan.samples.max():11.4f}{scan.step:9.4f}{scan.minimum:11.4f}"
        )


def _spans(fit: Fit) -> str:
    """Return the modes as ranges, ends included."""
    modes = np.sort(fit.modes)
    runs = np.split(modes, np.flatnonzero(np.diff(modes) > 1) + 1)
    words = [f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs[:_NAMED]]
    return ", ".join(words) + (", ..." if len(runs) > _NAMED else "")


def _gains(fit: Fit) -> str:
    low, middle, high = np.percentile(fit.gains, [5.0, 50.0, 95.0])
    text = f"median {middle:.3g}, 90 % of them within {low:.3g} to {high:.3g}"
    far = fit.modes[np.abs(fit.gains / middle - 1.0) > _FAR_GAIN]
    if len(far):
        named = ", ".join(str(mode) for mode in far[:_NAMED])
        more = f" and {len(far) - _NAMED} more" if len(far) > _NAMED else ""
        text += f"; more than {100 * _FAR_GAIN:.0f} % off: mode {named}{more}"
    return text
