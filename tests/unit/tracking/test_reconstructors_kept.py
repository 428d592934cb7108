import pytest

from service.errors import UnknownIdError
from service.tracking import events as ev
from service.tracking.products import MatrixState
from service.tracking.reconstructors import (
    RECONSTRUCTORS_KEPT,
    RETURNS_KEPT,
    UNSENT_KEPT,
    change_state,
    mark_applied,
    store_reconstructor,
)
from service.tracking.resume import restored
from service.tracking.state import TrackerState
from tests.states import changed
from tests.unit.tracking.situations import Story, foreign, record, rtc, turned

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


def test_a_restarted_service_takes_over_the_newest_only():
    kept = restored(tuple(record(f"cm-{n}") for n in range(RECONSTRUCTORS_KEPT + 1)))
    assert [kept[0].id, kept[-1].id] == ["cm-1", f"cm-{RECONSTRUCTORS_KEPT}"]


def test_one_reconstructor_in_use_supersedes_another():
    state = with_record(with_record(STATE, foreign()), record("cm-1"))
    state = with_in_use(with_in_use(state, "initial"), "cm-1")
    assert state.matrices.in_use == "cm-1"
    assert [r.state for r in state.matrices.reconstructors] == [
        MatrixState.SUPERSEDED,
        MatrixState.APPLIED,
    ]


def test_telling_again_what_is_in_use_changes_nothing():
    state = with_in_use(with_record(STATE, foreign()), "initial")
    assert with_in_use(state, "initial") is state


def test_the_reconstructor_in_use_stays_on_a_full_shelf():
    state = with_in_use(with_record(STATE, foreign()), "initial")
    for number in range(RECONSTRUCTORS_KEPT + 5):
        state = with_record(state, record(f"cm-{number}", MatrixState.REFUSED))
    assert len(state.matrices.reconstructors) == RECONSTRUCTORS_KEPT
    assert state.reconstructor("initial") is not None
    assert state.matrices.reconstructors[-1].id == f"cm-{RECONSTRUCTORS_KEPT + 4}"


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
