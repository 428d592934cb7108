"""Kill the service again and again; what it has acknowledged must be there afterwards.

Run: ``python -m pyrcal_studies.restarts --rounds 200 --output var/restarts.jsonl``. A service of
the small telescope on a data folder of its own, and a simulated RTC that goes on all the while. In
each round somebody gives orders over REST, and the service alone is killed with SIGKILL at a random
moment: in three rounds of four about when it answers an order to publish. Then it is started anew
and asked.

An order counts as acknowledged when its answer of 2xx has come back. The RTC's own account, its
truth file, says which matrix closes the loop.
"""

from __future__ import annotations

import io
import statistics
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from pyrcal_studies.campaign.rows import RowFile
from pyrcal_studies.live import WITHIN_S, Telescope, tracks
from pyrcal_studies.shared import study_parser

ASKED_S = 5.0
"""From the start of the process until it tracks again."""

PUBLISH_S = 0.4
"""A kill comes at most so long after an order to publish has been sent."""

IDLE_S = 1.5
"""... or, in the other rounds, after the first order."""


@dataclass(kw_only=True)
class Round:
    """One kill and what was found after it."""

    number: int
    publishing: bool
    """Whether the kill came while an order to publish had been sent and not yet been answered."""

    acknowledged: int = 0
    """Orders so far in all rounds."""

    answers_s: float | None = None
    """From the start of the process until REST answers."""

    tracks_s: float | None = None
    """... until the registration it had is there, the RTC is known and frames come in."""

    window_s: float | None = None
    """... until the first window of its own."""

    broken: list[str] = field(default_factory=list)
    """What should have been found, or should not."""


@dataclass(kw_only=True)
class Acknowledged:
    """What the service has said that it has done."""

    notes: list[str] = field(default_factory=list)
    products: list[str] = field(default_factory=list)
    pins: list[str] = field(default_factory=list)
    mode: str = "auto"
    n_orders: int = 0


class Operator:
    """Gives orders, and remembers those that were acknowledged."""

    def __init__(self, telescope: Telescope, rng: np.random.Generator) -> None:
        self._telescope, self._rng = telescope, rng
        self.told = Acknowledged()
        self._answered = threading.Event()

    def orders(self, number: int) -> None:
        """Note, pin and change the mode, as far as the service lets him."""
        text = f"round {number}: {self._rng.integers(1 << 30):x}"
        if self._send("POST", "/v1/annotations", {"note": text}):
            self.told.notes.append(text)
        mode = ("auto", "propose", "hold")[int(self._rng.integers(3))]
        if self._send("PUT", "/v1/mode", {"mode": mode}):
            self.told.mode = mode
        own = self._own()
        if own and self._send("PUT", f"/v1/archive/{own[-1]}/pin", None):
            self.told.pins.append(own[-1])

    def publish(self) -> None:
        """Send the newest matrix again; an answer may never come."""
        own = self._own()
        if not own:
            return
        answer = self._send("POST", f"/v1/reconstructors/{own[-1]}/publish", None)
        if answer:
            self.told.products.append(answer.split(" ", 1)[0])
            self.told.mode = "hold"
        self._answered.set()

    @property
    def answered(self) -> bool:
        """Whether the order to publish has been answered."""
        return self._answered.is_set()

    def _own(self) -> list[str]:
        with suppress(httpx.HTTPError):
            found = self._telescope.get("/v1/reconstructors")["reconstructors"]
            return [one["id"] for one in found if one["state"] in {"applied", "superseded"}][1:]
        return []

    def _send(self, method: str, path: str, body: object) -> str:
        """Return what an acknowledged order was answered; empty: it was not."""
        with suppress(httpx.HTTPError):
            with httpx.Client(base_url=self._telescope.client.base_url, timeout=20.0) as client:
                answer = client.request(method, path, json=body)
            if answer.is_success:
                self.told.n_orders += 1
                return str(answer.json().get("text", "yes")) or "yes"
        return ""


def one_round(telescope: Telescope, told: Acknowledged, number: int, seed: int) -> Round:
    """Give orders, kill, start anew and look."""
    rng = np.random.default_rng([seed, number])
    operator = Operator(telescope, rng)
    operator.told = told
    wanted = number % 4 != 3
    giving = threading.Thread(
        target=operator.publish if wanted else operator.orders,
        args=() if wanted else (number,),
    )
    giving.start()
    time.sleep(float(rng.uniform(0.0, PUBLISH_S if wanted else IDLE_S)))
    found = Round(number=number, publishing=wanted and not operator.answered)
    telescope.kill()
    giving.join()
    found.acknowledged = told.n_orders
    begun_s = telescope.start()
    found.answers_s = telescope.wait(begun_s, lambda _: True)
    found.tracks_s = telescope.wait(begun_s, tracks)
    if found.tracks_s is None:
        found.broken.append(f"does not track within {WITHIN_S:g} s: {telescope.says()}")
        return found
    _look(telescope, told, found)
    found.window_s = telescope.wait(begun_s, lambda state: state["registration"]["n_windows"] > 0)
    if found.window_s is None:
        found.broken.append(f"no window within {WITHIN_S:g} s")
    return found


def _look(telescope: Telescope, told: Acknowledged, found: Round) -> None:
    """Hold what the service says against what it has acknowledged and what the RTC does."""
    state = telescope.state() or {}
    shelf = {one["id"]: one for one in telescope.get("/v1/reconstructors")["reconstructors"]}
    lost = [name for name in told.products if name not in shelf]
    found.broken += [f"{name} was acknowledged and is gone" for name in lost]
    notes = {one["note"] for one in telescope.get("/v1/annotations")["annotations"]}
    found.broken += [f"the note {text!r} is gone" for text in told.notes if text not in notes]
    archive = telescope.get("/v1/archive")["products"]
    kept = {one["id"]: "pin" in one["kept_because"] for one in archive}
    found.broken += [f"{name} is not pinned" for name in set(told.pins) if not kept.get(name)]
    # a kill may come between the answer's making and its arrival, never the other way round
    if state["mode"] != told.mode and state["mode"] != "hold":
        found.broken.append(f"mode {state['mode']}, acknowledged was {told.mode}")
    told.mode = state["mode"]
    said, in_use = telescope.agreed_in_use()
    if said != in_use:
        found.broken.append(f"{said} is said to be in use, the RTC has {in_use}")
    found.broken += _half_products(telescope, shelf)


def _half_products(telescope: Telescope, shelf: dict[str, Any]) -> list[str]:
    """Return which matrices cannot be read whole, or are said to be on their way for ever."""
    broken = []
    for name, record in list(shelf.items())[-4:]:
        answer = telescope.client.get(f"/v1/reconstructors/{name}/matrix")
        if answer.status_code != httpx.codes.OK:
            broken.append(f"{name}: {answer.text}")
            continue
        matrix = np.load(io.BytesIO(answer.content))
        if matrix.shape[0] != record["n_modes"] or not np.isfinite(matrix).all():
            broken.append(f"{name}: {matrix.shape} of {record['n_modes']} modes")
    # what it writes at this moment is its own, and the next save takes the place of the last one's
    parts = telescope.directory.glob("data/**/*.part")
    left = [one.name for one in parts if one.name != "tracking.json.part" and _is_older(one)]
    return broken + [f"{name} is left on the disk" for name in left]


def _is_older(path: Path) -> bool:
    """Return whether a file has not been written to for as long as a service needs to begin."""
    with suppress(FileNotFoundError):
        return time.time() - path.stat().st_mtime > ASKED_S
    return False


def run(n_rounds: int, seed: int, output: Path, directory: Path) -> list[Round]:
    """Run rounds, and write what came of each at once."""
    telescope, told, rounds = Telescope(directory, seed), Acknowledged(), []
    file = RowFile(output)
    try:
        begun_s = telescope.start()
        telescope.start_rtc()
        if telescope.wait(begun_s, lambda state: len(telescope.applied()) > 1) is None:
            raise RuntimeError(f"no matrix was applied within {WITHIN_S:g} s: see {directory}")
        for number in range(n_rounds):
            rounds.append(one_round(telescope, told, number, seed))
            file.add(asdict(rounds[-1]))
            if rounds[-1].tracks_s is None:
                break
    finally:
        telescope.end()
    return rounds


def summary(rounds: list[Round]) -> str:
    """Return what came of all rounds, for a person."""
    broken = [f"round {one.number}: {text}" for one in rounds for text in one.broken]
    lines = [
        f"{len(rounds)} kills, {sum(one.publishing for one in rounds)} while publishing; "
        f"{rounds[-1].acknowledged if rounds else 0} orders acknowledged; {len(broken)} broken",
        *broken,
    ]
    for name, text in (("answers_s", "answers"), ("tracks_s", "tracks"), ("window_s", "a window")):
        took = [s for one in rounds if (s := getattr(one, name)) is not None]
        if took:
            lines.append(
                f"{text} after {min(took):.1f} to {max(took):.1f} s, median "
                f"{statistics.median(took):.1f}; later than {ASKED_S:g} s: "
                f"{sum(s > ASKED_S for s in took)}"
            )
    return "\n".join(lines)


def main() -> int:
    """Run what is asked for; the exit status is 1 if anything was broken."""
    parser = study_parser("pyrcal_studies.restarts", __doc__)
    parser.add_argument("--rounds", type=int, default=200, metavar="N")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--directory", type=Path, help="data folder and logs, kept afterwards")
    parser.add_argument("--output", type=Path, default=Path("var/restarts.jsonl"))
    given = parser.parse_args()
    given.output.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(prefix="restarts-") as folder:
        directory = given.directory or Path(folder)
        directory.mkdir(parents=True, exist_ok=True)
        rounds = run(given.rounds, given.seed, given.output, directory)
    sys.stdout.write(summary(rounds) + "\n")
    return int(len(rounds) < given.rounds or any(one.broken for one in rounds))


if __name__ == "__main__":
    sys.exit(main())
