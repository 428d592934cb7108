"""One number for all that is known of an instrument: products say what they were made for."""

from __future__ import annotations

import hashlib
from dataclasses import fields, is_dataclass, replace

import numpy as np

from service.model.instrument import Instrument


def instrument_sha256(instrument: Instrument) -> str:
    """Return the SHA-256 of every field of an instrument, arrays included, as hex.

    Two files that describe the same instrument, one with the defaults spelt out, are the same.
    """
    digest = hashlib.sha256()
    _add(digest, replace(instrument, remarks=()))
    return digest.hexdigest()


def _add(digest: hashlib._Hash, value: object) -> None:
    if is_dataclass(value):
        digest.update(f"{type(value).__name__}(".encode())
        for part in fields(value):
            digest.update(f"{part.name}=".encode())
            _add(digest, getattr(value, part.name))
        digest.update(b")")
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, tuple):
        for item in value:
            _add(digest, item)
        digest.update(f"{len(value)};".encode())
    else:
        digest.update(f"{value!r};".encode())
