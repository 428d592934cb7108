"""What ``pyrcal fit`` makes of the peers' matrices, and how far that is from the truth."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.peers_cases import SMALLEST, Case, in_degrees
from pyrcal_studies.peers_files import (
    LISTINGS,
    Listing,
    turned,
    write_instrument,
    write_reference,
)
from pyrcal_studies.peers_pushpull import Measured
from service.model.kinds import Stop
from service.model.misregistration import PARAMETERS

Array = NDArray[Any]

LIMITS = np.array([0.002, 0.002, 0.005, 0.0003])
"""Largest error with all modes: subapertures, degrees, ratio."""

LIMITS_FEW = np.array([0.005, 0.005, np.inf, np.inf])
"""Largest error with the 20 lowest modes: only of the shifts is anything asked."""

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

    @property
    def as_asked(self) -> bool:
        """Whether the issue's numbers are reached; of a wrong stop, that it is refused."""
        if self.question is Question.WRONG_STOP:
            return not self.accepted
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
    with (toml.parent / KEPT_ANSWERS).open("a") as kept:
        print(json.dumps(found), file=kept)
    return _judged(case, found)


def kept_answers(case: Case, folder: Path) -> list[Answer]:
    """Return the answers of the last run; none where there are none."""
    kept = folder / KEPT_ANSWERS
    lines = kept.read_text().splitlines() if kept.exists() else []
    return [_judged(case, json.loads(line)) for line in lines]


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
