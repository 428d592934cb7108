"""``pyrcal fit``: from a measured interaction matrix on disk to a registration and a verdict."""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path

from service.archive.product import write_whole
from service.commands.terminal import check_folder, parsed_by, say, show_progress
from service.config import load_instrument
from service.errors import ConfigurationError
from service.files.figures.sheet import check_plots, write_sheet
from service.files.light import Light, read_light
from service.files.product import fill_fit
from service.files.recorded import DATASET
from service.files.report import document
from service.files.request import parse_alpha, parse_arms, parse_count, parse_modes
from service.files.run import fit_file
from service.files.table import table
from service.fit.options import FitOptions, Method
from service.fit.turned_light import Arms
from service.model.instrument import Instrument

ACCEPTED, REFUSED = 0, 1

_DESCRIPTION = """
Find where the mirror lies on the sensor from a measured interaction matrix: shift, rotation and
magnification with 1 sigma, the gain of every mode, what is left over, and whether to believe it.
"""

_EPILOG = f"""
REFERENCE holds (n_slopes, n_modes), slope per metre of OPD, in the RTC's own order and axes, as
the array {DATASET!r} or the one that --dataset names. What is printed on standard output is the
answer; progress goes to standard error. Exit status: 0 accepted, 1 fitted but refused (the verdict
says why), 2 input that cannot be used. docs/fitting.md explains format, orientation and verdicts.
"""


def add_fit_arguments(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declare ``pyrcal fit``; ``commands`` is argparse's collection of sub-commands."""
    fit = commands.add_parser(
        "fit",
        help="the registration in a measured interaction matrix",
        description=_DESCRIPTION,
        epilog=_EPILOG,
    )
    fit.add_argument("instrument", metavar="INSTRUMENT", help="TOML file, or a packaged name")
    fit.add_argument("reference", metavar="REFERENCE", type=Path, help="HDF5 or FITS file")
    fit.add_argument("--dataset", metavar="NAME", help=f"of the matrix, default {DATASET}")
    fit.add_argument(
        "--method",
        type=Method,
        choices=list(Method),
        default=Method.JOINT,
        help="joint: all four together (default); paper: one at a time, with parabolas; "
        "sensitivity: projection on sensitivity matrices",
    )
    fit.add_argument(
        "--modes",
        type=parsed_by(parse_modes),
        metavar="FIRST:END",
        help="basis indices to use, like 0:400 (400 is not) or 3,5,9; default all",
    )
    fit.add_argument(
        "--start",
        type=parsed_by(parse_alpha),
        metavar="X,Y,ROT,MAG",
        help="where to begin: subapertures, degrees, ratio",
    )
    fit.add_argument(
        "--flux-map",
        type=Path,
        metavar="FILE",
        help="mean counts of the four pupil images, array flux (4, n, n): the model is lit as it "
        "says",
    )
    turned = fit.add_mutually_exclusive_group()
    turned.add_argument(
        "--flux-reference",
        type=Path,
        metavar="FILE",
        help="a flux map of another day: by how much the light is turned since is told",
    )
    turned.add_argument(
        "--arms",
        type=parsed_by(parse_arms),
        metavar="WIDTH:DEG,DEG...",
        help="the spider's arms at rotation 0: the rotation is told that their shadows in the "
        "flux map have",
    )
    fit.add_argument("--gain-map", action="store_true", help="fit a gain over the pupil, too")
    fit.add_argument("--anamorphosis", action="store_true", help="fit a stretched image, too")
    fit.add_argument("--json", action="store_true", help="print one JSON object, not a table")
    fit.add_argument("--plot", type=Path, metavar="FILE.png", help="write the paper's figures")
    fit.add_argument("--output", type=Path, metavar="FILE.h5", help="write all that was found")
    fit.add_argument(
        "--threads",
        type=parsed_by(parse_count),
        default=os.cpu_count() or 1,
        metavar="N",
        help="default: one for every core",
    )


def run_fit(options: argparse.Namespace) -> int:
    """Fit, say what was found, and return the exit status.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used.
    """
    if options.plot is not None:
        check_plots()
    for path in (options.plot, options.output):
        check_folder(path)
    instrument = load_instrument(options.instrument)
    light = _light(options, instrument)
    asked = FitOptions(
        method=options.method,
        modes=options.modes,
        start=options.start,
        gain_map=options.gain_map,
        anamorphosis=options.anamorphosis,
        illumination=None if light is None else light.illumination,
    )
    report = fit_file(
        instrument,
        options.reference,
        asked,
        dataset=options.dataset,
        threads=options.threads,
        progress=show_progress,
    )
    if light is not None:
        report = replace(report, notes=(*report.notes, light.note))
    if options.json:
        print(json.dumps(document(report), allow_nan=False))
        for note in report.notes:
            say(f"note: {note}")
    else:
        print(table(report))
    if options.output is not None:
        write_whole(options.output, partial(fill_fit, report=report))
    if options.plot is not None:
        write_sheet(report, instrument, options.plot)
    return ACCEPTED if report.fit.accepted else REFUSED


def _light(options: argparse.Namespace, instrument: Instrument) -> Light | None:
    reference: Path | Arms | None = options.flux_reference or options.arms
    if options.flux_map is not None:
        return read_light(options.flux_map, instrument, reference)
    if reference is not None:
        raise ConfigurationError(
            "found a reference for the light and no light, expected --flux-map beside it"
        )
    return None
