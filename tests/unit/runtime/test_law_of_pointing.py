"""A night under a field that turns: the whole service follows the law, and a slew keeps α."""

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import Dome, Observatory
from service.config import load_settings
from service.errors import ConfigurationError
from service.instrument import load_instrument
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.runtime.worker import OpticsWorker
from sim_rtc.assembly import build_telescope
from sim_rtc.options import parse_options
from tests.support.small import COMPUTE, INSTRUMENT, N_CONTROLLED

LAW = '\n[law]\nrotation_deg = "azimuth - 12.984 + 0.25 * (elevation - 60)"\n'


FIRST_S, SLEWED_S = 10.5, 10.0
"""Telemetry before the slew, and until the end of the slew is followed."""


class PointedDome(Dome):
    """A telescope whose RTC tells where it points, as the simulated one does over the network."""

    def __init__(self, words):
        super().__init__(words)
        self.elevation = parse_options(words).elevation

    def status(self):
        return replace(super().status(), pointing=self.elevation.at(self.time_s))


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("law") / "law.toml"
    path.write_text(INSTRUMENT.read_text(encoding="utf-8") + LAW, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def night(file):
    """Two degrees of azimuth a minute, and a slew of 8 degrees in elevation after 11 seconds."""
    nominal_deg = 30.0 - 12.984
    words = [
        f"--instrument={file}",
        "--plant=linear",
        "--imperfections=ideal",
        f"--n-controlled={N_CONTROLLED}",
        "--seed=1",
        "--azimuth=30,2",
        "--slew=11:8",
        f"--alpha=0.06,-0.04,{nominal_deg + 0.15},1.002",
    ]
    given = {"control.n_modes_target": N_CONTROLLED}
    instrument = load_instrument(file)
    policy = policy_of(load_settings(None, {}, given), instrument)
    with threadpool_limits(1):
        bench = OpticsWorker(instrument, COMPUTE)
        dome = PointedDome(words)
        found = Observatory(words, policy, Mode.AUTO, bench, with_poles=False, dome=dome)
        found.parts = []
        for seconds in (FIRST_S, SLEWED_S, 13.0):
            found.advance(seconds)
            found.parts.append((found.state, found.dome.alpha))
    return found


def error_in_sigma(state, true):
    registration = state.alpha.registration
    return np.abs(registration.alpha.vector - true.vector) / registration.sigma


def test_alpha_is_followed_while_the_field_turns(night):
    state, true = night.parts[0]
    assert state.alpha.registration.n_windows >= 3
    assert (error_in_sigma(state, true) < 5.0).all()
    turned = np.rad2deg(true.rotation_rad) - (30.0 - 12.984 + 0.15)
    assert turned == pytest.approx(2.0 * FIRST_S / 60.0, abs=0.05)


def test_after_a_slew_alpha_is_where_the_law_has_it(night):
    """Two degrees of rotation further, one second after the telescope has come to rest."""
    (before, _), (state, true) = night.parts[0], night.parts[1]
    step = np.rad2deg(
        state.alpha.registration.alpha.rotation_rad - before.alpha.registration.alpha.rotation_rad
    )
    assert step == pytest.approx(2.0 + 2.0 * SLEWED_S / 60.0, abs=0.1)
    assert (error_in_sigma(state, true) < 6.0).all()


def test_the_reconstructor_follows_and_nothing_is_the_matter_at_the_end(night):
    state, true = night.parts[-1]
    assert (error_in_sigma(state, true) < 5.0).all()
    used = state.reconstructor(state.matrices.in_use)
    assert used.alpha is not None
    assert np.rad2deg(abs(used.alpha.rotation_rad - true.rotation_rad)) < 1.0
    assert {alarm.name for alarm in state.alarms.active} == set()
    assert "registration.jump-suspected" not in [entry.name for entry in state.log]


def test_the_simulator_has_laws_of_pointing_alone(file, tmp_path):
    path = tmp_path / "other.toml"
    text = file.read_text(encoding="utf-8").replace("azimuth -", "derotator -")
    path.write_text(text, encoding="utf-8")
    options = parse_options([f"--instrument={path}", "--seed=1"])
    with pytest.raises(ConfigurationError, match="found a law of derotator"):
        build_telescope(options, load_instrument(path))


@pytest.mark.parametrize(
    ("term", "found"),
    [
        ('shift_x_subap = "0.0008 * azimuth"', "0.288"),
        ('shift_y_subap = { of = "azimuth", at = [0, 360], values = [0.1, 0.3] }', "0.2"),
        ('rotation_deg = "azimuth / 2"', "180"),
        ('magnification = "1 + azimuth / 10000"', "0.036"),
    ],
)
def test_a_law_that_would_leap_at_north_is_refused(tmp_path, term, found):
    path = tmp_path / "law.toml"
    text = f"{INSTRUMENT.read_text(encoding='utf-8')}\n[law]\n{term}\n"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match=f"{found} more after a whole turn of azimuth"):
        load_instrument(path)


@pytest.mark.parametrize(
    ("term", "remarked"),
    [
        ('shift_x_subap = { of = "rotator", at = [-180, 180], values = [-0.1, 0.1] }', True),
        ('shift_x_subap = { of = "rotator", at = [0, 60], values = [0, 1], period = 60 }', True),
        ('shift_x_subap = { of = "rotator", at = [0, 50], values = [0, 1], period = 60 }', False),
        ('rotation_deg = { of = "rotator", at = [-180, 180], values = [-180, 180] }', False),
        ('shift_x_subap = { of = "temperature", at = [0, 20], values = [0, 0.1] }', False),
    ],
)
def test_a_table_that_does_not_close_is_remarked(tmp_path, term, remarked):
    path = tmp_path / "law.toml"
    text = f"{INSTRUMENT.read_text(encoding='utf-8')}\n[law]\n{term}\n"
    path.write_text(text, encoding="utf-8")
    found = [remark for remark in load_instrument(path).remarks if "law." in remark]
    assert len(found) == remarked
    assert all("law.shift_x_subap" in remark and "rotator" in remark for remark in found)


def test_a_period_that_is_no_number_is_refused(tmp_path):
    path = tmp_path / "law.toml"
    term = 'shift_x_subap = { of = "rotator", at = [0, 60], values = [0, 1], period = "360" }'
    path.write_text(f"{INSTRUMENT.read_text(encoding='utf-8')}\n[law]\n{term}\n", "utf-8")
    with pytest.raises(ConfigurationError, match=r"law.shift_x_subap.*values and period"):
        load_instrument(path)
