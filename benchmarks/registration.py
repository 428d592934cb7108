"""The benchmark of registration: twenty interaction matrices of three codes, and the score.

``--make`` measures the matrices anew with OOPAO, HCIPy and SPECULA, each in an environment of its
own, and writes ``benchmarks/registration_matrices``: a matrix ``NAME.h5``, its instrument file
``NAME.toml`` and ``truth.json``. Without it the files that are there are fitted, the estimates in
``sprint.json`` are scored beside them, and docs/results/registration.md gets the table.

Run: ``make registration-benchmark``, or with ``ARGS=--make``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

import pyrcal
from pyrcal_studies import drawn_fits
from pyrcal_studies.campaign.rows import heading, line
from pyrcal_studies.drawn_fits import AS_IT_IS, Condition, Draw, error
from pyrcal_studies.peers import LISTINGS, ROOT, environment, variables
from pyrcal_studies.peers_pushpull import JOB, write_job
from pyrcal_studies.shared import RESULTS, study_parser, write_section
from service.model.misregistration import BOUNDARY_SCALE, Misregistration

FOLDER = Path(__file__).parent / "registration_matrices"
PAGE = RESULTS / "registration.md"

PLAIN, FAR, NOISY = Condition(), Condition(far=True), Condition(noise=0.1)
CASES = {
    **{f"oopao-{k}": Draw(code="oopao", condition=PLAIN, seed=k) for k in (1001, 1003, 1005, 1002)},
    **{f"oopao-far-{k}": Draw(code="oopao", condition=FAR, seed=k) for k in (1007, 1009, 1011)},
    **{f"oopao-noisy-{k}": Draw(code="oopao", condition=NOISY, seed=k) for k in (1013, 1015)},
    "oopao-displaced-1017": Draw(code="oopao", condition=Condition(position_error=0.02), seed=1017),
    **{f"hcipy-{k}": Draw(code="hcipy", condition=PLAIN, seed=k) for k in (1001, 1002, 1003)},
    "hcipy-far-1007": Draw(code="hcipy", condition=FAR, seed=1007),
    "hcipy-noisy-1013": Draw(code="hcipy", condition=NOISY, seed=1013),
    **{f"specula-{k}": Draw(code="specula", condition=PLAIN, seed=k) for k in (1001, 1002, 1003)},
    "specula-far-1007": Draw(code="specula", condition=FAR, seed=1007),
    "specula-noisy-1013": Draw(code="specula", condition=NOISY, seed=1013),
}
"""The twenty matrices; odd seeds have the telescope as stop, even ones the mirror."""

TOML = """\
# Licence: CC0 1.0. What a user of {code} knows of the matrix beside this file.
[instrument]
name = "bench"
diameter_m = 4.0
obscuration_ratio = 0.2
stop = "{stop}"

[wfs]
kind = "pyramid"
n_subapertures = 12
pupil_separation_subap = 18
wavelength_m = {wavelength_m!r}
modulation_lambda_over_d = 3.0
valid_subapertures = "{name}.h5:/valid_subapertures"

[mirror]
layout = "positions"
positions = "{name}.h5:/positions_m"
pitch_m = {pitch_m!r}
influence = "gaussian"
coupling = 0.35
mode_to_actuator = "{name}.h5:/mode_to_actuator"

[slopes]
order = "xy"
orientation = "auto"
normalisation = "{normalisation}"
"""


def make() -> None:
    """Measure all matrices and write the folder."""
    FOLDER.mkdir(exist_ok=True)
    truth = {}
    for code in dict.fromkeys(draw.code for draw in CASES.values()):
        names = [name for name, draw in CASES.items() if draw.code == code]
        found = {id(draw): one for draw, one in drawn_fits.measured([CASES[n] for n in names])}
        for name in names:
            draw, one = CASES[name], found[id(CASES[name])]
            mirror = draw.telescope.analytic_mirror
            with h5py.File(FOLDER / f"{name}.h5", "w") as file:
                for key, values in {
                    "interaction_matrix": one.matrix,
                    "positions_m": mirror.positions_m,
                    "mode_to_actuator": drawn_fits.strokes(),
                }.items():
                    file.create_dataset(key, data=values.astype(np.float32), compression="gzip")
                file["valid_subapertures"] = one.valid
            text = TOML.format(
                code=code,
                name=name,
                stop=draw.stop.value,
                wavelength_m=one.wavelength_m,
                pitch_m=float(mirror.pitch_m),
                normalisation=LISTINGS[code].normalisation,
            )
            (FOLDER / f"{name}.toml").write_text(text)
            truth[name] = {"made_by": one.version, **draw.alpha.to_boundary()}
    (FOLDER / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    (FOLDER / "sprint.json").write_text(json.dumps(_sprint(), indent=1) + "\n")


def _sprint() -> dict[str, Any]:
    """Return what OOPAO's SPRINT finds on the matrices of OOPAO whose pupil is fixed."""
    names = [n for n, draw in CASES.items() if draw.code == "oopao" and draw.seed % 2]
    draw = CASES[names[0]]
    job, mirror = FOLDER / f"sprint{JOB}", draw.telescope.analytic_mirror
    told = replace(draw.bench, image_shift_subap=(0.0, 0.0))
    # In OOPAO a pixel is 1 / (n - 1) of the pupil, so its metre is longer.
    metre = told.n_pupil / (told.n_pupil - 1)
    arrays = {"positions_m": mirror.positions_m * metre}
    arrays["pitch_m"] = np.array(mirror.pitch_m * metre)
    write_job(job, told, **arrays, mode_to_actuator=drawn_fits.strokes())
    questions = []
    for name in names:
        product = FOLDER / f"{name}-sprint.npz"
        with h5py.File(FOLDER / f"{name}.h5") as file:
            np.savez(product, matrix=file["interaction_matrix"][()])
        questions.append(json.dumps({"do": "estimate", "matrix": str(product)}))
    done = subprocess.run(
        [str(environment("oopao")), "-m", "benchmarks.peer_rounds", "oopao", str(job)],
        cwd=ROOT,
        env=variables(),
        input="\n".join(questions) + "\n",
        capture_output=True,
        text=True,
        check=True,
    )
    answers = [json.loads(row) for row in done.stdout.splitlines()[1:]]
    for path in (job, *FOLDER.glob("*-sprint.npz")):
        path.unlink()
    return dict(zip(names, answers, strict=True))


def read_truth() -> dict[str, Any]:
    """Return the true registration of each matrix, by name."""
    found: dict[str, Any] = json.loads((FOLDER / "truth.json").read_text())
    return found


def scored() -> Iterator[dict[str, Any]]:
    """Yield error, σ, verdict and time of every matrix, from the files alone."""
    sprint = json.loads((FOLDER / "sprint.json").read_text())
    for name, known in read_truth().items():
        alpha = Misregistration.from_boundary({k: v for k, v in known.items() if k != "made_by"})
        begun = time.process_time()
        instrument = pyrcal.load_instrument(FOLDER / f"{name}.toml")
        options = pyrcal.FitOptions(explain=True)
        fit = pyrcal.fit_file(instrument, FOLDER / f"{name}.h5", options, threads=1).fit
        yield {
            "name": name,
            "error": error(fit.alpha, alpha, AS_IT_IS) * BOUNDARY_SCALE,
            "sigma": fit.sigma * BOUNDARY_SCALE,
            "accepted": fit.accepted,
            "seconds": time.process_time() - begun,
            "sprint": _sprint_error(sprint.get(name), alpha),
            "sprint_s": sprint.get(name, {}).get("seconds"),
            "converged": sprint.get(name, {}).get("converged"),
        }


def _sprint_error(found: dict[str, Any] | None, alpha: Misregistration) -> NDArray[Any] | None:
    if found is None:
        return None
    x, y, rotation_deg, magnification = found["alpha"]
    estimate = np.array([x, y, np.deg2rad(rotation_deg), magnification])
    return np.asarray(
        error(Misregistration.from_vector(estimate), alpha, AS_IT_IS) * BOUNDARY_SCALE
    )


def table(rows: list[dict[str, Any]]) -> str:
    """Return the table of the page."""
    parts = [
        heading(
            "Matrix",
            "pyrcal: error x, y (subap), rotation (deg), magnification",
            "σ",
            "largest error/σ",
            "verdict",
            "time, s",
            "SPRINT: the same errors",
            "SPRINT: verdict, time, s",
        )
    ]
    for row in rows:
        over = np.abs(row["error"] / row["sigma"]).max()
        theirs = row["sprint"] is not None
        parts.append(
            line(
                f"`{row['name']}`",
                _numbers(row["error"]),
                _numbers(row["sigma"]),
                f"{over:.1f}",
                "accepted" if row["accepted"] else "refused",
                f"{row['seconds']:.1f}",
                _numbers(row["sprint"]) if theirs else "not possible",
                f"{'valid' if row['converged'] else 'not valid'}, {row['sprint_s']:.1f}"
                if theirs
                else "",
            )
        )
    return "".join(parts)


def _numbers(values: NDArray[Any]) -> str:
    x, y, rotation_deg, magnification = values
    return f"{x:.4f}, {y:.4f}, {rotation_deg:.4f}, {magnification:.5f}"


def main() -> int:
    """Make the matrices if asked to, fit them, and write the table."""
    parser = study_parser("benchmarks.registration", __doc__)
    parser.add_argument("--make", action="store_true", help="measure the matrices anew")
    if parser.parse_args().make:
        make()
    text = table(list(scored()))
    write_section(PAGE, "registration", text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
