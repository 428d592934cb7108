"""A service that does whatever it is asked: REST is tried with it where no other is needed."""

from dataclasses import dataclass, field

from service.runtime.command_results import Refits
from service.runtime.snapshot import Snapshot
from service.tracking.commands import Refit
from service.tracking.events import MakeMatrix
from service.tracking.policy import Policy
from service.tracking.state import TrackerState
from tests.unit.test_api import LINK
from tests.unit.tracking.situations import POLICY


@dataclass
class Obedient:
    """Holds a real state and remembers what it was asked."""

    tracker: TrackerState = field(default_factory=lambda: TrackerState(system="flao-lbt"))
    now_ns: int = 0
    archive: object = None
    refusal: Exception | None = None
    commands: list = field(default_factory=list)
    refits: Refits = field(default_factory=Refits)
    policy: Policy = POLICY

    def snapshot(self):
        return Snapshot(
            tracker=self.tracker,
            link=LINK,
            now_ns=self.now_ns,
            started_ns=0,
            ready=True,
            ready_reason="ready",
            policy=self.policy,
        )

    async def submit(self, command, caller, order_id=""):
        if self.refusal is not None:
            raise self.refusal
        self.commands.append(command)
        if isinstance(command, Refit):
            effect = MakeMatrix(n_modes=command.n_modes or 1, why="", cause=order_id)
            self.refits.begin([effect], self.now_ns)
        return f"{type(command).__name__}: 1 action(s) under way"
