"""Report a fitted system as JSON, as a table, and as HDF5."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import h5py
import numpy as np

from pyrcal.fitting import report as fit_report
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.report import FitReport
from pyrcal.fitting.system import ARCSEC_RAD, STAR, System
from pyrcal.fitting.system_fit import SystemFit, fit_system
from service.errors import shown
from service.files.container import put_array
from service.files.documents import json_text, pick
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS

MIN_PROBABILITY = 1e-4
"""Probability of χ² below which the pairs do not belong to one system."""

NOTABLE_UNSEEN_SHARE = 0.05
"""Share in unobservable directions above which a parameter is marked."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SystemReport:
    """A system, the fits of its pairs, and the fitted positions."""

    system: System
    fits: tuple[FitReport, ...]
    """Fits of the pairs, in the order of ``system.pairs``."""

    found: SystemFit | None
    """Fitted positions; None if no pair was accepted."""

    @property
    def unmeasured(self) -> frozenset[str]:
        """Sensors and mirrors without a used pair, whose positions are unknown."""
        system, used = self.system, set[str]()
        for pair, misfit in zip(
            system.pairs, self.found.misfit if self.found else (), strict=False
        ):
            if np.isfinite(misfit).all():
                used |= set(system.names(pair))
        names = {sensor.name for sensor in system.sensors}
        return frozenset((names | {mirror.name for mirror in system.mirrors}) - used)

    @property
    def refused(self) -> tuple[str, ...]:
        """Pairs whose own fit was refused, with its verdict."""
        return tuple(
            f"{' x '.join(self.system.names(pair))}: {_explain(one.fit)}"
            for pair, one in zip(self.system.pairs, self.fits, strict=True)
            if not one.fit.accepted
        )

    @property
    def accepted(self) -> bool:
        """True if every pair was accepted and all agree."""
        return (
            not self.refused
            and self.found is not None
            and self.found.probability >= MIN_PROBABILITY
        )

    @property
    def verdict(self) -> str:
        """Verdict in one line."""
        if self.refused or self.found is None:
            more = f" (and {len(self.refused) - 1} more)" if len(self.refused) > 1 else ""
            n_pairs = len(self.fits)
            return f"refused: {len(self.refused)} of {n_pairs} pairs{more}: {self.refused[0]}"
        agree = f"chi2 {self.found.chi2:.1f} where {self.found.n_free} is expected"
        if not self.accepted:
            return (
                f"refused: the pairs disagree ({agree}), most {self._worst(self.found)}: "
                f"{self._cause(self.found)}"
            )
        if not self.found.n_free:
            return "accepted: no number is measured twice, so that nothing checks another"
        return f"accepted: {len(self.fits)} pairs agree ({agree})"

    def _cause(self, found: SystemFit) -> str:
        """Return the change of the file that would make the pairs agree, if they show it."""
        system = self.system
        if not system.stars_move:
            free = replace(system, stars_move=True)
            alphas = np.array([one.fit.alpha.vector for one in self.fits])
            alphas[~np.isfinite(found.misfit).all(axis=1)] = np.nan
            moved = fit_system(free, alphas, np.array([one.fit.covariance for one in self.fits]))
            if moved.n_free and moved.probability >= MIN_PROBABILITY:
                return f'with stars = "direction" they agree: {self._farthest_star(moved)}'
        return (
            "an altitude, a star or a nominal place is not as the file says, or a matrix is "
            "another pair's"
        )

    def _farthest_star(self, moved: SystemFit) -> str:
        """Return the star with the largest offset from the file, relative to the other stars.

        A common direction of all stars changes no pair's α.
        """
        system = self.system
        places = [system.of_sensor(number) for number in range(len(system.sensors))]
        off = np.array([moved.values[one][STAR] - system.nominal[one][STAR] for one in places])
        # the mean of the others is the common direction, which α does not show
        n_others = max(len(off) - 1, 1)
        to_others = off - (off.sum(axis=0) - off) / n_others
        number = int(np.argmax(np.hypot(*off.T)))
        x, y = to_others[number] / ARCSEC_RAD
        return (
            f"the star of {system.sensors[number].name} is {x:+.2f}, {y:+.2f} arcseconds from "
            "the file's direction, relative to the other stars"
        )

    def _worst(self, found: SystemFit) -> str:
        number, column = np.unravel_index(np.nanargmax(np.abs(found.pulls)), found.pulls.shape)
        names = " x ".join(self.system.names(self.system.pairs[number]))
        off = found.misfit[number, column] * BOUNDARY_SCALE[column]
        pull = found.pulls[number, column]
        return f"{names}: {PARAMETERS[column]} by {off:+.3g}, {abs(pull):.1f} sigma"


def document(report: SystemReport) -> dict[str, Any]:
    """Return the report as one JSON object, in boundary units.

    ``sensors`` and ``mirrors`` have an object for each name, with ``value``, ``sigma``, ``nominal``
    and ``unseen_share`` of each parameter of its position; ``sigma`` is None for parameters that
    are not fitted. Both are None if no pair with it was accepted. ``pairs`` has the output of
    ``pyrcal fit --json``.
    """
    system, found = report.system, report.found
    pairs: dict[str, dict[str, Any]] = {sensor.name: {} for sensor in system.sensors}
    for pair, one in zip(system.pairs, report.fits, strict=True):
        sensor, mirror = system.names(pair)
        pairs[sensor][mirror] = fit_report.document(one)
    places: dict[str, dict[str, Any]] = {}
    for row in _rows(report):
        number = pick(row, "value sigma nominal unseen_share")
        places.setdefault(row.owner, {})[row.name] = number
    return {
        "system": system.name,
        "verdict": report.verdict,
        "chi2": None if found is None else found.chi2,
        "n_free": None if found is None else found.n_free,
        "not_seen": [] if found is None else list(found.unseen),
        "sensors": {one.name: places.get(one.name, {}) for one in system.sensors},
        "mirrors": {one.name: places.get(one.name, {}) for one in system.mirrors},
        "pairs": pairs,
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class _Row:
    """One parameter in boundary units; values are None if infinite or unknown."""

    owner: str
    name: str
    value: float | None
    sigma: float | None
    nominal: float | None
    unseen_share: float


def _explain(fit: Fit) -> str:
    """Return the reason of a fit's verdict; a fit by hand has its verdict alone."""
    return fit.verdict if fit.registration is None else fit.registration.reason


def _rows(report: SystemReport) -> Iterator[_Row]:
    found, system, unmeasured = report.found, report.system, report.unmeasured
    if found is None:
        return
    for parameter, value, sigma, nominal, share in zip(
        system.parameters,
        found.values,
        found.sigma,
        system.nominal,
        found.unseen_share,
        strict=True,
    ):
        finite = bool(np.isfinite(nominal))
        known = not (parameter.free and parameter.owner in unmeasured)
        yield _Row(
            owner=parameter.owner,
            name=parameter.name,
            value=float(value * parameter.boundary) if finite and known else None,
            sigma=float(sigma * parameter.boundary) if parameter.free and known else None,
            nominal=float(nominal * parameter.boundary) if finite else None,
            unseen_share=round(float(share), 4),
        )


def table(report: SystemReport) -> str:
    """Return the verdict, the positions, and α of each pair as text."""
    lines = [report.verdict, "", *_place_lines(report)]
    if report.found is not None:
        lines += [f"not seen: {words}" for words in report.found.unseen]
    lines += ["", *_pair_lines(report)]
    for pair, one in zip(report.system.pairs, report.fits, strict=True):
        names = " x ".join(report.system.names(pair))
        lines += [f"note: {names}: {note}" for note in one.notes]
    return "\n".join(shown(line) for line in lines)


def _place_lines(report: SystemReport) -> Iterator[str]:
    rows = list(_rows(report))
    if not rows:
        return
    yield f"{'':28s}{'value':>12s}{'1 sigma':>12s}{'nominal':>12s}"
    for row in rows:
        if row.sigma is None:
            continue
        mark = (
            "  only relative to others: see not seen"
            if row.unseen_share > NOTABLE_UNSEEN_SHARE
            else ""
        )
        numbers = "".join(
            f"{number:12.6g}" if number is not None else f"{'':>12s}"
            for number in (row.value, row.sigma, row.nominal)
        )
        yield f"{row.owner + ' ' + row.name:28s}{numbers}{mark}"


def _pair_lines(report: SystemReport) -> Iterator[str]:
    yield f"{'pair':28s}" + "".join(
        f"{name:>12s}" for name in ("shift x", "shift y", "rotation", "magnif.", "residual %")
    )
    for pair, one in zip(report.system.pairs, report.fits, strict=True):
        values = one.fit.alpha.vector * BOUNDARY_SCALE
        numbers = "".join(f"{value:12.5f}" for value in values)
        names = " x ".join(report.system.names(pair))
        refusal_mark = "" if one.fit.accepted else "  refused"
        yield f"{names:28s}{numbers}{100.0 * one.fit.residual_fraction:12.2f}{refusal_mark}"


def fill_system(file: h5py.File, report: SystemReport) -> None:
    """Write everything into an open, empty HDF5 file; pairs as ``pyrcal fit`` writes them.

    Each pair is the group ``pairs/SENSOR/MIRROR``; the JSON document is the attribute ``document``.
    """
    for pair, one in zip(report.system.pairs, report.fits, strict=True):
        sensor, mirror = report.system.names(pair)
        fit_report.fill_fit(file.create_group(f"pairs/{sensor}/{mirror}"), one)
    found, parameters = report.found, report.system.parameters
    if found is not None:
        boundary = np.array([parameter.boundary for parameter in parameters])
        described = "of the numbers that `parameters` names, in the units of their names"
        scale = np.outer(boundary, boundary)
        unknown = np.array([one.free and one.owner in report.unmeasured for one in parameters])
        values, covariance = found.values * boundary, found.covariance * scale
        values[unknown] = covariance[unknown] = covariance[:, unknown] = np.nan
        put_array(file, "values", values, f"(n,) {described}; NaN: no accepted pair")
        put_array(file, "covariance", covariance, f"(n, n) {described}; 0: not found")
        put_array(file, "unseen_share", found.unseen_share, f"(n,) {described}, not seen, 0 to 1")
        put_array(file, "pulls", found.pulls, "(n_pairs, 4) what is left of each pair over 1 sigma")
        file["values"].attrs["parameters"] = [f"{one.owner}.{one.name}" for one in parameters]
    file.attrs["system"], file.attrs["verdict"] = report.system.name, report.verdict
    file.attrs["accepted"] = report.accepted
    file.attrs["document"] = json_text(document(report))
