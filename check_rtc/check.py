"""Check an RTC and print one line for each requirement."""

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
from check_rtc.connection import RtcConnection, systems_with_rtc
from check_rtc.examine import Examination, examine
from check_rtc.offload import Registered
from check_rtc.requirements import REQUIREMENTS, Checked, Outcome
from check_rtc.telemetry_checks import ImagePlaces
from check_rtc.watch import TelemetryObserver
from service.config import load_instrument, packaged_instrument
from service.config.link_tables import ZenohTable, link_security, read_link_tables
from service.errors import ConfigurationError, LinkError, ModelError, say, shown
from service.estimation.lockin import LockInEstimate, Spectra
from service.estimation.slope_convention import SlopeConvention, of_reconstructor
from service.estimation.windows import ClosedLoop, WindowRefused
from service.files.disk_cache import DiskCache, usual_folder
from service.link.session import Endpoint
from service.model.instrument import Instrument
from service.model.interaction import RtcInteractionModel
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import CannotTell
from service.model.slopes import likely_kind

if TYPE_CHECKING:
    from service.runtime.worker import OpticsWorker

KEPT, BROKEN = 0, 1

PAGE = "docs/rtc.md"

DEFAULT = "flao-lbt"
"""Instrument of an RTC that is waited for, where none is named."""

NO_FILE = "slopes and commands are held against nothing; name its file with --instrument"


def check(options: argparse.Namespace) -> int:
    """Check, print, and return the exit status: 0 nothing is wrong, 1 something is.

    Raises
    ------
    PyrcalError
        If nothing could be checked: no RTC, no link, or options that make no sense.
    """
    unknown = [name for name in options.only if name not in REQUIREMENTS]
    if unknown:
        raise ConfigurationError(
            f"--only: found {', '.join(unknown)}, expected some of {', '.join(REQUIREMENTS)}"
        )
    endpoint, instrument = _whom(options)
    examination = Examination(
        only=frozenset(options.only),
        passive=options.passive,
        open_loop=options.open_loop,
        listen_s=options.seconds,
        wait_s=options.wait,
        consent=lambda moved: _agreed(moved, yes=options.yes),
        move_image=options.move_image,
    )
    if instrument is not None:
        examination = replace(
            examination,
            basis_id=instrument.basis_id,
            config_id=instrument.config_id,
            dialect=lambda matrix: compared(instrument, matrix),
            images=lambda flux: found_images(instrument, flux),
            registered=registering(instrument),
        )
    checks = []
    with RtcConnection(endpoint, as_service=not options.passive) as ear:
        for one in examine(
            RtcClient(ear, TelemetryObserver(endpoint, time.monotonic)), examination
        ):
            checks.append(one)
            if not options.json:
                print(shown(line(one)), flush=True)
    if options.json:
        print(json.dumps({"checks": [as_document(one) for one in checks]}, indent=2))
    broken = [one.name for one in checks if one.outcome is Outcome.WRONG]
    say(f"{len(checks)} checks, {len(broken)} wrong{': ' if broken else ''}{', '.join(broken)}")
    return BROKEN if broken else KEPT


def _whom(options: argparse.Namespace) -> tuple[Endpoint, Instrument | None]:
    """Return the system to listen to, and its instrument; None: no file describes it.

    Raises
    ------
    PyrcalError
        If there is no RTC at a router, or there are several and none was named.
    """
    zenoh = read_link_tables(options.config, listen=options.listen, connect=options.connect)
    if options.instrument is not None or (options.system is None and not zenoh.connect):
        instrument = load_instrument(options.instrument or DEFAULT)
        return _endpoint(zenoh, options.system or instrument.name), instrument
    system = options.system
    if system is None:
        system = _only_system(_endpoint(zenoh, "any"), options.wait)
        say(f"the RTC there is that of system {system}")
    endpoint = _endpoint(zenoh, system)
    try:
        return endpoint, packaged_instrument(endpoint.system)
    except ConfigurationError:
        say(f"no instrument of that name is packaged: {NO_FILE}")
        return endpoint, None


def _endpoint(zenoh: ZenohTable, system: str) -> Endpoint:
    security = link_security(zenoh, system)
    return Endpoint(system=system, listen=zenoh.listen, connect=zenoh.connect, security=security)


def _only_system(endpoint: Endpoint, wait_s: float) -> str:
    found = systems_with_rtc(endpoint, wait_s)
    where = ", ".join(endpoint.connect)
    if not found:
        raise LinkError(f"no RTC of any system was at {where} within {wait_s:g} s: start it")
    if len(found) > 1:
        raise ConfigurationError(
            f"--system: found RTCs of {', '.join(found)} at {where}, expected the name of one"
        )
    return found[0]


def line(one: Checked) -> str:
    """Return a check on one line: finding, requirement, place in the contract."""
    article = one.requirement
    return (
        f"{one.outcome:8}{one.name:12} {one.found} "
        f"[contract: {article.says}; {PAGE}#{article.anchor}]"
    )


def as_document(one: Checked) -> dict[str, str]:
    """Return a check as JSON."""
    article = one.requirement
    return {
        "check": one.name,
        "outcome": one.outcome.lower(),
        "found": one.found,
        "contract": article.says,
        "where": f"{PAGE}#{article.anchor}",
        "moves": article.moves.value,
    }


def compared(instrument: Instrument, matrix: NDArray[np.float32]) -> SlopeConvention | str:
    """Return how the matrix in use compares with the instrument file."""
    folder: Path = usual_folder(os.environ)
    try:
        basis = DiskCache(folder).basis(instrument)
        model = RtcInteractionModel(instrument, basis, pupil_sampling=3, detector_nodes=3)
        response = model.interaction_matrix(instrument.start)
        if matrix.shape[1] != len(response) or len(matrix) > response.shape[1]:
            return (
                f"the matrix in use is {list(matrix.shape)}, {instrument.name} has "
                f"{len(response)} slopes and {response.shape[1]} modes"
                f"{likely_kind(matrix.shape[1], len(response))}"
            )
        dialect = of_reconstructor(
            matrix, instrument, basis, near=instrument.start, response=response
        )
    except ModelError as error:
        return f"the model of {instrument.name} cannot tell: {error}"
    return replace(dialect, adopted=instrument.slopes.orientation is None)


def found_images(instrument: Instrument, flux: bytes) -> ImagePlaces | str:
    """Return where the pupil images lie by the flux of a status, in the RTC's own axes."""
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
    return ImagePlaces(
        found_px=found.subap * instrument.binning,
        sigma_px=found.sigma_subap * instrument.binning,
        stated_px=None if stated is None else stated * instrument.binning,
    )


def registering(instrument: Instrument) -> Registered:
    """Return a function that fits α to a window of dither as the service does."""

    @functools.cache
    def worker() -> OpticsWorker:
        from service.runtime.worker import OpticsWorker
        from service.runtime.worker.records import Compute

        return OpticsWorker(instrument, Compute(cache=usual_folder(os.environ)))

    def registered(window: Spectra, loop: ClosedLoop) -> LockInEstimate | WindowRefused:
        try:
            worker().read_slope_convention(loop.reconstructor, None)
            return worker().fit(window, loop, None)
        except ModelError as error:
            return WindowRefused(reason=str(error), t_ns_utc=window.t_end_ns_utc)

    return registered


def _agreed(moved: tuple[str, ...], *, yes: bool) -> bool:
    """Print what will move, and ask."""
    for each in moved:
        say(f"will move: {each}")
    if yes or not sys.stdin.isatty():
        return yes
    sys.stderr.write("go on? [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in {"y", "yes"}
