"""``pyrcal fit-system``: from the matrices of all pairs to where each sensor and mirror is."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.figures import check_plots
from pyrcal.fitting.fit_file import fit_file
from pyrcal.fitting.matrix import FitOptions
from pyrcal.fitting.report import FitReport
from pyrcal.fitting.system import SHIFTS, Pair, System
from pyrcal.fitting.system_figures import write_system_sheet
from pyrcal.fitting.system_file import load_system
from pyrcal.fitting.system_fit import SystemFit, fit_system
from pyrcal.fitting.system_report import MIN_PROBABILITY, SystemReport, document, fill_system, table
from pyrcal.terminal import show_progress
from service.errors import MatrixError, PyrcalError
from service.files.container import DATASET, opened
from service.files.documents import json_text
from service.files.whole import write_whole
from service.model.instrument import Instrument
from service.model.kinds import Stop

ACCEPTED, REFUSED = 0, 1

PUPIL_SUBAP = 0.02
"""Displacement of the pupil on a grid above which the pairs are fitted again, subapertures."""

PUPIL_EFFECT = 0.2
"""Largest error of α over the shift of the pupil, if the fit had the pupil in the centre. Pairs
that disagree by more do so for another reason."""


def main(options: argparse.Namespace) -> int:
    """Fit every pair, fit the system, print the result, and return the exit status.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used.
    """
    if options.plot is not None:
        check_plots()
    report = fit_system_files(
        options.system, options.reference, dataset=options.dataset, threads=options.threads
    )
    print(json_text(document(report)) if options.json else table(report))
    if options.output is not None:
        write_whole(options.output, partial(fill_system, report=report))
    if options.plot is not None:
        write_system_sheet(report, options.plot)
    return ACCEPTED if report.accepted else REFUSED


def fit_system_files(
    system: str | Path, reference: str | Path, *, dataset: str | None = None, threads: int = 2
) -> SystemReport:
    """Return the positions of sensors, mirrors and stars of a system from its measured matrices.

    Parameters
    ----------
    system
        TOML file of sensors and mirrors.
    reference
        One HDF5 file, or one for each pair, with ``{sensor}`` and ``{mirror}`` in its name.
    dataset
        Dataset of each matrix; None for ``{sensor}/{mirror}/interaction_matrix``.
    threads
        Threads that share the work.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used.
    """
    about = load_system(Path(system))
    places = locate_matrices(about, Path(reference), dataset)
    stored = dict(zip(about.pairs, places, strict=True))
    return fit_pairs(about, lambda pair, one: _fit_pair(about, pair, one, stored[pair], threads))


def fit_pairs(system: System, fit: Callable[[Pair, Instrument], FitReport]) -> SystemReport:
    """Return the fit of the system from a fit of each pair as an instrument.

    A shifted sensor has the pupil off the centre of its grid. If that was not known, its pairs are
    fitted again with the displaced pupil. They are not fitted again if the pairs disagree by more
    than such a displacement explains, because the shift is then not that of the sensor. The first
    fit is kept if a pair that was accepted is refused with the displaced pupil.
    """
    fits = {pair: fit(pair, system.instrument(pair)) for pair in system.pairs}
    found = _fit_positions(system, fits, _select_pairs(fits))
    for number, sensor in enumerate(system.sensors):
        if found is None or sensor.instrument.stop is Stop.MIRROR:
            break
        shift = found.values[system.of_sensor(number)][SHIFTS]
        off = np.hypot(*(shift - [sensor.place.shift.real, sensor.place.shift.imag]))
        if off < PUPIL_SUBAP or _pairs_disagree(found, PUPIL_EFFECT * float(off)):
            continue
        again: dict[Pair, FitReport] = {}
        for pair in (pair for pair in system.pairs if pair.sensor == number):
            about = replace(system.instrument(pair), pupil_shift_subap=tuple(shift.tolist()))
            again[pair] = fit(pair, about)
        # a displaced pupil that makes an accepted pair fail is not the true one
        if all(one.fit.accepted or not fits[pair].fit.accepted for pair, one in again.items()):
            fits |= again
    accepted = np.array([one.fit.accepted for one in fits.values()])
    found = _fit_positions(system, fits, accepted)
    return SystemReport(system=system, fits=tuple(fits.values()), found=found)


def _pairs_disagree(found: SystemFit, by_subap: float) -> bool:
    """Return True if pairs differ significantly, and in shift by more than ``by_subap``."""
    apart = np.abs(found.misfit[:, SHIFTS])
    return found.probability < MIN_PROBABILITY and bool(np.nanmax(apart) > by_subap)


def _select_pairs(fits: dict[Pair, FitReport]) -> NDArray[np.bool_]:
    """Return the pairs that determine the pupil's position.

    These are the accepted ones, or the converged ones of a sensor without an accepted pair: a
    displaced pupil may be the only reason for a refusal.
    """
    trusted = {pair.sensor for pair, one in fits.items() if one.fit.accepted}
    return np.array(
        [
            one.fit.accepted or (one.fit.converged and pair.sensor not in trusted)
            for pair, one in fits.items()
        ]
    )


def _fit_positions(
    system: System, fits: dict[Pair, FitReport], used: NDArray[np.bool_]
) -> SystemFit | None:
    """Return the fit of the system from the used pairs; None if none is used."""
    alphas = np.array([one.fit.alpha.vector for one in fits.values()])
    alphas[~used] = np.nan
    covariances = np.array([one.fit.covariance for one in fits.values()])
    return fit_system(system, alphas, covariances) if used.any() else None


class StoredMatrix(NamedTuple):
    """File and data set of a pair's matrix."""

    path: Path
    dataset: str


def locate_matrices(system: System, reference: Path, dataset: str | None) -> list[StoredMatrix]:
    """Return the file and data set of each pair's matrix, in the order of ``system.pairs``.

    ``{sensor}`` and ``{mirror}`` in the file's name and in the data set's name are replaced by
    names.

    Raises
    ------
    MatrixError
        If a matrix is missing, or several pairs have the same one.
    """
    apart = any(name in str(reference) for name in ("{sensor}", "{mirror}"))
    named = dataset or (DATASET if apart else f"{{sensor}}/{{mirror}}/{DATASET}")
    found = []
    for pair in system.pairs:
        sensor, mirror = system.names(pair)

        def of_pair(text: str, sensor: str = sensor, mirror: str = mirror) -> str:
            return text.replace("{sensor}", sensor).replace("{mirror}", mirror)

        one = StoredMatrix(Path(of_pair(str(reference))), of_pair(named))
        if one in found:
            raise MatrixError(
                f"{one.path}:/{one.dataset.strip('/')}: found one matrix for several pairs, "
                "expected {sensor} and {mirror} in the name of the file or of --dataset"
            )
        _check_there(one, f"{sensor} x {mirror}")
        found.append(one)
    return found


def _check_there(stored: StoredMatrix, names: str) -> None:
    """Raise if the matrix of a pair is missing, before any other pair is fitted."""
    if not stored.path.is_file():
        raise MatrixError(f"{names}: found no file {stored.path}, expected the matrix of this pair")
    with opened(stored.path) as container:
        if not container.is_fits and container.find(stored.dataset) is None:
            raise MatrixError(
                f"{names}: found no dataset {stored.dataset} in {stored.path}, expected the "
                f"matrix of this pair; it holds {container.listing()}"
            )


def _fit_pair(
    system: System, pair: Pair, about: Instrument, stored: StoredMatrix, threads: int
) -> FitReport:
    names = " x ".join(system.names(pair))
    lit = system.lit(pair)
    try:
        report = fit_file(
            about,
            stored.path,
            FitOptions(modes=lit),
            dataset=stored.dataset,
            threads=threads,
            basis=system.basis(pair),
            progress=lambda step: show_progress(f"{names}: {step}"),
        )
    except PyrcalError as error:
        raise type(error)(f"{names}: {error}") from error
    if lit is None:
        return report
    mirror = system.mirrors[pair.mirror].instrument.analytic_mirror
    outside = (
        f"{len(mirror.positions_m) - len(lit)} of {len(mirror.positions_m)} actuators are outside "
        "the star's light"
    )
    return replace(report, notes=(*report.notes, outside))
