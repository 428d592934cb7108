"""Several sensors and mirrors: MORFEO's geometry, found again; SynIM as an outside judge.

Run: ``python -m pyrcal_studies.systems [geometry] [matrices] [noise]``, by default all three.

Six laser stars on a ring of 45 arcseconds and mirrors at 600, 6500 and 17500 m are those of
SynIM's own tutorial (docs/tutorials/registration_morfeo_tutorial.rst). Sensors of 16 x 16
subapertures, 8 x 8 and two of them under noise, and actuators on square grids are ours. SynIM is
asked in an environment of its own, made at the first call under ``var/peers``.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.fit_system import fit_pairs
from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.fitting.report import FitReport
from pyrcal.fitting.system import ARCSEC_RAD, SHIFTS, Pair, System
from pyrcal.fitting.system_file import load_system
from pyrcal.fitting.system_fit import fit_system
from pyrcal.fitting.system_report import SystemReport
from pyrcal_studies.peers import environment, variables
from pyrcal_studies.shared import study_parser
from service.estimation.reference import Reference
from service.model.instrument import Instrument
from service.model.interaction import RtcInteractionModel
from service.model.kinds import Method
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.pupil import rtc_valid_subapertures

Array = NDArray[np.float64]

DIAMETER_M, N_SUBAPERTURES, PIXELS = 38.5, 16, 12
"""PIXELS: of SynIM's pupil, across a subaperture."""

RING_ARCSEC, HEIGHT_M = 45.0, 90e3
ALTITUDES_M = (600.0, 6500.0, 17500.0)
N_STARS = 6
TABLE_M = 8.0
"""SynIM's tables of a mirror reach so far beyond the pupil on either side."""

SIGMA = np.array([0.02, 0.02, 0.03, 0.005])
"""The tutorial's noise of α: metres, degrees, ratio."""

_INSTRUMENT = """
[instrument]
name = "{name}"
diameter_m = {diameter_m}
stop = "telescope"
[wfs]
kind = "shack-hartmann"
n_subapertures = {n_subapertures}
wavelength_m = 589e-9
[mirror]
layout = "grid"
n_across = {n_across}
pitch_m = {pitch_m}
diameter_m = {width_m}
influence = "gaussian"
coupling = 0.35
basis = "zonal"
[slopes]
orientation = {{ sign = 1 }}
"""


def morfeo(
    folder: Path,
    stars: str = "known",
    fixed: str = "dm1",
    *,
    every: int = 1,
    n_subapertures: int = N_SUBAPERTURES,
) -> System:
    """Return the system, its files written into a folder; of its stars every so many-th."""
    lines = ["[system]", 'name = "morfeo-like"', 'instrument = "dm1.toml"', f'stars = "{stars}"']
    for k in range(0, N_STARS, every):
        angle = np.pi / 6 + k * np.pi / 3
        x, y = RING_ARCSEC * np.cos(angle), RING_ARCSEC * np.sin(angle)
        lines += ["[[sensors]]", f'name = "lgs{k + 1}"', f"star_arcsec = [{x:.6f}, {y:.6f}]"]
        lines += [f"star_height_m = {HEIGHT_M}"]
    for k, altitude_m in enumerate(ALTITUDES_M, start=1):
        # as wide as the light that meets it, and a pitch more
        width_m = DIAMETER_M * (1 - altitude_m / HEIGHT_M)
        width_m += 2 * RING_ARCSEC * ARCSEC_RAD * altitude_m + 4.0
        about = {"name": f"dm{k}", "pitch_m": width_m / (n_subapertures + 1)}
        about |= {"n_across": n_subapertures + 2, "width_m": width_m + 0.1}
        about |= {"diameter_m": DIAMETER_M, "n_subapertures": n_subapertures}
        (folder / f"dm{k}.toml").write_text(_INSTRUMENT.format(**about))
        lines += ["[[mirrors]]", f'name = "dm{k}"', f'instrument = "dm{k}.toml"']
        lines += [f"altitude_m = {altitude_m}", f"fixed = {str(fixed == f'dm{k}').lower()}"]
    (folder / "system.toml").write_text("\n".join(lines))
    return load_system(folder / "system.toml")


def _asked(folder: Path, job: dict[str, Any]) -> dict[str, Any]:
    """Return what SynIM says to a job."""
    np.savez(folder / "job.npz", **job)
    where = [str(folder / name) for name in ("job.npz", "product.npz")]
    command = [str(environment("synim")), "-m", "pyrcal_studies.systems_synim", *where]
    subprocess.run(command, check=True, env=variables(), stdout=subprocess.DEVNULL)
    with np.load(folder / "product.npz") as file:
        return dict(file)


def _job(system: System, pitch_m: float, drawn: list[Array]) -> dict[str, Any]:
    """Return the geometry of some systems in SynIM's words.

    Its sensors' places are from the grid to the pupil, ours the other way round; a mirror's shift
    is multiplied by its magnification there.
    """
    sensors, mirrors = [], []
    for values in drawn:
        there = system.at(values)
        back = [one.place.inverse for one in there.sensors]
        width_m = there.sensors[0].instrument.subaperture_m
        sensors.append([[*_xy(one.shift * width_m / pitch_m), *_turned(one.turn)] for one in back])
        mirrors.append(
            [
                [*_xy(one.place.shift / abs(one.place.turn) / pitch_m), *_turned(one.place.turn)]
                for one in there.mirrors
            ]
        )
    stars = [[*_xy(one.star.direction_rad / ARCSEC_RAD), HEIGHT_M] for one in system.sensors]
    return {
        "pitch_m": pitch_m,
        "stars": stars,
        "altitudes_m": ALTITUDES_M,
        "sensors": sensors,
        "mirrors": mirrors,
        "free_sensors": [k for k, one in enumerate(system.sensors) if not one.fixed],
        "free_mirrors": [k for k, one in enumerate(system.mirrors) if not one.fixed],
        "sigma": SIGMA / [pitch_m, pitch_m, 1.0, 1.0],
    }


def _xy(point: complex) -> list[float]:
    return [point.real, point.imag]


def _turned(turn: complex) -> list[float]:
    return [float(np.angle(turn, deg=True)), abs(turn)]


def _drawn(system: System, rng: np.random.Generator, size_subap: float) -> Array:
    """Return numbers of which the free ones are off by so much, 1 σ, at the edge of the pupil."""
    values = system.nominal.copy()
    for k, one in enumerate(system.parameters):
        values[k] += size_subap * one.subap * rng.normal() * one.free
    return values


def geometry() -> Iterator[str]:
    """Yield how the two codes agree without any matrix: α of each pair, what comes back, σ."""
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        system = morfeo(folder)
        pitch_m = 0.0802
        drawn = [_drawn(system, rng, 0.2) for _ in range(20)]
        told = _asked(folder, _job(system, pitch_m, drawn))
        width_m = system.sensors[0].instrument.subaperture_m
        worst = np.zeros(4)
        for values, alphas in zip(drawn, told["alphas"], strict=True):
            ours = np.array([
                system.seen(pair, values).alpha.vector * BOUNDARY_SCALE for pair in system.pairs
            ])  # fmt: skip
            theirs = alphas * [pitch_m / width_m, pitch_m / width_m, 1.0, 1.0]
            worst = np.maximum(worst, np.abs(ours - theirs).max(axis=0))
        yield f"SynIM {told['version']}: α of 18 pairs of 20 systems, largest difference: {worst}"
        scale = SIGMA / [width_m, width_m, 180 / np.pi, 1.0]
        covariances = np.tile(np.diag(scale**2), (len(system.pairs), 1, 1))
        found = fit_system(system, system.alphas(drawn[0]), covariances)
        free = [k for k, one in enumerate(system.parameters) if one.free]
        yield f"without noise: ours off by {np.nanmax(np.abs(found.values - drawn[0])[free]):.1e}"
        nominal = fit_system(system, system.alphas(system.nominal), covariances)
        own = [
            nominal.sigma[k] * one.boundary * (width_m if one.name.endswith("_subap") else 1.0)
            for k, one in enumerate(system.parameters) if one.free
        ]  # fmt: skip
        theirs = told["sigma"].reshape(-1, 4) * [pitch_m, pitch_m, 1.0, 1.0]
        ratio = np.reshape(own, (-1, 4)) / theirs
        yield f"σ, ours over SynIM's: {ratio.min():.3f} to {ratio.max():.3f}"
        gauge = morfeo(folder, fixed="")
        yield from _named(gauge, covariances, "nothing fixed, stars known")
        yield from _named(morfeo(folder, "direction", ""), covariances, "stars to be found")
        both = morfeo(folder, "direction and height")
        seen = fit_system(both, both.alphas(both.nominal), covariances)
        yield from _named(both, covariances, "directions and heights, dm1 fixed")
        for k, one in enumerate(both.parameters[:7]):
            yield f"    {one.owner} {one.name}: 1 σ {seen.sigma[k] * one.boundary:.3g}"


def _named(system: System, covariances: Array, words: str) -> Iterator[str]:
    found = fit_system(system, system.alphas(system.nominal), covariances)
    yield f"{words}: {len(found.unseen)} not seen: {'; '.join(found.unseen)}"


def _report(system: System, matrices: dict[Pair, Array]) -> SystemReport:
    """Return what ``pyrcal fit-system`` finds in these matrices."""
    bases = {pair: system.basis(pair) for pair in system.pairs}

    def fit(pair: Pair, about: Instrument) -> FitReport:
        asked = FitOptions(modes=system.lit(pair))
        reference = Reference(matrix=matrices[pair])
        found = fit_matrix(about, reference, asked, basis=bases[pair])
        return FitReport(
            fit=found,
            method=Method.JOINT,
            instrument=about.name,
            instrument_sha256="",
            reference="",
            reference_sha256="",
            double_pass=False,
            seconds=0.0,
        )

    return fit_pairs(system, fit)


def matrices() -> Iterator[str]:
    """Yield what is found in SynIM's own interaction matrices, slopes from derivatives."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        system = morfeo(folder)
        width_m = system.sensors[0].instrument.subaperture_m
        pixel_m = width_m / PIXELS
        line = (np.arange(N_SUBAPERTURES * PIXELS) + 0.5) * pixel_m - DIAMETER_M / 2
        n_table = len(line) + 2 * int(TABLE_M / pixel_m)
        wide = (np.arange(n_table) - (n_table - 1) / 2) * pixel_m
        grid = np.stack(np.meshgrid(wide, wide), axis=-1).reshape(-1, 2) / width_m
        mask = rtc_valid_subapertures(system.instrument(system.pairs[0]))
        # (rows, columns) of pixels, degrees, ratio, as SynIM has them
        moved = np.tile([0.0, 0.0, 0.0, 1.0], (N_STARS, 1))
        moved[0, :2], moved[1, 2], moved[2, 3] = [2.4, -1.2], 0.5, 1.003
        turned = np.array([0.0, -0.3, 0.4])
        job = _job(system, pixel_m, [system.nominal]) | {
            "pupil": (np.hypot(*np.meshgrid(line, line)) <= DIAMETER_M / 2).astype(float),
            "diameter_m": DIAMETER_M,
            "n_subapertures": N_SUBAPERTURES,
            "valid": np.flatnonzero(mask),
            "slope_method": "derivatives",
            "matrix_sensors": moved,
            "matrix_turned": turned,
        }
        for m, mirror in enumerate(system.mirrors):
            basis = system.bases[m]
            shapes = basis.render(grid).T.reshape(-1, n_table, n_table)
            job[f"shapes{m}"] = shapes
            yield f"{mirror.name}: {len(shapes)} actuators"
        told = _asked(folder, job)
        made = {
            pair: told[f"matrix_{pair.sensor}_{pair.mirror}"] * 1e9 / 5e-3 for pair in system.pairs
        }
        made = {pair: _in_waves(system, pair, one) for pair, one in made.items()}
        report = _report(system, made)
        yield report.verdict
        if report.found is None:
            return
        for k, one in enumerate(system.parameters):
            if one.free:
                value, sigma = report.found.values[k], report.found.sigma[k]
                yield (
                    f"    {one.owner} {one.name}: {value * one.boundary:+.5f} "
                    f"± {sigma * one.boundary:.5f}"
                )
        for pair, fit in zip(system.pairs, report.fits, strict=True):
            yield f"    {system.names(pair)}: {fit.fit.alpha} left {fit.fit.residual_fraction:.2%}"


def _in_waves(system: System, pair: Pair, matrix: Array) -> Array:
    """Return a matrix in about the model's unit: only its shape counts."""
    model = RtcInteractionModel(system.instrument(pair), system.basis(pair))
    ours = np.linalg.norm(model.interaction_matrix(Misregistration()))
    return np.asarray(matrix * (ours / np.linalg.norm(matrix)))


def noise(share: float = 0.3, n_seeds: int = 20) -> Iterator[str]:
    """Yield errors over σ of two stars, three mirrors, from noisy matrices of the model, finer."""
    with tempfile.TemporaryDirectory() as name:
        system = morfeo(Path(name), every=3, n_subapertures=8)
        free = np.array([one.free for one in system.parameters])
        unit = np.array([one.subap for one in system.parameters])[free]
        pulls, errors, left, local, accepted = [], [], [], [], 0
        for seed in range(n_seeds):
            rng = np.random.default_rng(seed)
            values = _drawn(system, rng, 0.1)
            report = _report(system, dict(_measured(system, values, share, rng)))
            accepted += report.accepted
            true = system.alphas(values)
            for fitted, alpha in zip(report.fits, true, strict=True):
                off = fitted.fit.alpha.vector - alpha
                local.append(off @ np.linalg.solve(fitted.fit.covariance, off) / 4)
            if report.found is None:
                continue
            off = (report.found.values - values)[free] / unit
            covariance = report.found.covariance[np.ix_(free, free)] / np.outer(unit, unit)
            pulls.append(off @ np.linalg.solve(covariance, off) / len(off))
            errors.append((report.found.values - values)[free])
            left.append(report.found.chi2 / report.found.n_free)
        yield (
            f"{len(system.pairs)} pairs, noise {share:g} of a column's RMS, {n_seeds} seeds: "
            f"{accepted} accepted; mean χ² of errors over their number: α of pairs "
            f"{np.mean(local):.2f}, sensors and mirrors {np.mean(pulls):.2f} "
            f"({np.min(pulls):.2f} to {np.max(pulls):.2f}); what pairs leave over expected "
            f"{np.mean(left):.2f}"
        )
        rms = np.sqrt(np.mean(np.square(errors), axis=0))
        for k, size in zip(np.flatnonzero(free), rms, strict=True):
            one = system.parameters[k]
            if one.owner in {"lgs1", "dm2", "dm3"}:
                sigma = report.found.sigma[k] if report.found is not None else np.nan
                yield (
                    f"    {one.owner} {one.name}: RMS error {size * one.boundary:.5f}, "
                    f"1 σ {sigma * one.boundary:.5f}"
                )


def _measured(
    system: System, values: Array, share: float, rng: np.random.Generator
) -> Iterator[tuple[Pair, Array]]:
    """Yield the matrix of each pair: six points a subaperture, the fits have three."""
    there = system.at(values)
    for pair in system.pairs:
        shift = values[system.of_sensor(pair.sensor)][SHIFTS]
        about = replace(there.instrument(pair), pupil_shift_subap=(shift[0], shift[1]))
        model = RtcInteractionModel(about, there.basis(pair), pupil_sampling=6, detector_nodes=6)
        matrix = np.asarray(model.interaction_matrix(Misregistration()), dtype=np.float64)
        size = np.sqrt(np.mean(matrix[:, system.lit(pair)] ** 2))
        yield pair, matrix + share * size * rng.normal(size=matrix.shape)


STEPS: dict[str, Callable[[], Iterator[str]]] = {
    "geometry": geometry,
    "matrices": matrices,
    "noise": noise,
}


def main() -> None:
    """Print what each step finds."""
    parser = study_parser("pyrcal_studies.systems", __doc__)
    parser.add_argument("steps", nargs="*", choices=[[], *STEPS], metavar="STEP")
    for name in parser.parse_args().steps or STEPS:
        print(f"--- {name}", flush=True)
        for line in STEPS[name]():
            print(line, flush=True)


if __name__ == "__main__":
    main()
