"""Sequence of checks: listen first, then send commands, then move what the user agrees to."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from check_rtc.client import (
    DITHER_RMS_M,
    RtcClient,
    check_dither,
    check_replies,
    check_signatures,
    choose_dither_modes,
)
from check_rtc.moving import (
    OPEN_LOOP_S,
    STROKE_M,
    MatrixInUse,
    check_chunks,
    check_commit,
    check_finite,
    check_loop,
    check_measure,
    check_reconnect,
    check_rejection,
)
from check_rtc.offload import STEP_SUBAP, RegistrationFit, check_offload
from check_rtc.references import check_references
from check_rtc.requirements import REQUIREMENTS, CheckResult, Moves, skipped, wrong
from check_rtc.telemetry_checks import ImageOffsets, TelemetryContext, run_telemetry_checks
from service.errors import LinkError, WireError
from service.estimation.slope_convention import SlopeConvention
from service.records.estimates import WindowRefused
from service.wire import Status

_MATRIX_CHECKS: Final = ("commit", "chunks", "rejection")
_NO_MATRIX: Final = "rtc/cm/applied does not give the matrix in use"

NO_INSTRUMENT: Final = "no instrument is given"
NO_ANSWER: Final = "no answer"
"""First words of the error if nothing answers a query."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Examination:
    """Selection of checks, permissions, and comparisons with an instrument."""

    only: frozenset[str] = frozenset()
    """Names of checks; if empty, all that neither open the loop nor move the image."""

    passive: bool = False
    """True to run only checks that listen."""

    open_loop: bool = False
    """True to run also checks that open the loop."""

    move_image: bool = False
    """True to run also checks that move the mirror's image on the sensor."""

    listen_s: float = 8.0
    """Duration of listening, seconds."""

    wait_s: float = 30.0
    """Longest wait for the first message of the RTC, seconds."""

    basis_id: str | None = None
    """Id of the modal basis in the instrument file; None if it gives none."""

    config_id: str | None = None
    """Id of the sensor configuration in the instrument file; None if it gives none."""

    consent: Callable[[tuple[str, ...]], bool] = lambda _: False
    """Shows the user what will be moved, and returns True if the user agrees."""

    compare_matrix: Callable[[NDArray[np.float32]], SlopeConvention | str] = lambda _: NO_INSTRUMENT
    """Compares the matrix in use with the instrument file; returns a reason if it cannot."""

    find_images: Callable[[bytes], ImageOffsets | str] = lambda _: NO_INSTRUMENT
    """Measures pupil images in the flux of a status; returns a reason if it cannot."""

    fit_registration: RegistrationFit = lambda _, __: WindowRefused(
        reason=NO_INSTRUMENT, t_ns_utc=0
    )
    """Fits α to a window of dither with the model of the instrument."""

    def includes(self, name: str) -> bool:
        """Return True if a check is selected and permitted."""
        moves = REQUIREMENTS[name].moves
        if self.passive and moves is not Moves.NOTHING:
            return False
        if self.only:
            return name in self.only
        permitted = {Moves.LOOP: self.open_loop, Moves.IMAGE: self.move_image}
        return permitted.get(moves, True)


def examine(client: RtcClient, examination: Examination) -> Iterator[CheckResult]:
    """Run the selected checks and yield the result of each as soon as it is known.

    Raises
    ------
    LinkError
        If no message of an RTC comes within ``examination.wait_s``.
    """
    for result in _run_telemetry_checks(client, examination):
        if examination.includes(result.name):
            yield result
    n_refused = len(client.observer.refused)
    status = client.observer.status
    active = [
        name
        for name, requirement in REQUIREMENTS.items()
        if requirement.moves is not Moves.NOTHING and examination.includes(name)
    ]
    if status is None or not active:
        return
    reason = _explain_refusal(client, examination, status, active)
    if reason:
        yield from (skipped(name, reason) for name in active)
        return
    # Some functions return several results, of which only one may have been selected.
    for result in _run_active_checks(client, examination, status):
        if result.name in active:
            yield result
    later = client.observer.refused[n_refused:]
    if later and examination.includes("messages"):
        texts = "; ".join(dict.fromkeys(refused.text for refused in later))
        yield wrong("messages", f"{len(later)} messages since then broke the contract: {texts}")


def _run_telemetry_checks(client: RtcClient, examination: Examination) -> Iterator[CheckResult]:
    """Listen to the RTC and yield the results of all checks that need telemetry only."""
    observer = client.observer
    if not client.listen(examination.wait_s, lambda: bool(observer.arrivals or observer.statuses)):
        raise LinkError(
            f"no RTC of system {client.connection.keys.system} was seen within "
            f"{examination.wait_s:g} s: start it, or give its system with --system"
        )
    # A status comes once a second only, so the other kind of message may follow a little later.
    client.listen(
        min(examination.wait_s, 3.0), lambda: bool(observer.arrivals and observer.statuses)
    )
    context = TelemetryContext(
        keys=client.connection.keys, began_s=client.clock(), ended_s=client.clock()
    )
    # The matrix is fetched before listening, so that commands can be compared with slopes.
    try:
        manifest, matrix = client.connection.fetch_applied()
    except (LinkError, WireError) as error:
        is_served = not str(error).startswith(NO_ANSWER)
        context = replace(context, applied_error=str(error), is_served=is_served)
    else:
        context = replace(context, applied=manifest)
        observer.loop.use(manifest.id, matrix)
    client.listen(examination.listen_s)
    context = replace(
        context,
        ended_s=client.clock(),
        basis_id=examination.basis_id,
        config_id=examination.config_id,
        slope_convention="the matrix in use is not known",
    )
    if observer.loop.matrix is not None and examination.includes("orientation"):
        convention = examination.compare_matrix(observer.loop.matrix)
        context = replace(context, slope_convention=convention)
    if examination.includes("images"):
        context = replace(context, images=_find_images(observer.status, examination))
    yield from run_telemetry_checks(observer, context)


def _find_images(status: Status | None, examination: Examination) -> ImageOffsets | str:
    """Return the offsets of the pupil images, or the reason why they are unknown."""
    if status is None:
        return "no status has come"
    if status.flux is None:
        return "the status has no flux, which is optional and would show the pupil images"
    return examination.find_images(status.flux)


def _explain_refusal(
    client: RtcClient, examination: Examination, status: Status, names: list[str]
) -> str:
    """Return the reason not to send commands to the RTC; empty if there is none."""
    if client.connection.other_service:
        return "a service drives this RTC: end it first, or listen with --passive"
    moved = list_moves(names, status)
    if moved and not examination.consent(moved):
        return "the user did not agree; --yes gives consent beforehand"
    return ""


def list_moves(names: list[str], status: Status) -> tuple[str, ...]:
    """Return one line for each kind of movement of these checks, empty if there is none."""
    lines = []
    kinds = {REQUIREMENTS[name].moves for name in names}
    if Moves.MIRROR in kinds:
        modes = ", ".join(map(str, choose_dither_modes(status)))
        lines.append(
            f"dither, columns: the mirror, by {1e9 * DITHER_RMS_M:.0f} nm RMS of sines on modes "
            f"{modes} for about 4 s, in addition to the loop"
        )
    if Moves.MATRIX in kinds:
        lines.append(
            "commit, chunks, rejection: matrices with the same numbers as the one in use are sent, "
            "most under new ids, and two of them are swapped in"
        )
    return (*lines, *(text for name, text in _MOVES_OF_CHECKS.items() if name in names))


_MOVES_OF_CHECKS: Final = {
    "references": (
        "references: an offset of the reference slopes, which the matrix in use does not see, is "
        "set for some seconds; afterwards the references have another name"
    ),
    "reconnect": "reconnect: the link only; the RTC loses its router for a second",
    "loop": f"loop: THE LOOP IS OPENED for about {OPEN_LOOP_S:.0f} s and closed again",
    "finite": (
        "finite: THE LOOP IS OPENED for a few seconds, and matrices with NaN and infinity are "
        "sent, which the RTC must reject; then it is closed again"
    ),
    "measure": (
        "measure: the RTC opens THE LOOP, pushes and pulls two modes by "
        f"{1e9 * STROKE_M:.0f} nm RMS, and closes it again"
    ),
    "offload": (
        f"offload: THE MIRROR'S IMAGE is moved by {STEP_SUBAP:g} subap along x and back, with "
        f"{1e9 * DITHER_RMS_M:.0f} nm RMS of dither"
    ),
}
"""Lines of the checks that move something of their own, in the order of the report."""


def _run_active_checks(
    client: RtcClient, examination: Examination, status: Status
) -> Iterator[CheckResult]:
    """Run the checks that send commands, those that move least first."""
    yield from _run_reply_checks(client, examination, status)
    if examination.includes("dither") or examination.includes("columns"):
        yield from check_dither(client, status, client.observer.loop.matrix)
    if any(examination.includes(name) for name in _MATRIX_CHECKS):
        yield from _run_matrix_checks(client, examination)
    if examination.includes("references"):
        yield check_references(client, client.observer.status or status)
    if examination.includes("reconnect"):
        yield check_reconnect(client)
    if examination.includes("loop"):
        yield check_loop(client, client.observer.status or status)
    yield from _run_matrix_comparisons(client, examination, status)
    if examination.includes("offload"):
        yield check_offload(client, client.observer.loop.matrix, examination.fit_registration)


def _run_matrix_comparisons(
    client: RtcClient, examination: Examination, status: Status
) -> Iterator[CheckResult]:
    """Run the checks that open the loop and need the matrix in use."""
    for name, check in (("finite", check_finite), ("measure", check_measure)):
        if not examination.includes(name):
            continue
        # Fetched again: an earlier check may have swapped in a matrix with another id.
        in_use = _fetch_matrix(client)
        if in_use is None:
            yield skipped(name, _NO_MATRIX)
        else:
            yield check(client, client.observer.status or status, in_use)


def _run_reply_checks(
    client: RtcClient, examination: Examination, status: Status
) -> Iterator[CheckResult]:
    if examination.includes("replies"):
        yield check_replies(client, status)
    if "signatures" in examination.only or client.connection.has_secret:
        yield check_signatures(client, status)


def _run_matrix_checks(client: RtcClient, examination: Examination) -> Iterator[CheckResult]:
    """Send the matrix in use again under new ids.

    If the first commit fails, the other checks are skipped: each would wait for its timeout.
    """
    in_use = _fetch_matrix(client)
    if in_use is None:
        yield from (skipped(name, _NO_MATRIX) for name in _MATRIX_CHECKS)
        return
    outcome, applied = check_commit(client, in_use)
    yield outcome
    if applied is None:
        yield from (skipped(name, "commit has to succeed first") for name in _MATRIX_CHECKS[1:])
        return
    if examination.includes("chunks"):
        outcome, later = check_chunks(client, applied)
        applied = later or applied
        yield outcome
    if examination.includes("rejection"):
        yield check_rejection(client, applied)


def _fetch_matrix(client: RtcClient) -> MatrixInUse | None:
    try:
        manifest, matrix = client.connection.fetch_applied()
    except (LinkError, WireError):
        return None
    return MatrixInUse(manifest=manifest, matrix=matrix)
