"""``pyrcal fit``: fit the registration of a matrix in a file, and print a verdict."""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

from pyrcal.fitting.figures import check_plots, write_sheet
from pyrcal.fitting.fit_file import fit_file
from pyrcal.fitting.fit_table import table
from pyrcal.fitting.light import SeenLight, read_light
from pyrcal.fitting.light_rotation import Arms
from pyrcal.fitting.matrix import FitOptions
from pyrcal.fitting.report import document, fill_fit
from pyrcal.terminal import show_progress
from service.errors import ConfigurationError, say
from service.files.documents import json_text
from service.files.whole import write_whole
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.kinds import Method

ACCEPTED, REFUSED = 0, 1


def main(options: argparse.Namespace) -> int:
    """Fit, print the result, and return the exit status.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used.
    """
    if options.plot is not None:
        check_plots()
    instrument = load_instrument(options.instrument)
    light = _light(options, instrument)
    fit_options = FitOptions(
        method=Method(options.method),
        modes=options.modes,
        start=options.start,
        gain_map=options.gain_map,
        gain=options.gain,
        anamorphosis=not options.no_anamorphosis,
        illumination=None if light is None else light.illumination,
    )
    report = fit_file(
        instrument,
        options.reference,
        fit_options,
        dataset=options.dataset,
        threads=options.threads,
        memory_gb=options.memory_gb,
        progress=show_progress,
    )
    if light is not None:
        report = replace(report, notes=(*report.notes, light.note))
    if options.json:
        print(json_text(document(report)))
        for note in report.notes:
            say(f"note: {note}")
    else:
        print(table(report))
    if options.output is not None:
        write_whole(options.output, partial(fill_fit, report=report))
    if options.plot is not None:
        heading = f"{report.instrument}: {report.reference}"
        write_sheet(report.fit, heading, instrument, options.plot)
    return ACCEPTED if report.fit.accepted else REFUSED


def _light(options: argparse.Namespace, instrument: Instrument) -> SeenLight | None:
    reference: Path | Arms | None = options.flux_reference or options.arms
    if options.flux_map is not None:
        return read_light(options.flux_map, instrument, reference)
    if reference is not None:
        raise ConfigurationError(
            "found a reference for the light and no light, expected --flux-map as well"
        )
    return None
