"""Whether an order may be given now is decided once: what ``permitted`` says is what is done."""

import inspect
from functools import cache

import pytest

from service.errors import CommandError, UnknownIdError
from service.records import commands as cmd
from service.records import events as ev
from service.records.products import MatrixState, ModeSet
from service.tracker import step
from service.tracking.interlocks import ORDERS, Permission, permissions, permitted
from service.wire import DitherKind, Pattern
from tests.support.activities import (
    COMMANDS,
    acquiring,
    gathering,
    idle,
    making,
    measuring,
    operators_dither,
    others_dither,
    ramping,
    sending,
)
from tests.support.moments import (
    MOMENTS,
    in_use,
    meant,
    met,
    nobody_there,
    opened,
    proposed,
    refused_since,
    small,
    without_dither,
)

NAMED = [name for name in ORDERS if name != "set_value"]


@cache
def at(moment):
    """State, time and settings in a moment."""
    story = moment()
    return story.state, story.now_ns, story.policy


def refusal_of(moment, command):
    """Why the tracker refuses a command; empty: it does not."""
    state, now_ns, policy = at(moment)
    try:
        step(state, command, policy, now_ns)
    except UnknownIdError:
        raise
    except CommandError as error:
        return str(error)
    return ""


def permission_for(moment, order):
    state, now_ns, policy = at(moment)
    return permitted(state, order, policy, now_ns)


@pytest.mark.parametrize("moment", MOMENTS, ids=lambda moment: moment.__name__)
def test_what_is_published_of_an_order_is_what_becomes_of_it(moment):
    state, now_ns, policy = at(moment)
    published = permissions(state, policy, now_ns)
    for name in NAMED:
        shown = published[name]
        assert shown == permission_for(moment, ORDERS[name]), name
        assert shown.allowed is not bool(shown.reason), name
        assert "\n" not in shown.reason, name
        command = meant(state, name)
        if command is None:
            assert not shown.allowed, name
        else:
            assert refusal_of(moment, command) == shown.reason, name


@pytest.mark.parametrize("moment", MOMENTS, ids=lambda moment: moment.__name__)
def test_one_that_names_something_is_decided_on_what_it_names(moment):
    for command in COMMANDS:
        try:
            permission = permission_for(moment, command)
        except UnknownIdError:
            with pytest.raises(UnknownIdError):
                refusal_of(moment, command)
            continue
        refusal = refusal_of(moment, command)
        if not permission.allowed:
            assert refusal == permission.reason, command
        # what is published of a kind holds for each of that kind
        kind = ORDERS["open_loop"] if getattr(command, "loop", None) == "open" else type(command)
        assert permission_for(moment, kind).allowed or not permission.allowed, command


def test_every_command_is_an_order_by_its_name():
    kinds = {kind for kind in vars(cmd).values() if inspect.isclass(kind)}
    assert {kind for kind in ORDERS.values() if isinstance(kind, type)} <= kinds
    assert set(ORDERS) >= {"approve", "stop_everything", "abort_acquisition", "measure_noisy"}


def test_each_moment_refuses_something_and_each_order_is_refused_and_allowed_somewhere():
    told = {name: {permission_for(m, ORDERS[name]).allowed for m in MOMENTS} for name in NAMED}
    always = {name for name, found in told.items() if found == {True}}
    assert always == {"stop_everything", "mute_alarm", "set_mode", "set_pointing"}
    assert not [name for name, found in told.items() if found == {False}]


@pytest.mark.parametrize(
    ("moment", "order", "words"),
    [
        (in_use, "approve", "no reconstructor is proposed: refit first"),
        (proposed, "give_up", "nothing is being measured"),
        (proposed, "resume", "nothing is stopped"),
        (
            proposed,
            "compensate_gains",
            "no optical gain is measured yet; start a dither and wait for a window",
        ),
        (proposed, "unmute_alarm", "no alarm is muted"),
        (proposed, "acknowledge_alarm", "every alarm is acknowledged"),
        (refused_since, "approve", "cm-2 cannot be sent: too little margin"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_a_refusal_says_what_is_missing(moment, order, words):
    assert permission_for(moment, ORDERS[order]) == Permission(allowed=False, reason=words)


def vanished():
    """The RTC has vanished; a reconstructor is proposed and another has been in use."""
    story = in_use()
    story.make("cm-2")
    story.tell(ev.RtcVanished())
    return story


def refused_by_the_gate():
    """The gate has refused the last reconstructor."""
    story = in_use()
    story.make("cm-2", MatrixState.REFUSED)
    return story


def measured():
    """A measurement is over."""
    return measuring().pass_(10.0)


def gathered():
    """A noisy matrix is stored, and nothing runs."""
    return gathering().pass_(40.0)


def gains(first, last, **changes):
    return cmd.SetLoop(gains=(cmd.GainGroup(first=first, last=last, gain=0.3),), **changes)


def dither(*frequency_hz, first=3):
    modes = tuple(range(first, first + len(frequency_hz)))
    return cmd.StartDither(modes=modes, frequency_hz=frequency_hz)


MEASURE, NOISY = cmd.Measure(id="im-9"), cmd.MeasureNoisy(id="noisy-9")
REFUSED = {
    nobody_there: {
        "no RTC is there": [cmd.Acquire(), MEASURE, cmd.Refit(), cmd.SetLoop(leak=0.9), cmd.Ramp()],
        "no RTC is there: start it first": [cmd.StartDither()],
    },
    vanished: {
        "no RTC is there": [cmd.Acquire(), cmd.Rollback(), cmd.Publish(id="cm-1")],
        "cannot be sent: no RTC is there": [cmd.Approve(id="cm-2")],
    },
    met: {
        "α is not known yet; start a dither": [cmd.Refit()],
        r"dither-\d+ is running; stop it first": [cmd.StartDither(), MEASURE],
        "no earlier reconstructor has been in use": [cmd.Rollback()],
    },
    opened: {
        "the loop is open: close it": [cmd.StartDither(), cmd.Ramp(), NOISY],
        "found gains for 2 modes; expected all 400": [gains(0, 1)],
    },
    small: {"at least 3": [cmd.Acquire()]},
    without_dither: {"forbid": [cmd.Acquire()]},
    in_use: {
        "found 595 modes; expected 1 to 594": [
            cmd.Refit(n_modes=595),
            cmd.SetLoop(n_controlled=595),
        ],
        "found modes 390 to 400; expected .* 0 to 399": [gains(390, 400)],
        "found modes 100 to 400; expected .* 0 to 399": [
            cmd.Ramp(groups=(cmd.ModeGroup(first=100, last=400),))
        ],
        "unknown reconstructor cm-9": [kind(id="cm-9") for kind in (cmd.Approve, cmd.Publish)],
        "unknown measurement im-1": [cmd.GiveUp(id="im-1")],
    },
    proposed: {
        "initial is applied, not proposed": [cmd.Approve(id="initial"), cmd.Reject(id="initial")],
        "unknown reconstructor cm-9": [cmd.Reject(id="cm-9")],
    },
    refused_by_the_gate: {
        "cm-2 is refused, not proposed": [cmd.Approve(id="cm-2"), cmd.Reject(id="cm-2")]
    },
    idle: {
        "found mode 594; expected 0 to 593": [cmd.Measure(id="im-1", modes=(0, 594))],
        "found mode 600": [cmd.MeasureNoisy(id="noisy-9", modes=(600,))],
        "594": [dither(250.0, first=594)],
        "room for the side bins": [dither(5.0), dither(495.0)],
        "closer than 4 bins": [dither(200.0, 200.5)],
        "11 nm RMS in all, budget 8 nm": [
            cmd.MeasureNoisy(id="noisy-9", total_amplitude_m=11e-9, duration_s=60.0)
        ],
        "found 100 nm on each of 1 modes": [
            cmd.MeasureNoisy(
                id="noisy-9", modes=(3,), total_amplitude_m=1e-7, over_budget=True, duration_s=60.0
            )
        ],
        "400 modes need windows of 3.2 s": [
            cmd.MeasureNoisy(id="noisy-9", modes=ModeSet.CONTROLLED, duration_s=2.0)
        ],
        "no acquisition is under way": [cmd.AbortAcquisition()],
    },
    making: {"being computed; wait": [cmd.Refit(), cmd.Publish(id="cm-1"), MEASURE]},
    sending: {"is on its way": [MEASURE]},
    acquiring: {
        "acquisition": [cmd.Refit(), cmd.SetLoop(loop="closed"), cmd.StartDither(), NOISY],
        "under way": [cmd.Acquire()],
    },
    measuring: {
        "im-1 is being measured; wait for it": [
            cmd.Acquire(),
            cmd.SetLoop(loop="open"),
            cmd.SetLoop(loop="closed"),
            cmd.Ramp(),
            cmd.Refit(),
            cmd.StartDither(),
            cmd.Approve(id="x"),
            cmd.Publish(id="x"),
            cmd.Rollback(),
            MEASURE,
        ]
    },
    measured: {
        "ids are never reused": [cmd.Measure(id="im-1")],
        "im-1 is stored: there is nothing to give up": [cmd.GiveUp(id="im-1")],
    },
    gathering: {
        "noisy-1": [
            cmd.Acquire(),
            cmd.SetLoop(loop="open"),
            cmd.Ramp(),
            cmd.StartDither(),
            MEASURE,
            NOISY,
        ]
    },
    gathered: {
        "never reused": [cmd.MeasureNoisy(id="noisy-1")],
        "noisy-1 is stored": [cmd.GiveUp(id="noisy-1")],
        "unknown reconstructor noisy-1": [
            kind(id="noisy-1") for kind in (cmd.Approve, cmd.Publish, cmd.Reject)
        ],
    },
    ramping: {
        "open the loop to end it": [
            cmd.Acquire(),
            gains(0, 399),
            cmd.Ramp(),
            cmd.StartDither(),
            MEASURE,
            NOISY,
        ]
    },
    operators_dither: {"is running; stop it first": [NOISY, cmd.StartDither()]},
    others_dither: {"of-another-program is running; stop it first": [NOISY, cmd.StartDither()]},
}
"""What is refused in each moment, with the reason that names what is in the way."""


@pytest.mark.parametrize(
    ("moment", "words", "command"),
    [
        (moment, words, command)
        for moment, reasons in REFUSED.items()
        for words, commands in reasons.items()
        for command in commands
    ],
    ids=lambda value: getattr(value, "__name__", type(value).__name__),
)
def test_a_command_that_cannot_be_carried_out_is_refused_by_what_is_in_the_way(
    moment, words, command
):
    state, now_ns, policy = at(moment)
    with pytest.raises((CommandError, UnknownIdError), match=words):
        step(state, command, policy, now_ns)


def test_a_gain_ramp_lets_the_loop_be_opened_and_nothing_else_changed():
    assert permission_for(ramping, ORDERS["open_loop"]).allowed


# --- commands that no state of the service could make sense of are not made


BINARY, SINE = DitherKind.BINARY, Pattern.SINE
SENSELESS = [
    (cmd.StartDither, {"modes": (3, 3)}, "modes without any of them twice"),
    (cmd.StartDither, {"modes": ModeSet.ALL}, "at most 64 modes with sine"),
    (cmd.StartDither, {"modes": tuple(range(65))}, "at most 64 modes with sine"),
    (cmd.StartDither, {"modes": (3, 4), "frequency_hz": (200.0,)}, "1 given for 2"),
    (cmd.StartDither, {"frequency_hz": (200.0,)}, "1 given for 0"),
    (cmd.StartDither, {"total_amplitude_m": 1e-9}, "amplitude_m of each mode"),
    (cmd.StartDither, {"kind": BINARY, "amplitude_m": 1e-9}, "no amplitude_m and no frequency_hz"),
    (cmd.MeasureNoisy, {"id": "n", "modes": (1, 1)}, "modes without any of them twice"),
    (cmd.Measure, {"id": "m", "modes": (1, 1)}, "modes without any of them twice"),
    (cmd.Measure, {"id": "m", "pattern": SINE, "n_average": 3}, "no n_average with a sine"),
    (cmd.Measure, {"id": "m", "duration_s": 3.0}, "no frequency_hz and no duration_s with push"),
    (cmd.SetLoop, {}, "at least one of loop, gains"),
    (cmd.SetLoop, {"gains": (cmd.GainGroup(first=0, last=1, gain=0.1),) * 2}, "mode 0 is"),
    (cmd.ModeGroup, {"first": 3, "last": 2}, "first <= last"),
    (
        cmd.Ramp,
        {"groups": (cmd.ModeGroup(first=5, last=20), cmd.ModeGroup(first=0, last=10))},
        "no mode in two groups: mode 5 is",
    ),
    (cmd.Refit, {"reason": "so\x1b[2J"}, r"found '\\x1b' in reason, expected printable"),
    (cmd.SetMode, {"mode": "auto", "by": "a\nb"}, r"found '\\n' in by"),
]


@pytest.mark.parametrize(("kind", "said", "why"), SENSELESS)
def test_what_makes_no_sense_in_any_state_is_no_command(kind, said, why):
    with pytest.raises(ValueError, match=why):
        kind(**said)


def test_a_command_has_its_fields_by_name():
    command = cmd.SetPointing(elevation_deg=61.5, azimuth_deg=-20.0, by="the mount")
    said = {"elevation_deg": 61.5, "azimuth_deg": -20.0, "by": "the mount", "reason": ""}
    assert command.as_fields() == said
