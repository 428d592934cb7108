"""The noisy interaction matrix from windows to archive and picture, on a small instrument."""

import h5py
import numpy as np
import pytest

from service.errors import CommandError, UnknownIdError, WorkerError
from service.estimation.frames import FrameBlock
from service.estimation.random_dither import RandomDither, RandomPlan
from service.model.misregistration import Misregistration
from service.records import events as ev
from service.records.alarms import Alarm
from service.records.messages import as_message
from service.records.operations import MeasurementRecord, MeasureState
from service.runtime.actions import Actions, Publishing
from service.runtime.estimates import NoisySums
from service.runtime.worker import OpticsWorker
from tests.support.situations import rtc
from tests.support.small import COMPUTE, small_instrument
from tests.support.states import changed, tracker_state

ALPHA = Misregistration(
    shift_x_subap=0.12, shift_y_subap=-0.08, rotation_rad=0.004, magnification=1.003
)
MODES = tuple(range(0, 60, 2))
TOTAL_M = 5e-9
DIVERGING = Alarm(name="loop-diverging", since_ns_utc=0, message=as_message("x", "it does"))
N_FRAMES = 1000
RUNNING = MeasurementRecord(
    id="noisy-1",
    state=MeasureState.RUNNING,
    pattern=None,
    modes=MODES,
    amplitude_m=(TOTAL_M / len(MODES) ** 0.5,) * len(MODES),
    duration_s=2.0,
    window_s=1.0,
    seed=3,
    asked_ns_utc=0,
    basis_id="kl",
    config_id="b1",
)
STATE = tracker_state(system="small", measurements=(RUNNING,))


class NearCrew:
    """Runs jobs here and now, on the real workbench."""

    def __init__(self):
        self.bench = OpticsWorker(small_instrument(), COMPUTE)

    async def call(self, job, *args):
        return job(self.bench, *args)


@pytest.fixture(scope="module")
def workers():
    return NearCrew()


@pytest.fixture
def desk(workers, archive):
    return NoisySums(workers=workers, archive=archive, instrument=small_instrument())


def windows(workers, n=2, *, gain=0.6, noise=3e-3, modes=MODES, session="s1"):
    """Windows of a sensor that sees random signs on these modes, and noise."""
    rng = np.random.default_rng(7)
    matrix = workers.bench.response(ALPHA)
    amplitude_m = TOTAL_M / np.sqrt(len(modes))
    dither = np.zeros((n * N_FRAMES, matrix.shape[1]), np.float32)
    dither[:, modes] = amplitude_m * rng.choice([-1.0, 1.0], (len(dither), len(modes)))
    slopes = gain * dither @ matrix.T + noise * rng.standard_normal((len(dither), len(matrix)))
    block = FrameBlock(
        session=session,
        first_seq=0,
        t0_ns_utc=0,
        dt_ns=1_000_000,
        slopes=slopes.astype(np.float32),
        commands_m=dither,
        dither_m=dither,
        cm_id="cm-1",
    )
    plan = RandomPlan(
        modes=modes, amplitude_m=(amplitude_m,) * len(modes), n_frames=N_FRAMES, first_seq=0
    )
    _, found = RandomDither(plan=plan).accumulate(block)
    return found


async def finish(desk, workers, **changes):
    for window in windows(workers, **changes):
        desk.take(window, STATE)
    return await desk.finish(RUNNING, STATE)


async def test_windows_become_an_archived_matrix_and_the_registration_in_it(desk, workers, archive):
    made = await finish(desk, workers)
    assert isinstance(made, ev.MatrixMeasured)
    record = made.record
    assert (record.state, record.reason) == (MeasureState.STORED, "")
    found = record.finding
    assert (found.n_frames, found.session, found.cm_id) == (1998, "s1", "cm-1")
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.alpha.vector - ALPHA.vector) < 4.0 * sigma)
    assert found.optical_gain == pytest.approx(0.6, abs=0.03)
    assert [r.id for r in archive.noisy.records()] == ["noisy-1"]


async def test_what_is_archived_is_the_matrix_within_its_stated_noise(desk, workers, archive):
    await finish(desk, workers)
    with h5py.File(archive.noisy.path_of("noisy-1")) as file:
        matrix, noise = file["interaction_matrix"][()], file["element_noise"][()]
        synthetic, gain = file["synthetic"][()], file["optical_gain"][()]
    true = 0.6 * workers.bench.response(ALPHA)[:, list(MODES)]
    assert np.sqrt(np.mean(((matrix - true) / noise) ** 2)) == pytest.approx(1.0, abs=0.03)
    # the model at the α found lies within that noise, too
    assert np.linalg.norm(synthetic * gain - true) < 0.1 * np.linalg.norm(matrix - true)


async def test_windows_of_another_dither_or_of_a_loop_out_of_hand_do_not_count(desk, workers):
    (other,) = windows(workers, n=1, modes=MODES[:5])
    desk.take(other, STATE)
    (window,) = windows(workers, n=1)
    desk.take(window, changed(STATE, measurements=()))
    desk.take(window, changed(STATE, active=(DIVERGING,)))
    with pytest.raises(CommandError, match="no window of its dither was whole"):
        await desk.finish(RUNNING, STATE)


async def test_what_came_before_the_rtc_restarted_does_not_count(desk, workers):
    (before,) = windows(workers, n=1)
    desk.take(before, STATE)
    made = await finish(desk, workers, n=1, session="s2")
    assert (made.record.finding.session, made.record.finding.n_frames) == ("s2", 999)


async def test_a_worker_that_dies_of_the_last_job_takes_no_window_with_it(archive, workers):
    class Dying(NearCrew):
        n_jobs = 0

        async def call(self, job, *args):
            self.n_jobs += 1
            if self.n_jobs == 1:
                raise WorkerError("the worker process died during work_out")
            return await super().call(job, *args)

    dying = Dying()
    desk = NoisySums(workers=dying, archive=archive, instrument=small_instrument())
    made = await finish(desk, dying)
    assert (made.record.state, made.record.finding.n_frames) == (MeasureState.STORED, 1998)
    assert dying.n_jobs == 2


async def test_a_matrix_nobody_can_fit_is_kept_and_says_so(desk, workers):
    made = await finish(desk, workers, gain=0.0)
    assert made.record.finding.alpha is None


async def test_nothing_that_publishes_finds_one(workers, archive):
    actions = Actions(
        bridge=None,
        workers=workers,
        archive=archive,
        instrument=small_instrument(),
        publishing=Publishing(system="small", chunk_bytes=4096, pole_radius_bound=0.95),
        clock_ns=lambda: 0,
    )
    await finish(actions.noisy, workers)
    with pytest.raises(UnknownIdError):
        actions.matrix("noisy-1")
    state = changed(STATE, rtc=rtc())
    for effect in (
        ev.SendMatrix(id="noisy-1", n_modes=30, gains=None),
        ev.RepublishMatrix(source="noisy-1", why="a mistake"),
    ):
        with pytest.raises(UnknownIdError, match="noisy-1"):
            await actions.perform(effect, state)
    assert archive.reconstructors.records() == ()
