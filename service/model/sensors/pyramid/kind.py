"""The pyramid as a kind of sensor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

from typing_extensions import override

from service.errors import ModelError
from service.model.kinds import Normalisation, SignalKind
from service.model.sensors.kind import SensorKind, WorkingPoint
from service.model.sensors.pyramid.table import USUAL_SEPARATION, PyramidTable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from service.model.instrument import Instrument, SensorMode
    from service.model.pupil import PupilGrid
    from service.model.sensors.kind import Term
    from service.model.sensors.pyramid.description import FrameWindows, Pyramid
    from service.model.sensors.pyramid.light import PyramidLight
    from service.model.sensors.pyramid.signals import PyramidSensor
    from service.model.sensors.pyramid.working_point import Halo
    from service.model.sensors.sensor import Fineness
    from service.model.slopes import SlopeRecipe


_IMAGES = "image_offsets_px"

_WEAK_LAMBDA_OVER_D = 1.5
"""Modulation up to which the star's own width counts as much."""


class PyramidKind(SensorKind):
    """The modulated pyramid."""

    name = "pyramid"
    table = PyramidTable
    unknown: ClassVar[Mapping[str, float | None]] = {
        "wavelength_m": 750e-9,
        "modulation_lambda_over_d": 3.0,
        _IMAGES: None,
    }
    signals = (SignalKind.XY, SignalKind.INTENSITY)
    normalised = True
    loses_gain = True
    edge_slips = True

    @override
    def as_read(self, written: Mapping[str, Any]) -> Mapping[str, Any]:
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
    def read_sensor(self, table: PyramidTable, given: frozenset[str]) -> Pyramid:
        from service.model.sensors.pyramid.description import pyramid_of

        return pyramid_of(table, given)

    @override
    def in_modes(
        self,
        table: PyramidTable,
        sensor: Pyramid,
    ) -> tuple[tuple[SensorMode, str], ...]:
        from service.model.sensors.pyramid.description import modes_of

        return modes_of(table, sensor)

    @override
    def frames(self, table: PyramidTable, given: frozenset[str]) -> FrameWindows | None:
        from service.model.sensors.pyramid.description import frames_of

        return frames_of(table, given)

    @override
    def list_assumptions(
        self, table: PyramidTable, given: frozenset[str]
    ) -> Iterator[tuple[str, str]]:
        told = table.input == "frames" and table.pupil_centres_px is not None
        if "pupil_separation_subap" not in given and not told:
            yield (
                "pupil_separation_subap",
                f"not given, taken as {table.image_separation_subap:g} ({USUAL_SEPARATION:g} pupil "
                "diameters)",
            )

    @override
    def signals_of_frames(
        self, instrument: Instrument, frames: NDArray[Any], flux_frame: NDArray[Any]
    ) -> NDArray[np.float64]:
        from service.model.sensors.pyramid.detector_windows import slopes_from_frames

        return slopes_from_frames(instrument, frames, flux_frame)

    @override
    def locate_images(
        self, instrument: Instrument, flux_frame: NDArray[Any]
    ) -> tuple[Instrument, tuple[str, ...]]:
        from service.model.sensors.pyramid.detector_windows import locate_images

        return locate_images(instrument, flux_frame)

    @override
    def image_centres(
        self, instrument: Instrument, flux_frame: NDArray[Any]
    ) -> NDArray[np.float64] | None:
        from service.model.sensors.pyramid.detector_windows import image_centres

        return image_centres(instrument, flux_frame)

    @override
    def identity(self, sensor: Pyramid) -> tuple[float, ...]:
        separation = sensor.image_separation_subap
        return (sensor.wavelength_m, sensor.modulation_lambda_over_d, separation)

    @override
    def bin_sensor(self, sensor: Pyramid, binning: int) -> Pyramid:
        from service.model.sensors.pyramid.description import bin_pyramid

        return bin_pyramid(sensor, binning)

    @override
    def noise_terms(self, instrument: Instrument) -> tuple[Term, Term]:
        # a difference of four pixels over the mean flux: their variances add up, in x and y alike
        return 1.0, 4.0

    @override
    def pixels(self, instrument: Instrument, valid: NDArray[np.bool_]) -> NDArray[np.intp]:
        from service.model.sensors.pyramid.signals import pixel_places

        return pixel_places(valid)

    @override
    def sensor(
        self,
        instrument: Instrument,
        pupil: PupilGrid,
        fineness: Fineness,
        working_point: WorkingPoint | None = None,
    ) -> PyramidSensor:
        from service.model.sensors.pyramid.signals import pyramid_sensor

        return pyramid_sensor(instrument, pupil, fineness, working_point)

    @override
    def working_point(
        self,
        instrument: Instrument,
        *,
        n_controlled: int,
        r0_m: float | None = None,
        sampling: int,
    ) -> Halo:
        from service.model.sensors.pyramid import working_point

        return working_point.working_point(
            instrument, n_controlled=n_controlled, r0_m=r0_m, sampling=sampling
        )

    @override
    def coarsest_sampling(self, sensor: Pyramid) -> int:
        # the phase of a modulation wide for its subapertures turns too fast for one point
        wide = 2.0 * sensor.modulation_lambda_over_d + 3.0 >= sensor.pupil_diameter
        return 2 if wide else 1

    @override
    def is_weakly_modulated(self, sensor: Pyramid) -> bool:
        return sensor.modulation_lambda_over_d <= _WEAK_LAMBDA_OVER_D

    @override
    def find_fitted_key(self, sensor: Pyramid) -> str | None:
        return "modulation_lambda_over_d" if sensor.modulation_lambda_over_d > 0.0 else None

    @override
    def other_recipes(self, recipe: SlopeRecipe) -> dict[str, SlopeRecipe]:
        local = recipe.normalisation is Normalisation.LOCAL
        divisor = Normalisation.GLOBAL if local else Normalisation.LOCAL
        return {f'normalisation = "{divisor}"': replace(recipe, normalisation=divisor)}

    @override
    def aot(self, recipe: SlopeRecipe) -> tuple[str, dict[str, int]]:
        return "Pyramid", {"n_sides": 4, "dimensions": recipe.kind.n_planes}

    @override
    def image_sigma_subap(self, instrument: Instrument) -> float | None:
        from service.model.sensors.pyramid.description import image_sigma_subap

        return image_sigma_subap(instrument)

    @override
    def image_floor(self, instrument: Instrument) -> NDArray[np.float64]:
        from service.model.sensors.pyramid.description import image_floor

        if f"wfs.{_IMAGES}" not in instrument.unknown:
            return super().image_floor(instrument)
        return image_floor(instrument)

    @override
    def unstated_image_floor(self, instrument: Instrument) -> NDArray[np.float64]:
        from service.model.sensors.pyramid.description import image_floor

        if f"wfs.{_IMAGES}" in instrument.unknown:
            return super().unstated_image_floor(instrument)
        return image_floor(instrument)

    @override
    def turned_edge_sigma(
        self, instrument: Instrument, displaced_subap: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        from service.model.sensors.pyramid.description import turned_edge_sigma

        return turned_edge_sigma(instrument, displaced_subap)

    @override
    def displace_images(self, instrument: Instrument, offsets: NDArray[np.float64]) -> Pyramid:
        from service.model.sensors.pyramid.description import displace_pyramid

        return displace_pyramid(instrument, offsets)

    @override
    def image_offsets(self, instrument: Instrument) -> NDArray[np.float64] | None:
        from service.model.sensors.pyramid.description import image_offsets

        offsets = image_offsets(instrument)
        return None if offsets is None else offsets.reshape(4, 2)

    @override
    def offsets_px(
        self, instrument: Instrument, offsets: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        from service.model.sensors.pyramid.description import offsets_px

        return offsets_px(instrument, offsets)

    @override
    def with_images_at(self, instrument: Instrument, offsets_px: NDArray[np.float64]) -> Pyramid:
        from service.model.sensors.pyramid.description import with_images_at

        return with_images_at(instrument, offsets_px)

    @override
    def pupil_offset(self, instrument: Instrument) -> tuple[float, float] | None:
        from service.model.sensors.pyramid.description import pupil_offset

        return pupil_offset(instrument)

    @override
    def light(self, instrument: Instrument) -> PyramidLight:
        from service.model.sensors.pyramid.light import PyramidLight

        return PyramidLight(instrument=instrument)
