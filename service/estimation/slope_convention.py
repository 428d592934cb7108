"""Check the RTC's slopes and commands against the instrument file.

An RTC whose slopes have the opposite sign, other axes or another order, or whose commands are in
nanometres, closes its own loop without any problem, because it is consistent with itself. The error
shows only in comparison with the model, and a matrix made by the model would open its loop. Two
sources are compared: the matrix in use, whose inverse is the interaction matrix as that RTC knows
it, and the slopes that respond to a dither.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.control.reconstructor import MAX_CONDITION
from service.errors import MatrixError
from service.estimation.orientation import (
    MIN_CORRELATION,
    MIN_CORRELATION_LEAD,
    Pose,
    coarse_model,
    format_setting,
    format_sign,
    poses_of,
    settings_of,
)
from service.estimation.reference import Reference
from service.model.instrument import Instrument
from service.model.misregistration import Misregistration, unit_like, wrap_angle
from service.model.modes import Basis
from service.model.pupil import rtc_valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Mapper
from service.model.slopes import FLIPS, SlopeRecipe, orient_mask, to_conventions

Array = NDArray[Any]

MAX_ROTATION_RAD = np.deg2rad(30.0)
"""Rotations further than this from where a fit starts are another mounting, or other axes."""

MIN_AXES_CORRELATION = 0.5
"""Smallest correlation of a dither's response with the model for axes to be accepted."""

OTHER_AXES_ADVANTAGE = 2.0
"""The stated ones must do worse by this factor."""

_ONE_MODE = 2
"""If more than this number of lines respond, a single contradicting line is a mode with a wrong
response: wrong axes turn about half of them. The next dithered modes decide if it was the axes."""

LAGS_FRAMES = np.arange(-3.0, 3.1, 0.5)
"""Frames by which slopes may lag the commands of their row and still be recognised."""

RESPONSE_RATIO_RANGE = (0.1, 3.0)
"""Slopes per unit of command over the model's: the optical gain, and by day both passes."""

DOUBLED_RESPONSE_RANGE = (1.5, 3.0)
"""The same of a matrix that halves every command, which no optical gain does."""

_UNIT_DECADES = 1.4
"""Powers of ten around a unit that are still recognised as it: optical gains are in between."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SlopeConvention:
    """The RTC's order, signs and unit as its matrix shows them."""

    wrong: str = ""
    """Finding, what the file states, and the change to make; empty if they agree."""

    found: SlopeRecipe | None = None
    """Order and orientation of the slopes, if they were clear."""

    adopted: bool = False
    """True if the model uses this slope order from now on, because the file says "auto"."""

    rotation_rad: float | None = None
    """Rough rotation of the mirror from the same source; None if it cannot be determined."""


def identify_from_reconstructor(
    reconstructor: NDArray[np.float32],
    instrument: Instrument,
    basis: Basis,
    *,
    near: Misregistration,
    response: NDArray[np.floating],
    mapper: Mapper = map,
) -> SlopeConvention:
    """Return the slope convention that the RTC's matrix in use ``(n_controlled, n_slopes)`` shows.

    ``near`` is the expected registration and ``response`` ``(n_slopes, n_modes)`` the model's
    response there: only the size of its columns counts.
    """
    used = np.flatnonzero(np.any(reconstructor != 0.0, axis=1))
    if not len(used) or not np.isfinite(reconstructor).all():
        return SlopeConvention()
    known = np.asarray(reconstructor[used], dtype=np.float64)
    measured = np.asarray(np.linalg.pinv(known, rcond=1.0 / MAX_CONDITION), dtype=np.float64)
    lower = used[: (len(used) + 1) // 2]
    sizes = np.linalg.norm(measured[:, : len(lower)], axis=0)
    ratio = float(np.median(sizes / np.linalg.norm(response[:, lower], axis=0)))
    unit = _unit_of_matrix(ratio, instrument)
    try:
        poses, _ = poses_of(
            coarse_model(instrument, basis.subset(used), mapper),
            instrument,
            Reference(matrix=measured, modes=used),
            list(settings_of(instrument.slopes, instrument.slopes.kind.orders)),
            mapper=mapper,
        )
    except MatrixError as error:
        return SlopeConvention(
            wrong=unit or f"the RTC's matrix answers to hardly any slope: {error}"
        )
    axes = _judge_candidates(poses, instrument, near.rotation_rad)
    return replace(axes, wrong="; ".join(part for part in (unit, axes.wrong) if part))


def identify_from_response(
    slopes: Array, expected: Array, turns_rad: Array, instrument: Instrument
) -> SlopeConvention:
    """Return the slope convention that the response to a dither shows.

    Parameters
    ----------
    slopes
        ``(n_lines, n_slopes)`` complex, at the lines of the dither, as the RTC lists them.
    expected
        The same by the model for the commands at those lines, as the RTC is stated to list them.
    turns_rad
        ``(n_lines,)`` phase by which each line advances in a frame: slopes that lag by half a
        period are no slopes of the other sign.
    """
    reported, mask = _report_recipe(instrument), rtc_valid_subapertures(instrument)
    model = _planes(expected, reported, mask)
    as_seen = _planes(slopes, reported, mask)
    as_stated = _resemblance(as_seen, model)
    lagging = max(
        _resemblance(as_seen * np.exp(1j * turns_rad * lag), model) for lag in LAGS_FRAMES
    )
    ratio = float(np.median(np.linalg.norm(slopes, axis=1) / np.linalg.norm(expected, axis=1)))
    unit = ""
    if (
        as_stated >= MIN_AXES_CORRELATION
        and not RESPONSE_RATIO_RANGE[0] < ratio < RESPONSE_RATIO_RANGE[1]
    ):
        unit = (
            f"slopes answer commands {ratio:.2g} times as the model does: "
            f"{_name_unit(ratio, instrument)}"
        )
    every = {
        setting: _resemblance(_planes(slopes, setting, mask), model)
        for setting in settings_of(reported, reported.kind.orders)
    }
    best = max(every.values())
    # A lag that explains the slopes better takes precedence: half a period of delay looks like the
    # other sign.
    if best < MIN_AXES_CORRELATION or as_stated * OTHER_AXES_ADVANTAGE > best or lagging > best:
        return SlopeConvention(wrong=unit)
    if (
        len(slopes) > _ONE_MODE
        and np.sum(_correlate_lines(as_seen, model) < MIN_AXES_CORRELATION) == 1
    ):
        return SlopeConvention(wrong=unit)
    alike = [setting for setting, much in every.items() if much > best - MIN_CORRELATION_LEAD]
    found = min(alike, key=lambda setting: _n_changes(setting, reported))
    return SlopeConvention(
        wrong=_axes_named("the answer to the dither", found, reported), found=found
    )


def _judge_candidates(
    poses: list[Pose], instrument: Instrument, start_rad: float
) -> SlopeConvention:
    reported = _report_recipe(instrument)
    best = max(poses, key=lambda pose: pose.correlation)
    stated = instrument.slopes.orientation is not None
    if best.correlation < MIN_CORRELATION:
        text = (
            'slopes.orientation is "auto", and no orientation explains the RTC\'s own matrix '
            f"(correlation {best.correlation:.2f}): its modes are another basis, or "
            "listed in another order: compare them with the file, or write [slopes] orientation"
        )
        return SlopeConvention(wrong="" if stated else text)
    alike = [pose for pose in poses if pose.correlation > best.correlation - MIN_CORRELATION_LEAD]
    near = [
        pose for pose in alike if abs(wrap_angle(pose.rotation_rad - start_rad)) <= MAX_ROTATION_RAD
    ]
    settings = {pose.slopes: pose.rotation_rad for pose in near}
    if reported in settings:
        return SlopeConvention(found=reported, rotation_rad=settings[reported])
    if not near:
        turned_deg = np.rad2deg(
            min(alike, key=lambda pose: _n_changes(pose.slopes, reported)).rotation_rad
        )
        return SlopeConvention(
            wrong=f"by the RTC's own matrix the mirror is turned by {turned_deg:.0f} deg, and by "
            f"{np.rad2deg(start_rad):.0f} deg by the instrument file: write nominal_rotation_deg = "
            f"{turned_deg:.0f} under [mirror], and restart the service"
        )
    found = min(settings, key=lambda setting: _n_changes(setting, reported))
    if not stated:
        return SlopeConvention(found=found, rotation_rad=settings[found])
    return SlopeConvention(wrong=_axes_named("the RTC's own matrix", found, reported), found=found)


def _report_recipe(instrument: Instrument) -> SlopeRecipe:
    return replace(instrument.slopes, orientation=instrument.slopes.assumed_orientation)


def _n_changes(setting: SlopeRecipe, reported: SlopeRecipe) -> int:
    """Return how many stated keys a setting contradicts."""
    axes, stated_axes = setting.assumed_orientation, reported.assumed_orientation
    names = (*FLIPS, "sign_x", "sign_y")
    changed = sum(bool(getattr(axes, name) != getattr(stated_axes, name)) for name in names)
    both_signs = axes.sign_x != stated_axes.sign_x and axes.sign_y != stated_axes.sign_y
    # light counted the other way round turns both signs: one thing
    return changed - both_signs + (setting.order != reported.order)


def _axes_named(witness: str, found: SlopeRecipe, reported: SlopeRecipe) -> str:
    """Return which axes, signs and orders differ from the file, and what to write."""
    axes, stated_axes = found.assumed_orientation, reported.assumed_orientation
    differ = []
    if found.order != reported.order:
        differ.append(f'slopes.order = "{found.order}" ("{reported.order}" in the file)')
    flips = [name for name in FLIPS if getattr(axes, name) != getattr(stated_axes, name)]
    differ += [f"orientation.{name} = {str(getattr(axes, name)).lower()}" for name in flips]
    if (axes.sign_x, axes.sign_y) != (stated_axes.sign_x, stated_axes.sign_y):
        differ.append(f"orientation.{format_sign(axes)} ({format_sign(stated_axes)} in the file)")
    turned = replace(stated_axes, sign_x=-stated_axes.sign_x, sign_y=-stated_axes.sign_y)
    only_the_sign = found == replace(reported, orientation=turned)
    other = "slopes have the other sign" if only_the_sign else "slopes lie otherwise"
    return (
        f"{other} than the instrument file says: {', '.join(differ)} by {witness}. Write "
        f"[slopes] {format_setting(found)}, and start the service again"
    )


def _unit_of_matrix(ratio: float, instrument: Instrument) -> str:
    """Return what is wrong with the unit of a matrix that expects so many times the model's slopes.

    An optical gain makes them fewer, the two passes of a day twice as many, and a pyramid whose
    modulation is half of the instrument file's nearly so.
    """
    if DOUBLED_RESPONSE_RANGE[0] < ratio < DOUBLED_RESPONSE_RANGE[1] and not instrument.double_pass:
        return (
            f"the RTC's own matrix expects {ratio:.2f} times the model's slopes: its slopes are in "
            "another unit than the instrument file says, its commands are metres of surface, not "
            "of OPD, it was measured in double pass ([instrument] double_pass = true), or "
            f"{_optic_named(ratio, instrument)}"
        )
    if RESPONSE_RATIO_RANGE[0] < ratio < RESPONSE_RATIO_RANGE[1]:
        return ""
    return (
        f"the RTC's own matrix expects {ratio:.2g} times the model's slopes: "
        f"{_name_unit(ratio, instrument)}"
    )


def _optic_named(ratio: float, instrument: Instrument) -> str:
    """Return the values of the sensor that also explain so many times the model's response."""
    key = kind_of(instrument).find_fitted_key(instrument.wfs)
    keys = "wavelength_m" if key is None else f"wavelength_m or {key}"
    return f"[wfs] {keys} is too {'large' if ratio > 1.0 else 'small'}"


def _name_unit(ratio: float, instrument: Instrument) -> str:
    """Return the unit of commands whose response is so many times that of metres of OPD."""
    unit = unit_like(1.0 / max(ratio, 1e-30), _UNIT_DECADES)
    if unit:
        return (
            f"commands look like {unit} (metres of OPD are expected), or slopes have another unit"
        )
    optic = _optic_named(ratio, instrument)
    return f"slopes or commands (metres of OPD) have another unit than in the file, or {optic}"


def _planes(rows: Array, slopes: SlopeRecipe, mask: NDArray[np.bool_]) -> Array:
    """Return slopes ``(n_lines, n_slopes)`` as maps ``(n_planes, n, n, n_lines)``.

    Of the sensor's axes; ``mask`` ``(n, n)`` [y, x] are the valid subapertures in the RTC's own.
    """
    listed = to_conventions(rows.T, slopes, mask)
    n_planes = slopes.kind.n_planes
    planes = np.zeros((n_planes, *mask.shape, len(rows)), dtype=listed.dtype)
    seen = orient_mask(mask, slopes.assumed_orientation)
    planes[:, seen] = listed.reshape(n_planes, -1, len(rows))
    return planes


def _resemblance(seen: Array, model: Array) -> float:
    """Return the mean correlation of the lines, -1..1: one sign for all, no lag."""
    return float(np.mean(_correlate_lines(seen, model)))


def _correlate_lines(seen: Array, model: Array) -> Array:
    """Return the correlation of each line, ``(n_lines,)``, -1..1."""
    lines = (0, 1, 2)
    along = np.sum(seen * model.conj(), axis=lines).real
    size = np.sqrt(np.sum(np.abs(seen) ** 2, axis=lines) * np.sum(np.abs(model) ** 2, axis=lines))
    correlations: Array = along / size
    return correlations
