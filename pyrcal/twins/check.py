"""Run exported models in their own programs, and compare the matrices that they measure."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from pyrcal.fitting.fit_file import make_reference
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.recorded import Recorded
from pyrcal.twins import oopao_model, specula_model
from pyrcal.twins.sampled import apply_fit, correlations, residual_fraction
from service.estimation.reference import target_of
from service.model.instrument import Instrument
from service.model.slopes import slopes_of

Array = NDArray[Any]

MAX_SECONDS = 3600.0
"""Time after which a program that measures a model is stopped."""

MAX_CHECKED_MODES = 60
"""Number of modes that are measured."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Checked:
    """Comparison of the matrix that an exported model measures with others."""

    program: str
    """Name of the program that measured."""

    modes: NDArray[np.intp]
    """``(n,)`` basis indices of the modes that were measured."""

    matrix: Array
    """``(n_slopes, n)`` measured matrix in the axes of conventions.md."""

    left_over: float
    """RMS of the bench's matrix that the exported model leaves, with a free gain for each mode."""

    left_over_by_fit: float
    """RMS of the bench's matrix that pyrcal's own model leaves, in the same modes."""

    correlation: Array
    """``(n,)`` correlation of each mode with the bench's."""

    seconds: float
    """Time that the measurement took."""

    @override
    def __str__(self) -> str:
        """Return the outcome in one sentence."""
        return (
            f"{self.program} runs its model: its matrix leaves {self.left_over:.2%} of the bench's "
            f"in {len(self.modes)} modes, the fit {self.left_over_by_fit:.2%}; the lowest "
            f"correlation of a mode is {self.correlation.min():.4f}."
        )


def check_oopao_model(
    folder: Path, instrument: Instrument, fit: Fit, *, python: Path | None = None
) -> Checked | str:
    """Return how the OOPAO model in ``folder`` compares with the bench and with the fit.

    If it cannot be run, the reason is returned, in one sentence. ``python`` is an interpreter that
    has OOPAO; None for the present one.
    """
    model, some = folder / oopao_model.NAME, _choose_columns(fit)
    with tempfile.TemporaryDirectory() as name:
        product, begun = Path(name) / "matrix.npz", time.perf_counter()
        command = [str(model.absolute()), str(product), *map(str, fit.modes[some])]
        if reason := _run("OOPAO", command, python, folder):
            return reason
        seconds = time.perf_counter() - begun
        with np.load(product) as found:
            matrix, reference = found["matrix"], found["reference"]
    matrix = _from_bench(matrix, reference, apply_fit(instrument, fit), fit.modes[some])
    return _judge("OOPAO", fit.measured[:, some], matrix, fit, some, seconds)


def check_specula_model(
    folder: Path, instrument: Instrument, fit: Fit, *, python: Path | None = None
) -> Checked | str:
    """Return how the SPECULA model in ``folder`` compares, as ``check_oopao_model`` does."""
    begun = time.perf_counter()
    program = ["-m", "specula.scripts.specula_main", "--cpu", "--precision", "0"]
    if reason := _run("SPECULA", [*program, specula_model.NAME], python, folder):
        return reason
    seconds, some = time.perf_counter() - begun, np.arange(len(fit.modes))
    # Its matrix has slopes, the bench's signals may be pixels.
    bench = slopes_of(fit.measured, instrument.slopes.kind).reshape(-1, len(some))
    return _judge("SPECULA", bench, specula_model.read_matrix(folder), fit, some, seconds)


def _choose_columns(fit: Fit) -> NDArray[np.intp]:
    """Return columns of the fit, spread over all of them."""
    spread = np.linspace(0, len(fit.modes) - 1, MAX_CHECKED_MODES)
    return np.unique(spread.round().astype(np.intp))


def _run(program: str, arguments: list[str], python: Path | None, folder: Path) -> str | None:
    """Run a Python file; return why it did not work, None if it did."""
    variables = {**os.environ, "MPLBACKEND": "Agg", "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            [str(python or sys.executable), *arguments],
            cwd=folder,
            env=variables,
            capture_output=True,
            text=True,
            timeout=MAX_SECONDS,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{program} could not be run: {error}."
    if done.returncode == 0:
        return None
    last = (done.stderr.strip().splitlines() or ["no message"])[-1]
    if "ModuleNotFoundError" in last:
        return f"{program} is not installed for {python or sys.executable}."
    return f"{program} did not run the model: {last}."


def _from_bench(measured: Array, reference: Array, instrument: Instrument, modes: Array) -> Array:
    """Return signals of OOPAO in the bench's own order ``(n, ...)`` as a fit has them."""
    frames = instrument.frames is not None
    normalised = getattr(instrument.frames, "normalised", False)
    recorded = Recorded(
        values=measured if frames else measured.T,
        modes=modes,
        noise=None,
        double_pass=False,
        flux_frame=reference if frames and not normalised else None,
        where="OOPAO",
        sha256="",
    )
    return target_of(make_reference(recorded, instrument)[0], instrument).matrix


def _judge(
    program: str, bench: Array, matrix: Array, fit: Fit, some: NDArray[np.intp], seconds: float
) -> Checked:
    """Compare the matrix of a program with that of the bench, both of some columns of the fit."""
    return Checked(
        program=program,
        modes=fit.modes[some],
        matrix=matrix,
        left_over=residual_fraction(bench, matrix),
        left_over_by_fit=float(np.sqrt(np.mean(fit.residual_by_mode[some] ** 2))),
        correlation=correlations(bench, matrix),
        seconds=seconds,
    )
