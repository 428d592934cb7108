"""Whatever operators ask, whatever runs: the mirror has one owner, and all comes to an end."""

import hypothesis.strategies as st
from hypothesis import HealthCheck, settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from service.records import commands as cmd
from service.records import events as ev
from service.records.operations import MeasureState
from service.tracking.interlocks import ALLOWS
from service.tracking.operations.running import OperationKind, running_operations
from service.wire import DitherStop, Loop, LoopRequest
from tests.support.activities import ACTIVITIES, COMMANDS, LONGEST_S, refused, strands

OWNERS = {
    OperationKind.MEASURING,
    OperationKind.GATHERING,
    OperationKind.RAMPING,
    OperationKind.ACQUIRING,
}
"""Each has the mirror and the loop to itself. A dither is not one of them: it makes way."""


def harmless(effect):
    """Whether it may be done though everything is stopped: only what makes the loop safer."""
    if not isinstance(effect, ev.Ask):
        return isinstance(effect, ev.FetchMatrix)
    request = effect.request
    opens = isinstance(request, LoopRequest) and request.loop is Loop.OPEN
    return opens or isinstance(request, DitherStop)


TROUBLES = ["loop-diverging", "commands-off-loop", "basis-mismatch", "matrix-mismatch"]


class Operators(RuleBasedStateMachine):
    """Several at once, none of whom looks first, and a night that does not go well."""

    @initialize(running=st.sampled_from(ACTIVITIES))
    def begin(self, running):
        self.world = running()
        self.quiet_from = None

    @rule(command=st.sampled_from(COMMANDS))
    def ask(self, command):
        running = running_operations(self.world.state, self.world.now_ns)
        refusal = refused(self.world, command)
        assert "\n" not in refusal
        forbidding = [one.text for one in running if type(command) not in ALLOWS[one.kind]]
        opens = isinstance(command, cmd.SetLoop) and command.loop == "open"
        if forbidding and not opens:
            assert refusal == forbidding[0]

    @rule(first=st.sampled_from(COMMANDS), second=st.sampled_from(COMMANDS))
    def ask_twice(self, first, second):
        self.ask(first)
        self.ask(second)

    @rule(seconds=st.sampled_from([0.5, 0.5, 2.0, 2.0, 7.0, 30.0]))
    def wait(self, seconds):
        self.world.pass_(seconds)

    @rule(name=st.sampled_from(TROUBLES), over=st.booleans())
    def trouble(self, name, over):
        self.world.tell(ev.ConditionChanged(name=name, text="found", over=over))

    @invariant()
    def the_mirror_has_one_owner(self):
        running = running_operations(self.world.state, self.world.now_ns)
        owners = [one.text for one in running if one.kind in OWNERS]
        assert len(owners) <= 1, owners

    @rule()
    def stop(self):
        assert refused(self.world, cmd.StopEverything(by="Ada")) == ""
        assert self.world.state.operator.stopped_because
        assert "everything was stopped" in str(self.world.state.alarms.active)

    @rule()
    def release(self):
        was_stopped = bool(self.world.state.operator.stopped_because)
        assert (refused(self.world, cmd.Resume()) == "") is was_stopped
        assert not self.world.state.operator.stopped_because

    @invariant()
    def what_is_stopped_stays_so_and_asks_for_nothing_but_what_is_safer(self):
        stopped, effects = bool(self.world.state.operator.stopped_because), self.world.effects
        if stopped and self.quiet_from is not None:
            assert not [one for one in effects[self.quiet_from :] if not harmless(one)]
            running = running_operations(self.world.state, self.world.now_ns)
            assert not [one for one in running if one.kind in OWNERS - {OperationKind.RAMPING}]
        self.quiet_from = len(effects) if stopped else None

    @invariant()
    def nothing_was_asked_of_an_rtc_that_was_at_something_else(self):
        """One that goes on with a measurement that was given up is: nothing can end that."""
        state = self.world.state
        given_up = [
            one for one in state.operations.measurements if one.state is MeasureState.GIVEN_UP
        ]
        busy = [entry.text for entry in state.log if "busy: " in entry.text]
        assert given_up or not busy, busy

    def teardown(self):
        for name in TROUBLES:
            self.trouble(name, over=True)
        passed_s = 0.0
        while strands(self.world) and passed_s < LONGEST_S:
            self.wait(5.0)
            passed_s += 5.0
        assert not strands(self.world)


TestOperators = Operators.TestCase
TestOperators.settings = settings(
    max_examples=15,
    stateful_step_count=30,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
