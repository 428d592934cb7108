"""Twenty RTCs that are not what they are told to be, in ``auto``: what is sent, what is named.

Run: ``python -m pyrcal_studies.campaign.mistold --instrument tests/system/small.toml --plant linear
--output var/mistold.jsonl --table table.md``; nights that are there already are not run again. The
first matrix is the RTC's own and its loop is healthy; every matrix sent would be one too many.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits
from typing_extensions import override

from pyrcal_studies.campaign.observatory import Observatory
from pyrcal_studies.campaign.rows import Row, RowFile
from pyrcal_studies.campaign.strange_rtc import Dialect, StrangeDome, StrangeLink
from service.config import load_settings
from service.instrument import load_instrument
from service.model.kinds import SlopeOrder
from service.model.pupil import rtc_valid_subapertures
from service.model.slopes import Orientation, SlopeRecipe, to_rtc
from service.runtime.policy import policy_of
from service.runtime.worker import Compute, OpticsWorker, Sampling
from service.tracking.state import Mode
from service.wire import LoopRequest, Status

GAINS = {"linear": 0.4, "diffractive": 0.6}
NAMING = ("matrix-mismatch", "response-mismatch", "loop-law", "command-unit", "commands-off-loop")


AS_TOLD = Orientation()


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One RTC: what it truly is where that is not what is told."""

    name: str
    words: str
    """What an alarm must say of it."""

    order: SlopeOrder = SlopeOrder.XY
    orientation: Orientation = AS_TOLD
    unit: float = 1.0
    """Commands on the wire over metres of OPD."""

    leak: float | None = None
    """The true one; told is that of the start."""

    delay_frames: int = 2
    """The true one; told are 2."""

    gain: float = 1.0
    """The true one over the one told."""


def _axes(name: str, words: str, *flips: str, sign_x: int = 1, sign_y: int = 1) -> Case:
    axes = replace(AS_TOLD, sign_x=sign_x, sign_y=sign_y, **dict.fromkeys(flips, True))
    return Case(name=name, words=words, orientation=axes)


CASES = (
    Case(name="as told", words=""),
    _axes("both signs", "sign = -1", sign_x=-1, sign_y=-1),
    _axes("sign of Sx", "sign = [-1, 1]", sign_x=-1),
    _axes("sign of Sy", "sign = [1, -1]", sign_y=-1),
    _axes("x flipped", "flip_x = true", "flip_x"),
    _axes("y flipped", "flip_y = true", "flip_y"),
    _axes("half a turn", "flip_x = true, flip_y = true", "flip_x", "flip_y"),
    _axes("axes exchanged", "swap_xy = true", "swap_xy"),
    _axes("a quarter turn", "swap_xy = true, flip_x = true", "swap_xy", "flip_x"),
    Case(name="yx", words='order = "yx"', order=SlopeOrder.YX),
    Case(name="interleaved", words='order = "interleaved"', order=SlopeOrder.INTERLEAVED),
    Case(
        name="interleaved with sign",
        words='order = "interleaved", orientation = { sign = -1 }',
        order=SlopeOrder.INTERLEAVED,
        orientation=replace(AS_TOLD, sign_x=-1, sign_y=-1),
    ),
    Case(name="nanometres", words="nanometres", unit=1e9),
    Case(name="micrometres", words="micrometres", unit=1e6),
    Case(name="millimetres", words="millimetres", unit=1e3),
    Case(name="surface", words="surface", unit=0.5),
    Case(name="leak 0.9", words="leak 0.900 found, 0.990 in the status", leak=0.9),
    Case(name="leak 0.97", words="leak 0.970 found, 0.990 in the status", leak=0.97),
    Case(name="delay 3", words="delay 3.00 frames found, 2.00 in the status", delay_frames=3),
    Case(name="delay 1", words="delay 1.00 frames found, 2.00 in the status", delay_frames=1),
    Case(name="gain half", words="gain 0.5 times the one in the status", gain=0.5),
)
TOLD_LEAK, TOLD_DELAY = 0.99, 2


class MistoldDome(StrangeDome):
    """A telescope whose RTC is one thing and is told to be another, from the first frame on."""

    def __init__(self, words: Sequence[str], case: Case) -> None:
        super().__init__(words)
        self._case = case
        self.dialect = _dialect(case, self)
        if case.leak is not None:
            self.computer.execute(LoopRequest(id="true-leak", leak=case.leak))
        if case.gain != 1.0:
            gains = tuple(case.gain * gain for gain in self.computer.status().gains)
            self.computer.execute(LoopRequest(id="true-gain", gains=gains))

    @override
    def status(self) -> Status:
        """Return what the RTC says of itself."""
        case, status = self._case, super().status()
        return replace(
            status,
            leak=TOLD_LEAK,
            delay_frames=float(TOLD_DELAY),
            gains=tuple(gain / case.gain for gain in status.gains),
        )


def _dialect(case: Case, dome: StrangeDome) -> Dialect:
    """Return how this RTC lists what the simulator has in the conventions' order."""
    recipe = SlopeRecipe(order=case.order, orientation=case.orientation)
    spoken = replace(dome.instrument, slopes=recipe)
    n_slopes = 2 * int(rtc_valid_subapertures(spoken).sum())
    # numbers from 1 on, so that a sign shows
    listed = to_rtc(np.arange(1, n_slopes + 1), recipe, rtc_valid_subapertures(spoken))
    return Dialect(
        index=np.abs(listed) - 1, sign=np.sign(listed).astype(np.float32), unit=case.unit
    )


def play(case: Case, given: argparse.Namespace) -> Row:
    """Run one night and return what came of it."""
    n_modes = given.n_controlled
    words = [
        f"--instrument={given.instrument}",
        f"--plant={given.plant}",
        f"--n-controlled={n_modes}",
        f"--gain={GAINS[given.plant]}",
        f"--leak={TOLD_LEAK}",
        f"--delay={case.delay_frames}",
        f"--mag={given.magnitude}",
        "--alpha=0.12,-0.08,0.2,1.003",
        "--seed=1",
    ]
    instrument = load_instrument(given.instrument)
    pinned = replace(instrument, slopes=replace(instrument.slopes, orientation=AS_TOLD))
    settings = load_settings(None, {}, {"control.n_modes_target": n_modes})
    begun = time.process_time()
    with threadpool_limits(1):
        working = settings.compute.working_point_modes if given.plant == "diffractive" else None
        bench = OpticsWorker(
            pinned, Compute(threads=1, sampling=Sampling(working_point_modes=working))
        )
        night = Observatory(
            words,
            policy_of(settings),
            Mode.AUTO,
            bench,
            with_poles=False,
            dome=MistoldDome(words, case),
            link=StrangeLink,
        )
        texts: dict[str, tuple[float, str]] = {}
        while night.time_s < given.seconds:
            night.advance(0.5)
            for alarm in night.state.alarms.active:
                texts.setdefault(alarm.name, (night.time_s, alarm.text))
    naming = [(at, name) for name, (at, text) in texts.items() if _named(case, name, text)]
    at_s, by = min(naming) if naming else (None, None)
    closed = [m for m in night.dome.moments if m.closed]
    return {
        "case": case.name,
        "instrument": Path(given.instrument).stem,
        "plant": given.plant,
        "named_s": at_s,
        "by": by,
        "sent": len(night.swaps),
        "opened": len(closed) < len(night.dome.moments),
        "worst_nm": max(moment.wavefront_nm for moment in night.dome.moments),
        "alarms": {name: text for name, (_, text) in texts.items()},
        "cpu_s": time.process_time() - begun,
    }


def _named(case: Case, alarm: str, text: str) -> bool:
    return bool(case.words) and alarm in NAMING and case.words in text


def table(rows: Iterable[Row]) -> str:
    """Return the rows in Markdown."""
    head = "| instrument, plant | RTC | named after | by | sent | loop opened | worst |"
    lines = [head, "| --- | --- | --- | --- | --- | --- | --- |"]
    for row in rows:
        named = "-" if row["named_s"] is None else f"{row['named_s']:.1f} s"
        lines.append(
            f"| {row['instrument']}, {row['plant']} | {row['case']} | {named} | {row['by'] or '-'} "
            f"| {row['sent']} | {'yes' if row['opened'] else 'no'} | {row['worst_nm']:.0f} nm |"
        )
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(prog="python -m pyrcal_studies.campaign.mistold")
    parser.add_argument("--instrument", default="tests/system/small.toml", metavar="NAME|FILE")
    parser.add_argument("--plant", choices=tuple(GAINS), default="linear")
    parser.add_argument("--n-controlled", type=int, default=45)
    parser.add_argument("--magnitude", type=float, default=8.0)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each night")
    parser.add_argument("--cases", default=",".join(case.name for case in CASES))
    parser.add_argument("--output", type=Path, default=Path("mistold.jsonl"))
    parser.add_argument("--table", type=Path, metavar="FILE.md")
    given = parser.parse_args()
    file = RowFile(given.output)
    key = (Path(given.instrument).stem, given.plant)
    done = {row["case"] for row in file.rows if (row["instrument"], row["plant"]) == key}
    for case in CASES:
        if case.name in done or case.name not in given.cases.split(","):
            continue
        row = play(case, given)
        file.add(row)
        sys.stderr.write(table([row]).splitlines()[-1] + "\n")
    text = table(file.rows)
    sys.stdout.write(text)
    if given.table is not None:
        given.table.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
