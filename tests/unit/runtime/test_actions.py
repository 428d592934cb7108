"""What the tracker decides, done: a real worker and archive, an RTC written by hand."""

from dataclasses import replace

import numpy as np
import pytest

from service.errors import ArchiveError, CommandError, LinkError, StorageError, UnknownIdError
from service.model.misregistration import Misregistration
from service.records import events as ev
from service.records.products import MatrixState, ReconstructorRecord
from service.tracker import step
from service.wire import (
    DitherKind,
    DitherRequest,
    DitherStop,
    Loop,
    LoopRequest,
    checksum,
    layout_of,
)
from tests.support.handmade import ALPHA, BROUGHT, N_MODES, N_SLOPES, REGISTRATION, RTC, STATE
from tests.support.situations import POLICY, foreign, record, rtc
from tests.support.small import N_CONTROLLED, SIGMA
from tests.support.states import changed

pytestmark = pytest.mark.timeout(60)


def stepped(state, event):
    """Return the state after an event, its matrices as they were."""
    after, _ = step(state, event, POLICY, 0)
    return replace(after, matrices=state.matrices)


LOST = ev.SendMatrix(id="initial", n_modes=60, gains=None)


async def made(actions, n_modes=N_CONTROLLED, state=STATE):
    """Make a reconstructor; return its record and the state that knows it."""
    event = await actions.perform(ev.MakeMatrix(n_modes=n_modes, why="a test"), state)
    shelf = (*state.matrices.reconstructors, event.record)
    return event.record, changed(state, reconstructors=shelf)


async def test_a_made_reconstructor_is_archived_before_anybody_hears_of_it(
    actions, archive, bridge
):
    found, _ = await made(actions)
    matrix = archive.reconstructors.matrix(found.id)
    assert matrix.shape == (N_CONTROLLED, N_SLOPES)
    assert (found.state, found.sha256) == (MatrixState.PROPOSED, checksum(matrix))
    assert (found.alpha, found.parent, found.reason) == (ALPHA, "initial", "a test")
    np.testing.assert_allclose(found.sigma, SIGMA * np.sqrt(2))
    assert found.gate.accepted
    assert [kept.id for kept in archive.reconstructors.records()] == [found.id]
    assert not bridge.published


async def test_every_reconstructor_has_an_id_of_its_own(actions):
    first, _ = await made(actions)
    second, _ = await made(actions)
    assert first.id != second.id


async def test_a_loop_that_no_matrix_can_hold_makes_a_refused_record(actions):
    wild = replace(RTC, gains=(1.9,) * N_CONTROLLED + (0.0,) * (N_MODES - N_CONTROLLED))
    found, _ = await made(actions, state=changed(STATE, rtc=wild))
    assert found.state is MatrixState.REFUSED
    assert "unstable" in found.gate.reason


async def test_more_modes_are_judged_with_the_gains_they_would_get(actions):
    found, _ = await made(actions, 60)
    assert found.n_modes == 60
    assert found.gate.accepted


@pytest.mark.parametrize(
    ("changes", "error", "match"),
    [
        ({"rtc": None}, LinkError, "no RTC is there"),
        ({"registration": None}, CommandError, "α is not known"),
    ],
)
async def test_what_it_takes_to_make_one_must_be_there(actions, changes, error, match):
    with pytest.raises(error, match=match):
        await made(actions, state=changed(STATE, **changes))


async def test_sending_the_same_number_of_modes_needs_no_command(actions, bridge):
    found, state = await made(actions)
    effect = ev.SendMatrix(id=found.id, n_modes=N_CONTROLLED, gains=None)
    assert await actions.perform(effect, state) is None
    ((manifest, matrix),) = bridge.published
    assert (manifest.id, manifest.layout.shape) == (found.id, (N_CONTROLLED, N_SLOPES))
    assert manifest.layout.sha256 == checksum(matrix) == found.sha256
    assert not bridge.commands


async def test_sending_more_modes_tells_the_rtc_first(actions, bridge):
    found, state = await made(actions, 60)
    gains = (0.4,) * 60 + (0.0,) * 30
    await actions.perform(ev.SendMatrix(id=found.id, n_modes=60, gains=gains), state)
    (command,) = bridge.commands
    assert isinstance(command, LoopRequest)
    assert (command.n_controlled, command.gains, command.loop) == (60, gains, None)
    assert len(bridge.published) == 1


async def test_an_rtc_that_will_not_control_so_many_modes_gets_no_matrix(actions, bridge):
    found, state = await made(actions, 60)
    bridge.refusal = "range: at most 50"
    with pytest.raises(CommandError, match="will not control 60 modes: range: at most 50"):
        await actions.perform(ev.SendMatrix(id=found.id, n_modes=60, gains=(0.4,) * 90), state)
    assert not bridge.published


async def test_after_more_modes_were_commanded_in_vain_fewer_are_commanded_again(actions, bridge):
    many, state = await made(actions, 60)
    few, state = await made(actions, N_CONTROLLED, state)
    told = await actions.perform(ev.SendMatrix(id=many.id, n_modes=60, gains=(0.4,) * 90), state)
    state = stepped(state, told)
    await actions.perform(ev.SendMatrix(id=few.id, n_modes=N_CONTROLLED, gains=None), state)
    assert [command.n_controlled for command in bridge.commands] == [60, N_CONTROLLED]


@pytest.mark.parametrize(
    "news",
    [
        (replace(RTC, n_controlled=60), RTC),
        (ev.SessionStarted(session="another"), RTC),
        (ev.JobFailed(effect=LOST, text="cut off"), RTC),
    ],
)
async def test_a_number_of_modes_that_no_longer_holds_is_commanded_again(actions, bridge, news):
    """An RTC that was restarted, or set by somebody else, would reject the matrix (R-53)."""
    many, state = await made(actions, 60)
    told = await actions.perform(ev.SendMatrix(id=many.id, n_modes=60, gains=None), state)
    for event in filter(None, (told, *news)):
        state = stepped(state, event)
    await actions.perform(ev.SendMatrix(id=many.id, n_modes=60, gains=None), state)
    assert [command.n_controlled for command in bridge.commands] == [60, 60]


async def test_nothing_unknown_is_sent(actions):
    with pytest.raises(UnknownIdError, match="cm-9"):
        await actions.perform(ev.SendMatrix(id="cm-9", n_modes=45, gains=None), STATE)


async def test_a_copy_has_the_same_numbers_a_new_id_and_a_new_verdict(actions, archive):
    source, state = await made(actions)
    effect = ev.RepublishMatrix(source=source.id, why="back")
    event = await actions.perform(effect, state)
    copy = event.record
    assert event.wanted
    assert copy.id != source.id
    assert (copy.parent, copy.sha256, copy.alpha) == (source.id, source.sha256, ALPHA)
    assert copy.gate is not source.gate
    assert copy.reason == "back"
    np.testing.assert_array_equal(
        archive.reconstructors.matrix(copy.id), archive.reconstructors.matrix(source.id)
    )


async def test_a_copy_of_an_earlier_matrix_needs_no_disk(actions, archive, monkeypatch):
    source, state = await made(actions)

    def refuse(*_):
        raise StorageError("full")

    monkeypatch.setattr(archive.reconstructors, "store", refuse)
    copy = (await actions.perform(ev.RepublishMatrix(source=source.id, why="back"), state)).record
    np.testing.assert_array_equal(actions.matrix(copy.id), actions.matrix(source.id))
    with pytest.raises(StorageError):
        await made(actions)


@pytest.mark.parametrize(
    ("changes", "unknown"),
    [
        ({"registration": None}, "α is unknown"),
        ({"rtc": replace(RTC, loop="open", gains=(0.0,) * RTC.n_modes)}, "an open loop"),
    ],
)
async def test_a_copy_that_cannot_be_judged_says_so(actions, changes, unknown):
    source, state = await made(actions)
    copied = ev.RepublishMatrix(source=source.id, why="back")
    copy = (await actions.perform(copied, changed(state, **changes))).record
    assert (copy.gate, copy.state) == (None, MatrixState.PROPOSED)
    assert copy.reason.startswith(f"back; the gate could not judge it: {unknown}")


async def test_a_copy_that_would_not_hold_the_loop_any_more_is_refused(actions):
    source, state = await made(actions)
    far = replace(REGISTRATION, alpha=Misregistration(rotation_rad=0.5))
    event = await actions.perform(
        ev.RepublishMatrix(source=source.id, why="back"), changed(state, registration=far)
    )
    assert event.record.state is MatrixState.REFUSED
    event = await actions.perform(
        ev.RepublishMatrix(source=source.id, why="back", anyway=True),
        changed(state, registration=far),
    )
    assert (event.record.state, event.record.gate, event.anyway) == (
        MatrixState.PROPOSED,
        None,
        True,
    )
    assert event.record.reason.startswith("back, though ")


async def test_the_margin_is_judged_at_the_registration_of_now(actions):
    found, state = await made(actions)
    event = await actions.perform(ev.JudgeMatrix(id=found.id), state)
    assert (event.id, event.verdict.accepted) == (found.id, True)
    far = replace(REGISTRATION, alpha=Misregistration(rotation_rad=0.5))
    event = await actions.perform(ev.JudgeMatrix(id=found.id), changed(state, registration=far))
    assert not event.verdict.accepted


@pytest.mark.parametrize("wanted", [True, False])
async def test_the_verdict_on_a_proposal_says_whether_an_operator_wants_it_sent(actions, wanted):
    found, state = await made(actions)
    gains = RTC.gains[:N_CONTROLLED]
    event = await actions.perform(ev.JudgeProposal(id=found.id, gains=gains, wanted=wanted), state)
    assert (event.id, event.verdict.accepted, event.wanted) == (found.id, True, wanted)


async def test_the_rtcs_own_matrix_is_fetched_and_archived_once(actions, archive):
    for _ in range(2):
        event = await actions.perform(ev.FetchMatrix(id="initial"), STATE)
        assert (event.record.id, event.record.parent) == ("initial", None)
    np.testing.assert_array_equal(archive.reconstructors.matrix("initial"), BROUGHT)
    np.testing.assert_array_equal(actions.matrix("initial"), BROUGHT)


async def test_another_matrix_under_a_known_id_is_not_taken_for_the_same(actions, bridge):
    await actions.perform(ev.FetchMatrix(id="initial"), STATE)
    other = BROUGHT * 2
    bridge.applied = (foreign().manifest(layout_of(other, 4096), RTC, "small"), other)
    with pytest.raises(LinkError, match="not the one archived under that id"):
        await actions.perform(ev.FetchMatrix(id="initial"), STATE)


async def test_other_numbers_under_an_id_the_tracker_knows_are_for_it_to_distrust(actions, bridge):
    event = await actions.perform(ev.FetchMatrix(id="initial"), STATE)
    state = changed(STATE, reconstructors=(event.record,))
    other = BROUGHT * 2
    bridge.applied = (foreign().manifest(layout_of(other, 4096), RTC, "small"), other)
    found = await actions.perform(ev.FetchMatrix(id="initial"), state)
    assert found.record.sha256 != event.record.sha256
    np.testing.assert_array_equal(actions.matrix("initial"), BROUGHT)


async def test_a_matrix_swapped_while_it_was_asked_for_is_named(actions):
    with pytest.raises(LinkError, match="offers initial, its status says it uses cm-1"):
        await actions.perform(ev.FetchMatrix(id="cm-1"), STATE)


async def test_old_matrices_come_from_the_archive(actions, archive):
    archive.reconstructors.store(
        record("cm-old", n_modes=N_CONTROLLED, sha256=""), BROUGHT, None, {}
    )
    np.testing.assert_array_equal(actions.matrix("cm-old"), BROUGHT)
    with pytest.raises(UnknownIdError):
        actions.matrix("cm-never")


async def test_those_asked_for_last_stay_in_memory_whoever_came_last(actions, archive):
    """The matrix in use is judged all night; the disk has the others."""
    for k in range(5):
        row = record(f"cm-{k}", n_modes=N_CONTROLLED, sha256="")
        archive.reconstructors.store(row, BROUGHT, None, {})
    in_use = actions.matrix("cm-0")
    for k in range(1, 5):
        actions.matrix(f"cm-{k}")
        assert actions.matrix("cm-0") is in_use
    first = actions.matrix("cm-1")
    assert first is not actions.matrix("cm-2")
    for path in archive.reconstructors.directory.glob("*.h5"):
        path.unlink()
    assert actions.matrix("cm-0") is in_use
    with pytest.raises(ArchiveError):
        actions.matrix("cm-3")


async def test_the_matrix_in_use_is_offered_to_an_rtc_that_comes_late(actions, bridge):
    await actions.perform(ev.FetchMatrix(id="initial"), STATE)
    actions.offer(STATE)
    ((manifest, matrix),) = bridge.offered
    assert (manifest.id, bridge.current) == ("initial", "initial")
    np.testing.assert_array_equal(matrix, BROUGHT)


async def test_nothing_is_offered_while_none_is_in_use(actions, bridge):
    actions.offer(changed(STATE, in_use=None))
    assert not bridge.offered


async def test_the_loop_is_changed_as_asked_and_the_answer_is_the_event(actions, bridge):
    asked = LoopRequest(id="loop-1", loop=Loop.OPEN, gains=(0.1,) * N_MODES, leak=0.9)
    event = await actions.perform(ev.Ask(request=asked), STATE)
    assert (event.request, event.reply.accepted) == (asked, True)
    assert bridge.commands == [asked]
    bridge.refusal = "busy: im-1"
    event = await actions.perform(ev.Ask(request=LoopRequest(id="loop-2", loop=Loop.CLOSED)), STATE)
    assert (event.reply.accepted, event.reply.reason) == (False, "busy: im-1")


class TestDither:
    DITHER = DitherRequest(
        id="dither-1",
        kind=DitherKind.SINE,
        modes=(63, 69),
        amplitude_m=(5e-9, 5e-9),
        frequency_hz=(211.0, 239.0),
        duration_s=120.0,
    )

    async def test_the_answer_of_the_rtc_is_the_event(self, actions, bridge):
        event = await actions.perform(ev.Ask(request=self.DITHER), STATE)
        assert event.request == self.DITHER
        assert (event.reply.accepted, event.reply.start_seq) == (True, 77)
        assert bridge.commands == [self.DITHER]

    async def test_stopping_needs_only_an_id(self, actions, bridge):
        stop = DitherStop(id="stop-1")
        assert await actions.perform(ev.Ask(request=stop), STATE) is None
        assert bridge.commands == [stop]


def test_a_manifest_carries_the_registration_in_boundary_units():
    matrix = np.zeros((400, 6), np.float32)
    manifest = record("cm-1").manifest(layout_of(matrix, 4096), rtc(), "flao")
    assert manifest.alpha["rotation_deg"] == pytest.approx(0.2)
    assert manifest.sigma["rotation_deg"] == pytest.approx(np.rad2deg(9e-5))
    assert (manifest.basis_id, manifest.system, manifest.parent) == ("kl-594", "flao", "initial")


def test_a_matrix_of_the_rtc_is_for_no_registration_we_can_vouch_for():
    matrix = np.zeros((3, 6), np.float32)
    sent = record("cm-1").manifest(layout_of(matrix, 4096), rtc(), "flao")
    brought = ReconstructorRecord.brought(sent)
    assert (brought.alpha, brought.parent, brought.n_modes) == (None, None, 3)
    assert brought.state is MatrixState.APPLIED
    manifest = foreign().manifest(layout_of(matrix, 4096), rtc(), "flao")
    assert (manifest.alpha, manifest.sigma) == (None, None)
