"""Checks that change the RTC's matrix, loop or link.

Every matrix that is sent while the loop is closed has the numbers of the matrix in use, so that the
loop does not change whatever the RTC does with it.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import msgpack
import numpy as np
from numpy.typing import NDArray

from check_rtc.client import MAX_NOISE_RATIO, RtcClient
from check_rtc.requirements import CheckResult, fine, seen, skipped, wrong
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
    checksum,
    encode,
    layout_of,
    split,
)

MAX_APPLY_DELAY_S: Final = 2.0
"""Longest time from a commit to its acknowledgement "applied" by the contract, seconds."""

ACKNOWLEDGEMENT_TIMEOUT_S: Final = 6.0
"""Time to wait for an acknowledgement, so that a late one is reported as late and not missing."""

CHUNK_REQUEST_DELAY_S: Final = 2.0
"""Time after which an RTC has to query chunks that have not come, by the contract."""

STATUS_TIMEOUT_S: Final = 1.5
"""Longest time until the status names a new matrix; a status comes at least once a second."""

_N_CHUNKS: Final = 4
"""Number of chunks in which a matrix is sent."""

_OMITTED_CHUNK: Final = 1
"""Index of the chunk that is not sent, which the RTC must query."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatrixInUse:
    """Matrix that the RTC uses: manifest and numbers."""

    manifest: Manifest
    matrix: NDArray[np.float32]

    def copy_as(self, name: str) -> MatrixInUse:
        """Return the same numbers under the id ``name``, in several chunks."""
        size = min(max(math.ceil(self.matrix.nbytes / _N_CHUNKS), 1), CHUNK_LIMIT)
        layout = layout_of(self.matrix, size)
        manifest = replace(self.manifest, id=name, layout=layout, parent=self.manifest.id)
        return MatrixInUse(manifest=manifest, matrix=self.matrix)

    def with_numbers(self, matrix: NDArray[np.float32]) -> MatrixInUse:
        """Return other numbers of the same shape under the same id, with their checksum."""
        # Not by layout_of, which refuses numbers that are not finite.
        layout = replace(self.manifest.layout, sha256=checksum(matrix))
        return MatrixInUse(manifest=replace(self.manifest, layout=layout), matrix=matrix)

    @property
    def parts(self) -> list[bytes]:
        """Chunks of the matrix as they are sent."""
        return split(self.matrix, self.manifest.layout.chunk_bytes)


def _send(
    client: RtcClient, new: MatrixInUse, changed: Mapping[str, object] | None = None
) -> list[tuple[float, Acknowledgement]]:
    """Offer and send a matrix, commit last; return its acknowledgements with their delays.

    ``changed`` replaces keys of the commit, also by values that a manifest cannot have.
    """
    name, known = new.manifest.id, len(client.observer.acknowledgements)
    # Offered as well, because an RTC may ignore chunks and query all of them after the commit.
    client.connection.offer(new.manifest, new.matrix)
    for index, part in enumerate(new.parts):
        client.connection.put_chunk(name, index, part)
    commit = msgpack.unpackb(encode(new.manifest)) | dict(changed or {})
    began_s = client.clock()
    client.connection.put_commit(name, msgpack.packb(commit))
    answers = _wait_for_acknowledgements(client, name, ACKNOWLEDGEMENT_TIMEOUT_S, known)
    return [(at_s - began_s, answer) for at_s, answer in answers]


def check_commit(client: RtcClient, before: MatrixInUse) -> tuple[CheckResult, MatrixInUse | None]:
    """Send the matrix again, commit last; return the result, and the new matrix if applied."""
    new = before.copy_as(client.connection.new_id("commit"))
    name = new.manifest.id
    answers = _send(client, new)
    took_s, last = answers[-1] if answers else (0.0, None)
    if last is None or last.state is not AckState.APPLIED:
        return wrong("commit", _explain_outcome(client, name, answers)), None
    # Acknowledgement, frames and status must agree on the first frame of the new matrix.
    client.observer.loop.use(name, new.matrix)
    found = f"applied {took_s:.2f} s after its commit, from frame {last.frame_seq} on"
    client.listen(STATUS_TIMEOUT_S, lambda: _status_has_matrix(client, name))
    problems = _find_contradictions(client, new, last)
    if took_s > MAX_APPLY_DELAY_S:
        problems.insert(0, f"more than {MAX_APPLY_DELAY_S:g} s")
    if problems:
        return wrong("commit", f"{found}: {'; '.join(problems)}"), new
    return fine("commit", f"{found}; frames and status agree"), new


def check_chunks(client: RtcClient, before: MatrixInUse) -> tuple[CheckResult, MatrixInUse | None]:
    """Check that the RTC queries a chunk that does not come after its commit."""
    new = before.copy_as(client.connection.new_id("chunks"))
    name = new.manifest.id
    client.connection.offer(new.manifest, new.matrix)
    began_s = client.clock()
    # The commit comes first here: zenoh may deliver it so, because it has the higher priority.
    client.connection.put_commit(name, encode(new.manifest))
    for index, part in enumerate(new.parts):
        if index != _OMITTED_CHUNK:
            client.connection.put_chunk(name, index, part)
    selector = f"{client.connection.keys.matrix(name)}?chunk={_OMITTED_CHUNK}"
    answers = _wait_for_acknowledgements(client, name, ACKNOWLEDGEMENT_TIMEOUT_S)
    delays_s = [at_s - began_s for at_s, key in client.observer.queries if key == selector]
    if not answers or answers[-1][1].state is not AckState.APPLIED:
        tail = _explain_outcome(client, name, answers)
        when = f"it was queried after {delays_s[0]:.1f} s" if delays_s else "it was not queried"
        return wrong("chunks", f"chunk {_OMITTED_CHUNK} was left out: {when}; {tail}"), None
    client.observer.loop.use(name, new.matrix)
    if not delays_s:
        # An RTC that applies an incomplete matrix plays numbers that were never judged.
        return wrong("chunks", f"applied though chunk {_OMITTED_CHUNK} never came"), new
    found = f"chunk {_OMITTED_CHUNK} was left out and queried after {delays_s[0]:.1f} s"
    late = delays_s[0] > CHUNK_REQUEST_DELAY_S + 1.0
    return (wrong if late else fine)("chunks", f"{found}; then the matrix was applied"), new


def check_rejection(client: RtcClient, in_use: MatrixInUse) -> CheckResult:
    """Check that invalid commits are rejected; their chunks have the numbers in use."""
    problems, reasons = [], []
    for what, bad, changed in _bad_matrices(client, in_use):
        problem, reason = _offer_bad_matrix(client, what, bad, changed)
        if problem:
            problems.append(problem)
            # What follows starts from the matrix in use again, and not from one with a wrong id.
            in_use = _put_back(client, in_use) or in_use
        else:
            reasons.append(reason)
    problems += _check_repeat(client, in_use)
    problems += _check_unreadable_commit(client)
    if problems:
        return wrong("rejection", "; ".join(problems))
    return fine(
        "rejection", f"rejected: {'; '.join(reasons)}; a repeated commit was acknowledged again"
    )


def _bad_matrices(
    client: RtcClient, in_use: MatrixInUse
) -> Iterator[tuple[str, MatrixInUse, Mapping[str, object]]]:
    """Yield matrices that must be rejected: defect, matrix, and changed keys of the commit."""
    other_sum = hashlib.sha256(b"other numbers").hexdigest()
    for what, changed in (
        ("a wrong checksum", {"sha256": other_sum}),
        ("another dtype", {"dtype": "<f8"}),
        ("another basis", {"basis_id": "no-basis-of-this-rtc"}),
        ("another configuration", {"config_id": "no-configuration-of-this-rtc"}),
        ("another system", {"system": "no-system-of-this-rtc"}),
    ):
        yield what, in_use.copy_as(client.connection.new_id("bad")), changed
    if len(in_use.matrix) > 1:
        # The last mode would be left out, and no other one would change.
        fewer = MatrixInUse(manifest=in_use.manifest, matrix=in_use.matrix[:-1])
        yield "a row too few", fewer.copy_as(client.connection.new_id("shape")), {}
    # Other numbers with their right checksum, so that only the id is wrong: the loop does not
    # notice the last bit of one number.
    changed_bit = in_use.matrix.copy()
    changed_bit.flat[0] = np.nextafter(changed_bit.flat[0], np.float32(np.inf))
    yield "a used id", in_use.with_numbers(changed_bit), {}


def _offer_bad_matrix(
    client: RtcClient, what: str, bad: MatrixInUse, changed: Mapping[str, object]
) -> tuple[str, str]:
    """Send a matrix that must be rejected; return the problem, empty if it was, and the reason."""
    answers = _send(client, bad, changed)
    if not answers or answers[-1][1].state is not AckState.REJECTED:
        return f"{what}: {_explain_outcome(client, bad.manifest.id, answers)}", ""
    return "", f"{what} ({answers[-1][1].reason:.40})"


def _put_back(client: RtcClient, in_use: MatrixInUse) -> MatrixInUse | None:
    """Send the matrix in use under a new id; return it, or None if it was not applied."""
    new = in_use.copy_as(client.connection.new_id("back"))
    answers = _send(client, new)
    if not answers or answers[-1][1].state is not AckState.APPLIED:
        return None
    client.observer.loop.use(new.manifest.id, new.matrix)
    return new


def _check_repeat(client: RtcClient, in_use: MatrixInUse) -> list[str]:
    """Send the commit of the matrix in use again; return a problem if its answer is another one."""
    # A service that lost the acknowledgement on the network sends its commit again.
    name, known = in_use.manifest.id, len(client.observer.acknowledgements)
    first_seq = {one.frame_seq for _, one in client.observer.acknowledgements if one.id == name}
    client.connection.offer(in_use.manifest, in_use.matrix)
    client.connection.put_commit(name, encode(in_use.manifest))
    answers = _wait_for_acknowledgements(client, name, MAX_APPLY_DELAY_S, known)
    if not answers or answers[-1][1].state is not AckState.APPLIED:
        return [f"the repeated commit: {_explain_outcome(client, name, answers)}"]
    again_seq = answers[-1][1].frame_seq
    return [] if again_seq in first_seq else [f"a repeated commit: applied again at {again_seq}"]


def _check_unreadable_commit(client: RtcClient) -> list[str]:
    """Send bytes that are no manifest; return a problem if they are not rejected without an id."""
    known = len(client.observer.acknowledgements)
    client.connection.put_commit(client.connection.new_id("unreadable"), b"\xc1 no manifest")

    def answered() -> bool:
        return any(
            acknowledgement.id is None
            for _, acknowledgement in client.observer.acknowledgements[known:]
        )

    if client.listen(MAX_APPLY_DELAY_S, answered):
        return []
    return ["an unreadable commit: no acknowledgement with id nil"]


def _wait_for_acknowledgements(
    client: RtcClient, name: str, patience_s: float, n_known: int = 0
) -> list[tuple[float, Acknowledgement]]:
    """Return the acknowledgements of a matrix up to a final one or the timeout."""

    def answers() -> list[tuple[float, Acknowledgement]]:
        every = client.observer.acknowledgements[n_known:]
        # Without an id it is the rejection of a commit that the RTC cannot read.
        return [(at_s, one) for at_s, one in every if one.id in {name, None}]

    client.listen(patience_s, lambda: any(one.state is not AckState.STAGED for _, one in answers()))
    return answers()


def _explain_outcome(
    client: RtcClient, name: str, acknowledgements: list[tuple[float, Acknowledgement]]
) -> str:
    """Return a text on what became of a matrix: its last acknowledgement, or that none came."""
    if acknowledgements and acknowledgements[-1][1].state is AckState.REJECTED:
        return f"rejected: {acknowledgements[-1][1].reason}"
    if acknowledgements and acknowledgements[-1][1].state is AckState.APPLIED:
        return "applied"
    words = "staged, and not applied" if acknowledgements else "no acknowledgement"
    frames = [a.header.seq0 for a in client.observer.arrivals if a.header.cm_id == name]
    in_frames = f", though frames name it from {frames[0]} on" if frames else ""
    return f"{words} within {ACKNOWLEDGEMENT_TIMEOUT_S:g} s{in_frames}"


def _status_has_matrix(client: RtcClient, name: str) -> bool:
    status = client.observer.status
    return status is not None and status.cm_id == name


def _find_contradictions(
    client: RtcClient, new: MatrixInUse, acknowledgement: Acknowledgement
) -> list[str]:
    """Return contradictions between the acknowledgement of a matrix, frames and status."""
    name, problems = new.manifest.id, []
    frames = [a.header.seq0 for a in client.observer.arrivals if a.header.cm_id == name]
    if not frames:
        problems.append("no frame names it")
    elif min(frames) != acknowledgement.frame_seq:
        problems.append(f"frames name it from {min(frames)} on")
    if not _status_has_matrix(client, name):
        problems.append(f"the status does not name it within {STATUS_TIMEOUT_S:g} s")
    status = client.observer.status
    if status is not None and acknowledgement.session != status.session:
        problems.append(
            f"its acknowledgement has session {acknowledgement.session}, the status has "
            f"{status.session}"
        )
    if acknowledgement.sha256 != new.manifest.layout.sha256:
        problems.append("its acknowledgement has another checksum")
    return problems + _read_back(client, new)


def _read_back(client: RtcClient, new: MatrixInUse) -> list[str]:
    """Return how the matrix that the RTC reports as applied differs from the one sent."""
    try:
        manifest, matrix = client.connection.fetch_applied()
    except (LinkError, WireError) as error:
        return [f"rtc/cm/applied afterwards: {error}"]
    if manifest.id != new.manifest.id:
        return [f"rtc/cm/applied afterwards has {manifest.id}"]
    same = np.array_equal(matrix, new.matrix)
    return [] if same else ["rtc/cm/applied afterwards has other numbers than were sent"]


# --- link and loop

ROUTER_DOWN_S: Final = 1.0
"""Time without a router."""

RECONNECT_TIMEOUT_S: Final = 10.0
"""Longest time until an RTC connects to its router again."""

LOOP_CHANGE_TIMEOUT_S: Final = 5.0
"""Longest time until frames and status show that the loop was opened or closed."""

OPEN_LOOP_S: Final = 1.0
"""Time for which the loop stays open."""

STROKE_M: Final = 20e-9
"""RMS of a push or pull, metres OPD; the default of the service."""

MEASURE_TIMEOUT_S: Final = 20.0
"""Longest time from the command to the measured matrix."""

_N_EQUAL_BATCHES: Final = 5
"""Number of batches with the same command from which the mirror counts as still."""

N_NOISE_MODES: Final = 10
"""Number of modes next to a measured one whose responses give the noise."""

PLAUSIBLE_RESPONSE: Final = (0.2, 3.0)
"""Range of a mode's response by the matrix in use: from a low optical gain to double pass."""


def check_reconnect(client: RtcClient) -> CheckResult:
    """Check that the RTC reconnects after its router was away for a second."""
    if not client.connection.own_router:
        return skipped("reconnect", "the router is another program")
    before = client.observer.session
    n_asked = len(client.observer.queries)
    # Closing the connection ends the router, as a restart of the service does.
    client.connection.close()
    client.listen(ROUTER_DOWN_S)
    opened_s = client.clock()
    client.connection.open()
    n_known = len(client.observer.arrivals)
    if not client.listen(RECONNECT_TIMEOUT_S, lambda: len(client.observer.arrivals) > n_known + 2):
        return wrong(
            "reconnect", f"no frame came within {RECONNECT_TIMEOUT_S:g} s after the router was back"
        )
    client.listen(1.0)
    back_s = client.observer.arrivals[n_known].at_s - opened_s
    found = f"frames again {back_s:.1f} s after the router was back"
    sessions = {arrival.header.session for arrival in client.observer.arrivals[n_known:]}
    if sessions != {before}:
        # A session means that the integrator started at zero. A lost link must not open the loop.
        return wrong("reconnect", f"{found}, in session {', '.join(sessions)} instead of {before}")
    current = client.connection.keys.current
    again = any(key == current for _, key in client.observer.queries[n_asked:])
    before_that = any(key == current for _, key in client.observer.queries[:n_asked])
    if again and before_that:
        return seen("reconnect", f"{found}; it queried cm/current again: once a session is enough")
    return fine("reconnect", f"{found}, in the same session")


def check_loop(client: RtcClient, status: Status) -> CheckResult:
    """Check that the loop opens with a zero integrator, and closes again."""
    if status.loop == Loop.OPEN:
        return skipped("loop", "the loop is open")
    refused = _send_command(
        client, LoopRequest(id=client.connection.new_id("open"), loop=Loop.OPEN)
    )
    if refused:
        return wrong("loop", f"it did not open: {refused}")
    try:
        opened = client.listen(LOOP_CHANGE_TIMEOUT_S, lambda: _loop_is(client, Loop.OPEN))
        during = client.observer.status
        client.listen(OPEN_LOOP_S)
    finally:  # also if the user interrupts the check: the loop must not stay open
        refused = _send_command(
            client, LoopRequest(id=client.connection.new_id("close"), loop=Loop.CLOSED)
        )
    problems = (
        _find_opening_problems(client, status) if opened else ["no status says that it is open"]
    )
    closed = client.listen(LOOP_CHANGE_TIMEOUT_S, lambda: not _loop_is(client, Loop.OPEN))
    client.listen(OPEN_LOOP_S)
    after = client.observer.status
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


def check_finite(client: RtcClient, status: Status, in_use: MatrixInUse) -> CheckResult:
    """Check that a matrix with a number that is not finite is rejected, with the loop open."""
    was_open, n_before = status.loop == Loop.OPEN, client.observer.n_nonfinite
    if not was_open:
        refused = _send_command(
            client, LoopRequest(id=client.connection.new_id("open"), loop=Loop.OPEN)
        )
        # Where the loop may be closed, such a matrix would reach every actuator in one frame.
        if refused or not client.listen(LOOP_CHANGE_TIMEOUT_S, lambda: _loop_is(client, Loop.OPEN)):
            return skipped("finite", f"the loop did not open: {refused or 'no status says so'}")
    problems, reasons, is_safe = list[str](), list[str](), False
    try:
        for value in (np.nan, np.inf):
            bad = in_use.matrix.copy()
            bad.flat[-1] = value
            new = in_use.copy_as(client.connection.new_id("finite")).with_numbers(bad)
            problem, reason = _offer_bad_matrix(client, f"a matrix with {value}", new, {})
            (problems if problem else reasons).append(problem or reason)
        is_safe = not problems
    finally:  # also if the user interrupts the check
        is_safe = is_safe or _put_back(client, in_use) is not None
        client.listen(OPEN_LOOP_S)
        if not was_open and is_safe and client.observer.n_nonfinite == n_before:
            refused = _send_command(
                client, LoopRequest(id=client.connection.new_id("close"), loop=Loop.CLOSED)
            )
            problems += [f"the loop is not closed again: {refused}"] if refused else []
        elif not was_open:
            problems.append("THE LOOP STAYS OPEN, because these numbers may still be in it")
    client.listen(LOOP_CHANGE_TIMEOUT_S, lambda: _loop_is(client, Loop.OPEN) is was_open)
    if problems:
        return wrong("finite", "; ".join(problems))
    return fine("finite", f"rejected: {'; '.join(reasons)}")


def _find_opening_problems(client: RtcClient, before: Status) -> list[str]:
    problems = []
    now = client.observer.status
    later = [a for a in client.observer.arrivals if a.header.session != before.session]
    if now is not None and now.session == before.session:
        problems.append("opening began no new session")
    elif not later:
        problems.append("no frame is of the new session")
    last_m = [arrival.largest_m for arrival in later[-_N_EQUAL_BATCHES:]]
    # A constant command above 0 is an integrator that kept its value. A dither changes with each
    # frame, and a mirror that returns slowly ends at 0.
    if len(last_m) == _N_EQUAL_BATCHES and last_m[0] > 0.0 and len(set(last_m)) == 1:
        problems.append(f"the command stays at {1e9 * last_m[0]:.3g} nm: the integrator is not 0")
    return problems


def check_measure(client: RtcClient, status: Status, in_use: MatrixInUse) -> CheckResult:
    """Check the measurement of two modes against the matrix in use."""
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
    n_known = len(client.observer.measured)
    try:
        reply = client.connection.command(request)
    except LinkError as error:  # the command is optional, and "replies" judges what must answer
        return skipped("measure", f"not offered: {error}")
    if reply.reason.startswith(("unsupported", "busy")):
        return skipped("measure", f"not offered now: {reply.reason}")
    if not reply.accepted:
        return wrong("measure", reply.reason or "refused without a reason")
    found = _wait_for_matrix(client, n_known)
    was_open = status.loop == Loop.OPEN
    back = client.listen(LOOP_CHANGE_TIMEOUT_S, lambda: _loop_is(client, Loop.OPEN) is was_open)
    client.listen(OPEN_LOOP_S)
    if not back:
        return wrong("measure", "the loop was not restored to its state before")
    return (
        wrong("measure", found)
        if isinstance(found, str)
        else _compare_measured(found, request, in_use)
    )


def _wait_for_matrix(client: RtcClient, n_known: int) -> MeasuredMatrix | str:
    """Return the measured matrix, or the reason why there is none."""
    collector, found = MeasuredIntake(client.connection.keys), list[MeasuredMatrix | str]()
    n_read = n_known

    def come() -> bool:
        nonlocal n_read
        for item in client.observer.measured[n_read:]:
            n_read += 1
            try:
                matrix = collector.take(item.key, item.data)
            except WireError as error:
                found.append(str(error))
            else:
                found.extend([] if matrix is None else [matrix])
        return bool(found)

    client.listen(MEASURE_TIMEOUT_S, come)
    return found[0] if found else f"no matrix within {MEASURE_TIMEOUT_S:g} s"


def _compare_measured(
    found: MeasuredMatrix, request: MeasureRequest, in_use: MatrixInUse
) -> CheckResult:
    manifest, matrix, modes = found.manifest, found.matrix, request.modes
    if matrix is None:
        return wrong("measure", f"it failed: {manifest.reason}")
    if (manifest.id, manifest.modes) != (request.id, modes):
        return wrong("measure", f"the matrix has id {manifest.id} and modes {manifest.modes}")
    if matrix.shape[0] != in_use.matrix.shape[1]:
        return wrong(
            "measure", f"it has {matrix.shape[0]} rows for {in_use.matrix.shape[1]} slopes"
        )
    # R D_measured: on its diagonal the optical gain if sign and unit are right, elsewhere noise.
    by_modes = in_use.matrix @ matrix
    own_responses = np.diag(by_modes[list(modes)])
    noise = max(
        float(np.median(np.abs(_neighbouring_responses(column, modes, mode))))
        for column, mode in zip(by_modes.T, modes, strict=True)
    )
    if noise > MAX_NOISE_RATIO * np.abs(own_responses).max():
        return skipped("measure", f"{list(matrix.shape)}; too noisy: noise is {noise:.2g}")
    own = " and ".join(f"{share:.2f}" for share in own_responses)
    text = f"{list(matrix.shape)}; response of the modes by the matrix in use: {own}"
    low, high = PLAUSIBLE_RESPONSE
    if (own_responses < low).any() or (own_responses > high).any():
        return wrong("measure", f"{text}, expected {low:g} to {high:g}: sign or unit")
    return fine("measure", text)


def _neighbouring_responses(
    column: NDArray[np.floating], measured: Sequence[int], mode: int
) -> NDArray[np.floating]:
    """Return the responses of modes next to the measured one, which are noise.

    Modes further away have another noise level, because turbulence and the noise of a sensor are
    strongest in the lowest modes.
    """
    others = np.setdiff1d(np.arange(len(column)), measured)
    return column[others[np.argsort(np.abs(others - mode), kind="stable")[:N_NOISE_MODES]]]


def _send_command(client: RtcClient, command: Command) -> str:
    """Send a command; return the reason of its refusal, empty if it was accepted."""
    try:
        reply = client.connection.command(command)
    except LinkError as error:
        return str(error)
    return "" if reply.accepted else reply.reason or "refused without a reason"


def _loop_is(client: RtcClient, wanted: Loop) -> bool:
    status = client.observer.status
    return status is not None and status.loop == wanted
