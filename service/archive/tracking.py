"""What the service knows of the registration, on the disk: one small file, replaced as a whole."""

from __future__ import annotations

import json
import os
import threading
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import ArchiveError, StorageError
from service.model.misregistration import Misregistration
from service.state import (
    Acquisition,
    AcquisitionStage,
    Interruption,
    LoopFound,
    Mode,
    ModeGain,
    Orders,
    PassiveBias,
    Pointing,
    Registration,
    Saved,
)

VERSION = 1

_NOT_KEPT = ("grown", "standing", "candidate", "earlier", "restored_ns_utc")
"""What the next service works out anew."""

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

_READ_FAILURES = (OSError, ValueError, KeyError, TypeError, AttributeError)


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
                json.dump(_to_json(saved), file)
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
            return _from_json(json.loads(self._path.read_text(encoding="utf-8")))
        except _READ_FAILURES as error:
            aside = self._path.with_suffix(".damaged")
            self._path.replace(aside)
            raise ArchiveError(
                f"{self._path}: damaged, now {aside.name}; α is measured anew, mode and dither are "
                f"as the settings say: {error!s:.200}"
            ) from error


def _to_json(saved: Saved) -> dict[str, Any]:
    return {
        "version": VERSION,
        **{f.name: _plain(getattr(saved, f.name)) for f in fields(saved)},
    }


def _plain(value: object) -> object:
    match value:
        case np.ndarray():
            return value.tolist()
        case Misregistration():
            return value.vector.tolist()
        case Registration() | PassiveBias():
            kept = (f.name for f in fields(value) if f.name not in _NOT_KEPT)
            return {name: _plain(getattr(value, name)) for name in kept}
        case Acquisition():
            return {name: _plain(getattr(value, name)) for name in _ACQUISITION_KEPT}
        case Pointing() | ModeGain() | LoopFound() | Interruption() | Orders():
            return asdict(value)
        case tuple():
            return [_plain(entry) for entry in value]
        case _:
            return value


def _from_json(values: dict[str, Any]) -> Saved:
    if values.pop("version") != VERSION:
        raise ValueError(f"expected version {VERSION}")
    known, acquisition = values["registration"], values.get("acquisition")
    orders = values.get("orders")
    if known is None and acquisition is None and orders is None:
        raise ValueError("neither an α nor an acquisition nor an order")
    return Saved(
        **{
            **values,
            "pointing": _pointing(values["pointing"]),
            "registration": None if known is None else _registration(known),
            "acquisition": None if acquisition is None else _acquisition(acquisition),
            "orders": None if orders is None else _orders(orders),
        }
    )


def _orders(values: dict[str, Any]) -> Orders:
    orders = Orders(**values)
    if type(orders.dither_stopped) is not bool:
        raise TypeError(f"dither_stopped is {orders.dither_stopped!r}, expected true or false")
    mode, of_settings = orders.mode, orders.settings_mode
    if (mode is None) is not (of_settings is None):
        raise ValueError(f"mode is {mode!r} and that of the settings {of_settings!r}")
    if mode is None or of_settings is None:
        return orders
    return replace(orders, mode=Mode(mode), settings_mode=Mode(of_settings))


def _registration(known: dict[str, Any]) -> Registration:
    floor = _numbers(known["floor"], (4,))
    registration = Registration(
        **{
            **known,
            "alpha": Misregistration.from_vector(_numbers(known["alpha"], (4,))),
            "covariance": _covariance(known["covariance"]),
            "floor": floor,
            "optical_gains": tuple(ModeGain(**gain) for gain in known["optical_gains"]),
            "bias": None if known["bias"] is None else _bias(known["bias"]),
            "pointing": _pointing(known["pointing"]),
            "window_pointing": _pointing(known["window_pointing"]),
        }
    )
    _check(registration)
    return registration


def _acquisition(values: dict[str, Any]) -> Acquisition:
    stage = AcquisitionStage(values["stage"])
    found, interruption = values["found"], values["interruption"]
    for name in ("started_ns_utc", "since_ns_utc", "attempt", "n_modes"):
        if type(values[name]) is not int:
            raise TypeError(f"{name} is {values[name]!r}, expected an integer")
    return Acquisition(
        **{
            **values,
            "stage": stage,
            "found": None if found is None else _loop_found(found),
            "interruption": None if interruption is None else Interruption(**interruption),
        }
    )


def _loop_found(values: dict[str, Any]) -> LoopFound:
    gains = _numbers(values["gains"], (len(values["gains"]),))
    return LoopFound(**{**values, "gains": tuple(gains.tolist())})


def _check(known: Registration) -> None:
    """Refuse what no service has written: α and its bias must be a joint normal distribution."""
    bias = known.bias
    if bias is not None:
        joint = np.block([[known.covariance, bias.shared.T], [bias.shared, bias.covariance]])
        _covariance(joint.tolist())
    for name in ("t_ns_utc", "arrived_ns_utc", "n_windows", "window_ns_utc"):
        if type(getattr(known, name)) is not int:
            raise TypeError(f"{name} is {getattr(known, name)!r}, expected an integer")


def _pointing(values: dict[str, float] | None) -> Pointing | None:
    return None if values is None else Pointing(**values)


def _bias(values: dict[str, Any]) -> PassiveBias:
    loop = values.get("loop", [])
    return PassiveBias(
        offset=_numbers(values["offset"], (4,)),
        covariance=_covariance(values["covariance"]),
        shared=_numbers(values["shared"], (4, 4)),
        looked_ns_utc=int(values["looked_ns_utc"]),
        excess=_numbers(values.get("excess", [0.0] * 4), (4,)),
        loop=tuple(_numbers(loop, (len(loop),)).tolist()),
    )


def _covariance(values: list[list[float]]) -> NDArray[np.float64]:
    found = _numbers(values, (len(values), len(values)))
    power = np.linalg.eigvalsh(found)
    # parameters of different units: rounding is relative to the largest
    if not np.allclose(found, found.T) or power[0] < -1e-9 * power[-1]:
        raise ValueError("a covariance is not one")
    return found


def _numbers(values: object, shape: tuple[int, ...]) -> NDArray[np.float64]:
    found = np.array(values, dtype=np.float64)
    if found.shape != shape or not np.isfinite(found).all():
        raise ValueError(f"found numbers of shape {found.shape}, expected {shape} finite ones")
    return found
