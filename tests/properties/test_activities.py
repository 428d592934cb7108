"""Whatever operators ask, whatever runs: the mirror has one owner, and all comes to an end."""

import hypothesis.strategies as st
from hypothesis import HealthCheck, settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from service.tracking import commands as cmd
from service.tracking import events as ev
from service.tracking.activity import ALLOWS, Activity, under_way
from tests.unit.tracking.test_activity import (
    ACTIVITIES,
    COMMANDS,
    LONGEST_S,
    refused,
    strands,
)

OWNERS = {Activity.MEASURING, Activity.GATHERING, Activity.RAMPING, Activity.ACQUIRING}
"""Each has the mirror and the loop to itself. A dither is not one of them: it makes way."""

TROUBLES = ["loop-diverging", "commands-off-loop", "basis-mismatch", "matrix-mismatch"]


class Operators(RuleBasedStateMachine):
    """Several at once, none of whom looks first, and a night that does not go well."""

    @initialize(running=st.sampled_from(ACTIVITIES))
    def begin(self, running):
        self.world = running()

    @rule(command=st.sampled_from(COMMANDS))
    def ask(self, command):
        running = under_way(self.world.state, self.world.now_ns)
        refusal = refused(self.world, command)
        assert "\n" not in refusal
        forbidding = [one.text for one in running if type(command) not in ALLOWS[one.activity]]
        opens = isinstance(command, cmd.SetLoop) and command.closed is False
        if forbidding and not opens:
            assert refusal == f"{type(command).__name__}: {forbidding[0]}"

    @rule(first=st.sampled_from(COMMANDS), second=st.sampled_from(COMMANDS))
    def ask_twice(self, first, second):
        self.ask(first)
        self.ask(second)

    @rule(seconds=st.sampled_from([0.5, 0.5, 2.0, 2.0, 7.0, 30.0]))
    def wait(self, seconds):
        self.world.pass_(seconds)

    @rule(name=st.sampled_from(TROUBLES), over=st.booleans())
    def trouble(self, name, over):
        self.world.tell(ev.Trouble(name=name, text="found", over=over))

    @invariant()
    def the_mirror_has_one_owner(self):
        running = under_way(self.world.state, self.world.now_ns)
        owners = [one.text for one in running if one.activity in OWNERS]
        assert len(owners) <= 1, owners

    @invariant()
    def nothing_was_asked_of_an_rtc_that_was_at_something_else(self):
        assert not [entry.text for entry in self.world.state.log if "busy: " in entry.text]

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
    max_examples=40,
    stateful_step_count=30,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
