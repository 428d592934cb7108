"""``pyrcal instrument``: write a commented file with every key, check a file, draw it."""

from __future__ import annotations

import argparse
import json
import textwrap
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pyrcal.fitting.figures import map_to_sensor, mirror_outline, new_figure, save_figure
from pyrcal.fitting.light import FLUX
from pyrcal.instruments.schema_texts import KeyText, TableText, tables_of
from pyrcal.terminal import print_lines, span
from service.control.reconstructor import MAX_CONDITION, invert
from service.errors import ConfigurationError, MatrixError, ModelError, StorageError
from service.files.container import opened
from service.instrument import load_instrument
from service.instrument.schema import whole_of
from service.model.instrument import Instrument
from service.model.interaction import RtcInteractionModel
from service.model.kinds import SignalKind
from service.model.memory import GB, work_of
from service.model.modes import modal_basis
from service.model.pupil import instrument_pupil, rtc_valid_subapertures, valid_subapertures
from service.model.sensors.kind import SensorKind
from service.model.sensors.registry import KINDS, kind_of
from service.model.sensors.sensor import CannotTell, Fineness

EXAMPLES: Mapping[str, Mapping[str, object]] = {
    "[instrument]": {"name": "bench", "diameter_m": 8.0, "stop": "telescope"},
    "[wfs]": {"n_subapertures": 20, "wavelength_m": 750e-9, "modulation_lambda_over_d": 3.0},
    "[mirror]": {"layout": "grid", "n_across": 21, "pitch_m": 0.4, "diameter_m": 8.6},
}
"""Example values of the required keys, and of the template's mirror."""

_WIDTH = 98

_HEAD = """
An instrument file of pyrcal: every key, what it means, and its default. A key behind # is not set:
take the # away to set it. Files of data are named "path:/dataset", relative to this file. Then:
pyrcal instrument check FILE, pyrcal instrument show FILE PICTURE.png
"""


def make_template(kind: SensorKind) -> str:
    """Return a valid instrument file for a kind of sensor, as a template."""
    lines = [*_comment(_HEAD)]
    for table in tables_of(whole_of(kind)):
        examples = dict(EXAMPLES.get(table.header, {}))
        if table.header == "[wfs]":
            examples["kind"] = kind.name
        lines += ["", *_table(table, examples)]
    return "\n".join(lines) + "\n"


def _table(table: TableText, examples: Mapping[str, object]) -> Iterator[str]:
    """Yield a table; an optional nested table is commented out."""
    # A nested table is optional: as a comment it does not make the template an instrument
    # with such a part.
    inner = "." in table.header
    yield from _comment(table.about)
    yield f"{'#' if inner else ''}{table.header}"
    for key in table.keys:
        yield from _comment(_describe_key(key))
        value = examples.get(key.name, key.default)
        unset = "#" if inner or key.name not in examples else ""
        yield f"{unset}{key.name} = {'' if value is None else json.dumps(value)}".rstrip()


def _describe_key(key: KeyText) -> str:
    type_words = f"({key.type}; needed)" if key.needed else f"({key.type})"
    return f"{key.meaning} {type_words}".strip()


def _comment(text: str) -> Iterator[str]:
    for line in textwrap.wrap(" ".join(text.replace("`", "").split()), _WIDTH - 2):
        yield f"# {line}"


SAMPLING = NODES = 3
"""Pupil points per subaperture, and detector nodes, of the model; the same as in a fit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Implied:
    """Derived properties of an instrument, with those of its matrix if it was computed."""

    n_valid: int
    """Valid subapertures."""

    n_slopes: int
    n_modes: int
    expected_gb: float
    """Expected peak memory of the matrix and its derivatives, program included, GB."""

    seconds: float | None = None
    """Computing time of modes and matrix, seconds; None if they were not computed."""

    condition_number: float | None = None
    """Condition number of the whole matrix at the nominal registration; None if it was not computed
    or has more modes than slopes."""

    n_weak: int = 0
    """Number of singular values that a reconstructor truncates."""


def derive_properties(instrument: Instrument, most_gb: float) -> Implied:
    """Return the properties; the matrix is computed if it needs at most ``most_gb`` of memory.

    Raises
    ------
    ModelError
        If the model cannot work with it.
    """
    pupil = instrument_pupil(instrument, SAMPLING * instrument.binning)
    fineness = Fineness(n_nodes=NODES * instrument.binning)
    sensor = kind_of(instrument).sensor(instrument, pupil, fineness)
    n_valid = int(rtc_valid_subapertures(instrument).sum())
    known = Implied(
        n_valid=n_valid,
        n_slopes=sensor.n_signals,
        n_modes=instrument.modes.n_modes,
        expected_gb=work_of(instrument, sensor, pupil).memory_bytes / GB,
    )
    # The size of an ELT's matrix is reported instead of being tried.
    return known if known.expected_gb > most_gb else _compute_matrix(instrument, known)


def _compute_matrix(instrument: Instrument, known: Implied) -> Implied:
    begun = time.perf_counter()
    model = RtcInteractionModel(
        instrument, modal_basis(instrument), pupil_sampling=SAMPLING, detector_nodes=NODES
    )
    matrix = model.interaction_matrix(instrument.start)
    seconds = time.perf_counter() - begun
    # An underdetermined matrix has no condition that a reconstructor could use.
    if known.n_modes > known.n_slopes:
        return replace(known, seconds=seconds)
    inversion = invert(matrix, known.n_modes, max_condition=MAX_CONDITION)
    return replace(
        known,
        seconds=seconds,
        condition_number=inversion.condition_number,
        n_weak=inversion.n_truncated,
    )


def describe_properties(instrument: Instrument, found: Implied) -> tuple[str, ...]:
    """Return it in lines for a person."""
    n, kind = instrument.wfs.n_subapertures, instrument.wfs.kind
    signals = "slopes" if instrument.slopes.kind is SignalKind.XY else "pixels"
    megabytes = 4.0 * found.n_slopes * found.n_modes / 1e6
    lines = [
        f"sensor      {kind}, {n} by {n} subapertures, {found.n_valid} of them valid: "
        f"{found.n_slopes} {signals}",
        f"modes       {found.n_modes}",
        f"matrix      {megabytes:.2g} MB; a fit takes {found.expected_gb:.2g} GB at most",
    ]
    if found.seconds is None:
        return (*lines, "condition   not computed: --memory-gb allows more")
    if found.condition_number is None:
        lines.append("condition   none: there are more modes than slopes, so not all can be seen")
    else:
        lines.append(
            f"condition   {found.condition_number:.3g} of all modes where the mirror belongs; "
            f"{found.n_weak} of them are too weak for a reconstructor of condition "
            f"{MAX_CONDITION:g}"
        )
    return (*lines, f"time        {span(found.seconds)} for modes and matrix")


_POINTS = 6
"""Number of pupil points per subaperture."""

_SENSOR, _MIRROR = "tab:blue", "tab:red"


def write_drawing(instrument: Instrument, path: Path) -> None:
    """Write the picture as an image of the kind the file's name says.

    Raises
    ------
    ConfigurationError
        If matplotlib is not installed, or the file cannot be written.
    """
    figure = new_figure(8.0, 8.4, "a picture")
    from matplotlib.collections import PolyCollection

    axes = figure.subplots()
    pupil = instrument_pupil(instrument, _POINTS)
    half = len(pupil.coordinates) / 2 / pupil.sampling
    extent = (-half, half, -half, half)
    axes.imshow(pupil.amplitude, origin="lower", extent=extent, cmap="Greys", vmin=0.0, vmax=3.0)
    valid = valid_subapertures(instrument)
    corners = np.argwhere(valid)[:, ::-1] - len(valid) / 2
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    axes.add_collection(
        PolyCollection(
            corners[:, None] + square, facecolor="none", edgecolor=_SENSOR, linewidth=0.6
        )
    )
    points, style = mirror_outline(instrument)
    here = map_to_sensor(points, instrument.start)
    axes.plot(here[:, 0], here[:, 1], style, color=_MIRROR, markersize=5.0, linewidth=1.0)
    # The mirror may be larger than the pupil, and must be seen whole.
    reach = 1.05 * max(half, float(np.abs(here).max()))
    axes.set(
        title=f"{instrument.name}: pupil (grey), valid subapertures (blue), mirror (red)",
        xlabel="x, subapertures",
        ylabel="y, subapertures",
        xlim=(-reach, reach),
        ylim=(-reach, reach),
        aspect="equal",
    )
    save_figure(figure, path)


USABLE, WRONG = 0, 1


def main(options: argparse.Namespace) -> int:
    """Run the command on an instrument file; return the exit status.

    Raises
    ------
    PyrcalError
        If a file cannot be read or written.
    """
    match options.action:
        case "new":
            return _new(options)
        case "check":
            return _check(options)
        case _:
            write_drawing(load_instrument(options.instrument), options.picture)
            print_lines([f"{options.picture}: drawn"])
            return USABLE


def _new(options: argparse.Namespace) -> int:
    try:
        # Mode x: a file that was edited is not overwritten.
        with options.file.open("x", encoding="utf-8") as file:
            file.write(make_template(KINDS[options.kind]))
    except OSError as error:
        raise StorageError(f"{options.file}: cannot be written: {error.strerror}") from error
    print_lines([f"{options.file}: written; next: pyrcal instrument check {options.file}"])
    return USABLE


def _check(options: argparse.Namespace) -> int:
    try:
        instrument = load_instrument(options.instrument)
        found = derive_properties(instrument, options.memory_gb)
    except ConfigurationError as error:
        print_lines(error.problems)
        return WRONG
    except ModelError as error:
        print_lines([f"{options.instrument}: {error}"])
        return WRONG
    print_lines([f"{options.instrument}: {instrument.name}"])
    print_lines(describe_properties(instrument, found))
    print_lines(f"note: {remark}" for remark in instrument.remarks)
    if options.light is not None:
        print_lines([find_image_offsets(instrument, options.light)])
    return USABLE


def find_image_offsets(instrument: Instrument, path: Path) -> str:
    """Return the line of the instrument file with the places of the pupil images in their light.

    The file has the mean light in the axes of the RTC: a frame of one pixel for each subaperture,
    or images ``(4, n, n)`` as in a status; as ``flux``, or as its only array.

    Raises
    ------
    MatrixError
        If it has no such light.
    ModelError
        If the light does not show the places.
    """
    as_listed = replace(instrument, slopes=replace(instrument.slopes, orientation=None))
    with opened(path) as container:
        only = FLUX if len(container.arrays) != 1 else next(iter(container.arrays))
        if (stored := container.find(only)) is None:
            raise MatrixError(f"{path}: no dataset {FLUX}; it holds {container.listing()}")
        found = kind_of(instrument).measure_image_offsets(as_listed, stored.numbers())
    if isinstance(found, CannotTell):
        raise ModelError(f"{path}: {found.reason}")
    places = ", ".join(f"[{x:.3f}, {y:.3f}]" for x, y in found * instrument.binning)
    return f"image_offsets_px = [{places}]  # add this line to [wfs] of the instrument file"
