"""``pyrcal twin`` on the files of drawn benches of OOPAO, compared with what they were made of.

Seeds decide modulation, signal, actuators, registration, places of the images, unit and noise
(``oopao_benches.draw_case``), and here what files there are. Rows are kept in
``var/twin_campaign``; those that are there are not measured again.
Run: ``python -m pyrcal_studies.twin_campaign --seeds FIRST:END``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal_studies.campaign.rows import Row, RowFile, range_of
from pyrcal_studies.peers import ROOT, environment, variables
from pyrcal_studies.shared import study_parser, write_section
from service.model.misregistration import PARAMETERS

KEPT = ROOT / "var" / "twin_campaign"
PAGE = ROOT / "docs" / "results" / "twin.md"

Array = NDArray[np.float64]


def simulate(seed: int) -> dict[str, Any]:
    """Return the arrays of a drawn bench, simulated by OOPAO unless they are there."""
    path = KEPT / f"drawn-{seed}.npz"
    if not path.exists():
        command = [str(environment("oopao")), "-m", "pyrcal_studies.oopao_benches"]
        subprocess.run(
            [*command, str(KEPT), path.stem],
            cwd=ROOT,
            env=variables(),
            stdout=subprocess.DEVNULL,
            check=True,
        )
    with np.load(path) as dump:
        return dict(dump)


def write_files(seed: int, dump: dict[str, Any], case: dict[str, Any], folder: Path) -> bool:
    """Write the files of a bench as its users would, and return whether functions are given."""
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "int_mat.npy", dump["calib.D"])
    scipy.io.savemat(folder / "M2C.mat", {"M2C": dump["M2C"]})
    if case["processing"] == "slopesMaps":
        np.save(folder / "valid_mask.npy", dump["wfs.validI4Q"])
    elif seed % 3:
        np.save(folder / "mean_frame.npy", dump["frame"] / dump["frame"].sum())
    given = bool(seed // 3 % 2)
    if given:
        scipy.io.savemat(folder / "influence_functions.mat", {"modes": dump["dm.modes"]})
    else:
        outer = 1 - 1 / dump["tel.resolution"]  # OOPAO spreads D between centres of outer points
        np.save(folder / "positions.npy", dump["dm.initial_coordinates"] * outer)
        np.save(folder / "tel_pupil.npy", dump["tel.pupil"])
    if case["ellipse"]:
        np.save(folder / "spot.npy", dump["spot"])
    return given


def measure(seed: int) -> Row:
    """Return the row of a bench."""
    dump = simulate(seed)
    case = json.loads(str(dump["case"]))
    files, output = KEPT / f"files-{seed}", KEPT / f"twin-{seed}"
    given = write_files(seed, dump, case, files)
    command = [sys.executable, "-m", "pyrcal", "twin", str(files), "--output", str(output)]
    stated = ["--diameter-m", "0.6", "--wavelength-m", str(float(dump["ngs.wavelength"]))]
    begun = time.monotonic()
    ended = subprocess.run(
        [*command, *stated, "--threads", "1"],
        cwd=ROOT,
        env=variables(),
        capture_output=True,
        text=True,
        check=False,
    )
    row = {"seed": seed, "given": given, "seconds": time.monotonic() - begun, **case}
    row |= {"exit": ended.returncode, "stderr": ended.stderr[-400:]}
    if ended.returncode < 2:
        row |= compare(dump, case, json.loads((output / "twin.json").read_text("utf-8")))
    return row


def compare(dump: dict[str, Any], case: dict[str, Any], twin: dict[str, Any]) -> Row:
    """Return what a twin has found, and how far it is from the truth."""
    values = {one["name"]: one for one in twin["values"]}
    found, sigma = (
        np.array([values[name][key] for name in PARAMETERS]) for key in ("value", "sigma")
    )
    alpha, row = np.array(case["alpha"]), {"left": twin["left_over"]}
    wider = float(dump["tel.resolution"] / (dump["tel.resolution"] - 1))
    if "image_offsets_px" in values:
        places = list_places(dump, case) if "wfs.pupil_centres_px" in values else np.zeros((4, 2))
        if places.any():
            windows = np.array(values["wfs.pupil_centres_px"]["value"])
            rows, columns = (windows > windows.mean(axis=0)).T
            places -= windows[np.lexsort((columns, rows)), ::-1]
        off_px = np.array(values["image_offsets_px"]["value"]) - places
        row["images_px"] = float(np.abs(off_px).max())
        alpha[:2] += places.mean(axis=0)  # the registration is the mirror's on the windows
    error = found - alpha
    error[2] = (error[2] + 180.0) % 360.0 - 180.0
    ellipse = values.get("modulation_ellipse", values.get("wfs.modulation_ellipse"))
    if case["ellipse"] and ellipse:
        entry = ellipse["value"]
        entry = tomllib.loads(f"it = {entry}")["it"] if isinstance(entry, str) else entry
        longer, shorter = entry["axes_lambda_over_d"]
        turned = (entry["angle_deg"] - case["ellipse"][2] + 180.0) % 180.0 - 90.0
        row["axes"] = [longer / (5.0 * wider) - 1.0, shorter / (4.0 * wider) - 1.0, turned]
    elif "modulation_lambda_over_d" in values:
        number = values["modulation_lambda_over_d"]
        row["modulation_error"] = float(number["value"]) - case["modulation"] * wider
        row["modulation_sigma"] = number["sigma"]
    stroke = values["stroke"]["value"]
    row["unit"] = stroke / case["unit_m"] if isinstance(stroke, float) else None
    return row | {"error": error.tolist(), "ratio": (error / sigma).tolist()}


def list_places(dump: dict[str, Any], case: dict[str, Any]) -> Array:
    """Return the true centres (x, y) of the images, pixels: -x -y, +x -y, -x +y, +x +y."""
    half = (case["subapertures"] + case["separation_px"]) / 2
    middle = (len(dump["frame"]) - 1) / 2
    x, y = np.array(case["faces_px"] or np.zeros((2, 4)))
    off = np.stack([x, -y], axis=1)[[2, 3, 1, 0]]
    return np.asarray(middle + half * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) + off)


def list_rows(rows: list[Row]) -> Iterator[str]:
    """Yield the lines of the table, and of the errors over σ."""
    yield "| Bench | Error of α, σ | Left over, % | Modulation | Images, px | Unit | Time, s |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for row in sorted(rows, key=lambda one: int(one["seed"])):
        yield _line(row)
    for noise, words in ((0.0, "without noise"), (0.1, "with 10 % noise")):
        ratios = [row["ratio"] for row in rows if row["noise"] == noise and "ratio" in row]
        if ratios:
            rms = ", ".join(f"{one:.2f}" for one in np.sqrt(np.mean(np.square(ratios), axis=0)))
            among = f"{words} ({len(ratios)} benches)"
            yield f"\nError over σ, RMS, {among}: {rms} in x, y, rotation and magnification."


def _line(row: Row) -> str:
    ellipse, whole = row["ellipse"], row["processing"] != "slopesMaps"
    kind = "4 by 5" if ellipse else f"{row['modulation']:g}"
    words = [f"{kind} λ/D", "whole detector" if whole else "slopes"]
    words += [f"{row['subapertures']} subapertures, {row['actuators']} actuators across"]
    words += ["images off"] * bool(row["faces_px"]) + ["noise"] * bool(row["noise"])
    words += [] if row["given"] else ["positions only"]
    cells = ["refused"] * 5
    if "ratio" in row:
        worst, left = max(map(abs, row["ratio"])), 100.0 * row["left"]
        cells = [_mark(f"{worst:.1f}", worst < 3.0)]
        cells += [_mark(f"{left:.2f}", bool(row["noise"]) or left <= 1.5), _modulation(row)]
        images, unit = row.get("images_px"), row["unit"]
        cells += ["" if images is None else _mark(f"{images:.3f}", images <= 0.03)]
        cells += ["" if unit is None else _mark(f"{unit:+.3f}", abs(abs(unit) - 1.0) <= 0.02)]
    return f"| {row['seed']}: {', '.join(words)} | {' | '.join(cells)} | {row['seconds']:.0f} |"


def _modulation(row: Row) -> str:
    """Return the error of the modulation, λ/D, or of axes, %, and angle, degrees."""
    if "axes" in row:
        first, second, turned = row["axes"]
        reached = max(abs(first), abs(second)) <= 0.01 and abs(turned) <= 1.0
        return _mark(f"{first:+.1%}, {second:+.1%}, {turned:+.2f} deg", reached)
    if "modulation_error" not in row:
        return "**none**"
    error, true = row["modulation_error"], row["modulation"]
    return _mark(
        f"{error:+.3f} ± {row['modulation_sigma']:.3f}", abs(error) <= (0.03 * true or 0.15)
    )


def _mark(text: str, reached: bool) -> str:
    return text if reached else f"**{text}**"


def main() -> None:
    """Measure what is not kept, and write the page."""
    parser = study_parser("pyrcal_studies.twin_campaign", __doc__)
    parser.add_argument("--seeds", type=range_of, default=range(8000, 8016), metavar="FIRST:END")
    given = parser.parse_args()
    file = RowFile(KEPT / "rows.jsonl")
    for seed in given.seeds:
        if seed not in {row["seed"] for row in file.rows}:
            print(seed, file=sys.stderr, flush=True)
            file.add(measure(seed))
    text = "\n".join([*list_rows(file.rows), "", f"**Date**: {datetime.now(tz=UTC):%Y-%m-%d}."])
    write_section(PAGE, "drawn benches", text)


if __name__ == "__main__":
    main()
