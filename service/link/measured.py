"""Interaction matrices the RTC sends, put together."""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from service.errors import WireError
from service.link.events import MeasuredMatrix
from service.wire import ChunkAssembler, Keys, MeasuredManifest, decode_measured_manifest

PENDING: Final = 2
"""Matrices on their way at once; the one that was begun first gives way."""

LIMIT_BYTES: Final = 1_000_000_000
"""Most memory for one of them."""


class MeasuredIntake:
    """Collects parts and manifests; used by one zenoh thread only."""

    def __init__(self, keys: Keys) -> None:
        self._keys = keys
        self._pending: OrderedDict[str, ChunkAssembler] = OrderedDict()
        self._manifests: dict[str, MeasuredManifest] = {}

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
            manifest = self._checked(name, data)
            if not manifest.layout.n_chunks:
                self._forget(name)
                return MeasuredMatrix(manifest=manifest, matrix=None)
            self._assembler(name).announce(manifest.layout)
            self._manifests[name] = manifest
        return self._finished(name)

    def _checked(self, name: str, data: bytes) -> MeasuredManifest:
        manifest = decode_measured_manifest(data)
        if (manifest.id, manifest.system) != (name, self._keys.system):
            raise WireError(
                f"id: the manifest of {manifest.id} of system {manifest.system} came on the key "
                f"of {name} of system {self._keys.system}"
            )
        return manifest

    def _assembler(self, name: str) -> ChunkAssembler:
        if name not in self._pending:
            if len(self._pending) == PENDING:
                self._forget(next(iter(self._pending)))
            self._pending[name] = ChunkAssembler(LIMIT_BYTES)
        return self._pending[name]

    def _finished(self, name: str) -> MeasuredMatrix | None:
        assembler = self._pending[name]
        if not assembler.complete:
            return None
        manifest = self._manifests[name]
        self._forget(name)
        return MeasuredMatrix(manifest=manifest, matrix=assembler.matrix())

    def _forget(self, name: str) -> None:
        self._pending.pop(name, None)
        self._manifests.pop(name, None)
