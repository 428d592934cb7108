"""What a service leaves on the disk and when, and a small telescope whose service is restarted."""

from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.acquisition import Start
from pyrcal_studies.campaign.observatory import Observatory
from service.archive import Archive
from service.config import load_settings
from service.instrument import load_instrument
from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import AcquisitionStage
from service.records.products import ModeProof
from service.records.state import Mode, TrackerState
from service.runtime.archiving import is_unsaved, is_urgent, leave, restore_tracking
from service.runtime.engine import Engine
from service.runtime.estimates import PendingWindow
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, OpticsWorker
from service.tracking.resume import restored
from tests.support.acquiring import Acquiring
from tests.support.shaped import ShapedStory
from tests.support.situations import START_NS
from tests.support.states import changed, tracker_state

SMALL = Path(__file__).parents[2] / "system" / "small.toml"
START = Start(instrument=str(SMALL), n_controlled=60, seed=0)


class TestWhatCannotWait:
    def test_every_stage_of_an_acquisition_and_the_session_it_opened_the_loop_in(self):
        story = Acquiring()
        before = story.state
        story.tell(cmd.Acquire())
        assert is_urgent(before, story.state)
        for follow in (story.open, story.see_afar, story.see_afar, lambda: story.close(150)):
            before = story.state
            follow()
            assert is_urgent(before, story.state)
            assert is_unsaved(before, story.state)

    @pytest.mark.parametrize("order", [cmd.SetMode(mode=Mode.HOLD), cmd.StopDither()])
    def test_what_an_operator_orders_and_takes_back(self, order):
        story = Acquiring()
        back = {
            "SetMode": cmd.SetMode(mode=story.state.operator.mode),
            "StopDither": cmd.StartDither(),
        }
        for command in (order, back[type(order).__name__]):
            before = story.state
            story.tell(command)
            assert is_urgent(before, story.state)
            assert is_unsaved(before, story.state)

    def test_a_window_can_wait_but_is_news(self):
        story = Acquiring()
        story.see()
        before = story.state
        story.see()
        assert is_unsaved(before, story.state)
        assert not is_urgent(before, story.state)

    def test_what_a_mode_has_shown(self):
        story = Acquiring()
        story.see()
        before = changed(story.state, mode_proof=ModeProof())
        shown = changed(before, mode_proof=ModeProof(suspected=frozenset({430})))
        assert is_urgent(before, shown)
        asked = changed(before, mode_proof=ModeProof(shown=frozenset({430})))
        assert not is_urgent(before, asked)

    def test_nothing_new_is_no_news(self):
        story = Acquiring()
        story.tell(cmd.Acquire())
        before = story.state
        story.tell(ev.Tick(), 1.0)
        assert not is_unsaved(before, story.state)


def test_the_alpha_on_the_disk_goes_when_an_acquisition_forgets_it(tmp_path):
    with Archive(tmp_path) as archive:
        archive.open()
        story = Acquiring()
        story.see(n_windows=3)
        leave(archive, story.state, story.now_ns)
        assert archive.tracking.read().registration is not None
        story.tell(cmd.Acquire())
        leave(archive, story.state, story.now_ns)
        state = restore_tracking(archive, TrackerState(system="flao"), story.policy, story.now_ns)
    assert state.alpha.registration is None
    assert state.operations.acquisition.stage is AcquisitionStage.INTERRUPTED


def test_nothing_is_written_over_what_another_night_has_left(tmp_path):
    with Archive(tmp_path) as archive:
        archive.open()
        story = Acquiring()
        story.see(n_windows=3)
        leave(archive, story.state, story.now_ns)
        leave(archive, TrackerState(system="flao"), START_NS)
        assert archive.tracking.read().registration is not None


def test_orders_are_left_beside_the_alpha_of_another_night_and_taken_back_there(tmp_path):
    """Of this night nothing is known yet."""
    with Archive(tmp_path) as archive:
        archive.open()
        story = Acquiring()
        story.see(n_windows=3)
        leave(archive, story.state, story.now_ns)
        fresh = tracker_state(system="flao", mode=Mode.AUTO)
        leave(archive, changed(fresh, stopped=True), START_NS)
        ordered = archive.tracking.read()
        assert ordered.orders.dither_stopped
        assert ordered.registration.alpha == story.state.alpha.registration.alpha
        leave(archive, fresh, START_NS)
        state = restore_tracking(archive, fresh, story.policy, story.now_ns)
    assert state.alpha.registration is not None
    assert not state.dithers.stopped


def test_orders_are_left_where_nothing_else_is_and_taken_back_there(tmp_path):
    fresh = tracker_state(system="flao", mode=Mode.AUTO)
    with Archive(tmp_path) as archive:
        archive.open()
        story = Acquiring()
        for stopped in (True, False):
            leave(archive, changed(fresh, stopped=stopped), START_NS)
            state = restore_tracking(archive, fresh, story.policy, START_NS)
            assert state.dithers.stopped is stopped


def test_a_shape_and_its_references_are_taken_over_by_the_next_service(tmp_path):
    with Archive(tmp_path) as archive:
        archive.open()
        story = ShapedStory(Mode.AUTO).load().use_references()
        story.tell(cmd.RollBackReferences(by="Ada"))
        leave(archive, story.state, story.now_ns)
        fresh = tracker_state(system="flao", mode=Mode.AUTO)
        state = restore_tracking(archive, fresh, story.policy, story.now_ns)
    kept, left = state.references, story.state.references
    assert kept.shape == left.shape is not None
    assert kept.paused == left.paused != ""


def test_what_another_system_has_left_is_neither_read_nor_kept(tmp_path):
    fresh = tracker_state(system="flao", mode=Mode.AUTO)
    with Archive(tmp_path) as archive:
        archive.open()
        leave(archive, changed(fresh, system="other", stopped=True), START_NS)
        assert not restore_tracking(archive, fresh, Acquiring().policy, START_NS).dithers.stopped
        leave(archive, changed(fresh, stopped=True), START_NS)
        assert archive.tracking.read().system == "flao"


class Restartable(Observatory):
    """A night whose service can end and begin again while the telescope goes on."""

    def restart_service(self, archive, mode, bench):
        old, now_ns = self.state, self.dome.now_ns
        leave(archive, old, now_ns)
        self._agenda.clear()
        self._link.sent.clear()
        self._fitting, self._backlog, self._worker_free_ns = False, PendingWindow(), 0
        shelf = restored(old.matrices.reconstructors)
        fresh = tracker_state(system=old.system, mode=mode, reconstructors=shelf)
        policy = self._engine.policy
        self._engine = Engine(restore_tracking(archive, fresh, policy, now_ns), policy, self)
        self._engine.set_description(bench.describe())
        self._begin()

    def until(self, stage, within_s=30.0):
        over_s = self.time_s + within_s
        while self.state.operations.acquisition.stage is not stage:
            assert self.time_s < over_s, [entry.text for entry in self.state.log]
            self.advance(0.05)


@pytest.fixture(scope="module")
def bench():
    return OpticsWorker(load_instrument(str(SMALL)), Compute(threads=1))


@pytest.fixture
def interrupted(bench, tmp_path):
    """Return a night whose loop diverged and was opened; its service was restarted then."""

    def play(stage, mode):
        settings = load_settings(None, {}, {"control.n_modes_target": 60})
        night = Restartable(START.words, policy_of(settings), Mode.AUTO, bench, with_poles=True)
        night.until(stage)
        night.advance(0.3)
        with Archive(tmp_path) as archive:
            archive.open()
            night.restart_service(archive, mode, bench)
        return night

    with threadpool_limits(1):
        yield play


def test_the_next_service_ends_tracking_where_the_mirror_is(interrupted):
    night = interrupted(AcquisitionStage.CONFIRMING, Mode.AUTO)
    assert not night.dome.moments[-1].closed
    assert night.state.operations.acquisition.stage is AcquisitionStage.INTERRUPTED
    night.until(AcquisitionStage.TRACKING)
    assert night.dome.moments[-1].closed
    assert night.state.operations.acquisition.attempt == 2
    error = night.state.alpha.registration.alpha.vector - night.dome.alpha.vector
    assert (abs(error) < 5.0 * night.state.alpha.registration.sigma).all()
    assert all(swap.radius < 0.95 for swap in night.swaps)


def test_one_that_may_not_leaves_the_loop_open_and_asks_nothing_of_the_rtc(interrupted):
    night = interrupted(AcquisitionStage.COARSE, Mode.PROPOSE)
    n_orders = len(night.dome.orders)
    night.advance(3.0)
    assert not night.dome.moments[-1].closed
    assert len(night.dome.orders) == n_orders


def test_one_whose_loop_had_just_been_closed_goes_on_from_there(interrupted):
    night = interrupted(AcquisitionStage.WIDENING, Mode.AUTO)
    matrix = night.dome.moments[-1].cm_id
    night.advance(2.0)
    assert night.dome.moments[-1].closed
    assert night.state.operations.acquisition.stage is AcquisitionStage.ABORTED
    assert matrix in night.state.operations.acquisition.text
    error = night.state.alpha.registration.alpha.vector - night.dome.alpha.vector
    assert (abs(error) < 5.0 * night.state.alpha.registration.sigma).all()
