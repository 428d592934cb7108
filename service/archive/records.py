"""Records of products <-> JSON, with boundary units and names."""

from __future__ import annotations

import json
from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.control.gate import GateVerdict
from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration
from service.state import (
    MatrixState,
    MeasurementRecord,
    MeasurePattern,
    MeasureState,
    ModeGain,
    ReconstructorRecord,
)

_OF_THIS_RUN = {"judged"}
"""What a restarted service must find out anew."""


def record_to_json(record: ReconstructorRecord) -> str:
    """Return the record as JSON; a pole radius may be ``Infinity``, as Python writes it."""
    values: dict[str, Any] = {
        f.name: getattr(record, f.name) for f in fields(record) if f.name not in _OF_THIS_RUN
    }
    if record.alpha is not None:
        values["alpha"] = record.alpha.to_boundary()
    if record.sigma is not None:
        sigma = record.sigma * BOUNDARY_SCALE
        values["sigma"] = dict(zip(PARAMETERS, sigma.tolist(), strict=True))
    if record.gate is not None:
        values["gate"] = asdict(record.gate)
    values["optical_gains"] = [asdict(gain) for gain in record.optical_gains]
    return json.dumps(values)


def record_from_json(text: str) -> ReconstructorRecord:
    """Return the record that :func:`record_to_json` wrote.

    Raises
    ------
    ValueError, KeyError, TypeError
        If the text is something else.
    """
    values = json.loads(text)
    record = ReconstructorRecord(**{**values, "state": MatrixState(values["state"])})
    alpha, sigma, gate = values["alpha"], values["sigma"], values["gate"]
    return replace(
        record,
        alpha=None if alpha is None else Misregistration.from_boundary(alpha),
        sigma=None if sigma is None else _numeric(sigma),
        gate=None if gate is None else GateVerdict(**gate),
        optical_gains=tuple(ModeGain(**gain) for gain in values.get("optical_gains", ())),
    )


def measurement_to_json(record: MeasurementRecord) -> str:
    """Return the record of a measured interaction matrix as JSON."""
    return json.dumps(asdict(record))


def measurement_from_json(text: str) -> MeasurementRecord:
    """Return the record that :func:`measurement_to_json` wrote.

    Raises
    ------
    ValueError, KeyError, TypeError
        If the text is something else.
    """
    values = json.loads(text)
    lines = values["frequency_hz"]
    values |= {
        "state": MeasureState(values["state"]),
        "pattern": MeasurePattern(values["pattern"]),
        "modes": tuple(values["modes"]),
        "amplitude_m": tuple(values["amplitude_m"]),
        "frequency_hz": None if lines is None else tuple(lines),
    }
    return MeasurementRecord(**values)


def _numeric(sigma: dict[str, float]) -> NDArray[np.float64]:
    values: NDArray[np.float64] = np.array([sigma[name] for name in PARAMETERS]) / BOUNDARY_SCALE
    return values
