"""Whether an order may be given now is decided once: what ``permitted`` says is what is done."""

import inspect
from functools import cache

import pytest

from service.errors import CommandError, UnknownIdError
from service.tracker import step
from service.tracking import commands as cmd
from service.tracking.interlocks import ORDERS, Permission, permissions, permitted
from tests.unit.tracking.moments import MOMENTS, in_use, meant, proposed, refused_since
from tests.unit.tracking.operations.test_running import COMMANDS, ramping

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


def test_a_gain_ramp_lets_the_loop_be_opened_and_nothing_else_changed():
    assert permission_for(ramping, ORDERS["open_loop"]).allowed
