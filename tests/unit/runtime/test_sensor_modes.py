"""A night with two changes of binning: α stays, in the subapertures of each mode."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import Dome, Observatory
from service.config import load_settings
from service.errors import ModelError
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE
from service.model.pupil import rtc_valid_subapertures
from service.model.slopes import Orientation, SlopeRecipe, to_rtc
from service.records.estimates import RefusalKind
from service.records.products import MatrixState
from service.records.state import LoopState, Mode, ModelState, TrackerState
from service.runtime.estimates import fitted
from service.runtime.policy import policy_of
from service.runtime.worker import OpticsWorker
from service.tracking.reconstructors import check_sendable
from service.tracking.resume import resumed, saved_of
from sim_rtc.options import parse_options
from tests.support.small import COMPUTE
from tests.support.supervisor import Window

FILE = """
[instrument]
name = "binned"
diameter_m = 3.0
obscuration_ratio = 0.1
stop = "mirror"

[wfs]
kind = "pyramid"
n_subapertures = 24
pupil_separation_subap = 30
wavelength_m = 750e-9
modulation_lambda_over_d = 3.0

[[wfs.mode]]
config_id = "fine"
n_controlled = 45

[[wfs.mode]]
config_id = "coarse"
binning = 2
n_controlled = 20

[mirror]
layout = "rings"
first_ring = 1
last_ring = 6
pitch_m = 0.28

[modes]
n_modes = 90
"""
TRUE = np.array([0.08, -0.06, 0.3, 1.003])
"""In the subapertures of the fine mode and degrees."""

HALF = np.array([0.5, 0.5, 1.0, 1.0])


class Dome2(Dome):
    """A telescope whose RTC begins again in the mode that is asked for next."""

    words: tuple[str, ...] = ()
    next_mode = "fine"

    def restart(self):
        alpha = TRUE * (HALF if self.next_mode == "coarse" else 1.0)
        words = [*self.words, f"--sensor-mode={self.next_mode}", written(alpha)]
        self.telescope = self._built(parse_options(words))
        self.computer = self.telescope.computer(self._blocks())
        self._clock.restart(self.now_ns)


def written(alpha):
    return "--alpha=" + ",".join(map(str, alpha))


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """The whole night, and what was known at the end of each of its three parts."""
    path = tmp_path_factory.mktemp("binned") / "binned.toml"
    path.write_text(FILE, encoding="utf-8")
    words = (f"--instrument={path}", "--plant=linear", "--imperfections=ideal", "--seed=1")
    instrument = load_instrument(path)
    given = {"control.n_modes_target": 45, "control.minimum_interval_s": 1.0}
    policy = policy_of(load_settings(None, {}, given), instrument)
    with threadpool_limits(1):
        dome = Dome2([*words, written(TRUE)])
        dome.words = words
        bench = OpticsWorker(instrument, COMPUTE)
        found = Observatory(words, policy, Mode.AUTO, bench, with_poles=False, dome=dome)
        found.parts = []
        for mode in ("fine", "coarse", "fine"):
            if found.parts:
                dome.next_mode = mode
                found.restart_rtc()
                found.advance(0.5)
                found.parts[-1]["after"] = found.state
            found.advance(10.0)
            found.parts.append({"mode": mode, "state": found.state})
    return found


def off_in_sigma(state, true):
    registration = state.alpha.registration
    error = registration.alpha.vector - true / BOUNDARY_SCALE
    return np.abs(error) / registration.sigma


def test_alpha_is_right_in_the_subapertures_of_each_mode(night):
    for part in night.parts:
        state, scale = part["state"], HALF if part["mode"] == "coarse" else 1.0
        assert state.loop.config_id == state.alpha.registration.config_id == part["mode"]
        assert state.alpha.registration.n_windows >= 2
        assert (off_in_sigma(state, TRUE * scale) < 5.0).all()


def test_a_change_of_mode_keeps_alpha_before_any_window_of_the_new_one(night):
    first, second = night.parts[0], night.parts[1]
    for before, after, scale in (
        (first["state"], first["after"], HALF),
        (second["state"], second["after"], 1.0 / HALF),
    ):
        kept, known = after.alpha.registration, before.alpha.registration
        assert kept.alpha.vector == pytest.approx(known.alpha.vector * scale)
        assert np.sqrt(np.diag(kept.covariance)) == pytest.approx(
            np.sqrt(np.diag(known.covariance)) * scale
        )
        assert (kept.n_windows, kept.bias, kept.optical_gains) == (0, None, ())


def test_the_change_is_told_in_one_line(night):
    texts = [entry.text for entry in night.state.log if entry.name == "sensor.mode"]
    assert [text.partition(";")[0] for text in texts] == [
        "the sensor's mode is coarse, it was fine",
        "the sensor's mode is fine, it was coarse",
    ]
    assert all("α is kept" in text for text in texts)


def test_matrices_are_made_and_used_in_each_mode_with_no_more_modes_than_it_has(night):
    records = night.state.matrices.reconstructors
    for mode, most in (("fine", 45), ("coarse", 20)):
        own = [r for r in records if r.config_id == mode and r.alpha is not None and r.was_used]
        assert own
        assert max(record.n_modes for record in own) <= most
    assert not [r for r in records if r.state in {MatrixState.FAILED, MatrixState.REJECTED}]
    assert night.state.alarms.active == ()


def test_a_matrix_of_another_mode_cannot_be_sent(night):
    coarse = next(r for r in night.state.matrices.reconstructors if r.config_id == "coarse")
    why = check_sendable(night.state, coarse)
    assert why.startswith("it is for the sensor's mode coarse, which is now fine: ")
    previous = night.state.previous
    assert previous is None or night.state.reconstructor(previous).config_id == "fine"


def test_after_a_restart_in_another_mode_alpha_is_there_in_its_subapertures(night):
    """The service begins in the first mode; α was saved in the other."""
    coarse, policy = night.parts[1]["state"], night._engine.policy
    saved = saved_of(coarse, night.now_ns())
    fresh = replace(TrackerState(system=coarse.system), loop=LoopState(config_id="fine"))
    found = resumed(fresh, saved, policy, night.now_ns()).alpha.registration
    assert found.alpha.vector == pytest.approx(coarse.alpha.registration.alpha.vector / HALF)
    assert found.config_id == "fine"
    unknown = replace(fresh, loop=LoopState(config_id="third"))
    assert resumed(unknown, saved, policy, night.now_ns()).alpha.registration is None


def test_the_mirrors_modes_are_the_same_in_every_mode_of_the_sensor(tmp_path):
    """Seen by a sensor of their own, 12 x 12, sampled as finely: the very same slopes."""
    path = tmp_path / "modes.toml"
    path.write_text(FILE, encoding="utf-8")
    worker = OpticsWorker(load_instrument(path), replace(COMPUTE, cache=None))
    fine = worker._basis
    worker.restore(ModelState(sensor_mode="coarse"), {})
    told = worker.describe()
    assert (worker._basis.mode_to_actuator == fine.mode_to_actuator).all()
    points = np.array([[1.3, -2.1], [-4.0, 0.4]])
    assert worker._basis.render(points) == pytest.approx(fine.render(2 * points), abs=1e-9)
    assert told.n_slopes == 2 * int(worker._model.valid.sum())
    assert len(worker._model.valid) == 12


@pytest.mark.parametrize("mode", ["coarse", "fine"])
def test_a_new_worker_has_mode_and_orientation_of_the_one_before(tmp_path, mode):
    path = tmp_path / "modes.toml"
    path.write_text(FILE.replace("[mirror]", '[slopes]\norientation = "auto"\n\n[mirror]'), "utf-8")
    worker = OpticsWorker(load_instrument(path), COMPUTE)
    theirs = SlopeRecipe(orientation=Orientation(flip_x=True))
    matrix = np.linalg.pinv(worker.response(None)[:, :45])
    mask = rtc_valid_subapertures(worker._model.instrument)
    flipped = np.ascontiguousarray(to_rtc(matrix.T, theirs, mask).T, np.float32)
    assert worker.read_slope_convention(flipped, None).adopted
    state = ModelState(sensor_mode=mode, slopes=worker.state.slopes)
    another = OpticsWorker(load_instrument(path), COMPUTE)
    for one in (worker, another):
        one.restore(state, {})
        assert one._model.instrument.slopes == theirs
        assert one._model.instrument.config_id == mode
    np.testing.assert_array_equal(another.response(None), worker.response(None))
    if mode == "fine":
        assert not another.read_slope_convention(flipped, None).adopted


def test_a_mode_that_the_instrument_does_not_have_is_refused(tmp_path):
    path = tmp_path / "modes.toml"
    path.write_text(FILE, encoding="utf-8")
    worker = OpticsWorker(load_instrument(path), COMPUTE)
    with pytest.raises(ModelError, match="found mode third, expected one of: fine, coarse"):
        worker.restore(ModelState(sensor_mode="third"), {})
    assert worker.describe().n_slopes == worker._model.n_slopes


async def test_a_window_of_an_unknown_dither_is_not_taken_for_sines(night):
    window = SimpleNamespace(session=night.state.loop.rtc.session, t_end_ns_utc=7)
    with pytest.raises(AssertionError):
        await fitted(window, night.state, workers=None, matrix_of=None)


async def test_a_window_of_a_session_before_is_not_fitted(night):
    """The worker has another model by then: of another mode, it could only fail."""
    window = Window(session="before", t_end_ns_utc=7)
    lost = await fitted(window, night.state, workers=None, matrix_of=None)
    assert (lost.refused.reason.code, lost.refused.t_ns_utc) == ("window.other-session", 7)
    assert lost.refused.kind is RefusalKind.VOID
