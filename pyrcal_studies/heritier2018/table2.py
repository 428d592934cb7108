"""Table 2 of the paper, column by column: level, order, and what makes ours what it is."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.heritier2018 import page, paper
from pyrcal_studies.heritier2018.loops import N_PARTS, Over, wavefront_error_nm
from pyrcal_studies.heritier2018.plan import (
    CLOSED_GAIN,
    Budget,
    Variant,
    answer,
    closed_run,
    hasty,
    ramped_run,
    reconstructor,
    trials,
)
from pyrcal_studies.heritier2018.store import Record, Store

Array = NDArray[np.float64]

_ALIKE = 0.2
"""Relative difference of levels that needs no reason: wind and gains are not quoted."""

_SIGMAS = 2.0
"""A difference within so many of its scatter may be chance."""

LEFT_OUT = (0, 2, 50)
"""First modes left out of the error, by column of Table 2."""

COLUMNS = ("WFE", "tip and tilt removed", "50 KL removed")

ROWS = {
    "synthetic": Variant.TUNED,
    "measured": Variant.MEASURED,
    "more": Variant.MORE,
}
"""Ours by the paper's rows."""


def columns_nm(record: Record, over: Over) -> Array:
    """Return the three columns of a loop, nm."""
    return np.array([wavefront_error_nm(record, without_first=n, over=over) for n in LEFT_OUT])


def shares_nm(columns: Array) -> Array:
    """Return tip and tilt, modes 3 to 50 and those beyond, of columns ``(..., 3)``, nm."""
    power = columns**2
    beyond = np.append(power[..., 1:], np.zeros_like(power[..., :1]), axis=-1)
    return np.asarray(np.sqrt(np.maximum(power - beyond, 0.0)))


def ours_nm(
    budget: Budget, store: Store, variant: Variant, over: Over, *, ramped: bool = False
) -> Array:
    """Return ``(n_telescopes, 3)`` columns of a variant in a shaking dome.

    ``ramped``: with the gains of the ramp, else one for every mode.
    """
    runs = (
        ramped_run(budget, seed, variant)
        if ramped
        else closed_run(budget, seed, variant, vibrations=True)
        for seed in budget.seeds
    )
    return np.array([columns_nm(store.read(run), over) for run in runs])


def body(budget: Budget, store: Store) -> str:
    """Return the part of the report on Table 2."""
    return (
        page.heading("Table 2, column by column")
        + _level_table(budget, store)
        + _level_remark(budget, store)
        + page.heading("The same by parts of the wavefront")
        + _shares_table(budget, store)
        + _tilt_remark(budget, store)
        + page.heading("Order, column by column")
        + _order_table(budget, store, ramped=False)
        + page.paragraph("The same with the gains that the ramp finds:")
        + _order_table(budget, store, ramped=True)
        + _order_remark(budget, store)
        + _gain_remark(budget, store)
        + page.heading("What makes ours what it is")
        + _trials_table(budget, store)
        + _trials_remark(budget, store)
    )


def _level_table(budget: Budget, store: Store) -> str:
    head = ["reconstructor", "residual taken over", *(f"{name} [nm]" for name in COLUMNS)]
    rows = []
    for key, variant in ROWS.items():
        quoted = paper.TABLE_2[key]
        rows.append([quoted.name, "paper, Table 2", *(f"{v:g}" for v in quoted.errors_nm)])
        for over in Over:
            found = ours_nm(budget, store, variant, over)
            rows.append([f"here: {variant}", str(over), *_with_scatter(found)])
    return page.table(head, rows, words=(1,))


def _with_scatter(found: Array) -> list[str]:
    if len(found) == 1:
        return [f"{value:.1f}" for value in found[0]]
    scatter = found.std(axis=0, ddof=1)
    return [f"{m:.1f} ± {s:.1f}" for m, s in zip(found.mean(axis=0), scatter, strict=True)]


def _level_remark(budget: Budget, store: Store) -> str:
    """Return which way of taking the residual comes nearest to the paper's levels."""
    away = {over: float(np.mean(np.abs(_ratios(budget, store, over) - 1.0))) for over in Over}
    nearest = min(away, key=lambda over: away[over])
    listed = ", ".join(f"{value:.0%} over {over}" for over, value in away.items())
    text = (
        "What the paper's residual is taken over is not in the numbers quoted to us, so each way "
        "is shown. Distance from its columns without tip and tilt and without 50 modes, mean of "
        f"all rows: {listed}. {nearest.capitalize()} comes nearest."
    )
    return page.remark(text, agrees=away[nearest] < _ALIKE)


def _ratios(budget: Budget, store: Store, over: Over) -> Array:
    """Return ours over the paper's, ``(3, 2)``: rows, and the columns that shaking leaves alone."""
    return np.array(
        [
            ours_nm(budget, store, variant, over).mean(axis=0)[1:]
            / np.array(paper.TABLE_2[key].errors_nm[1:])
            for key, variant in ROWS.items()
        ]
    )


def _shares_table(budget: Budget, store: Store) -> str:
    head = ["reconstructor", "", "tip and tilt [nm]", "modes 3 to 50 [nm]", "beyond mode 50 [nm]"]
    rows = []
    for key, variant in ROWS.items():
        quoted = paper.TABLE_2[key]
        shares = shares_nm(np.array(quoted.errors_nm))
        rows.append([quoted.name, "paper", *(f"{value:.1f}" for value in shares)])
        found = shares_nm(ours_nm(budget, store, variant, Over.CONTROLLED))
        rows.append([f"here: {variant}", str(Over.CONTROLLED), *_with_scatter(found)])
    return page.table(head, rows, words=(1,))


def _tilt_remark(budget: Budget, store: Store) -> str:
    """Return why the first column cannot tell reconstructors from one another."""
    tilts = {key: shares_nm(np.array(row.errors_nm))[0] for key, row in paper.TABLE_2.items()}
    totals = {key: row.errors_nm[0] for key, row in paper.TABLE_2.items()}
    share = min(tilts[key] ** 2 / totals[key] ** 2 for key in tilts)
    apart = max(tilts.values()) / min(tilts.values()) - 1.0
    ours = shares_nm(ours_nm(budget, store, Variant.TUNED, Over.CONTROLLED))[:, 0].mean()
    moments = _chance_nm(budget, store)[0] / float(ours)
    text = (
        f"In the paper tip and tilt are {share:.0%} or more of the variance of the first column, "
        f"{min(tilts.values()):.0f} to {max(tilts.values()):.0f} nm: {apart:.0%} apart, in loops "
        "one after the other. Here one and the same loop differs by "
        f"{moments:.0%} (1 σ) from one part of it to the next. "
    )
    chance = moments > apart / _SIGMAS
    text += (
        "So the order of the first column can be that of how the telescope happened to shake, and "
        "need be no property of the matrices."
        if chance
        else "So much is no chance."
    )
    return page.remark(text, agrees=False)


def _chance_nm(budget: Budget, store: Store) -> Array:
    """Return the scatter of tip and tilt, modes 3 to 50, and beyond, between parts of one loop."""
    scatter = []
    for seed in budget.seeds:
        run = closed_run(budget, seed, Variant.TUNED, vibrations=True)
        scatter.append(shares_nm(columns_by_part_nm(store.read(run))).var(axis=0, ddof=1))
    return np.asarray(np.sqrt(np.mean(scatter, axis=0)))


def columns_by_part_nm(record: Record) -> Array:
    """Return ``(N_PARTS, 3)`` columns over the controlled modes, part by part of a loop."""
    n_controlled = len(record["slopes_nm2"])
    modal = record["modal_by_part_nm2"][:, :n_controlled]
    power = np.array([[part[n:].sum() for n in LEFT_OUT] for part in modal])
    return np.asarray(np.sqrt(power))


def _order_table(budget: Budget, store: Store, *, ramped: bool) -> str:
    head = ["column", "second less first", "paper [nm]", *(f"here, {over} [nm]" for over in Over)]
    rows = []
    for column, name in enumerate(COLUMNS):
        for first, second in combinations(ROWS, 2):
            theirs = _paper_difference(column, first, second)
            cells = []
            for over in Over:
                ours = _differences_nm(budget, store, over, first, second, ramped=ramped)[:, column]
                cells.append(_judged(ours, theirs))
            pair = f"{paper.TABLE_2[second].name} less {paper.TABLE_2[first].name}"
            rows.append([name, pair, f"{theirs:+.2f}", *cells])
    return page.table(head, rows, words=(1,))


def _paper_difference(column: int, first: str, second: str) -> float:
    rows = paper.TABLE_2
    return rows[second].errors_nm[column] - rows[first].errors_nm[column]


def _differences_nm(
    budget: Budget, store: Store, over: Over, first: str, second: str, *, ramped: bool
) -> Array:
    """Return ours ``(n_telescopes, 3)``, each pair on the same turbulence and shaking."""
    one, other = (ours_nm(budget, store, ROWS[key], over, ramped=ramped) for key in (first, second))
    return other - one


def _judged(ours: Array, theirs: float) -> str:
    scatter = f" ± {ours.std(ddof=1):.2f}" if len(ours) > 1 else ""
    return f"{ours.mean():+.2f}{scatter} ({order_word(ours, theirs)})"


def order_word(ours: Array, theirs: float) -> str:
    """Return whether differences by telescope have the sign of the paper's."""
    signs = np.sign(ours * theirs)
    if np.all(signs > 0):
        return "same"
    return "other way" if np.all(signs < 0) else "either way"


def _order_remark(budget: Budget, store: Store) -> str:
    """Return how many of the paper's orders ours has, and what chance does to the others."""
    n_pairs, best = 3 * len(COLUMNS), 0
    texts = []
    for ramped, word in ((False, "one gain"), (True, "gains by the ramp")):
        for over in Over:
            n_same = 0
            for first, second in combinations(ROWS, 2):
                found = _differences_nm(budget, store, over, first, second, ramped=ramped)
                n_same += sum(
                    order_word(found[:, k], _paper_difference(k, first, second)) == "same"
                    for k in range(len(COLUMNS))
                )
            best = max(best, n_same)
            texts.append(f"{n_same} ({word}, {over})")
    text = f"Of {n_pairs} orders the paper's on every telescope: {', '.join(texts)}. "
    return page.remark(text + _chance_text(budget, store), agrees=best == n_pairs)


def _chance_text(budget: Budget, store: Store) -> str:
    """Return how the paper's differences compare with chance and with noise."""
    chance = _chance_nm(budget, store)
    low = {key: shares_nm(np.array(row.errors_nm))[1] for key, row in paper.TABLE_2.items()}
    brief = hasty(budget)
    noise = _differences_nm(
        brief, store, Over.CONTROLLED, "synthetic", "measured", ramped=False
    ).mean(axis=0)
    listed = " / ".join(f"{value:+.2f}" for value in noise)
    return (
        "The paper's two rows of 400 modes differ by "
        f"{_paper_difference(1, 'synthetic', 'measured'):.1f} and "
        f"{_paper_difference(2, 'synthetic', 'measured'):.1f} nm without tip and tilt and without "
        f"50 modes; its 500 modes have {low['more'] - low['synthetic']:+.1f} nm in modes 3 to 50, "
        "which is all that makes them worse there. The same loop here differs from one part of "
        f"{budget.closed_frames // N_PARTS} frames to the next by {chance[1]:.1f} nm in modes 3 to "
        f"50 and by {chance[2]:.1f} nm beyond them. With a matrix whose every mode was pushed and "
        f"pulled once, measured less synthetic is {listed} nm in the three columns (first "
        f"telescope, {Over.CONTROLLED})"
        + (": noise makes the paper's order." if np.all(noise > 0.0) else ".")
    )


def _gain_remark(budget: Budget, store: Store) -> str:
    """Return how the order of both matrices hangs on the gain of the loop."""
    texts, signs = [], set()
    for ramped, word in ((False, f"with gain {CLOSED_GAIN:g}"), (True, "with the ramp's gains")):
        found = _differences_nm(
            budget, store, Over.CONTROLLED, "synthetic", "measured", ramped=ramped
        )[:, 1]
        signs.add(bool(found.mean() > 0.0))
        listed = ", ".join(f"{value:+.2f}" for value in found)
        texts.append(f"{listed} nm {word}")
    text = (
        "Measured less synthetic over the controlled modes, tip and tilt removed, telescope by "
        f"telescope: {'; '.join(texts)}. "
    )
    given = {
        word: np.mean([response(budget, store, seed, variant) for seed in budget.seeds], axis=0)
        for word, variant in (("synthetic", Variant.TUNED), ("measured", Variant.MEASURED))
    }
    text += "What R D of the true telescope gives back of a mode: " + ", ".join(
        f"{own:.3f} of itself and {others:.3f} of all others ({word})"
        for word, (own, others) in given.items()
    )
    text += (
        ". So which of the two is better hangs on the gain: one acts as if its gain were higher, "
        "and a higher gain helps as long as the loop is slow and harms near its limit."
        if len(signs) == 2
        else ". The gain does not decide which of the two is better."
    )
    return page.remark(text, agrees=signs == {True})


def response(budget: Budget, store: Store, seed: int, variant: Variant) -> tuple[float, float]:
    """Return what a reconstructor gives back of a mode of the true telescope, mean over modes.

    Its own row, and the quadratic sum of all other rows.
    """
    inverse = reconstructor(budget, seed, variant)
    matrix = store.read(answer(seed))["matrix"].astype(np.float64) * inverse.passes
    back = store.read(inverse)["matrix"].astype(np.float64) @ matrix
    own = np.diag(back)
    others = back - np.diag(own)
    return float(own.mean()), float(np.sqrt((others**2).sum(axis=0).mean()))


def _trials_table(budget: Budget, store: Store) -> str:
    head = ["first telescope, no vibrations", "modes"]
    head += [f"{name}, {over} [nm]" for over in Over for name in ("tt removed", "50 removed")]
    rows = []
    for variant in (Variant.TUNED, Variant.MORE):
        for name, run in trials(budget, variant).items():
            record = store.read(run)
            cells = [f"{value:.1f}" for over in Over for value in columns_nm(record, over)[1:]]
            rows.append([name, str(run.reconstructor.n_modes), *cells])
    for key, variant in ROWS.items():
        quoted = paper.TABLE_2[key].errors_nm
        n_modes = "500" if variant is Variant.MORE else "400"
        rows.append(
            [f"paper: {paper.TABLE_2[key].name}", n_modes, f"{quoted[1]:g}", f"{quoted[2]:g}"]
            + [""] * 4
        )
    return page.table(head, rows)


def _trials_remark(budget: Budget, store: Store) -> str:
    """Return what of the residual comes from where, by the trials."""
    found = {name: store.read(run) for name, run in trials(budget, Variant.TUNED).items()}
    usual, _, played, *_ = (columns_nm(record, Over.CONTROLLED)[1] for record in found.values())
    whole = columns_nm(next(iter(found.values())), Over.PUPIL)[1]
    shown = columns_nm(next(iter(found.values())), Over.SLOPES)[1]
    beyond, leaked = (_quadrature_nm(a, b) for a, b in ((whole, usual), (usual, played)))
    quoted = paper.TABLE_2["synthetic"].errors_nm[1]
    text = (
        f"Of {whole:.0f} nm without tip and tilt (400 modes), {beyond:.0f} nm are turbulence "
        f"played in modes that 400 do not control, {leaked:.0f} nm are what those modes leak "
        f"into the controlled ones, and {played:.0f} nm are what the loop itself leaves. The "
        f"slopes show {shown:.0f} nm: what has leaked is gone from them, because the loop has "
        "corrected it there, and is on the mirror all the same. "
    )
    explained = abs(usual / quoted - 1.0) < _ALIKE < abs(whole / quoted - 1.0)
    text += (
        f"Taken over the controlled modes ours is {usual:.0f} nm, the paper's {quoted:g}: what "
        "made ours larger is the part of the turbulence that the controlled modes cannot make."
        if explained
        else f"Taken over the controlled modes ours is {usual:.0f} nm, the paper's {quoted:g}."
    )
    return page.remark(text, agrees=explained)


def _quadrature_nm(larger: float, smaller: float) -> float:
    return float(np.sqrt(max(larger**2 - smaller**2, 0.0)))
