"""Fit matrices of three other codes with one wrong value in each instrument file.

OOPAO, HCIPy and SPECULA push every actuator of a bench of twenty subapertures with a square grid of
Gaussian influence functions, as simulators ship it, at known registrations; modes are combinations
of these columns. What is accepted must lie within 3 of its own σ.
Run: ``python -m pyrcal_studies.mistold_fits``, or with ``--peers hcipy`` for some; answers are
kept.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.fitting.matrix import fit_matrix
from pyrcal_studies.campaign.rows import RowFile
from pyrcal_studies.peers import (
    FITTED,
    KEPT,
    LISTINGS,
    REQUIREMENTS,
    ROOT,
    environment,
    in_degrees,
    mirror_points,
)
from pyrcal_studies.peers_pushpull import Bench, Measured, read_product, write_job
from service.errors import PyrcalError
from service.estimation.reference import Reference
from service.instrument.mirrors import grid
from service.model.instrument import Instrument, Mirror
from service.model.kinds import (
    BasisKind,
    Influence,
    InfluenceShape,
    KarhunenLoeve,
    Normalisation,
    SlopeOrder,
    Stop,
)
from service.model.misregistration import BOUNDARY_SCALE, Misregistration, rotation
from service.model.modes import karhunen_loeve_basis
from service.model.sensors.pyramid.description import Pyramid
from service.model.slopes import SlopeRecipe

Array = NDArray[Any]

COUPLING = 0.35
"""Height of the true influence functions at a distance of one pitch."""

N_ACROSS, PITCH_M, CIRCLE_M = 21, 0.4, 8.6

NEAR = Misregistration(
    shift_x_subap=0.12, shift_y_subap=-0.08, rotation_rad=np.deg2rad(0.5), magnification=1.004
)
FAR = Misregistration(
    shift_x_subap=0.45, shift_y_subap=0.3, rotation_rad=np.deg2rad(-1.2), magnification=0.99
)
WITH_PUPIL = Misregistration(
    shift_x_subap=0.25, shift_y_subap=-0.25, rotation_rad=np.deg2rad(0.8), magnification=1.006
)
"""In quarters of a subaperture: SPECULA's pupil images move by whole samples."""

FRESH = Misregistration(
    shift_x_subap=-0.33, shift_y_subap=0.21, rotation_rad=np.deg2rad(1.4), magnification=1.011
)
FRESH_FAR = Misregistration(
    shift_x_subap=0.07, shift_y_subap=0.62, rotation_rad=np.deg2rad(-0.7), magnification=0.994
)
FRESH_WITH_PUPIL = Misregistration(
    shift_x_subap=-0.5, shift_y_subap=-0.25, rotation_rad=np.deg2rad(-1.7), magnification=1.013
)
"""Measured after every constant of the fit was set."""

_NAMES = {
    NEAR: "near",
    FAR: "far",
    WITH_PUPIL: "with-pupil",
    FRESH: "fresh",
    FRESH_FAR: "fresh-far",
    FRESH_WITH_PUPIL: "fresh-with-pupil",
}

OBSCURATION, OBSCURED = 0.14, 0.25
"""Linear central obscuration of the bench, and of another whose user believes it to be the same."""

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True, slots=True, kw_only=True)
class ZonalCase:
    """One zonal matrix of one peer."""

    peer: str
    """Name of its package."""

    stop: Stop
    """What moves: the mirror alone, or the pupil images with it."""

    alpha: Misregistration
    """The truth."""

    own_mirror: bool = False
    """Whether the peer's own mirror is moved by its own tools."""

    obscuration_ratio: float = OBSCURATION
    """Of the peer's telescope."""

    @property
    def name(self) -> str:
        """Of its files."""
        kind = "-own-mirror" if self.own_mirror else ""
        kind += "-obscured" if self.obscuration_ratio > OBSCURATION else ""
        return f"{self.peer}-{_NAMES[self.alpha]}{kind}"

    @property
    def bench(self) -> Bench:
        """What the peer is told of the optics."""
        alpha = self.alpha
        moved = self.stop is Stop.MIRROR
        return Bench(
            diameter_m=8.0,
            obscuration_ratio=self.obscuration_ratio,
            n_subapertures=20,
            pupil_separation_subap=26,
            wavelength_m=790e-9,
            modulation_lambda_over_d=3.0,
            n_modulation=20,
            sampling=4,
            image_shift_subap=(alpha.shift_x_subap, alpha.shift_y_subap) if moved else (0.0, 0.0),
            misregistration=in_degrees(alpha) if self.own_mirror else None,
        )


def zonal_cases(peer: str) -> tuple[ZonalCase, ...]:
    """Return the matrices a peer is asked for."""
    asked = [
        ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=NEAR),
        ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=FAR),
        ZonalCase(peer=peer, stop=Stop.MIRROR, alpha=WITH_PUPIL),
    ]
    if peer == "oopao":
        asked.append(ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=NEAR, own_mirror=True))
    return tuple(asked)


def fresh_cases(peer: str) -> tuple[ZonalCase, ...]:
    """Return matrices at registrations that no constant of the fit was chosen on."""
    return (
        ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=FRESH),
        ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=FRESH_FAR),
        ZonalCase(peer=peer, stop=Stop.MIRROR, alpha=FRESH_WITH_PUPIL),
    )


def obscured_case(peer: str) -> ZonalCase:
    """Return the matrix of a telescope that is obscured more than its user says."""
    return ZonalCase(peer=peer, stop=Stop.TELESCOPE, alpha=FRESH, obscuration_ratio=OBSCURED)


def actuators_m() -> NDArray[np.float64]:
    """Return where the actuators are, ``(n_actuators, 2)``, metres in the pupil plane."""
    return grid(N_ACROSS, PITCH_M, CIRCLE_M)


def measured_zonal(case: ZonalCase) -> Measured:
    """Return the peer's matrix, measured now unless it is kept."""
    told = json.dumps([REQUIREMENTS[case.peer], asdict(case.bench), in_degrees(case.alpha)])
    digest = hashlib.sha256(told.encode()).hexdigest()[:10]
    folder = KEPT / case.peer
    kept = folder / f"zonal-{case.name}-{digest}.npz"
    if not kept.exists():
        print(f"{case.name}: measuring", file=sys.stderr, flush=True)
        interpreter = environment(case.peer)
        job = folder / f"zonal-{case.name}-job.npz"
        write_job(job, case.bench, **_pushed(case))
        subprocess.run(
            [str(interpreter), "-m", f"pyrcal_studies.peers_{case.peer}", str(job), str(kept)],
            cwd=ROOT,
            env={**os.environ, **_ONE_THREAD, "MPLBACKEND": "Agg"},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        job.unlink()
    return read_product(kept)[0]


def _pushed(case: ZonalCase) -> dict[str, Array]:
    """Return the actuators' shapes where they lie, or what the peer's own mirror is made of."""
    positions_m = actuators_m()
    if case.own_mirror:
        return {
            "positions_m": positions_m,
            "pitch_m": np.array(PITCH_M),
            "mode_to_actuator": np.eye(len(positions_m)),
        }
    bench = case.bench
    points = mirror_points(bench, case.alpha, case.stop)
    metres = points * bench.diameter_m / bench.n_subapertures
    apart = np.linalg.norm(metres - positions_m[:, None], axis=2)
    shapes = COUPLING ** ((apart / PITCH_M) ** 2)
    return {"shapes_m": shapes.reshape(-1, bench.n_pupil, bench.n_pupil)}


PAGE = ROOT / "var" / "mistold" / "mistold_fits.md"
N_MODES = 250
MOST_SIGMA = 3.0
_POINTS = 80
"""Across a peer's pupil: OOPAO's metre is longer by one in so many."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mistelling:
    """One thing that a user says and that is not so."""

    words: str
    tell: Callable[[Instrument], Instrument]
    """From the instrument as it is to the one that is told."""

    image: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))
    """What the told coordinates of actuators are of the true ones, but for their size."""

    size: float = 1.0
    """How much larger the mirror is told to be."""


def _coupling(value: float) -> Callable[[Instrument], Instrument]:
    return lambda about: replace(
        about,
        mirror=replace(
            about.analytic_mirror,
            shape=InfluenceShape(influence=Influence.GAUSSIAN, coupling=value),
        ),
    )


def _modulation(radius: float) -> Callable[[Instrument], Instrument]:
    return lambda about: replace(about, wfs=replace(about.wfs, modulation_lambda_over_d=radius))


def _other_wavelength(about: Instrument) -> Instrument:
    return replace(about, wfs=replace(about.wfs, wavelength_m=900e-9))


def _sized(factor: float) -> Callable[[Instrument], Instrument]:
    def tell(about: Instrument) -> Instrument:
        mirror = about.analytic_mirror
        return replace(
            about,
            mirror=replace(
                mirror, positions_m=mirror.positions_m * factor, pitch_m=mirror.pitch_m * factor
            ),
        )

    return tell


def _other_stop(about: Instrument) -> Instrument:
    return replace(about, stop=Stop.MIRROR if about.stop is Stop.TELESCOPE else Stop.TELESCOPE)


def _other_order(about: Instrument) -> Instrument:
    order = SlopeOrder.YX if about.slopes.order is SlopeOrder.XY else SlopeOrder.XY
    return replace(about, slopes=replace(about.slopes, order=order))


def _mirrored(about: Instrument) -> Instrument:
    mirror = about.analytic_mirror
    return replace(about, mirror=replace(mirror, positions_m=mirror.positions_m * [-1.0, 1.0]))


MISTELLINGS = (
    Mistelling(words="coupling 0.20", tell=_coupling(0.2)),
    Mistelling(words="coupling 0.50", tell=_coupling(0.5)),
    Mistelling(words="modulation 2", tell=_modulation(2.0)),
    Mistelling(words="modulation 6", tell=_modulation(6.0)),
    Mistelling(words="the other stop", tell=_other_stop),
    Mistelling(words="pitch 5 % large", tell=_sized(1.05), size=1.05),
    Mistelling(words="wavelength 900 nm", tell=_other_wavelength),
    Mistelling(
        words="OOPAO's metre", tell=_sized(_POINTS / (_POINTS - 1)), size=_POINTS / (_POINTS - 1)
    ),
    Mistelling(words="order of slopes", tell=_other_order),
    Mistelling(words="mirror image", tell=_mirrored, image=((-1.0, 0.0), (0.0, 1.0))),
)
AS_IT_IS = Mistelling(words="nothing", tell=lambda about: about)


def _diameter(factor: float) -> Callable[[Instrument], Instrument]:
    return lambda about: replace(about, diameter_m=about.diameter_m * factor)


def _pupil(factor: float) -> Callable[[Instrument], Instrument]:
    return lambda about: replace(
        about,
        wfs=replace(about.wfs, pupil_diameter_subap=about.wfs.pupil_diameter * factor),
    )


LESS_OBSCURED = Mistelling(
    words=f"obscuration {OBSCURATION} for {OBSCURED}",
    tell=lambda about: replace(about, obscuration_ratio=OBSCURATION),
)
PUPILS = (
    Mistelling(words="diameter 2 % large", tell=_diameter(1.02), size=1.0 / 1.02),
    Mistelling(words="pupil image 2 % small", tell=_pupil(0.98), size=0.98),
    LESS_OBSCURED,
)
"""Told of the fresh matrices alone."""


def bench(case: ZonalCase, measured: Measured, strokes: Array | None) -> Instrument:
    """Return the instrument as it is; ``strokes`` ``(n_actuators, n_modes)``, None: zonal."""
    told, listing = case.bench, LISTINGS[case.peer]
    return Instrument(
        name=case.name,
        diameter_m=told.diameter_m,
        obscuration_ratio=told.obscuration_ratio,
        stop=case.stop,
        wfs=Pyramid(
            n_subapertures=told.n_subapertures,
            wavelength_m=measured.wavelength_m,
            modulation_lambda_over_d=told.modulation_lambda_over_d,
            pupil_separation_subap=float(told.pupil_separation_subap),
            valid_subapertures=measured.valid,
        ),
        mirror=Mirror(
            positions_m=actuators_m(),
            pitch_m=PITCH_M,
            shape=InfluenceShape(influence=Influence.GAUSSIAN, coupling=COUPLING),
            basis=BasisKind.ZONAL,
            mode_to_actuator=strokes,
        ),
        modes=KarhunenLoeve(n_modes=N_MODES),
        slopes=SlopeRecipe(
            order=SlopeOrder(listing.order), normalisation=Normalisation(listing.normalisation)
        ),
    )


@cache
def strokes_of_modes() -> Array:
    """Return the bench's KL modes as strokes ``(n_actuators, N_MODES)``."""
    case = fresh_cases("hcipy")[0]
    plain = bench(case, measured_zonal(case), None)
    plain = replace(plain, wfs=replace(plain.wfs, valid_subapertures=None))
    return karhunen_loeve_basis(plain).mode_to_actuator


def error(alpha: Misregistration, truth: Misregistration, told: Mistelling) -> Array:
    """Return found less true ``(4,)``, numeric units, in the axes found and the metre told.

    No matrix tells which way round sensor and drawing are together: of the eight ways the nearest
    counts, as long as sensor and drawing are mirrored together.
    """
    turn = rotation(truth.rotation_rad)
    errors = []
    for flip, quarters in product((1.0, -1.0), range(4)):
        axes = np.diag([flip, 1.0]) @ np.linalg.matrix_power([[0.0, -1.0], [1.0, 0.0]], quarters)
        seen = axes @ turn @ np.array(told.image)
        if np.linalg.det(seen) < 0.0:
            continue
        expected = np.array(
            [
                *(axes @ truth.vector[:2]),
                np.arctan2(seen[1, 0], seen[0, 0]),
                truth.magnification / told.size,
            ]
        )
        off = alpha.vector - expected
        off[2] = (off[2] + np.pi) % (2.0 * np.pi) - np.pi
        errors.append(off)
    return np.asarray(min(errors, key=lambda off: float(np.abs(off[:3]).sum())))


def asked(case: ZonalCase, *, modal: bool, told: Mistelling) -> dict[str, Any]:
    """Return what the fit answers."""
    measured = measured_zonal(case)
    strokes = strokes_of_modes() if modal else None
    matrix = np.asarray(measured.matrix, dtype=np.float64)
    begun = time.process_time()
    answer: dict[str, Any] = {"case": case.name, "modal": modal, "told": told.words}
    try:
        with threadpool_limits(1):
            fit = fit_matrix(
                told.tell(bench(case, measured, strokes)),
                Reference(matrix=matrix if strokes is None else matrix @ strokes),
            )
    except PyrcalError as refusal:
        return answer | {"accepted": False, "said": str(refusal)}
    off = error(fit.alpha, case.alpha, told)
    return answer | {
        "accepted": fit.accepted,
        "error": list(off * BOUNDARY_SCALE),
        "sigma": list(fit.sigma * BOUNDARY_SCALE),
        "residual": fit.residual_fraction,
        "said": fit.verdict.removeprefix("refused: ") if not fit.accepted else _named(fit.remarks),
        "seconds": time.process_time() - begun,
    }


def _named(remarks: Iterable[str]) -> str:
    return "; ".join(remark.split(":", maxsplit=1)[0] for remark in remarks)


def answers(peer: str, *, ask: bool = True) -> list[dict[str, Any]]:
    """Return what is answered to everything told of one peer, asked now unless it is kept."""
    cases = zonal_cases(peer)[:3]
    told = enumerate((AS_IT_IS, *MISTELLINGS))
    questions = [(cases[k % 3], one) for k, one in told]
    return _answers(f"mistold-{peer}", questions if ask else [])


def fresh_answers(peer: str, *, ask: bool = True) -> list[dict[str, Any]]:
    """Return the same of registrations that no constant was chosen on."""
    cases = fresh_cases(peer)
    told = [(case, AS_IT_IS) for case in cases]
    told += [(cases[k % 3], one) for k, one in enumerate((*MISTELLINGS, *PUPILS[:2]))]
    told.append((obscured_case(peer), LESS_OBSCURED))
    return _answers(f"mistold-fresh-{peer}", told if ask else [])


def _answers(name: str, questions: list[tuple[ZonalCase, Mistelling]]) -> list[dict[str, Any]]:
    file = RowFile(KEPT / f"{name}.jsonl")
    known = {(one["case"], one["modal"], one["told"]) for one in file.rows}
    for (case, told), modal in product(questions, (False, True)):
        if (case.name, modal, told.words) in known:
            continue
        one = asked(case, modal=modal, told=told)
        print(json.dumps(one), file=sys.stderr, flush=True)
        file.add(one)
    return file.rows


def page(found: list[dict[str, Any]]) -> str:
    """Return the page in Markdown; docs/results/accuracy.md says what was done."""
    return "\n".join(["# Matrices of other codes with one thing told wrong", "", *_shown(found)])


def fresh_page(found: list[dict[str, Any]]) -> str:
    """Return the page of the matrices that no constant was chosen on."""
    return "\n".join(["# Fresh matrices, one thing told wrong", "", *_shown(found)])


def _shown(found: list[dict[str, Any]]) -> list[str]:
    wrong = [one for one in found if one["told"] != AS_IT_IS.words]
    accepted = [one for one in found if one["accepted"]]
    mistold = [one for one in accepted if one["told"] != AS_IT_IS.words]
    beyond = [one for one in accepted if _worst(one) > MOST_SIGMA]
    return [
        f"**{len(found) - len(wrong)} told right: {len(accepted) - len(mistold)} accepted. "
        f"{len(wrong)} mistold: {len(mistold)} accepted, {len(wrong) - len(mistold)} refused. Of "
        f"all accepted {len(beyond)} lie beyond {MOST_SIGMA:g} σ.**",
        "",
        "| told wrong | fits | accepted | largest error x, y (subap) | rotation (deg) | "
        "magnification | over σ | the first says |",
        "|" + " --- |" * 8,
        *(_row(told, found) for told in dict.fromkeys(one["told"] for one in found)),
        "",
        "## Errors over σ",
        "",
        "RMS of all that was accepted; 1 is honest, 0.3 to 2 was asked.",
        "",
        "| modes | fits | x | y | rotation | magnification |",
        "|" + " --- |" * 6,
        *(_honesty(found, modal=modal) for modal in (False, True)),
        "",
    ]


def _worst(one: Mapping[str, Any]) -> float:
    return float(np.max(np.abs(one["error"]) / np.array(one["sigma"])))


def _row(told: str, found: list[dict[str, Any]]) -> str:
    these = [one for one in found if one["told"] == told]
    cells = [told, str(len(these)), str(sum(one["accepted"] for one in these))]
    fitted = [one for one in these if "error" in one]
    x, y, turned, size = np.max(np.abs([one["error"] for one in fitted]), axis=0)
    cells += [f"{x:.4f}, {y:.4f}", f"{turned:.4f}", f"{size:.5f}"]
    cells.append(f"{max(map(_worst, fitted)):.1f}")
    said = these[0]["said"].replace("|", "/")
    cells.append(said if len(said) < _LONGEST else f"{said[:_LONGEST]}...")
    return "| " + " | ".join(cells) + " |"


_LONGEST = 150


def _honesty(found: list[dict[str, Any]], *, modal: bool) -> str:
    right = [one for one in found if one["accepted"] and one["modal"] is modal]
    ratios = np.array([np.array(one["error"]) / one["sigma"] for one in right])
    rms = np.sqrt(np.mean(ratios**2, axis=0))
    numbers = " | ".join(f"{value:.2f}" for value in rms)
    return f"| {'KL' if modal else 'zonal'} | {len(right)} | {numbers} |"


def main() -> int:
    """Ask, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--peers", nargs="+", choices=FITTED, default=None)
    parser.add_argument(
        "--fresh", action="store_true", help="matrices that no constant was chosen on"
    )
    parser.add_argument("--kept", action="store_true", help="ask nothing: what is kept")
    given = parser.parse_args()
    answered, written, path = answers, page, PAGE
    if given.fresh:
        answered, written, path = fresh_answers, fresh_page, PAGE.with_name("mistold_fresh.md")
    ask = not given.kept
    found = [one for peer in given.peers or FITTED for one in answered(peer, ask=ask)]
    if given.peers is None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(written(found))
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
