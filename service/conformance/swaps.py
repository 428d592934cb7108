"""Matrices on their way into an RTC: always the numbers that are in use already, under new ids."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.conformance.articles import Checked, fine, wrong
from service.conformance.talk import Talk
from service.wire import (
    CHUNK_LIMIT,
    Acknowledgement,
    AckState,
    Manifest,
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


def commit(talk: Talk, before: MatrixInUse) -> tuple[Checked, MatrixInUse | None]:
    """Send the matrix again, commit last; return what came of it, and what is applied, if it is."""
    new = before.named(talk.ear.new_id("commit"))
    name = new.manifest.id
    talk.ear.offer(new.manifest, new.matrix)
    for index, part in enumerate(new.parts):
        talk.ear.put_chunk(name, index, part)
    began_s = talk.clock()
    talk.ear.put_commit(name, encode(new.manifest))
    said = _answers(talk, name, PATIENCE_S)
    last = said[-1][1] if said else None
    if last is None or last.state is not AckState.APPLIED:
        return wrong("commit", _without(talk, name, said)), None
    took_s = said[-1][0] - began_s
    talk.watch.loop.use(name, new.matrix)
    found = f"applied {took_s:.2f} s after its commit, from frame {last.frame_seq}"
    talk.listen(TOLD_S, lambda: _status_names(talk, name))
    problems = _problems(talk, new, last)
    if took_s > APPLIED_S:
        problems.insert(0, f"more than {APPLIED_S:g} s")
    if problems:
        return wrong("commit", f"{found}: {'; '.join(problems)}"), new
    return fine("commit", f"{found} on, as frames and status say"), new


def chunks(talk: Talk, before: MatrixInUse) -> tuple[Checked, MatrixInUse | None]:
    """Send the commit first and leave one part out: the RTC has to ask for it."""
    new = before.named(talk.ear.new_id("chunks"))
    name = new.manifest.id
    talk.ear.offer(new.manifest, new.matrix)
    began_s = talk.clock()
    talk.ear.put_commit(name, encode(new.manifest))
    for index, part in enumerate(new.parts):
        if index != _LEFT_OUT:
            talk.ear.put_chunk(name, index, part)
    wanted = f"{talk.ear.keys.matrix(name)}?chunk={_LEFT_OUT}"
    said = _answers(talk, name, PATIENCE_S)
    asked = [at_s - began_s for at_s, key in talk.watch.asked if key == wanted]
    if not said or said[-1][1].state is not AckState.APPLIED:
        tail = _without(talk, name, said)
        when = f"it asked for it after {asked[0]:.1f} s" if asked else "it did not ask for it"
        return wrong("chunks", f"chunk {_LEFT_OUT} was left out: {when}; {tail}"), None
    talk.watch.loop.use(name, new.matrix)
    if not asked:
        return wrong("chunks", f"applied though chunk {_LEFT_OUT} never came"), new
    found = f"chunk {_LEFT_OUT}, left out, was asked for after {asked[0]:.1f} s"
    late = asked[0] > MISSING_S + 1.0
    return (wrong if late else fine)("chunks", f"{found}; then it was applied"), new


def rejection(talk: Talk, in_use: MatrixInUse) -> Checked:
    """Send what must be rejected; whatever is applied all the same has the numbers in use."""
    problems, reasons = [], []
    for what, manifest in _bad_manifests(talk, in_use):
        name = manifest.id
        known = len(talk.watch.acknowledgements)
        for index, part in enumerate(in_use.named(name).parts):
            talk.ear.put_chunk(name, index, part)
        talk.ear.put_commit(name, encode(manifest))
        said = _answers(talk, name, PATIENCE_S, known)
        if not said or said[-1][1].state is not AckState.REJECTED:
            problems.append(f"{what}: {_without(talk, name, said)}")
        else:
            reasons.append(f"{what} ({said[-1][1].reason:.40})")
    problems += _repeated(talk, in_use)
    problems += _unreadable(talk)
    if problems:
        return wrong("rejection", "; ".join(problems))
    return fine("rejection", f"rejected: {'; '.join(reasons)}; a repeat was answered again")


def _bad_manifests(talk: Talk, in_use: MatrixInUse) -> list[tuple[str, Manifest]]:
    new = talk.ear.new_id
    other_sum = hashlib.sha256(b"other numbers").hexdigest()
    of_sum = in_use.named(new("sum")).manifest
    of_basis = in_use.named(new("basis")).manifest
    used = in_use.manifest
    return [
        ("a wrong sum", replace(of_sum, layout=replace(of_sum.layout, sha256=other_sum))),
        ("another basis", replace(of_basis, basis_id="no-basis-of-this-rtc")),
        ("a used id", replace(used, layout=replace(used.layout, sha256=other_sum))),
    ]


def _repeated(talk: Talk, in_use: MatrixInUse) -> list[str]:
    """Send the commit of the matrix in use again: its acknowledgement must come again."""
    name, known = in_use.manifest.id, len(talk.watch.acknowledgements)
    talk.ear.put_commit(name, encode(in_use.manifest))
    said = _answers(talk, name, APPLIED_S, known)
    if said and said[-1][1].state is AckState.APPLIED:
        return []
    return [f"the same commit again: {_without(talk, name, said)}"]


def _unreadable(talk: Talk) -> list[str]:
    """Send a commit that is none: it must be rejected without id and sum."""
    known = len(talk.watch.acknowledgements)
    talk.ear.put_commit(talk.ear.new_id("unreadable"), b"\xc1 no manifest")

    def answered() -> bool:
        return any(said.id is None for _, said in talk.watch.acknowledgements[known:])

    if talk.listen(APPLIED_S, answered):
        return []
    return ["a commit that cannot be read: no acknowledgement with id nil"]


def _answers(
    talk: Talk, name: str, patience_s: float, known: int = 0
) -> list[tuple[float, Acknowledgement]]:
    """Return what is said of a matrix, once that is final or the time is over."""

    def said() -> list[tuple[float, Acknowledgement]]:
        every = talk.watch.acknowledgements[known:]
        return [(at_s, one) for at_s, one in every if one.id == name]

    talk.listen(patience_s, lambda: any(one.state is not AckState.STAGED for _, one in said()))
    return said()


def _without(talk: Talk, name: str, said: list[tuple[float, Acknowledgement]]) -> str:
    """Return in words how a matrix fared that was not applied, or nobody said so."""
    if said and said[-1][1].state is AckState.REJECTED:
        return f"rejected: {said[-1][1].reason}"
    if said and said[-1][1].state is AckState.APPLIED:
        return "applied"
    words = "staged, and not applied" if said else "no acknowledgement"
    frames = [a.header.seq0 for a in talk.watch.arrivals if a.header.cm_id == name]
    named = f", though frames name it from {frames[0]} on" if frames else ""
    return f"{words} within {PATIENCE_S:g} s{named}"


def _status_names(talk: Talk, name: str) -> bool:
    status = talk.watch.status
    return status is not None and status.cm_id == name


def _problems(talk: Talk, new: MatrixInUse, said: Acknowledgement) -> list[str]:
    """Return what contradicts the acknowledgement of a matrix that is in use."""
    name, problems = new.manifest.id, []
    frames = [a.header.seq0 for a in talk.watch.arrivals if a.header.cm_id == name]
    if not frames:
        problems.append("no frame names it")
    elif min(frames) != said.frame_seq:
        problems.append(f"frames name it from {min(frames)} on")
    if not _status_names(talk, name):
        problems.append(f"the status does not within {TOLD_S:g} s")
    status = talk.watch.status
    if status is not None and said.session != status.session:
        problems.append(f"it is of session {said.session}, the status of {status.session}")
    if said.sha256 != new.manifest.layout.sha256:
        problems.append("its sum is another one")
    return problems
