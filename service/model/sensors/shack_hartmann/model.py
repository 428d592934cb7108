"""The Shack-Hartmann as a model of a kind of sensor."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.errors import ModelError
from service.model.instrument import Instrument, SensorDescription
from service.model.pupil import PupilGrid, fully_lit_subapertures, valid_subapertures
from service.model.sensors.model import LeftOut, SensorModel, Term
from service.model.sensors.sensor import Fineness, WorkingPoint
from service.model.sensors.shack_hartmann.description import (
    ShackHartmann,
    pixel_places,
    shack_hartmann_in,
)
from service.model.sensors.shack_hartmann.optics import ShackHartmannSensor
from service.model.sensors.shack_hartmann.stars import centroid_variances, check_star
from service.model.sensors.shack_hartmann.table import (
    Centroid,
    PartlyLit,
    ShackHartmannNumbers,
    ShackHartmannTable,
)
from service.model.slopes import SlopeRecipe

FIELDS_LAMBDA_OVER_D = (1.5, 60.0)
"""Width of a subaperture's field: a narrower one cuts the spot itself, a wider one is a slip of the
unit."""


class ShackHartmannModel(SensorModel):
    """Lenslets, each with a spot whose centroid measures the wavefront's gradient."""

    name = "shack-hartmann"
    fine_sampling = 4
    """With three points fits of OOPAO's matrices are off by 0.004 deg on 20 by 20 lenslets, twice
    their σ; with four by 0.0015, and six change no more than noise."""

    @override
    def read_sensor(
        self, table: ShackHartmannTable, given: frozenset[str], subaperture_m: float
    ) -> ShackHartmann:
        thresholded = table.centroid is Centroid.THRESHOLD
        # There is no usual value, and a wrong one would bias α.
        if thresholded and table.threshold is None:
            raise ModelError(
                'threshold: found none, expected a share of the brightest pixel with centroid = "'
                f'{table.centroid}"'
            )
        if not thresholded and table.threshold is not None:
            raise ModelError(
                f'threshold: found {table.threshold:g} with centroid = "{table.centroid}", '
                'expected centroid = "threshold" or no threshold'
            )
        if table.centroid is Centroid.GRADIENT and table.laser is not None:
            raise ModelError(
                'centroid: found "gradient" with a laser star, expected "cog", "weighted" or '
                '"threshold": a mean gradient does not model elongated spots'
            )
        if thresholded and table.partly_lit is PartlyLit.USE:
            raise ModelError(
                f'partly_lit: found "use" with a threshold of {table.threshold:g}, expected "leave '
                'out": a threshold removes more of a spot that the pupil edge widens'
            )
        sensor = ShackHartmann(
            **{field.name: getattr(table, field.name) for field in fields(ShackHartmannNumbers)}
        )
        width = sensor.pixels_per_subaperture * sensor.pixel_lambda_over_d(subaperture_m)
        low, high = FIELDS_LAMBDA_OVER_D
        if not low <= width <= high:
            raise ModelError(
                f"pixel_scale_arcsec: found a field of {width:.3g} λ/d across a subaperture of "
                f"{subaperture_m:.3g} m, expected {low:g} to {high:g}"
            )
        check_star(sensor, subaperture_m)
        return sensor

    @override
    def left_out(self, instrument: Instrument) -> LeftOut | None:
        if not shack_hartmann_in(instrument).leaves_out_partly_lit:
            return None
        cut = valid_subapertures(instrument) & ~fully_lit_subapertures(instrument)
        return LeftOut(cut, "cut by the edge of the pupil, left out by wfs.partly_lit")

    @override
    def noise_terms(self, instrument: Instrument) -> tuple[Term, Term]:
        return centroid_variances(instrument)

    @override
    def pixels(self, instrument: Instrument, valid: NDArray[np.bool_]) -> NDArray[np.intp]:
        return pixel_places(shack_hartmann_in(instrument), valid)

    @override
    def sensor(
        self,
        instrument: Instrument,
        pupil: PupilGrid,
        fineness: Fineness,
        working_point: WorkingPoint | None = None,
    ) -> ShackHartmannSensor:
        return ShackHartmannSensor(instrument=instrument, pupil=pupil, dtype=fineness.dtype)

    @override
    def coarsest_sampling(self, sensor: ShackHartmann) -> int:
        # from one point to the next a mode of a few subapertures is no cubic any more
        return 2

    @override
    def other_sensors(self, sensor: ShackHartmann) -> dict[str, SensorDescription]:
        if sensor.centroid is not Centroid.CENTRE_OF_GRAVITY or sensor.laser is not None:
            return {}
        return {'centroid = "gradient"': replace(sensor, centroid=Centroid.GRADIENT)}

    @override
    def aot(self, recipe: SlopeRecipe) -> tuple[str, dict[str, int]]:
        return "ShackHartmann", {}
