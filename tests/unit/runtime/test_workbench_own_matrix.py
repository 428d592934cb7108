"""What the RTC's own matrix tells of its modes goes into every matrix that is made from then on."""

import numpy as np
import pytest

from pyrcal_studies.campaign.observatory import OwnHands
from service.errors import UnknownIdError
from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInPlan
from service.model.misregistration import Misregistration
from service.runtime.estimates import read_own_matrix
from service.runtime.worker import OpticsWorker
from service.tracking.events import ModesRecognised
from service.tracking.products import MatrixState, ReconstructorRecord
from tests.states import tracker_state
from tests.unit.runtime.small import (
    COMPUTE,
    N_CONTROLLED,
    SIGMA,
    conditions,
    loop_settings,
    small_instrument,
)
from tests.unit.runtime.test_workbench import ALPHA, dithered_window, open_loop


@pytest.fixture
def bench():
    return OpticsWorker(small_instrument(), COMPUTE)


def made_by(bench):
    return bench.make(conditions(ALPHA, np.diag(SIGMA**2), loop_settings(), 0.95))


def own(bench, scale):
    """The RTC's matrix by day, elsewhere, for modes that answer so many times as drawn."""
    response = bench.response(Misregistration())[:, :N_CONTROLLED].astype(float)
    return np.linalg.pinv(response * scale).astype(np.float32)


@pytest.mark.parametrize("scale", [0.5, np.where(np.arange(N_CONTROLLED) == 10, 3.0, 1.0)])
def test_a_matrix_acts_as_strongly_as_the_rtcs_own(bench, scale):
    theirs, plain = own(bench, scale), made_by(bench)
    truth = bench.response(ALPHA)[:, :N_CONTROLLED] * scale
    found, response = bench.recognise(theirs, None, None)
    assert found.wrong == ""
    np.testing.assert_allclose(response[:N_CONTROLLED], scale * np.ones(N_CONTROLLED), rtol=0.02)
    made = made_by(bench)
    np.testing.assert_allclose(np.diag(made.matrix @ truth), 1.0, atol=0.02)
    # judged with the response it has, the loop is the one of before
    assert made.gate.worst_pole_radius == pytest.approx(plain.gate.worst_pole_radius, abs=5e-3)


def test_telemetry_is_then_compared_with_that_response(bench):
    window = dithered_window(bench, ALPHA, gain=0.5)
    reconstructor = own(bench, 0.5)
    bench.recognise(reconstructor, None, None)
    estimate = bench.fit(window, open_loop(reconstructor), None)
    np.testing.assert_allclose(np.abs(estimate.optical_gain), 1.0, atol=0.05)
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert np.all(np.abs(estimate.alpha.vector - ALPHA.vector) < 4 * sigma + 2e-4)


def test_a_matrix_that_answers_as_drawn_changes_nothing(bench):
    before = bench.response(ALPHA)
    found, response = bench.recognise(own(bench, 1.05), None, None)
    assert response is None
    assert found.known.all()
    np.testing.assert_array_equal(bench.response(ALPHA), before)


def test_nothing_is_taken_over_from_a_matrix_of_other_modes(bench):
    turned = np.where(np.arange(N_CONTROLLED) == 10, -0.5, 0.5)
    found, response = bench.recognise(own(bench, turned), None, None)
    assert "mode 10 has the other sign" in found.wrong
    assert response is None


def test_a_new_worker_is_told_what_the_last_one_found(bench):
    _, response = bench.recognise(own(bench, 0.5), None, None)
    another = OpticsWorker(small_instrument(), COMPUTE)
    another.adopt(None, response)
    np.testing.assert_allclose(another.response(ALPHA), bench.response(ALPHA), rtol=1e-5)


def test_a_new_worker_judges_loops_with_the_measured_response_too(bench):
    """What the model does not explain of the RTC's own matrix weakens the loop of its inverse."""
    rng = np.random.default_rng(4)
    response = bench.response(Misregistration())[:, :N_CONTROLLED].astype(float)
    error = rng.standard_normal(response.shape)
    error *= 0.4 * np.linalg.norm(response, axis=0) / np.linalg.norm(error, axis=0)
    found, mode_response = bench.recognise(
        np.linalg.pinv(response + error).astype(np.float32), None, None
    )
    another = OpticsWorker(small_instrument(), COMPUTE)
    plain = made_by(another).gate.worst_pole_radius
    another.adopt(None, mode_response, None, found.left_over)
    radius = made_by(bench).gate.worst_pole_radius
    assert made_by(another).gate.worst_pole_radius == pytest.approx(radius, abs=1e-3)
    assert radius > plain + 0.01


async def test_after_a_restart_the_rtcs_own_matrix_is_read_and_not_the_one_made_of_the_model(bench):
    """The one in use agrees with the model in everything: it tells nothing of its error."""
    rng = np.random.default_rng(4)
    response = bench.response(Misregistration())[:, :N_CONTROLLED].astype(float)
    error = rng.standard_normal(response.shape)
    error *= 0.3 * np.linalg.norm(response, axis=0) / np.linalg.norm(error, axis=0)
    matrices = {
        "own": np.linalg.pinv(response + error).astype(np.float32),
        "made": made_by(bench).matrix,
    }
    theirs, made = (
        ReconstructorRecord(
            id=name,
            state=MatrixState.APPLIED,
            n_modes=N_CONTROLLED,
            created_ns_utc=0,
            parent=parent,
        )
        for name, parent in (("own", None), ("made", "own"))
    )
    state = tracker_state(system="small", reconstructors=(theirs, made), in_use="made")

    async def read(known):
        workers = OwnHands(OpticsWorker(small_instrument(), COMPUTE))
        found = await read_own_matrix(made, matrices["made"], state, workers, known)
        return next(event for event in found if isinstance(event, ModesRecognised))

    assert (await read(matrices.__getitem__)).misfit == pytest.approx(0.3, abs=0.03)

    def lost(name):
        raise UnknownIdError(name)

    assert (await read(lost)).misfit < 0.02


N_MORE = 79
"""Modes of a matrix that controls more than the RTC's own; beyond, the edge would slip."""


def a_window_of_free_modes(response, noise=1e-3):
    """Two seconds of an open loop whose modes 45 to 89 are dithered together."""
    rng, time = np.random.default_rng(2), np.arange(2000) / 1000.0
    modes = tuple(range(N_CONTROLLED, 90))
    lines = tuple(160.0 + 6.0 * k for k in range(len(modes)))
    dither = np.zeros((len(time), 90), np.float32)
    for mode, line in zip(modes, lines, strict=True):
        dither[:, mode] = 1e-9 * np.sqrt(2) * np.sin(2 * np.pi * line * time)
    scatter = noise * rng.standard_normal((len(time), len(response)))
    block = FrameBlock(
        session="s1",
        first_seq=0,
        t0_ns_utc=0,
        dt_ns=1_000_000,
        slopes=(dither @ response.T + scatter).astype(np.float32),
        commands_m=dither,
        dither_m=dither,
        cm_id="initial",
    )
    plan = LockInPlan(
        modes=modes,
        frequencies_hz=lines,
        amplitude_m=(1e-9,) * len(modes),
        frame_rate_hz=1000.0,
        n_frames=len(time),
        first_seq=0,
    )
    _, (window,) = LockIn(plan=plan).accumulate(block)
    return window


def test_a_loop_is_judged_with_the_dithered_response_of_modes_that_the_rtc_does_not_control(bench):
    """The model's error of the modes above those of the RTC's own matrix makes the loop unstable.

    The error of pairs of modes exchanges them in part: each responds as the other, too, with
    opposite signs, so that the eigenvalues of g R D are about 0.4 (1 ± 1.3 i).
    """
    start = Misregistration()
    model = bench.response(start).astype(float)
    first, second = np.arange(N_CONTROLLED, 89, 2), np.arange(N_CONTROLLED + 1, 90, 2)
    truth = model.copy()
    # Of random sense, because a rotation of the mirror exchanges all pairs in one sense.
    ratio = 1.3 * np.random.default_rng(3).choice([-1.0, 1.0], len(first))
    truth[:, first] += ratio * model[:, second]
    truth[:, second] -= ratio * model[:, first]
    own = np.linalg.pinv(truth[:, :N_CONTROLLED]).astype(np.float32)
    found, _ = bench.recognise(own, None, None)
    assert found.known.all()
    more = conditions(start, np.diag(SIGMA**2), loop_settings(N_MORE), 0.95)
    inverse = np.linalg.pinv(model[:, :N_MORE]).astype(np.float32)
    assert bench.judge(inverse, more).accepted
    bench.fit(a_window_of_free_modes(truth), open_loop(own), start)
    verdict = bench.judge(inverse, more)
    poles = loop_settings(N_MORE).pole_radius(np.linalg.eigvals(0.4 * inverse @ truth[:, :N_MORE]))
    assert poles.max() > 1.0
    assert verdict.worst_pole_radius >= poles.max()
    assert not verdict.accepted
    # a matrix of the RTC's own modes alone is judged as before
    fewer = conditions(start, np.diag(SIGMA**2), loop_settings(), 0.95)
    assert bench.judge(inverse[:N_CONTROLLED], fewer).accepted


def test_a_window_of_a_right_model_changes_no_verdict(bench):
    start = Misregistration()
    truth = bench.response(start).astype(float)
    own = np.linalg.pinv(truth[:, :N_CONTROLLED]).astype(np.float32)
    bench.recognise(own, None, None)
    more = conditions(start, np.diag(SIGMA**2), loop_settings(N_MORE), 0.95)
    inverse = np.linalg.pinv(truth[:, :N_MORE]).astype(np.float32)
    before = bench.judge(inverse, more).worst_pole_radius
    bench.fit(a_window_of_free_modes(truth), open_loop(own), start)
    assert bench.judge(inverse, more).worst_pole_radius == pytest.approx(before, abs=0.02)


@pytest.mark.parametrize(("error", "counts"), [(0.02, False), (0.3, True)])
def test_where_the_model_is_poor_the_noise_of_a_dither_counts_as_its_error(bench, error, counts):
    start, rng = Misregistration(), np.random.default_rng(4)
    truth = bench.response(start).astype(float)
    part = rng.standard_normal((len(truth), N_CONTROLLED))
    part *= error * np.linalg.norm(truth[:, :N_CONTROLLED], axis=0) / np.linalg.norm(part, axis=0)
    truth[:, :N_CONTROLLED] += part
    bench.recognise(np.linalg.pinv(truth[:, :N_CONTROLLED]).astype(np.float32), None, None)
    more = conditions(start, np.diag(SIGMA**2), loop_settings(N_MORE), 0.95)
    inverse = np.linalg.pinv(bench.response(start)[:, :N_MORE]).astype(np.float32)
    before = bench.judge(inverse, more).worst_pole_radius
    own = np.zeros((0, len(truth)), np.float32)
    bench.fit(a_window_of_free_modes(truth, noise=0.1), open_loop(own), start)
    raised = bench.judge(inverse, more).worst_pole_radius - before
    assert raised > 0.1 if counts else raised < 0.02
