"""Checks that move the RTC's matrix, loop or link.

A matrix that is sent always has the numbers in use already, under a new id.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from check_rtc.client import RtcClient
from check_rtc.requirements import Checked, fine, seen, skipped, wrong
from service.errors import LinkError, WireError
from service.link.matrices import MeasuredIntake, MeasuredMatrix
from service.wire import (
    CHUNK_LIMIT,
    Acknowledgement,
    AckState,
    Command,
    Loop,
    LoopRequest,
    Manifest,
    MeasureRequest,
    Pattern,
    Status,
    encode,
    layout_of,
    split,
)

APPLIED_S: Final = 2.0
"""From the commit to the acknowledgement "applied"."""

PATIENCE_S: Final = 6.0
"""For an answer that comes late."""

MISSING_S: Final = 2.0
"""After which an RTC asks for the chunks that have not come."""

TOLD_S: Final = 1.5
"""For the status to name the new matrix."""

_PARTS: Final = 4
_LEFT_OUT: Final = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatrixInUse:
    """The matrix that an RTC uses, by its manifest and numbers."""

    manifest: Manifest
    matrix: NDArray[np.float32]

    def named(self, name: str) -> MatrixInUse:
        """Return the same numbers under another id, in some parts."""
        size = min(max(math.ceil(self.matrix.nbytes / _PARTS), 1), CHUNK_LIMIT)
        layout = layout_of(self.matrix, size)
        manifest = replace(self.manifest, id=name, layout=layout, parent=self.manifest.id)
        return MatrixInUse(manifest=manifest, matrix=self.matrix)

    @property
    def parts(self) -> list[bytes]:
        """Its bytes as they travel."""
        return split(self.matrix, self.manifest.layout.chunk_bytes)


def commit(client: RtcClient, before: MatrixInUse) -> tuple[Checked, MatrixInUse | None]:
    """Send the matrix again, commit last; return the outcome and the matrix applied."""
    new = before.named(client.connection.new_id("commit"))
    name = new.manifest.id
    client.connection.offer(new.manifest, new.matrix)
    for index, part in enumerate(new.parts):
        client.connection.put_chunk(name, index, part)
    began_s = client.clock()
    client.connection.put_commit(name, encode(new.manifest))
    answers = _answers(client, name, PATIENCE_S)
    last = answers[-1][1] if answers else None
    if last is None or last.state is not AckState.APPLIED:
        return wrong("commit", _without(client, name, answers)), None
    took_s = answers[-1][0] - began_s
    client.watch.loop.use(name, new.matrix)
    found = f"applied {took_s:.2f} s after its commit, from frame {last.frame_seq}"
    client.listen(TOLD_S, lambda: _status_names(client, name))
    problems = _problems(client, new, last)
    if took_s > APPLIED_S:
        problems.insert(0, f"more than {APPLIED_S:g} s")
    if problems:
        return wrong("commit", f"{found}: {'; '.join(problems)}"), new
    return fine("commit", f"{found} on, as frames and status say"), new


def chunks(client: RtcClient, before: MatrixInUse) -> tuple[Checked, MatrixInUse | None]:
    """Send the commit first and leave one part out: the RTC has to ask for it."""
    new = before.named(client.connection.new_id("chunks"))
    name = new.manifest.id
    client.connection.offer(new.manifest, new.matrix)
    began_s = client.clock()
    client.connection.put_commit(name, encode(new.manifest))
    for index, part in enumerate(new.parts):
        if index != _LEFT_OUT:
            client.connection.put_chunk(name, index, part)
    wanted = f"{client.connection.keys.matrix(name)}?chunk={_LEFT_OUT}"
    answers = _answers(client, name, PATIENCE_S)
    asked = [at_s - began_s for at_s, key in client.watch.asked if key == wanted]
    if not answers or answers[-1][1].state is not AckState.APPLIED:
        tail = _without(client, name, answers)
        when = f"it asked for it after {asked[0]:.1f} s" if asked else "it did not ask for it"
        return wrong("chunks", f"chunk {_LEFT_OUT} was left out: {when}; {tail}"), None
    client.watch.loop.use(name, new.matrix)
    if not asked:
        return wrong("chunks", f"applied though chunk {_LEFT_OUT} never came"), new
    found = f"chunk {_LEFT_OUT}, left out, was asked for after {asked[0]:.1f} s"
    late = asked[0] > MISSING_S + 1.0
    return (wrong if late else fine)("chunks", f"{found}; then it was applied"), new


def rejection(client: RtcClient, in_use: MatrixInUse) -> Checked:
    """Send what must be rejected, with the numbers in use."""
    problems, reasons = [], []
    for what, manifest in _bad_manifests(client, in_use):
        name = manifest.id
        known = len(client.watch.acknowledgements)
        for index, part in enumerate(in_use.named(name).parts):
            client.connection.put_chunk(name, index, part)
        client.connection.put_commit(name, encode(manifest))
        answers = _answers(client, name, PATIENCE_S, known)
        if not answers or answers[-1][1].state is not AckState.REJECTED:
            problems.append(f"{what}: {_without(client, name, answers)}")
        else:
            reasons.append(f"{what} ({answers[-1][1].reason:.40})")
    problems += _repeated(client, in_use)
    problems += _unreadable(client)
    if problems:
        return wrong("rejection", "; ".join(problems))
    return fine("rejection", f"rejected: {'; '.join(reasons)}; a repeat was answered again")


def _bad_manifests(client: RtcClient, in_use: MatrixInUse) -> list[tuple[str, Manifest]]:
    new = client.connection.new_id
    other_sum = hashlib.sha256(b"other numbers").hexdigest()
    of_sum = in_use.named(new("sum")).manifest
    of_basis = in_use.named(new("basis")).manifest
    used = in_use.manifest
    return [
        ("a wrong sum", replace(of_sum, layout=replace(of_sum.layout, sha256=other_sum))),
        ("another basis", replace(of_basis, basis_id="no-basis-of-this-rtc")),
        ("a used id", replace(used, layout=replace(used.layout, sha256=other_sum))),
    ]


def _repeated(client: RtcClient, in_use: MatrixInUse) -> list[str]:
    """Send the commit of the matrix in use again: its acknowledgement must come again."""
    name, known = in_use.manifest.id, len(client.watch.acknowledgements)
    client.connection.put_commit(name, encode(in_use.manifest))
    answers = _answers(client, name, APPLIED_S, known)
    if answers and answers[-1][1].state is AckState.APPLIED:
        return []
    return [f"the same commit again: {_without(client, name, answers)}"]


def _unreadable(client: RtcClient) -> list[str]:
    """Send an unreadable commit: it must be rejected without id and sum."""
    known = len(client.watch.acknowledgements)
    client.connection.put_commit(client.connection.new_id("unreadable"), b"\xc1 no manifest")

    def answered() -> bool:
        return any(
            acknowledgement.id is None
            for _, acknowledgement in client.watch.acknowledgements[known:]
        )

    if client.listen(APPLIED_S, answered):
        return []
    return ["a commit that cannot be read: no acknowledgement with id nil"]


def _answers(
    client: RtcClient, name: str, patience_s: float, n_known: int = 0
) -> list[tuple[float, Acknowledgement]]:
    """Return the acknowledgements of a matrix until a final one or the time is over."""

    def answers() -> list[tuple[float, Acknowledgement]]:
        every = client.watch.acknowledgements[n_known:]
        return [(at_s, one) for at_s, one in every if one.id == name]

    client.listen(patience_s, lambda: any(one.state is not AckState.STAGED for _, one in answers()))
    return answers()


def _without(
    client: RtcClient, name: str, acknowledgements: list[tuple[float, Acknowledgement]]
) -> str:
    """Return in words why a matrix was not applied, or that no answer came."""
    if acknowledgements and acknowledgements[-1][1].state is AckState.REJECTED:
        return f"rejected: {acknowledgements[-1][1].reason}"
    if acknowledgements and acknowledgements[-1][1].state is AckState.APPLIED:
        return "applied"
    words = "staged, and not applied" if acknowledgements else "no acknowledgement"
    frames = [a.header.seq0 for a in client.watch.arrivals if a.header.cm_id == name]
    named = f", though frames name it from {frames[0]} on" if frames else ""
    return f"{words} within {PATIENCE_S:g} s{named}"


def _status_names(client: RtcClient, name: str) -> bool:
    status = client.watch.status
    return status is not None and status.cm_id == name


def _problems(client: RtcClient, new: MatrixInUse, acknowledgement: Acknowledgement) -> list[str]:
    """Return what contradicts the acknowledgement of a matrix that is in use."""
    name, problems = new.manifest.id, []
    frames = [a.header.seq0 for a in client.watch.arrivals if a.header.cm_id == name]
    if not frames:
        problems.append("no frame names it")
    elif min(frames) != acknowledgement.frame_seq:
        problems.append(f"frames name it from {min(frames)} on")
    if not _status_names(client, name):
        problems.append(f"the status does not within {TOLD_S:g} s")
    status = client.watch.status
    if status is not None and acknowledgement.session != status.session:
        problems.append(
            f"it is of session {acknowledgement.session}, the status of {status.session}"
        )
    if acknowledgement.sha256 != new.manifest.layout.sha256:
        problems.append("its sum is another one")
    return problems


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

NEIGHBOURS: Final = 10
"""Modes next to a measured one that tell how noisy it is."""

LIKELY: Final = (0.2, 3.0)
"""What a mode measures of itself by the matrix in use: optical gain, double pass."""


def reconnect(client: RtcClient) -> Checked:
    """Take the router away for a moment."""
    if not client.connection.own_router:
        return skipped("reconnect", "the router is not this program's")
    before = client.watch.session
    n_asked = len(client.watch.asked)
    client.connection.close()
    client.listen(AWAY_S)
    opened_s = client.clock()
    client.connection.open()
    n_known = len(client.watch.arrivals)
    if not client.listen(BACK_S, lambda: len(client.watch.arrivals) > n_known + 2):
        return wrong("reconnect", f"no frame came within {BACK_S:g} s after the router was back")
    client.listen(1.0)
    back_s = client.watch.arrivals[n_known].at_s - opened_s
    found = f"frames again {back_s:.1f} s after the router was back"
    sessions = {arrival.header.session for arrival in client.watch.arrivals[n_known:]}
    if sessions != {before}:
        return wrong("reconnect", f"{found}, in session {', '.join(sessions)} instead of {before}")
    current = client.connection.keys.current
    again = any(key == current for _, key in client.watch.asked[n_asked:])
    before_that = any(key == current for _, key in client.watch.asked[:n_asked])
    if again and before_that:
        return seen("reconnect", f"{found}; it asked cm/current again: once a session is enough")
    return fine("reconnect", f"{found}, in the same session")


def loop(client: RtcClient, status: Status) -> Checked:
    """Open the loop, and close it again."""
    if status.loop == Loop.OPEN:
        return skipped("loop", "the loop is open")
    refused = _refusal_of(client, LoopRequest(id=client.connection.new_id("open"), loop=Loop.OPEN))
    if refused:
        return wrong("loop", f"it would not open: {refused}")
    try:
        opened = client.listen(CHANGED_S, lambda: _loop_is(client, Loop.OPEN))
        during = client.watch.status
        client.listen(OPEN_S)
    finally:  # whoever breaks it off wants the loop as it was all the more
        refused = _refusal_of(
            client, LoopRequest(id=client.connection.new_id("close"), loop=Loop.CLOSED)
        )
    problems = _after_opening(client, status) if opened else ["no status says that it is open"]
    closed = client.listen(CHANGED_S, lambda: not _loop_is(client, Loop.OPEN))
    client.listen(OPEN_S)
    after = client.watch.status
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


def _after_opening(client: RtcClient, before: Status) -> list[str]:
    problems = []
    now = client.watch.status
    later = [a for a in client.watch.arrivals if a.header.session != before.session]
    if now is not None and now.session == before.session:
        problems.append("opening began no new session")
    elif not later:
        problems.append("no frame is of the new session")
    last_m = [arrival.largest_m for arrival in later[-_STANDING:]]
    # what is played on the mirror moves, a mirror that lags comes to rest
    if len(last_m) == _STANDING and last_m[0] > 0.0 and len(set(last_m)) == 1:
        problems.append(f"a command of {1e9 * last_m[0]:.3g} nm stands: the integrator is not 0")
    return problems


def measure(client: RtcClient, status: Status, in_use: MatrixInUse) -> Checked:
    """Have two modes measured, and compare the result with the matrix in use."""
    n_rows = len(in_use.matrix)
    modes = tuple(sorted({0, n_rows // 3}))
    name = client.connection.new_id("measure")
    request = MeasureRequest(
        id=name,
        pattern=Pattern.PUSH_PULL_MODAL,
        modes=modes,
        amplitude_m=(STROKE_M,) * len(modes),
        n_average=4,
    )
    n_known = len(client.watch.measured)
    refused = _refusal_of(client, request)
    if refused.startswith(("unsupported", "busy", "no answer")):
        return skipped("measure", f"it will not: {refused}")
    if refused:
        return wrong("measure", refused)
    found = _awaited(client, n_known)
    was_open = status.loop == Loop.OPEN
    back = client.listen(CHANGED_S, lambda: _loop_is(client, Loop.OPEN) is was_open)
    client.listen(OPEN_S)
    if not back:
        return wrong("measure", "the loop is not as it was before")
    return wrong("measure", found) if isinstance(found, str) else _measured(found, request, in_use)


def _awaited(client: RtcClient, n_known: int) -> MeasuredMatrix | str:
    """Return the measured matrix, or why there is none."""
    collector, found = MeasuredIntake(client.connection.keys), list[MeasuredMatrix | str]()
    looked_at = n_known

    def come() -> bool:
        nonlocal looked_at
        for item in client.watch.measured[looked_at:]:
            looked_at += 1
            try:
                matrix = collector.take(item.key, item.data)
            except WireError as error:
                found.append(str(error))
            else:
                found.extend([] if matrix is None else [matrix])
        return bool(found)

    client.listen(MEASURED_S, come)
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
    noise = max(
        float(np.median(np.abs(_beside(column, modes, mode))))
        for column, mode in zip(by_modes.T, modes, strict=True)
    )
    if noise > NOISY * np.abs(of_itself).max():
        return skipped("measure", f"{list(matrix.shape)}; too noisy to compare: {noise:.2g}")
    own = " and ".join(f"{share:.2f}" for share in of_itself)
    text = f"{list(matrix.shape)}; by the matrix in use a metre of a mode measures {own}"
    if (of_itself < LIKELY[0]).any() or (of_itself > LIKELY[1]).any():
        return wrong("measure", f"{text}, expected {LIKELY[0]:g} to {LIKELY[1]:g}: sign or unit")
    return fine("measure", text)


def _beside(
    column: NDArray[np.floating], measured: Sequence[int], mode: int
) -> NDArray[np.floating]:
    """Return what a measured column has of the modes next to its own: all noise.

    Modes far off have another noise: a sensor's own, or turbulence, has most of the lowest.
    """
    others = np.setdiff1d(np.arange(len(column)), measured)
    return column[others[np.argsort(np.abs(others - mode), kind="stable")[:NEIGHBOURS]]]


def _refusal_of(client: RtcClient, command: Command) -> str:
    """Send a command; return why it was not accepted, empty: it was."""
    try:
        reply = client.connection.command(command)
    except LinkError as error:
        return str(error)
    return "" if reply.accepted else reply.reason or "refused without a reason"


def _loop_is(client: RtcClient, wanted: Loop) -> bool:
    status = client.watch.status
    return status is not None and status.loop == wanted
