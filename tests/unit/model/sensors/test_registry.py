"""Another kind of sensor than the pyramid, registered for a test: the rest of pyrcal asks it."""

from dataclasses import dataclass, fields
from typing import ClassVar, Literal

import numpy as np
import pytest

from pyrcal.fitting.models import FitModels, Optic
from service.errors import ConfigurationError
from service.estimation.openloop import far_starts
from service.instrument import load_instrument
from service.model.instrument import instrument_sha256
from service.model.kinds import SignalKind
from service.model.sensors import registry
from service.model.sensors.kind import SensorKind
from service.model.sensors.model import SensorModel
from service.runtime.worker.sensor import SensorAtWork
from tests.support.config import ABOUT, MIRROR, MODES

WFS = '[wfs]\nkind = "curvature"\nn_subapertures = 20\nwavelength_m = 750e-9\nextra_m = 1.0\n'


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbers:
    """Keys of a sensor that nobody has."""

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True}

    n_subapertures: int
    wavelength_m: float
    extra_m: float
    flux_threshold: float = 0.5

    @property
    def pupil_diameter(self) -> float:
        return float(self.n_subapertures)


@dataclass(frozen=True, slots=True, kw_only=True)
class CurvatureTable(Numbers):
    """``[wfs]``: another sensor."""

    kind: Literal["curvature"]
    valid_subapertures: str = "auto"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curvature(Numbers):
    """The same as an instrument has it."""

    kind: ClassVar[str] = "curvature"
    valid_subapertures: np.ndarray | None = None


class CurvatureModel(SensorModel):
    """A model that has nothing but what it must."""

    name = "curvature"
    sensor = pixels = noise_terms = aot = None

    def read_sensor(self, table, given, subaperture_m):
        return Curvature(**{one.name: getattr(table, one.name) for one in fields(Numbers)})


class CurvatureKind(SensorKind):
    """Its keys."""

    name = "curvature"
    table = CurvatureTable
    unknown: ClassVar[dict[str, float]] = {"extra_m": 2.0}
    signals = (SignalKind.XY,)
    model = CurvatureModel()


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(registry.KINDS, "curvature", CurvatureKind())


@pytest.fixture
def write(tmp_path):
    def _write(wfs, more=""):
        path = tmp_path / "bench.toml"
        path.write_text(ABOUT + wfs + MIRROR + MODES + more)
        return path

    return _write


def test_its_table_is_read_by_its_own_keys(write):
    bench = load_instrument(write(WFS))
    assert registry.kind_of(bench).name == "curvature"
    assert bench.wfs.extra_m == 1.0
    assert bench.subaperture_m == pytest.approx(8.0 / 20)
    other = load_instrument(write(WFS.replace("extra_m = 1.0", "extra_m = 1.5")))
    assert instrument_sha256(bench) != instrument_sha256(other)


def test_what_may_be_unknown_of_it_is(write):
    bench = load_instrument(write(WFS.replace("1.0", '"unknown"')))
    assert bench.wfs.extra_m == 2.0
    assert bench.unknown == ("wfs.extra_m",)
    assert "wfs.extra_m: unknown; a fit" in bench.remarks[-1]


@pytest.mark.parametrize(
    ("wfs", "more", "said"),
    [
        (WFS.replace("curvature", "shear"), "", "wfs.kind: found 'shear', expected 'pyramid' or"),
        (WFS.replace("extra_m", "extra"), "", "wfs.extra: unknown key, did you mean extra_m?"),
        (
            WFS + "modulation_lambda_over_d = 3.0\n",
            "",
            'modulation_lambda_over_d: belongs to kind = "pyramid"',
        ),
        (WFS, '[slopes]\nkind = "intensity"\n', "found intensity of a curvature, expected xy"),
        (
            WFS,
            '[slopes]\nnormalisation = "local"\n',
            'normalisation: has no effect with kind = "curvature"',
        ),
    ],
)
def test_what_it_does_not_have_is_refused_in_one_line(write, wfs, more, said):
    with pytest.raises(ConfigurationError) as refused:
        load_instrument(write(wfs, more))
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_its_light_is_not_asked_for_a_start(write):
    bench = load_instrument(write(WFS))
    flux = np.ones((4, 20, 20), "<f4").tobytes()
    assert far_starts(bench, flux) == far_starts(bench, None)


def test_a_fit_has_no_number_of_it_to_find(write):
    bench = load_instrument(write(WFS))
    models = FitModels(instrument=bench, basis=None)
    assert Optic.SENSOR not in models.optics
    assert list(models.other_instruments) == ['stop = "mirror"']


def test_at_work_it_answers_as_to_a_flat_wavefront(write):
    bench, flat = load_instrument(write(WFS)), object()
    sensor = SensorAtWork(lambda at_work: flat, bench, 30, 3)
    assert sensor.is_flat
    assert sensor.models == (flat,)
    assert sensor.strength == 0.0
