"""Records as JSON on disk: products, and α for the next service."""

from __future__ import annotations

import hashlib
import json
import threading
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from service.errors import ArchiveError, ModelError, StorageError
from service.estimation.estimate import BIAS_WANDER
from service.files.durable import replace_file
from service.model.misregistration import BOUNDARY_SCALE, COVARIANCE_SCALE
from service.records.estimates import BIAS_FLOOR, BIAS_OVER_SCATTER
from service.records.registration import Registration
from service.records.state import Saved
from service.tracking.filtering import joint_of

NOT_UNDERSTOOD = (ValueError, KeyError, TypeError, ModelError)
"""Errors raised by a record that is damaged or of another version."""

_OF_THIS_RUN = "judged"
"""Field that a restarted service has to determine again."""

_NUMERIC = ("shift_x_subap", "shift_y_subap", "rotation_rad", "magnification")
_RADIANS, _DEGREES, _DEGREES_PER_RADIAN = "rotation_rad", "rotation_deg", float(BOUNDARY_SCALE[2])

_Record = TypeVar("_Record")


def to_json(record: object) -> str:
    """Return a record as JSON; a pole radius may be ``Infinity``, as Python writes it."""
    values = _in_degrees(msgspec.to_builtins(record, enc_hook=_plain))
    values.pop(_OF_THIS_RUN, None)
    return json.dumps(values)


def from_json(text: str, kind: type[_Record]) -> _Record:
    """Return the record of this kind that :func:`to_json` wrote.

    Raises
    ------
    ValueError, KeyError, TypeError, ModelError
        If the text is something else.
    """
    values = json.loads(text, object_hook=_in_radians)
    record = msgspec.convert(values, kind, dec_hook=_array)
    refuse_unknown(values, record)
    return record


def refuse_unknown(values: object, record: object) -> None:
    """Refuse what was read into a record if it holds keys that the record does not have.

    Raises
    ------
    ValueError
        If it does: another version has written it.
    """
    if isinstance(values, list) and isinstance(record, tuple):
        for entry, of_record in zip(values, record, strict=True):
            refuse_unknown(entry, of_record)
    elif isinstance(values, dict) and is_dataclass(record):
        known = {field.name for field in fields(record)}
        if not values.keys() <= known:
            raise ValueError(f"unknown keys {', '.join(sorted(values.keys() - known))}")
        for name, value in values.items():
            refuse_unknown(value, getattr(record, name))


def plain_numbers(value: object) -> object:
    """Turn numpy's scalars and arrays into Python's."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be stored")


def _plain(value: object) -> object:
    if not isinstance(value, np.ndarray):
        return plain_numbers(value)
    if value.ndim == 1:
        return dict(zip(_NUMERIC, value.tolist(), strict=True))
    return (value * COVARIANCE_SCALE).tolist()


def _array(_kind: type, value: Any) -> NDArray[np.float64]:  # noqa: ANN401  whatever JSON holds
    if isinstance(value, dict):
        return np.array([value[name] for name in _NUMERIC], dtype=np.float64)
    return np.asarray(np.array(value, dtype=np.float64) / COVARIANCE_SCALE)


def _in_degrees(value: Any) -> Any:  # noqa: ANN401  any value of a record
    if not isinstance(value, dict):
        return value
    found = {name: _in_degrees(below) for name, below in value.items()}
    if _RADIANS in found:
        found[_DEGREES] = found.pop(_RADIANS) * _DEGREES_PER_RADIAN
    return found


def _in_radians(values: dict[str, Any]) -> dict[str, Any]:
    if _DEGREES in values:
        values[_RADIANS] = values.pop(_DEGREES) / _DEGREES_PER_RADIAN
    return values


# --- what the next service needs

VERSION = 1

_NOT_KEPT = ("grown", "validity", "suspected_jump", "previous_estimate", "restored_ns_utc")
"""Fields of the registration and its bias that the next service computes again."""

_BIAS_BLOCK = {
    "name": "passive",
    "floor": BIAS_FLOOR.tolist(),
    "over_scatter": BIAS_OVER_SCATTER.tolist(),
    "wander": BIAS_WANDER.tolist(),
}
"""Head of the bias in the file, which could hold those of several estimators."""

_ACQUISITION_KEPT = (
    "stage",
    "text",
    "started_ns_utc",
    "since_ns_utc",
    "commanded",
    "attempt",
    "found",
    "n_modes",
    "max_modes",
    "lost_with",
    "matrix",
    "sent",
    "held_off",
    "interruption",
)
"""The rest is of telemetry that the next one will not have."""


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
        values = _kept(saved)
        text = json.dumps(values | {"sha256": _sha256(values)}).encode()
        try:
            with self._lock:
                replace_file(self._path, text)
        except OSError as error:
            raise StorageError(f"{self._path}: cannot be written: {error}") from error

    def read(self) -> Saved | None:
        """Return the saved state; None if there is no file.

        Raises
        ------
        ArchiveError
            If the file is damaged; it has been renamed for inspection, and the next one can be
            written.
        """
        if not self._path.exists():
            return None
        try:
            text = self._path.read_text(encoding="utf-8")
            values = json.loads(text)
            expected = values.pop("sha256")
            if expected != _sha256(values):
                raise ValueError(f"found checksum {_sha256(values)}, expected {expected}")
            return _convert_saved(values)
        except (OSError, AttributeError, *NOT_UNDERSTOOD) as error:
            # Renamed, or every start would fail at the same file.
            aside = self._path.with_suffix(".damaged")
            self._path.replace(aside)
            raise ArchiveError(
                f"{self._path}: damaged, moved to {aside.name}; the service starts without α, with "
                f"mode and dither of the settings: {error!s:.200}"
            ) from error


def _sha256(values: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()


def _kept(saved: Saved) -> dict[str, Any]:
    values = msgspec.to_builtins(saved, enc_hook=plain_numbers)
    known, acquisition = values["registration"], values["acquisition"]
    if known is not None:
        alpha = known["alpha"]
        known["alpha"] = [*(alpha[name] for name in _NUMERIC), *(alpha["anamorphosis"] or ())]
        bias = known.pop("bias")
        known["biases"] = [] if bias is None else [{"block": _BIAS_BLOCK, **bias}]
        for record in (known, *known["biases"]):
            for name in _NOT_KEPT:
                record.pop(name, None)
    if acquisition is not None:
        values["acquisition"] = {name: acquisition[name] for name in _ACQUISITION_KEPT}
    return {"version": VERSION, **values}


def _convert_saved(values: dict[str, Any]) -> Saved:
    if values.pop("version") != VERSION:
        raise ValueError(f"expected version {VERSION}")
    known = values["registration"]
    if known is not None:
        four, stretches = known["alpha"][:4], known["alpha"][4:]
        known["alpha"] = dict(zip(_NUMERIC, four, strict=True)) | {
            "anamorphosis": stretches or None
        }
        biases = (each for each in known.pop("biases", ()) if each.pop("block") == _BIAS_BLOCK)
        known["bias"] = next(biases, None)
    saved = msgspec.convert(
        values, Saved, dec_hook=lambda _kind, value: np.array(value, dtype=np.float64)
    )
    # msgspec ignores unknown keys: those of a later version would be lost with the next write.
    refuse_unknown(values, saved)
    parts = (saved.registration, saved.acquisition, saved.orders, saved.offload)
    if all(part is None for part in parts):
        raise ValueError("neither an α nor an acquisition nor an order")
    if saved.registration is not None:
        _check(saved.registration)
    found = None if saved.acquisition is None else saved.acquisition.found
    if found is not None and not np.isfinite(found.gains).all():
        raise ValueError("a gain is not finite")
    if saved.offload is not None:
        _check_shapes([(saved.offload.step, (4,)), (saved.offload.total, (4,))])
    orders = saved.orders
    if orders is not None and (orders.mode is None) is not (orders.settings_mode is None):
        raise ValueError(f"mode is {orders.mode!r} and of the settings {orders.settings_mode!r}")
    return saved


def _check_shapes(arrays: list[tuple[NDArray[Any], tuple[int, ...]]]) -> None:
    for values, shape in arrays:
        if values.shape != shape or not np.isfinite(values).all():
            raise ValueError(f"found numbers of shape {values.shape}, expected {shape} finite ones")


def _check(registration: Registration) -> None:
    """Refuse what no service has written: α and its bias must be a joint normal distribution."""
    arrays = [
        (registration.covariance, (4, 4)),
        (registration.floor, (4,)),
        (np.array(registration.scatter), ()),
    ]
    n, stretches = 4, registration.stretches
    if stretches is not None:
        arrays += [(stretches.covariance, (2, 2)), (stretches.shared, (2, 4))]
        n = 6
    bias = registration.bias
    if bias is not None:
        arrays += [(bias.offset, (4,)), (bias.covariance, (4, 4)), (bias.shared, (4, n))]
        arrays += [(bias.excess, (4,)), (np.array(bias.loop), (len(bias.loop),))]
        arrays += [(np.array(bias.scatter), ())]
    _check_shapes(arrays)
    covariance = joint_of(registration).covariance
    power = np.linalg.eigvalsh(covariance)
    # parameters of different units: rounding is relative to the largest
    if not np.allclose(covariance, covariance.T) or power[0] < -1e-9 * power[-1]:
        raise ValueError("a covariance is not one")
