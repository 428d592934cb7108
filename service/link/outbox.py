"""Reconstructors an RTC may ask for."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

from service.errors import UnknownIdError, WireError
from service.wire import Manifest

OFFERS: Final = 8
"""Most matrices kept, whatever their age; the current one is always among them."""

REMEMBERED_IDS: Final = 4096
"""Ids whose acknowledgements are recognised."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Offer:
    """One reconstructor in the form it travels in."""

    manifest: Manifest
    commit: bytes
    """The encoded manifest."""

    parts: tuple[bytes, ...]
    offered_s: float
    """When, on a monotonic clock."""


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
            known = self._sums.setdefault(name, found)
            if known != found:
                raise WireError(f"id: {name} already names a matrix with sha256 {known}")
            if len(self._sums) > REMEMBERED_IDS:
                self._sums.popitem(last=False)
            self._offers[name] = offer
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
            if matrix_id in self._offers and self._sums.get(matrix_id) == sha256:
                self._current = matrix_id

    def current_commit(self) -> bytes:
        """Return the manifest that answers ``cm/current``.

        Raises
        ------
        UnknownIdError
            If there is nothing to offer.
        """
        with self._lock:
            if self._current is None:
                raise UnknownIdError("nothing to offer")
            return self._offers[self._current].commit

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

    def _forget(self, now_s: float) -> None:
        idle = [name for name in self._offers if name != self._current]
        crowd = len(self._offers) - OFFERS
        for position, name in enumerate(idle):
            if position < crowd or now_s - self._offers[name].offered_s > self._keep_s:
                del self._offers[name]
