"""``pyrcal twin``: fit a bench's files, and write report, instrument and other codes' models."""

from __future__ import annotations

import argparse
import contextlib
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from pyrcal.fitting.advice import read_entries
from pyrcal.fitting.alternatives import PLAUSIBLE_DISPLACEMENT_PX
from pyrcal.fitting.comparison import MIN_EXPLAINED, Alternative
from pyrcal.fitting.fit_file import Progress, fit_file
from pyrcal.fitting.fit_table import NOTABLE_DISPLACEMENT_PX
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.instrument_checks import UNKNOWN_ABERRATION
from pyrcal.fitting.matrix import FitOptions
from pyrcal.fitting.models import FAMILIES
from pyrcal.fitting.report import fill_fit, orientation_words
from pyrcal.importers.imported import UNKNOWN, Imported, Tables
from pyrcal.terminal import show_progress
from pyrcal.twins.bench import Bench, read_bench
from pyrcal.twins.check import check_oopao_model, check_specula_model
from pyrcal.twins.oopao_model import write_oopao_model
from pyrcal.twins.report import Twin, list_lines, write_report
from pyrcal.twins.sampled import Actuators, list_adopted, sample_bench
from pyrcal.twins.specula_model import write_specula_model
from service.errors import ConfigurationError, PyrcalError, StorageError
from service.files import parse_modes
from service.files.container import DATASET
from service.files.disk_cache import cached_basis
from service.files.toml import read_dataset
from service.files.whole import write_whole
from service.instrument import load_instrument
from service.instrument.paths import TWIN_FILE, TWIN_FIT, TWIN_LIVE_FILE
from service.model.instrument import instrument_sha256
from sim_rtc.rehearsal import write_live_instrument

ACCEPTED, REFUSED = 0, 1

STATED: Mapping[str, Any] = {
    **dict.fromkeys(("instrument", "unit", "basis", "diameter_m", "modes", "sensor")),
    **dict.fromkeys(("obscuration", "wavelength_m", "modulation", "pupil_subap")),
    "pixels_per_subap": None,
    "stop": "telescope",
}
"""Values that files may lack, named as the options of ``pyrcal twin``, with their defaults."""

MAX_SHARE, MIN_SIGNIFICANCE = 0.9, 2.0
"""Another value of a number is tried if it leaves less than this share of the power that is left
over, by more than so many σ. A fit with it decides."""

HARDLY_MORE_LEFT = 1.01
"""Residual over that of the file's values up to which corrected values are kept: the entries of the
file are rounded, and numbers that were free are fixed."""

MAX_CORRECTIONS = 3
"""Number of times that a file is corrected and fitted again."""

MUCH_LEFT = 0.1
"""Residual above which the pupil images of a simulation may be elsewhere: with 10 % noise 0.05 is
left over."""

EXACT = 0.01
"""Residual below which no other model is tried."""


def main(options: argparse.Namespace) -> int:
    """Make the twin, print its report, and return the exit status.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used; nothing is left behind.
    """
    made = _make(options, show_progress)
    print("\n".join(list_lines(made)))
    return ACCEPTED if made.report.fit.accepted else REFUSED


def twin(
    files: str | Path | Iterable[str | Path] | Mapping[str, str | Path],
    output: str | Path,
    *,
    check: bool = False,
    python: str | Path | None = None,
    threads: int = 2,
    **stated: Any,  # noqa: ANN401 - as different as the options
) -> Twin:
    """Fit the model of a bench to its files, and write it for pyrcal, OOPAO and SPECULA.

    Parameters
    ----------
    files
        Folder, file, several of them, or files by role: matrix, valid, light, modes,
        mode_to_actuator, positions, pupil, sky_pupil, spot.
    output
        Folder to write: a new one, or that of an earlier twin, which is replaced.
    check
        Whether OOPAO and SPECULA, where installed, measure the matrices of their models.
    python
        Interpreter that has them; None for the present one.
    threads
        Threads that share the work.
    stated
        Values that the files lack, named as the options of ``pyrcal twin``: ``diameter_m``,
        ``unit``, ``wavelength_m``, ``modulation``, ``pupil_subap``, ``modes``, ``instrument``.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used; nothing is left behind.

    Examples
    --------
    >>> made = pyrcal.twin("bench", "twin", diameter_m=0.6, unit="m")  # doctest: +SKIP
    >>> made.report.fit.alpha, made.folder / "twin.html"  # doctest: +SKIP
    """
    if unknown := stated.keys() - STATED.keys():
        raise TypeError(f"twin: found {min(unknown)}, expected one of {', '.join(STATED)}")
    given: Iterable[tuple[str | None, str | Path]]
    if isinstance(files, Mapping):
        given = files.items()
    else:
        given = ((None, one) for one in ([files] if isinstance(files, str | Path) else files))
    if isinstance(modes := stated.get("modes"), str):
        stated["modes"] = parse_modes(modes)
    paths = [(role, Path(path)) for role, path in given]
    task = {"output": Path(output), "check": check, "threads": threads}
    python = None if python is None else Path(python)
    return _make(argparse.Namespace(**{**STATED, **stated}, **task, files=paths, python=python))


def _make(options: argparse.Namespace, progress: Progress | None = None) -> Twin:
    """Write the twin into a temporary folder, and move it to its place when it is complete."""
    output, python = options.output, options.python and options.python.absolute()
    _check_output(output)
    if python is not None and not python.is_file():
        raise ConfigurationError(f"--python: found no file {python}, expected a Python interpreter")
    bench = read_bench(options)
    try:
        with tempfile.TemporaryDirectory(dir=output.absolute().parent, prefix=".twin-") as name:
            draft = Path(name) / "twin"
            made = _fit_bench(bench, partial(_fit, bench, draft, options.threads, progress))
            # A second thread of BLAS waits in a loop for the first one: it only costs time.
            with threadpool_limits(1):
                made = _export(made, check=options.check, python=python)
            write_report(made)
            if output.is_dir():
                shutil.rmtree(output)
            draft.replace(output)
    except OSError as error:
        raise StorageError(f"{output}: cannot be written: {error}") from error
    exported = tuple(replace(one, path=output / one.path.name) for one in made.exported)
    return replace(made, folder=output, exported=exported)


def _check_output(output: Path) -> None:
    """Refuse a place where something other than an earlier twin would be replaced."""
    if not output.absolute().parent.is_dir():
        raise ConfigurationError(
            f"{output}: found no folder {output.absolute().parent}, expected it to exist"
        )
    is_twin = (output / "twin.json").is_file()
    if output.exists() and not is_twin and not (output.is_dir() and not any(output.iterdir())):
        raise ConfigurationError(
            f"{output}: found other files, expected a new folder or an earlier twin"
        )


def _fit_bench(bench: Bench, fit_import: Callable[[Imported], Twin]) -> Twin:
    """Return the fit of the bench, with the instrument file corrected, and write both."""
    best = _correct_file(_choose_import(bench, fit_import), fit_import)
    for other in bench.imported[1:-1]:
        if best.residual < MUCH_LEFT:
            break
        # With its corrections, because other optics make up for images in wrong places at first.
        with contextlib.suppress(PyrcalError):
            made = _correct_file(fit_import(other), fit_import)
            best = made if made.residual < best.residual else best
    best = replace(best, imported=_correct(best.imported, best.report.fit, _list_found(best)))
    saved = best.imported.save(best.folder)
    # The fit belongs to the instrument file that is written, which has what it found.
    digest = instrument_sha256(load_instrument(saved.instrument))
    report = replace(best.report, instrument_sha256=digest)
    write_whole(best.folder / TWIN_FIT, partial(fill_fit, report=report))
    _write_live(best)
    return best


def _correct_file(best: Twin, fit_import: Callable[[Imported], Twin]) -> Twin:
    """Return the best fit of an import with what its fits correct of the instrument file."""
    number = _find_number(best.report.fit)
    corrections = best.report.fit.corrections if number is None else read_entries([number.key])
    for _ in range(MAX_CORRECTIONS):
        if not corrections:
            break
        # The axes of the slopes are as the fit has found them; other values move it.
        again = fit_import(_correct(best.imported, best.report.fit, corrections))
        share = HARDLY_MORE_LEFT if number is None else MAX_SHARE**0.5
        if not _is_better(again, than=best, share=share):
            break
        best, number = replace(again, before=best.report), None
        # A value that was made unknown has been fitted, and is now written.
        corrections = again.report.fit.corrections if UNKNOWN in corrections.values() else {}
    return best


def _choose_import(bench: Bench, fit_import: Callable[[Imported], Twin]) -> Twin:
    """Return the fit of the import whose model leaves least."""
    *grids, usual = bench.imported
    simulated = None
    # The files may allow a grid that the bench does not have.
    with contextlib.suppress(PyrcalError):
        simulated = fit_import(grids[0]) if grids else None
    if simulated is None:
        return fit_import(usual)
    if simulated.residual < EXACT:
        return simulated
    with contextlib.suppress(PyrcalError):
        made = fit_import(usual)
        if made.residual**2 - simulated.residual**2 <= MIN_EXPLAINED**2:
            return made
    return simulated


def _fit(
    bench: Bench, folder: Path, threads: int, progress: Progress | None, imported: Imported
) -> Twin:
    saved = imported.save(folder)
    instrument = load_instrument(saved.instrument)
    report = fit_file(instrument, saved.matrix, FitOptions(), threads=threads, progress=progress)
    # The folder is moved to its place later.
    remarks, notes = (
        tuple(one.replace(f"{folder}/", "") for one in some)
        for some in (report.fit.remarks, report.notes)
    )
    report = replace(report, fit=replace(report.fit, remarks=remarks), notes=notes)
    return Twin(folder=folder, bench=bench, imported=imported, instrument=instrument, report=report)


def _is_better(again: Twin, *, than: Twin, share: float) -> bool:
    """Return True if the fit with a corrected file alone is accepted, or leaves little enough.

    ``share`` is the largest ratio of the residuals.
    """
    if again.report.fit.accepted != than.report.fit.accepted:
        return again.report.fit.accepted
    return again.residual < max(share * than.residual, EXACT)


def _find_number(fit: Fit) -> Alternative | None:
    """Return the number of the instrument file that explains most of what an accepted fit leaves.

    None if there is none. A fit does not need it; the model of a bench is closer with it.
    """
    found = [
        one
        for one in fit.alternatives
        if fit.accepted
        and one.is_number
        and "=" in one.key
        # the first step says little of a large aberration
        and (one.misfit < MAX_SHARE or one.key == UNKNOWN_ABERRATION)
        and one.significance > MIN_SIGNIFICANCE
    ]
    return min(found, key=lambda one: one.misfit, default=None)


def _list_found(made: Twin) -> Mapping[str, Any]:
    """Return the fitted optical numbers that the twin adopts, by table and key.

    The twin is the model that reproduces the matrix. It therefore has the fitted value where the
    files have none or a notably different one.
    """
    fit = made.report.fit
    found = [f"{key} = {value:.4g}" for key, value in list_adopted(fit).items() if key]
    found += [one.entry for one in fit.origins if one.key in FAMILIES]
    return read_entries(found)


def _correct(imported: Imported, fit: Fit, values: Mapping[str, Any]) -> Imported:
    """Return the import with these values, and with the slopes' axes that the fit has found."""
    corrected = {name: dict(table) for name, table in imported.tables.items()}
    for place, value in values.items():
        table, key = place.split(".")
        if place == "instrument.pupil":
            continue  # words on how the map is to be turned
        corrected.setdefault(table, {})[key] = value
        if value is None:
            del corrected[table][key]
    if isinstance(corrected["wfs"].get("modulation_ellipse"), dict):
        corrected["wfs"].pop("modulation_lambda_over_d", None)
    if fit.accepted and "slopes" in corrected:
        words = orientation_words(fit.orientation, fit.order)
        order = words.pop("order")
        corrected["slopes"]["orientation"] = words
        if "order" in corrected["slopes"]:
            corrected["slopes"]["order"] = order
    known = {f"{place.partition('.')[2]} is unknown" for place in values}
    notes = tuple(note for note in imported.notes if note not in known)
    return replace(imported, tables=corrected, notes=notes)


@contextlib.contextmanager
def _draft(made: Twin, tables: Tables) -> Iterator[Path]:
    """Write an instrument file of other tables beside the twin's; it is removed after use."""
    path = made.folder / f"draft-{TWIN_FILE}"
    path.write_text(replace(made.imported, tables=tables).instrument_text(), encoding="utf-8")
    yield path
    path.unlink()


def _write_live(made: Twin) -> None:
    """Write the instrument file of ``pyrcal run``: an RTC sends slopes, not frames."""
    folder, live = made.folder, made.folder / TWIN_LIVE_FILE
    with _draft(made, _describe_live(made.imported.tables, made.report.fit)) as draft:
        write_live_instrument(draft, live)
    # It refers to arrays by absolute paths, in a folder that is moved to its place later.
    text = live.read_text(encoding="utf-8").replace(f"{folder}/", "").replace("draft-", "")
    live.write_text(text, encoding="utf-8")


def _describe_live(tables: Tables, fit: Fit) -> Tables:
    """Return the tables with fitted values that frames show and slopes do not.

    These are the places of the pupil images, and the rotation from which the service begins.
    """
    wfs, mirror = dict(tables["wfs"]), dict(tables["mirror"])
    places, centres = fit.image_offsets_px, wfs.get("pupil_centres_px", "auto")
    if not isinstance(centres, str):
        ordered = np.sort(np.array(centres), axis=0)
        apart_px = float(np.mean(ordered[2:] - ordered[:2]))
        wfs["pupil_separation_subap"] = apart_px / wfs.get("pixels_per_subaperture", 1)
    if places is not None and (
        NOTABLE_DISPLACEMENT_PX < abs(places).max() < PLAUSIBLE_DISPLACEMENT_PX
    ):
        wfs["image_offsets_px"] = places.round(3).tolist()
    if fit.accepted:
        mirror["nominal_rotation_deg"] = round(fit.alpha.to_boundary()["rotation_deg"], 3)
    return {**tables, "wfs": wfs, "mirror": mirror}


def _read_actuators(made: Twin) -> Actuators | None:
    """Return the actuators whose influence functions are given; None if there are no functions.

    The model of the fit only keeps the modes: the functions are read as a zonal mirror.
    """
    tables = made.imported.tables
    mirror = dict(tables["mirror"])
    if "influence_functions" not in mirror:
        return None
    reference = mirror.pop("mode_to_actuator", None)
    with _draft(made, {**tables, "mirror": {**mirror, "basis": "zonal"}}) as draft:
        zonal = load_instrument(draft).mirror
    # The optics are those of the fit: the tables may have corrected ones.
    functions = cached_basis(replace(made.instrument, mirror=zonal))
    if reference is None:
        return functions, np.eye(functions.n_modes)
    strokes = read_dataset(reference, made.folder, "mirror.mode_to_actuator").astype(np.float64)
    strokes[:, made.instrument.mirror.flat_modes] = 0.0  # modes that the model does not use
    return functions, strokes


def _export(made: Twin, *, check: bool, python: Path | None) -> Twin:
    """Write the models of other programs, and let these run them if requested."""
    about, fit, folder = made.instrument, made.report.fit, made.folder
    if about.wfs.kind != "pyramid":
        return replace(made, checks=("Only benches with a pyramid are exported.",))
    shape = made.imported.arrays[DATASET].shape
    frame_shape = (shape[1], shape[2]) if about.frames is not None else None
    sampled = sample_bench(about, fit, frame_shape, _read_actuators(made))
    exported = (
        write_oopao_model(sampled, folder, made.bench.sky_pupil),
        write_specula_model(sampled, fit, folder),
    )
    runs = (check_oopao_model, check_specula_model) if check else ()
    checks = tuple(str(run(folder, about, fit, python=python)) for run in runs)
    return replace(made, exported=exported, checks=checks)
