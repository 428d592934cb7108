"""A fit together with what it was made from, as a JSON document and as a table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import shown
from service.fit.options import Fit, Method, ScanStep
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS
from service.model.slopes import Orientation, SlopeOrder


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitReport:
    """What was found, from which file, for which instrument."""

    fit: Fit
    """What was found."""

    method: Method
    """How."""

    instrument: str
    """Name of the instrument."""

    instrument_sha256: str
    """Of everything that is known of the instrument, arrays included."""

    reference: str
    """File and array that were fitted."""

    reference_sha256: str
    """Of the whole file."""

    double_pass: bool
    """Whether the matrix was taken as twice the model's."""

    seconds: float
    """Time of the fit, the optical model included and reading not."""

    notes: tuple[str, ...] = ()
    """What was decided on the way and should be known, one sentence each."""


def document(report: FitReport) -> dict[str, Any]:
    """Return the fit as one JSON object, in boundary units; a number that is not finite is None.

    ``gains`` belong to the modes used, in the order of the basis. What was left out is named in
    ``verdict``, which begins with "accepted" or "refused".
    """
    fit = report.fit
    sigma = np.sqrt(np.diag(fit.covariance)) * BOUNDARY_SCALE
    return {
        **fit.alpha.to_boundary(),
        "sigma": _four(sigma),
        "covariance": _plain(fit.covariance * np.outer(BOUNDARY_SCALE, BOUNDARY_SCALE)),
        "gains": _plain(fit.gains),
        "residual_fraction": _plain(fit.residual_fraction),
        "condition_number": _plain(fit.condition_number),
        "n_modes_used": len(fit.modes),
        "orientation": orientation_words(fit.orientation, fit.order),
        "subset_scatter": _four(fit.subset_scatter * BOUNDARY_SCALE),
        "converged": bool(fit.converged),
        "verdict": verdict_line(fit),
        "notes": list(report.notes),
        "seconds": round(report.seconds, 3),
    }


def verdict_line(fit: Fit) -> str:
    """Return the verdict and what was left out, in one line."""
    if not fit.left_out:
        return fit.verdict
    return f"{fit.verdict}; left out: {'; '.join(fit.left_out)}"


def orientation_words(orientation: Orientation, order: SlopeOrder) -> dict[str, Any]:
    """Return order and orientation as the instrument file would say them."""
    both = [orientation.sign_x, orientation.sign_y]
    return {
        "order": str(order),
        "swap_xy": orientation.swap_xy,
        "flip_x": orientation.flip_x,
        "flip_y": orientation.flip_y,
        "sign": both[0] if both[0] == both[1] else both,
    }


def _four(values: NDArray[np.float64]) -> dict[str, float | None]:
    return dict(zip(PARAMETERS, _plain(values), strict=True))


def _plain(values: float | NDArray[np.float64]) -> Any:  # noqa: ANN401 - as nested as the array
    """Return numbers or nested lists of them, None for what is not finite."""
    array = np.asarray(values, dtype=np.float64)
    plain = array.astype(object)
    plain[~np.isfinite(array)] = None
    return plain.tolist()


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
