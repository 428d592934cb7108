"""The figures of the tutorials, from the files and programs that the tutorials use."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import pyrcal
from pyrcal.__main__ import main as run_pyrcal
from pyrcal.fitting import figures as fit_figures
from pyrcal.fitting.fitted import Fit
from service.control.loop import pole_radius
from service.model.instrument import Instrument
from service.model.misregistration import Misregistration

ROOT = Path(__file__).parents[1]
FILES = ROOT / "pyrcal" / "samples" / "data"
GAIN = 0.5


@contextmanager
def _imported(*words: str) -> Iterator[Path]:
    """Yield the folder that ``pyrcal import`` wrote."""
    with TemporaryDirectory() as folder:
        with contextlib.redirect_stdout(io.StringIO()):
            status = run_pyrcal(["import", *words, "--output", f"{folder}/bench"])
        if status:
            raise SystemExit(f"pyrcal import {' '.join(words)} ended with {status}")
        yield Path(folder) / "bench"


@cache
def _fitted(*words: str) -> tuple[Instrument, Fit]:
    with _imported(*words) as bench:
        instrument = pyrcal.load_instrument(bench / "instrument.toml")
        fit = pyrcal.fit_file(instrument, bench / "matrix.h5", pyrcal.FitOptions()).fit
        return instrument, fit


def _oopao() -> tuple[Instrument, Fit]:
    return _fitted("oopao", str(FILES / "oopao-pyramid.npz"))


def _specula(code: str) -> tuple[Instrument, Fit]:
    mask = {"specula": "pup", "synim": "subap"}[code]
    names = (f"{code}-im", f"{code}-{mask}", f"{code}-ifunc")
    return _fitted("specula", *(str(FILES / f"{name}.fits") for name in names), "--diameter-m", "8")


@cache
def _made(kind: str, *words: str) -> tuple[Instrument, Fit]:
    """Return the fit of files that ``pyrcal.samples`` wrote."""
    with TemporaryDirectory() as folder:
        made = [sys.executable, "-m", "pyrcal.samples", kind, folder]
        subprocess.run(made, cwd=ROOT, check=True)
        return _fitted({"papyrus": "files", "cacao": "cacao"}[kind], folder, *words)


def _fit_sheet(instrument: Instrument, fit: Fit) -> Figure:
    """Draw mirror over subapertures, gains, and residual of each mode."""
    figure = Figure(figsize=(9.4, 3.3), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    fit_figures.registration(left, fit, instrument)
    fit_figures.gains(middle, fit)
    fit_figures.residual_by_mode(right, fit)
    return figure


def oopao_fit() -> Figure:
    """Draw the fit of OOPAO's matrix."""
    return _fit_sheet(*_oopao())


def specula_fit() -> Figure:
    """Draw the fit of SPECULA's matrix."""
    return _fit_sheet(*_specula("specula"))


def synim_fit() -> Figure:
    """Draw the fit of SynIM's matrix."""
    return _fit_sheet(*_specula("synim"))


def cacao_fit() -> Figure:
    """Draw the fit of the files like cacao's."""
    return _fit_sheet(*_made("cacao", "--diameter-m", "2"))


def residual_maps(fit: Fit) -> Figure:
    """Draw slope maps of single modes: model, measurement, difference."""
    figure = Figure(figsize=(9.4, 3.0), layout="constrained")
    (part,) = figure.subfigures(1, 1, squeeze=False).ravel()
    fit_figures.slope_maps(part, fit)
    return figure


def oopao_maps() -> Figure:
    """Draw slope maps of OOPAO's matrix beside the model's."""
    return residual_maps(_oopao()[1])


def oopao_poles() -> Figure:
    """Draw the poles of the loop on OOPAO's own matrix, for two reconstructors."""
    with _imported("oopao", str(FILES / "oopao-pyramid.npz")) as bench:
        instrument = pyrcal.load_instrument(bench / "instrument.toml")
        with h5py.File(bench / "matrix.h5") as file:
            measured = np.asarray(file["interaction_matrix"][...])
    fit = _oopao()[1]
    synthetic = {
        "D at the nominal registration": _as_measured(instrument, Misregistration(), fit),
        "D at the fitted registration": _as_measured(instrument, fit.alpha, fit),
        "OOPAO's own matrix": measured,
    }
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    axes = figure.subplots()
    numbers = range(4, measured.shape[1] + 1, 2)
    for (label, matrix), mark in zip(synthetic.items(), ("s", "o", "x"), strict=True):
        radii = []
        for n in numbers:
            inverse = pyrcal.reconstruct(matrix, pyrcal.InversionOptions(n_modes=n)).matrix
            found = np.linalg.eigvals(GAIN * inverse @ measured[:, :n])
            radii.append(pole_radius(found, leak=0.999, delay_frames=2.0).max())
        axes.plot(numbers, radii, f"{mark}-", ms=4, label=f"inverse of {label}")
    axes.axhline(1.0, color="tab:red", lw=1.0)
    axes.set(xlabel="controlled modes", ylabel=f"largest pole radius, gain {GAIN}")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3)
    return figure


def _as_measured(instrument: Instrument, alpha: Misregistration, fit: Fit) -> NDArray[np.float64]:
    """Return D at a registration in the order and axes of the measured matrix."""
    from dataclasses import replace

    recipe = replace(instrument.slopes, order=fit.order, orientation=fit.orientation)
    told = replace(instrument, slopes=recipe)
    model = pyrcal.RtcInteractionModel(told, pyrcal.modal_basis(told))
    return np.asarray(model.interaction_matrix(alpha), dtype=float)


def specula_mask() -> Figure:
    """Draw the valid subapertures and three modes of the files of SPECULA."""
    words = [str(FILES / f"specula-{name}.fits") for name in ("im", "pup", "ifunc")]
    with (
        _imported("specula", *words, "--diameter-m", "8") as bench,
        h5py.File(bench / "matrix.h5") as file,
    ):
        valid = np.asarray(file["valid_subapertures"][...])
        shapes = np.asarray(file["mode_shapes"][...])
    figure = Figure(figsize=(9.4, 2.6), layout="constrained")
    grid = figure.subplots(1, 4)
    grid[0].imshow(valid, origin="lower", cmap="Greys", vmax=2)
    grid[0].set_title(f"{int(valid.sum())} valid subapertures", fontsize="medium")
    for axes, mode in zip(grid[1:], (1, 6, 15), strict=True):
        shape = np.where(shapes[mode] == 0.0, np.nan, shapes[mode])
        limit = np.nanmax(np.abs(shape))
        axes.imshow(shape, origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit)
        axes.set_title(f"mode {mode}", fontsize="medium")
    for axes in grid:
        axes.set(xticks=[], yticks=[])
    return figure


def _frames(kind: str, columns: tuple[int, ...], titles: str) -> Figure:
    """Draw camera frames of the files that ``pyrcal.samples`` writes."""
    from astropy.io import fits

    with TemporaryDirectory() as folder:
        made = [sys.executable, "-m", "pyrcal.samples", kind, folder]
        subprocess.run(made, cwd=ROOT, check=True)
        if kind == "cacao":
            cube = fits.getdata(Path(folder) / "zrespM-H.fits").astype(float)
        else:
            (path,) = Path(folder).glob("int_mat*")
            cube = np.load(path).T.reshape(-1, 240, 240)
    figure = Figure(figsize=(9.4, 3.8), layout="constrained")
    for axes, column in zip(figure.subplots(1, len(columns)), columns, strict=True):
        limit = np.percentile(np.abs(cube[column]), 99.5)
        axes.imshow(cube[column], cmap="RdBu_r", vmin=-limit, vmax=limit, origin="lower")
        axes.set(title=f"{titles} {column}", xlabel="column (pixels)")
    figure.axes[0].set_ylabel("row (pixels)")
    return figure


def cacao_response() -> Figure:
    """Draw the response of the camera to three actuators."""
    return _frames("cacao", (28, 66, 114), "actuator")


def papyrus_frames() -> Figure:
    """Draw the response of the camera to three of the nine modes."""
    return _frames("papyrus", (0, 3, 7), "column")


def _from_page(name: str) -> Instrument:
    """Return the instrument that a tutorial writes, from the text of its page."""
    text = (ROOT / "docs" / "tutorials" / f"{name}.md").read_text("utf-8")
    told = text.partition('write_text("""')[2].partition('"""')[0]
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.toml"
        path.write_text(told, "utf-8")
        return pyrcal.load_instrument(path)


def lenslets() -> Figure:
    """Draw the slopes of two modes of the lenslets of the tutorial as arrows."""
    instrument = _from_page("shack_hartmann")
    model = pyrcal.RtcInteractionModel(instrument, pyrcal.modal_basis(instrument))
    matrix = np.asarray(model.interaction_matrix(Misregistration()))
    rows, columns = np.nonzero(model.valid)
    figure = Figure(figsize=(9.4, 3.4), layout="constrained")
    grid = figure.subplots(1, 3)
    for axes, mode in zip(grid[:2], (2, 20), strict=True):
        x, y = np.split(matrix[:, mode], 2)
        axes.quiver(columns, rows, x, y, color="tab:blue", width=0.004)
        axes.set(title=f"slopes of mode {mode}", xlabel="x (subapertures)", aspect="equal")
    grid[0].set_ylabel("y (subapertures)")
    points = instrument.analytic_mirror.positions_m / instrument.subaperture_m
    half = (len(model.valid) - 1) / 2
    grid[2].plot(columns - half, rows - half, "s", color="#e6e1cf", ms=7, mew=0)
    grid[2].plot(*points.T, ".", color="tab:blue", ms=3)
    grid[2].set(title=f"{len(points)} actuators", xlabel="x (subapertures)", aspect="equal")
    return figure


def petals() -> Figure:
    """Draw pupil, spiders and petals of METIS and of the telescope of the tutorial."""
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    for axes, instrument in zip(
        figure.subplots(1, 2), (pyrcal.load_instrument("metis-elt"), _from_page("elt")), strict=True
    ):
        points = instrument.analytic_mirror.positions_m
        axes.scatter(*points.T, s=1.0, color="tab:blue", lw=0)
        for radius in (1.0, instrument.obscuration_ratio):
            turn = np.linspace(0.0, 2 * np.pi, 200)
            half = radius * instrument.diameter_m / 2
            axes.plot(half * np.cos(turn), half * np.sin(turn), color="tab:orange", lw=1.0)
        for angle in np.deg2rad(np.arange(30.0, 390.0, 60.0)):
            ends = np.array([instrument.obscuration_ratio, 1.0]) * instrument.diameter_m / 2
            axes.plot(ends * np.cos(angle), ends * np.sin(angle), color="tab:orange", lw=1.0)
        axes.set(
            title=f"{instrument.name}: {len(points)} actuators", xlabel="x (m)", aspect="equal"
        )
    figure.axes[0].set_ylabel("y (m)")
    return figure


def elt_poles() -> Figure:
    """Draw the pole radius against a shift for the telescope of the tutorial."""
    instrument = _from_page("elt")
    model = pyrcal.RtcInteractionModel(instrument, pyrcal.modal_basis(instrument))
    nominal = model.interaction_matrix(Misregistration())
    shifts = np.linspace(0.0, 0.6, 7)
    moved = [model.interaction_matrix(Misregistration(shift_x_subap=float(x))) for x in shifts]
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    axes = figure.subplots()
    for n in (100, 200, 300, 400):
        inverse = pyrcal.reconstruct(nominal, pyrcal.InversionOptions(n_modes=n)).matrix
        found = [np.linalg.eigvals(GAIN * inverse @ matrix[:, :n]) for matrix in moved]
        radii = [pole_radius(values, leak=0.999, delay_frames=2.0).max() for values in found]
        axes.plot(shifts, radii, "o-", ms=4, label=f"{n} modes")
    axes.axhline(1.0, color="tab:red", lw=1.0)
    axes.set(xlabel="shift (subapertures)", ylabel=f"largest pole radius, gain {GAIN}")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3)
    return figure


def rtc_timing() -> Figure:
    """Draw which command is on the mirror during which exposure, with a delay of two frames."""
    figure = Figure(figsize=(8.6, 3.0), layout="constrained")
    axes = figure.subplots()
    for k in range(5):
        axes.broken_barh([(k, 0.96)], (2.0, 0.6), facecolors="#cfe0f2")
        axes.text(k + 0.48, 2.3, f"exposure {k}", ha="center", va="center", fontsize=9)
        axes.broken_barh([(k + 1.0, 0.5)], (1.0, 0.6), facecolors="#f3dcc1")
        axes.text(k + 1.25, 1.3, f"s[{k}]", ha="center", va="center", fontsize=9)
        axes.broken_barh([(k, 0.96)], (0.0, 0.6), facecolors="#d5ead0")
        axes.text(k + 0.48, 0.3, f"c[{k}]", ha="center", va="center", fontsize=9)
    arrow = {"arrowstyle": "-|>", "color": "#41668c"}
    axes.annotate("", xy=(1.25, 1.62), xytext=(0.6, 1.98), arrowprops=arrow)
    axes.annotate("", xy=(2.1, 0.62), xytext=(1.3, 0.98), arrowprops=arrow)
    axes.set(xlim=(-0.05, 5.6), xlabel="time (frames)", yticks=(0.3, 1.3, 2.3))
    axes.set_yticklabels(["command on the mirror", "slopes read, multiplied", "sensor"])
    axes.spines[["top", "right"]].set_visible(False)
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    f"tutorials/{draw.__name__}": draw
    for draw in (
        oopao_fit,
        oopao_maps,
        oopao_poles,
        specula_mask,
        specula_fit,
        synim_fit,
        cacao_response,
        cacao_fit,
        papyrus_frames,
        lenslets,
        petals,
        elt_poles,
        rtc_timing,
    )
}
