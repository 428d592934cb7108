"""Stage reconstructors and swap them into the loop.

Collect, check, stage, swap, acknowledge.
"""

from __future__ import annotations

import hashlib
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from service.errors import WireError
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import BasisKind, SignalKind
from service.model.misregistration import Misregistration
from service.model.modes import Basis
from service.model.sensors.registry import kind_of
from service.wire import (
    TEXT_LIMIT,
    Acknowledgement,
    AckState,
    ChunkAssembler,
    Manifest,
    checksum,
)
from sim_rtc.computer.telemetry import Identity, Reconstructor

Array32 = NDArray[np.float32]

_WAIT_S = 2.0
"""How long missing chunks are waited for, before and again after they have been asked for."""

_MOST_COLLECTED = 4
"""Matrices collected at a time; beyond it the oldest is forgotten."""

_MOST_REMEMBERED = 1000
_SMALLEST_SINGULAR_RATIO = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Terms:
    """Conditions that a reconstructor must fit."""

    session: str
    identity: Identity
    n_slopes: int
    n_controlled: tuple[int, ...]
    """Numbers of rows the loop takes: the present one, and the one a command has asked for."""

    def refusal(self, manifest: Manifest) -> str:
        """Return why the manifest does not fit; empty: it does."""
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
    """Parts of one matrix, and its manifest once it has come."""

    parts: ChunkAssembler
    manifest: Manifest | None = None
    deadline_s: float = float("inf")
    asked: bool = False


@dataclass(slots=True, kw_only=True)
class Outcome:
    """Acknowledgements and queries that follow from an arrival or from elapsed time."""

    said: list[Acknowledgement] = field(default_factory=list)
    """To be sent, in order."""

    staged: list[Reconstructor] = field(default_factory=list)
    """To be handed to the loop."""

    missing: list[tuple[str, tuple[int, ...]]] = field(default_factory=list)
    """Ids and chunk numbers to be asked for."""


class Staging:
    """Reconstructors on their way in; time is an argument, the link sends."""

    def __init__(self, terms: Callable[[], Terms], *, limit_bytes: int) -> None:
        self._terms = terms
        self._limit_bytes = limit_bytes
        self._collected: OrderedDict[str, _Collection] = OrderedDict()
        self._said: OrderedDict[str, Acknowledgement] = OrderedDict()

    def chunk(self, matrix_id: str, index: int, data: bytes) -> Outcome:
        """Take one part; one that cannot be right is dropped and asked for again in time."""
        if matrix_id in self._said:
            return Outcome()
        with suppress(WireError):
            self._collection(matrix_id).parts.add(index, data)
        return self._complete(matrix_id)

    def commit(self, manifest: Manifest, now_s: float) -> Outcome:
        """Take a manifest: the order to stage and swap."""
        known = self._said.get(manifest.id)
        if known is not None:
            return self._repeated(manifest, known)
        collection = self._collection(manifest.id)
        if collection.manifest is not None:
            return Outcome()
        collection.manifest = manifest
        refusal = self._terms().refusal(manifest)
        if refusal:
            return self._reject(manifest.id, refusal)
        collection.deadline_s = now_s + _WAIT_S
        # Parts that do not fit the manifest are dropped by it, and so will be asked for.
        with suppress(WireError):
            collection.parts.announce(manifest.layout)
        return self._complete(manifest.id)

    def poll(self, now_s: float) -> Outcome:
        """Ask for what is missing when the wait is over, and give up after a second wait."""
        outcome = Outcome()
        for matrix_id, collection in list(self._collected.items()):
            if now_s < collection.deadline_s:
                continue
            missing = collection.parts.missing()
            if collection.asked:
                reason = f"missing: chunks {list(missing[:8])}, {len(missing)} in all"
                outcome.said += self._reject(matrix_id, reason).said
            else:
                collection.asked, collection.deadline_s = True, now_s + _WAIT_S
                outcome.missing.append((matrix_id, missing))
        return outcome

    def applied(self, matrix_id: str, frame_seq: int) -> Acknowledgement | None:
        """Note that the loop has swapped; return the acknowledgement, None if it was voided."""
        staged = self._said.get(matrix_id)
        if staged is None:
            return None
        return self._remember(replace(staged, state=AckState.APPLIED, frame_seq=frame_seq))

    def void(self) -> None:
        """Forget matrices not applied yet: a new session begins."""
        self._collected.clear()
        for matrix_id, acknowledgement in list(self._said.items()):
            if acknowledgement.state is AckState.STAGED:
                del self._said[matrix_id]

    def _collection(self, matrix_id: str) -> _Collection:
        if matrix_id not in self._collected:
            parts = ChunkAssembler(self._limit_bytes)
            self._collected[matrix_id] = _Collection(parts=parts)
            if len(self._collected) > _MOST_COLLECTED:
                self._collected.popitem(last=False)
        return self._collected[matrix_id]

    def _complete(self, matrix_id: str) -> Outcome:
        collection = self._collected[matrix_id]
        if collection.manifest is None or not collection.parts.complete:
            return Outcome()
        try:
            matrix = collection.parts.matrix()
        except WireError as error:
            return self._reject(matrix_id, str(error))
        manifest = collection.manifest
        del self._collected[matrix_id]
        return Outcome(
            said=[self._remember(self.answer(manifest, AckState.STAGED))],
            staged=[Reconstructor(manifest=manifest, matrix=matrix)],
        )

    def _reject(self, matrix_id: str, reason: str) -> Outcome:
        manifest = self._collected.pop(matrix_id).manifest
        if manifest is None:
            return Outcome()
        return Outcome(said=[self._remember(self.answer(manifest, AckState.REJECTED, reason))])

    def _repeated(self, manifest: Manifest, known: Acknowledgement) -> Outcome:
        """Repeat the answer for the same matrix; refuse an id that is used for another."""
        if manifest.layout.sha256 == known.sha256:
            return Outcome(said=[replace(known, session=self._terms().session)])
        reason = f"id: {manifest.id} was used with sha256 {known.sha256}, expected a new id"
        return Outcome(said=[self.answer(manifest, AckState.REJECTED, reason)])

    def answer(self, manifest: Manifest, state: AckState, reason: str = "") -> Acknowledgement:
        """Return the acknowledgement of a matrix in the present session."""
        return Acknowledgement(
            session=self._terms().session,
            id=manifest.id,
            sha256=manifest.layout.sha256,
            state=state,
            reason=reason,
            frame_seq=None,
        )

    def unreadable(self, reason: str) -> Acknowledgement:
        """Return the answer to an unreadable commit: it names no matrix."""
        return Acknowledgement(
            session=self._terms().session,
            id=None,
            sha256=None,
            state=AckState.REJECTED,
            reason=reason[:TEXT_LIMIT],
            frame_seq=None,
        )

    def _remember(self, acknowledgement: Acknowledgement) -> Acknowledgement:
        if acknowledgement.id is not None:
            self._said[acknowledgement.id] = acknowledgement
            self._said.move_to_end(acknowledgement.id)
        if len(self._said) > _MOST_REMEMBERED:
            self._said.popitem(last=False)
        return acknowledgement


def truncated_inverse(interaction: Array32) -> Array32:
    """Return the pseudo-inverse of D ``(n_slopes, n_modes)`` without its weakest directions."""
    u, values, vh = scipy.linalg.svd(interaction.astype(np.float64), full_matrices=False)
    kept = values > _SMALLEST_SINGULAR_RATIO * values[0]
    inverse = (vh[kept].T / values[kept]) @ u[:, kept].T
    return np.ascontiguousarray(inverse, dtype=np.float32)


def initial_reconstructor(
    instrument: Instrument,
    basis: Basis,
    identity: Identity,
    n_controlled: int,
    aligned: Misregistration,
) -> Reconstructor:
    """Return the matrix before any flexure: the inverse of the model where all is aligned."""
    interaction = InteractionModel(instrument, basis).interaction_matrix(aligned)
    return own_reconstructor(interaction[:, :n_controlled], identity, aligned)


def own_reconstructor(
    interaction: NDArray[Any], identity: Identity, alpha: Misregistration | None = None
) -> Reconstructor:
    """Return the pseudo-inverse of D ``(n_slopes, n_controlled)`` as the RTC's own matrix.

    ``alpha`` is the registration that D belongs to; None if it is not known.
    """
    matrix = truncated_inverse(interaction.astype(np.float32))
    name = f"initial-{len(matrix)}-{checksum(matrix)[:8]}"
    told = None if alpha is None else alpha.to_boundary()
    return Reconstructor.own(name, matrix, identity, created_ns=time.time_ns(), alpha=told)


def identity_of(instrument: Instrument, valid: NDArray[np.bool_]) -> Identity:
    """Return the names of basis and sensor configuration: they change when either does."""
    mirror, wfs = instrument.analytic_mirror, instrument.wfs
    basis = hashlib.sha256(np.round(mirror.positions_m, 6).tobytes())
    basis.update(repr((mirror.shape.influence, mirror.shape.coupling, instrument.modes)).encode())
    kind = "kl"
    if mirror.mode_to_actuator is not None or mirror.basis is not BasisKind.KARHUNEN_LOEVE:
        kind = "own"
        strokes = mirror.mode_to_actuator
        basis.update(b"zonal" if strokes is None else np.round(strokes, 9).tobytes())
    sensor = hashlib.sha256(np.packbits(valid).tobytes())
    sensor.update(repr(kind_of(instrument).identity(wfs)).encode())
    if instrument.slopes.kind is not SignalKind.XY:
        sensor.update(instrument.slopes.kind.encode())
    config_id = instrument.config_id
    if not instrument.sensor_modes or config_id is None:
        config_id = f"{wfs.kind}-{wfs.n_subapertures}-{sensor.hexdigest()[:8]}"
    return Identity(
        system=instrument.name,
        basis_id=f"{kind}-{instrument.modes.n_modes}-{basis.hexdigest()[:8]}",
        config_id=config_id,
    )
