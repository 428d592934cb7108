"""The keys of a Shack-Hartmann in an instrument file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from typing_extensions import override

from service.errors import ModelError
from service.model.kinds import SignalKind
from service.model.sensors.kind import SensorKind
from service.model.sensors.shack_hartmann.table import Centroid, ShackHartmannTable

if TYPE_CHECKING:
    from service.model.sensors.shack_hartmann.model import ShackHartmannModel


class ShackHartmannKind(SensorKind):
    """Lenslets, each with a spot whose centroid measures the wavefront's gradient."""

    name = "shack-hartmann"
    table = ShackHartmannTable
    unknown: ClassVar[Mapping[str, float]] = {"wavelength_m": 750e-9}
    signals = (SignalKind.XY,)

    @property
    @override
    def model(self) -> ShackHartmannModel:
        from service.model.sensors.shack_hartmann.model import ShackHartmannModel

        return ShackHartmannModel()

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
