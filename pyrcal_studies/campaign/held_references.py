"""Changes of reference slopes against the whole service in simulated time.

Run: ``python -m pyrcal_studies.campaign.held_references --seeds 0:20 --output
var/held_references.jsonl --table table.md``. Each draw is a night of 110 s (of at most 70 s with a
fault, which ends 5 s after it was named) on the simulator's small telescope of 3 m in mode auto,
for a worst seeing of 0.9 arcsec. From 10 s on a shape is loaded every 20 s: amplitudes that fall as
order to the power -2 in modes 2 to 21 with random signs, 30 to 60 nm RMS. In place of a shape that
is refused as too large the next one is drawn. The RTC applies the references as it should, or from
25 s on with the sign turned, twice as large, or keeps the old ones; it shows what it applies, or
hides it and shows what was sent. A row has the changes, the alarms, the matrices taken back, when a
fault was named, and how much of each shape the mirror was measured to hold.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.observatory import SETTINGS, SMALL, Observatory, bench_of
from pyrcal_studies.campaign.rows import (
    Row,
    campaign_parser,
    complete,
    heading,
    line,
    range_of,
    tell,
)
from service.config import load_settings
from service.records import alarms
from service.records import commands as cmd
from service.records import events as ev
from service.records.products import Frame, MatrixState, ShapeKind
from service.records.state import Mode
from service.runtime.policy import policy_of

Array32 = NDArray[np.float32]

KINDS = ("as it should", "sign turned", "twice as large", "old ones kept")
FACTORS = {"sign turned": -1.0, "twice as large": 2.0}

NIGHT_S, FAULTY_NIGHT_S = 110.0, 70.0
MAKING_S = 3.0
"""Within that time references are made or refused."""
AFTERWARDS_S = 5.0
FIRST_S = 10.0
EVERY_S = 20.0
FAULT_S = 25.0
MAX_NAMED_S = 30.0
MODES = np.arange(2, 22)


@dataclass(frozen=True, slots=True, kw_only=True)
class Draw:
    """One night; two that are equal give the same row."""

    seed: int
    kind: str
    hidden: bool
    """True if the RTC shows what was sent, whatever it applies."""


def load_of(rng: np.random.Generator) -> cmd.LoadShape:
    """Return the order that loads a steep shape."""
    order = np.floor((np.sqrt(8.0 * (MODES + 1) + 1.0) - 1.0) / 2.0)
    shape = np.zeros(MODES[-1] + 1)
    shape[MODES] = rng.choice([-1.0, 1.0], len(MODES)) / order**2
    shape *= rng.uniform(30.0, 60.0) / np.linalg.norm(shape)
    return cmd.LoadShape(
        kind=ShapeKind.MODES, frame=Frame.MIRROR, values=tuple(shape.tolist()), unit="nm"
    )


def spoil_of(kind: str) -> Callable[[Array32, Array32], Array32] | None:
    """Return what the RTC applies, as a function of the present and the requested offset."""
    if kind == "old ones kept":
        return lambda present, _: present
    factor = FACTORS.get(kind)
    return None if factor is None else lambda _, requested: np.float32(factor) * requested


def play(draw: Draw) -> Row:
    """Play one night."""
    rng = np.random.default_rng([draw.seed, 51])
    words = [
        *(f"--instrument={SMALL}", "--plant=linear", "--imperfections=ideal", "--mag=8"),
        *("--optical-gain=0.7,0.9", "--n-controlled=45", f"--seed={draw.seed}"),
    ]
    given = {"dither.budget_m": 20e-9, "dither.amplitude_m": 10e-9, "control.n_modes_target": 45}
    given["references.worst_seeing_arcsec"] = 0.9
    policy = policy_of(load_settings(None, {}, {**SETTINGS, **given}))
    spoil = spoil_of(draw.kind)
    night_s = NIGHT_S if spoil is None else FAULTY_NIGHT_S
    loads = np.arange(FIRST_S, night_s - EVERY_S / 2, EVERY_S) if spoil is None else (10.0, 30.0)
    with threadpool_limits(1):
        night = Observatory(words, policy, Mode.AUTO, bench_of(SMALL), with_poles=False)
        for time_s in sorted({*map(float, loads), FAULT_S, night_s}):
            while night.time_s < time_s and alarms.REFERENCES_MISAPPLIED not in _named(night):
                night.advance(min(time_s - night.time_s, 1.0))
            if time_s == FAULT_S and spoil is not None:
                night.dome.computer.spoil_references(spoil, hidden=draw.hidden)
            elif time_s in loads and alarms.REFERENCES_MISAPPLIED not in _named(night):
                _load_accepted(night, rng)
        if spoil is not None:
            night.advance(AFTERWARDS_S)
    return asdict(draw) | _found(night)


def _load_accepted(night: Observatory, rng: np.random.Generator) -> None:
    """Load shapes until one is not refused."""
    accepted = False
    while not accepted:
        night.command(load_of(rng))
        night.advance(MAKING_S)
        accepted = night.state.references.records[-1].state is not MatrixState.REFUSED


def _named(night: Observatory) -> dict[str, float]:
    """Return when each alarm was first seen, seconds."""
    found: dict[str, float] = {}
    for glance in night.glances:
        for name in glance.alarms:
            found.setdefault(name, glance.time_s)
    return found


def _found(night: Observatory) -> Row:
    start_s = night.time_s - night.now_ns() * 1e-9
    used = [r for r in night.state.references.records if r.applied_ns_utc and r.shape]
    applied_s = [(r.applied_ns_utc or 0) * 1e-9 + start_s for r in used]
    first_s = min((t for t in applied_s if t > FAULT_S), default=float("nan"))
    named = _named(night)
    named_s = named.pop(alarms.REFERENCES_MISAPPLIED, None)
    held = [event for _, event in night.events if isinstance(event, ev.ShapeHeld)]
    last = {event.id: (event.ratio, event.sigma) for event in held}
    worse = [e for _, e in night.events if isinstance(e, ev.Compared)]
    return {
        "n_changes": sum(r.applied_ns_utc is not None for r in night.state.references.records),
        "named_s": None if named_s is None else named_s - first_s,
        "held": [list(one) for one in last.values()],
        "n_worse": sum(event.finding.verdict == "worse" for event in worse),
        "n_accepted": night.state.windows.accepted,
        "n_refused": night.state.windows.refused,
        "alpha": str(
            night.state.alpha.registration and night.state.alpha.registration.validity.level
        ),
        "closed": night.dome.moments[-1].closed,
        "alarms": sorted(named),
    }


def table(rows: list[Row]) -> str:
    """Return the campaign as a Markdown table."""
    text = heading(
        *("The RTC", "What it shows", "Nights", "Changes", "Named within 30 s", "Named after, s"),
        *("Matrices taken back", "Other alarms"),
    )
    for kind, hidden in dict.fromkeys((row["kind"], row["hidden"]) for row in rows):
        of = [row for row in rows if (row["kind"], row["hidden"]) == (kind, hidden)]
        named = [row["named_s"] for row in of if row["named_s"] is not None]
        soon = [time_s for time_s in named if time_s <= MAX_NAMED_S]
        others = sorted({name for row in of for name in row["alarms"]})
        text += line(
            *(kind, "what was sent" if hidden else "what it applies", len(of)),
            sum(row["n_changes"] for row in of),
            f"{len(soon)} of {len(of)}",
            f"{np.median(named):.1f}, at most {max(named):.1f}" if named else "-",
            sum(row["n_worse"] for row in of),
            ", ".join(others) or "none",
        )
    return text


def is_right(row: Row) -> bool:
    """Return whether a night is as it should be: named where the RTC shows it, else no alarm."""
    if row["kind"] == "as it should":
        return bool(row["named_s"] is None and not row["alarms"] and not row["n_worse"])
    shown = row["hidden"] or (row["named_s"] is not None and row["named_s"] <= MAX_NAMED_S)
    return bool(shown and row["closed"] and not row["n_worse"])


def main() -> int:
    """Play what is missing, then print the table; 1 if a night is not as it should be."""
    parser = campaign_parser("held_references", __doc__)
    parser.add_argument("--seeds", type=range_of, default=range(40), metavar="FIRST:END")
    given = parser.parse_args()
    draws = [
        Draw(seed=seed, kind=kind, hidden=hidden)
        for seed in given.seeds
        for kind in KINDS
        for hidden in (False, True)
        if not (kind == "as it should" and hidden)
    ]
    # What the RTC shows is compared as bytes: those nights come last.
    draws.sort(key=lambda draw: not draw.hidden and draw.kind in KINDS[1:])
    rows = complete(play, draws, given)
    tell(table(rows), given.table, parser.prog)
    return int(not all(is_right(row) for row in rows))


if __name__ == "__main__":
    sys.exit(main())
