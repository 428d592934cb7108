"""Carry a share of the telemetry only, so that it gets older, and see what the service does.

Run: ``python -m pyrcal_studies.slow_link --share 0.45 0.8 --seconds 45``. A service of the small
telescope and a simulated RTC, each a process. The link between them keeps all that the RTC sends in
a queue and passes on a share of its usual rate. After each share the queue is carried at once.
"""

from __future__ import annotations

import socket
import sys
import tempfile
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from typing_extensions import override

from pyrcal_studies.live import WITHIN_S, Cable, Telescope
from pyrcal_studies.shared import study_parser

OLD_S = 3.0
"""Age from which telemetry must be named and nothing may be made of it."""

SETTLED_S = 25.0
"""Time at the full rate before the first share, and after each."""

PIECE_BYTES = 16384
PERIOD_S = 0.1
"""Interval between two looks at the service."""


class SlowCable(Cable):
    """A connection with an endless queue towards the service, which carries ``bytes_per_s``."""

    def __init__(self, to_port: int) -> None:
        super().__init__(to_port)
        self.n_bytes = 0
        """Bytes that the RTC has sent."""

        self.age_s = 0.0
        """Time that the last piece has waited, seconds."""

    @override
    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        if sink.getpeername()[1] != self.to_port:
            super()._carry(source, sink)
            return
        waiting: deque[tuple[float, bytes]] = deque()
        threading.Thread(target=self._pass_on, args=(waiting, sink), daemon=True).start()
        with suppress(OSError):
            while data := source.recv(PIECE_BYTES):
                self.n_bytes += len(data)
                waiting.append((time.monotonic(), data))

    def _pass_on(self, waiting: deque[tuple[float, bytes]], sink: socket.socket) -> None:
        free_s = 0.0
        with suppress(OSError):
            while True:
                if not waiting:
                    time.sleep(0.001)
                    continue
                came_s, data = waiting.popleft()
                if self.bytes_per_s is not None:
                    # by a schedule, because a sleep lasts longer than requested
                    free_s = max(free_s, came_s) + len(data) / self.bytes_per_s
                    time.sleep(max(free_s - time.monotonic(), 0.0))
                else:
                    free_s = 0.0
                self.age_s = time.monotonic() - came_s
                sink.sendall(data)


@dataclass(kw_only=True)
class Outcome:
    """What the service did while the link carried a share."""

    share: float
    oldest_s: float = 0.0
    """Largest age of the telemetry."""

    named_s: float | None = None
    """From an age of ``OLD_S`` until the alarm; negative if the alarm came first."""

    windows: int = 0
    """Windows accepted while telemetry was older than ``OLD_S``."""

    matrices: int = 0
    """Reconstructors made meanwhile."""

    fresh_s: float = 0.0
    """Time for which α was ``fresh`` meanwhile."""

    back_s: float | None = None
    """From the moment at which the link carried everything again until the next window."""

    validity: list[str] = field(default_factory=list)
    """Validity of α meanwhile, in order."""


def run(shares: list[float], seconds: float, folder: Path) -> list[Outcome]:
    """Play the shares one after the other on one service."""
    telescope = Telescope(folder, seed=1)
    telescope.cable.close()
    cable = telescope.cable = SlowCable(telescope.zenoh_port)
    try:
        begun_s = telescope.start()
        telescope.start_rtc()
        if telescope.wait(begun_s, _is_known) is None:
            raise RuntimeError(f"no tracking within {WITHIN_S:g} s: {telescope.says()}")
        time.sleep(SETTLED_S)
        return [_play(telescope, cable, share, seconds) for share in shares]
    finally:
        telescope.end()


def _is_known(state: dict[str, Any]) -> bool:
    return state["registration"] is not None and state["windows_accepted"] > 0


def _play(telescope: Telescope, cable: SlowCable, share: float, seconds: float) -> Outcome:
    sent, since_s = cable.n_bytes, time.monotonic()
    time.sleep(5.0)
    rate = (cable.n_bytes - sent) / (time.monotonic() - since_s)
    outcome, began_s = Outcome(share=share), time.monotonic()
    old_s = alarm_s = None
    before: dict[str, int] = {}
    cable.bytes_per_s = share * rate
    last_s = began_s
    while (now_s := time.monotonic()) - began_s < seconds:
        state = telescope.get("/v1/state")
        counts = {
            "windows": state["windows_accepted"],
            "matrices": len(telescope.get("/v1/reconstructors")["reconstructors"]),
        }
        outcome.oldest_s = max(outcome.oldest_s, cable.age_s)
        names = [alarm["name"] for alarm in state["alarms"]]
        if alarm_s is None and "telemetry-old" in names:
            alarm_s = now_s
        if old_s is None and cable.age_s >= OLD_S:
            old_s, before = now_s, counts
        if old_s is not None:
            outcome.windows = counts["windows"] - before["windows"]
            outcome.matrices = counts["matrices"] - before["matrices"]
            level = state["registration"]["validity"]
            outcome.fresh_s += (level == "fresh") * (now_s - last_s)
            if level not in outcome.validity[-1:]:
                outcome.validity.append(level)
        last_s = now_s
        time.sleep(PERIOD_S)
    if old_s is not None and alarm_s is not None:
        outcome.named_s = alarm_s - old_s
    cable.bytes_per_s, n_windows = None, telescope.get("/v1/state")["windows_accepted"]
    outcome.back_s = telescope.wait(
        time.monotonic(), lambda state: state["windows_accepted"] > n_windows
    )
    time.sleep(SETTLED_S)
    return outcome


def table(outcomes: list[Outcome]) -> str:
    """Return what happened, one line for each share."""
    lines = [
        "| Share carried, % | Oldest telemetry, s | Named after 3 s old, s | Windows | Matrices | "
        "α fresh, s | Next window after the end, s |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for one in outcomes:
        named, back = (
            "never" if value is None else f"{value:.1f}" for value in (one.named_s, one.back_s)
        )
        lines.append(
            f"| {100 * one.share:.1f} | {one.oldest_s:.1f} | {named} | {one.windows} | "
            f"{one.matrices} | {one.fresh_s:.1f} ({', '.join(one.validity)}) | {back} |"
        )
    return "\n".join(lines)


def main() -> int:
    """Run what is asked for; the exit status is 1 if old telemetry was used or not named."""
    parser = study_parser("pyrcal_studies.slow_link", __doc__)
    parser.add_argument("--share", type=float, nargs="+", default=[0.45, 0.8], metavar="X")
    parser.add_argument("--seconds", type=float, default=45.0, metavar="S", help="for each share")
    parser.add_argument("--directory", type=Path, help="data folder and logs, kept afterwards")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="slow-link-") as folder:
        directory = given.directory or Path(folder)
        directory.mkdir(parents=True, exist_ok=True)
        outcomes = run(given.share, given.seconds, directory)
    sys.stdout.write(table(outcomes) + "\n")
    named = all(
        one.oldest_s < OLD_S or (one.named_s is not None and one.named_s <= 3.0) for one in outcomes
    )
    return int(not named or any(one.windows or one.matrices for one in outcomes))


if __name__ == "__main__":
    sys.exit(main())
