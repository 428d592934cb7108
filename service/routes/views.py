"""What every view of a record shares: it is read-only, and what is not finite is null."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, model_validator

from service.model.misregistration import BOUNDARY_SCALE, PARAMETERS, Misregistration


def _finite_or_none(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


Number = Annotated[float | None, BeforeValidator(_finite_or_none)]
"""A number, or null where there is none or it is not finite."""


class View(BaseModel):
    """A read-only picture of one of the service's records, made from its attributes."""

    model_config = ConfigDict(frozen=True, from_attributes=True, use_attribute_docstrings=True)


class FourView(View):
    """The four parameters of a registration, or their 1 σ."""

    shift_x_subap: Number
    """Along sensor +x, subapertures."""

    shift_y_subap: Number
    """Along sensor +y, subapertures."""

    rotation_deg: Number
    """From sensor +x towards +y, degrees."""

    magnification: Number
    """Ratio; 1 is nominal."""

    @model_validator(mode="before")
    @classmethod
    def _in_boundary_units(cls, value: Misregistration | NDArray[np.float64]) -> dict[str, float]:
        if isinstance(value, Misregistration):
            return value.to_boundary()
        return dict(zip(PARAMETERS, (value * BOUNDARY_SCALE).tolist(), strict=True))
