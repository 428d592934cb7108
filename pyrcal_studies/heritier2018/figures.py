"""Figures 3 to 14 of the paper, from the study's own steps, laid out as in the paper.

Values that the paper prints are drawn in. Every picture stays below 100 kB.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import paper, plan, results, telescope
from pyrcal_studies.heritier2018.loops import FIELD, OVERSAMPLING, strehl, wavefront_error_nm
from pyrcal_studies.heritier2018.plan import Budget, Variant
from pyrcal_studies.heritier2018.registration import fitted_alpha
from pyrcal_studies.heritier2018.store import Store
from pyrcal_studies.shared import save_picture
from service.model.slopes import as_maps

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_WIDTH = 9
_EXACT = 10
"""First modes, shown as they are."""


def smoothed(variance_nm2: Array) -> tuple[NDArray[np.intp], Array]:
    """Return mode numbers from 1 and variances: as they are, then a running mean over 9 modes."""
    mean = np.convolve(variance_nm2, np.full(_WIDTH, 1 / _WIDTH), mode="same")
    high = len(variance_nm2) - _WIDTH // 2
    values = np.concatenate([variance_nm2[:_EXACT], mean[_EXACT:high]])
    return np.arange(1, high + 1), values


_DPI = 85

SYNTHETIC, MEASURED, TURBULENCE, PAPER = "#0757ae", "#b3261e", "0.55", "#1a7f37"


def canvas(width_in: float, height_in: float) -> Figure:
    """Return an empty figure; matplotlib is needed from here on and not before."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def eigenvalues(budget: Budget, store: Store) -> Figure:
    """Draw figure 3: the singular values of the measured and of the synthetic matrix."""
    found = results.spectra(budget, store)
    figure = canvas(9.0, 3.6)
    panels = figure.subplots(1, 2, sharey=True)
    pairs = (
        ("at 98 % (the registration found)", found.measured[0], found.synthetic, "measured"),
        ("at 100 %, no noise", found.clean[1], found.model[1], "telescope"),
    )
    for axes, (title, measured, synthetic, name) in zip(panels, pairs, strict=True):
        for values, colour, word in (
            (measured, MEASURED, name),
            (synthetic, SYNTHETIC, "synthetic"),
        ):
            number = np.arange(1, len(values) + 1)
            label = f"{word}, condition {results.condition(values):.2f}"
            axes.semilogy(number, values / values[0], color=colour, label=label)
        axes.set(title=title, xlabel="eigenmode number")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small", loc="lower left")
        for value, colour in zip(
            paper.QUOTES["condition"].values, (SYNTHETIC, MEASURED), strict=True
        ):
            axes.axhline(1.0 / value, color=colour, linestyle=":", linewidth=0.9)
    panels[0].set_ylabel("singular value over the largest")
    figure.suptitle(
        "dotted: smallest value for the paper's 8.1 (synthetic) and 8.85 (measured)", fontsize=9
    )
    return figure


def slopes_rms(budget: Budget, store: Store) -> Figure:
    """Draw figure 4: the RMS of the slopes of each mode."""
    _, record = results.fit_record(budget, store, budget.seeds[0])
    number = record["modes"] + 1
    figure = canvas(7.0, 3.6)
    axes = figure.subplots()
    tuned = record["synthetic"] * record["gains"]
    axes.plot(number, results.rms(record["measured"]) * 1e-9, color=MEASURED, label="measured")
    axes.plot(
        number,
        results.rms(tuned) * 1e-9,
        "--",
        color=SYNTHETIC,
        label="synthetic, modal gains tuned",
    )
    axes.plot(
        number,
        results.rms(record["measured"] - tuned) * 1e-9,
        ":",
        color="0.4",
        label="difference",
    )
    axes.set(xlabel="KL mode", ylabel="slopes RMS per nm RMS of wavefront", ylim=(0.0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    return figure


def sensitivity(budget: Budget, store: Store) -> Figure:
    """Draw figure 5: the wavefront error against each misregistration."""
    figure = canvas(6.0, 8.4)
    panels = figure.subplots(3, 1)
    marks = dict(zip(("rotation_deg", "shift_x_subap"), paper.QUOTES["drop"].values, strict=True))
    labels = ("rotation [deg]", "shift in x [% of a subaperture]", "magnification [%]")
    for axes, sweep, label in zip(panels, plan.SWEEPS, labels, strict=True):
        for n_modes, colour in zip(plan.INFLUENCE_MODES, (SYNTHETIC, MEASURED), strict=True):
            found = results.curve(budget, store, sweep, n_modes)
            axes.plot(
                found.values, found.errors_nm, "o-", ms=4, color=colour, label=f"{n_modes} modes"
            )
            after = found.first_after()
            if n_modes == plan.N_BASIS and after is not None:
                axes.axvline(after, color=colour, linestyle=":", label=f"ours: {after:g}")
        if sweep.name in marks:
            axes.axvline(
                marks[sweep.name],
                color=PAPER,
                linestyle="--",
                label=f"paper: {marks[sweep.name]:g}",
            )
        axes.set(xlabel=label, ylabel="wavefront error [nm RMS]", yscale="log")
        _nm_ticks(axes)
        axes.legend(fontsize="small")
    return figure


def _nm_ticks(axes: Axes) -> None:
    low, high = axes.get_ylim()
    ticks = [t for t in (80, 100, 150, 200, 300, 500, 1000, 2000, 5000) if low <= t <= high]
    axes.set_yticks(ticks, [str(tick) for tick in ticks])
    axes.set_yticks([], minor=True)
    axes.grid(alpha=0.3)


def sensitivity_spectra(budget: Budget, store: Store) -> Figure:
    """Draw figure 6: modal spectra with 594 modes, registered and misregistered."""
    figure = canvas(6.0, 6.4)
    panels = figure.subplots(2, 1, sharex=True)
    at_rest = store.read(plan.influence_run(budget, plan.ROTATION.alpha(0.0), plan.N_BASIS))
    for axes, sweep in zip(panels, (plan.ROTATION, plan.SHIFT), strict=True):
        shown = [
            ("turbulence", at_rest["incoming_nm2"], TURBULENCE),
            ("nominal", at_rest["modal_nm2"], SYNTHETIC),
        ]
        values = results.shown_values(budget, store, sweep)
        for (value, word), colour in zip(values.items(), (PAPER, MEASURED), strict=False):
            run = plan.influence_run(budget, sweep.alpha(value), plan.N_BASIS)
            label = f"{sweep.symbol} = {value:g} {sweep.unit} ({word})"
            shown.append((label, store.read(run)["modal_nm2"], colour))
        _spectra(axes, shown)
    panels[1].set_xlabel("KL mode")
    return figure


def _spectra(axes: Axes, shown: Iterable[tuple[str, Array, str]]) -> None:
    for label, values, colour in shown:
        axes.loglog(*smoothed(values), color=colour, label=label, linewidth=1.1)
    axes.set_ylabel("modal PSD [nm²]")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def last_scans(budget: Budget, store: Store) -> Figure:
    """Draw figure 7: the criterion in the last scan of every parameter."""
    _, record = results.fit_record(budget, store, budget.seeds[0])
    lines = results.scan_lines(record)
    figure = canvas(8.0, 5.6)
    panels = figure.subplots(2, 2).ravel()
    # in the order of the paper's figure: shifts, rotation, magnification
    wanted = {"α_x": -92.0, "α_y": 35.0, "α_rot": 65.08, "α_magn": 98.0}
    for axes, (symbol, theirs) in zip(panels, wanted.items(), strict=True):
        k = max(k for k, line in enumerate(lines) if line.symbol == symbol)
        line = lines[k]
        scale = results.SHOWN[list(results.SYMBOLS.values()).index(symbol)]
        chi = record[f"chi_{k}"]
        least = float(chi.min())
        axes.plot(record[f"samples_{k}"] * scale, chi / least, "o", color=MEASURED, ms=4)
        place = np.linspace(-2.6, 2.6, 60)
        parabola = np.polyval(record[f"coefficients_{k}"], place)
        axes.plot(line.value + line.step * place, parabola / least, "-", color=SYNTHETIC)
        axes.axvline(line.value, color=SYNTHETIC, linestyle=":", label=f"ours: {line.value:.2f}")
        axes.axvline(theirs, color=PAPER, linestyle="--", label=f"paper: {theirs:g}")
        axes.set(
            title=f"step {k + 1}: {symbol} by {line.step:g} {line.unit}",
            xlabel=f"{symbol} [{line.unit}]",
            ylabel="χ_400 over its minimum",
        )
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small", loc="upper center")
    return figure


def registration(budget: Budget, store: Store) -> Figure:
    """Draw figure 8: actuators over subapertures."""
    _, record = results.fit_record(budget, store, budget.seeds[0])
    alpha = fitted_alpha(record)
    points = telescope.actuators_subap()
    cosine, sine = np.cos(alpha.rotation_rad), np.sin(alpha.rotation_rad)
    turned = points @ np.array([[cosine, -sine], [sine, cosine]]).T
    placed = alpha.magnification * turned + alpha.vector[:2]
    valid = record["valid"]
    row, column = np.nonzero(valid)
    centre = (len(valid) - 1) / 2
    radius = len(valid) / 2
    figure = canvas(5.6, 5.6)
    axes = figure.subplots()
    axes.plot(
        (column - centre) / radius,
        (row - centre) / radius,
        "x",
        ms=5,
        color="#5b7fa8",
        label="subapertures",
    )
    axes.plot(*(placed / radius).T, "d", ms=3.5, color=MEASURED, label="actuators")
    found = alpha.to_boundary()
    axes.set(
        xlabel="x [pupil radius]",
        ylabel="y [pupil radius]",
        aspect="equal",
        title=(
            f"{100 * found['shift_x_subap']:.1f} %, {100 * found['shift_y_subap']:.1f} %, "
            f"{found['rotation_deg']:.2f}°, {100 * found['magnification']:.2f} %"
        ),
    )
    axes.legend(fontsize="small", loc="upper right")
    return figure


def slope_maps(budget: Budget, store: Store) -> Figure:
    """Draw figure 9: slope maps of nine modes, synthetic, measured and residual."""
    _, record = results.fit_record(budget, store, budget.seeds[0])
    columns = [int(np.argmin(np.abs(record["modes"] + 1 - mode))) for mode in results.SHOWN_MODES]
    tuned = record["synthetic"] * record["gains"]
    figure = canvas(7.4, 11.6)
    figure.set_layout_engine("constrained", w_pad=0.01, h_pad=0.01, wspace=0.0, hspace=0.0)
    panels = figure.subplots(len(columns), 3)
    for trio, column in zip(panels, columns, strict=True):
        synthetic, measured = tuned[:, column], record["measured"][:, column]
        limit = 2.5 * float(np.std(measured))
        share = np.linalg.norm(measured - synthetic) / np.linalg.norm(measured)
        for axes, slopes in zip(trio, (synthetic, measured, measured - synthetic), strict=True):
            axes.imshow(
                as_maps(slopes, record["valid"]) / limit,
                origin="lower",
                cmap="RdBu_r",
                vmin=-1,
                vmax=1,
                interpolation="nearest",
            )
            axes.set(xticks=[], yticks=[])
        trio[0].set_ylabel(f"KL {record['modes'][column] + 1}", fontsize="small")
        trio[2].set_xlabel(f"{share:.1%} left", fontsize="x-small")
    for axes, name in zip(panels[0], ("synthetic [Sx Sy]", "measured", "residual"), strict=True):
        axes.set_title(name, fontsize="small")
    return figure


def variance_maps(budget: Budget, store: Store) -> Figure:
    """Draw figure 10: the variance of the slopes over the modes, two telescopes and the model."""
    shown: list[tuple[str, Array, NDArray[np.bool_]]] = []
    for seed in budget.seeds[:2]:
        _, record = results.fit_record(budget, store, seed)
        values = results.normalised_variance(record["measured"])
        shown.append((f"measured, telescope {seed}", values, record["valid"]))
    _, record = results.fit_record(budget, store, budget.seeds[0])
    synthetic = results.normalised_variance(record["synthetic"])
    shown.append(("synthetic", synthetic, record["valid"]))
    figure = canvas(5.6, 7.4)
    for axes, (name, values, valid) in zip(
        figure.subplots(len(shown), 1, squeeze=False)[:, 0], shown, strict=True
    ):
        image = axes.imshow(
            as_maps(values, valid),
            origin="lower",
            cmap="viridis",
            vmin=0.0,
            vmax=2.5,
            interpolation="nearest",
        )
        axes.set(xticks=[], yticks=[], title=f"{name} [Sx Sy]")
        figure.colorbar(image, ax=axes, label="variance over its mean")
    return figure


def simulator_spectra(budget: Budget, store: Store) -> Figure:
    """Draw figure 11: modal spectra in the simulator with both reconstructors."""
    runs = plan.simulator_pair(budget, budget.seeds[0])
    synthetic, measured = (store.read(run) for run in runs)
    theirs = paper.QUOTES["simulator"].values
    figure = canvas(6.4, 3.8)
    _spectra(
        figure.subplots(),
        (
            ("turbulence", synthetic["incoming_nm2"], TURBULENCE),
            (
                f"synthetic: {wavefront_error_nm(synthetic):.0f} nm (paper: {theirs[0]:g} nm)",
                synthetic["modal_nm2"],
                SYNTHETIC,
            ),
            (
                f"measured: {wavefront_error_nm(measured):.0f} nm (paper: {theirs[1]:g} nm)",
                measured["modal_nm2"],
                MEASURED,
            ),
        ),
    )
    figure.axes[0].set_xlabel("KL mode")
    return figure


def around(budget: Budget, store: Store) -> Figure:
    """Draw figure 12: the simulator's error about the optimum, measured reconstructor."""
    figure = canvas(6.0, 7.6)
    panels = figure.subplots(3, 1)
    groups = ((plan.AROUND[0],), plan.AROUND[1:3], (plan.AROUND[3],))
    for axes, sweeps in zip(panels, groups, strict=True):
        for sweep, colour in zip(sweeps, (MEASURED, SYNTHETIC), strict=False):
            found = results.around_nm(budget, store, sweep)
            best = results.optimum(found)
            word = "" if best is None else f", best at {best:+.2f} {sweep.unit}"
            axes.plot(
                list(found), list(found.values()), "o-", color=colour, label=sweep.symbol + word
            )
        axes.axvline(0.0, color=PAPER, linestyle="--", label="found by Table 1's procedure")
        axes.set(
            xlabel=f"{' and '.join(s.symbol for s in sweeps)} less the value found "
            f"[{sweeps[0].unit}]",
            ylabel="wavefront error [nm RMS]",
        )
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small", loc="upper center")
    return figure


def telescope_spectra(budget: Budget, store: Store) -> Figure:
    """Draw figure 13: modal spectra by day from the mirror's positions."""
    synthetic, measured = (
        store.read(plan.variant_run(budget, budget.seeds[0], variant))
        for variant in (Variant.SYNTHETIC, Variant.MEASURED)
    )
    figure = canvas(6.4, 3.8)
    n = plan.N_MEASURED
    _spectra(
        figure.subplots(),
        (
            ("disturbance", synthetic["incoming_nm2"], TURBULENCE),
            ("synthetic, mirror's positions", synthetic["mirror_nm2"][:n], SYNTHETIC),
            ("measured, mirror's positions", measured["mirror_nm2"][:n], MEASURED),
            ("synthetic, true residual", synthetic["modal_nm2"][:n], "#e08a00"),
        ),
    )
    figure.axes[0].set_xlabel("KL mode")
    return figure


def images(budget: Budget, store: Store) -> Figure:
    """Draw figure 14: the PSF in the H band on a logarithmic scale."""
    figure = canvas(8.6, 3.2)
    panels = figure.subplots(1, 3)
    half = FIELD / OVERSAMPLING / 2
    order = (Variant.SYNTHETIC, Variant.MEASURED, Variant.MORE)
    for axes, variant in zip(panels, order, strict=True):
        record = store.read(plan.variant_run(budget, budget.seeds[0], variant))
        image = axes.imshow(
            np.log10(np.maximum(record["image"], 1e-7)),
            origin="lower",
            cmap="inferno",
            vmin=-5.0,
            vmax=0.0,
            extent=(-half, half, -half, half),
            interpolation="nearest",
        )
        axes.set_title(f"{variant}\nStrehl {strehl(record['image']):.3f}", fontsize="small")
        axes.set_xlabel("λ/D", fontsize="small")
    figure.colorbar(image, ax=panels, shrink=0.8, label="log10 of the peak without aberrations")
    return figure


DRAWN: dict[int, Callable[[Budget, Store], Figure]] = {
    3: eigenvalues,
    4: slopes_rms,
    5: sensitivity,
    6: sensitivity_spectra,
    7: last_scans,
    8: registration,
    9: slope_maps,
    10: variance_maps,
    11: simulator_spectra,
    12: around,
    13: telescope_spectra,
    14: images,
}
"""Figures by their number in the paper."""


def file_name(number: int) -> str:
    """Return the name of a figure's picture."""
    return f"figure{number:02d}.png"


def write_all(budget: Budget, store: Store, folder: Path) -> None:
    """Write every picture into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, draw in DRAWN.items():
        save_picture(draw(budget, store), folder / file_name(number), _DPI)
