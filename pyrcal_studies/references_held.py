"""The shape that a loop holds by its reference slopes, on the simulated diffractive telescope.

A loop is to hold a shape of some size in modes 2 to 21, and the wavefront that it leaves on the
sensor is averaged. The same loop without a shape, on the same turbulence and photons, is run first:
its residual wavefronts give the true modal gains, by pokes without noise along the reconstructor,
and its own mean is subtracted, so that the error of the shape is that of the references. ``held``
are shapes in constant seeing, with references of several kinds; ``moved`` are mirrors that are off
their place, with references that follow and others that do not; ``jump`` are shapes as large as the
limit permits while the seeing goes from 0.6 to the worst within a second; ``sweep`` are shapes that
grow from there by steps of 25 % until the loop is lost.

Run: ``python -m pyrcal_studies.references_held --output var/references.jsonl --table table.md``.
Rows that are in the file already are not computed again; ``--only jump`` runs a part. ``--limits``
has jumps with parts and multiples of the largest shape, ``--loop-gain`` and ``--magnitude`` with
other loops.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.rows import (
    Row,
    campaign_parser,
    complete,
    grouped,
    heading,
    line,
    tell,
    words,
)
from service.control.expected_gain import compute_radial_orders
from service.control.gains import gain_table
from service.control.reconstructor import invert
from service.control.references import (
    compute_references,
    limit_shape,
    shape_in_modes,
)
from service.files import parse_alpha
from service.instrument import load_instrument
from service.model.interaction import InteractionModel
from service.model.modes import karhunen_loeve_basis
from service.records.products import Frame
from service.records.registration import ModeGain
from sim_rtc.assembly import build_telescope
from sim_rtc.computer.feed import BATCH_FRAMES
from sim_rtc.computer.loop import LoopTerms, ModalLoop
from sim_rtc.options import parse_options
from sim_rtc.telescope.diffractive import DiffractiveOptics

Array = NDArray[np.float64]

TELESCOPES = {"flao-lbt": 400, "tests/system/small.toml": 63}
"""Instrument files, and modes that are controlled: an 8.2 m and a 3 m telescope."""

SHAPED = np.arange(2, 22)
"""Modes of the shape."""

EXPONENTS = {"steep": -2.0, "middle": -1.0, "flat": 0.0}
"""Amplitude as the radial order to this power."""

SETTLING_FRAMES, HELD_FRAMES = 300, 1000
SETTLED_BATCHES = SETTLING_FRAMES // BATCH_FRAMES
POKE_M = 10e-9
POKE_FRAMES = 150
"""Frames from one residual that is poked to the next."""

CALM_ARCSEC, RISE_S, AFTERWARDS_S = 0.6, 1.0, 1.0
LOST_M = 500e-9
"""RMS wavefront of a lost loop; the largest seeing leaves 0.2 µm."""
LOST_BATCHES = 10

GROWING = 1.25 ** np.arange(9)
"""Sizes of a sweep over the largest shape, one after the other until the loop is lost."""

SWEPT = {0.9: (range(1, 6), (1, 2)), 1.2: ((1, 2), range(1, 7))}
"""Seeds of shapes and of turbulences at each worst seeing, arcsec."""

DITHERED = (310, 330, 360, 390, 11)
GAIN_SIGMA = 0.02
"""Relative 1 σ of a dithered mode's gain."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One loop that holds a shape."""

    case: str
    """held, moved, jump or sweep."""

    seeing_arcsec: float
    """Constant, or the one after the jump."""

    seed: int
    references: str
    """static: D c; pokes: D G c; holding: with the gain that holds; table: that of a few dithered
    modes; strong: 1.3 times; nominal: as holding, of a mirror in its place."""

    shape: str = "steep"
    rms_nm: float = 100.0
    """0: as large as the limit permits."""

    alpha: str = "0,0,0,1"
    instrument: str = "flao-lbt"

    drawn: int = 0
    """Seed of the shape; 0: that of the turbulence."""

    limits: float = 1.0
    """Size over that of the largest shape, if ``rms_nm`` is 0."""

    loop_gain: float = 0.4
    magnitude: float = 8.0

    @property
    def jumps(self) -> bool:
        """True if the seeing changes within the loop."""
        return self.case in {"jump", "sweep"}


@lru_cache(maxsize=2)
def model_of(instrument: str) -> InteractionModel:
    """Return the model of all modes."""
    found = load_instrument(instrument)
    return InteractionModel(found, karhunen_loeve_basis(found))


@lru_cache(maxsize=4)
def matrix_of(instrument: str, alpha: str) -> NDArray[np.float32]:
    """Return D of the controlled modes."""
    matrix = model_of(instrument).interaction_matrix(parse_alpha(alpha))
    return np.asarray(matrix[:, : TELESCOPES[instrument]])


@lru_cache(maxsize=4)
def reconstructor_of(instrument: str, alpha: str) -> NDArray[np.float32]:
    """Return the inverse of D."""
    return invert(matrix_of(instrument, alpha), TELESCOPES[instrument]).matrix


def shape_of(plan: Plan) -> Array:
    """Return the shape ``(n_controlled,)`` with signs drawn by the seed, of 1 m RMS."""
    n_controlled = TELESCOPES[plan.instrument]
    orders = compute_radial_orders(n_controlled)[SHAPED]
    drawn = np.random.default_rng(plan.drawn or plan.seed).normal(size=len(SHAPED))
    if not plan.jumps:  # amplitudes as they are defined, signs at random
        drawn = np.sign(drawn)
    given = np.zeros(n_controlled)
    given[SHAPED] = orders ** EXPONENTS[plan.shape] * drawn
    alpha = parse_alpha(plan.alpha)
    found = shape_in_modes(
        model_of(plan.instrument), alpha, given, Frame.MIRROR, n_modes=n_controlled
    ).coefficients_m[:n_controlled]
    return found / np.linalg.norm(found)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Held:
    """What a loop left."""

    modes_m: Array
    """``(n_batches, n_controlled)`` wavefront in the first frame of each batch."""

    mean_m: Array
    """``(n_controlled,)`` its mean once the loop has settled."""

    gain: Array
    """``(n_controlled,)`` true optical gains of the modes that were poked, 1 of others."""

    lost_s: float | None
    """When it ran away; None if it did not."""


def run(plan: Plan, references: Array | None, *, poked: bool = False) -> Held:
    """Run a loop with a leak of 0.999; with ``poked`` in the seeing before any jump."""
    n_frames, seeing = SETTLING_FRAMES + HELD_FRAMES, f"{plan.seeing_arcsec}"
    if plan.jumps:
        settled_s, seeing = SETTLING_FRAMES / 1000.0, f"{CALM_ARCSEC}"
        if not poked:
            n_frames += round(1000.0 * (RISE_S + AFTERWARDS_S))
            seeing += f" --seeing-at {settled_s}:{CALM_ARCSEC}"
            seeing += f" --seeing-at {settled_s + RISE_S}:{plan.seeing_arcsec}"
    options = parse_options(
        f"--plant diffractive --alpha {plan.alpha} --seed {plan.seed} --seeing {seeing} "
        f"--mag {plan.magnitude} "
        f"--n-controlled {TELESCOPES[plan.instrument]}".split()
    )
    telescope = build_telescope(options, model_of(plan.instrument).instrument)
    matrix = reconstructor_of(plan.instrument, plan.alpha)
    loop = ModalLoop(n_modes=len(telescope.settings.gains), delay_frames=2, stroke_m=1e-5)
    gains = np.full(len(matrix), plan.loop_gain, np.float32)
    offset = None if references is None else references.astype(np.float32)
    optics = telescope.optics.start()
    if not isinstance(optics, DiffractiveOptics):
        raise TypeError(f"study: found {type(optics).__name__}; expected --plant diffractive")
    terms = LoopTerms.of(optics, matrix, gains, 0.999, offset)
    lefts: list[Array] = []
    n_lost = 0
    for block in telescope.feed.blocks():
        for row in range(0, block.n_frames, BATCH_FRAMES):
            commands_m = block.run(row, loop, terms, None).commands_m
            left = block.phase_at(row) + optics.mirror_opd_m(commands_m[0])
            lefts.append(np.asarray(left - telescope.weights @ left))
            n_lost = n_lost + 1 if np.sqrt(telescope.weights @ lefts[-1] ** 2) > LOST_M else 0
        if len(lefts) * BATCH_FRAMES >= n_frames or n_lost >= LOST_BATCHES:
            break
    modes = optics.opd_per_command[:, : len(matrix)].astype(np.float64)
    weighted = (modes - telescope.weights @ modes).T * telescope.weights
    modes_m = np.asarray(np.linalg.solve(weighted @ modes, weighted @ np.array(lefts).T).T)
    gain = np.ones(len(matrix))
    if poked:
        residuals = np.array(lefts[SETTLED_BATCHES :: POKE_FRAMES // BATCH_FRAMES])
        gain[_poked(len(matrix))] = poke(optics, residuals, matrix)
    return Held(
        modes_m=modes_m,
        mean_m=modes_m[SETTLED_BATCHES:].mean(axis=0),
        gain=gain,
        lost_s=len(lefts) * BATCH_FRAMES / 1000.0 if n_lost >= LOST_BATCHES else None,
    )


def _poked(n_controlled: int) -> NDArray[np.intp]:
    return np.array([*SHAPED, *(mode for mode in DITHERED if SHAPED[-1] < mode < n_controlled)])


def poke(optics: DiffractiveOptics, lefts: Array, matrix: NDArray[np.float32]) -> Array:
    """Return the mean gains of the poked modes on these residual wavefronts, along R."""
    modes, rng = _poked(len(matrix)), np.random.default_rng(0)
    found = np.zeros((len(lefts), len(modes)))
    for k, left in enumerate(lefts.astype(np.float32)):
        for column, mode in enumerate(modes):
            step = np.float32(POKE_M) * optics.opd_per_command[:, mode]
            up, down = (optics.slopes(left + side * step, None, rng) for side in (1, -1))
            found[k, column] = matrix[mode] @ (up - down) / (2.0 * POKE_M)
    return np.asarray(found.mean(axis=0))


@lru_cache(maxsize=64)
def without_shape(plan: Plan) -> Held:
    """Return the same loop without a shape, and its true gains."""
    return run(plan, None, poked=True)


def gains_of(plan: Plan, base: Held) -> Array:
    """Return the gains with which the references of a plan are computed, ``(n_controlled,)``."""
    n_controlled = len(base.gain)
    if plan.references == "static":
        return np.ones(n_controlled)
    if plan.references == "table":
        rng = np.random.default_rng(plan.seed)
        measured = [
            ModeGain(
                mode=mode,
                gain=float(base.gain[mode] * (1.0 + GAIN_SIGMA * rng.normal())),
                sigma=GAIN_SIGMA * float(base.gain[mode]),
                scatter=GAIN_SIGMA,
                t_ns_utc=0,
            )
            for mode in DITHERED
        ]
        return gain_table(measured, n_controlled).optical_gain
    return base.gain


def largest_of(plan: Plan, shape: Array, gain: Array) -> float:
    """Return the RMS of the largest multiple of a shape that is accepted, metres."""
    if not plan.jumps and plan.shape == "steep":
        return np.inf  # not of interest, and seconds of work
    model = model_of(plan.instrument)
    beyond = np.zeros(model.basis.n_modes - len(shape))
    return limit_shape(
        model.instrument,
        model.basis,
        np.concatenate([1e-8 * shape, beyond]),
        optical_gain=np.concatenate([gain, beyond + 1.0]),
        n_controlled=len(shape),
        worst_seeing_arcsec=plan.seeing_arcsec,
    ).largest_m


def play(plan: Plan) -> Row | list[Row]:
    """Return the row of a plan; of a sweep those of its sizes, until the loop is lost."""
    usual = replace(plan, references="", shape="steep", rms_nm=0.0, drawn=0, limits=1.0)
    # The gains in calm seeing are the same to 1 % on every turbulence.
    base = without_shape(replace(usual, seed=1) if plan.jumps else usual)
    shape, gain = shape_of(plan), gains_of(plan, base)
    largest_m = largest_of(plan, shape, gain)
    if plan.case != "sweep":
        size_m = 1e-9 * plan.rms_nm or plan.limits * largest_m
        return _play_shape(plan, base, gain, size_m * shape, largest_m)
    rows: list[Row] = []
    for times in GROWING:
        rows.append(_play_shape(plan, base, gain, times * largest_m * shape, largest_m))
        if rows[-1]["lost_s"] is not None:
            break
    return rows


def _play_shape(plan: Plan, base: Held, gain: Array, shape: Array, largest_m: float) -> Row:
    at = "0,0,0,1" if plan.references == "nominal" else plan.alpha
    references = compute_references(matrix_of(plan.instrument, at), gain, shape)
    if plan.references == "pokes":
        references = matrix_of(plan.instrument, at) @ (gain * shape)
    if plan.references == "strong":
        references = 1.3 * references
    found = run(plan, references)
    left = (found.mean_m - base.mean_m)[SHAPED]
    return asdict(plan) | {
        "gain": float(base.gain[SHAPED].mean()),
        "largest_nm": largest_m * 1e9,
        "shape_nm": float(np.linalg.norm(shape) * 1e9),
        "peak": float(np.abs(references).max()),
        "held": float(left @ shape[SHAPED] / (shape @ shape)),
        "error_nm": float(np.linalg.norm(left - shape[SHAPED]) * 1e9),
        "peak_nm": float(1e9 * np.linalg.norm(found.modes_m, axis=1)[SETTLED_BATCHES:].max()),
        "with_turbulence_nm": float(np.linalg.norm(found.mean_m[SHAPED] - shape[SHAPED]) * 1e9),
        "without_shape_nm": float(np.linalg.norm(base.mean_m[SHAPED]) * 1e9),
        "lost_s": found.lost_s,
    }


def plans(n_jumps: int = 20) -> Iterable[Plan]:
    """Yield all loops of the page."""
    for seed, seeing in product((1, 2, 3), (0.6, 0.9, 1.2)):
        one = Plan(case="held", seeing_arcsec=seeing, seed=seed, references="holding")
        for references in ("holding", "pokes", "static", "table"):
            yield replace(one, references=references)
        yield replace(one, shape="flat")
        if seed == 1:
            yield replace(one, references="strong")
        small = replace(one, instrument="tests/system/small.toml")
        for references, shape in product(("holding", "pokes", "static"), ("steep", "flat")):
            yield replace(small, references=references, shape=shape, rms_nm=60.0)
    moved = product((0.6, 0.9), ("1,0,0,1", "0,0,2,1"), ("holding", "nominal"))
    for seeing, alpha, references in moved:
        one = Plan(case="moved", seeing_arcsec=seeing, seed=1, references=references)
        yield replace(one, alpha=alpha)
    for instrument, seed in product(TELESCOPES, range(1, n_jumps + 1)):
        one = Plan(case="jump", seeing_arcsec=1.2, seed=seed, references="holding", rms_nm=0.0)
        shape = tuple(EXPONENTS)[seed % len(EXPONENTS)]
        yield replace(one, shape=shape, instrument=instrument)
    yield from sweep_plans()


def sweep_plans() -> Iterable[Plan]:
    """Yield the sweeps: each shape in each turbulence, on the telescope of 3 m."""
    for seeing, (shapes, turbulences) in SWEPT.items():
        for drawn, seed in product(shapes, turbulences):
            yield Plan(
                case="sweep",
                seeing_arcsec=seeing,
                seed=seed,
                references="holding",
                shape=tuple(EXPONENTS)[drawn % len(EXPONENTS)],
                rms_nm=0.0,
                drawn=drawn,
                instrument="tests/system/small.toml",
            )


def tell_sweeps(rows: list[Row]) -> str:
    """Return the table of the sizes with which loops were lost."""
    text = heading(
        "worst seeing, arcsec", "loops", "slope at the limit", "none lost to", "lost from"
    )
    for seeing in sorted({row["seeing_arcsec"] for row in rows}):
        swept = [row for row in rows if row["seeing_arcsec"] == seeing]
        ends = [group[-1] for group in grouped(swept, Plan)]
        lost = sorted(one["peak"] for one in ends if one["lost_s"] is not None)
        kept = [row["peak"] for row in swept if row["lost_s"] is None]
        safe = max((slope for slope in kept if not lost or slope < 0.99 * lost[0]), default=0.0)
        found = f"{lost[0]:.2f} to {lost[-1]:.2f}" if lost else "-"
        n_lost, limit = f"{len(lost)} of {len(ends)} lost", min(row["peak"] for row in swept)
        text += line(f"{seeing:.1f}", n_lost, f"{limit:.2f}", f"{safe:.2f}", found)
    return text


def main() -> None:
    """Complete the rows and print their table."""
    parser = campaign_parser("", __doc__)
    parser.prog = "python -m pyrcal_studies.references_held"
    parser.add_argument("--only", type=words, default=("held", "moved", "jump", "sweep"))
    parser.add_argument("--instrument", type=words, default=tuple(TELESCOPES))
    parser.add_argument("--jump-nm", type=float, default=0.0, help="size instead of the limit's")
    parser.add_argument("--limits", type=float, default=1.0, help="size of jumps over the limit's")
    parser.add_argument("--jumps", type=int, default=20, help="jumps of each telescope")
    parser.add_argument("--loop-gain", type=float, default=0.4)
    parser.add_argument("--magnitude", type=float, default=8.0)
    given = parser.parse_args()
    with threadpool_limits(1):
        changed = {"loop_gain": given.loop_gain, "magnitude": given.magnitude}
        size = {"rms_nm": given.jump_nm, "limits": given.limits}
        chosen = [
            replace(plan, **changed, **(size if plan.case == "jump" else {}))
            for plan in plans(given.jumps)
            if plan.case in given.only and plan.instrument in given.instrument
        ]
        rows = complete(play, chosen, given)
    sweeps = [row for row in rows if row["case"] == "sweep"]
    rows = [row for row in rows if row["case"] != "sweep"]
    if not rows:
        tell(tell_sweeps(sweeps), given.table, parser.prog)
        return
    text = heading(
        "loop", "seeing, arcsec", "gain", "shape, nm", "held", "error, nm", "limit, nm", "lost"
    )
    for group in grouped(rows, Plan, "seed", *(("shape",) if rows[0]["case"] == "jump" else ())):
        first, kept = group[0], [row for row in group if row["lost_s"] is None]
        mean = {
            name: np.mean([row[name] for row in kept or group])
            for name in ("gain", "shape_nm", "held", "error_nm", "largest_nm")
        }
        text += line(
            f"{first['case']} {first['shape']} {first['references']} {first['alpha']} "
            f"{first['instrument']}",
            first["seeing_arcsec"],
            f"{mean['gain']:.2f}",
            f"{mean['shape_nm']:.0f}",
            f"{mean['held']:.3f}",
            f"{mean['error_nm']:.1f}",
            f"{mean['largest_nm']:.0f}",
            f"{len(group) - len(kept)} of {len(group)}",
        )
    tell(text + (f"\n{tell_sweeps(sweeps)}" if sweeps else ""), given.table, parser.prog)


if __name__ == "__main__":
    main()
