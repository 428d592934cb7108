"""What needs the loop opened or the link taken away: the RTC's sessions, and a measured matrix."""

from __future__ import annotations

from typing import Final

import numpy as np

from service.conformance.articles import Checked, fine, seen, skipped, wrong
from service.conformance.swaps import MatrixInUse
from service.conformance.talk import Talk
from service.errors import LinkError, WireError
from service.link.matrices import MeasuredIntake, MeasuredMatrix
from service.wire import Command, Loop, LoopRequest, MeasureRequest, Pattern, Status

AWAY_S: Final = 1.0
BACK_S: Final = 10.0
"""For an RTC to come back to its router."""

CHANGED_S: Final = 5.0
"""For frames and status to show a loop that was opened or closed."""

OPEN_S: Final = 1.0
"""For which the loop stays open."""

STROKE_M: Final = 20e-9
"""RMS of a push or pull, metres OPD: the service's own."""

MEASURED_S: Final = 20.0
_STANDING: Final = 5
"""Batches with one and the same command: it stands."""

NOISY: Final = 0.3
"""What other modes measure, over a mode's own, from which on it tells nothing."""

LIKELY: Final = (0.2, 3.0)
"""What a mode measures of itself by the matrix in use: optical gain, double pass."""


def reconnect(talk: Talk) -> Checked:
    """Take the router away for a moment."""
    if not talk.ear.own_router:
        return skipped("reconnect", "the router is not this program's")
    before = talk.watch.session
    n_asked = len(talk.watch.asked)
    talk.ear.close()
    talk.listen(AWAY_S)
    opened_s = talk.clock()
    talk.ear.open()
    n_known = len(talk.watch.arrivals)
    if not talk.listen(BACK_S, lambda: len(talk.watch.arrivals) > n_known + 2):
        return wrong("reconnect", f"no frame came within {BACK_S:g} s after the router was back")
    talk.listen(1.0)
    back_s = talk.watch.arrivals[n_known].at_s - opened_s
    found = f"frames again {back_s:.1f} s after the router was back"
    sessions = {arrival.header.session for arrival in talk.watch.arrivals[n_known:]}
    if sessions != {before}:
        return wrong("reconnect", f"{found}, in session {', '.join(sessions)} instead of {before}")
    current = talk.ear.keys.current
    again = any(key == current for _, key in talk.watch.asked[n_asked:])
    before_that = any(key == current for _, key in talk.watch.asked[:n_asked])
    if again and before_that:
        return seen("reconnect", f"{found}; it asked cm/current again: once a session is enough")
    return fine("reconnect", f"{found}, in the same session")


def loop(talk: Talk, status: Status) -> Checked:
    """Open the loop, and close it again."""
    if status.loop == Loop.OPEN:
        return skipped("loop", "the loop is open")
    refused = _told(talk, LoopRequest(id=talk.ear.new_id("open"), loop=Loop.OPEN))
    if refused:
        return wrong("loop", f"it would not open: {refused}")
    try:
        opened = talk.listen(CHANGED_S, lambda: _loop_is(talk, Loop.OPEN))
        during = talk.watch.status
        talk.listen(OPEN_S)
    finally:  # whoever breaks it off wants the loop as it was all the more
        refused = _told(talk, LoopRequest(id=talk.ear.new_id("close"), loop=Loop.CLOSED))
    problems = _after_opening(talk, status) if opened else ["no status says that it is open"]
    closed = talk.listen(CHANGED_S, lambda: not _loop_is(talk, Loop.OPEN))
    talk.listen(OPEN_S)
    after = talk.watch.status
    if refused or not closed or after is None or during is None:
        problems.append(f"it is not closed again: {refused or 'the status says so'}")
    else:
        if after.session != during.session:
            problems.append(f"closing began session {after.session}")
        if after.cm_id != status.cm_id:
            problems.append(f"afterwards {after.cm_id} is in use, before it was {status.cm_id}")
    if problems:
        return wrong("loop", "; ".join(problems))
    return fine("loop", f"opened in session {during.session if during else ''}, closed in it again")


def _after_opening(talk: Talk, before: Status) -> list[str]:
    problems = []
    now = talk.watch.status
    later = [a for a in talk.watch.arrivals if a.header.session != before.session]
    if now is not None and now.session == before.session:
        problems.append("opening began no new session")
    elif not later:
        problems.append("no frame is of the new session")
    last_m = [arrival.largest_m for arrival in later[-_STANDING:]]
    # what is played on the mirror moves, a mirror that lags comes to rest
    if len(last_m) == _STANDING and last_m[0] > 0.0 and len(set(last_m)) == 1:
        problems.append(f"a command of {1e9 * last_m[0]:.3g} nm stands: the integrator is not 0")
    return problems


def measure(talk: Talk, status: Status, in_use: MatrixInUse) -> Checked:
    """Have two modes measured, and compare what comes with the matrix in use."""
    n_rows = len(in_use.matrix)
    modes = tuple(sorted({0, n_rows // 3}))
    name = talk.ear.new_id("measure")
    request = MeasureRequest(
        id=name,
        pattern=Pattern.PUSH_PULL_MODAL,
        modes=modes,
        amplitude_m=(STROKE_M,) * len(modes),
        n_average=4,
    )
    n_known = len(talk.watch.measured)
    refused = _told(talk, request)
    if refused.startswith(("unsupported", "busy", "no answer")):
        return skipped("measure", f"it will not: {refused}")
    if refused:
        return wrong("measure", refused)
    found = _awaited(talk, n_known)
    was_open = status.loop == Loop.OPEN
    back = talk.listen(CHANGED_S, lambda: _loop_is(talk, Loop.OPEN) is was_open)
    talk.listen(OPEN_S)
    if not back:
        return wrong("measure", "the loop is not as it was before")
    return wrong("measure", found) if isinstance(found, str) else _measured(found, request, in_use)


def _awaited(talk: Talk, n_known: int) -> MeasuredMatrix | str:
    """Return the matrix that comes, or why there is none."""
    collector, found = MeasuredIntake(talk.ear.keys), list[MeasuredMatrix | str]()
    looked_at = n_known

    def come() -> bool:
        nonlocal looked_at
        for item in talk.watch.measured[looked_at:]:
            looked_at += 1
            try:
                matrix = collector.take(item.key, item.data)
            except WireError as error:
                found.append(str(error))
            else:
                found.extend([] if matrix is None else [matrix])
        return bool(found)

    talk.listen(MEASURED_S, come)
    return found[0] if found else f"no matrix within {MEASURED_S:g} s"


def _measured(found: MeasuredMatrix, request: MeasureRequest, in_use: MatrixInUse) -> Checked:
    manifest, matrix, modes = found.manifest, found.matrix, request.modes
    if matrix is None:
        return wrong("measure", f"it failed: {manifest.reason}")
    if (manifest.id, manifest.modes) != (request.id, modes):
        return wrong("measure", f"it is called {manifest.id} and of modes {manifest.modes}")
    if matrix.shape[0] != in_use.matrix.shape[1]:
        return wrong(
            "measure", f"it has {matrix.shape[0]} rows for {in_use.matrix.shape[1]} slopes"
        )
    by_modes = in_use.matrix @ matrix
    of_itself = np.diag(by_modes[list(modes)])
    noise = float(np.median(np.abs(np.delete(by_modes, modes, axis=0))))
    if noise > NOISY * np.abs(of_itself).max():
        return skipped("measure", f"{list(matrix.shape)}; too noisy to compare: {noise:.2g}")
    own = " and ".join(f"{share:.2f}" for share in of_itself)
    text = f"{list(matrix.shape)}; by the matrix in use a metre of a mode measures {own}"
    if (of_itself < LIKELY[0]).any() or (of_itself > LIKELY[1]).any():
        return wrong("measure", f"{text}, expected {LIKELY[0]:g} to {LIKELY[1]:g}: sign or unit")
    return fine("measure", text)


def _told(talk: Talk, command: Command) -> str:
    """Send a command; return why it was not accepted, empty: it was."""
    try:
        reply = talk.ear.command(command)
    except LinkError as error:
        return str(error)
    return "" if reply.accepted else reply.reason or "refused without a reason"


def _loop_is(talk: Talk, wanted: Loop) -> bool:
    status = talk.watch.status
    return status is not None and status.loop == wanted
