"""Draw the figures of the manual, each from a run of the code.

Run: ``python -m pyrcal_studies.figures`` for all (about two minutes), or with names such as
``start/poles``. Figures are PNG files below 100 kB beside the page that shows them. The figures of
the tutorials are in ``pyrcal_studies/tutorial_figures.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import FancyBboxPatch, Rectangle
from numpy.typing import NDArray

import pyrcal
from pyrcal_studies import references_held, small_loop, tutorial_figures
from pyrcal_studies.shared import save_picture, study_parser
from service.control.gate import judge
from service.control.loop import ControlLoop, pole_radius
from service.control.references import compute_references, holding_gain
from service.instrument import packaged_instrument
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import karhunen_loeve_basis
from service.model.pupil import valid_subapertures
from service.model.slopes import as_maps
from sim_rtc.computer.feed import BATCH_FRAMES

OFF = (0.4, -0.1, 2.5, 1.01)
"""Subapertures, degrees, ratio: rotated more than in a night, so that it is visible."""

EXPECTED, TRUE = "#9aa4ad", "#1f6fb2"
Points = NDArray[np.float64]


def misregistration() -> Figure:
    """Draw nominal and actual positions of the actuators on the sensor."""
    instrument = packaged_instrument("flao-lbt")
    alpha = Misregistration.from_vector(np.array(OFF) / BOUNDARY_SCALE)
    expected = instrument.analytic_mirror.positions_m / instrument.subaperture_m
    true = on_sensor(expected, alpha)
    figure, (whole, part) = plt.subplots(1, 2, figsize=(6.2, 3.1), layout="constrained")
    half = instrument.wfs.n_subapertures / 2
    for axes, middle, reach in ((whole, (0.0, 0.0), half + 1.0), (part, (9.0, 6.0), 3.2)):
        _grid(axes, instrument)
        size = 1.5 if axes is whole else 60.0
        axes.scatter(*expected.T, s=size, facecolors="none", edgecolors=EXPECTED, lw=0.8)
        axes.scatter(*true.T, s=size, color=TRUE, lw=0.0)
        axes.set(xlim=(middle[0] - reach, middle[0] + reach), xticks=[], yticks=[])
        axes.set(ylim=(middle[1] - reach, middle[1] + reach), aspect="equal")
        axes.spines[:].set_visible(False)
    near = np.max(np.abs(expected - (9.0, 6.0)), axis=1) < 3.0
    for begin, end in zip(expected[near], true[near], strict=True):
        style = {"arrowstyle": "->", "color": "#c0392b", "lw": 1.2}
        part.annotate("", xy=tuple(end), xytext=tuple(begin), arrowprops=style)
    whole.set_title("663 actuators on the sensor's subapertures", fontsize=8)
    part.set_title("grey: nominal, blue: actual (a part)", fontsize=8)
    return figure


def on_sensor(points: Points, alpha: Misregistration) -> Points:
    """Return the positions on the sensor of points of the mirror, in subapertures."""
    cosine, sine = np.cos(alpha.rotation_rad), np.sin(alpha.rotation_rad)
    turned = points @ np.array([[cosine, sine], [-sine, cosine]])
    moved = alpha.magnification * turned + (alpha.shift_x_subap, alpha.shift_y_subap)
    return np.asarray(moved)


def _grid(axes: Axes, instrument: Instrument) -> None:
    """Draw the subapertures whose middle the pupil covers."""
    n, radius = instrument.wfs.n_subapertures, instrument.wfs.pupil_diameter / 2
    middles = np.arange(n) - (n - 1) / 2
    for x in middles:
        for y in middles:
            if instrument.obscuration_ratio * radius < np.hypot(x, y) < radius:
                axes.add_patch(
                    Rectangle((x - 0.5, y - 0.5), 1.0, 1.0, fc="#f4f1e8", ec="#d8d2c0", lw=0.5)
                )


DOCS = Path(__file__).parents[1] / "docs"
Array = NDArray[np.float64]
GAIN, LEAK, DELAY = 0.5, 0.999, 2.0
"""Loop of the figures about stability: integrator gain, leak, delay in frames."""

GATE_BOUND = 0.95
"""Largest pole radius that the gate accepts by default."""


def alpha_of(x: float = 0.0, y: float = 0.0, deg: float = 0.0, mag: float = 1.0) -> Misregistration:
    """Return a registration from subapertures, degrees and a ratio."""
    return Misregistration(
        shift_x_subap=x, shift_y_subap=y, rotation_rad=np.deg2rad(deg), magnification=mag
    )


@cache
def _flao() -> tuple[Instrument, InteractionModel]:
    instrument = pyrcal.load_instrument("flao-lbt")
    return instrument, InteractionModel(instrument, karhunen_loeve_basis(instrument))


# --- start: concepts -------------------------------------------------------------------------


def four_numbers() -> Figure:
    """Draw what shift, rotation and magnification do to the actuators on the subapertures."""
    instrument = pyrcal.load_instrument("tests/system/small.toml")
    nominal = instrument.analytic_mirror.positions_m / instrument.subaperture_m
    cases = {
        "shift: 0.5 subaperture along x": alpha_of(x=0.5),
        "rotation: 5 deg": alpha_of(deg=5.0),
        "magnification: 1.06": alpha_of(mag=1.06),
    }
    figure = Figure(figsize=(9.0, 3.3), layout="constrained")
    for axes, (title, alpha) in zip(figure.subplots(1, 3), cases.items(), strict=True):
        draw_subapertures(axes, instrument)
        axes.scatter(*nominal.T, s=14, facecolors="none", edgecolors="0.6", label="nominal")
        axes.scatter(*on_sensor(nominal, alpha).T, s=14, color="tab:blue", label="misregistered")
        axes.set(title=title, xlabel="x (subapertures)", aspect="equal", xlim=(-7, 7), ylim=(-7, 7))
    figure.axes[0].set_ylabel("y (subapertures)")
    figure.axes[0].legend(fontsize="x-small", loc="lower left")
    return figure


def draw_subapertures(axes: Axes, instrument: Instrument) -> None:
    """Draw the valid subapertures, coordinates in subapertures from the middle of the grid."""
    valid = valid_subapertures(instrument)
    half = (len(valid) - 1) / 2
    squares = [Rectangle((x - half - 0.5, y - half - 0.5), 1.0, 1.0) for y, x in np.argwhere(valid)]
    axes.add_collection(PatchCollection(squares, fc="#f4f1e8", ec="#d8d2c0", lw=0.5))


def slopes_of_an_actuator() -> Figure:
    """Draw Sx and Sy of one actuator, nominal and shifted, and their difference."""
    instrument = pyrcal.load_instrument("tests/data/zonal.toml")
    model = pyrcal.RtcInteractionModel(instrument, pyrcal.modal_basis(instrument))
    away = alpha_of(x=0.3)
    position = instrument.analytic_mirror.positions_m / instrument.subaperture_m
    actuator = int(np.argmin(np.hypot(*(position - (6.0, 3.0)).T)))
    nominal = model.interaction_matrix(alpha_of())[:, actuator] * 1e-9
    shifted = model.interaction_matrix(away)[:, actuator] * 1e-9
    names = ["nominal", "shifted by 0.3 subaperture", "difference"]
    return _slope_panels(
        {
            name: slope_maps(column, model.valid)
            for name, column in zip(names, (nominal, shifted, shifted - nominal), strict=True)
        },
        "slope per nm",
    )


def slope_maps(column: NDArray[np.floating], valid: NDArray[np.bool_]) -> Array:
    """Return Sx and Sy of one column of D on the grid of the sensor, ``(2, n, n)``."""
    return np.stack(np.hsplit(as_maps(column, valid), 2))


def _slope_panels(columns: dict[str, Array], unit: str) -> Figure:
    """Draw Sx above Sy for each named pair of maps, all with one colour scale."""
    engine = ConstrainedLayoutEngine(w_pad=0.15)
    figure = Figure(figsize=(2.6 * len(columns) + 1.0, 5.0), layout=engine)
    grid = figure.subplots(2, len(columns), squeeze=False)
    limit = max(float(np.nanmax(np.abs(maps))) for maps in columns.values())
    for k, (name, maps) in enumerate(columns.items()):
        for row, label in enumerate(("Sx", "Sy")):
            axes = grid[row, k]
            image = axes.imshow(maps[row], origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit)
            axes.set(xticks=[], yticks=[])
            if not row:
                axes.set_title(name, fontsize="medium")
            if not k:
                axes.set_ylabel(label)
    figure.colorbar(image, ax=grid, label=unit, shrink=0.8)
    return figure


def slopes_of_modes() -> Figure:
    """Draw Sx of three modes and how much a shift changes each."""
    _, model = _flao()
    nominal = model.interaction_matrix(alpha_of())
    shifted = model.interaction_matrix(alpha_of(x=0.3))
    modes = (5, 100, 400)
    figure = Figure(figsize=(8.6, 5.4), layout="constrained")
    grid = figure.subplots(2, 3)
    for k, mode in enumerate(modes):
        columns = nominal[:, mode], shifted[:, mode] - nominal[:, mode]
        limit = float(np.abs(columns[0]).max())
        change = np.linalg.norm(columns[1]) / np.linalg.norm(columns[0])
        for row, column in enumerate(columns):
            axes = grid[row, k]
            image = slope_maps(column / limit, model.valid)[0]
            drawn = axes.imshow(image, origin="lower", cmap="RdBu_r", vmin=-1.0, vmax=1.0)
            axes.set(xticks=[], yticks=[])
        grid[0, k].set_title(f"mode {mode}")
        grid[1, k].set_title(f"change: {100 * change:.0f} % of the signal", fontsize="medium")
    grid[0, 0].set_ylabel("Sx, nominal")
    grid[1, 0].set_ylabel("change by 0.3 subaperture")
    figure.colorbar(drawn, ax=grid, label="over the largest slope of the mode", shrink=0.8)
    return figure


def sensitivity() -> Figure:
    """Draw the relative change of each column of D for a shift, a rotation, a magnification."""
    _, model = _flao()
    nominal = model.interaction_matrix(alpha_of())
    figure = Figure(figsize=(7.0, 3.8), layout="constrained")
    axes = figure.subplots()
    cases = {
        "shift 0.1 subaperture": alpha_of(x=0.1),
        "rotation 0.5 deg": alpha_of(deg=0.5),
        "magnification 1 %": alpha_of(mag=1.01),
    }
    for (name, alpha), mark in zip(cases.items(), ("o", "s", "^"), strict=True):
        change = np.linalg.norm(model.interaction_matrix(alpha) - nominal, axis=0)
        axes.plot(
            100.0 * change / np.linalg.norm(nominal, axis=0), mark, ms=2.0, alpha=0.6, label=name
        )
    axes.set(xlabel="mode", ylabel="change of its slopes (% of the signal)", ylim=(0, None))
    axes.legend(markerscale=3)
    axes.grid(alpha=0.3)
    return figure


def poles() -> Figure:
    """Draw the pole radius of FLAO's loop against each parameter of the registration."""
    _, model = _flao()
    nominal = model.interaction_matrix(alpha_of())
    ranges: dict[str, tuple[Array, Callable[[float], Misregistration]]] = {
        "shift x (subapertures)": (np.linspace(0.0, 0.5, 6), lambda v: alpha_of(x=v)),
        "rotation (deg)": (np.linspace(0.0, 1.6, 5), lambda v: alpha_of(deg=v)),
        "magnification - 1 (%)": (np.linspace(0.0, 5.0, 6), lambda v: alpha_of(mag=1 + v / 100)),
    }
    inverses = {
        n: pyrcal.reconstruct(nominal, pyrcal.InversionOptions(n_modes=n)).matrix
        for n in (100, 300, 500)
    }
    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    grid = figure.subplots(1, 3, sharey=True)
    for axes, (label, (values, at)) in zip(grid, ranges.items(), strict=True):
        matrices = [model.interaction_matrix(at(float(value))) for value in values]
        for n, inverse in inverses.items():
            radii = [loop_radius(inverse, matrix) for matrix in matrices]
            axes.plot(values, radii, "o-", ms=3, label=f"{n} modes")
        axes.axhline(1.0, color="tab:red", lw=1.0)
        axes.axhline(GATE_BOUND, color="tab:red", lw=1.0, ls=":")
        axes.set(xlabel=label)
        axes.grid(alpha=0.3)
    grid[0].set_ylabel(f"largest pole radius, gain {GAIN}")
    grid[0].legend(fontsize="small")
    grid[2].text(0.1, 1.004, "unstable above", color="tab:red", fontsize="small")
    grid[2].text(0.1, GATE_BOUND + 0.004, "limit of the gate", color="tab:red", fontsize="small")
    return figure


def loop_radius(reconstructor: NDArray[np.floating], matrix: NDArray[np.floating]) -> float:
    """Return the largest pole radius of the loop of the figures, 1 at the edge of stability."""
    coupling = GAIN * reconstructor @ matrix[:, : len(reconstructor)]
    return float(pole_radius(np.linalg.eigvals(coupling), leak=LEAK, delay_frames=DELAY).max())


def wavefront_against_shift() -> Figure:
    """Draw the wavefront error of a loop against the shift, with an old and with a right matrix."""
    shifts = np.linspace(0.0, 0.6, 13)
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axes = figure.subplots()
    for n_modes, mark in ((40, "s"), (80, "o")):
        old: list[float] = []
        right: list[float] = []
        for shift in shifts:
            alpha = alpha_of(x=float(shift))
            for found, held in ((old, alpha_of()), (right, alpha)):
                loop = small_loop.run(small_loop.Case(alpha=alpha, matrix=held, n_modes=n_modes))
                found.append(loop.wavefront_nm())
        axes.plot(
            shifts,
            old,
            f"{mark}-",
            color="tab:orange",
            ms=4,
            label=f"nominal matrix, {n_modes} modes",
        )
        axes.plot(
            shifts,
            right,
            f"{mark}-",
            color="tab:blue",
            ms=4,
            label=f"matrix of the true registration, {n_modes} modes",
        )
    axes.set(
        xlabel="shift of the mirror (subapertures)",
        ylabel="wavefront error (nm RMS)",
        yscale="log",
        title="loop of 90 modes, gain 0.5, 300 nm of turbulence",
    )
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3, which="both")
    return figure


def flow() -> Figure:
    """Draw the way from telemetry and geometry to a reconstructor."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axes = figure.subplots()
    boxes = {
        "RTC": (0.0, 1.0, "real-time computer\nslopes, commands"),
        "alpha": (2.6, 1.0, "registration α ± σ\n4 numbers"),
        "D": (5.2, 1.0, "interaction matrix D(α)\nfrom the model, no noise"),
        "R": (7.8, 1.0, "reconstructor\nR = D(α)$^{+}$"),
        "geometry": (5.2, 2.2, "pupil, mirror, sensor\ninstrument file"),
        "gate": (7.8, -0.2, "gate\nstable in all of α ± 3σ?"),
    }
    for x, y, text in boxes.values():
        box = FancyBboxPatch(
            (x, y), 2.0, 0.7, boxstyle="round,pad=0.05", fc="#eef3f8", ec="#41668c"
        )
        axes.add_patch(box)
        axes.text(x + 1.0, y + 0.35, text, ha="center", va="center", fontsize=9)
    arrows = [
        ((2.1, 1.35), (2.5, 1.35), ""),
        ((4.7, 1.35), (5.1, 1.35), ""),
        ((7.3, 1.35), (7.7, 1.35), ""),
        ((6.2, 2.1), (6.2, 1.8), ""),
        ((8.8, 0.9), (8.8, 0.6), ""),
    ]
    for begin, end, _ in arrows:
        axes.annotate(
            "", xy=end, xytext=begin, arrowprops={"arrowstyle": "-|>", "color": "#41668c"}
        )
    axes.annotate(
        "",
        xy=(1.0, 0.9),
        xytext=(7.7, 0.15),
        arrowprops={
            "arrowstyle": "-|>",
            "color": "#41668c",
            "connectionstyle": "angle,angleA=180,angleB=90",
        },
    )
    axes.text(4.2, 0.25, "accepted: sent, and used from a stated frame on", ha="center", fontsize=9)
    axes.set(xlim=(-0.2, 10.0), ylim=(-0.4, 3.1))
    axes.set_axis_off()
    return figure


def dither_lines() -> Figure:
    """Draw the spectrum of a dithered mode and of a controlled one in closed loop."""
    case = small_loop.Case(
        alpha=alpha_of(x=0.1), matrix=alpha_of(x=0.1), n_modes=60, dither_nm=8.0, n_frames=16000
    )
    loop = small_loop.run(case)
    modal = loop.slopes @ np.linalg.pinv(loop.response).T * 1e9
    figure = Figure(figsize=(7.4, 3.8), layout="constrained")
    axes = figure.subplots()
    lines = dict(zip(case.dither_modes, case.dither_hz, strict=True))
    dithered = case.dither_modes[1]
    for mode, label, colour in (
        (20, "mode 20, controlled", "0.6"),
        (dithered, f"mode {dithered}, dithered with 8 nm", "tab:blue"),
    ):
        f_hz, power = scipy.signal.welch(modal[:, mode], case.rate_hz, nperseg=2000)
        axes.semilogy(f_hz[1:], np.sqrt(power[1:]), color=colour, lw=1.0, label=label)
    for mode, f_hz in lines.items():
        axes.axvline(f_hz, color="tab:orange", lw=0.8, ls=":")
        axes.text(f_hz, axes.get_ylim()[1], f"{mode}", fontsize="x-small", ha="center", va="bottom")
    axes.set(
        xlabel="frequency (Hz); dotted: the line of each dithered mode",
        ylabel="residual (nm per square root of Hz)",
    )
    axes.legend(loc="lower right", fontsize="small")
    axes.grid(alpha=0.3)
    return figure


def gate() -> Figure:
    """Draw the pole radius over shift and rotation, and two estimates with their 3 σ."""
    _, model = _flao()
    n = 300
    inverse = pyrcal.reconstruct(
        model.interaction_matrix(alpha_of()), pyrcal.InversionOptions(n_modes=n)
    ).matrix
    near = model.linearise(alpha_of())
    shifts, turns = np.linspace(-0.36, 0.36, 9), np.linspace(-1.0, 1.0, 9)
    coupling = GAIN * inverse @ near.matrix[:, :n]
    by_x = GAIN * inverse @ near.derivatives[0][:, :n]
    by_turn = GAIN * inverse @ near.derivatives[2][:, :n]
    radii = np.array(
        [
            [
                pole_radius(
                    np.linalg.eigvals(coupling + x * by_x + np.deg2rad(turn) * by_turn),
                    leak=LEAK,
                    delay_frames=DELAY,
                ).max()
                for x in shifts
            ]
            for turn in turns
        ]
    )
    figure = Figure(figsize=(6.6, 4.4), layout="constrained")
    axes = figure.subplots()
    filled = axes.contourf(shifts, turns, radii, levels=np.arange(0.7, 1.13, 0.03), cmap="Blues")
    axes.contour(shifts, turns, radii, levels=[GATE_BOUND], colors="tab:orange")
    axes.contour(shifts, turns, radii, levels=[1.0], colors="tab:red")
    figure.colorbar(filled, label="largest pole radius")
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    loop = ControlLoop(gains=np.full(n, GAIN), leak=LEAK, delay_frames=DELAY, frame_rate_hz=1000.0)
    for sigma_x, sigma_deg, colour in ((0.02, 0.05, "tab:green"), (0.1, 0.3, "tab:purple")):
        sigma = np.array([sigma_x, sigma_x, np.deg2rad(sigma_deg), 1e-3])
        verdict = judge(inverse, near, alpha_of(), np.diag(sigma**2), loop, bound=GATE_BOUND)
        word = "accepted" if verdict.accepted else "refused"
        axes.plot(
            3 * sigma_x * np.cos(angle),
            3 * sigma_deg * np.sin(angle),
            color=colour,
            label=f"3 σ, σ = {sigma_x} subap, {sigma_deg} deg: {word}",
        )
    axes.set(
        xlabel="shift x from the estimate (subapertures)",
        ylabel="rotation (deg)",
        title=f"{n} modes, gain {GAIN}; orange: {GATE_BOUND}, red: 1",
    )
    axes.legend(fontsize="small", loc="lower left")
    return figure


def probation() -> Figure:
    """Draw the residual of a loop after a right matrix, and after one that diverges."""
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    axes = figure.subplots()
    swap_s, back_s, step = 6.0, 0.1, 50
    n_modes = 75
    cases = {
        "right matrix: stays": {6000: alpha_of(x=0.02)},
        "matrix that diverges: taken back after 0.1 s": {6000: alpha_of(x=0.62), 6100: alpha_of()},
    }
    for (label, swaps), colour in zip(cases.items(), ("tab:blue", "tab:orange"), strict=True):
        loop = small_loop.run(
            small_loop.Case(
                alpha=alpha_of(), matrix=alpha_of(), n_modes=n_modes, n_frames=12000, swaps=swaps
            )
        )
        power = (loop.residual_m[:, :n_modes] ** 2).sum(axis=1).reshape(-1, step).mean(axis=1)
        times = (np.arange(len(power)) + 0.5) * step / 1000.0
        axes.semilogy(times, 1e9 * np.sqrt(power), color=colour, lw=1.0, label=label)
    axes.axvspan(swap_s, swap_s + 4.0, color="0.92", zorder=0)
    axes.axvline(swap_s, color="0.5", lw=1.0)
    axes.axvline(swap_s + back_s, color="tab:orange", lw=1.0, ls=":")
    axes.text(swap_s + 0.3, 0.03, "probation, 4 s", transform=axes.get_xaxis_transform())
    axes.set(xlabel="time (s)", ylabel=f"residual of {n_modes} modes (nm RMS)", xlim=(3.0, 12.0))
    axes.legend(loc="upper right", fontsize="small")
    axes.grid(alpha=0.3, which="both")
    return figure


def night() -> Figure:
    """Draw α with its σ against the truth while the mirror drifts and jumps."""
    truth, track = small_loop.tracked_night()
    figure = Figure(figsize=(8.4, 5.0), layout="constrained")
    names = ("shift x (subapertures)", "shift y (subapertures)", "rotation (deg)", "magnification")
    for k, axes in enumerate(figure.subplots(2, 2, sharex=True).ravel()):
        axes.plot(truth[:, 0], truth[:, k + 1], color="tab:orange", label="truth")
        axes.fill_between(
            track.t,
            track.alpha[:, k] - track.sigma[:, k],
            track.alpha[:, k] + track.sigma[:, k],
            color="tab:blue",
            alpha=0.25,
            label="α ± 1 σ",
            step=None,
        )
        axes.plot(track.t, track.alpha[:, k], ".-", color="tab:blue", ms=3, lw=0.8)
        axes.set(ylabel=names[k])
        axes.grid(alpha=0.3)
        axes.ticklabel_format(useOffset=False)
    figure.axes[0].legend(fontsize="small")
    for axes in figure.axes[2:]:
        axes.set_xlabel("time (s)")
    return figure


# --- explanation -----------------------------------------------------------------------------


def modes() -> Figure:
    """Draw Karhunen-Loeve modes of FLAO's mirror over the pupil."""
    instrument, _ = _flao()
    basis = karhunen_loeve_basis(instrument)
    half = instrument.wfs.pupil_diameter / 2
    x, y = np.meshgrid(*2 * [np.linspace(-half, half, 81)])
    radius = np.hypot(x, y) / half
    inside = (radius < 1.0) & (radius > instrument.obscuration_ratio)
    surface = basis.render(np.column_stack([x[inside], y[inside]]))
    figure = Figure(figsize=(9.0, 2.5), layout="constrained")
    for axes, mode in zip(figure.subplots(1, 5), (0, 3, 20, 100, 400), strict=True):
        image = np.full(x.shape, np.nan)
        image[inside] = surface[:, mode]
        limit = np.nanpercentile(np.abs(image), 99)
        drawn = axes.imshow(image, origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit)
        axes.set(title=f"mode {mode}", xticks=[], yticks=[])
    figure.colorbar(drawn, ax=figure.axes, label="OPD per unit RMS", shrink=0.7)
    return figure


def singular_values() -> Figure:
    """Draw the singular values of FLAO's D for three numbers of modes."""
    _, model = _flao()
    matrix = model.interaction_matrix(alpha_of())
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    for n in (300, 500, 594):
        values = np.linalg.svd(matrix[:, :n], compute_uv=False)
        axes.semilogy(
            values / values[0], label=f"{n} modes, condition {values[0] / values[-1]:.1f}"
        )
    axes.set(xlabel="number", ylabel="singular value over the largest")
    axes.legend()
    axes.grid(alpha=0.3)
    return figure


def noise_of_a_matrix() -> Figure:
    """Draw the wavefront error with a measured, noisy matrix against its noise."""
    noises = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8])
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    for n_modes, colour in ((40, "tab:blue"), (80, "tab:orange")):
        found = [
            small_loop.run(
                small_loop.Case(
                    alpha=alpha_of(), matrix=alpha_of(), n_modes=n_modes, matrix_noise=float(noise)
                )
            ).wavefront_nm()
            for noise in noises
        ]
        axes.plot(
            100 * noises, found, "o-", color=colour, label=f"measured matrix, {n_modes} modes"
        )
        axes.axhline(found[0], color=colour, ls=":", label=f"without noise, {n_modes} modes")
    axes.set(
        xlabel="noise of the matrix (% of each mode's signal)",
        ylabel="wavefront error (nm RMS)",
    )
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3, which="both")
    return figure


def sigma_of_a_dither() -> Figure:
    """Draw the σ of α that photon noise allows, against the length of a dither."""
    _, model = _flao()
    near = model.linearise(alpha_of())
    seconds = np.geomspace(0.5, 60.0, 12)
    names = ("shift (% of a subaperture)", "rotation (mdeg)", "magnification (%)")
    scales = (100.0, np.rad2deg(1e3), 100.0)
    figure = Figure(figsize=(9.2, 3.2), layout="constrained")
    grid = figure.subplots(1, 3)
    for noise, label in ((0.1, "slope noise 0.1"), (0.5, "slope noise 0.5")):
        sigma = np.array(
            [
                pyrcal.dither_sigma(
                    near,
                    (405, 428, 451, 471),
                    amplitude_m=5e-9,
                    n_frames=int(1000 * s),
                    slope_noise=noise,
                )
                for s in seconds
            ]
        )
        for axes, name, scale, k in zip(grid, names, scales, (0, 2, 3), strict=True):
            axes.loglog(seconds, sigma[:, k] * scale, "o-", ms=3, label=label)
            axes.set(xlabel="dither of 5 nm (s, 1 kHz)", ylabel=f"1 σ of {name}")
            axes.grid(alpha=0.3, which="both")
    grid[0].legend(fontsize="small")
    return figure


def disjoint_sets() -> Figure:
    """Draw α of disjoint sets of modes of one measured matrix, each with its σ."""
    import h5py

    with h5py.File("tests/data/tiny/tiny.h5") as file:
        matrix = file["interaction_matrix"][...]
    sets = {
        "all 40": range(40),
        "even": range(0, 40, 2),
        "odd": range(1, 40, 2),
        "lowest 20": range(20),
        "highest 20": range(20, 40),
    }
    fits = {
        name: pyrcal.fit("tests/data/tiny/tiny.toml", matrix[:, list(modes)], modes=list(modes))
        for name, modes in sets.items()
    }
    truth = {
        "shift_x_subap": -0.31,
        "shift_y_subap": 0.17,
        "rotation_deg": 64.2,
        "magnification": 0.985,
    }
    figure = Figure(figsize=(9.2, 3.0), layout="constrained")
    for axes, (name, value) in zip(figure.subplots(1, 4), truth.items(), strict=True):
        for row, fit in enumerate(fits.values()):
            axes.errorbar(
                fit.alpha.to_boundary()[name],
                row,
                xerr=fit.sigma_to_boundary()[name],
                fmt="o",
                color="tab:blue",
            )
        axes.axvline(value, color="tab:orange")
        axes.set(title=name, yticks=range(len(fits)), yticklabels=list(fits), ylim=(4.5, -0.5))
        axes.tick_params(axis="x", labelsize="x-small")
        axes.ticklabel_format(useOffset=False, axis="x")
        axes.grid(alpha=0.3)
    for axes in figure.axes[1:]:
        axes.set_yticklabels([])
    return figure


def pupils() -> Figure:
    """Draw valid subapertures and actuators of four packaged instruments."""
    figure = Figure(figsize=(9.6, 2.9), layout="constrained")
    for axes, name in zip(
        figure.subplots(1, 4), ("papyrus", "flao-lbt", "maps-mmt", "aof-ut4"), strict=True
    ):
        instrument = pyrcal.load_instrument(name)
        draw_subapertures(axes, instrument)
        points = instrument.analytic_mirror.positions_m / instrument.subaperture_m
        axes.scatter(*points.T, s=1.5, color="tab:blue", lw=0)
        axes.set(title=f"{name}: {len(points)} actuators", xticks=[], yticks=[], aspect="equal")
        axes.title.set_fontsize("medium")
    return figure


def references() -> Figure:
    """Draw what fixed references hold at each optical gain, and loops that the seeing surprises."""
    figure = Figure(figsize=(8.4, 3.4), layout="constrained")
    held, jump = figure.subplots(1, 2)
    gain = np.linspace(0.3, 1.0, 71)
    for factor, label in (
        (1.0 / holding_gain(gain), "D c: static"),
        (gain / holding_gain(gain), "D G c: the gain of fast dithers"),
        (np.ones_like(gain), "D G c: the gain that holds"),
    ):
        held.plot(gain, factor, label=label)
    held.set(xlabel="optical gain G", ylabel="shape held over shape wanted", ylim=(0.8, 3.6))
    for rms_nm in (25.0, 80.0):
        plan = references_held.Plan(
            case="jump",
            seeing_arcsec=1.2,
            seed=1,
            references="holding",
            shape="flat",
            rms_nm=rms_nm,
            instrument="tests/system/small.toml",
        )
        shape = references_held.shape_of(plan)
        matrix = references_held.matrix_of(plan.instrument, plan.alpha)
        offset = compute_references(matrix, np.full(len(shape), 0.85), 1e-9 * rms_nm * shape)
        along = references_held.run(plan, offset).modes_m @ shape * 1e9
        smooth = np.convolve(along, np.full(10, 0.1), "valid")
        time_s = (np.arange(len(smooth)) + 5.0) * BATCH_FRAMES / 1000.0
        jump.plot(time_s, smooth, lw=1.0, label=f"{rms_nm:.0f} nm wanted")
    jump.axvspan(0.3, 1.3, color="0.92", zorder=0)
    jump.text(0.35, 0.92, "0.6 to 1.2 arcsec", transform=jump.get_xaxis_transform())
    jump.set(xlabel="time (s)", ylabel="shape held (nm RMS)", ylim=(-100.0, 800.0))
    for axes in (held, jump):
        axes.legend(fontsize="small")
        axes.grid(alpha=0.3)
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "pictures/misregistration": misregistration,
    "start/four_numbers": four_numbers,
    "start/slopes_of_an_actuator": slopes_of_an_actuator,
    "start/slopes_of_modes": slopes_of_modes,
    "start/sensitivity": sensitivity,
    "start/poles": poles,
    "start/wavefront_against_shift": wavefront_against_shift,
    "start/flow": flow,
    "start/dither_lines": dither_lines,
    "start/gate": gate,
    "start/probation": probation,
    "start/night": night,
    "explanation/modes": modes,
    "explanation/singular_values": singular_values,
    "explanation/noise_of_a_matrix": noise_of_a_matrix,
    "explanation/sigma_of_a_dither": sigma_of_a_dither,
    "explanation/disjoint_sets": disjoint_sets,
    "explanation/pupils": pupils,
    "explanation/references": references,
    **tutorial_figures.FIGURES,
}


def main() -> int:
    """Draw the figures named, or all."""
    parser = study_parser("pyrcal_studies.figures", __doc__)
    parser.add_argument("names", nargs="*", choices=[[], *FIGURES], metavar="NAME")
    mpl.rcParams.update({"font.size": 9.0, "figure.facecolor": "white"})
    for name in parser.parse_args().names or FIGURES:
        path = DOCS / f"{name}.png"
        save_picture(FIGURES[name](), path, dpi=100)
        print(path, path.stat().st_size)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
