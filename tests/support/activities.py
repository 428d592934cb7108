"""What tests of several modules share of unit.tracking.operations.test_running."""

from __future__ import annotations

from copy import copy
from functools import cache

from service.errors import CommandError, UnknownIdError
from service.records import commands as cmd
from service.records.operations import MeasureState
from service.records.products import MatrixState, ModeSet
from service.records.state import Mode
from service.tracking.operations.running import running_operations
from service.wire import DitherKind, DitherRequest, DitherStatus, Pattern
from tests.support.world import World

LONGEST_S = 400
"""For everything to be over: an acquisition with all its patience takes less."""


def idle():
    return copy(quiet())


@cache
def quiet():
    """A night on which α is known, no dither plays, and two matrices have been in use."""
    world = World(Mode.HOLD)
    world.pass_(10.0)
    assert world.state.alpha.registration is not None
    world.tell(cmd.Refit())
    world.pass_(2.0)
    world.tell(cmd.Approve(id="cm-1"))
    world.pass_(2.0)
    world.tell(cmd.StopDither())
    world.tell(cmd.SetMode(mode=Mode.PROPOSE))
    world.pass_(5.0)
    assert world.state.matrices.in_use == "cm-1"
    assert not running_operations(world.state, world.now_ns)
    return world


def measuring():
    world = idle()
    world.tell(cmd.Measure(id="im-1", pattern=Pattern.PUSH_PULL_MODAL))
    return world.pass_(1.0)


def measuring_sines():
    world = idle()
    world.tell(cmd.Measure(id="im-1", pattern=Pattern.SINE))
    return world.pass_(1.0)


def waiting_for_a_noisy_one():
    world = own_dither()
    world.tell(cmd.MeasureNoisy(id="noisy-1", duration_s=30.0))
    assert world.state.noisy_measurement.state is MeasureState.WAITING
    return world


def gathering():
    world = idle()
    world.tell(cmd.MeasureNoisy(id="noisy-1", modes=ModeSet.CONTROLLED, duration_s=30.0))
    world.pass_(3.0)
    assert world.state.noisy_measurement.state is MeasureState.RUNNING
    return world


def ramping():
    world = idle()
    world.tell(cmd.Ramp())
    return world.pass_(1.0)


def acquiring():
    world = idle()
    world.tell(cmd.Acquire())
    return world.pass_(2.0)


def own_dither():
    world = idle()
    world.tell(cmd.StartDither())
    return world.pass_(2.0)


def operators_dither():
    world = idle()
    world.tell(cmd.StartDither(modes=(501,), amplitude_m=2e-9, frequency_hz=(250.0,)))
    return world.pass_(2.0)


def others_dither():
    world = idle()
    request = DitherRequest(
        id="of-another-program",
        kind=DitherKind.SINE,
        modes=(501,),
        amplitude_m=(2e-9,),
        frequency_hz=(250.1234,),
        duration_s=60.0,
    )
    world.playing = DitherStatus(request=request, start_seq=world.seq)
    return world.pass_(2.0)


def making():
    world = idle()
    world.tell(cmd.Refit())
    return world


def sending():
    world = idle()
    world.tell(cmd.Refit())
    world.pass_(0.5)
    proposed = [
        r.id for r in world.state.matrices.reconstructors if r.state is MatrixState.PROPOSED
    ]
    world.tell(cmd.Approve(id=proposed[-1]))
    return world


def stopped():
    world = own_dither()
    world.tell(cmd.StopEverything(by="Ada", reason="someone is on the platform"))
    return world


ACTIVITIES = [
    idle,
    stopped,
    measuring,
    measuring_sines,
    waiting_for_a_noisy_one,
    gathering,
    ramping,
    acquiring,
    own_dither,
    operators_dither,
    others_dither,
    making,
    sending,
]


COMMANDS = [
    cmd.StopEverything(),
    cmd.Resume(),
    cmd.Acquire(),
    cmd.AbortAcquisition(),
    cmd.SetMode(mode=Mode.AUTO),
    cmd.SetMode(mode=Mode.HOLD),
    cmd.Refit(),
    cmd.StartDither(),
    cmd.StartDither(modes=(502,), amplitude_m=2e-9, frequency_hz=(260.0,)),
    cmd.StopDither(),
    cmd.Approve(id="cm-1"),
    cmd.Reject(id="cm-1"),
    cmd.Publish(id="initial"),
    cmd.Rollback(),
    cmd.Measure(id="im-9", pattern=Pattern.PUSH_PULL_MODAL),
    cmd.Measure(id="im-9", pattern=Pattern.SINE),
    cmd.GiveUp(id="im-1"),
    cmd.MeasureNoisy(id="noisy-9", duration_s=30.0),
    cmd.GiveUp(id="noisy-1"),
    cmd.SetLoop(loop="open"),
    cmd.SetLoop(gains=(cmd.GainGroup(first=0, last=399, gain=0.3),)),
    cmd.SetPointing(elevation_deg=60.0, azimuth_deg=0.0),
    cmd.Ramp(),
]


def strands(world):
    """What has neither ended nor goes on."""
    state = world.state
    left = [f"{r.id} {r.state}" for r in state.operations.measurements if r.under_way]
    left += [f"{r.id} {r.state}" for r in state.matrices.reconstructors if r.state in SENT]
    if state.operations.acquisition.under_way:
        left.append(state.operations.acquisition.text)
    if state.matrices.making_since_ns_utc is not None:
        left.append("a matrix that is made")
    left += [a.text for a in state.alarms.active if a.name == "dither-not-stopped"]
    return left


SENT = (MatrixState.PUBLISHED, MatrixState.STAGED)


def refused(world, command):
    """Why the tracker does not carry out a command, and stands as it was; empty: it does."""
    before = world.state
    try:
        world.tell(command)
    except (CommandError, UnknownIdError) as refusal:
        text = str(refusal)
    else:
        return ""
    assert world.state is before
    assert text
    return text
