"""Moments in which some orders may be given and others not, and each order as it is meant then."""

from dataclasses import replace

from service.records import commands as cmd
from service.records import events as ev
from service.records.alarms import AlarmRecord, Severity
from service.records.products import MatrixState
from service.records.registration import ModeGain
from service.records.state import Mode
from tests.support.activities import ACTIVITIES
from tests.support.shaped import LOADED, ShapedStory
from tests.support.situations import POLICY, Story, moved, rtc
from tests.support.states import changed

SUM = "a" * 64


def nobody_there():
    """No RTC has been heard yet."""
    return Story()


def met():
    """An RTC is there, and α is not known."""
    return Story(Mode.PROPOSE).meet()


def opened():
    """The loop of the RTC is open, and its basis too small for an acquisition."""
    return Story(Mode.PROPOSE).meet(loop="open", gains=(0.0,) * 594)


def small():
    """The RTC plays two modes at once: too few to find α from nothing."""
    return Story(Mode.PROPOSE).meet(max_dither_modes=2)


def without_dither():
    """The settings forbid any dither."""
    return Story(Mode.PROPOSE, replace(POLICY, dither_enabled=False)).meet()


def proposed(**changes):
    """A reconstructor waits for an approval."""
    story = Story(Mode.PROPOSE).meet()
    story.see(n_windows=3)
    story.make("cm-2", **changes)
    return story


def in_use():
    """Two have been in use, the second one is."""
    story = Story(Mode.HOLD).meet()
    story.see(n_windows=3)
    return story.use("cm-1")


def gains_measured():
    """Windows have told the optical gains."""
    story = in_use()
    gain = ModeGain(mode=509, gain=0.7, sigma=0.01, scatter=0.02, t_ns_utc=story.now_ns)
    known = replace(story.state.alpha.registration, optical_gains=(gain,))
    story.state = changed(story.state, registration=known)
    return story


def references_proposed():
    """A shape is loaded, and references for it wait for an approval."""
    return ShapedStory(Mode.PROPOSE).load().make_references()


def references_used():
    """References are in use."""
    return ShapedStory(Mode.PROPOSE).load().use_references()


def gains_without_matrix():
    """The same, and nobody knows which reconstructor is in use."""
    story = gains_measured()
    story.state = changed(story.state, in_use=None)
    return story


def refused_since():
    """The gate refuses now what is proposed."""
    story = proposed()
    (*others, last) = story.state.matrices.reconstructors
    gate = replace(last.gate, accepted=False, reason="too little margin")
    story.state = changed(story.state, reconstructors=(*others, replace(last, gate=gate)))
    return story


def left_behind():
    """α has moved since a reconstructor was proposed."""
    story = proposed()
    known = story.state.alpha.registration
    story.state = changed(
        story.state, registration=replace(known, alpha=moved(known.alpha, shift_x_subap=0.1))
    )
    return story


def suspected():
    """The last window saw a jump, and the next one decides."""
    story = proposed()
    story.see(moved(story.state.alpha.registration.alpha, shift_x_subap=0.4))
    return story


def diverging():
    """An alarm forbids to send anything."""
    story = proposed()
    story.tell(ev.ConditionChanged(name="loop-diverging", text="found"))
    story.tell(
        ev.ConditionChanged(name="command-unit", text="commands are a million times too large")
    )
    return story


def opened_with_a_proposal():
    """An open loop does not tell the gains that a proposal would run with."""
    story = proposed(judged=None)
    story.tell(rtc(loop="open", gains=(0.0,) * 594))
    return story


def unread():
    """Nobody has read back the matrix that the RTC uses."""
    story = proposed()
    story.shows = False
    story.tell(rtc(cm_id="of-somebody"))
    return story


def standing_by():
    """Another service drives the RTC."""
    story = proposed()
    story.tell(ev.ServicesMet(drives=False, others=("that of 12:00",)))
    return story


def seen():
    """Every alarm is acknowledged, and one is muted."""
    story = diverging()
    for alarm in story.state.alarms.active:
        story.tell(cmd.AcknowledgeAlarm(name=alarm.name, by="Ada"))
    story.tell(cmd.MuteAlarm(name="loop-diverging", for_s=60.0))
    return story


def gone():
    """An alarm went, and nobody had seen it."""
    story = in_use()
    record = AlarmRecord(name="margin", worst=Severity.SERIOUS, over_ns_utc=1)
    story.state = changed(story.state, records=(record,))
    return story


MOMENTS = [
    *ACTIVITIES,
    nobody_there,
    met,
    opened,
    small,
    without_dither,
    proposed,
    in_use,
    gains_measured,
    gains_without_matrix,
    references_proposed,
    references_used,
    refused_since,
    left_behind,
    suspected,
    diverging,
    opened_with_a_proposal,
    unread,
    standing_by,
    seen,
    gone,
]


def meant(state, order):
    """The command that an operator would give now; None: there is nothing that it could name."""
    proposals = [r.id for r in state.matrices.reconstructors if r.state is MatrixState.PROPOSED]
    used = [r.id for r in state.matrices.reconstructors if r.was_used]
    offered = [r.id for r in state.references.records if r.state is MatrixState.PROPOSED]
    work = state.measuring or state.noisy_measurement
    unseen = [
        n.name for n in state.alarms.records if n.worst is not None and n.acknowledged is None
    ]
    muted = [note.name for note in state.alarms.records if note.muted is not None]
    named = {
        "approve": (cmd.Approve, proposals),
        "reject": (cmd.Reject, proposals),
        "publish": (cmd.Publish, used),
        "give_up": (cmd.GiveUp, [work.id] if work else []),
        "approve_references": (cmd.ApproveReferences, offered),
        "reject_references": (cmd.RejectReferences, offered),
    }
    if order in named:
        kind, ids = named[order]
        return kind(id=ids[-1]) if ids else None
    alarms = {
        "acknowledge_alarm": (cmd.AcknowledgeAlarm, unseen),
        "unmute_alarm": (cmd.UnmuteAlarm, muted),
    }
    if order in alarms:
        kind, names = alarms[order]
        return kind(name=names[-1]) if names else None
    return PLAIN[order]


PLAIN = {
    "stop_everything": cmd.StopEverything(),
    "resume": cmd.Resume(),
    "mute_alarm": cmd.MuteAlarm(name="margin", for_s=60.0),
    "acquire": cmd.Acquire(),
    "abort_acquisition": cmd.AbortAcquisition(),
    "set_mode": cmd.SetMode(mode=Mode.HOLD),
    "refit": cmd.Refit(),
    "start_dither": cmd.StartDither(),
    "stop_dither": cmd.StopDither(),
    "rollback": cmd.Rollback(),
    "measure": cmd.Measure(id="im-9"),
    "measure_noisy": cmd.MeasureNoisy(id="noisy-9", modes=(0, 1)),
    "set_loop": cmd.SetLoop(leak=0.99),
    "open_loop": cmd.SetLoop(loop="open"),
    "compensate_gains": cmd.SetLoop(effective_gain=0.5),
    "set_pointing": cmd.SetPointing(elevation_deg=60.0, azimuth_deg=0.0),
    "ramp": cmd.Ramp(),
    "load_shape": LOADED,
    "clear_shape": cmd.ClearShape(),
    "roll_back_references": cmd.RollBackReferences(),
}
"""Those that name nothing; what the observatory tells needs a rule, see test_rules."""
