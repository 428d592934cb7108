"""Fit interaction matrices of OOPAO, HCIPy and SPECULA, with what a user of each would know.

Each peer, in an environment of its own under ``var/peers``, measures modes of the FLAO mirror by
push-pull at a known registration, with its own pyramid, detector, valid pixels, slopes and signs.
``pyrcal fit`` gets the matrix, and an instrument file that says what a user of that peer knows.
Matrices and environments are kept; the first run takes an hour, later ones minutes.
Run: ``python -m pyrcal_studies.peers``, or with ``--peers hcipy`` for some of them.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
import venv
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.campaign.rows import RowFile
from pyrcal_studies.peers_pushpull import Bench, Measured, read_product, write_job
from service.instrument import load_instrument
from service.model.instrument import Instrument, Mirror
from service.model.kinds import Influence, InfluenceShape, Stop
from service.model.misregistration import PARAMETERS, Misregistration, rotation
from service.model.modes import ModalBasis, karhunen_loeve_basis
from service.model.sensors.pyramid.description import pyramid_in

Array = NDArray[Any]

INSTRUMENT = "flao-lbt"
"""The packaged instrument whose telescope and mirror the peers imitate."""

N_MODES = 400
"""Columns of every matrix."""

SAMPLING = 4
"""Of the peers' pupils, points per subaperture."""

N_MODULATION = 28
"""Points of the peers' modulation."""

SMALL = Misregistration(
    shift_x_subap=0.31, shift_y_subap=-0.17, rotation_rad=np.deg2rad(0.6), magnification=1.004
)
LARGE = Misregistration(
    shift_x_subap=0.9, shift_y_subap=-0.7, rotation_rad=np.deg2rad(2.0), magnification=1.02
)
OTHER = Misregistration(
    shift_x_subap=-0.9, shift_y_subap=0.5, rotation_rad=np.deg2rad(-2.0), magnification=0.98
)
OTHER_SAMPLES = replace(OTHER, shift_x_subap=-0.75)
SMALL_SAMPLES = replace(SMALL, shift_x_subap=0.25, shift_y_subap=-0.25)
"""Whole samples, for a peer that cannot move its images by less."""

SMALLEST = (SMALL, SMALL_SAMPLES)
"""The registrations nearest to perfect."""

_SIZES = {SMALL: "small", LARGE: "large", OTHER: "other"}
_SIZES |= {SMALL_SAMPLES: "small", OTHER_SAMPLES: "other"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One matrix of one peer."""

    peer: str
    """Name of its package."""

    stop: Stop
    """What moves: the mirror alone, or the pupil images with it."""

    alpha: Misregistration
    """The truth."""

    own_mirror: bool = False
    """Whether the peer's own mirror is moved by its own tools, and told to pyrcal as a cube."""

    as_shipped: bool = False
    """Whether the peer keeps its own pupil and its own reading of the modulation radius."""

    @property
    def name(self) -> str:
        """Of its files."""
        kind = "own-mirror" if self.own_mirror else str(self.stop)
        shipped = "-as-shipped" if self.as_shipped else ""
        return f"{self.peer}-{kind}-{_SIZES[self.alpha]}{shipped}"


def cases(peer: str) -> tuple[Case, ...]:
    """Return what a peer is asked for."""
    other, small = (OTHER_SAMPLES, SMALL_SAMPLES) if peer == "specula" else (OTHER, SMALL)
    asked = [
        Case(peer=peer, stop=Stop.TELESCOPE, alpha=LARGE),
        Case(peer=peer, stop=Stop.MIRROR, alpha=other),
        Case(peer=peer, stop=Stop.TELESCOPE, alpha=SMALL),
        Case(peer=peer, stop=Stop.MIRROR, alpha=small),
    ]
    if peer == "oopao":
        asked += [
            Case(peer=peer, stop=Stop.TELESCOPE, alpha=LARGE, own_mirror=True),
            Case(peer=peer, stop=Stop.TELESCOPE, alpha=SMALL, own_mirror=True),
            Case(peer=peer, stop=Stop.TELESCOPE, alpha=SMALL, as_shipped=True),
        ]
    return tuple(asked)


@cache
def instrument() -> Instrument:
    """Return the telescope that all of them imitate."""
    return load_instrument(INSTRUMENT)


@cache
def basis(influence: Influence) -> ModalBasis:
    """Return its modes, with the influence functions given."""
    shared = instrument()
    drawn = shared.analytic_mirror
    mirror = Mirror(
        positions_m=drawn.positions_m,
        pitch_m=drawn.pitch_m,
        shape=InfluenceShape(influence=influence),
    )
    return karhunen_loeve_basis(
        replace(shared, mirror=mirror, modes=replace(shared.modes, n_modes=N_MODES))
    )


def bench(case: Case) -> Bench:
    """Return what the peer is told of the optics."""
    shared, alpha = instrument(), case.alpha
    wfs = pyramid_in(shared)
    moved = case.stop is Stop.MIRROR
    return Bench(
        diameter_m=shared.diameter_m,
        obscuration_ratio=shared.obscuration_ratio,
        n_subapertures=wfs.n_subapertures,
        pupil_separation_subap=round(wfs.image_separation_subap),
        wavelength_m=wfs.wavelength_m,
        modulation_lambda_over_d=wfs.modulation_lambda_over_d,
        n_modulation=N_MODULATION,
        sampling=SAMPLING,
        as_shipped=case.as_shipped,
        image_shift_subap=(alpha.shift_x_subap, alpha.shift_y_subap) if moved else (0.0, 0.0),
        misregistration=in_degrees(alpha) if case.own_mirror else None,
    )


def job_arrays(case: Case) -> dict[str, Array]:
    """Return the shapes the peer shall push: modes where the mirror lies, or the mirror itself."""
    if case.own_mirror:
        return {
            "positions_m": instrument().analytic_mirror.positions_m,
            "pitch_m": np.array(instrument().analytic_mirror.pitch_m),
            "mode_to_actuator": basis(Influence.GAUSSIAN).mode_to_actuator,
        }
    points = mirror_points(bench(case), case.alpha, case.stop)
    shapes = basis(Influence.THIN_PLATE).render(points)
    n = bench(case).n_pupil
    return {"shapes_m": shapes.T.reshape(N_MODES, n, n)}


def mirror_points(told: Bench, alpha: Misregistration, stop: Stop) -> Array:
    """Return where each point of a peer's pupil grid, row-major, lies on the mirror, subapertures.

    Where the mirror is the stop the pupil moves with it: only what turns it and its size is left.
    """
    along = (np.arange(told.n_pupil) - (told.n_pupil - 1) / 2) / told.sampling
    x, y = np.meshgrid(along, along)
    points = np.column_stack([x.ravel(), y.ravel()])
    if stop is Stop.TELESCOPE:
        points = points - alpha.vector[:2]
    return np.asarray(points @ rotation(alpha.rotation_rad) / alpha.magnification)


def digest(case: Case, requirement: str) -> str:
    """Return a name for everything that the peer's matrix depends on."""
    told = json.dumps([requirement, N_MODES, asdict(bench(case)), in_degrees(case.alpha)])
    return hashlib.sha256(told.encode()).hexdigest()[:10]


def in_degrees(alpha: Misregistration) -> tuple[float, float, float, float]:
    """Return shift x and y in subapertures, rotation in degrees, magnification."""
    return (
        alpha.shift_x_subap,
        alpha.shift_y_subap,
        float(np.rad2deg(alpha.rotation_rad)),
        alpha.magnification,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Listing:
    """How the peer lists its slopes, and what its user would say of that."""

    order: str
    """``xy`` or ``interleaved``, as its user would say."""

    normalisation: str
    """``global`` or ``local``."""

    rows_first: bool = False
    """Whether what the peer lists first, and calls x, is the slope along the rows of its mask."""


LISTINGS = {
    "oopao": Listing(order="xy", normalisation="global"),
    "hcipy": Listing(order="xy", normalisation="local"),
    "specula": Listing(order="xy", normalisation="global", rows_first=True),
}


def write_reference(path: Path, measured: Measured, cube: Array | None) -> None:
    """Write the matrix and whatever the instrument file refers to."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        file["interaction_matrix"] = measured.matrix
        file["valid_subapertures"] = measured.valid
        if cube is not None:
            file["influence_functions"] = cube
            file["mode_to_actuator"] = basis(Influence.GAUSSIAN).mode_to_actuator


def write_instrument(
    path: Path, reference: Path, case: Case, measured: Measured, listing: Listing, stop: Stop
) -> None:
    """Write the instrument file; ``stop`` need not be the peer's, the rest is."""
    told = bench(case)
    mirror = f'layout = "rings"\n\n[modes]\nn_modes = {N_MODES}\n'
    if case.own_mirror:
        mirror = (
            f'influence_functions = "{reference.name}:/influence_functions"\n'
            f'mode_to_actuator = "{reference.name}:/mode_to_actuator"\n'
            f"modes_pitch_m = {told.diameter_m / told.n_pupil!r}\n"
        )
    path.write_text(
        f'[instrument]\nname = "{case.peer}"\ndiameter_m = {told.diameter_m}\n'
        f'obscuration_ratio = {told.obscuration_ratio}\nstop = "{stop}"\n\n'
        f'[wfs]\nkind = "pyramid"\nn_subapertures = {told.n_subapertures}\n'
        f"pupil_separation_subap = {told.pupil_separation_subap}\n"
        f"wavelength_m = {measured.wavelength_m!r}\n"
        f"modulation_lambda_over_d = {told.modulation_lambda_over_d}\n"
        f'valid_subapertures = "{reference.name}:/valid_subapertures"\n\n'
        f"[mirror]\n{mirror}\n"
        f'[slopes]\norder = "{listing.order}"\norientation = "auto"\n'
        f'normalisation = "{listing.normalisation}"\n'
    )


def turned(measured: Measured, listing: Listing) -> Measured:
    """Return the same matrix as a bench with other habits lists it: interleaved, x first.

    The detector is mirrored on its diagonal, its rows are counted from the other end while Sy
    keeps its sign, and every slope has the other sign.
    """
    n_modes = measured.matrix.shape[1]
    maps = np.zeros((2, *measured.valid.shape, n_modes))
    maps[:, measured.valid] = measured.matrix.reshape(2, -1, n_modes)
    # The slope along the rows runs along the columns once the detector is mirrored.
    by_columns = maps if listing.rows_first else maps[::-1]
    maps = -by_columns.transpose(0, 2, 1, 3)[:, ::-1]
    valid = np.ascontiguousarray(measured.valid.T[::-1])
    interleaved = maps[:, valid].transpose(1, 0, 2).reshape(-1, n_modes)
    return replace(measured, matrix=interleaved, valid=valid)


LIMITS = np.array([0.002, 0.002, 0.005, 0.0003])
"""Largest error with all modes: subapertures, degrees, ratio."""

LIMITS_FEW = np.array([0.005, 0.005, np.inf, np.inf])
"""Largest error with the 20 lowest modes: only of the shifts is anything asked."""

MAX_CHANGE_SIGMA = 3.0
"""Largest change of α by a wrong value of the file that is accepted, in σ of that fit."""

RESIDUAL_LIMIT = 0.02

FEW = "0:20"

KEPT_ANSWERS = "answers.jsonl"
"""Beside the files that were fitted: what ``pyrcal fit`` said, one line each."""

_TIMEOUT_S = 600.0
_ACCEPTED_OR_REFUSED = (0, 1)


class Question(StrEnum):
    """What is asked of a matrix."""

    ALL = "all modes"
    FEW = "20 lowest"
    TURNED = "other axes"
    WRONG_STOP = "wrong stop"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """One fit against the truth."""

    case: Case
    """What was measured."""

    question: Question
    """What was asked."""

    error: Array
    """``(4,)`` found less true: subapertures, degrees, ratio; in the axes that were found."""

    sigma: Array
    """``(4,)`` 1 σ that the fit claims."""

    residual: float
    """Fraction of the signal left over."""

    accepted: bool
    """The verdict."""

    verdict: str
    """In words."""

    orientation: dict[str, Any]
    """As found."""

    seconds: float
    """That the fit took."""

    right_error: Array | None = None
    """``(4,)`` error of the fit with the right file, where this file has one wrong value."""

    @property
    def change_sigma(self) -> float:
        """Largest difference from the fit with the right file, in σ of this one; 0 for itself."""
        if self.right_error is None:
            return 0.0
        return float(np.max(np.abs(self.error - self.right_error) / self.sigma))

    @property
    def as_asked(self) -> bool:
        """Whether the targets are met.

        A file with a wrong value may be refused, or change α by less than ``MAX_CHANGE_SIGMA``.
        """
        if self.question is Question.WRONG_STOP:
            return not self.accepted or self.change_sigma <= MAX_CHANGE_SIGMA
        limits = LIMITS_FEW if self.question is Question.FEW else LIMITS
        near = bool(np.all(np.abs(self.error) <= limits))
        return near and self.accepted and self.residual <= RESIDUAL_LIMIT


def ask(case: Case, measured: Measured, cube: Array | None, folder: Path) -> list[Answer]:
    """Return the answers to all that is asked of one matrix."""
    reference = folder / "reference.h5"
    write_reference(reference, measured, cube)
    (folder / KEPT_ANSWERS).unlink(missing_ok=True)
    listing = LISTINGS[case.peer]
    right = folder / "instrument.toml"
    write_instrument(right, reference, case, measured, listing, case.stop)
    answers = [
        _answer(case, Question.ALL, right, reference),
        _answer(case, Question.FEW, right, reference, "--modes", FEW),
    ]
    if case.own_mirror or case.as_shipped:
        return answers
    other = Stop.MIRROR if case.stop is Stop.TELESCOPE else Stop.TELESCOPE
    wrong = folder / "wrong-stop.toml"
    write_instrument(wrong, reference, case, measured, listing, other)
    answers.append(_answer(case, Question.WRONG_STOP, wrong, reference))
    answers = _compare_with_right(answers)
    if case.stop is Stop.MIRROR and case.alpha not in SMALLEST:
        answers.append(_ask_turned(case, measured, folder))
    return answers


def _ask_turned(case: Case, measured: Measured, folder: Path) -> Answer:
    reference, toml = folder / "other-axes.h5", folder / "other-axes.toml"
    seen = turned(measured, LISTINGS[case.peer])
    write_reference(reference, seen, None)
    listing = Listing(order="interleaved", normalisation=LISTINGS[case.peer].normalisation)
    write_instrument(toml, reference, case, seen, listing, case.stop)
    return _answer(case, Question.TURNED, toml, reference)


def _answer(case: Case, question: Question, toml: Path, reference: Path, *more: str) -> Answer:
    command = [sys.executable, "-m", "pyrcal", "fit", str(toml), str(reference), "--json", *more]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    if done.returncode not in _ACCEPTED_OR_REFUSED:
        raise RuntimeError(f"{case.name}, {question}: pyrcal fit: {done.stderr.strip()}")
    found = {"question": question, "accepted": done.returncode == 0, **json.loads(done.stdout)}
    RowFile(toml.parent / KEPT_ANSWERS).add(found)
    return _judged(case, found)


def kept_answers(case: Case, folder: Path) -> list[Answer]:
    """Return the answers of the last run; none where there are none."""
    return _compare_with_right([_judged(case, row) for row in RowFile(folder / KEPT_ANSWERS).rows])


def _compare_with_right(answers: list[Answer]) -> list[Answer]:
    """Return answers of one matrix, those of wrong files with the error of the right one."""
    right = next((one.error for one in answers if one.question is Question.ALL), None)
    return [
        replace(one, right_error=right) if one.question is Question.WRONG_STOP else one
        for one in answers
    ]


def _judged(case: Case, found: dict[str, Any]) -> Answer:
    return Answer(
        case=case,
        question=Question(found["question"]),
        error=error(found, in_degrees(case.alpha)),
        sigma=np.array([found["sigma"][name] for name in PARAMETERS], dtype=float),
        residual=float(found["residual_fraction"]),
        accepted=bool(found["accepted"]),
        verdict=found["verdict"],
        orientation=found["orientation"],
        seconds=float(found["seconds"]),
    )


def error(found: dict[str, Any], truth: tuple[float, float, float, float]) -> Array:
    """Return found less true ``(4,)``: subapertures, degrees, ratio.

    Quarter turns of the sensor's axes are no error: the same sensor seen with its axes a quarter
    turn on has the mirror, and the shift with it, a quarter turn further.
    """
    alpha = np.array([found[name] for name in PARAMETERS], dtype=float)
    quarters = round((alpha[2] - truth[2]) / 90.0)
    x, y = truth[:2]
    for _ in range(quarters % 4):
        x, y = -y, x
    return np.asarray(alpha - np.array([x, y, truth[2] + 90.0 * quarters, truth[3]]))


_NAMED = re.compile(r'with (\w+ = "\w+")')
"""What of the instrument file a verdict would change."""

_PERCENT = np.array([100.0, 100.0, 1.0, 100.0])

_OPENING = f"""# Interaction matrices of other codes

Generated by `python -m pyrcal_studies.peers`. OOPAO, HCIPy and SPECULA measure {N_MODES} KL modes
of the FLAO mirror by push-pull of 1 nm, {SAMPLING} pupil points per subaperture, with their own
pyramids, detectors, valid pixels, slopes, signs and axes. `pyrcal fit` is given the matrix, the
peer's mask, and an instrument file with `orientation = "auto"`; it is not told where the mirror is.

The truth: with `stop = "telescope"` a peer is handed the modes where the mirror lies (our basis,
evaluated there, never interpolated); with `stop = "mirror"` the peer moves its pupil images by the
shift as well: OOPAO by tilting the pyramid's faces, HCIPy by moving the detector, SPECULA by moving
the pupil by whole samples. "own mirror" is OOPAO's own: Gaussian influence functions moved by its
`MisRegistration`; pyrcal has them only as a cube at perfect registration, which ends with the
pupil's square. "as shipped": OOPAO's binary pupil, and 3 λ/D by its own count (3.025 λ/D);
elsewhere every peer has the same grey pupil. Seconds are wall time on a machine that was busy. What
was refused although right is told at the end.
"""

_READING = """
Asked: with all modes at most 0.2 % of a subaperture, 0.005 deg, 0.03 %; with the 20 lowest 0.5 % of
a subaperture; residual at most 2 %; accepted. Errors are found less true, in the axes found.
"""

_WRONG = """
## The wrong stop

The same matrices with the other `stop` in the instrument file. Asked: refused, or α within 3 σ of
that with the right file.
"""

_TURNED = """
## Other axes

The same matrices as a bench with other habits would list them: detector mirrored on its diagonal,
rows counted from the other end while Sy keeps its sign, all signs turned, slopes interleaved.
"""


_HABITS = """
## What the peers do differently

- OOPAO 1.0.0: slopes of the other sign than ours; pupil binary; its modulation tilts rise by λ from
  the first sample to the last, so that 3 λ/D are 3 n / (n - 1). The binary pupil, not the pyramid,
  makes most of the residual as shipped.
- HCIPy 0.7.1: images turned by half a turn, slopes normalised in each subaperture; the subsampling
  of its detector is never applied at read-out, the study sums the pixels itself.
- SPECULA 1.1.0: what it calls x runs along the rows of its mask. The instrument file says what its
  user would say, order "xy"; the fit finds and reports "yx". Its `pup_shifts` add an eighth of a
  subaperture and stretch the images by 0.3 %, the faces of its `pyr_tlt_coeff` no longer meet: the
  study moves the pupil instead. At its own thresholds its pupil finder takes diffracted light for
  pupil: the study raises them.
"""


def page(matrices: Sequence[tuple[Case, Measured]], answers: Sequence[Answer]) -> str:
    """Return the page in Markdown."""
    straight = [a for a in answers if a.question in {Question.ALL, Question.FEW}]
    wrong = [a for a in answers if a.question is Question.WRONG_STOP]
    turned = [a for a in answers if a.question is Question.TURNED]
    reached = sum(a.as_asked for a in answers)
    parts = [
        _OPENING,
        "\n## The matrices\n\n",
        _matrix_table(matrices),
        "\n## The registration found\n",
        _READING,
        "\n",
        _table([a for a in straight if a.question is Question.ALL]),
        _few([a for a in straight if a.question is Question.FEW]),
        _TURNED,
        "\n",
        _table(turned),
        _WRONG,
        "\n",
        _wrong_table(wrong),
        f"\nAs asked: {reached} of {len(answers)}.\n",
        _worst(straight + turned),
        _HABITS,
        _refusals(straight + turned),
    ]
    return "".join(parts)


def _rows(header: str, rows: Iterable[Sequence[str]]) -> str:
    names = [name.strip() for name in header.split("|")]
    lines = ["| " + " | ".join(names) + " |", "|" + " --- |" * len(names)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def _matrix_table(matrices: Sequence[tuple[Case, Measured]]) -> str:
    return _rows(
        "matrix | x, y (subap) | rotation (deg) | magnification | seconds",
        (
            (
                case.name,
                "{:+.2f}, {:+.2f}".format(*in_degrees(case.alpha)[:2]),
                f"{in_degrees(case.alpha)[2]:+.1f}",
                f"{case.alpha.magnification:.3f}",
                f"{measured.seconds:.0f}",
            )
            for case, measured in matrices
        ),
    )


def _table(answers: Sequence[Answer]) -> str:
    return _rows(
        "matrix | modes | x, y (% subap) | rotation (deg) | magnification (%) | σ of x (% subap)"
        " | residual | as asked",
        (
            (
                answer.case.name,
                str(answer.question),
                "{:+.3f}, {:+.3f}".format(*(answer.error * _PERCENT)[:2]),
                f"{answer.error[2]:+.4f}",
                f"{100 * answer.error[3]:+.4f}",
                f"{100 * answer.sigma[0]:.3f}",
                f"{answer.residual:.2%}",
                "yes" if answer.as_asked else "**no**",
            )
            for answer in answers
        ),
    )


def _few(answers: Sequence[Answer]) -> str:
    """Return what the fits of the lowest modes alone come to."""
    if not answers:
        return ""
    x, y, turned, size = np.max(np.abs([a.error * _PERCENT for a in answers]), axis=0)
    reached = sum(a.as_asked for a in answers)
    return (
        f"\nWith the 20 lowest modes {reached} of {len(answers)} are as asked; largest errors "
        f"{x:.3f}, {y:.3f} % of a subaperture, {turned:.4f} deg, {size:.4f} %.\n"
    )


def _wrong_table(answers: Sequence[Answer]) -> str:
    return _rows(
        "matrix | x, y off (% subap) | magnification off (%) | residual | from the right file (σ)"
        " | refused, and named | as asked",
        (
            (
                answer.case.name,
                "{:+.1f}, {:+.1f}".format(*(answer.error * _PERCENT)[:2]),
                f"{100 * answer.error[3]:+.2f}",
                f"{answer.residual:.1%}",
                f"{answer.change_sigma:.1f}",
                "accepted"
                if answer.accepted
                else ", ".join(_NAMED.findall(answer.verdict)) or answer.verdict,
                "yes" if answer.as_asked else "**no**",
            )
            for answer in answers
        ),
    )


def _worst(answers: Sequence[Answer]) -> str:
    """Return by how many σ the fits are off: whether σ covers what codes differ by."""
    if not answers:
        return ""
    ratios = np.array([np.abs(answer.error) / answer.sigma for answer in answers])
    rms = np.sqrt(np.mean(ratios**2, axis=0))
    worst = ratios.max(axis=0)
    told = ", ".join(
        f"{name} {a:.1f} ({b:.1f})"
        for name, a, b in zip(("x", "y", "rotation", "magnification"), rms, worst, strict=True)
    )
    return f"\nErrors over the σ that the fits claim, RMS (largest): {told}.\n"


def _refusals(answers: Sequence[Answer]) -> str:
    missed = [answer for answer in answers if not answer.accepted]
    if not missed:
        return ""
    lines = [f"- {answer.case.name}, {answer.question}: {answer.verdict}" for answer in missed]
    return "\nRefused although right:\n\n" + "\n".join(lines) + "\n"


ROOT = Path(__file__).resolve().parent.parent
KEPT = ROOT / "var" / "peers"
PAGE = KEPT / "peers.md"

REQUIREMENTS = {
    "oopao": "OOPAO==1.0.0",
    "hcipy": "hcipy==0.7.1",
    "specula": "specula==1.1.0",
    "synim": "synim==2.0.0",
}
"""What is installed for each peer."""

FITTED = ("oopao", "hcipy", "specula")
"""Peers with a pyramid, whose matrices of FLAO are fitted here: SynIM's sensors are lenslets."""

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def environment(peer: str) -> Path:
    """Return the interpreter that has the peer, made at the first call."""
    folder = KEPT / peer / "venv"
    interpreter, stamp = folder / "bin" / "python", folder / "installed"
    if not stamp.exists() or stamp.read_text() != REQUIREMENTS[peer]:
        venv.create(folder, with_pip=True, clear=True)
        pip = [str(interpreter), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, REQUIREMENTS[peer]], check=True)
        stamp.write_text(REQUIREMENTS[peer])
    return interpreter


def variables() -> dict[str, str]:
    """Return the environment variables of a peer's process: one thread, no window."""
    return {**os.environ, **dict.fromkeys(_ONE_THREAD, "1"), "MPLBACKEND": "Agg"}


def measured(case: Case) -> Path:
    """Return the file with the peer's matrix, measured now unless it is kept."""
    folder = KEPT / case.peer
    kept = folder / f"{case.name}-{digest(case, REQUIREMENTS[case.peer])}.npz"
    if not kept.exists():
        print(f"{case.name}: measuring", file=sys.stderr, flush=True)
        interpreter = environment(case.peer)
        job = folder / f"{case.name}-job.npz"
        write_job(job, bench(case), **job_arrays(case))
        command = [str(interpreter), "-m", f"pyrcal_studies.peers_{case.peer}", str(job), str(kept)]
        subprocess.run(
            command,
            cwd=ROOT,
            env=variables(),
            stdout=subprocess.DEVNULL,
            check=True,
        )
        job.unlink()
    return kept


def main() -> int:
    """Measure, fit, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--peers", nargs="+", choices=FITTED, default=None)
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument(
        "--page-only", action="store_true", help="fit nothing: the page of the last run's answers"
    )
    given = parser.parse_args()
    matrices: list[tuple[Case, Measured]] = []
    answers: list[Answer] = []
    for case in (case for peer in given.peers or FITTED for case in cases(peer)):
        matrix, beside = read_product(measured(case))
        matrices.append((case, matrix))
        folder = KEPT / "files" / case.name
        if given.page_only:
            answers += kept_answers(case, folder)
            continue
        print(f"{case.name}: fitting", file=sys.stderr, flush=True)
        answers += ask(case, matrix, beside.get("influence_functions"), folder)
    given.page.parent.mkdir(parents=True, exist_ok=True)
    given.page.write_text(page(matrices, answers))
    print(given.page)
    return 0 if all(answer.as_asked for answer in answers) else 1


if __name__ == "__main__":
    sys.exit(main())
