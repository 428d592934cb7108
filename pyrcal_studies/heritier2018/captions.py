"""Captions of the figures: conditions, our numbers beside the paper's, agreement or reason."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pyrcal_studies.heritier2018 import markdown, paper, plan, results, telescope
from pyrcal_studies.heritier2018.loops import Over
from pyrcal_studies.heritier2018.markdown import listed
from pyrcal_studies.heritier2018.plan import Budget, Variant
from pyrcal_studies.heritier2018.registration import errors
from pyrcal_studies.heritier2018.store import Store

Caption = Callable[[Budget, Store], tuple[str, str]]


def eigenvalues(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 3."""
    found = results.spectra(budget, store)
    theirs = paper.QUOTES["condition"].values
    measured = [results.condition(values) for values in found.measured]
    clean = [results.condition(values) for values in found.clean]
    model = [results.condition(values) for values in found.model]
    drawn = [results.condition(values) for values in found.drawn]
    middle = len(found.synthetic) // 2
    flat = [values[middle] / values[0] for values in (found.synthetic, found.measured[0])]
    knees = [results.knee(values) for values in (found.synthetic, found.measured[0])]
    flatter = "flatter" if flat[0] > flat[1] else "steeper"
    later = "later" if knees[0] > knees[1] else "not later"
    text = (
        f"Condition numbers: synthetic {results.condition(found.synthetic):.2f} (the paper "
        f"{theirs[0]:g}), measured {listed(measured, '.2f')} on the telescopes in turn (the paper "
        f"{theirs[1]:g}). In the middle the synthetic spectrum has {flat[0]:.3f} of its first "
        f"value, the measured one {flat[1]:.3f}; the knee is at eigenmode {knees[0]} and "
        f"{knees[1]}. The paper: “{paper.QUOTES['eigenvalues'].text}”; here the synthetic spectrum "
        f"is {flatter}, its knee {later}.\n\n"
        "The condition numbers depend on the border. At 98 % of magnification the pupil reaches "
        f"{telescope.beyond_actuators_subap(0.98):.2f} subaperture beyond the outermost actuators, "
        "where the surface is an extrapolation that depends on the mirror. Without noise the model "
        f"has {model[0]:.2f} there, telescope {budget.seeds[0]} {clean[0]:.2f} and a telescope "
        "with "
        f"the model's own mirror {drawn[0]:.2f}. At 100 %, everything else unchanged, they have "
        f"{model[1]:.2f}, {clean[1]:.2f} and {drawn[1]:.2f}"
        + (
            ": the telescope is then above the model, as in the paper. So the border reverses the "
            "order. "
            if clean[1] > model[1] and clean[0] < model[0]
            else ". The border alone does not decide the order. "
        )
        + "The paper used measured influence functions, ours are thin plates."
    )
    return "eigenvalues of the measured and the synthetic matrix", text


def slopes_rms(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 4."""
    _, record = results.fit_record(budget, store, budget.seeds[0])
    before = results.rms(record["measured"]) / results.rms(record["synthetic"])
    after = results.rms(record["measured"]) / results.rms(record["synthetic"] * record["gains"])
    text = (
        f"Measured over synthetic, by mode: {before.mean():.3f} ± {before.std():.3f} before the "
        f"modal gains are tuned, {after.mean():.3f} ± {after.std():.3f} after (telescope "
        f"{budget.seeds[0]}). The paper: “{paper.QUOTES['slopes_rms'].text}” It agrees. The gains "
        "are the last step of section 4.3; the paper plays with the amplitude of the modes, here "
        "they are the least-squares gain of every column."
    )
    return "RMS of the slopes of each mode", text


def sensitivity(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 5."""
    theirs = dict(zip(("rotation_deg", "shift_x_subap"), paper.QUOTES["drop"].values, strict=True))
    texts = []
    for sweep in plan.SWEEPS:
        few, many = (results.curve(budget, store, sweep, n) for n in plan.INFLUENCE_MODES)
        drop, after = many.drop(), many.first_after()
        drops = "none" if drop is None else f"{drop:.2f} {sweep.unit} (first value after {after:g})"
        few_drop = few.drop()
        few_words = "none in this range" if few_drop is None else f"{few_drop:.2f} {sweep.unit}"
        own = ""
        if sweep.name in theirs:
            own = f", the paper's first value after it is {theirs[sweep.name]:g}"
        texts.append(f"{sweep.symbol}: 594 modes {drops}{own}; 400 modes {few_words}")
    costs = results.rule_costs_nm(budget, store)
    rule = "; ".join(
        f"{symbol}, {n_modes} modes: {cost:+.1f} nm" for (symbol, n_modes), cost in costs.items()
    )
    magnification = [
        results.curve(budget, store, plan.MAGNIFICATION, n) for n in plan.INFLUENCE_MODES
    ]
    at = magnification[0].values[min(2, len(magnification[0].values) - 1)]
    grown = [one.errors_nm[one.values.index(at)] - one.errors_nm[0] for one in magnification]
    text = (
        f"The drop is where {results.COSTLY_NM:g} nm are added in quadrature: {'. '.join(texts)}. "
        "The paper prints no threshold, gain or wind.\n\n"
        f"{_stability(budget, store)}\n\n"
        f"The rule of 10 % and 0.1° costs: {rule}. Magnification: {at:g} % adds "
        f"{grown[0]:.0f} nm with 400 modes and {grown[1]:.0f} nm with 594: "
        f"“{paper.QUOTES['magnification'].text}”. "
        f"1° moves the border by {100 * plan.ROTATION.border_subap(1.0):.1f} % of a subaperture "
        f"(the paper: around {paper.QUOTES['border'].values[1]:g} %)."
    )
    return "impact of a misregistration on the wavefront error", text


def _stability(budget: Budget, store: Store) -> str:
    """Return where the loop of 594 modes becomes unstable, by gain, beside the paper's values."""
    rotation, shift = (
        results.stability_limits(budget, store, sweep) for sweep in (plan.ROTATION, plan.SHIFT)
    )
    theirs = paper.QUOTES["drop"].values
    border = 100.0 * plan.ROTATION.border_subap(theirs[0])
    cells, ratios = [], []
    for gain in plan.POLE_GAINS:
        turned, moved = rotation[gain], shift[gain]
        words = [
            "stable" if value is None else f"{value:.2f}{unit}"
            for value, unit in ((turned, "°"), (moved, " %"))
        ]
        ratio = ""
        if turned is not None and moved is not None:
            ratios.append(100.0 * plan.ROTATION.border_subap(turned) / moved)
            ratio = f"{ratios[-1]:.2f}"
        cells.append([f"{gain:g}", *words, ratio])
    head = ["Gain", "α_rot", "α_x", "Movement of the border by α_rot over that by α_x"]
    text = (
        "With 594 modes the drop is a loss of stability, so the gain decides where it is. Table: "
        "values at which a pole of the model's loop leaves the unit circle, by integrator gain, "
        f"without turbulence.\n\n{markdown.table(head, cells)}\n\n"
    )
    if ratios and min(ratios) > border / theirs[1] * 1.2:
        text += (
            f"The paper's {theirs[0]:g}° move the border by {border:.0f} % of a subaperture, "
            f"{border / theirs[1]:.2f} times as much as its {theirs[1]:g} % of shift. Here the "
            f"ratio is {min(ratios):.2f} to {max(ratios):.2f} at any gain, so the gain alone does "
            "not explain the paper's pair of values. They are the first points of two sweeps after "
            "the drop, and the paper does not print the steps of the sweeps."
        )
    return text


def sensitivity_spectra(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 6."""
    texts = []
    for sweep in (plan.ROTATION, plan.SHIFT):
        for value, word in results.shown_values(budget, store, sweep).items():
            times, mode = results.amplified(budget, store, sweep, value)
            share = results.share_of_last_third(budget, store, sweep, value)
            texts.append(
                f"at {sweep.symbol} = {value:g} {sweep.unit} ({word}) modes about {mode} have "
                f"{times:.1f} times the turbulence, and {share:.0%} of the added variance is in "
                "the last third of the modes"
            )
    text = (
        f"594 modes controlled; {'; '.join(texts)}. The paper: “{paper.QUOTES['high_modes'].text}”."
    )
    return "modal PSD, nominal and misregistered", text


def last_scans(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 7."""
    _, record = results.fit_record(budget, store, budget.seeds[0])
    departures = []
    for k in range(6, len(record["steps"])):
        samples = (record[f"samples_{k}"] - record["minima"][k]) / record["step_sizes"][k]
        near = np.abs(samples) < 2.6
        chi = record[f"chi_{k}"]
        fitted = np.polyval(record[f"coefficients_{k}"], samples[near])
        departures.append(float(np.abs(chi[near] - fitted).max() / np.ptp(chi[near])))
    text = (
        "Steps 7 to 10 of Table 1 on the measured matrix of telescope "
        f"{budget.seeds[0]}; solid line: the second order polynomial. The paper: "
        f"“{paper.QUOTES['quadratic'].text}”. Samples depart from the polynomial by at most "
        f"{max(departures):.1%} of their range. It agrees."
    )
    return "the criterion χ_400 in the last scans", text


def registration(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 8."""
    off = errors(results.fit_record(budget, store, budget.seeds[0])[1], plan.TRUTH)
    text = (
        "Table 1's procedure on telescope "
        f"{budget.seeds[0]}: off by {off[0]:+.2f} %, {off[1]:+.2f} %, {off[2]:+.4f}°, "
        f"{off[3]:+.3f} % from the simulator's registration, which is the paper's."
    )
    return "actuators (diamonds) and subapertures (crosses)", text


def slope_maps(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 9."""
    _, record = results.fit_record(budget, store, budget.seeds[0])
    shares = record["residual_by_mode"]
    text = (
        "Synthetic, measured and residual slopes, all on the scale of the measured map (telescope "
        f"{budget.seeds[0]}). The residual has {np.median(shares):.0%} of the measured RMS in the "
        f"middle of the modes, {shares.min():.0%} at least, {shares.max():.0%} at most: noise of "
        "the measurement, uneven light and another mirror. The paper's comparison "
        f"“{paper.QUOTES['maps'].text}”; it prints no number."
    )
    return "slope maps of KL modes 1 to 400", text


def variance_maps(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 10."""
    values = []
    for seed in budget.seeds[:2]:
        _, record = results.fit_record(budget, store, seed)
        values.append(results.normalised_variance(record["measured"]))
    synthetic = results.normalised_variance(record["synthetic"])
    spread = [float(np.std(one / synthetic)) for one in values]
    alike = np.atleast_2d(np.corrcoef(np.array(values) / synthetic))[0, -1]
    text = (
        "Variance of each slope over the modes, each mode scaled to RMS 1. Measured over synthetic "
        f"it scatters by {listed(spread, '.0%')} between subapertures; the features of both "
        f"telescopes correlate by {alike:.2f}. In the paper “{paper.QUOTES['features'].text}”, and "
        "the features change from 2016 to 2017. Ours come from smooth uneven light (10 %); what "
        "the paper's features would cost is in the section on 147 nm."
    )
    return "variance of the slopes over the modes", text


def simulator_spectra(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 11."""
    pairs = [results.simulator_nm(store, budget, seed) for seed in budget.seeds]
    theirs = paper.QUOTES["simulator"].values
    text = (
        f"Simulator with all of the turbulence (1 arcsec), 400 modes, gain {plan.NIGHT_GAIN:g}. "
        f"Synthetic: {listed((pair[0] for pair in pairs), '.1f')} nm by telescope (the paper "
        f"{theirs[0]:g} nm; it prints no wind, gain or flux, so the agreement is that of the "
        f"uncontrolled modes). Measured: {listed((pair[1] for pair in pairs), '.1f')} nm (the "
        "paper "
        f"{theirs[1]:g} nm): not reached, see the section on 147 nm."
    )
    return "modal PSD in the simulator with both reconstructors", text


def around(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 12."""
    texts, best_at_zero = [], 0
    for sweep in plan.AROUND:
        found = results.around_nm(budget, store, sweep)
        best = results.optimum(found)
        smallest = list(found)[int(np.argmin(list(found.values())))]
        best_at_zero += smallest == 0.0
        word = "no minimum" if best is None else f"{best:+.2f} {sweep.unit}"
        rise = max(found.values()) - found[0.0]
        texts.append(
            f"{sweep.symbol} smallest sample at {smallest:g}, parabola at {word}, up to "
            f"{rise:+.0f} nm at the ends"
        )
    ratios = results.sensitivity_ratios(budget, store)
    alike = "; ".join(f"{name}: {a:.0f} and {b:.0f} nm" for name, (a, b) in ratios.items())
    text = (
        "Measured reconstructor of telescope "
        f"{budget.seeds[0]} in the simulator, whose registration is moved away from the value that "
        f"Table 1's procedure found, judged by wavefront error: {'; '.join(texts)}. The paper: "
        f"“{paper.QUOTES['best'].text}”; here for {best_at_zero} of {len(plan.AROUND)}, judged by "
        f"the smallest sample. “{paper.QUOTES['same'].text}”: added in quadrature in figure 5 and "
        f"here, {alike or 'not compared'}. The loops about the optimum also differ by where the "
        "light "
        "falls on the sensor's mask, which moves with the shift."
    )
    return "the simulator about the optimum, measured reconstructor", text


def telescope_spectra(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 13."""
    record = store.read(plan.closed_run(budget, budget.seeds[0], Variant.SYNTHETIC))
    low = [float(np.sqrt(record[name][:2].sum())) for name in ("mirror_nm2", "modal_nm2")]
    by = [
        results.table_2_nm(budget, store, v, Over.MIRROR).mean(axis=0)
        for v in (Variant.SYNTHETIC, Variant.MEASURED)
    ]
    text = (
        "Spectra of the mirror's positions, as the paper computes its residuals, with the true "
        "residual beside them. Tip and tilt have "
        f"{low[0]:.0f} nm in the positions and {low[1]:.0f} nm in truth: the difference is the "
        "correction of vibrations. Without tip and tilt synthetic and measured have "
        f"{by[0][1]:.1f} and {by[1][1]:.1f} nm (the paper 41.7 and 42.1), without 50 modes "
        f"{by[0][2]:.1f} and {by[1][2]:.1f} nm (the paper 30.1 and 30.8)."
    )
    return "modal PSD by day, same disturbance", text


def images(budget: Budget, store: Store) -> tuple[str, str]:
    """Return title and text of figure 14."""
    stable = sum(
        results.is_stable(store.read(plan.closed_run(budget, seed, Variant.MORE)))
        for seed in budget.seeds
    )
    ratios = ", ".join(f"{results.strehls(budget, store, v).mean():.3f} ({v})" for v in Variant)
    text = (
        "1.65 µm, long exposure of the true residual, vibrations included. Strehl ratio: "
        f"{ratios}. "
        f"The loop of 500 modes is stable on {stable} of {len(budget.seeds)} telescopes, although "
        "only 400 modes were measured. The paper managed “"
        f"{paper.QUOTES['more'].text}”; it prints no Strehl ratio."
    )
    return "PSF in the H band, logarithmic", text


CAPTIONS: dict[int, Caption] = {
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
"""Captions by the number of the figure in the paper."""
