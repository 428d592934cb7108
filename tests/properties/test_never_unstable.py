"""Whatever happens, no reconstructor is sent whose verdict is not yes, of this loop and this α."""

from dataclasses import replace

import hypothesis.strategies as st
from hypothesis import given

from service.estimation.loop import select_gains
from service.records import commands as cmd
from service.records import events as ev
from service.records.products import ExpectedGain, MatrixState
from service.records.state import Mode
from service.tracking.update_policy import verdict_invalid_reason
from tests.support.laws import LAWS, Night, commands, heard, ids
from tests.support.situations import ALPHA, moved, record, rtc, verdict

MADE = [f"made-{k}" for k in range(1, 6)]
any_id = st.one_of(ids, st.sampled_from(MADE))
verdicts = st.builds(verdict, accepted=st.booleans(), radius=st.sampled_from([0.7, 0.94, 1.2]))
judged = st.builds(
    lambda name, said, shift, loss: ev.MarginJudged(
        id=name,
        verdict=said,
        alpha=moved(ALPHA, shift_x_subap=shift),
        expected=ExpectedGain(
            loss_m=loss, wavefront_m=1e-7, pole_radius=0.8, fresh_pole_radius=0.6
        ),
    ),
    any_id,
    verdicts,
    st.sampled_from([0.0, 0.05, 0.3]),
    st.sampled_from([0.0, 1e-9, float("inf")]),
)
made = st.builds(
    lambda name, state, n, asked, wanted: ev.MatrixMade(
        record=record(name, state, n_modes=n),
        wanted=wanted,
        asked_modes=asked,
        why_fewer="too little margin" if asked is not None and n < asked else "",
    ),
    st.sampled_from(["extra-1", "extra-2", "extra-3"]),
    st.sampled_from([MatrixState.PROPOSED, MatrixState.REFUSED]),
    st.sampled_from([100, 300, 400, 500]),
    st.sampled_from([None, 400, 500]),
    st.booleans(),
)
more_commands = st.one_of(
    st.builds(cmd.Approve, id=st.sampled_from([*MADE, "extra-1", "extra-2", "extra-3"])),
    st.builds(cmd.Publish, id=any_id),
    st.builds(cmd.SetLoop, effective_gain=st.sampled_from([0.3, 1.5])),
)
retuned = st.builds(
    lambda gain, leak: rtc(gains=(gain,) * 400 + (0.0,) * 194, leak=leak),
    st.sampled_from([0.4, 0.8]),
    st.sampled_from([0.999, 0.99]),
)
stories = st.lists(
    st.tuples(
        st.one_of(
            heard,
            commands,
            judged,
            judged,
            made,
            more_commands,
            retuned,
            *[st.just("done")] * 8,
            st.just("refused"),
        ),
        st.sampled_from([0.0, 0.1, 1.0, 4.0, 31.0]),
    ),
    min_size=30,
    max_size=60,
)


@LAWS
@given(stories, st.sampled_from(list(Mode)))
def test_nothing_is_sent_whose_verdict_is_not_yes_or_of_another_loop(story, mode):
    night = Night(mode)
    for event, after_s in story:
        if isinstance(event, ev.MatrixMade) and night.state.reconstructor(event.record.id):
            continue  # no two that the service makes have the same id
        night.tell(event, after_s)
        for effect in night.last:
            if isinstance(effect, ev.SendMatrix):
                found = night.state.reconstructor(effect.id)
                assert found.gate.accepted
                assert found.state is MatrixState.PUBLISHED
                assert effect.n_modes == found.n_modes
                assert night.state.alpha.registration is None or of_now(night.state, found, effect)


def of_now(state, found, effect):
    """Whether the verdict is of the loop and the α there are."""
    gains = effect.gains or select_gains(state.loop.rtc, found.n_modes)
    return verdict_invalid_reason(state, found.judged, gains[: found.n_modes]) is None


def test_a_proposal_whose_verdict_has_changed_since_cannot_be_approved():
    night = Night(Mode.PROPOSE)
    proposal = replace(record("extra-1"), created_ns_utc=night.now_ns)
    night.tell(ev.MatrixMade(record=proposal, wanted=False), 0.1)
    night.tell(ev.MarginJudged(id="extra-1", verdict=verdict(accepted=False)), 0.1)
    night.tell(cmd.Approve(id="extra-1"), 0.1)
    assert not night.last
    assert night.state.reconstructor("extra-1").state is MatrixState.PROPOSED
