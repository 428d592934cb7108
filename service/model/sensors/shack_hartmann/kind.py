"""The Shack-Hartmann as a kind of sensor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

from typing_extensions import override

from service.errors import ModelError
from service.model.kinds import SignalKind
from service.model.sensors.kind import LeftOut, SensorKind, WorkingPoint
from service.model.sensors.shack_hartmann.table import Centroid, ShackHartmannTable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from service.model.instrument import Instrument, SensorDescription
    from service.model.pupil import PupilGrid
    from service.model.sensors.kind import Term
    from service.model.sensors.sensor import Fineness
    from service.model.sensors.shack_hartmann.description import ShackHartmann
    from service.model.sensors.shack_hartmann.optics import ShackHartmannSensor
    from service.model.slopes import SlopeRecipe


class ShackHartmannKind(SensorKind):
    """Lenslets, each with a spot whose centroid measures the wavefront's gradient."""

    name = "shack-hartmann"
    table = ShackHartmannTable
    unknown: ClassVar[Mapping[str, float]] = {"wavelength_m": 750e-9}

    fine_sampling = 4
    """With three points fits of OOPAO's matrices are off by 0.004 deg on 20 by 20 lenslets, twice
    their σ; with four by 0.0015, and six change no more than noise."""
    signals = (SignalKind.XY,)

    @override
    def as_read(self, written: Mapping[str, Any]) -> Mapping[str, Any]:
        height = written.get("guide_star_height_m", "infinity")
        if height != "infinity":
            raise ModelError(
                f'guide_star_height_m: found {height!r}, expected "infinity", or a table '
                "[wfs.laser] with height_m, thickness_m, spot_arcsec and launcher_m"
            )
        if "guide_star_height_m" in written and "laser" in written:
            raise ModelError(
                "guide_star_height_m: has no effect together with the table [wfs.laser]; remove it"
            )
        return written

    @override
    def read_sensor(self, table: ShackHartmannTable, given: frozenset[str]) -> ShackHartmann:
        from service.model.sensors.shack_hartmann.description import shack_hartmann_of

        return shack_hartmann_of(table)

    @override
    def check(self, sensor: ShackHartmann, subaperture_m: float) -> None:
        from service.model.sensors.shack_hartmann.description import check_field
        from service.model.sensors.shack_hartmann.stars import check_star

        check_field(sensor, subaperture_m)
        check_star(sensor, subaperture_m)

    @override
    def left_out(self, instrument: Instrument) -> LeftOut | None:
        from service.model.pupil import fully_lit_subapertures, valid_subapertures
        from service.model.sensors.shack_hartmann.description import shack_hartmann_in

        if not shack_hartmann_in(instrument).leaves_out_partly_lit:
            return None
        cut = valid_subapertures(instrument) & ~fully_lit_subapertures(instrument)
        return LeftOut(cut, "cut by the edge of the pupil, left out by wfs.partly_lit")

    @override
    def list_assumptions(
        self, table: ShackHartmannTable, given: frozenset[str]
    ) -> Iterator[tuple[str, str]]:
        if "pixel_scale_arcsec" not in given:
            yield "pixel_scale_arcsec", "not given, taken as λ/d of a subaperture"
        if table.centroid is Centroid.THRESHOLD and "partly_lit" not in given:
            yield (
                "partly_lit",
                'not given, taken as "leave out": with a threshold, fits leave out subapertures '
                "that the edge of the pupil cuts",
            )

    @override
    def noise_terms(self, instrument: Instrument) -> tuple[Term, Term]:
        from service.model.sensors.shack_hartmann.stars import centroid_variances

        return centroid_variances(instrument)

    @override
    def pixels(self, instrument: Instrument, valid: NDArray[np.bool_]) -> NDArray[np.intp]:
        from service.model.sensors.shack_hartmann.description import pixel_places, shack_hartmann_in

        return pixel_places(shack_hartmann_in(instrument), valid)

    @override
    def sensor(
        self,
        instrument: Instrument,
        pupil: PupilGrid,
        fineness: Fineness,
        working_point: WorkingPoint | None = None,
    ) -> ShackHartmannSensor:
        from service.model.sensors.shack_hartmann.optics import ShackHartmannSensor

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
