"""``pyrcal fit-system``: from the matrices of all pairs to where each sensor and mirror is."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pyrcal.offline.figures import check_plots
from pyrcal.offline.fit_file import fit_file
from pyrcal.offline.matrix import FitOptions
from pyrcal.offline.report import FitReport
from pyrcal.offline.system import Pair, System
from pyrcal.offline.system_figures import write_system_sheet
from pyrcal.offline.system_file import load_system
from pyrcal.offline.system_fit import fit_system
from pyrcal.offline.system_report import SystemReport, document, fill_system, table
from pyrcal.terminal import show_progress
from service.archive.store import write_whole
from service.errors import MatrixError, PyrcalError
from service.files.container import DATASET, opened

ACCEPTED, REFUSED = 0, 1


def main(options: argparse.Namespace) -> int:
    """Fit every pair, find where everything is, print it, and return the exit status.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used.
    """
    if options.plot is not None:
        check_plots()
    system = load_system(options.system)
    stored = matrices_of(system, options.reference, options.dataset)
    fits = tuple(
        _fitted(system, pair, one, options.threads)
        for pair, one in zip(system.pairs, stored, strict=True)
    )
    report = report_of(system, fits)
    print(json.dumps(document(report), allow_nan=False) if options.json else table(report))
    if options.output is not None:
        write_whole(options.output, partial(fill_system, report=report))
    if options.plot is not None:
        write_system_sheet(report, options.plot)
    return ACCEPTED if report.accepted else REFUSED


def report_of(system: System, fits: tuple[FitReport, ...]) -> SystemReport:
    """Return where everything is, from the fits of all pairs; refused ones tell nothing."""
    accepted = np.array([one.fit.accepted for one in fits])
    alphas = np.array([one.fit.alpha.vector for one in fits])
    alphas[~accepted] = np.nan
    covariances = np.array([one.fit.covariance for one in fits])
    found = fit_system(system, alphas, covariances) if accepted.any() else None
    return SystemReport(system=system, fits=fits, found=found)


class StoredMatrix(NamedTuple):
    """Where the matrix of a pair is."""

    path: Path
    dataset: str


def matrices_of(system: System, reference: Path, dataset: str | None) -> list[StoredMatrix]:
    """Return where the matrix of each pair is, in the order of ``system.pairs``.

    ``{sensor}`` and ``{mirror}`` in the file's name and in that of the data set stand for names.

    Raises
    ------
    MatrixError
        If one is missing, or all are the same.
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
    """Refuse a pair whose matrix is missing, before any other is fitted."""
    if not stored.path.is_file():
        raise MatrixError(f"{names}: found no file {stored.path}, expected the matrix of this pair")
    with opened(stored.path) as container:
        if not container.is_fits and container.find(stored.dataset) is None:
            raise MatrixError(
                f"{names}: found no dataset {stored.dataset} in {stored.path}, expected the "
                f"matrix of this pair; it holds {container.listing()}"
            )


def _fitted(system: System, pair: Pair, stored: StoredMatrix, threads: int) -> FitReport:
    names = " x ".join(system.names(pair))
    lit = system.lit(pair)
    try:
        report = fit_file(
            system.instrument(pair),
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
        f"{len(mirror.positions_m) - len(lit)} of {len(mirror.positions_m)} actuators lie outside "
        "the star's light"
    )
    return replace(report, notes=(*report.notes, outside))
