"""Parts of a calibration that act at once in cacao: gains of the modes, reference of the slopes.

They are set when cacao has taken up the matrix that they belong to. The previous values are kept
under the name of the previous matrix.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cacao_bridge.settings import Settings
from cacao_bridge.streams import Stream, StreamError, path_of
from service.files.bundle import Bundle
from service.files.durable import replace_file

Array32 = NDArray[np.float32]

GAINS, REFERENCE = "gain_factor", "reference_slopes"
"""Names in a bundle."""


class Parts:
    """Gains and reference of matrices, in a folder and in cacao's streams."""

    def __init__(self, settings: Settings, index: NDArray[np.int64]) -> None:
        self._names, self._loop, self._index = settings.streams, settings.loop, index
        self._folder = Path(settings.calibration.folder)

    @property
    def takes(self) -> frozenset[str]:
        """Return the parts of a bundle that this loop can use."""
        can = {GAINS: self._names.gains and self._loop.gain > 0.0, REFERENCE: self._names.reference}
        return frozenset(name for name, has in can.items() if has)

    def keep_of(self, name: str, bundle: Bundle) -> None:
        """Keep the parts of a bundle other than its matrix, in the layout of cacao's streams.

        Raises
        ------
        StreamError
            If a stream that it needs is not there, or has another size.
        OSError
            If the disk refuses.
        """
        kept: dict[str, Array32] = {}
        if GAINS in self.takes and GAINS in bundle.arrays:
            gains = self._stream(self._names.gains).latest().copy()
            factors = bundle.arrays[GAINS]
            if gains.size < len(factors):
                found = f"{self._names.gains}: found {gains.size} gains"
                raise StreamError(f"{found}, expected {len(factors)}")
            gains.reshape(-1)[: len(factors)] = self._loop.gain * factors
            kept[self._names.gains] = gains
        if REFERENCE in bundle.arrays:
            reference = self._stream(self._names.reference).latest().copy()
            if reference.size <= self._index.max():
                found = f"{self._names.reference}: found {reference.size} values"
                raise StreamError(f"{found}, expected at least {self._index.max() + 1}")
            reference.reshape(-1)[self._index] = bundle.arrays[REFERENCE]
            kept[self._names.reference] = reference
        self._keep(name, kept)

    def keep_now(self, name: str) -> None:
        """Keep what the streams have now as what belongs to a matrix."""
        streams = [one for one in (self._names.gains, self._names.reference) if one]
        self._keep(name, {one: self._stream(one).latest() for one in streams})

    def set(self, name: str) -> None:
        """Set what is kept with a matrix; what is so already is not written again.

        Raises
        ------
        StreamError
            If a stream is not there, or has another size by now.
        """
        path = self._path(name)
        if not path.exists():
            return
        with np.load(path, allow_pickle=False) as kept:
            parts = {one: kept[one] for one in kept.files}
        for one, values in parts.items():
            stream = self._stream(one)
            # All sizes are checked before the first is written: half of a calibration is another
            # loop.
            if stream.n_values != values.size:
                raise StreamError(
                    f"{one}: found {stream.n_values} values, expected {values.size} of {name}"
                )
        for one, values in parts.items():
            stream = self._stream(one, writable=True)
            if not np.array_equal(stream.latest().ravel(), values.ravel()):
                stream.write(values)

    def _keep(self, name: str, parts: dict[str, Array32]) -> None:
        buffer = io.BytesIO()
        np.savez(buffer, **parts)  # type: ignore[arg-type]
        replace_file(self._path(name), buffer.getvalue())

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.parts.npz"

    def _stream(self, name: str, *, writable: bool = False) -> Stream:
        return Stream(path_of(name, self._names.directory), writable=writable)
