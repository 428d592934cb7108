"""One examination of an RTC: listen, tell, ask whether to move anything, and do that."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from check_rtc.articles import ARTICLES, Checked, Moves, skipped, wrong
from check_rtc.listening import About, listened
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
from check_rtc.talk import TOTAL_M, Talk, dither, dithered_modes, replies
from service.errors import LinkError, WireError
from service.estimation.dialect import Dialect
from service.estimation.windows import WindowRefused
from service.wire import Status

_SWAPS: Final = ("commit", "chunks", "rejection")
_UNKNOWN: Final = "the matrix in use is not to be had on rtc/cm/applied"

NO_INSTRUMENT: Final = "no instrument was named"
NO_ANSWER: Final = "no answer"
"""How an error begins that says that nobody was there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Examination:
    """What is to be checked, and how."""

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
    """Is told what would be moved, and answers whether it may be."""

    dialect: Callable[[NDArray[np.float32]], Dialect | str] = lambda _: NO_INSTRUMENT
    """Compares the matrix in use with the instrument file; a text says why it does not."""

    registered: Registered = lambda _, __: WindowRefused(reason=NO_INSTRUMENT, t_ns_utc=0)
    """Makes α of a window of dither, by the instrument file."""

    def wants(self, name: str) -> bool:
        """Return whether a check is to be made, if it may."""
        moves = ARTICLES[name].moves
        if self.passive and moves is not Moves.NOTHING:
            return False
        if self.only:
            return name in self.only
        agreed = {Moves.LOOP: self.open_loop, Moves.IMAGE: self.move_image}
        return agreed.get(moves, True)


def examine(talk: Talk, wish: Examination) -> Iterator[Checked]:
    """Yield every check as soon as it is made.

    Raises
    ------
    LinkError
        If no RTC is heard.
    """
    yield from (one for one in _listening(talk, wish) if wish.wants(one.name))
    n_refused = len(talk.watch.refused)
    status = talk.watch.status
    asking = [name for name, of in ARTICLES.items() if of.moves is not Moves.NOTHING]
    asking = [name for name in asking if wish.wants(name)]
    if status is None or not asking:
        return
    why = _why_not(talk, wish, status, asking)
    if why:
        yield from (skipped(name, why) for name in asking)
        return
    yield from (one for one in _asking(talk, wish, status) if one.name in asking)
    later = talk.watch.refused[n_refused:]
    if later and wish.wants("messages"):
        texts = "; ".join(dict.fromkeys(refused.text for refused in later))
        yield wrong("messages", f"meanwhile {len(later)} could not be read: {texts}")


def _listening(talk: Talk, wish: Examination) -> Iterator[Checked]:
    watch = talk.watch
    if not talk.listen(wish.wait_s, lambda: bool(watch.arrivals or watch.statuses)):
        raise LinkError(
            f"nothing of an RTC of system {talk.ear.keys.system} was heard within "
            f"{wish.wait_s:g} s: start it, or name its system with --system"
        )
    talk.listen(min(wish.wait_s, 3.0), lambda: bool(watch.arrivals and watch.statuses))
    about = About(keys=talk.ear.keys, began_s=talk.clock(), ended_s=talk.clock())
    try:
        manifest, matrix = talk.ear.applied()
    except (LinkError, WireError) as error:
        offered = not str(error).startswith(NO_ANSWER)
        about = replace(about, not_applied=str(error), offered=offered)
    else:
        about = replace(about, applied=manifest)
        watch.loop.use(manifest.id, matrix)
    talk.listen(wish.listen_s)
    about = replace(
        about,
        ended_s=talk.clock(),
        basis_id=wish.basis_id,
        config_id=wish.config_id,
        dialect="the matrix in use is not known",
    )
    if watch.loop.matrix is not None and wish.wants("orientation"):
        about = replace(about, dialect=wish.dialect(watch.loop.matrix))
    yield from listened(watch, about)


def _why_not(talk: Talk, wish: Examination, status: Status, names: list[str]) -> str:
    """Return why nothing is to be asked of the RTC; empty: it may be."""
    if talk.ear.other_service:
        return "a service drives this RTC: end it first, or listen with --passive"
    moved = moved_by(names, status)
    if moved and not wish.consent(moved):
        return "not agreed to: --yes agrees beforehand"
    return ""


def moved_by(names: list[str], status: Status) -> tuple[str, ...]:
    """Return what these checks will move, a line for each kind; empty: nothing."""
    lines = []
    kinds = {ARTICLES[name].moves for name in names}
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


def _asking(talk: Talk, wish: Examination, status: Status) -> Iterator[Checked]:
    """Make the checks that ask, those that move least first."""
    if wish.wants("replies"):
        yield replies(talk, status)
    if wish.wants("dither") or wish.wants("columns"):
        yield from dither(talk, status, talk.watch.loop.matrix)
    if any(wish.wants(name) for name in _SWAPS):
        yield from _swapping(talk, wish)
    if wish.wants("reconnect"):
        yield reconnect(talk)
    if wish.wants("loop"):
        yield loop(talk, talk.watch.status or status)
    if wish.wants("measure"):
        in_use = _in_use(talk)
        found = skipped("measure", _UNKNOWN)
        yield found if in_use is None else measure(talk, talk.watch.status or status, in_use)
    if wish.wants("offload"):
        yield offload(talk, talk.watch.loop.matrix, wish.registered)


def _swapping(talk: Talk, wish: Examination) -> Iterator[Checked]:
    """Send the matrix in use again and again; an RTC that does not answer is asked once."""
    in_use = _in_use(talk)
    if in_use is None:
        yield from (skipped(name, _UNKNOWN) for name in _SWAPS)
        return
    told, applied = commit(talk, in_use)
    yield told
    if applied is None:
        yield from (skipped(name, "commit has to succeed first") for name in _SWAPS[1:])
        return
    if wish.wants("chunks"):
        told, later = chunks(talk, applied)
        applied = later or applied
        yield told
    if wish.wants("rejection"):
        yield rejection(talk, applied)


def _in_use(talk: Talk) -> MatrixInUse | None:
    try:
        manifest, matrix = talk.ear.applied()
    except (LinkError, WireError):
        return None
    return MatrixInUse(manifest=manifest, matrix=matrix)
