"""Run of ``pyrcal check-rtc``: find the RTC, make the checks, print the results."""

from __future__ import annotations

import argparse
import functools
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from check_rtc.client import RtcClient
from check_rtc.connection import RtcConnection, find_systems_with_rtc
from check_rtc.examine import Examination, examine
from check_rtc.offload import RegistrationFit
from check_rtc.requirements import REQUIREMENTS, CheckResult, Outcome
from check_rtc.telemetry_checks import ImageOffsets
from check_rtc.watch import TelemetryObserver
from service.config.link_tables import ZenohTable, link_security, read_link_tables
from service.errors import ConfigurationError, LinkError, ModelError, say, shown
from service.estimation.lockin import Spectra
from service.estimation.slope_convention import SlopeConvention, identify_from_reconstructor
from service.estimation.windows import ClosedLoop
from service.files.disk_cache import DiskCache, usual_folder
from service.instrument import load_instrument, packaged_instrument
from service.link.session import Endpoint
from service.model.instrument import Instrument
from service.model.interaction import RtcInteractionModel
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import CannotTell
from service.model.slopes import likely_kind
from service.records.estimates import LockInEstimate, WindowRefused

if TYPE_CHECKING:
    from service.runtime.worker import OpticsWorker

EXIT_OK, EXIT_WRONG = 0, 1

CONTRACT_PAGE = "docs/rtc.md"

DEFAULT_INSTRUMENT = "flao-lbt"
"""Instrument of the RTC if neither an instrument nor a system is given."""

NO_INSTRUMENT_HINT = "slopes and commands are not compared; give its file with --instrument"


def check(options: argparse.Namespace) -> int:
    """Make the checks and print them; return 0 if nothing is wrong, 1 if something is.

    Raises
    ------
    PyrcalError
        If nothing can be checked: no RTC, no link, or contradictory options.
    """
    unknown = [name for name in options.only if name not in REQUIREMENTS]
    if unknown:
        raise ConfigurationError(
            f"--only: found {', '.join(unknown)}, expected some of {', '.join(REQUIREMENTS)}"
        )
    endpoint, instrument = _find_rtc(options)
    examination = Examination(
        only=frozenset(options.only),
        passive=options.passive,
        open_loop=options.open_loop,
        listen_s=options.seconds,
        wait_s=options.wait,
        consent=lambda moved: _ask_consent(moved, yes=options.yes),
        move_image=options.move_image,
    )
    if instrument is not None:
        examination = replace(
            examination,
            basis_id=instrument.basis_id,
            config_id=instrument.config_id,
            compare_matrix=lambda matrix: compare_matrix(instrument, matrix),
            find_images=lambda flux: measure_image_offsets(instrument, flux),
            fit_registration=make_registration_fit(instrument),
        )
    results = []
    with RtcConnection(endpoint, as_service=not options.passive) as connection:
        client = RtcClient(connection, TelemetryObserver(endpoint, time.monotonic))
        for result in examine(client, examination):
            results.append(result)
            if not options.json:
                print(shown(format_line(result)), flush=True)
    if options.json:
        print(json.dumps({"checks": [as_document(result) for result in results]}, indent=2))
    broken = [result.name for result in results if result.outcome is Outcome.WRONG]
    say(f"{len(results)} checks, {len(broken)} wrong{': ' if broken else ''}{', '.join(broken)}")
    return EXIT_WRONG if broken else EXIT_OK


def _find_rtc(options: argparse.Namespace) -> tuple[Endpoint, Instrument | None]:
    """Return the link to the RTC's system, and its instrument; None if no file describes it.

    Raises
    ------
    PyrcalError
        If there is no RTC at the router, or there are several and ``--system`` was not given.
    """
    zenoh = read_link_tables(options.config, listen=options.listen, connect=options.connect)
    if options.instrument is not None or (options.system is None and not zenoh.connect):
        instrument = load_instrument(options.instrument or DEFAULT_INSTRUMENT)
        return _make_endpoint(zenoh, options.system or instrument.name), instrument
    system = options.system
    if system is None:
        system = _find_system(_make_endpoint(zenoh, "any"), options.wait)
        say(f"found the RTC of system {system}")
    endpoint = _make_endpoint(zenoh, system)
    try:
        return endpoint, packaged_instrument(endpoint.system)
    except ConfigurationError:
        # Most checks need no instrument, so an unknown name is not an error here.
        say(f"no instrument named {endpoint.system} is packaged: {NO_INSTRUMENT_HINT}")
        return endpoint, None


def _make_endpoint(zenoh: ZenohTable, system: str) -> Endpoint:
    security = link_security(zenoh, system)
    return Endpoint(system=system, listen=zenoh.listen, connect=zenoh.connect, security=security)


def _find_system(endpoint: Endpoint, wait_s: float) -> str:
    found = find_systems_with_rtc(endpoint, wait_s)
    where = ", ".join(endpoint.connect)
    if not found:
        raise LinkError(f"no RTC of any system came to {where} within {wait_s:g} s: start it")
    if len(found) > 1:
        raise ConfigurationError(
            f"--system: found RTCs of {', '.join(found)} at {where}, expected the name of one"
        )
    return found[0]


def format_line(result: CheckResult) -> str:
    """Return a result on one line: finding, requirements by number, section of the contract."""
    requirement = result.requirement
    labels = ", ".join(requirement.labels)
    return (
        f"{result.outcome:8}{result.name:12} {result.found} "
        f"[{labels}: {requirement.says}; {CONTRACT_PAGE}#{requirement.anchor}]"
    )


def as_document(result: CheckResult) -> dict[str, str | list[str]]:
    """Return a result as a JSON object."""
    requirement = result.requirement
    return {
        "check": result.name,
        "outcome": result.outcome.lower(),
        "found": result.found,
        "requirements": list(requirement.labels),
        "contract": requirement.says,
        "where": f"{CONTRACT_PAGE}#{requirement.anchor}",
        "moves": requirement.moves.value,
    }


def compare_matrix(instrument: Instrument, matrix: NDArray[np.float32]) -> SlopeConvention | str:
    """Return the slope convention that the matrix in use implies, or the reason why not.

    ``matrix`` is ``(n_controlled, n_slopes)`` as the RTC uses it. It is compared with the model of
    the instrument at its start registration.
    """
    folder: Path = usual_folder(os.environ)
    try:
        basis = DiskCache(folder).basis(instrument)
        # A coarse model is quicker to compute, and shows signs, order and axes as well.
        model = RtcInteractionModel(instrument, basis, pupil_sampling=3, detector_nodes=3)
        response = model.interaction_matrix(instrument.start)
        if matrix.shape[1] != len(response) or len(matrix) > response.shape[1]:
            return (
                f"the matrix in use is {list(matrix.shape)}, {instrument.name} has "
                f"{len(response)} slopes and {response.shape[1]} modes"
                f"{likely_kind(matrix.shape[1], len(response))}"
            )
        convention = identify_from_reconstructor(
            matrix, instrument, basis, near=instrument.start, response=response
        )
    except ModelError as error:
        return f"the model of {instrument.name} cannot be computed: {error}"
    # A file that leaves the orientation open agrees with whatever is found.
    return replace(convention, adopted=instrument.slopes.orientation is None)


def measure_image_offsets(instrument: Instrument, flux: bytes) -> ImageOffsets | str:
    """Return the offsets of the pupil images in the flux of a status, or the reason why not.

    Offsets are in the axes of the RTC, because the RTC and its instrument file use these.
    """
    kind = kind_of(instrument)
    as_listed = replace(instrument, slopes=replace(instrument.slopes, orientation=None))
    light = kind.light(as_listed)
    if isinstance(light, CannotTell):
        return light.reason
    try:
        found = light.find_image_offsets(light.counts_of(flux))
    except ModelError as error:
        return str(error)
    if isinstance(found, CannotTell):
        return found.reason
    stated = kind.image_offsets(as_listed)
    return ImageOffsets(
        measured_px=found.subap * instrument.binning,
        sigma_px=found.sigma_subap * instrument.binning,
        nominal_px=None if stated is None else stated * instrument.binning,
    )


def make_registration_fit(instrument: Instrument) -> RegistrationFit:
    """Return a function that fits α to a window of dither, as the service does."""

    @functools.cache
    def worker() -> OpticsWorker:
        # Most runs make no check of the offload, and the worker imports the whole model.
        from service.runtime.worker import OpticsWorker
        from service.runtime.worker.records import Compute

        return OpticsWorker(instrument, Compute(cache=usual_folder(os.environ)))

    def fit_registration(window: Spectra, loop: ClosedLoop) -> LockInEstimate | WindowRefused:
        try:
            # Before the fit, which needs the order and signs that a file with orientation "auto"
            # leaves open.
            worker().read_slope_convention(loop.reconstructor, None)
            return worker().fit(window, loop, None)
        except ModelError as error:
            return WindowRefused(reason=str(error), t_ns_utc=window.t_end_ns_utc)

    return fit_registration


def _ask_consent(moved: tuple[str, ...], *, yes: bool) -> bool:
    """Print what will be moved and return True if the user agrees.

    Without a terminal there is no answer, so only ``yes`` counts.
    """
    for each in moved:
        say(f"will move: {each}")
    if yes or not sys.stdin.isatty():
        return yes
    sys.stderr.write("go on? [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in {"y", "yes"}
