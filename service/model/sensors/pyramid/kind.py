"""The keys of a pyramid in an instrument file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from typing_extensions import override

from service.errors import ModelError
from service.model.kinds import SignalKind
from service.model.sensors.kind import SensorKind
from service.model.sensors.pyramid.table import (
    ABERRATION_KEY,
    ELLIPSE_KEY,
    IMAGE_KEY,
    ROOFTOP_KEY,
    USUAL_SEPARATION,
    PyramidTable,
)

if TYPE_CHECKING:
    from service.model.sensors.pyramid.model import PyramidModel


class PyramidKind(SensorKind):
    """The modulated pyramid."""

    name = "pyramid"
    table = PyramidTable
    unknown: ClassVar[Mapping[str, float | None]] = {
        "wavelength_m": 750e-9,
        "modulation_lambda_over_d": 3.0,
        ROOFTOP_KEY: 0.0,
        IMAGE_KEY: None,
        ELLIPSE_KEY: None,
        ABERRATION_KEY: None,
    }
    signals = (SignalKind.XY, SignalKind.INTENSITY)
    normalised = True

    @property
    @override
    def model(self) -> PyramidModel:
        from service.model.sensors.pyramid.model import PyramidModel

        return PyramidModel()

    @override
    def as_read(self, written: Mapping[str, Any]) -> Mapping[str, Any]:
        written = _with_radius(written)
        centres = written.get("pupil_centres_px")
        if centres is None:
            return written
        if centres == "auto":
            return {**written, "pupil_centres_px": None}
        points = centres if isinstance(centres, list) else []
        pairs = [point for point in points if isinstance(point, list) and len(point) == 2]
        if len(points) != 4 or len(pairs) != 4:
            raise ModelError(
                f'pupil_centres_px: found {centres!r}, expected "auto" or four pairs [row, column]'
            )
        return written

    @override
    def list_assumptions(
        self, table: PyramidTable, given: frozenset[str]
    ) -> Iterator[tuple[str, str]]:
        has_centres = table.input != "slopes" and table.pupil_centres_px is not None
        if "pupil_separation_subap" not in given and not has_centres:
            yield (
                "pupil_separation_subap",
                f"not given, taken as {table.image_separation_subap:g} ({USUAL_SEPARATION:g} pupil "
                "diameters)",
            )


def _with_radius(written: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return ``[wfs]`` with the radius of the circle that has the area of a stated ellipse."""
    ellipse = written.get(ELLIPSE_KEY)
    if not isinstance(ellipse, dict):
        return written
    if "modulation_lambda_over_d" in written:
        raise ModelError(
            "modulation_ellipse: found modulation_lambda_over_d as well, expected one of them: "
            "remove the radius of the circle"
        )
    found = ellipse.get("axes_lambda_over_d")
    axes = found if isinstance(found, list) else []
    # Axes that are not two positive numbers are refused with the table.
    usable = len(axes) == 2 and all(isinstance(one, int | float) and one > 0 for one in axes)
    return {**written, "modulation_lambda_over_d": math.sqrt(math.prod(axes)) if usable else 0.0}
