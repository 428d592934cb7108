"""Send and receive matrices in parts."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from service import wire
from service.errors import UnknownIdError, WireError
from service.records.events import Event

MAX_OFFERS: Final = 8
"""Most matrices kept, whatever their age; the current one is always among them."""

MAX_PENDING_MATRICES: Final = 2
"""Measured matrices on their way at once; the one that was begun first gives way."""

MAX_MATRIX_BYTES: Final = 1_000_000_000
"""Most memory for one of them."""

MAX_REMEMBERED_IDS: Final = 4096
"""Ids whose acknowledgements are recognised."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredMatrix:
    """An interaction matrix the RTC has measured, or why it could not."""

    manifest: wire.MeasuredManifest
    matrix: NDArray[np.float32] | None
    """``(n_slopes, n_modes_measured)``, slope per metre OPD; None: see the manifest's reason."""


LinkEvent = Event | MeasuredMatrix
"""Messages of the RTC other than frames; a matrix becomes an event for the tracker once archived.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Offer:
    """One reconstructor in the form it travels in."""

    manifest: wire.Manifest
    commit: bytes
    """The encoded manifest."""

    parts: tuple[bytes, ...]
    offered_s: float
    """Time of the offer, on a monotonic clock."""

    @classmethod
    def of(cls, manifest: wire.Manifest, matrix: NDArray[np.float32]) -> Self:
        """Return a matrix in the parts of its manifest, offered from now on."""
        parts = tuple(wire.split(matrix, manifest.layout.chunk_bytes))
        return cls(
            manifest=manifest, commit=wire.encode(manifest), parts=parts, offered_s=time.monotonic()
        )


class Outbox:
    """Keeps what was published for those who come late; thread-safe."""

    def __init__(self, keep_s: float) -> None:
        self._keep_s = keep_s
        self._lock = threading.Lock()
        self._offers: OrderedDict[str, Offer] = OrderedDict()
        self._sums: OrderedDict[str, str] = OrderedDict()
        self._current: str | None = None

    def add(self, offer: Offer) -> None:
        """Offer a matrix from now on.

        Raises
        ------
        WireError
            If its id has been used for another matrix: ids are never reused.
        """
        name, found = offer.manifest.id, offer.manifest.layout.sha256
        with self._lock:
            # Checksums are kept longer than offers: an id is never reused, however old.
            known = self._sums.setdefault(name, found)
            if known != found:
                raise WireError(f"id: {name} already names a matrix with sha256 {known}")
            if len(self._sums) > MAX_REMEMBERED_IDS:
                self._sums.popitem(last=False)
            self._offers[name] = offer
            # _forget drops from the front: an offer that is repeated counts as new.
            self._offers.move_to_end(name)
            self._forget(offer.offered_s)

    def knows(self, matrix_id: str) -> bool:
        """Return whether a matrix of this id was ever offered by this process."""
        with self._lock:
            return matrix_id in self._sums

    def set_current(self, matrix_id: str | None) -> None:
        """Say which offer answers ``cm/current``; None: nothing.

        Raises
        ------
        UnknownIdError
            If it is not on offer.
        """
        with self._lock:
            if matrix_id is not None and matrix_id not in self._offers:
                raise UnknownIdError(f"reconstructor {matrix_id} is not on offer")
            self._current = matrix_id

    def adopt(self, matrix_id: str, sha256: str | None) -> None:
        """Make an offer the current one if it is still there, and of this sum."""
        with self._lock:
            # An acknowledgement with another checksum is of other numbers under this id.
            if matrix_id in self._offers and self._sums.get(matrix_id) == sha256:
                self._current = matrix_id

    @property
    def current(self) -> Offer | None:
        """The offer that answers ``cm/current``; None: there is none."""
        with self._lock:
            return None if self._current is None else self._offers.get(self._current)

    def answer(self, matrix_id: str, index: int | None, now_s: float) -> bytes:
        """Return the manifest of an offer, or its part ``index``.

        Raises
        ------
        UnknownIdError
            If the matrix is not on offer or has no such part.
        """
        with self._lock:
            self._forget(now_s)
            offer = self._offers.get(matrix_id)
        if offer is None:
            raise UnknownIdError(f"reconstructor {matrix_id} is not on offer")
        if index is None:
            return offer.commit
        if not 0 <= index < len(offer.parts):
            raise UnknownIdError(f"chunk {index} of {matrix_id}: there are {len(offer.parts)}")
        return offer.parts[index]

    def asked(self, keys: wire.Keys, key: str, part: str | None, now_s: float) -> bytes:
        """Return what answers a query on ``cm/current`` or ``cm/{id}``, or for its ``?chunk=``.

        Raises
        ------
        UnknownIdError
            If it is not on offer.
        WireError
            If key or part are none.
        """
        if key == keys.current:
            offer = self.current
            if offer is None:
                raise UnknownIdError("nothing to offer")
            return offer.commit
        index = None if part is None else wire.parse_chunk_index(part, "a query")
        return self.answer(keys.matrix_id_of(key), index, now_s)

    def _forget(self, now_s: float) -> None:
        idle = [name for name in self._offers if name != self._current]
        crowd = len(self._offers) - MAX_OFFERS
        for position, name in enumerate(idle):
            if position < crowd or now_s - self._offers[name].offered_s > self._keep_s:
                del self._offers[name]


class MeasuredIntake:
    """Collects parts and manifests of interaction matrices; used by one zenoh thread only."""

    def __init__(self, keys: wire.Keys) -> None:
        self._keys = keys
        self._pending: OrderedDict[str, wire.ChunkAssembler] = OrderedDict()
        self._manifests: dict[str, wire.MeasuredManifest] = {}

    def take(self, key: str, data: bytes) -> MeasuredMatrix | None:
        """Take a part or a manifest; return the matrix it completes.

        Raises
        ------
        WireError
            If it breaks the contract; a matrix with a wrong checksum is forgotten.
        """
        name = self._keys.matrix_id_of(key)
        index = self._keys.chunk_index_of(key)
        if index is not None:
            self._assembler(name).add(index, data)
        else:
            manifest = self._check(name, data)
            # A measurement that failed has a manifest and no parts, so it is complete.
            if not manifest.layout.n_chunks:
                self._forget(name)
                return MeasuredMatrix(manifest=manifest, matrix=None)
            self._assembler(name).announce(manifest.layout)
            self._manifests[name] = manifest
        return self._finish(name)

    def _check(self, name: str, data: bytes) -> wire.MeasuredManifest:
        manifest = wire.decode(wire.MeasuredManifest, data)
        if (manifest.id, manifest.system) != (name, self._keys.system):
            raise WireError(
                f"id: the manifest of {manifest.id} of system {manifest.system} came on the key "
                f"of {name} of system {self._keys.system}"
            )
        return manifest

    def _assembler(self, name: str) -> wire.ChunkAssembler:
        if name not in self._pending:
            if len(self._pending) == MAX_PENDING_MATRICES:
                self._forget(next(iter(self._pending)))
            self._pending[name] = wire.ChunkAssembler(MAX_MATRIX_BYTES)
        return self._pending[name]

    def _finish(self, name: str) -> MeasuredMatrix | None:
        assembler = self._pending[name]
        if not assembler.complete:
            return None
        manifest = self._manifests[name]
        # First, because matrix() raises if the checksum is wrong, and that matrix must be forgotten
        # too.
        self._forget(name)
        return MeasuredMatrix(manifest=manifest, matrix=assembler.matrix())

    def _forget(self, name: str) -> None:
        self._pending.pop(name, None)
        self._manifests.pop(name, None)
