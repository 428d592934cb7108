"""One examination: listen, ask, and move what the user agrees to."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from check_rtc.client import (
    TOTAL_M,
    RtcClient,
    dither,
    dithered_modes,
    replies,
    signatures,
)
from check_rtc.moving import (
    OPEN_S,
    STROKE_M,
    MatrixInUse,
    chunks,
    commit,
    loop,
    measure,
    reconnect,
    rejection,
)
from check_rtc.offload import STEP, Registered, offload
from check_rtc.requirements import REQUIREMENTS, Checked, Moves, skipped, wrong
from check_rtc.telemetry_checks import About, ImagePlaces, find_all
from service.errors import LinkError, WireError
from service.estimation.slope_convention import SlopeConvention
from service.estimation.windows import WindowRefused
from service.wire import Status

_SWAPS: Final = ("commit", "chunks", "rejection")
_UNKNOWN: Final = "the matrix in use is not to be had on rtc/cm/applied"

NO_INSTRUMENT: Final = "no instrument was named"
NO_ANSWER: Final = "no answer"
"""How an error begins that says that nobody was there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Examination:
    """Which checks to make, and with what permission."""

    only: frozenset[str] = frozenset()
    """Names of checks; empty: all that neither open the loop nor move the image."""

    passive: bool = False
    """Only what moves and asks nothing."""

    open_loop: bool = False
    """Also what opens the loop."""

    move_image: bool = False
    """Also what moves the mirror's image on the sensor."""

    listen_s: float = 8.0
    wait_s: float = 30.0
    """For an RTC to be heard."""

    basis_id: str | None = None
    config_id: str | None = None
    """As the instrument file pins them."""

    consent: Callable[[tuple[str, ...]], bool] = lambda _: False
    """Shows what would be moved, and returns whether it may be."""

    dialect: Callable[[NDArray[np.float32]], SlopeConvention | str] = lambda _: NO_INSTRUMENT
    """Compares the matrix in use with the instrument file; a text says why it does not."""

    images: Callable[[bytes], ImagePlaces | str] = lambda _: NO_INSTRUMENT
    """Finds the pupil images in the flux of a status; a text says why they are not found."""

    registered: Registered = lambda _, __: WindowRefused(reason=NO_INSTRUMENT, t_ns_utc=0)
    """Makes α of a window of dither, by the instrument file."""

    def wants(self, name: str) -> bool:
        """Whether a check is wanted."""
        moves = REQUIREMENTS[name].moves
        if self.passive and moves is not Moves.NOTHING:
            return False
        if self.only:
            return name in self.only
        agreed = {Moves.LOOP: self.open_loop, Moves.IMAGE: self.move_image}
        return agreed.get(moves, True)


def examine(client: RtcClient, examination: Examination) -> Iterator[Checked]:
    """Yield each check when it is made.

    Raises
    ------
    LinkError
        If no RTC is heard.
    """
    yield from (one for one in _listening(client, examination) if examination.wants(one.name))
    n_refused = len(client.watch.refused)
    status = client.watch.status
    asking = [name for name, of in REQUIREMENTS.items() if of.moves is not Moves.NOTHING]
    asking = [name for name in asking if examination.wants(name)]
    if status is None or not asking:
        return
    why = _why_not(client, examination, status, asking)
    if why:
        yield from (skipped(name, why) for name in asking)
        return
    yield from (one for one in _asking(client, examination, status) if one.name in asking)
    later = client.watch.refused[n_refused:]
    if later and examination.wants("messages"):
        texts = "; ".join(dict.fromkeys(refused.text for refused in later))
        yield wrong("messages", f"meanwhile {len(later)} could not be read: {texts}")


def _listening(client: RtcClient, examination: Examination) -> Iterator[Checked]:
    observer = client.watch
    if not client.listen(examination.wait_s, lambda: bool(observer.arrivals or observer.statuses)):
        raise LinkError(
            f"no RTC of system {client.connection.keys.system} was seen within "
            f"{examination.wait_s:g} s: start it, or name its system with --system"
        )
    client.listen(
        min(examination.wait_s, 3.0), lambda: bool(observer.arrivals and observer.statuses)
    )
    about = About(keys=client.connection.keys, began_s=client.clock(), ended_s=client.clock())
    try:
        manifest, matrix = client.connection.applied()
    except (LinkError, WireError) as error:
        offered = not str(error).startswith(NO_ANSWER)
        about = replace(about, not_applied=str(error), offered=offered)
    else:
        about = replace(about, applied=manifest)
        observer.loop.use(manifest.id, matrix)
    client.listen(examination.listen_s)
    about = replace(
        about,
        ended_s=client.clock(),
        basis_id=examination.basis_id,
        config_id=examination.config_id,
        dialect="the matrix in use is not known",
    )
    if observer.loop.matrix is not None and examination.wants("orientation"):
        about = replace(about, dialect=examination.dialect(observer.loop.matrix))
    if examination.wants("images"):
        about = replace(about, images=_images(observer.status, examination))
    yield from find_all(observer, about)


def _images(status: Status | None, examination: Examination) -> ImagePlaces | str:
    """Return where the pupil images lie, or why that is not known."""
    if status is None:
        return "no status has come"
    if status.flux is None:
        return "the status has no flux, which is optional: it would show where the pupil images lie"
    return examination.images(status.flux)


def _why_not(client: RtcClient, examination: Examination, status: Status, names: list[str]) -> str:
    """Return why the RTC must not be asked; empty: it may be."""
    if client.connection.other_service:
        return "a service drives this RTC: end it first, or listen with --passive"
    moved = moved_by(names, status)
    if moved and not examination.consent(moved):
        return "not agreed to: --yes agrees beforehand"
    return ""


def moved_by(names: list[str], status: Status) -> tuple[str, ...]:
    """Return what these checks will move, a line for each kind; empty: nothing."""
    lines = []
    kinds = {REQUIREMENTS[name].moves for name in names}
    if Moves.MIRROR in kinds:
        modes = ", ".join(map(str, dithered_modes(status)))
        lines.append(
            f"dither, columns: the mirror, {1e9 * TOTAL_M:.0f} nm RMS of sines on modes {modes} "
            "for some 4 s, added to the loop"
        )
    if Moves.MATRIX in kinds:
        lines.append(
            "commit, chunks, rejection: the matrix in use is sent again under new ids, the same "
            "numbers; two of them will be swapped in"
        )
    if "reconnect" in names:
        lines.append("reconnect: the link only; the RTC loses its router for a second")
    if "loop" in names:
        lines.append(f"loop: THE LOOP IS OPENED for some {OPEN_S:.0f} s, and closed again")
    if "measure" in names:
        lines.append(
            "measure: the RTC opens THE LOOP, pushes and pulls two modes by "
            f"{1e9 * STROKE_M:.0f} nm RMS, and closes it again"
        )
    if "offload" in names:
        lines.append(
            f"offload: THE MIRROR'S IMAGE is moved by {STEP:g} subap along x, and back; meanwhile "
            f"{1e9 * TOTAL_M:.0f} nm RMS of dither"
        )
    return tuple(lines)


def _asking(client: RtcClient, examination: Examination, status: Status) -> Iterator[Checked]:
    """Make the checks that ask, those that move least first."""
    yield from _asking_words(client, examination, status)
    if examination.wants("dither") or examination.wants("columns"):
        yield from dither(client, status, client.watch.loop.matrix)
    if any(examination.wants(name) for name in _SWAPS):
        yield from _swapping(client, examination)
    if examination.wants("reconnect"):
        yield reconnect(client)
    if examination.wants("loop"):
        yield loop(client, client.watch.status or status)
    if examination.wants("measure"):
        in_use = _in_use(client)
        found = skipped("measure", _UNKNOWN)
        yield found if in_use is None else measure(client, client.watch.status or status, in_use)
    if examination.wants("offload"):
        yield offload(client, client.watch.loop.matrix, examination.registered)


def _asking_words(client: RtcClient, examination: Examination, status: Status) -> Iterator[Checked]:
    if examination.wants("replies"):
        yield replies(client, status)
    if "signatures" in examination.only or client.connection.signs:
        yield signatures(client, status)


def _swapping(client: RtcClient, examination: Examination) -> Iterator[Checked]:
    """Send the matrix in use again and again; an RTC that does not answer is asked once."""
    in_use = _in_use(client)
    if in_use is None:
        yield from (skipped(name, _UNKNOWN) for name in _SWAPS)
        return
    outcome, applied = commit(client, in_use)
    yield outcome
    if applied is None:
        yield from (skipped(name, "commit has to succeed first") for name in _SWAPS[1:])
        return
    if examination.wants("chunks"):
        outcome, later = chunks(client, applied)
        applied = later or applied
        yield outcome
    if examination.wants("rejection"):
        yield rejection(client, applied)


def _in_use(client: RtcClient) -> MatrixInUse | None:
    try:
        manifest, matrix = client.connection.applied()
    except (LinkError, WireError):
        return None
    return MatrixInUse(manifest=manifest, matrix=matrix)
