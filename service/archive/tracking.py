"""What the service knows of the registration, on the disk: one small file, replaced as a whole."""

from __future__ import annotations

import json
import os
import threading
from dataclasses import fields
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.archive.records import NOT_UNDERSTOOD, plain_numbers, refuse_unknown
from service.errors import ArchiveError, StorageError
from service.model.misregistration import Misregistration
from service.tracking.registration import Registration
from service.tracking.state import Saved

VERSION = 1

_NOT_KEPT = ("grown", "standing", "candidate", "earlier", "restored_ns_utc")
"""Of the registration and its bias: what the next service works out anew."""

_ACQUISITION_KEPT = (
    "stage",
    "text",
    "started_ns_utc",
    "since_ns_utc",
    "commanded",
    "attempt",
    "found",
    "n_modes",
    "most_modes",
    "matrix",
    "sent",
    "held_off",
    "interruption",
)
"""The rest is of telemetry that the next one will not have."""

_ALPHA = tuple(field.name for field in fields(Misregistration))


class TrackingFile:
    """``tracking.json``: JSON in numeric units (subapertures, radians, ratio).

    A service killed at any moment leaves the last file or the one before, never half of one.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()

    def write(self, saved: Saved) -> None:
        """Replace what is saved; it is on the disk when this returns.

        Raises
        ------
        StorageError
            If the disk refuses.
        """
        part = self._path.with_suffix(".part")
        try:
            with self._lock, part.open("w", encoding="utf-8") as file:
                json.dump(_kept(saved), file)
                file.flush()
                os.fsync(file.fileno())
                part.replace(self._path)
        except OSError as error:
            raise StorageError(f"{self._path}: cannot be written: {error}") from error

    def read(self) -> Saved | None:
        """Return what was saved; None: nothing was.

        Raises
        ------
        ArchiveError
            If the file is damaged; it has been put aside, for somebody to look at, and the next
            one can be written.
        """
        if not self._path.exists():
            return None
        try:
            return _read(json.loads(self._path.read_text(encoding="utf-8")))
        except (OSError, AttributeError, *NOT_UNDERSTOOD) as error:
            aside = self._path.with_suffix(".damaged")
            self._path.replace(aside)
            raise ArchiveError(
                f"{self._path}: damaged, now {aside.name}; α is measured anew, mode and dither are "
                f"as the settings say: {error!s:.200}"
            ) from error


def _kept(saved: Saved) -> dict[str, Any]:
    values = msgspec.to_builtins(saved, enc_hook=plain_numbers)
    known, acquisition = values["registration"], values["acquisition"]
    if known is not None:
        known["alpha"] = [known["alpha"][name] for name in _ALPHA]
        for record in (known, known["bias"] or {}):
            for name in _NOT_KEPT:
                record.pop(name, None)
    if acquisition is not None:
        values["acquisition"] = {name: acquisition[name] for name in _ACQUISITION_KEPT}
    return {"version": VERSION, **values}


def _read(values: dict[str, Any]) -> Saved:
    if values.pop("version") != VERSION:
        raise ValueError(f"expected version {VERSION}")
    known = values["registration"]
    if known is not None:
        known["alpha"] = dict(zip(_ALPHA, known["alpha"], strict=True))
    saved = msgspec.convert(values, Saved, dec_hook=_array)
    refuse_unknown(values, saved)
    if saved.registration is None and saved.acquisition is None and saved.orders is None:
        raise ValueError("neither an α nor an acquisition nor an order")
    if saved.registration is not None:
        _check(saved.registration)
    found = None if saved.acquisition is None else saved.acquisition.found
    if found is not None and not np.isfinite(found.gains).all():
        raise ValueError("a gain is not finite")
    orders = saved.orders
    if orders is not None and (orders.mode is None) is not (orders.settings_mode is None):
        raise ValueError(f"mode is {orders.mode!r} and of the settings {orders.settings_mode!r}")
    return saved


def _array(_kind: type, value: object) -> NDArray[np.float64]:
    return np.array(value, dtype=np.float64)


def _check(known: Registration) -> None:
    """Refuse what no service has written: α and its bias must be a joint normal distribution."""
    arrays = [(known.covariance, (4, 4)), (known.floor, (4,))]
    bias = known.bias
    if bias is not None:
        arrays += [(bias.offset, (4,)), (bias.covariance, (4, 4)), (bias.shared, (4, 4))]
        arrays += [(bias.excess, (4,)), (np.array(bias.loop), (len(bias.loop),))]
    for values, shape in arrays:
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"found numbers of shape {values.shape}, expected {shape} finite ones")
    covariance = known.covariance
    if bias is not None:
        covariance = np.block([[covariance, bias.shared.T], [bias.shared, bias.covariance]])
    power = np.linalg.eigvalsh(covariance)
    # parameters of different units: rounding is relative to the largest
    if not np.allclose(covariance, covariance.T) or power[0] < -1e-9 * power[-1]:
        raise ValueError("a covariance is not one")
