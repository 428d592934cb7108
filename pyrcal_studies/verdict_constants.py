"""What other values of the constants of the registration verdict would give.

Matrices of an independent pyramid (the Fourier pyramid of the tests, 12 subapertures) are fitted
with one value of the instrument file wrong, zonal and modal, without noise and with 15 %. Each fit
is judged again with other values of one constant at a time; nothing else changes. The registration
is known, so that a fit which is accepted further than 3 σ off counts against a value, and so does
the refusal of a fit that is right. Run: ``python -m pyrcal_studies.verdict_constants``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import pyrcal.fitting.alternatives as other_explanations
import pyrcal.fitting.instrument_checks as checks
import pyrcal.fitting.matrix as fits
import pyrcal.fitting.verdict as verdicts
from pyrcal.fitting.pupil_checks import FitSubset
from service.estimation.reference import Reference
from service.model.instrument import Instrument
from service.model.kinds import Influence, InfluenceShape, Stop
from tests.unit.fitting.test_mistold import MODES, TRUTH, bench, masked, zonal

Array = NDArray[np.float64]

NOISE = 0.15
MAX_SIGMA = 3.0

SETTINGS: dict[str, tuple[float, ...]] = {
    "MAX_DISPLACEMENT": (0.3, 1.0, 3.0, 10.0),
    "EXCLUSION_SIGMA": (1.0, 2.0, 3.0, 5.0),
    "MIN_EXPLAINED": (0.001, 0.0025, 0.005, 0.01, 0.03),
}
"""Values of each constant that are tried."""

_MODULES: dict[str, tuple[Any, ...]] = {
    "MAX_DISPLACEMENT": (verdicts,),
    "EXCLUSION_SIGMA": (other_explanations,),
    "MIN_EXPLAINED": (other_explanations, checks),
}


def _sensor(**changes: Any) -> Callable[[Instrument], Instrument]:  # noqa: ANN401 - of a record
    return lambda about: replace(about, wfs=replace(about.wfs, **changes))


def _mirror(shape: InfluenceShape) -> Callable[[Instrument], Instrument]:
    return lambda about: replace(about, mirror=replace(about.analytic_mirror, shape=shape))


def _gaussian(coupling: float) -> Callable[[Instrument], Instrument]:
    return _mirror(InfluenceShape(influence=Influence.GAUSSIAN, coupling=coupling))


WRONG: dict[str, Callable[[Instrument], Instrument]] = {
    "nothing": lambda about: about,
    "coupling 0.2 for 0.35": _gaussian(0.2),
    "coupling 0.5 for 0.35": _gaussian(0.5),
    "thin plates for Gaussians": _mirror(InfluenceShape(influence=Influence.THIN_PLATE)),
    "modulation 1.5 for 3": _sensor(modulation_lambda_over_d=1.5),
    "modulation 6 for 3": _sensor(modulation_lambda_over_d=6.0),
    "the other stop": lambda about: replace(about, stop=Stop.MIRROR),
    "obscuration 0.2 for 0.1": lambda about: replace(about, obscuration_ratio=0.2),
    "obscuration 0.3 for 0.1": lambda about: replace(about, obscuration_ratio=0.3),
    "spiders that are not there": lambda about: replace(
        about, spiders_m=0.08, spiders_deg=(45.0, 135.0, 225.0, 315.0)
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recorded:
    """A fit, ready to be judged again."""

    words: str
    alternatives: tuple[Any, ...]
    """Arguments of ``find_alternatives``."""

    width: Array
    matrices: list[Array]
    """What the models of the alternatives gave, in the order of the calls."""

    findings: verdicts.FitFindings

    def judged(self) -> tuple[bool, float]:
        """Return whether the fit is accepted, and its largest error over σ."""
        found, replay = self.findings, iter(self.matrices)
        with patch.object(FitSubset, "matrix", lambda _self, _tried: next(replay)):
            tried = other_explanations.find_alternatives(*self.alternatives)
        sure = other_explanations.add_alternatives(
            found.before,
            tried,
            found.residual_fraction,
            width=self.width,
            without=found.with_file_values,
        )
        refusal, _ = verdicts.judge_fit(replace(found, uncertainty=sure, alternatives=tried))
        sigma = np.sqrt(np.diag(sure.covariance))
        error = np.abs(found.solution.vector - TRUTH.vector)
        return refusal is None, float(np.max(error / sigma))


def recorded(words: str, about: Instrument, matrix: Array) -> Recorded:
    """Return a fit with all that its verdict is made of."""
    kept: dict[str, Any] = {"matrices": []}
    own: dict[str, Any] = {
        "alternatives": other_explanations.find_alternatives,
        "judged": verdicts.judge_fit,
        "width": checks.estimate_width_effect,
        "matrix": FitSubset.matrix,
    }

    def alternatives(*given: Any) -> Any:  # noqa: ANN401 - passes all on
        kept["alternatives"] = given

        def matrix_of(self: FitSubset, tried: Any) -> Array:  # noqa: ANN401
            kept["matrices"].append(own["matrix"](self, tried))
            return np.asarray(kept["matrices"][-1])

        with patch.object(FitSubset, "matrix", matrix_of):
            return own["alternatives"](*given)

    def judged(findings: verdicts.FitFindings) -> Any:  # noqa: ANN401
        kept["findings"] = findings
        return own["judged"](findings)

    def width(*given: Any) -> Array:  # noqa: ANN401
        kept["width"] = own["width"](*given)
        return np.asarray(kept["width"])

    with (
        patch.object(fits, "find_alternatives", alternatives),
        patch.object(fits, "judge_fit", judged),
        patch.object(fits, "estimate_width_effect", width),
    ):
        fits.fit_matrix(about, Reference(matrix=matrix))
    return Recorded(words=words, **kept)


def cases() -> Iterator[Recorded]:
    """Yield the fits, zonal and modal, without noise and with it."""
    for words, change in WRONG.items():
        for modal, share in ((False, 0.0), (True, 0.0), (True, NOISE)):
            about = masked(bench(mode_to_actuator=MODES if modal else None))
            matrix = zonal() @ MODES if modal else zonal()
            scatter = np.random.default_rng(8).normal(size=matrix.shape)
            name = f"{words}, {'modal' if modal else 'zonal'}, noise {share:.0%}"
            yield recorded(name, change(about), matrix + share * matrix.std() * scatter)


def table(found: list[Recorded]) -> Iterator[str]:
    """Yield a row of Markdown for every value of every constant."""
    yield (
        "| constant | value | accepted | accepted further than 3 σ off | right within 3 σ and "
        "refused | RMS of the largest error over σ |"
    )
    yield "| --- | --- | --- | --- | --- | --- |"
    for name, values in SETTINGS.items():
        used = getattr(_MODULES[name][0], name)
        for value in values:
            for module in _MODULES[name]:
                setattr(module, name, value)
            answers = [one.judged() for one in found]
            for module in _MODULES[name]:
                setattr(module, name, used)
            accepted = [off for ok, off in answers if ok]
            wrong = sum(off > MAX_SIGMA for off in accepted)
            refused = sum(not ok and off <= MAX_SIGMA for ok, off in answers)
            marked = f"**{value:g}**" if value == used else f"{value:g}"
            rms = float(np.sqrt(np.mean(np.square(accepted))))
            yield f"| {name} | {marked} | {len(accepted)} | {wrong} | {refused} | {rms:.2f} |"


def main() -> int:
    """Fit, judge with every value, print the table and the fits as they are judged now."""
    found = []
    with threadpool_limits(1):
        for one in cases():
            accepted, off = one.judged()
            print(f"{one.words}: accepted {accepted}, {off:.1f} sigma", flush=True)
            found.append(one)
    print("\n".join(table(found)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
