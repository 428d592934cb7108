from dataclasses import replace

import pytest

from service.errors import UnknownIdError
from service.estimation.loop import extend_gains
from service.records import events as ev
from service.records.products import MatrixState
from service.records.state import Level, Mode, TrackerState
from service.tracker import step
from service.tracking.reconstructors import (
    RECONSTRUCTORS_KEPT,
    RETURNS_KEPT,
    UNSENT_KEPT,
    change_state,
    mark_applied,
    store_reconstructor,
)
from service.tracking.resume import restored
from tests.support.situations import (
    POLICY,
    START_NS,
    Story,
    acknowledged,
    foreign,
    of_kind,
    record,
    rtc,
    turned,
    verdict,
)
from tests.support.states import changed, tracker_state


@pytest.fixture
def story():
    story = Story(Mode.HOLD).meet()
    story.see(n_windows=2)
    return story


def test_more_modes_get_the_gain_of_the_last_controlled_one_and_fewer_release_the_rest():
    view = rtc(gains=(0.4,) * 399 + (0.3,) + (0.0,) * 194)
    assert extend_gains(view, 500) == (0.4,) * 399 + (0.3,) * 101 + (0.0,) * 94
    assert extend_gains(rtc(), 100) == (0.4,) * 100 + (0.0,) * 494


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("wanted", [True, False])
def test_a_refused_matrix_is_never_sent(mode, wanted):
    story = Story(mode).meet()
    assert not of_kind(story.make("cm-1", MatrixState.REFUSED, wanted=wanted), ev.SendMatrix)
    entry = story.state.log[-1]
    assert (entry.name, entry.level) == ("reconstructor.refused", Level.WARNING)
    assert "too little margin" in entry.text


def test_a_newer_proposal_replaces_one_nobody_has_decided_on(story):
    story.make("cm-1")
    story.make("cm-2")
    assert story.matrix_state("cm-1") is MatrixState.DISCARDED
    assert story.state.reconstructor("cm-1").reason == "cm-2 replaces it"
    assert story.matrix_state("cm-2") is MatrixState.PROPOSED


def test_the_number_of_modes_is_commanded_only_when_it_changes(story):
    (same,) = story.make("cm-1", wanted=True, n_modes=400)
    (more,) = story.make("cm-2", wanted=True, n_modes=500)
    assert (same.n_modes, same.gains) == (400, None)
    assert more.n_modes == 500
    assert more.gains == (0.4,) * 500 + (0.0,) * 94


def test_an_applied_matrix_is_in_use_from_the_frame_the_rtc_names(story):
    story.make("cm-1", wanted=True)
    story.acknowledge("cm-1", MatrixState.STAGED)
    assert story.matrix_state("cm-1") is MatrixState.STAGED
    assert story.state.matrices.in_use == "initial"
    story.acknowledge("cm-1", frame_seq=4242)
    assert story.state.matrices.in_use == "cm-1"
    assert story.state.reconstructor("cm-1").applied_frame_seq == 4242
    assert story.matrix_state("initial") is MatrixState.SUPERSEDED
    assert story.state.matrices.margin == story.state.reconstructor("cm-1").gate


def test_a_late_acknowledgement_is_accepted_and_ends_the_alarm(story):
    story.make("cm-1", wanted=True)
    story.wait(10)
    assert "no-acknowledgement" in story.alarms
    story.acknowledge("cm-1")
    assert story.state.matrices.in_use == "cm-1"
    assert "no-acknowledgement" not in story.alarms


def test_no_acknowledgement_of_before_takes_back_what_is_in_use(story):
    story.use("cm-1")
    story.acknowledge("cm-1", MatrixState.STAGED)
    assert story.matrix_state("cm-1") is MatrixState.APPLIED
    story.use("cm-2")
    story.acknowledge("cm-1")
    assert story.state.matrices.in_use == "cm-2"
    assert story.matrix_state("cm-1") is MatrixState.SUPERSEDED


def test_the_rtcs_reason_for_a_rejection_is_kept(story):
    story.make("cm-1", wanted=True)
    story.acknowledge("cm-1", MatrixState.REJECTED, "range: 399 modes, expected 400")
    assert story.matrix_state("cm-1") is MatrixState.REJECTED
    assert story.state.reconstructor("cm-1").reason == "range: 399 modes, expected 400"
    assert story.state.matrices.in_use == "initial"
    assert story.state.log[-1].level is Level.WARNING


def test_an_acknowledgement_for_an_unknown_id_is_logged_and_changes_nothing(story):
    before = story.state.matrices.reconstructors
    story.acknowledge("cm-unknown")
    assert story.state.matrices.reconstructors == before
    assert story.state.matrices.in_use == "initial"
    assert story.state.log[-1].name == "acknowledgement.unknown"
    assert "cm-unknown" in story.state.log[-1].text


def test_the_margin_of_the_matrix_in_use_is_kept_and_short_is_an_alarm(story):
    story.tell(ev.MarginJudged(id="initial", verdict=verdict(accepted=False, radius=1.1)))
    assert story.state.matrices.margin.worst_pole_radius == 1.1
    assert story.state.reconstructor("initial").gate.worst_pole_radius == 1.1
    assert "margin" in story.alarms
    story.tell(ev.MarginJudged(id="initial", verdict=verdict()))
    assert "margin" not in story.alarms


def test_a_verdict_that_comes_too_late_belongs_to_its_own_matrix_whose_alarm_has_ended(story):
    short = ev.MarginJudged(id="initial", verdict=verdict(accepted=False, radius=1.1))
    story.tell(short)
    assert "margin" in story.alarms
    story.use("cm-1")
    margin = story.state.matrices.margin
    story.tell(replace(short, verdict=verdict(accepted=False, radius=1.2)))
    assert story.state.matrices.margin is margin
    assert not story.alarms
    assert story.state.reconstructor("initial").gate.worst_pole_radius == 1.2


class TestOldAcknowledgements:
    def test_one_of_another_session_changes_nothing(self):
        state = tracker_state(
            system="flao", rtc=rtc(), reconstructors=(record("cm-1", MatrixState.PUBLISHED),)
        )
        told = acknowledged("cm-1", session="s0", state=MatrixState.APPLIED, reason="", frame_seq=5)
        after, _ = step(state, told, POLICY, START_NS)
        assert after.reconstructor("cm-1").state is MatrixState.PUBLISHED


# --- how many are kept


STATE = TrackerState(system="flao")


def with_record(state, made):
    return turned(state, store_reconstructor, made)


def with_in_use(state, matrix_id):
    return turned(state, mark_applied, matrix_id)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (MatrixState.PUBLISHED, MatrixState.FAILED),
        (MatrixState.STAGED, MatrixState.FAILED),
        (MatrixState.PROPOSED, MatrixState.DISCARDED),
        (MatrixState.APPLIED, MatrixState.APPLIED),
        (MatrixState.SUPERSEDED, MatrixState.SUPERSEDED),
        (MatrixState.REFUSED, MatrixState.REFUSED),
    ],
)
def test_a_restarted_service_gives_up_what_was_under_way_and_keeps_what_was_decided(before, after):
    (kept,) = restored((record("cm-1", before),))
    assert kept.state is after
    assert (kept.reason == "the service restarted") is (before is not after)


def test_a_restarted_service_knows_the_rtcs_own_matrices_and_believes_none_of_them():
    assert [kept.id for kept in restored((foreign(), record("cm-1")))] == ["initial", "cm-1"]
    story = Story(state=changed(STATE, reconstructors=restored((foreign(),))))
    story.shows = False
    story.tell(ev.SessionStarted(session="s1"))
    story.tell(rtc())
    assert story.asked(ev.FetchMatrix) == [ev.FetchMatrix(id="initial")]
    assert story.state.matrices.in_use is None


def test_telling_again_what_is_in_use_changes_nothing():
    state = with_in_use(with_record(STATE, foreign()), "initial")
    assert with_in_use(state, "initial") is state


@pytest.mark.parametrize(
    "unwanted", [MatrixState.REFUSED, MatrixState.DISCARDED, MatrixState.REJECTED]
)
def test_no_flood_of_what_nobody_wants_washes_away_the_way_back(unwanted):
    state = with_record(with_in_use(with_record(STATE, foreign()), "initial"), record("cm-good"))
    state = with_in_use(with_in_use(state, "cm-good"), "initial")
    for number in range(2 * RECONSTRUCTORS_KEPT):
        state = with_record(state, record(f"cm-{number}", unwanted))
    assert len(state.matrices.reconstructors) == RECONSTRUCTORS_KEPT
    assert state.reconstructor("cm-good").state is MatrixState.SUPERSEDED
    assert state.matrices.in_use == "initial"
    assert state.reconstructor("initial") is not None
    assert state.matrices.reconstructors[-1].id == f"cm-{2 * RECONSTRUCTORS_KEPT - 1}"


def test_after_many_updates_the_newest_to_go_back_to_and_the_newest_refused_are_kept():
    state = STATE
    for number in range(RECONSTRUCTORS_KEPT + 20):
        state = with_record(state, record(f"cm-{number}", MatrixState.SUPERSEDED))
        state = with_record(state, record(f"no-{number}", MatrixState.REFUSED))
    last = RECONSTRUCTORS_KEPT + 19
    assert len(state.matrices.reconstructors) == RECONSTRUCTORS_KEPT
    assert all(state.reconstructor(f"cm-{last - n}") is not None for n in range(RETURNS_KEPT))
    assert all(state.reconstructor(f"no-{last - n}") is not None for n in range(UNSENT_KEPT))


def test_a_restarted_service_still_knows_the_way_back_after_a_flood():
    flood = tuple(record(f"cm-{n}", MatrixState.DISCARDED) for n in range(RECONSTRUCTORS_KEPT))
    kept = restored((record("cm-good", MatrixState.SUPERSEDED), *flood))
    assert (len(kept), kept[0].id) == (RECONSTRUCTORS_KEPT, "cm-good")


def test_a_reconstructor_nobody_knows_is_named():
    with pytest.raises(UnknownIdError, match="unknown reconstructor cm-9"):
        turned(STATE, change_state, "cm-9", MatrixState.FAILED, "")
