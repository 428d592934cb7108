"""The loop closed with the measured and with the synthetic matrix."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import page, paper, table2
from pyrcal_studies.heritier2018.closed_remarks import noise_remark, shaken_remark
from pyrcal_studies.heritier2018.closing import RAMP_GAINS
from pyrcal_studies.heritier2018.loops import SETTLING_FRAMES, wavefront_error_nm
from pyrcal_studies.heritier2018.plan import (
    CLOSED_GAIN,
    Budget,
    Variant,
    closed_run,
    gain_tuning,
    hasty,
)
from pyrcal_studies.heritier2018.psf import FIELD, OVERSAMPLING, marechal, strehl
from pyrcal_studies.heritier2018.spectra import smoothed
from pyrcal_studies.heritier2018.store import Record, Store

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

LEFT_OUT = (0, 2, 50)
"""Modes left out of an error: none, tip and tilt, the first 50."""

_NAMES = ("all modes", "without tip-tilt", "without the first 50")


def records(
    budget: Budget, store: Store, variant: Variant, *, vibrations: bool
) -> tuple[Record, ...]:
    """Return a variant's loop on every telescope."""
    runs = (closed_run(budget, seed, variant, vibrations=vibrations) for seed in budget.seeds)
    return tuple(store.read(run) for run in runs)


def errors_nm(
    budget: Budget, store: Store, variant: Variant, *, vibrations: bool, without_first: int = 0
) -> Array:
    """Return its wavefront error on every telescope, nm."""
    found = records(budget, store, variant, vibrations=vibrations)
    return np.array([wavefront_error_nm(r, without_first=without_first) for r in found])


def section(budget: Budget, store: Store) -> page.Section:
    """Return the section on closed loops."""
    n_frames, n_seeds = budget.closed_frames, len(budget.seeds)
    body = page.paragraph(
        "By day: a turbulence of 1 arcsec is played on the mirror, which also corrects it, the "
        f"light meets it twice, gain {CLOSED_GAIN:g} of every mode, fibre of magnitude 7. Errors "
        "are at the sensor, after both passes. "
        f"{n_frames} frames a loop after {SETTLING_FRAMES} of settling, {n_seeds} "
        f"telescope{'s' * (n_seeds > 1)}, each with imperfections, measured matrix, fit and "
        "turbulence of its own; ± is their scatter."
    )
    body += table2.body(budget, store) + _gains_table(budget, store)
    body += page.heading("All of the wavefront, with and without vibrations")
    body += _errors_table(budget, store)
    body += shaken_remark(*_all_modes_nm(budget, store))
    body += _pairs_remark(budget, store)
    body += _noise_table(budget, store)
    well, in_haste = (
        np.array([gained_nm(b, store, vibrations=v)[0] for v in (False, True)])
        for b in (budget, hasty(budget))
    )
    body += noise_remark(well, in_haste)
    body += page.picture(
        _spectra_figure(budget, store),
        f"Residual by mode, telescope {budget.seeds[0]}, without and with vibrations. "
        f"{n_frames} frames; a running mean over 9 modes beyond the tenth.",
    )
    body += page.picture(
        _images_figure(budget, store),
        f"H band (1.65 µm), telescope {budget.seeds[0]}, vibrations on, {n_frames} frames: "
        f"central {FIELD // OVERSAMPLING} λ/D, logarithm of the intensity over the perfect peak.",
    )
    body += _strehl_table(budget, store)
    return page.Section(anchor="loops", title="Closed loop", body=body)


def _errors_table(budget: Budget, store: Store) -> str:
    head = ["reconstructor", "vibrations", *(f"{name} [nm]" for name in _NAMES)]
    rows = []
    for vibrations in (False, True):
        word = "on" if vibrations else "off"
        for variant in Variant:
            cells = [
                _with_scatter(
                    errors_nm(budget, store, variant, vibrations=vibrations, without_first=n)
                )
                for n in LEFT_OUT
            ]
            rows.append([str(variant), word, *cells])
    return page.table(head, rows, words=(1,))


def _with_scatter(values: Array) -> str:
    if len(values) == 1:
        return f"{values[0]:.1f}"
    return f"{values.mean():.1f} ± {values.std(ddof=1):.1f}"


def _all_modes_nm(budget: Budget, store: Store) -> tuple[Array, Array]:
    still, shaken = (errors_nm(budget, store, Variant.TUNED, vibrations=v) for v in (False, True))
    return still, shaken


def _gains_table(budget: Budget, store: Store) -> str:
    head = ["reconstructor", "telescope", "tip and tilt", "modes to 100", "the rest"]
    rows = []
    for variant in (Variant.MEASURED, Variant.TUNED, Variant.MORE):
        for seed in budget.seeds:
            gains = store.read(gain_tuning(budget, seed, variant))["by_group"]
            rows.append([str(variant), str(seed), *(f"{gain:g}" for gain in gains)])
    told = (
        "The paper tunes gains by groups: tip and tilt, modes to 100, the rest, each by its own "
        f"residual slopes. The ramp tries {', '.join(f'{gain:g}' for gain in RAMP_GAINS)}; the "
        f"service's own goes no higher than {CLOSED_GAIN:g}, which is the gain of the loops here."
    )
    return page.heading("Gains that the ramp finds") + page.paragraph(told) + page.table(head, rows)


def _pairs_remark(budget: Budget, store: Store) -> str:
    """Return measured against synthetic, telescope by telescope, and 500 modes."""
    text, good = "", True
    for vibrations in (False, True):
        gained = gained_nm(budget, store, vibrations=vibrations)
        good &= bool(np.all(gained >= 0.0))
        listed = ", ".join(f"{value:+.2f}" for value in gained)
        word = "with" if vibrations else "without"
        text += f"Measured less synthetic (gains tuned) {word} vibrations: {listed} nm. "
    text += (
        "The synthetic matrix is not worse on any telescope. "
        if good
        else "The synthetic matrix is worse on some: there the model's error costs more than the "
        "noise of the measurement does. "
    )
    more = errors_nm(budget, store, Variant.MORE, vibrations=True)
    tuned = errors_nm(budget, store, Variant.TUNED, vibrations=True)
    better = float(np.mean(tuned - more))
    stable = bool(np.all(more < 2.0 * tuned))
    text += (
        f"500 modes with the synthetic matrix, 100 beyond any that was measured, "
        f"{'hold' if stable else 'do not hold'}: {better:+.1f} nm better on average."
    )
    return page.remark(text, agrees=good and stable)


def gained_nm(budget: Budget, store: Store, *, vibrations: bool) -> Array:
    """Return what the synthetic matrix, gains tuned, gains on the measured one, nm."""
    measured = errors_nm(budget, store, Variant.MEASURED, vibrations=vibrations)
    return measured - errors_nm(budget, store, Variant.TUNED, vibrations=vibrations)


def _noise_table(budget: Budget, store: Store) -> str:
    """Return the same with a matrix measured well and measured in haste, first telescope."""
    head = ["pushes and pulls of a mode", "vibrations", "measured [nm]", "synthetic [nm]", "gained"]
    first = replace(budget, seeds=budget.seeds[:1])
    rows = []
    for measured in dict.fromkeys((first, hasty(budget))):
        for vibrations in (False, True):
            pair = [
                float(errors_nm(measured, store, variant, vibrations=vibrations)[0])
                for variant in (Variant.MEASURED, Variant.TUNED)
            ]
            cells = [*(f"{value:.1f}" for value in pair), f"{pair[0] - pair[1]:+.1f}"]
            rows.append([str(measured.n_average), "on" if vibrations else "off", *cells])
    return page.heading("What the noise of the measured matrix costs") + page.table(
        head, rows, words=(1,)
    )


def _spectra_figure(budget: Budget, store: Store) -> Figure:
    figure = page.canvas(10.5, 3.9)
    panels = figure.subplots(1, 2, sharey=True)
    for axes, vibrations in zip(panels, (False, True), strict=True):
        for variant in Variant:
            record = records(budget, store, variant, vibrations=vibrations)[0]
            if variant is Variant.MEASURED:
                axes.loglog(*smoothed(record["incoming_nm2"]), color="0.6", label="no correction")
            axes.loglog(*smoothed(record["modal_nm2"]), label=str(variant), linewidth=1.1)
        axes.set(xlabel="mode", title="vibrations on" if vibrations else "vibrations off")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("variance of the mode [nm²]")
    panels[0].legend(fontsize="small")
    return figure


def _images_figure(budget: Budget, store: Store) -> Figure:
    figure = page.canvas(10.5, 3.1)
    panels = figure.subplots(1, len(Variant))
    half = FIELD / OVERSAMPLING / 2
    for axes, variant in zip(panels, Variant, strict=True):
        record = records(budget, store, variant, vibrations=True)[0]
        image = axes.imshow(
            np.log10(np.maximum(record["image"], 1e-7)),
            origin="lower",
            cmap="inferno",
            vmin=-5.0,
            vmax=0.0,
            extent=(-half, half, -half, half),
        )
        axes.set_title(f"{variant}\nStrehl {strehl(record['image']):.3f}", fontsize="x-small")
        axes.tick_params(labelsize="x-small")
    figure.colorbar(image, ax=panels, shrink=0.8)
    return figure


def _strehl_table(budget: Budget, store: Store) -> str:
    head = ["reconstructor", "Strehl in H, vibrations off", "on", "Maréchal, on"]
    rows = []
    for variant in Variant:
        still, shaken = (
            np.array([strehl(r["image"]) for r in records(budget, store, variant, vibrations=v)])
            for v in (False, True)
        )
        error_nm = errors_nm(budget, store, variant, vibrations=True).mean()
        rows.append(
            [
                str(variant),
                f"{still.mean():.3f}",
                f"{shaken.mean():.3f}",
                f"{marechal(float(error_nm)):.3f}",
            ]
        )
    for row in paper.TABLE_2.values():
        total = row.errors_nm[0]
        rows.append([f"paper: {row.name}, {total:g} nm", "", "", f"{marechal(total):.2f}"])
    return page.table(head, rows)
