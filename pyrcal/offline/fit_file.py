"""Fit the matrix in a file: one way for command line and REST."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.offline.matrix import FitOptions, fit_matrix
from pyrcal.offline.memory import check_fit
from pyrcal.offline.recorded import FLUX_FRAME, Recorded, read_recorded
from pyrcal.offline.report import FitReport
from service.errors import MatrixError
from service.estimation.reference import Reference
from service.files.disk_cache import cached_basis
from service.model.instrument import Instrument, instrument_sha256
from service.model.modes import Basis
from service.model.sensors.registry import kind_of

Progress = Callable[[str], None]


def fit_file(
    instrument: Instrument,
    path: Path,
    options: FitOptions,
    *,
    dataset: str | None = None,
    threads: int = 2,
    memory_gb: float | None = None,
    basis: Basis | None = None,
    progress: Progress | None = None,
) -> FitReport:
    """Return the fit of the measured matrix in a file.

    ``basis`` are the instrument's modes; None: from the cache on disk, or made here.
    What would take more than ``memory_gb`` is refused before it is fitted; None: it is not asked.

    Raises
    ------
    MatrixError
        If the file or the matrix cannot be used.
    ModelError
        If the optical model cannot work with the instrument or the options.
    """
    recorded = read_recorded(path, dataset)
    reference, notes = reference_of(recorded, instrument)
    options = replace(options, explain=True)
    if memory_gb is not None:
        n_modes = len(reference.columns if options.modes is None else options.modes)
        check_fit(instrument, n_modes, memory_gb, gain_map=options.gain_map)
    begun = time.perf_counter()
    tell = progress or (lambda _: None)
    # BLAS keeps to one thread: nested threading made a fit seven times slower
    with threadpool_limits(1), ThreadPoolExecutor(threads) as pool:
        try:
            if basis is None:
                tell("modes")
                basis = cached_basis(instrument)
            fit = fit_matrix(
                instrument, reference, options, basis=basis, mapper=pool.map, progress=tell
            )
        except MatrixError as error:
            text = str(error).removeprefix("reference: ")
            raise MatrixError(f"{recorded.where}: {text}") from error
    return FitReport(
        fit=fit,
        method=options.method,
        instrument=instrument.name,
        instrument_sha256=instrument_sha256(instrument),
        reference=recorded.where,
        reference_sha256=recorded.sha256,
        double_pass=reference.double_pass,
        seconds=time.perf_counter() - begun,
        notes=(*notes, *fit.remarks),
    )


def reference_of(recorded: Recorded, instrument: Instrument) -> tuple[Reference, tuple[str, ...]]:
    """Return the matrix to be fitted, and the decisions made on the way.

    Raises
    ------
    MatrixError
        If the file holds frames and the instrument slopes, or the other way round.
    """
    notes = list(instrument.remarks)
    double_pass = instrument.double_pass
    if recorded.double_pass is not None and recorded.double_pass is not double_pass:
        double_pass = recorded.double_pass
        notes.append(
            f"double pass: {'yes' if double_pass else 'no'}, as the measured file says; the "
            "instrument file says otherwise"
        )
    if recorded.modes is not None:
        notes.append(f"columns belong to the {len(recorded.modes)} modes the measured file names")
    frames = recorded.values.ndim == 3
    if frames and recorded.noise is not None:
        notes.append("the noise in the measured file is of frames, not of slopes: not used")
    matrix = _slopes(recorded, instrument)
    if instrument.frames is not None and recorded.flux_frame is not None:
        notes.extend(kind_of(instrument).remarks_on_frames(instrument, recorded.flux_frame))
    reference = Reference(
        matrix=matrix,
        modes=recorded.modes,
        noise=None if frames else recorded.noise,
        double_pass=double_pass,
    )
    return reference, tuple(notes)


def _slopes(recorded: Recorded, instrument: Instrument) -> NDArray[np.float64]:
    """Return the measured slopes, cut from detector frames if need be."""
    found = f"{recorded.where}: found shape {recorded.values.shape}"
    if instrument.frames is None:
        if recorded.values.ndim == 3:
            raise MatrixError(
                f"{found}, expected (n_slopes, n_modes): detector frames need "
                'wfs.input = "frames" in the instrument file'
            )
        return recorded.values
    if recorded.values.ndim != 3:
        raise MatrixError(
            f'{found}, expected detector frames (n_modes, ny, nx): wfs.input is "frames"'
        )
    if recorded.flux_frame is None:
        raise MatrixError(
            f"{recorded.where}: found no {FLUX_FRAME} beside it, expected a mean detector frame "
            "(ny, nx) in the same counts"
        )
    flux_frame = recorded.flux_frame
    return kind_of(instrument).signals_of_frames(instrument, recorded.values, flux_frame)
