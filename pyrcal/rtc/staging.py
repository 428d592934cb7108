"""Reconstructors on their way into the loop: collect the parts, check them, stage, acknowledge."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

from pyrcal.rtc.identity import Identity, Reconstructor
from service.errors import WireError
from service.wire import TEXT_LIMIT, Acknowledgement, AckState, ChunkAssembler, Manifest

_CHUNK_TIMEOUT_S = 2.0
"""Time allowed for missing chunks, once before and once after they were requested again."""

_MAX_COLLECTED_MATRICES = 4
"""Matrices that may arrive at the same time; beyond this number the oldest is dropped."""

_MAX_REMEMBERED_ANSWERS = 1000
"""Acknowledgements that are kept, so that a repeated commit gets the same answer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Terms:
    """Present requirements on a new reconstructor."""

    session: str
    """Session of the frames to come."""

    identity: Identity
    """Names that the manifest must carry."""

    n_slopes: int
    """Number of columns."""

    n_controlled: tuple[int, ...]
    """Accepted numbers of rows: the present number of modes, and the one last requested."""

    def refusal(self, manifest: Manifest) -> str:
        """Return the reason to reject the manifest, in the contract's words, or an empty string."""
        # The present number of modes stays valid after another was requested: that number takes
        # effect only with the next matrix.
        rows, columns = manifest.layout.shape
        if columns != self.n_slopes or rows not in self.n_controlled:
            expected = " or ".join(str([n, self.n_slopes]) for n in self.n_controlled)
            return f"range: shape {[rows, columns]}, expected {expected}"
        for name in ("basis_id", "config_id", "system"):
            found, expected = getattr(manifest, name), getattr(self.identity, name)
            if found != expected:
                return f"id: {name} {found!r}, expected {expected!r}"
        return ""


@dataclass(slots=True, kw_only=True)
class _Collection:
    """Chunks of one matrix, and its manifest once it has arrived."""

    parts: ChunkAssembler
    manifest: Manifest | None = None
    deadline_s: float = float("inf")
    requested_again: bool = False


@dataclass(slots=True, kw_only=True)
class Replies:
    """Actions for the link after a message or a timeout."""

    acknowledgements: list[Acknowledgement] = field(default_factory=list)
    """Acknowledgements to send, in order."""

    staged: list[Reconstructor] = field(default_factory=list)
    """Complete reconstructors to pass to the loop."""

    missing: list[tuple[str, tuple[int, ...]]] = field(default_factory=list)
    """Id and chunk numbers of incomplete matrices, to request again."""


class Staging:
    """Collects the chunks of reconstructors until each is complete, checked and acknowledged.

    It uses no clock and no network: time is an argument, and the caller sends what is returned.

    Parameters
    ----------
    terms
        Returns what a reconstructor must agree with at present.
    limit_bytes
        Size of the largest matrix accepted.
    """

    def __init__(self, terms: Callable[[], Terms], *, limit_bytes: int) -> None:
        self._terms = terms
        self._limit_bytes = limit_bytes
        self._collected: OrderedDict[str, _Collection] = OrderedDict()
        self._answers: OrderedDict[str, Acknowledgement] = OrderedDict()

    def chunk(self, matrix_id: str, index: int, data: bytes) -> Replies:
        """Add one chunk. An invalid chunk is dropped and requested again after the timeout."""
        # Late or repeated chunks of a matrix that is settled. A new collection for them would never
        # be completed, and could displace one in progress.
        if matrix_id in self._answers:
            return Replies()
        with suppress(WireError):
            self._collection(matrix_id).parts.add(index, data)
        return self._complete(matrix_id)

    def commit(self, manifest: Manifest, now_s: float) -> Replies:
        """Add the manifest, which is the order to stage the matrix and swap it in."""
        known = self._answers.get(manifest.id)
        if known is not None:
            return self._repeat_answer(manifest, known)
        collection = self._collection(manifest.id)
        # A repeated commit must not extend the deadline.
        if collection.manifest is not None:
            return Replies()
        collection.manifest = manifest
        refusal = self._terms().refusal(manifest)
        if refusal:
            return self._reject(manifest.id, refusal)
        # The deadline starts with the manifest, which alone says how many chunks there are.
        collection.deadline_s = now_s + _CHUNK_TIMEOUT_S
        # Chunks that contradict the manifest are dropped here and requested again by poll().
        with suppress(WireError):
            collection.parts.announce(manifest.layout)
        return self._complete(manifest.id)

    def poll(self, now_s: float) -> Replies:
        """Request missing chunks after the first timeout; reject the matrix after the second."""
        outcome = Replies()
        # Without a manifest the deadline is infinite. _reject() changes the dictionary.
        for matrix_id, collection in list(self._collected.items()):
            if now_s < collection.deadline_s:
                continue
            missing = collection.parts.missing()
            if collection.requested_again:
                reason = f"missing: chunks {list(missing[:8])}, {len(missing)} in all"
                outcome.acknowledgements += self._reject(matrix_id, reason).acknowledgements
            else:
                collection.requested_again, collection.deadline_s = True, now_s + _CHUNK_TIMEOUT_S
                outcome.missing.append((matrix_id, missing))
        return outcome

    def applied(self, matrix_id: str, frame_seq: int) -> Acknowledgement | None:
        """Record a swap and return its acknowledgement, or None if the matrix was voided."""
        staged = self._answers.get(matrix_id)
        # void() drops staged answers, so a swap that belongs to an ended session is not found.
        if staged is None:
            return None
        return self._remember(replace(staged, state=AckState.APPLIED, frame_seq=frame_seq))

    def void(self) -> None:
        """Drop all matrices that are not applied yet, because a new session begins."""
        self._collected.clear()
        for matrix_id, acknowledgement in list(self._answers.items()):
            # Applied and rejected ones stay settled: their ids are never used again.
            if acknowledgement.state is AckState.STAGED:
                del self._answers[matrix_id]

    def _collection(self, matrix_id: str) -> _Collection:
        if matrix_id not in self._collected:
            parts = ChunkAssembler(self._limit_bytes)
            self._collected[matrix_id] = _Collection(parts=parts)
            # Chunks may come without a commit ever: their memory is bounded.
            if len(self._collected) > _MAX_COLLECTED_MATRICES:
                self._collected.popitem(last=False)
        return self._collected[matrix_id]

    def _complete(self, matrix_id: str) -> Replies:
        collection = self._collected[matrix_id]
        if collection.manifest is None or not collection.parts.complete:
            return Replies()
        try:
            matrix = collection.parts.matrix()
        except WireError as error:
            return self._reject(matrix_id, str(error))
        manifest = collection.manifest
        del self._collected[matrix_id]
        return Replies(
            acknowledgements=[self._remember(self.answer(manifest, AckState.STAGED))],
            staged=[Reconstructor(manifest=manifest, matrix=matrix)],
        )

    def _reject(self, matrix_id: str, reason: str) -> Replies:
        manifest = self._collected.pop(matrix_id).manifest
        # Without a manifest there is no order to answer.
        if manifest is None:
            return Replies()
        return Replies(
            acknowledgements=[self._remember(self.answer(manifest, AckState.REJECTED, reason))]
        )

    def _repeat_answer(self, manifest: Manifest, known: Acknowledgement) -> Replies:
        """Repeat the answer to a repeated commit; reject an id that belongs to another matrix."""
        if manifest.layout.sha256 == known.sha256:
            # In the present session, because the service ignores acknowledgements of others.
            return Replies(acknowledgements=[replace(known, session=self._terms().session)])
        # This rejection is not remembered: the first matrix keeps its answer under the id.
        reason = f"id: {manifest.id} was used with sha256 {known.sha256}, expected a new id"
        return Replies(acknowledgements=[self.answer(manifest, AckState.REJECTED, reason)])

    def answer(self, manifest: Manifest, state: AckState, reason: str = "") -> Acknowledgement:
        """Return an acknowledgement for a matrix in the present session."""
        return Acknowledgement(
            session=self._terms().session,
            id=manifest.id,
            sha256=manifest.layout.sha256,
            state=state,
            reason=reason,
            frame_seq=None,
        )

    def unreadable(self, reason: str) -> Acknowledgement:
        """Return the rejection of a commit that cannot be decoded: its matrix is unknown."""
        return Acknowledgement(
            session=self._terms().session,
            id=None,
            sha256=None,
            state=AckState.REJECTED,
            reason=reason[:TEXT_LIMIT],
            frame_seq=None,
        )

    def _remember(self, acknowledgement: Acknowledgement) -> Acknowledgement:
        # An unreadable commit has no id under which it could be repeated.
        if acknowledgement.id is not None:
            self._answers[acknowledgement.id] = acknowledgement
            # A replaced entry keeps its old place in the dictionary and would be dropped too early.
            self._answers.move_to_end(acknowledgement.id)
        if len(self._answers) > _MAX_REMEMBERED_ANSWERS:
            self._answers.popitem(last=False)
        return acknowledgement
