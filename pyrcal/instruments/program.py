"""``pyrcal instrument new | check | show``."""

from __future__ import annotations

import argparse

from pyrcal.instruments.drawing import write_drawing
from pyrcal.instruments.implied import derive_properties, describe_properties
from pyrcal.instruments.template import make_template
from pyrcal.terminal import print_lines
from service.errors import ConfigurationError, ModelError, StorageError
from service.instrument import load_instrument
from service.model.sensors.registry import KINDS

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
    return USABLE
